"""What a run would tell, as a smooth function of its rate and its revolutions: for planning.

At constant rate every column of the term table is an exact combination of a few functions of the
spindle angle th: th^2, th^3, and cos, sin, th cos, th sin of its first harmonics. The functions
do not know the rate and their weights do not know the length of the run. So a run's square-root
information is

    R(revolutions) @ W(rate),

R the triangular factor of the whitened functions with the run's own start errors projected out,
W the weights, which are polynomials in the rate. Both are found once, from the same columns and
the same whitening as a calibration's; afterwards a run costs a few small products. Between whole
revolutions R follows the smooth curve through them, without the ripple of a few parts in 1e4 that
a fraction of a revolution adds.

- `RunInformation`: blocks of square-root information, many runs at once
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from numpy.polynomial import chebyshev

from counterspin.arrays import Array
from counterspin.inference.joint.prepared import Prepared, prepare_columns
from counterspin.inference.joint.series import Series, jitter_of
from counterspin.inference.joint.unknowns import Unknowns
from counterspin.inference.noise.model import NoiseModel, make_whitener
from counterspin.physics.accelerometer import Term
from counterspin.physics.motion import Trajectory
from counterspin.physics.shared_terms import term
from counterspin.physics.spindle import Spindle
from counterspin.planning.angle_functions import functions, integration, prefix_factors
from counterspin.planning.experimental_setup import PlannedInstrument, Setup

#: Highest harmonic of the products of the table; |a_I| has them all, falling off as n^-4 or so.
_HARMONICS: Final = 3
_HARMONICS_OF_KINK: Final = 11

_POINTS: Final = 4  #: rows to a revolution for each harmonic
_FITTED: Final = 3  #: revolutions over which the weights are found

#: Nodes in the rate: the weights are polynomials of the eighth degree (a_I^3 goes as w^6).
_RATE_NODES: Final = 13

#: Ratio of neighbouring nodes in the number of revolutions.
_NODE_RATIO: Final = 1.13


class RunInformation:
    """Square-root information of runs in one set-up.

    Parameters
    ----------
    setup
        What is planned.
    rates
        Smallest and largest size of the rate, rad/s.
    revolutions
        Smallest and largest number of revolutions, at least 1.
    senses
        +1, -1 or both.
    """

    def __init__(
        self,
        setup: Setup,
        rates: tuple[float, float],
        revolutions: tuple[float, float],
        senses: Sequence[int],
    ) -> None:
        self.setup = setup
        kinked = any("|I|" in _factors(unknown.symbol) for unknown in setup.model.unknowns)
        kinked |= any("|I|" in _factors(other.symbol) for other in setup.model.considered)
        self._harmonics = _HARMONICS_OF_KINK if kinked else _HARMONICS
        low, high = rates
        # A single rate is a range too, or there would be nothing to interpolate.
        self._rates = (low * 0.99, high * 1.01) if high < 1.02 * low else rates
        self._counts = _whole_numbers(revolutions)
        self._factors = {
            key: self._factor(instrument)
            for key, instrument in {
                _key(instrument): instrument for instrument in setup.instruments
            }.items()
        }
        self._weights = {
            (name, sense): [self._weight(i, name, sense) for i in setup.instruments]
            for name in setup.attitudes
            for sense in senses
        }

    def blocks(self, attitude: str, sense: int, rate: Array, revolutions: Array) -> Array:
        """Return what runs say about the shared unknowns.

        Parameters
        ----------
        attitude, sense
            Of all the runs.
        rate, revolutions
            Size of the rate (rad/s) and length of each run, shape (n,).

        Returns
        -------
        Array
            Rows of unit variance, shape (n, b, p + q), b = `rows`: columns of the shared unknowns,
            then of the shared considered terms, then of the run's own considered terms. The run's
            own unknowns, start errors included, are projected out.
        """
        setup = self.setup
        own, _ = setup.own(attitude)
        parts = []
        for instrument, weight in zip(
            setup.instruments, self._weights[attitude, sense], strict=True
        ):
            weights = self._in_rate(weight, rate)
            parts.append(self._scaled(instrument, rate, revolutions) @ weights)
        rows = parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1)
        for prior in _weights_of_priors(setup.model, own):
            rows = _without_first(rows, float(prior))
        return rows

    @property
    def rows(self) -> int:
        """How many rows a run has in `blocks`."""
        return sum(len(self._used(instrument.order)) for instrument in self.setup.instruments)

    # The functions of the angle

    def _factor(self, instrument: PlannedInstrument) -> Any:
        """Return the spline of R over the logarithm of revolutions (and of the rate)."""
        from scipy.interpolate import NdBSpline, make_interp_spline

        points = _POINTS * (self._harmonics + 1)
        angle = (np.arange(points * self._counts[-1]) + 0.5) * (2.0 * math.pi / points)
        shapes = functions(angle, self._harmonics)
        along = np.log(self._counts)
        if instrument.noise.random_walk == 0.0:
            # White noise scales all rows alike: the rate and the size come in with `_scaled`.
            drop = instrument.order
            held = [column for column in range(4) if column < drop]
            used = [*held, *self._used(instrument.order)]
            prefixes = prefix_factors(shapes[:, used], self._counts * points, drop)
            return make_interp_spline(along, prefixes)
        nodes = _log_nodes(*self._rates)
        table = []
        for log_rate in nodes:
            rate = math.exp(log_rate)
            density = points * rate / (2.0 * math.pi)
            white = math.sqrt(self._variance(instrument, rate) * density / self.setup.sampling_rate)
            whiten = make_whitener(
                angle / rate,
                instrument.order,
                NoiseModel(white, instrument.noise.random_walk),
            )
            rows = whiten.apply(shapes[:, self._used(instrument.order)])
            ends = self._counts * points - instrument.order
            table.append(prefix_factors(rows, ends, 0))
        first = make_interp_spline(along, np.array(table), axis=1)
        # make_interp_spline puts its axis first: (revolutions, rates, ...) -> over the rates next.
        second = make_interp_spline(nodes, np.moveaxis(first.c, 0, 1))
        return NdBSpline((second.t, first.t), np.ascontiguousarray(second.c), 3)

    def _scaled(self, instrument: PlannedInstrument, rate: Array, revolutions: Array) -> Array:
        """Return R for each run, its rows of unit variance, shape (n, b, b)."""
        spline = self._factors[_key(instrument)]
        if instrument.noise.random_walk > 0.0:
            return np.asarray(spline(np.column_stack([np.log(rate), np.log(revolutions)])))
        points = _POINTS * (self._harmonics + 1)
        density = points * rate / (2.0 * math.pi)
        variance = self._variance(instrument, rate) * density / self.setup.sampling_rate
        factor: Array = np.asarray(spline(np.log(revolutions)), dtype=np.float64)
        return np.asarray(factor / np.sqrt(variance)[:, None, None])

    def _variance(self, instrument: PlannedInstrument, rate: Any) -> Any:
        """Return the white variance of one sample, that of jitter included."""
        jitter = jitter_of(instrument.jitter, self.setup.radius, rate, instrument.order)
        return instrument.noise.sample_variance + jitter**2

    def _used(self, order: int) -> list[int]:
        """Functions that are not start errors: for displacement all but 1 and th."""
        return list(range(order, 4 + 4 * self._harmonics))

    # The weights

    def _weight(self, instrument: PlannedInstrument, attitude: str, sense: int) -> Array:
        """Return Chebyshev coefficients of the weights over the rate, (nodes, b, columns)."""
        setup = self.setup
        own, own_considered = setup.own(attitude)
        wanted = [*own, *setup.shared]
        fixed = [*setup.considered, *own_considered]
        angle = np.linspace(0.0, 2.0 * math.pi * _FITTED, 24 * (self._harmonics + 1))
        constant_and_linear = [0, 1, *range(4, 4 + 4 * self._harmonics)]
        basis = functions(angle, self._harmonics)[:, constant_and_linear]
        solve = np.linalg.pinv(basis)
        integrate = integration(self._harmonics, instrument.order)
        low, high = self._rates
        nodes = chebyshev.chebpts1(_RATE_NODES)
        values = []
        for rate in 0.5 * (low + high) + 0.5 * (high - low) * nodes:
            prepared = self._forces(instrument, attitude, sense * rate, angle / rate)
            columns = np.zeros((angle.size, len(wanted) + len(fixed)))
            for column, index in zip(prepared.design.T, prepared.unknowns, strict=True):
                columns[:, wanted.index(index)] = column
            for column, index in zip(prepared.fixed.T, prepared.considered, strict=True):
                columns[:, len(wanted) + fixed.index(index)] = column
            weights = np.zeros((4 + 4 * self._harmonics, columns.shape[1]))
            weights[constant_and_linear] = solve @ columns
            # Multiplied with the rate, what grows with time is a polynomial in the rate as well.
            values.append(rate * (integrate @ weights)[self._used(instrument.order)])
        vander = chebyshev.chebvander(nodes, _RATE_NODES - 1)
        flat = np.array(values).reshape(_RATE_NODES, -1)
        coefficients: Array = np.asarray(np.linalg.solve(vander, flat), dtype=np.float64)
        return np.asarray(coefficients.reshape(_RATE_NODES, -1, len(wanted) + len(fixed)))

    def _in_rate(self, weight: Array, rate: Array) -> Array:
        low, high = self._rates
        place = (2.0 * rate - low - high) / (high - low)
        vander = chebyshev.chebvander(place, _RATE_NODES - 1) / rate[:, None]
        flat = vander @ weight.reshape(_RATE_NODES, -1)
        return np.asarray(flat.reshape(len(rate), *weight.shape[1:]))

    def _forces(
        self, instrument: PlannedInstrument, attitude: str, rate: float, times: Array
    ) -> Prepared:
        """Return the columns of the specific force, before any integration, times rate^-order."""
        setup = self.setup
        trajectory = Trajectory(Spindle(rate), setup.radius, setup.site)
        series = Series(
            accelerometer=instrument.name,
            run=attitude,
            trajectory=trajectory,
            mounting=instrument.mounting,
            observable="specific_force",
            attitude=setup.attitudes[attitude],
            time=times,
            spread=np.zeros_like(times),
            count=np.ones_like(times),
            spacing=float(times[1] - times[0]),
            error=np.zeros_like(times),
        )
        factors = {name: setup.scale_factors[name] for name in [instrument.name]}
        (prepared,) = prepare_columns([series], setup.model, factors, setup.estimate)
        scale = abs(rate) ** -instrument.order
        return replace(prepared, design=prepared.design * scale, fixed=prepared.fixed * scale)


def _without_first(rows: Array, prior: float) -> Array:
    """Project the first unknown out of rows, of which 1/u is known beforehand.

    What is left of the information is Y' (1 - x x'/(prior^2 + x'x)) Y, and its root is Y less a
    part of its component along x: exact, and no product is formed of which a root must be taken.
    """
    x, others = rows[:, :, :1], rows[:, :, 1:]
    size = np.sum(x**2, axis=1, keepdims=True)
    kept = prior / np.sqrt(prior**2 + size)
    along = np.sum(x * others, axis=1, keepdims=True) / np.where(size > 0.0, size, 1.0)
    return np.asarray(others - x * ((1.0 - kept) * along))


def _key(instrument: PlannedInstrument) -> tuple[object, ...]:
    """Return what tells apart the instruments whose functions are whitened differently."""
    if instrument.noise.random_walk == 0.0:
        return (instrument.order,)
    return (instrument.order, instrument.noise, instrument.jitter)


def _factors(symbol: str) -> tuple[str, ...]:
    row = term(symbol)
    return row.factors if isinstance(row, Term) else ()


def _weights_of_priors(model: Unknowns, places: Sequence[int]) -> Array:
    """Return 1/u of what is known of some unknowns; of nothing, the solver's regularisation."""
    chosen = [model.unknowns[i] for i in places]
    return np.array([1.0 / unknown.spread for unknown in chosen])


def _whole_numbers(between: tuple[float, float]) -> npt.NDArray[np.int64]:
    """Return whole numbers of revolutions that span a range, nearly in a geometric series."""
    low, high = max(1, math.floor(between[0])), math.ceil(between[1])
    high = max(high, low + 4)
    counts = [low]
    while counts[-1] < high:
        counts.append(max(counts[-1] + 1, round(counts[-1] * _NODE_RATIO)))
    return np.array(counts, dtype=np.int64)


def _log_nodes(low: float, high: float) -> Array:
    count = max(6, math.ceil(math.log(high / low) / 0.2) + 1)
    return np.linspace(math.log(low), math.log(high), count)

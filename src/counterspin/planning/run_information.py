"""What a run would tell, as a smooth function of its rate and its revolutions: for planning.

At constant rate every column of the term table is an exact combination of a few functions of the
spindle angle th: th^2, th^3, and cos, sin, th cos, th sin of its first harmonics. The functions
do not know the rate and their weights do not know the length of the run. So a run's square-root
information is

    R(rate, revolutions) @ W(rate),

R a factor of the whitened functions with the run's own start errors projected out, W the weights,
which are polynomials in the rate and found once, from the same columns as a calibration's. With
white noise R has a closed form (`counterspin.planning.even_samples`), exact for the very samples
of the record; with a random walk, or noise of the time stamps, it is interpolated
(`counterspin.planning.information_table`).
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Final

import numpy as np
import numpy.typing as npt
from numpy.polynomial import chebyshev

from counterspin.arrays import Array
from counterspin.inference.joint.inputs import CLOCK
from counterspin.inference.joint.prepared import Prepared, prepare_columns
from counterspin.inference.joint.series import Series
from counterspin.inference.joint.unknowns import Unknowns
from counterspin.inference.noise.model import Noise
from counterspin.physics.effects import RunConditions
from counterspin.physics.motion import Trajectory
from counterspin.physics.spindle import Spindle
from counterspin.physics.terms import CONDITION_TERMS
from counterspin.planning import even_samples
from counterspin.planning.angle_functions import functions, integration
from counterspin.planning.even_samples import EvenSamples
from counterspin.planning.experimental_setup import PlannedInstrument, Setup, expected_record
from counterspin.planning.information_table import InformationTable
from counterspin.records.reduction import block_size

#: Highest harmonics of the angle that are tried, until the columns are combinations of the
#: functions to `_RESIDUAL` of their size; |a_I| has all harmonics, falling off as n^-4 or so.
_HARMONICS: Final = (3, 4, 6, 11)
_RESIDUAL: Final = 1e-6

#: Nodes in the rate: the weights are polynomials of the tenth degree (a_I^4 goes as w^8).
_RATE_NODES: Final = 13

#: Step of the derivative by the clock.
_CLOCK_STEP: Final = 1e-6


class RunInformation:
    """Square-root information of runs in one set-up.

    rates: Smallest and largest size of the rate, rad/s.
    revolutions: Smallest and largest number of revolutions, at least 1.
    senses: +1, -1 or both.
    """

    def __init__(
        self,
        setup: Setup,
        rates: tuple[float, float],
        revolutions: tuple[float, float],
        senses: Sequence[int],
        like: RunInformation | None = None,
    ) -> None:
        self.setup = setup
        low, high = rates
        # A single rate is a range too, or there would be nothing to interpolate.
        self._rates = (low * 0.99, high * 1.01) if high < 1.02 * low else rates
        self._revolutions = revolutions
        #: Places, among the shared unknowns, of those that go with how warm a run is, and of those
        #: that go with when it is made.
        self._by_warmth, self._by_time = (
            _by_condition(setup, condition) for condition in ("temperature", "time")
        )
        for self._harmonics in _HARMONICS:
            fits = {
                (name, sense): [self._weight(i, name, sense) for i in setup.instruments]
                for name in setup.attitudes
                for sense in senses
            }
            if all(residual < _RESIDUAL for fit in fits.values() for _, residual in fit):
                break
        self._kinds = {kind: index for index, kind in enumerate(fits)}
        self._owns = max(len(setup.own(name)[0]) for name in setup.attitudes)
        self._weights: list[Array] = []
        #: Of what goes with time, the weights of one second later.
        self._late: list[Array] = []
        for i in range(len(setup.instruments)):
            found = [(name, fit[i][0]) for (name, _), fit in fits.items()]
            end = found[0][1].shape[2] - len(self._by_time)
            self._weights.append(np.array([self._padded(w[..., :end], name) for name, w in found]))
            self._late.append(np.array([w[..., end:] for _, w in found]))
        self._priors = np.ones((len(fits), self._owns))
        for kind, (name, _) in enumerate(fits):
            known = _weights_of_priors(setup.model, setup.own(name)[0])
            self._priors[kind, : known.size] = known
        serves = like is not None and like._harmonics == self._harmonics
        self._tables: list[list[InformationTable | None]]
        self._tables = like._tables if like and serves else self._made_tables()

    def _made_tables(self) -> list[list[InformationTable | None]]:
        """Return what is interpolated for each instrument and kind; None: there is a closed form.

        Noise of the time stamps goes with the slope of what this very kind of run records.
        """
        tables: dict[tuple[PlannedInstrument, object], InformationTable] = {}
        chosen: list[list[InformationTable | None]] = []
        for instrument in self.setup.instruments:
            noise = instrument.noise
            if instrument.order == 0:  # a random walk of the velocity is white in specific force
                walk = noise.random_walk**2 * self.setup.sampling_rate
                noise = Noise(math.sqrt(noise.sample_variance + walk))
            of_kinds: list[InformationTable | None] = []
            for kind in self._kinds:
                if noise.random_walk == 0.0 and instrument.timing == 0.0:
                    of_kinds.append(None)
                    continue
                key: tuple[PlannedInstrument, object] = (instrument, kind)
                if instrument.timing == 0.0:
                    first = self.setup.instruments[0].mounting
                    key = (replace(instrument, name="", mounting=first), None)
                if key not in tables:
                    tables[key] = InformationTable(
                        instrument.order,
                        noise,
                        partial(self._of_time_stamps, instrument, *kind)
                        if instrument.timing > 0.0
                        else None,
                        self.setup.sampling_rate,
                        self._rates,
                        self._revolutions,
                        self._harmonics,
                    )
                of_kinds.append(tables[key])
            chosen.append(of_kinds)
        return chosen

    def _of_time_stamps(
        self, instrument: PlannedInstrument, attitude: str, sense: int, rate: float, angle: Array
    ) -> Array:
        """Return the variance that noise of its time stamp adds to a sample, at angles, (n,)."""
        setup = self.setup
        series = self._series(instrument, attitude, sense * rate, angle / rate)
        expected = dict(zip(setup.model.unknowns, setup.estimate.tolist(), strict=True))
        expecting = expected_record(series, expected, setup.scale_factors[instrument.name])
        return expecting.with_timing(instrument.timing).jitter_variance

    def sampled_at(self, sampling_rate: float) -> RunInformation:
        """Return the same for another sampling rate, Hz."""
        other = copy.copy(self)
        other.setup = replace(self.setup, sampling_rate=sampling_rate)
        other._tables = other._made_tables()
        return other

    def blocks(
        self,
        types: Sequence[tuple[str, int]],
        rate: Array,
        revolutions: Array,
        *,
        whole_samples: bool = False,
        conditions: tuple[Array, Array] | None = None,
    ) -> Array:
        """Return what runs say about the shared unknowns.

        rate, revolutions: Size of the rate (rad/s) and length of each run, shape (..., n).
        conditions: When each run begins (s) and how warm it is (K from the reference), of a shape
            like the rate's; None: nothing changes from run to run.
        whole_samples: Whether the last sample is the last one that a run of this length has; False:
            as smooth functions of the length, with a part of a sample at the end.
        Returns: rows of unit variance, shape (..., n, b, p + q), b = `rows`: columns of the shared
            unknowns, then of the shared considered terms, then of the run's own considered terms,
            zero where an attitude has fewer of these than others. The run's own unknowns, start
            errors included, are projected out.
        """
        shape = rate.shape
        of_run = np.array([self._kinds[kind] for kind in types], dtype=np.intp)
        kinds = np.broadcast_to(of_run, shape).ravel()
        rate, revolutions = rate.ravel(), revolutions.ravel()
        samples = revolutions * (2.0 * math.pi * self.setup.sampling_rate) / rate
        samples = np.floor(samples * (1.0 + 1e-12)) + 1.0 if whole_samples else samples + 1.0
        start, warmth = (
            np.broadcast_to(one, shape).ravel()[:, None, None]
            for one in conditions or (np.zeros(()), np.zeros(()))
        )
        parts = []
        for instrument, tables, weight, late in zip(
            self.setup.instruments, self._tables, self._weights, self._late, strict=True
        ):
            weights = self._in_rate(weight, kinds, rate, instrument.order)
            weights[..., [self._owns + place for place in self._by_warmth]] *= warmth
            since = start * self._in_rate(late, kinds, rate, instrument.order)
            weights[..., [self._owns + place for place in self._by_time]] += since
            part = np.empty((rate.size, weights.shape[1] - instrument.order, weights.shape[2]))
            for table in dict.fromkeys(tables[kind] for kind in np.unique(kinds)):
                here = np.array([tables[kind] is table for kind in kinds])
                part[here] = self._root(
                    instrument, table, weights[here], rate[here], samples[here], whole_samples
                )
            parts.append(part)
        rows = parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1)
        for prior in self._priors[kinds].T:
            rows = _without_first(rows, prior[:, None, None])
        return rows.reshape(*shape, *rows.shape[1:])

    @property
    def dated(self) -> bool:
        """Whether what a run tells depends on when it is made."""
        return bool(self._by_warmth or self._by_time)

    @property
    def rows(self) -> int:
        """How many rows a run has in `blocks`."""
        size = 4 + 4 * self._harmonics
        return sum(size - instrument.order for instrument in self.setup.instruments)

    def _root(
        self,
        instrument: PlannedInstrument,
        table: InformationTable | None,
        weights: Array,
        rate: Array,
        samples: Array,
        with_ripple: bool,
    ) -> Array:
        """Return an instrument's rows, start errors projected out."""
        step = 1.0 / self.setup.sampling_rate
        block = np.array([block_size(step, float(w)) for w in rate], dtype=np.float64)
        spread = rate * step * np.sqrt((block**2 - 1.0) / 12.0)
        if table is not None:
            return table.root(
                even_samples.averaged(weights, spread), rate, samples, with_ripple=with_ripple
            )
        records = EvenSamples(
            first=0.5 * rate * step * (block - 1.0),
            step=rate * step * block,
            count=samples / block,
            spread=spread,
        )
        variance = instrument.noise.sample_variance
        if instrument.order == 0:  # a random walk of the velocity is white in specific force
            variance = variance + instrument.noise.random_walk**2 / step
        size: Array = np.sqrt(block / variance)[:, None, None]
        return np.asarray(size * even_samples.root(records, weights, instrument.order))

    # The weights

    def _weight(
        self, instrument: PlannedInstrument, attitude: str, sense: int
    ) -> tuple[Array, float]:
        """Return Chebyshev coefficients of the weights over the rate, (nodes, b, columns).

        And how well the columns are combinations of the functions: the largest residual, as a
        part of its column.
        """
        setup = self.setup
        own, own_considered = setup.own(attitude)
        wanted = [*own, *setup.shared]
        fixed = [*setup.considered, *own_considered]
        points = 24 * (self._harmonics + 1)  # to each of three revolutions
        angle: Array = np.arange(3.0 * points) * (2.0 * math.pi / points)
        integrate = integration(self._harmonics, instrument.order)
        low, high = self._rates
        nodes = chebyshev.chebpts1(_RATE_NODES)
        values, worst = [], 0.0
        for rate in 0.5 * (low + high) + 0.5 * (high - low) * nodes:
            prepared = self._forces(instrument, attitude, sense * rate, angle / rate)
            columns = np.zeros((angle.size, len(wanted) + len(fixed) + len(self._by_time)))
            for column, index in zip(prepared.design.T, prepared.unknowns, strict=True):
                columns[:, wanted.index(index)] = column
            for column, index in zip(prepared.fixed.T, prepared.considered, strict=True):
                columns[:, len(wanted) + fixed.index(index)] = column
            for k, place in enumerate(self._by_time):
                unknown = setup.model.unknowns[setup.shared[place]]
                if unknown.concerns(prepared.series):
                    base = CONDITION_TERMS[unknown.symbol].effect.coefficient
                    columns[:, len(wanted) + len(fixed) + k] = prepared.series.columns([base], 1.0)[
                        :, 0
                    ]
            weights, residual = _combination(angle, columns, self._harmonics)
            worst = max(worst, residual)
            # At a given angle forces are polynomials in the rate; times the rate, so is what
            # grows with time.
            values.append(rate * (integrate @ weights))
        vander = chebyshev.chebvander(nodes, _RATE_NODES - 1)
        flat = np.array(values).reshape(_RATE_NODES, -1)
        coefficients: Array = np.asarray(np.linalg.solve(vander, flat), dtype=np.float64)
        return coefficients.reshape(_RATE_NODES, -1, columns.shape[1]), worst

    def _padded(self, weight: Array, attitude: str) -> Array:
        """Return weights with as many columns of a run's own as any attitude has."""
        setup = self.setup
        own, considered = setup.own(attitude)
        most = max(len(setup.own(name)[1]) for name in setup.attitudes)
        before, after = self._owns - len(own), most - len(considered)
        place = len(own)
        zeros = np.zeros((*weight.shape[:2], before))
        parts = [weight[..., :place], zeros, weight[..., place:]]
        return np.concatenate([*parts, np.zeros((*weight.shape[:2], after))], axis=2)

    def _in_rate(
        self, weights: Array, kinds: npt.NDArray[np.intp], rate: Array, order: int
    ) -> Array:
        """Return the weights at rates, shape (n, b, columns), integrated over time."""
        low, high = self._rates
        place = (2.0 * rate - low - high) / (high - low)
        vander = chebyshev.chebvander(place, _RATE_NODES - 1) / rate[:, None] ** (1 + order)
        result = np.empty((len(rate), *weights.shape[2:]))
        for kind in np.unique(kinds):
            which = kinds == kind
            result[which] = np.tensordot(vander[which], weights[kind], axes=1)
        return result

    def _forces(
        self, instrument: PlannedInstrument, attitude: str, rate: float, times: Array
    ) -> Prepared:
        """Return the columns of the specific force, before any integration."""
        setup = self.setup
        forced = replace(instrument, observable="specific_force")
        series = self._series(forced, attitude, rate, times)
        factors = {name: setup.scale_factors[name] for name in [instrument.name]}
        (prepared,) = prepare_columns([series], setup.model, factors, setup.estimate)
        symbols = [setup.model.unknowns[i].symbol for i in prepared.unknowns]
        if CLOCK in symbols and instrument.order > 0:
            column = prepared.design[:, symbols.index(CLOCK)]
            column[:] = self._by_clock(prepared, column, instrument.order)
        return prepared

    def _series(
        self, instrument: PlannedInstrument, attitude: str, rate: float, times: Array
    ) -> Series:
        """Return a record without errors."""
        setup = self.setup
        return Series(
            accelerometer=instrument.name,
            run=attitude,
            trajectory=Trajectory(
                Spindle(rate), setup.radius, setup.site, conditions=RunConditions(warmth=1.0)
            ),
            mounting=instrument.mounting,
            observable=instrument.observable,
            attitude=setup.attitudes[attitude],
            time=times,
            spread=np.zeros_like(times),
            count=np.ones_like(times),
            spacing=float(times[1] - times[0]),
            error=np.zeros_like(times),
        )

    def _by_clock(self, prepared: Prepared, column: Array, order: int) -> Array:
        """Return what a fast clock does to a record, differentiated so often, from the force's.

        Of a force at true times the clock makes one that is less by itself for each integration.
        A circle is passed at the same angles: nothing of it shows in displacement, its
        acceleration in velocity.
        """
        series, model = prepared.series, self.setup.model
        asked = [k for k, i in enumerate(prepared.unknowns) if model.unknowns[i].asked]
        values = self.setup.estimate[[prepared.unknowns[k] for k in asked]]
        errors = prepared.design[:, asked] @ values
        there = series.by_clock(_CLOCK_STEP).reference() - series.reference()
        shown: Array = column - there / _CLOCK_STEP - order * errors
        if order == 1:
            axis = series.mounting.turned(series.attitude).input_axis
            shown = shown + series.trajectory.acceleration(series.time) @ axis
        return shown


def _combination(angle: Array, columns: Array, harmonics: int) -> tuple[Array, float]:
    """Return the weights of 1, th, cos, sin, th cos and th sin in columns over three revolutions.

    What grows with the angle is the difference of two revolutions, and is exact whatever harmonics
    the rest has. Also the largest residual of a column, as a part of its size.
    """
    points = len(angle) // 3
    shapes = functions(angle, harmonics)
    periodic = [0, *(place for m in range(1, harmonics + 1) for place in (4 * m, 4 * m + 1))]
    growing = [1, *(place for m in range(1, harmonics + 1) for place in (4 * m + 2, 4 * m + 3))]
    project = 2.0 / points * shapes[:points, periodic].T
    project[0] *= 0.5
    first, second = columns[:points], columns[points : 2 * points]
    slope = (second - first) / (2.0 * math.pi)
    weights = np.zeros((shapes.shape[1], columns.shape[1]))
    weights[growing] = project @ slope
    weights[periodic] = project @ (first - angle[:points, None] * slope)
    size = np.maximum(np.abs(columns).max(axis=0), np.finfo(float).tiny)
    return weights, float(np.max(np.abs(columns - shapes @ weights) / size, initial=0.0))


def _without_first(rows: Array, prior: Array) -> Array:
    """Project the first unknown out of rows, of which 1/u is known beforehand, (n, 1, 1).

    What is left of the information is Y' (1 - x x'/(prior^2 + x'x)) Y, and its root is Y less a
    part of its component along x: exact, and no product is formed of which a root must be taken.
    """
    x, others = rows[:, :, :1], rows[:, :, 1:]
    size = np.sum(x**2, axis=1, keepdims=True)
    kept = prior / np.sqrt(prior**2 + size)
    along = np.sum(x * others, axis=1, keepdims=True) / np.where(size > 0.0, size, 1.0)
    return np.asarray(others - x * ((1.0 - kept) * along))


def _by_condition(setup: Setup, condition: str) -> list[int]:
    """Return the places of what goes with a condition, among the shared unknowns."""
    rows = (CONDITION_TERMS.get(setup.model.unknowns[i].symbol) for i in setup.shared)
    return [
        place
        for place, row in enumerate(rows)
        if row is not None and row.effect.condition == condition
    ]


def _weights_of_priors(model: Unknowns, places: Sequence[int]) -> Array:
    """Return 1/u of what is known of some unknowns; of nothing, the solver's regularisation."""
    chosen = [model.unknowns[i] for i in places]
    return np.array([1.0 / unknown.spread for unknown in chosen])

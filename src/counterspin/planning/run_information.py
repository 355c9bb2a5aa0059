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
from collections.abc import Mapping, Sequence
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
from counterspin.inference.joint.unknowns import Unknown
from counterspin.inference.noise.model import Noise
from counterspin.physics.effects import Product, RunConditions
from counterspin.physics.motion import Trajectory
from counterspin.physics.spindle import Spindle
from counterspin.physics.terms import CONDITION_TERMS, term
from counterspin.planning import even_samples
from counterspin.planning.angle_functions import functions, integration
from counterspin.planning.even_samples import EvenSamples
from counterspin.planning.experimental_setup import PlannedInstrument, Setup, expected_record
from counterspin.planning.information_table import InformationTable
from counterspin.records.reduction import block_size

#: Highest harmonics of the angle that are tried, until the columns are combinations of the
#: functions to `_RESIDUAL` of their size, or as well as they ever are: difference quotients have
#: rounding. A term with a kink has all harmonics, those of its force falling off as n^-3: of it
#: what is left in the record counts, whose square is missing from the information.
_HARMONICS: Final = (3, 4, 6, 11)
_RESIDUAL: Final = 1e-6
_RESIDUAL_OF_KINK: Final = 5e-4

#: Nodes in the rate: the weights are polynomials of the tenth degree (a_I^4 goes as w^8).
_RATE_NODES: Final = 13

#: Owner and symbol of a term, the latter with an ending for what it adds in each second.
Key = tuple[str, str]
_A_SECOND: Final = " in a second"

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
    ) -> None:
        self.setup = setup
        low, high = rates
        # A single rate is a range too, or there would be nothing to interpolate.
        self._rates = (low * 0.99, high * 1.01) if high < 1.02 * low else rates
        self._revolutions = revolutions
        kinds = [(name, sense) for name in setup.attitudes for sense in senses]
        self._kinds = {kind: index for index, kind in enumerate(kinds)}
        forces = [[self._forces(i, *kind) for kind in kinds] for i in setup.instruments]
        for self._harmonics in _HARMONICS:
            if all(
                self._suffice(instrument, *shown)
                for instrument, of_kinds in zip(setup.instruments, forces, strict=True)
                for shown in of_kinds
            ):
                break
        #: Of each instrument and kind of run, the weights of each term.
        self._terms = [
            [self._weights_of(instrument, *shown) for shown in of_kinds]
            for instrument, of_kinds in zip(setup.instruments, forces, strict=True)
        ]
        self._tables = self._made_tables()
        self._arrange()

    def _arrange(self) -> None:
        """Put the weights in the order of the set-up's model."""
        setup = self.setup
        #: Places, among the shared unknowns, of those that go with how warm a run is, and of those
        #: that go with when it is made.
        self._by_warmth, self._by_time = (
            _by_condition(setup, condition) for condition in ("temperature", "time")
        )
        model = setup.model
        late = [_key(model.unknowns[setup.shared[i]], _A_SECOND) for i in self._by_time]
        owns = {name: setup.own(name) for name in setup.attitudes}
        self._owns, known = (max(len(own[i]) for own in owns.values()) for i in (0, 1))
        shared = [_key(model.unknowns[i]) for i in setup.shared]
        shared += [_key(model.considered[i]) for i in setup.considered]
        columns = {
            name: [
                *_filled([_key(model.unknowns[i]) for i in own], self._owns),
                *shared,
                *_filled([_key(model.considered[i]) for i in considered], known),
            ]
            for name, (own, considered) in owns.items()
        }

        def chosen(terms: Mapping[Key, Array], keys: Sequence[Key]) -> Array:
            nothing = np.zeros((_RATE_NODES, 4 + 4 * self._harmonics))
            return np.stack([terms.get(key, nothing) for key in keys] or [nothing[..., :0]], axis=2)

        self._weights = [
            np.array(
                [
                    chosen(terms, columns[name])
                    for terms, (name, _) in zip(own, self._kinds, strict=True)
                ]
            )
            for own in self._terms
        ]
        #: Of what goes with time, the weights of one second later.
        self._late = [
            np.array([chosen(terms, late) for terms in own]) if late else None
            for own in self._terms
        ]
        self._priors = np.ones((len(self._kinds), self._owns))
        for kind, (name, _) in enumerate(self._kinds):
            own = [model.unknowns[i] for i in owns[name][0]]
            # Of nothing known, the solver's regularisation.
            self._priors[kind, : len(own)] = [1.0 / unknown.spread for unknown in own]

    def of_model(self, setup: Setup) -> RunInformation:
        """Return the same for a set-up whose model has some of these terms, in other parts."""
        other = copy.copy(self)
        other.setup = setup
        other._arrange()
        return other

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
            if late is not None:
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

    @property
    def _nodes(self) -> Array:
        """Sizes of the rate at which the weights are computed, rad/s."""
        low, high = self._rates
        return np.asarray(0.5 * (low + high) + 0.5 * (high - low) * chebyshev.chebpts1(_RATE_NODES))

    def _forces(
        self, instrument: PlannedInstrument, attitude: str, sense: int
    ) -> tuple[list[Key], Array]:
        """Return the terms that act, and their forces at the nodes of the rate, (nodes, n, k).

        At n even angles in three revolutions.
        """
        points = 24 * (_HARMONICS[-1] + 1)
        angle: Array = np.arange(3.0 * points) * (2.0 * math.pi / points)
        model, shown = self.setup.model, []
        for rate in self._nodes:
            prepared = self._columns(instrument, attitude, sense * rate, angle / rate)
            keys = [_key(model.unknowns[i]) for i in prepared.unknowns]
            keys += [_key(model.considered[i]) for i in prepared.considered]
            columns = [prepared.design, prepared.fixed]
            for owner, symbol in keys[: len(prepared.unknowns)]:
                row = CONDITION_TERMS.get(symbol)
                if row is not None and row.effect.condition == "time":
                    keys.append((owner, symbol + _A_SECOND))
                    columns.append(prepared.series.columns([row.effect.coefficient], 1.0))
            shown.append(np.hstack(columns))
        return keys, np.array(shown)

    def _suffice(self, instrument: PlannedInstrument, keys: list[Key], forces: Array) -> bool:
        """Return whether the terms are combinations of the functions, as well as they have to be.

        forces: Of the terms, as of `_forces`.
        """
        residual, least = (
            _combination(forces, harmonics)[1] for harmonics in (self._harmonics, _HARMONICS[-1])
        )
        # Integration divides what the first harmonics leave by their number at least.
        of_kink = _RESIDUAL_OF_KINK * (self._harmonics + 1.0) ** instrument.order
        kinked = [_has_kink(symbol.removesuffix(_A_SECOND)) for _, symbol in keys]
        allowed = np.where(kinked, of_kink, np.maximum(_RESIDUAL, 1.1 * least))
        return bool(np.all(residual < allowed))

    def _weights_of(
        self, instrument: PlannedInstrument, keys: list[Key], forces: Array
    ) -> dict[Key, Array]:
        """Return Chebyshev coefficients of each term's weights over the rate, (nodes, b).

        forces: Of the terms, as of `_forces`.
        """
        weights, _ = _combination(forces, self._harmonics)
        # At a given angle forces are polynomials in the rate; times the rate, so is what grows with
        # time.
        turning = integration(self._harmonics, instrument.order)
        values = self._nodes[:, None, None] * (turning @ weights)
        vander = chebyshev.chebvander(chebyshev.chebpts1(_RATE_NODES), _RATE_NODES - 1)
        coefficients = np.linalg.solve(vander, values.reshape(_RATE_NODES, -1))
        columns = np.moveaxis(coefficients.reshape(values.shape), 2, 0)
        return dict(zip(keys, columns, strict=True))

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

    def _columns(
        self, instrument: PlannedInstrument, attitude: str, rate: float, times: Array
    ) -> Prepared:
        """Return the columns of the specific force, before any integration."""
        setup = self.setup
        forced = replace(instrument, observable="specific_force")
        series = self._series(forced, attitude, rate, times)
        factors = {name: setup.scale_factors[name] for name in [instrument.name]}
        (prepared,) = prepare_columns([series], setup.model, factors, setup.estimate)
        asked = [setup.model.unknowns[i].symbol for i in prepared.unknowns]
        held = [setup.model.considered[i].symbol for i in prepared.considered]
        for symbols, columns in ((asked, prepared.design), (held, prepared.fixed)):
            if CLOCK in symbols and instrument.order > 0:
                column = columns[:, symbols.index(CLOCK)]
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


def _combination(columns: Array, harmonics: int) -> tuple[Array, Array]:
    """Return the weights of 1, th, cos, sin, th cos and th sin in columns, (..., b, k).

    What grows with the angle is the difference of two revolutions, and is exact whatever harmonics
    the rest has. Also the largest residual of each column, as a part of its size, (k,).

    columns: Over three revolutions, shape (..., n, k).
    """
    points = columns.shape[-2] // 3
    angle: Array = np.arange(3.0 * points) * (2.0 * math.pi / points)
    shapes = functions(angle, harmonics)
    periodic = [0, *(place for m in range(1, harmonics + 1) for place in (4 * m, 4 * m + 1))]
    growing = [1, *(place for m in range(1, harmonics + 1) for place in (4 * m + 2, 4 * m + 3))]
    project = 2.0 / points * shapes[:points, periodic].T
    project[0] *= 0.5
    first, second = columns[..., :points, :], columns[..., points : 2 * points, :]
    slope = (second - first) / (2.0 * math.pi)
    weights = np.zeros((*columns.shape[:-2], shapes.shape[1], columns.shape[-1]))
    weights[..., growing, :] = project @ slope
    weights[..., periodic, :] = project @ (first - angle[:points, None] * slope)
    size = np.maximum(np.abs(columns).max(axis=-2), np.finfo(float).tiny)
    residual = np.abs(columns - shapes @ weights).max(axis=-2) / size
    return weights, residual.reshape(-1, columns.shape[-1]).max(axis=0)


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


def _key(one: Unknown, ending: str = "") -> Key:
    return one.owner, one.symbol + ending


def _has_kink(symbol: str) -> bool:
    effect = getattr(term(symbol), "effect", None)
    return isinstance(effect, Product) and effect.has_kink


def _filled(keys: list[Key], count: int) -> list[Key]:
    """Return as many keys as another attitude has, the last ones of nothing."""
    return [*keys, *[("", "")] * (count - len(keys))]

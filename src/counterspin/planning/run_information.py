"""Information of a run as a smooth function of its rate and its revolutions, for planning.

`Predictor` puts runs together: the uncertainties of a design.

At constant rate every column of the term table is an exact combination of a few functions of the
spindle angle th: th^2, th^3, and cos, sin, th cos, th sin of its first harmonics. The functions
do not know the rate and their weights do not know the length of the run. So a run's square-root
information is

    R(rate, revolutions) @ W(rate),

R a factor of the whitened functions with the run's own start errors projected out, W the weights,
which are polynomials in the rate (`weights`). With white noise R has a closed form
(`information_table.root`), exact for the very samples of the record; with a random walk, or noise
of the time stamps, it is interpolated (`InformationTable`).
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Final

import numpy as np

from counterspin.arrays import Array, triangular_factor
from counterspin.campaign.conditions import DEFAULT_WARMING
from counterspin.inference.noise.model import Noise
from counterspin.inference.priors import prior_correlation, whiten_priors
from counterspin.physics.terms import condition_of
from counterspin.planning.design import Criterion, Design, RunType, measurement_order
from counterspin.planning.information_table import (
    EvenSamples,
    InformationTable,
    average_over_blocks,
    sqrt_information,
)
from counterspin.planning.weights import (
    A_SECOND,
    Key,
    PlannedInstrument,
    Setup,
    TermWeights,
    expected_record,
    key_of,
)
from counterspin.records.reduction import block_size

#: Relative step of the derivatives of a run's information, by central differences.
_RELATIVE_STEP: Final = 1e-5


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
        run_types = [(name, sense) for name in setup.attitudes for sense in senses]
        self._run_types = {run_type: index for index, run_type in enumerate(run_types)}
        self._terms = TermWeights(setup, self._rates, run_types)
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
        late = [key_of(model.unknowns[setup.shared[i]], A_SECOND) for i in self._by_time]
        owns = {name: setup.own(name) for name in setup.attitudes}
        self._owns, known = (max(len(places[i]) for places in owns.values()) for i in (0, 1))
        shared = [key_of(model.unknowns[i]) for i in setup.shared]
        shared += [key_of(model.considered[i]) for i in setup.considered]
        columns = {
            name: [
                *_pad_keys([key_of(model.unknowns[i]) for i in places], self._owns),
                *shared,
                *_pad_keys([key_of(model.considered[i]) for i in considered], known),
            ]
            for name, (places, considered) in owns.items()
        }

        def chosen(terms: Mapping[Key, Array], keys: Sequence[Key]) -> Array:
            nothing = np.zeros(self._terms.shape)
            return np.stack([terms.get(key, nothing) for key in keys] or [nothing[..., :0]], axis=2)

        self._weights = [
            np.array(
                [
                    chosen(terms, columns[name])
                    for terms, (name, _) in zip(weights, self._run_types, strict=True)
                ]
            )
            for weights in self._terms.terms
        ]
        #: Of what goes with time, the weights of one second later.
        self._late = [
            np.array([chosen(terms, late) for terms in weights]) if late else None
            for weights in self._terms.terms
        ]
        self._priors = np.ones((len(self._run_types), self._owns))
        for run_type, (name, _) in enumerate(self._run_types):
            unknowns = [model.unknowns[i] for i in owns[name][0]]
            # Of nothing known, the solver's regularisation.
            self._priors[run_type, : len(unknowns)] = [
                1.0 / unknown.prior_sd for unknown in unknowns
            ]

    def of_model(self, setup: Setup) -> RunInformation:
        """Return the same for a set-up whose model has some of these terms, in other parts."""
        clone = copy.copy(self)
        clone.setup = setup
        clone._arrange()
        return clone

    def _made_tables(self) -> list[list[InformationTable | None]]:
        """Return the interpolation tables for each instrument and kind; None: a closed form exists.

        The effect of time-stamp noise depends on the slope of the record of this kind of run.
        """
        tables: dict[tuple[PlannedInstrument, object], InformationTable] = {}
        chosen: list[list[InformationTable | None]] = []
        for instrument in self.setup.instruments:
            noise = instrument.noise
            if instrument.order == 0:  # a random walk of the velocity is white in specific force
                walk = noise.random_walk**2 * self.setup.sampling_rate
                noise = Noise(math.sqrt(noise.sample_variance + walk))
            by_run_type: list[InformationTable | None] = []
            for run_type in self._run_types:
                if noise.random_walk == 0.0 and not instrument.scatters:
                    by_run_type.append(None)
                    continue
                key: tuple[PlannedInstrument, object] = (instrument, run_type)
                if not instrument.scatters:
                    first = self.setup.instruments[0].mounting
                    key = (replace(instrument, name="", mounting=first), None)
                if key not in tables:
                    tables[key] = InformationTable(
                        instrument.order,
                        noise,
                        partial(self._of_time_stamps, instrument, *run_type)
                        if instrument.scatters
                        else None,
                        self.setup.sampling_rate,
                        self._rates,
                        self._revolutions,
                        self._terms.harmonics,
                    )
                by_run_type.append(tables[key])
            chosen.append(by_run_type)
        return chosen

    def _of_time_stamps(
        self, instrument: PlannedInstrument, attitude: str, sense: int, rate: float, angle: Array
    ) -> Array:
        """Return the variance that noise of its time stamp adds to a sample, at angles, (n,)."""
        setup = self.setup
        series = self._terms.series(instrument, attitude, sense * rate, angle / rate)
        expected = dict(zip(setup.model.unknowns, setup.estimate.tolist(), strict=True))
        expecting = expected_record(series, expected, setup.scale_factors[instrument.name])
        return expecting.with_timestamp_noise(instrument.timing_left(rate)).jitter_variance

    def sampled_at(self, sampling_rate: float) -> RunInformation:
        """Return the same for another sampling rate, Hz."""
        copied = copy.copy(self)
        copied.setup = replace(self.setup, sampling_rate=sampling_rate)
        copied._tables = copied._made_tables()
        return copied

    def blocks(
        self,
        types: Sequence[tuple[str, int]],
        rate: Array,
        revolutions: Array,
        *,
        whole_samples: bool = False,
        conditions: tuple[Array, Array] | None = None,
    ) -> Array:
        """Return the information of runs about the shared unknowns.

        rate, revolutions: Size of the rate (rad/s) and length of each run, shape (..., n).
        conditions: When each run begins (s) and how warm it is (K from the reference), of a shape
            like the rate's; None: nothing changes from run to run.
        whole_samples: True: the last sample is the last one that a run of this length has; False:
            as smooth functions of the length, with a part of a sample at the end.
        Returns: rows of unit variance, shape (..., n, b, p + q), b = `rows`: columns of the shared
            unknowns, then of the shared considered terms, then of the run's own considered terms,
            zero where an attitude has fewer of these than others. The run's own unknowns, start
            errors included, are projected out.
        """
        shape = rate.shape
        of_run = np.array([self._run_types[run_type] for run_type in types], dtype=np.intp)
        run_types = np.broadcast_to(of_run, shape).ravel()
        rate, revolutions = rate.ravel(), revolutions.ravel()
        samples = revolutions * (2.0 * math.pi * self.setup.sampling_rate) / rate
        samples = np.floor(samples * (1.0 + 1e-12)) + 1.0 if whole_samples else samples + 1.0
        start, warmth = (
            np.broadcast_to(condition, shape).ravel()[:, None, None]
            for condition in conditions or (np.zeros(()), np.zeros(()))
        )
        parts = []
        for instrument, tables, weight, late in zip(
            self.setup.instruments, self._tables, self._weights, self._late, strict=True
        ):
            weights = self._terms.at(weight, run_types, rate, instrument.order)
            weights[..., [self._owns + place for place in self._by_warmth]] *= warmth
            if late is not None:
                since = start * self._terms.at(late, run_types, rate, instrument.order)
                weights[..., [self._owns + place for place in self._by_time]] += since
            part = np.empty((rate.size, weights.shape[1] - instrument.order, weights.shape[2]))
            for table in dict.fromkeys(tables[run_type] for run_type in np.unique(run_types)):
                mask = np.array([tables[run_type] is table for run_type in run_types])
                part[mask] = self._root(
                    instrument, table, weights[mask], rate[mask], samples[mask], whole_samples
                )
            parts.append(part)
        rows = parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1)
        for prior in self._priors[run_types].T:
            rows = _project_out_first(rows, prior[:, None, None])
        return rows.reshape(*shape, *rows.shape[1:])

    @property
    def dated(self) -> bool:
        """True if the information of a run depends on its start time."""
        return bool(self._by_warmth or self._by_time)

    @property
    def rows(self) -> int:
        """Number of rows of a run in `blocks`."""
        size = 4 + 4 * self._terms.harmonics
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
            return table.sqrt_information(
                average_over_blocks(weights, spread), rate, samples, with_ripple=with_ripple
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
        return np.asarray(size * sqrt_information(records, weights, instrument.order))


def _project_out_first(rows: Array, prior: Array) -> Array:
    """Project the first unknown, with the prior 1/u, shape (n, 1, 1), out of rows.

    The remaining information is Y' (1 - x x'/(prior^2 + x'x)) Y, and its root is Y minus a
    part of its component along x: exact, and no product is formed of which a root must be taken.
    """
    x, other_columns = rows[:, :, :1], rows[:, :, 1:]
    sum_of_squares = np.sum(x**2, axis=1, keepdims=True)
    kept = prior / np.sqrt(prior**2 + sum_of_squares)
    projection = np.sum(x * other_columns, axis=1, keepdims=True) / np.where(
        sum_of_squares > 0.0, sum_of_squares, 1.0
    )
    return np.asarray(other_columns - x * ((1.0 - kept) * projection))


def _by_condition(setup: Setup, condition: str) -> list[int]:
    """Return the places of the shared unknowns that depend on a condition."""
    symbols = (setup.model.unknowns[i].symbol for i in setup.shared)
    return [index for index, symbol in enumerate(symbols) if condition_of(symbol) == condition]


def _pad_keys(keys: list[Key], count: int) -> list[Key]:
    """Return the keys, padded with empty keys to the number of another attitude."""
    return [*keys, *[("", "")] * (count - len(keys))]


def _conditions(types: Sequence[RunType], duration: Array) -> tuple[Array, Array]:
    """Return the start times and temperatures of runs, each of shape (..., n).

    duration: s, shape (..., n).
    """
    order = measurement_order(types)
    start, warmth = np.empty_like(duration), np.zeros(len(order))
    start[..., order] = np.cumsum(duration[..., order], axis=-1) - duration[..., order]
    if len(order) > 1:
        warmth[order] = DEFAULT_WARMING * np.linspace(-0.5, 0.5, len(order))
    return start, warmth


class Predictor:
    """Uncertainties that designs would have, by the same solve as a calibration's."""

    def __init__(self, information: RunInformation) -> None:
        self.information = information
        setup = information.setup
        shared = [setup.model.unknowns[i] for i in setup.shared]
        self.names = tuple(unknown.name for unknown in shared)
        sd = np.array([unknown.prior_sd for unknown in shared])
        #: An unknown without a prior is constrained as weakly as in the solution.
        self.prior = whiten_priors(np.eye(sd.size), sd, prior_correlation(shared))
        sizes = setup.considered_sizes
        self.common = sizes[list(setup.considered)]
        self.own = {name: sizes[list(setup.own(name)[1])] for name in setup.attitudes}

    @property
    def p(self) -> int:
        """Number of unknowns that all runs share."""
        return len(self.names)

    def covariance(
        self,
        types: Sequence[RunType],
        rate: Array,
        revolutions: Array,
        *,
        whole_samples: bool = False,
    ) -> Array:
        """Return the covariance of the shared unknowns for each of many designs.

        rate, revolutions: Shape (..., n).
        Returns: shape (..., p, p).
        """
        blocks = self.information.blocks(
            types,
            rate,
            revolutions,
            whole_samples=whole_samples,
            conditions=_conditions(types, 2.0 * math.pi * revolutions / rate),
        )
        return self._covariance(types, blocks)[0]

    def u(self, design: Design) -> Array:
        """Return the standard uncertainties of the shared unknowns, shape (p,).

        For the samples that records of these lengths have, while `covariance` is smooth in the
        lengths.
        """
        runs = (design.types, design.rate, design.revolutions)
        covariance = self.covariance(*runs, whole_samples=True)
        return np.asarray(np.sqrt(np.diag(covariance)))

    def value(self, criterion: Criterion, design: Design) -> float:
        """Return a criterion of a design, see `Criterion.value`."""
        covariance = self.covariance(design.types, design.rate, design.revolutions)
        return float(criterion.value(covariance))

    def _covariance(self, types: Sequence[RunType], blocks: Array) -> tuple[Array, Array, Array]:
        """Return covariance, its part without considered terms, and their spread (..., p, k)."""
        p = self.p
        lead = blocks.shape[:-3]
        rows = blocks[..., :p].reshape(*lead, -1, p)
        prior = np.broadcast_to(self.prior, (*lead, p, p))
        triangle = triangular_factor(np.concatenate([rows, prior], axis=-2))
        root = np.linalg.inv(triangle)
        inner = np.asarray(root @ np.swapaxes(root, -1, -2), dtype=np.float64)
        if blocks.shape[-1] == p:
            return inner, inner, np.zeros((*lead, p, 0))
        moments = np.swapaxes(blocks[..., :p], -1, -2) @ self._scale_considered(types, blocks)
        q = self.common.size
        common = moments[..., :q].sum(axis=-3)
        of_runs = np.moveaxis(moments[..., q:], -3, -2)
        of_runs = of_runs.reshape(*lead, p, of_runs.shape[-2] * of_runs.shape[-1])
        columns = np.concatenate([common, of_runs], axis=-1)
        spread: Array = -inner @ columns
        covariance: Array = inner + spread @ np.swapaxes(spread, -1, -2)
        return covariance, inner, spread

    def _scale_considered(self, types: Sequence[RunType], blocks: Array) -> Array:
        """Return the considered columns of blocks, each times its standard uncertainty."""
        q = self.common.size
        columns = blocks[..., self.p :].copy()
        columns[..., :q] *= self.common
        for index, run_type in enumerate(types):
            run_sizes = self.own[run_type.attitude]
            columns[..., index, :, q : q + run_sizes.size] *= run_sizes
        return columns

    def sensitivities(self, design: Design, criterion: Criterion) -> tuple[float, Array, Array]:
        """Return a criterion and its derivatives by log rate and log revolutions of each run.

        The information of one run enters the covariance as P dM P, so that once P is known the
        derivatives need no other solution, only blocks a step aside.
        """
        up, down = 1.0 + _RELATIVE_STEP, 1.0 - _RELATIVE_STEP
        rate = np.array([[1.0], [up], [down], [1.0], [1.0]]) * design.rate
        turns = np.array([[1.0], [1.0], [1.0], [up], [down]]) * design.revolutions
        # When a run begins depends on those before it: so little that no derivative has it.
        when = _conditions(design.types, design.duration)
        blocks = self.information.blocks(design.types, rate, turns, conditions=when)
        covariance, inner, spread = self._covariance(design.types, blocks[0])
        value = float(criterion.value(covariance))
        c = criterion.directions(covariance)
        share = self._share(design.types, blocks, inner, spread, c)
        return (
            value,
            (share[1] - share[2]) / (2.0 * _RELATIVE_STEP),
            (share[3] - share[4]) / (2.0 * _RELATIVE_STEP),
        )

    def _share(
        self, types: Sequence[RunType], blocks: Array, inner: Array, spread: Array, c: Array
    ) -> Array:
        """Return for each run a quantity whose difference quotient is the criterion's derivative.

        With v = P c, s = spread' c and B the considered moments, d(c' S c) is
        -v' dM v - 2 s' (dB' v) - 2 s' B' dP c; shape (..., runs).
        """
        p = self.p
        v = inner @ c
        seen = blocks[..., :p] @ v
        share = -np.sum(seen**2, axis=(-2, -1))
        if spread.shape[-1] == 0:
            return np.asarray(share)
        s = spread.T @ c
        # d(spread' c) = -(dB)' v + B' P dM P c, and B' P is -spread'.
        towards = spread @ s
        share -= 2.0 * np.sum(seen * (blocks[..., :p] @ towards), axis=(-2, -1))
        columns = self._scale_considered(types, blocks)
        q, n = self.common.size, len(types)
        width = columns.shape[-1] - q
        weights = np.zeros((n, q + width, c.shape[1]))
        weights[:, :q] = s[:q]
        weights[:, q:] = s[q:].reshape(n, width, c.shape[1])
        share -= 2.0 * np.sum(seen * (columns @ weights), axis=(-2, -1))
        return np.asarray(share)

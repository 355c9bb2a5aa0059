"""Information of a run as a smooth function of its rate and its revolutions, for planning.

`Predictor` combines runs and returns the uncertainties of a design.

At constant rate, every column of the term table is an exact combination of a few functions of the
spindle angle th: th^2, th^3, and cos, sin, th cos, th sin of its first harmonics. The functions do
not depend on the rate, and their weights do not depend on the length of the run. So the square-root
information of a run is

    R(rate, revolutions) @ W(rate),

where R is a factor of the whitened functions with the start errors of the run projected out, and W
are the weights, which are polynomials in the rate (`weights`). With white noise, R has a closed
form (`information_table.sqrt_information`), exact for the samples of the record. With a random
walk, or noise of the time stamps, R is interpolated (`InformationTable`).
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
    PER_SECOND_SUFFIX,
    Key,
    PlannedInstrument,
    Setup,
    TermWeights,
    expected_record,
    make_key,
)
from counterspin.records.reduction import block_size

#: Relative step of the derivatives of a run's information, by central differences.
_DERIVATIVE_STEP: Final = 1e-5


class RunInformation:
    """Square-root information of runs in one setup.

    rate_range: Lowest and highest rate (magnitudes), rad/s.
    revolution_range: Smallest and largest number of revolutions, at least 1.
    senses: +1, -1 or both.
    """

    def __init__(
        self,
        setup: Setup,
        rate_range: tuple[float, float],
        revolution_range: tuple[float, float],
        senses: Sequence[int],
    ) -> None:
        self.setup = setup
        low, high = rate_range
        # A single rate is a range too, or there would be nothing to interpolate.
        self._rates = (low * 0.99, high * 1.01) if high < 1.02 * low else rate_range
        self._revolutions = revolution_range
        run_types = [(name, sense) for name in setup.attitudes for sense in senses]
        self._run_types = {run_type: index for index, run_type in enumerate(run_types)}
        self._terms = TermWeights(setup, self._rates, run_types)
        self._tables = self._make_tables()
        self._arrange_weights()

    def _arrange_weights(self) -> None:
        """Put the weights in the order of the setup's model."""
        setup = self.setup
        #: Indices of the shared unknowns that depend on the temperature and on the start time.
        self._temperature_indices, self._time_indices = (
            _indices_by_condition(setup, condition) for condition in ("temperature", "time")
        )
        model = setup.model
        rate_keys = [
            make_key(model.unknowns[setup.shared_indices[i]], PER_SECOND_SUFFIX)
            for i in self._time_indices
        ]
        own_indices = {name: setup.own_indices(name) for name in setup.attitudes}
        self._n_own, n_own_considered = (
            max(len(own_unknowns[i]) for own_unknowns in own_indices.values()) for i in (0, 1)
        )
        shared_keys = [make_key(model.unknowns[i]) for i in setup.shared_indices]
        shared_keys += [make_key(model.considered[i]) for i in setup.shared_considered]
        column_keys = {
            name: [
                *_pad_keys([make_key(model.unknowns[i]) for i in own_unknowns], self._n_own),
                *shared_keys,
                *_pad_keys(
                    [make_key(model.considered[i]) for i in own_considered], n_own_considered
                ),
            ]
            for name, (own_unknowns, own_considered) in own_indices.items()
        }

        def stack_weights(terms: Mapping[Key, Array], keys: Sequence[Key]) -> Array:
            zeros = np.zeros(self._terms.shape)
            return np.stack([terms.get(key, zeros) for key in keys] or [zeros[..., :0]], axis=2)

        self._weights = [
            np.array(
                [
                    stack_weights(terms, column_keys[name])
                    for terms, (name, _) in zip(weights, self._run_types, strict=True)
                ]
            )
            for weights in self._terms.terms
        ]
        #: Change per second of the weights of time-dependent unknowns.
        self._weight_rates = [
            np.array([stack_weights(terms, rate_keys) for terms in weights]) if rate_keys else None
            for weights in self._terms.terms
        ]
        self._own_prior_rows = np.ones((len(self._run_types), self._n_own))
        for run_type, (name, _) in enumerate(self._run_types):
            unknowns = [model.unknowns[i] for i in own_indices[name][0]]
            # 1 for padding, as in the regularisation of the solver.
            self._own_prior_rows[run_type, : len(unknowns)] = [
                1.0 / unknown.prior_sd for unknown in unknowns
            ]

    def with_setup(self, setup: Setup) -> RunInformation:
        """Return the information for a setup whose model has a subset of these terms."""
        clone = copy.copy(self)
        clone.setup = setup
        clone._arrange_weights()
        return clone

    def _make_tables(self) -> list[list[InformationTable | None]]:
        """Return the tables by instrument and type of run; None if a closed form exists.

        With noise of the time stamps, the information depends on the slope of the record.
        """
        tables: dict[tuple[PlannedInstrument, object], InformationTable] = {}
        tables_by_instrument: list[list[InformationTable | None]] = []
        for instrument in self.setup.instruments:
            noise = instrument.noise
            if instrument.order == 0:  # a random walk of the velocity is white in specific force
                walk_variance = noise.random_walk**2 * self.setup.sampling_rate
                noise = Noise(math.sqrt(noise.sample_variance + walk_variance))
            tables_by_type: list[InformationTable | None] = []
            for run_type in self._run_types:
                if noise.random_walk == 0.0 and not instrument.has_timing_noise:
                    tables_by_type.append(None)
                    continue
                key: tuple[PlannedInstrument, object] = (instrument, run_type)
                if not instrument.has_timing_noise:
                    first_mounting = self.setup.instruments[0].mounting
                    key = (replace(instrument, name="", mounting=first_mounting), None)
                if key not in tables:
                    tables[key] = InformationTable(
                        instrument.order,
                        noise,
                        partial(self._time_stamp_variance, instrument, *run_type)
                        if instrument.has_timing_noise
                        else None,
                        self.setup.sampling_rate,
                        self._rates,
                        self._revolutions,
                        self._terms.n_harmonics,
                    )
                tables_by_type.append(tables[key])
            tables_by_instrument.append(tables_by_type)
        return tables_by_instrument

    def _time_stamp_variance(
        self, instrument: PlannedInstrument, attitude: str, sense: int, rate: float, angle: Array
    ) -> Array:
        """Return the variance of samples from noise of the time stamps, at angles, shape (n,)."""
        setup = self.setup
        series = self._terms.series(instrument, attitude, sense * rate, angle / rate)
        expected = dict(zip(setup.model.unknowns, setup.expected.tolist(), strict=True))
        record = expected_record(series, expected, setup.scale_factors[instrument.name])
        return record.with_timestamp_noise(instrument.remaining_timing_noise(rate)).jitter_variance

    def with_sampling_rate(self, sampling_rate: float) -> RunInformation:
        """Return the information for another sampling rate, Hz."""
        clone = copy.copy(self)
        clone.setup = replace(self.setup, sampling_rate=sampling_rate)
        clone._tables = clone._make_tables()
        return clone

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

        rate, revolutions: Rate (magnitude, rad/s) and revolutions of each run, shape (..., n).
        conditions: Start time (s) and temperature offset (K) of each run, shape (n,) or (..., n);
            None: zero for all runs.
        whole_samples: True: an integer number of samples; False: a smooth function of the length,
            with a fraction of a sample at the end.
        Returns: rows with unit variance, shape (..., n, b, p + q), b = `n_rows`: columns of the
            shared unknowns, of the shared considered terms, and of the run's own considered terms,
            padded with zeros. The run's own unknowns, start errors included, are projected out.
        """
        shape = rate.shape
        type_indices = np.array([self._run_types[run_type] for run_type in types], dtype=np.intp)
        run_types = np.broadcast_to(type_indices, shape).ravel()
        rate, revolutions = rate.ravel(), revolutions.ravel()
        n_samples = revolutions * (2.0 * math.pi * self.setup.sampling_rate) / rate
        n_samples = np.floor(n_samples * (1.0 + 1e-12)) + 1.0 if whole_samples else n_samples + 1.0
        start_time, temperature_offset = (
            np.broadcast_to(condition, shape).ravel()[:, None, None]
            for condition in conditions or (np.zeros(()), np.zeros(()))
        )
        instrument_rows = []
        for instrument, tables, weight, weight_rates in zip(
            self.setup.instruments, self._tables, self._weights, self._weight_rates, strict=True
        ):
            weights = self._terms.evaluate(weight, run_types, rate, instrument.order)
            weights[..., [self._n_own + index for index in self._temperature_indices]] *= (
                temperature_offset
            )
            if weight_rates is not None:
                time_weights = start_time * self._terms.evaluate(
                    weight_rates, run_types, rate, instrument.order
                )
                weights[..., [self._n_own + index for index in self._time_indices]] += time_weights
            type_rows = np.empty((rate.size, weights.shape[1] - instrument.order, weights.shape[2]))
            for table in dict.fromkeys(tables[run_type] for run_type in np.unique(run_types)):
                uses_table = np.array([tables[run_type] is table for run_type in run_types])
                type_rows[uses_table] = self._instrument_rows(
                    instrument,
                    table,
                    weights[uses_table],
                    rate[uses_table],
                    n_samples[uses_table],
                    whole_samples,
                )
            instrument_rows.append(type_rows)
        rows = (
            instrument_rows[0]
            if len(instrument_rows) == 1
            else np.concatenate(instrument_rows, axis=1)
        )
        for prior in self._own_prior_rows[run_types].T:
            rows = _project_out_first_column(rows, prior[:, None, None])
        return rows.reshape(*shape, *rows.shape[1:])

    @property
    def is_time_dependent(self) -> bool:
        """True if the information of a run depends on its start time."""
        return bool(self._temperature_indices or self._time_indices)

    @property
    def n_rows(self) -> int:
        """Number of rows of a run in `blocks`."""
        n_functions = 4 + 4 * self._terms.n_harmonics
        return sum(n_functions - instrument.order for instrument in self.setup.instruments)

    def _instrument_rows(
        self,
        instrument: PlannedInstrument,
        table: InformationTable | None,
        weights: Array,
        rate: Array,
        n_samples: Array,
        depends_on_phase: bool,
    ) -> Array:
        """Return the rows of an instrument with the start errors projected out."""
        sample_interval = 1.0 / self.setup.sampling_rate
        block_length = np.array(
            [block_size(sample_interval, float(run_rate)) for run_rate in rate], dtype=np.float64
        )
        angle_sd = rate * sample_interval * np.sqrt((block_length**2 - 1.0) / 12.0)
        if table is not None:
            return table.sqrt_information(
                average_over_blocks(weights, angle_sd),
                rate,
                n_samples,
                depends_on_phase=depends_on_phase,
            )
        samples = EvenSamples(
            first_angle=0.5 * rate * sample_interval * (block_length - 1.0),
            angle_step=rate * sample_interval * block_length,
            count=n_samples / block_length,
            angle_sd=angle_sd,
        )
        variance = instrument.noise.sample_variance
        if instrument.order == 0:  # a random walk of the velocity is white in specific force
            variance = variance + instrument.noise.random_walk**2 / sample_interval
        inverse_sd: Array = np.sqrt(block_length / variance)[:, None, None]
        return np.asarray(inverse_sd * sqrt_information(samples, weights, instrument.order))


def _project_out_first_column(rows: Array, prior: Array) -> Array:
    """Project the first unknown, with the prior 1/u, shape (n, 1, 1), out of rows.

    The remaining information is Y' (1 - x x'/(prior^2 + x'x)) Y. Its square root is Y minus a
    fraction of its component along x, which is exact and does not form products.
    """
    x, other_columns = rows[:, :, :1], rows[:, :, 1:]
    sum_of_squares = np.sum(x**2, axis=1, keepdims=True)
    retained_fraction = prior / np.sqrt(prior**2 + sum_of_squares)
    projection = np.sum(x * other_columns, axis=1, keepdims=True) / np.where(
        sum_of_squares > 0.0, sum_of_squares, 1.0
    )
    return np.asarray(other_columns - x * ((1.0 - retained_fraction) * projection))


def _indices_by_condition(setup: Setup, condition: str) -> list[int]:
    """Return the indices of the shared unknowns that depend on a condition."""
    symbols = (setup.model.unknowns[i].symbol for i in setup.shared_indices)
    return [index for index, symbol in enumerate(symbols) if condition_of(symbol) == condition]


def _pad_keys(keys: list[Key], count: int) -> list[Key]:
    """Return the keys, padded with empty keys to the number of another attitude."""
    return [*keys, *[("", "")] * (count - len(keys))]


def _expected_conditions(types: Sequence[RunType], duration: Array) -> tuple[Array, Array]:
    """Return the start times (s) and temperature offsets (K) of runs, shapes (..., n) and (n,).

    duration: s, shape (..., n).
    """
    order = measurement_order(types)
    start_time, temperature_offset = np.empty_like(duration), np.zeros(len(order))
    start_time[..., order] = np.cumsum(duration[..., order], axis=-1) - duration[..., order]
    if len(order) > 1:
        temperature_offset[order] = DEFAULT_WARMING * np.linspace(-0.5, 0.5, len(order))
    return start_time, temperature_offset


class Predictor:
    """Predicted uncertainties of designs, from the same solution as in a calibration."""

    def __init__(self, information: RunInformation) -> None:
        self.information = information
        setup = information.setup
        unknowns = [setup.model.unknowns[i] for i in setup.shared_indices]
        self.names = tuple(unknown.name for unknown in unknowns)
        prior_sds = np.array([unknown.prior_sd for unknown in unknowns])
        #: An unknown without a prior is constrained as weakly as in the solution.
        self.prior = whiten_priors(np.eye(prior_sds.size), prior_sds, prior_correlation(unknowns))
        considered_sds = setup.considered_sds
        self.common_sds = considered_sds[list(setup.shared_considered)]
        self.own_sds = {
            name: considered_sds[list(setup.own_indices(name)[1])] for name in setup.attitudes
        }

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
            conditions=_expected_conditions(types, 2.0 * math.pi * revolutions / rate),
        )
        return self._covariance(types, blocks)[0]

    def u(self, design: Design) -> Array:
        """Return the standard uncertainties of the shared unknowns, shape (p,).

        The number of samples is an integer, while `covariance` is a smooth function of the lengths.
        """
        runs = (design.types, design.rate, design.revolutions)
        covariance = self.covariance(*runs, whole_samples=True)
        return np.asarray(np.sqrt(np.diag(covariance)))

    def value(self, criterion: Criterion, design: Design) -> float:
        """Return the criterion value of a design, see `Criterion.value`."""
        covariance = self.covariance(design.types, design.rate, design.revolutions)
        return float(criterion.value(covariance))

    def _covariance(self, types: Sequence[RunType], blocks: Array) -> tuple[Array, Array, Array]:
        """Return the covariance, the noise covariance, and the contributions of considered terms.

        Shapes (..., p, p), (..., p, p) and (..., p, k).
        """
        p = self.p
        shape = blocks.shape[:-3]
        rows = blocks[..., :p].reshape(*shape, -1, p)
        prior = np.broadcast_to(self.prior, (*shape, p, p))
        triangle = triangular_factor(np.concatenate([rows, prior], axis=-2))
        inverse_triangle = np.linalg.inv(triangle)
        noise_covariance = np.asarray(
            inverse_triangle @ np.swapaxes(inverse_triangle, -1, -2), dtype=np.float64
        )
        if blocks.shape[-1] == p:
            return noise_covariance, noise_covariance, np.zeros((*shape, p, 0))
        moments = np.swapaxes(blocks[..., :p], -1, -2) @ self._scale_considered(types, blocks)
        q = self.common_sds.size
        common_moments = moments[..., :q].sum(axis=-3)
        run_moments = np.moveaxis(moments[..., q:], -3, -2)
        run_moments = run_moments.reshape(*shape, p, run_moments.shape[-2] * run_moments.shape[-1])
        considered_moments = np.concatenate([common_moments, run_moments], axis=-1)
        contributions: Array = -noise_covariance @ considered_moments
        covariance: Array = noise_covariance + contributions @ np.swapaxes(contributions, -1, -2)
        return covariance, noise_covariance, contributions

    def _scale_considered(self, types: Sequence[RunType], blocks: Array) -> Array:
        """Return the considered columns of blocks, each times its standard uncertainty."""
        q = self.common_sds.size
        columns = blocks[..., self.p :].copy()
        columns[..., :q] *= self.common_sds
        for index, run_type in enumerate(types):
            run_sds = self.own_sds[run_type.attitude]
            columns[..., index, :, q : q + run_sds.size] *= run_sds
        return columns

    def sensitivities(self, design: Design, criterion: Criterion) -> tuple[float, Array, Array]:
        """Return the criterion and its derivatives by log rate and log revolutions of each run.

        The information of a run enters the covariance as P dM P, so the derivatives need only
        shifted blocks, not further solutions.
        """
        upper_factor, lower_factor = 1.0 + _DERIVATIVE_STEP, 1.0 - _DERIVATIVE_STEP
        rate = np.array([[1.0], [upper_factor], [lower_factor], [1.0], [1.0]]) * design.rate
        revolutions = (
            np.array([[1.0], [1.0], [1.0], [upper_factor], [lower_factor]]) * design.revolutions
        )
        # The start time depends on the previous runs; its small effect on derivatives is neglected.
        conditions = _expected_conditions(design.types, design.duration)
        blocks = self.information.blocks(design.types, rate, revolutions, conditions=conditions)
        covariance, noise_covariance, contributions = self._covariance(design.types, blocks[0])
        value = float(criterion.value(covariance))
        directions = criterion.directions(covariance)
        run_terms = self._derivative_terms(
            design.types, blocks, noise_covariance, contributions, directions
        )
        return (
            value,
            (run_terms[1] - run_terms[2]) / (2.0 * _DERIVATIVE_STEP),
            (run_terms[3] - run_terms[4]) / (2.0 * _DERIVATIVE_STEP),
        )

    def _derivative_terms(
        self,
        types: Sequence[RunType],
        blocks: Array,
        noise_covariance: Array,
        contributions: Array,
        directions: Array,
    ) -> Array:
        """Return a quantity per run whose difference quotient is the derivative of the criterion.

        With c = directions, v = P c (scaled), s = K' c (considered), K the contributions and B the
        considered moments, d(c' S c) is -v' dM v - 2 s' (dB' v) - 2 s' B' dP c. Shape (..., runs).
        """
        p = self.p
        scaled_directions = noise_covariance @ directions
        projected_rows = blocks[..., :p] @ scaled_directions
        run_terms = -np.sum(projected_rows**2, axis=(-2, -1))
        if contributions.shape[-1] == 0:
            return np.asarray(run_terms)
        considered_directions = contributions.T @ directions
        # d(K' c) = -(dB)' v + B' P dM P c, and B' P is -K'.
        contribution_direction = contributions @ considered_directions
        run_terms -= 2.0 * np.sum(
            projected_rows * (blocks[..., :p] @ contribution_direction), axis=(-2, -1)
        )
        columns = self._scale_considered(types, blocks)
        q, n = self.common_sds.size, len(types)
        n_own = columns.shape[-1] - q
        weights = np.zeros((n, q + n_own, directions.shape[1]))
        weights[:, :q] = considered_directions[:q]
        weights[:, q:] = considered_directions[q:].reshape(n, n_own, directions.shape[1])
        run_terms -= 2.0 * np.sum(projected_rows * (columns @ weights), axis=(-2, -1))
        return np.asarray(run_terms)

"""Weights of functions of the angle in the columns of a planned run.

The weights are polynomials in the rate, fitted once to the columns of the calibration.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Final

import numpy as np
import numpy.typing as npt
from numpy.polynomial import chebyshev

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.inference.joint.design_blocks import DesignBlock, build_design_blocks
from counterspin.inference.joint.series import CLOCK, ResidualSeries
from counterspin.inference.joint.unknowns import Unknown, Unknowns
from counterspin.inference.noise.model import Noise
from counterspin.physics.accelerometer import Mounting
from counterspin.physics.conditions import RunConditions
from counterspin.physics.motion import Site, Trajectory
from counterspin.physics.observation import ORDERS
from counterspin.physics.spindle import Spindle
from counterspin.physics.terms import INPUTS, TERMS, coefficient_of, condition_of
from counterspin.planning.information_table import basis_functions, integration_matrix


@frozen
class PlannedInstrument:
    """An accelerometer in a plan."""

    #: As in `ResidualSeries`.
    name: str
    mounting: Mounting
    observable: str
    noise: Noise  #: Noise of one sample.
    timing_noise: float = 0.0  #: Standard deviation of the time stamps, s.
    #: Standard deviation of the recorded angle, rad, which corrects the times; infinite without an
    #: angle.
    encoder_noise: float = math.inf

    @property
    def order(self) -> int:
        """Number of integrations of the specific force in the observable."""
        return ORDERS[self.observable]

    def remaining_timing_noise(self, rate: float) -> float:
        """Return the noise of the times after correction by the angle at a rate, s."""
        combined_noise = math.hypot(self.timing_noise, self.encoder_noise / rate)
        return (
            self.timing_noise * self.encoder_noise / rate / combined_noise
            if math.isfinite(combined_noise)
            else self.timing_noise
        )

    @property
    def has_timing_noise(self) -> bool:
        """True if noise of the time stamps remains."""
        return self.timing_noise > 0.0 and self.encoder_noise > 0.0


def expected_record(
    series: ResidualSeries, expected: Mapping[Unknown, float], scale_factor: float
) -> ResidualSeries:
    """Return a record with its expected errors, except those of inputs.

    expected: Values minus nominal.
    scale_factor: K_I, which multiplies the errors of the platform.
    """
    active_unknowns = [
        unknown
        for unknown in expected
        if expected[unknown] and unknown.symbol not in INPUTS and unknown.affects(series)
    ]
    columns = series.columns([unknown.symbol for unknown in active_unknowns], scale_factor)
    return replace(series, error=columns @ [expected[unknown] for unknown in active_unknowns])


@frozen
class Setup:
    """The setup of a plan: instruments, attitudes, unknowns."""

    instruments: tuple[PlannedInstrument, ...]  #: The accelerometers.
    #: Attitudes by name: rows x, y, z in east-north-up, shape (3, 3). The model has the unknowns of
    #: a run, such as its tilt, once for each name.
    attitudes: dict[str, Array]
    radius: float  #: Radius of the centrifuge, m.
    site: Site  #: Location of the centrifuge.
    sampling_rate: float  #: Sampling rate, Hz.
    model: Unknowns  #: Estimated and considered terms.
    #: Expected values of the unknowns minus nominal, shape (p,), for the effect of inputs.
    expected: Array
    scale_factors: dict[str, float]  #: K_I of each accelerometer.

    @cached_property
    def shared_indices(self) -> tuple[int, ...]:
        """Indices of the shared unknowns in the model."""
        unknowns = enumerate(self.model.unknowns)
        return tuple(i for i, unknown in unknowns if unknown.owner not in self.attitudes)

    @cached_property
    def shared_considered(self) -> tuple[int, ...]:
        """Indices of the shared considered terms in the model."""
        owners = [considered_term.owner for considered_term in self.model.considered]
        return tuple(i for i, owner in enumerate(owners) if owner not in self.attitudes)

    def own_indices(self, attitude: str) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Return the indices of the run's own unknowns and own considered terms."""
        model = self.model
        return (
            tuple(i for i, unknown in enumerate(model.unknowns) if unknown.owner == attitude),
            tuple(
                i
                for i, considered_term in enumerate(model.considered)
                if considered_term.owner == attitude
            ),
        )

    @property
    def considered_sds(self) -> Array:
        """Standard uncertainties of all considered terms, in the order of the model."""
        return np.array(self.model.considered_sds)


#: Candidates for the number of harmonics. The smallest one with relative residuals below
#: `_MAX_RESIDUAL` is used, or with residuals near those of all harmonics, because difference
#: quotients have rounding errors. A term with a kink has all harmonics, which decrease as n^-3; its
#: limit is higher, because the information lacks only the square of the residual.
_HARMONIC_COUNTS: Final = (3, 4, 6, 11)
_MAX_RESIDUAL: Final = 1e-6
_MAX_KINK_RESIDUAL: Final = 5e-4

#: Number of nodes in the rate: the weights are polynomials of degree 10 (a_I^4 has w^8).
_N_RATE_NODES: Final = 13

#: Owner and symbol of a term; the suffix marks the change of its effect per second.
Key = tuple[str, str]
PER_SECOND_SUFFIX: Final = " in a second"

#: Step of the derivative with respect to the clock.
_CLOCK_STEP: Final = 1e-6


class TermWeights:
    """Weights of the functions of the angle in the columns of every term, over the rate.

    rates: Lowest and highest rate (magnitudes), rad/s.
    run_types: Attitude and sense of each type of run.
    """

    def __init__(
        self, setup: Setup, rates: tuple[float, float], run_types: Sequence[tuple[str, int]]
    ) -> None:
        self.setup = setup
        self.rates = rates
        forces = [
            [self._forces_at_nodes(instrument, *run_type) for run_type in run_types]
            for instrument in setup.instruments
        ]
        #: Highest harmonic of the functions.
        self.n_harmonics = next(
            (
                n_harmonics
                for n_harmonics in _HARMONIC_COUNTS
                if all(
                    self._is_accurate(n_harmonics, instrument, *keys_and_forces)
                    for instrument, forces_by_type in zip(setup.instruments, forces, strict=True)
                    for keys_and_forces in forces_by_type
                )
            ),
            _HARMONIC_COUNTS[-1],
        )
        #: For each instrument and type of run: Chebyshev coefficients of the weights over the rate,
        #: by term, shape (nodes, b).
        self.terms = [
            [self._fit_weights(instrument, *keys_and_forces) for keys_and_forces in forces_by_type]
            for instrument, forces_by_type in zip(setup.instruments, forces, strict=True)
        ]

    @property
    def shape(self) -> tuple[int, int]:
        """The shape of each term's weights."""
        return _N_RATE_NODES, 4 + 4 * self.n_harmonics

    def evaluate(
        self, weights: Array, run_types: npt.NDArray[np.intp], rate: Array, order: int
    ) -> Array:
        """Return the weights at rates, shape (n, b, columns), integrated over time."""
        low, high = self.rates
        position = (2.0 * rate - low - high) / (high - low)
        vander = chebyshev.chebvander(position, _N_RATE_NODES - 1) / rate[:, None] ** (1 + order)
        result = np.empty((len(rate), *weights.shape[2:]))
        for run_type in np.unique(run_types):
            has_type = run_types == run_type
            result[has_type] = np.tensordot(vander[has_type], weights[run_type], axes=1)
        return result

    @property
    def _nodes(self) -> Array:
        """Rates at which the weights are computed, rad/s."""
        low, high = self.rates
        return np.asarray(
            0.5 * (low + high) + 0.5 * (high - low) * chebyshev.chebpts1(_N_RATE_NODES)
        )

    def _forces_at_nodes(
        self, instrument: PlannedInstrument, attitude: str, sense: int
    ) -> tuple[list[Key], Array]:
        """Return the active terms, and their forces at the nodes of the rate, (nodes, n, k).

        The n angles are evenly spaced over three revolutions.
        """
        points_per_revolution = 24 * (_HARMONIC_COUNTS[-1] + 1)
        angle: Array = np.arange(3.0 * points_per_revolution) * (
            2.0 * math.pi / points_per_revolution
        )
        model, forces = self.setup.model, []
        for rate in self._nodes:
            block = self._columns(instrument, attitude, sense * rate, angle / rate)
            keys = [make_key(model.unknowns[i]) for i in block.unknowns]
            keys += [make_key(model.considered[i]) for i in block.considered]
            columns = [block.design, block.considered_design]
            for owner, symbol in keys[: len(block.unknowns)]:
                if condition_of(symbol) == "time":
                    keys.append((owner, symbol + PER_SECOND_SUFFIX))
                    columns.append(block.series.columns([coefficient_of(symbol)], 1.0))
            forces.append(np.hstack(columns))
        return keys, np.array(forces)

    def _is_accurate(
        self, n_harmonics: int, instrument: PlannedInstrument, keys: list[Key], forces: Array
    ) -> bool:
        """Check that the terms are combinations of the functions, to the required accuracy.

        forces: Forces of the terms, as in `_forces_at_nodes`.
        """
        residual, min_residual = (
            _fit_combination(forces, n)[1] for n in (n_harmonics, _HARMONIC_COUNTS[-1])
        )
        # Integration divides the harmonics after the first n by at least n + 1.
        kink_residual = _MAX_KINK_RESIDUAL * (n_harmonics + 1.0) ** instrument.order
        is_kinked = [_has_kink(symbol.removesuffix(PER_SECOND_SUFFIX)) for _, symbol in keys]
        limit = np.where(is_kinked, kink_residual, np.maximum(_MAX_RESIDUAL, 1.1 * min_residual))
        return bool(np.all(residual < limit))

    def _fit_weights(
        self, instrument: PlannedInstrument, keys: list[Key], forces: Array
    ) -> dict[Key, Array]:
        """Return Chebyshev coefficients of each term's weights over the rate, (nodes, b).

        forces: Forces of the terms, as in `_forces_at_nodes`.
        """
        weights, _ = _fit_combination(forces, self.n_harmonics)
        # At a fixed angle, forces are polynomials in the rate; times the rate, so are effects that
        # grow with time.
        integration_operator = integration_matrix(self.n_harmonics, instrument.order)
        values = self._nodes[:, None, None] * (integration_operator @ weights)
        vander = chebyshev.chebvander(chebyshev.chebpts1(_N_RATE_NODES), _N_RATE_NODES - 1)
        coefficients = np.linalg.solve(vander, values.reshape(_N_RATE_NODES, -1))
        columns = np.moveaxis(coefficients.reshape(values.shape), 2, 0)
        return dict(zip(keys, columns, strict=True))

    def _columns(
        self, instrument: PlannedInstrument, attitude: str, rate: float, times: Array
    ) -> DesignBlock:
        """Return the columns of the specific force, before integration."""
        setup = self.setup
        force_instrument = replace(instrument, observable="specific_force")
        series = self.series(force_instrument, attitude, rate, times)
        factors = {name: setup.scale_factors[name] for name in [instrument.name]}
        (block,) = build_design_blocks([series], setup.model, factors, setup.expected)
        unknowns = [setup.model.unknowns[i].symbol for i in block.unknowns]
        considered = [setup.model.considered[i].symbol for i in block.considered]
        for symbols, columns in ((unknowns, block.design), (considered, block.considered_design)):
            if CLOCK in symbols and instrument.order > 0:
                column = columns[:, symbols.index(CLOCK)]
                column[:] = self._clock_derivative(block, column, instrument.order)
        return block

    def series(
        self, instrument: PlannedInstrument, attitude: str, rate: float, times: Array
    ) -> ResidualSeries:
        """Return a record without errors."""
        setup = self.setup
        return ResidualSeries(
            accelerometer=instrument.name,
            run=attitude,
            trajectory=Trajectory(
                Spindle(rate),
                setup.radius,
                setup.site,
                conditions=RunConditions(temperature_offset=1.0),
            ),
            mounting=instrument.mounting,
            observable=instrument.observable,
            attitude=setup.attitudes[attitude],
            time=times,
            time_sd=np.zeros_like(times),
            count=np.ones_like(times),
            spacing=float(times[1] - times[0]),
            error=np.zeros_like(times),
        )

    def _clock_derivative(self, block: DesignBlock, column: Array, order: int) -> Array:
        """Return the `order`-th derivative of the effect of a clock error on a record.

        A fast clock reduces the force at true times by its relative error for each integration.
        The spindle passes the same angles: the circular motion has no effect on displacement, and
        the effect of its acceleration on velocity.
        """
        series, model = block.series, self.setup.model
        parameters = [k for k, i in enumerate(block.unknowns) if model.unknowns[i].is_of_interest]
        values = self.setup.expected[[block.unknowns[k] for k in parameters]]
        errors = block.design[:, parameters] @ values
        clock_effect = series.rescale_clock(_CLOCK_STEP).reference() - series.reference()
        derivative: Array = column - clock_effect / _CLOCK_STEP - order * errors
        if order == 1:
            axis = series.mounting.turned(series.attitude).input_axis
            derivative = derivative + series.trajectory.acceleration(series.time) @ axis
        return derivative


def _fit_combination(columns: Array, n_harmonics: int) -> tuple[Array, Array]:
    """Return the weights of 1, th, cos, sin, th cos, th sin in columns, and relative residuals.

    Terms that grow with the angle follow from the difference of two revolutions, which is exact for
    any harmonics of the other terms. Shapes (..., b, k) and (k,).

    columns: Over three revolutions, shape (..., n, k).
    """
    points_per_revolution = columns.shape[-2] // 3
    angle: Array = np.arange(3.0 * points_per_revolution) * (2.0 * math.pi / points_per_revolution)
    basis = basis_functions(angle, n_harmonics)
    periodic_indices = [0, *(i for m in range(1, n_harmonics + 1) for i in (4 * m, 4 * m + 1))]
    growing_indices = [1, *(i for m in range(1, n_harmonics + 1) for i in (4 * m + 2, 4 * m + 3))]
    projection = 2.0 / points_per_revolution * basis[:points_per_revolution, periodic_indices].T
    projection[0] *= 0.5
    first_revolution = columns[..., :points_per_revolution, :]
    second_revolution = columns[..., points_per_revolution : 2 * points_per_revolution, :]
    slope = (second_revolution - first_revolution) / (2.0 * math.pi)
    weights = np.zeros((*columns.shape[:-2], basis.shape[1], columns.shape[-1]))
    weights[..., growing_indices, :] = projection @ slope
    weights[..., periodic_indices, :] = projection @ (
        first_revolution - angle[:points_per_revolution, None] * slope
    )
    amplitude = np.maximum(np.abs(columns).max(axis=-2), np.finfo(float).tiny)
    residual = np.abs(columns - basis @ weights).max(axis=-2) / amplitude
    return weights, residual.reshape(-1, columns.shape[-1]).max(axis=0)


def make_key(unknown: Unknown, suffix: str = "") -> Key:
    """Return the key of an unknown's weights."""
    return unknown.owner, unknown.symbol + suffix


def _has_kink(symbol: str) -> bool:
    return symbol in TERMS and TERMS[symbol].effect.has_kink

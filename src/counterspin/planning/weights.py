"""The weights with which a planned run's columns are combinations of functions of the angle.

Polynomials in the rate, found once from the same columns as a calibration's.
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
    noise: Noise  #: Of one sample.
    timing: float = 0.0  #: Standard deviation of the time stamps, s.
    #: Standard deviation of a recorded angle, rad, by which times are corrected; infinite without
    #: an angle.
    encoder: float = math.inf

    @property
    def order(self) -> int:
        """Number of integrations of the specific force in the observable."""
        return ORDERS[self.observable]

    def timing_left(self, rate: float) -> float:
        """Return the noise of the times that the angles leave at a rate, s."""
        both = math.hypot(self.timing, self.encoder / rate)
        return self.timing * self.encoder / rate / both if math.isfinite(both) else self.timing

    @property
    def scatters(self) -> bool:
        """True if noise of the time stamps remains."""
        return self.timing > 0.0 and self.encoder > 0.0


def expected_record(
    series: ResidualSeries, expected: Mapping[Unknown, float], scale_factor: float
) -> ResidualSeries:
    """Return a record with its expected errors, except those of inputs.

    expected: Values minus nominal.
    scale_factor: K_I, with which the accelerometer sees the platform's errors.
    """
    relevant = [u for u in expected if expected[u] and u.symbol not in INPUTS and u.affects(series)]
    columns = series.columns([u.symbol for u in relevant], scale_factor)
    return replace(series, error=columns @ [expected[u] for u in relevant])


@frozen
class Setup:
    """The setup of a plan: instruments, attitudes, unknowns."""

    instruments: tuple[PlannedInstrument, ...]  #: The accelerometers.
    #: Name -> rows x, y, z in east-north-up, shape (3, 3). The model has the unknowns that belong
    #: to a run, such as its tilt, once for each of these names.
    attitudes: dict[str, Array]
    #: m; where the centrifuge stands.
    radius: float
    site: Site
    sampling_rate: float  #: Samples a second, Hz.
    model: Unknowns  #: What is estimated and considered.
    #: Expected values of the unknowns, minus nominal, shape (p,); the uncertain inputs act on them.
    estimate: Array
    scale_factors: dict[str, float]  #: K_I of each accelerometer.

    @cached_property
    def shared(self) -> tuple[int, ...]:
        """Places of the unknowns that all runs share, in the model."""
        unknowns = enumerate(self.model.unknowns)
        return tuple(i for i, unknown in unknowns if unknown.owner not in self.attitudes)

    @cached_property
    def considered(self) -> tuple[int, ...]:
        """Places of the considered terms that all runs share."""
        owners = [considered_term.owner for considered_term in self.model.considered]
        return tuple(i for i, owner in enumerate(owners) if owner not in self.attitudes)

    def own(self, attitude: str) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Return the places of a run's own unknowns and of its own considered terms."""
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
    def considered_sizes(self) -> Array:
        """Standard uncertainties of all considered columns, in the model's order."""
        return np.array(self.model.considered_sds)


#: Highest harmonics of the angle that are tried, until the columns are combinations of the
#: functions to `_RESIDUAL` of their size, or as well as they ever are: difference quotients have
#: rounding. A term with a kink has all harmonics, those of its force falling off as n^-3: of it
#: the remainder in the record counts, whose square is missing from the information.
_HARMONICS: Final = (3, 4, 6, 11)
_RESIDUAL: Final = 1e-6
_RESIDUAL_OF_KINK: Final = 5e-4

#: Nodes in the rate: the weights are polynomials of the tenth degree (a_I^4 goes as w^8).
_RATE_NODES: Final = 13

#: Owner and symbol of a term; an ending marks the change of its effect in each second.
Key = tuple[str, str]
A_SECOND: Final = " in a second"

#: Step of the derivative by the clock.
_CLOCK_STEP: Final = 1e-6


class TermWeights:
    """The weights of every term in the functions of the angle, over the rate.

    rates: Smallest and largest size of the rate, rad/s.
    run_types: Attitude and sense of each type of run.
    """

    def __init__(
        self, setup: Setup, rates: tuple[float, float], run_types: Sequence[tuple[str, int]]
    ) -> None:
        self.setup = setup
        self.rates = rates
        forces = [[self._forces(i, *run_type) for run_type in run_types] for i in setup.instruments]
        #: Highest harmonic of the functions.
        self.harmonics = next(
            (
                harmonics
                for harmonics in _HARMONICS
                if all(
                    self._suffice(harmonics, instrument, *shown)
                    for instrument, by_run_type in zip(setup.instruments, forces, strict=True)
                    for shown in by_run_type
                )
            ),
            _HARMONICS[-1],
        )
        #: Of each instrument and kind of run, the Chebyshev coefficients of each term's weights
        #: over the rate, shape (nodes, b).
        self.terms = [
            [self._weights_of(instrument, *shown) for shown in by_run_type]
            for instrument, by_run_type in zip(setup.instruments, forces, strict=True)
        ]

    @property
    def shape(self) -> tuple[int, int]:
        """The shape of each term's weights."""
        return _RATE_NODES, 4 + 4 * self.harmonics

    def at(self, weights: Array, run_types: npt.NDArray[np.intp], rate: Array, order: int) -> Array:
        """Return the weights at rates, shape (n, b, columns), integrated over time."""
        low, high = self.rates
        position = (2.0 * rate - low - high) / (high - low)
        vander = chebyshev.chebvander(position, _RATE_NODES - 1) / rate[:, None] ** (1 + order)
        result = np.empty((len(rate), *weights.shape[2:]))
        for run_type in np.unique(run_types):
            is_type = run_types == run_type
            result[is_type] = np.tensordot(vander[is_type], weights[run_type], axes=1)
        return result

    @property
    def _nodes(self) -> Array:
        """Sizes of the rate at which the weights are computed, rad/s."""
        low, high = self.rates
        return np.asarray(0.5 * (low + high) + 0.5 * (high - low) * chebyshev.chebpts1(_RATE_NODES))

    def _forces(
        self, instrument: PlannedInstrument, attitude: str, sense: int
    ) -> tuple[list[Key], Array]:
        """Return the terms that act, and their forces at the nodes of the rate, (nodes, n, k).

        At n even angles in three revolutions.
        """
        points = 24 * (_HARMONICS[-1] + 1)
        angle: Array = np.arange(3.0 * points) * (2.0 * math.pi / points)
        model, forces = self.setup.model, []
        for rate in self._nodes:
            block = self._columns(instrument, attitude, sense * rate, angle / rate)
            keys = [key_of(model.unknowns[i]) for i in block.unknowns]
            keys += [key_of(model.considered[i]) for i in block.considered]
            columns = [block.design, block.fixed]
            for owner, symbol in keys[: len(block.unknowns)]:
                if condition_of(symbol) == "time":
                    keys.append((owner, symbol + A_SECOND))
                    columns.append(block.series.columns([coefficient_of(symbol)], 1.0))
            forces.append(np.hstack(columns))
        return keys, np.array(forces)

    def _suffice(
        self, harmonics: int, instrument: PlannedInstrument, keys: list[Key], forces: Array
    ) -> bool:
        """Check that the terms are combinations of the functions, to the required accuracy.

        forces: Of the terms, as in `_forces`.
        """
        residual, min_residual = (
            _combination(forces, order)[1] for order in (harmonics, _HARMONICS[-1])
        )
        # Integration divides the remainder after the first harmonics by at least their number.
        kink_residual = _RESIDUAL_OF_KINK * (harmonics + 1.0) ** instrument.order
        is_kinked = [_has_kink(symbol.removesuffix(A_SECOND)) for _, symbol in keys]
        limit = np.where(is_kinked, kink_residual, np.maximum(_RESIDUAL, 1.1 * min_residual))
        return bool(np.all(residual < limit))

    def _weights_of(
        self, instrument: PlannedInstrument, keys: list[Key], forces: Array
    ) -> dict[Key, Array]:
        """Return Chebyshev coefficients of each term's weights over the rate, (nodes, b).

        forces: Of the terms, as in `_forces`.
        """
        weights, _ = _combination(forces, self.harmonics)
        # At a given angle forces are polynomials in the rate; times the rate, so is what grows with
        # time.
        turning = integration_matrix(self.harmonics, instrument.order)
        values = self._nodes[:, None, None] * (turning @ weights)
        vander = chebyshev.chebvander(chebyshev.chebpts1(_RATE_NODES), _RATE_NODES - 1)
        coefficients = np.linalg.solve(vander, values.reshape(_RATE_NODES, -1))
        columns = np.moveaxis(coefficients.reshape(values.shape), 2, 0)
        return dict(zip(keys, columns, strict=True))

    def _columns(
        self, instrument: PlannedInstrument, attitude: str, rate: float, times: Array
    ) -> DesignBlock:
        """Return the columns of the specific force, before any integration."""
        setup = self.setup
        force_instrument = replace(instrument, observable="specific_force")
        series = self.series(force_instrument, attitude, rate, times)
        factors = {name: setup.scale_factors[name] for name in [instrument.name]}
        (block,) = build_design_blocks([series], setup.model, factors, setup.estimate)
        unknowns = [setup.model.unknowns[i].symbol for i in block.unknowns]
        considered = [setup.model.considered[i].symbol for i in block.considered]
        for symbols, columns in ((unknowns, block.design), (considered, block.fixed)):
            if CLOCK in symbols and instrument.order > 0:
                column = columns[:, symbols.index(CLOCK)]
                column[:] = self._by_clock(block, column, instrument.order)
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

    def _by_clock(self, block: DesignBlock, column: Array, order: int) -> Array:
        """Return the `order`-th derivative of a fast clock's effect on a record, from the force.

        The clock reduces a force at true times by its own size for each integration.
        A circle is passed at the same angles: nothing of it shows in displacement, its
        acceleration in velocity.
        """
        series, model = block.series, self.setup.model
        requested = [k for k, i in enumerate(block.unknowns) if model.unknowns[i].is_of_interest]
        values = self.setup.estimate[[block.unknowns[k] for k in requested]]
        errors = block.design[:, requested] @ values
        change = series.rescale_clock(_CLOCK_STEP).reference() - series.reference()
        shown: Array = column - change / _CLOCK_STEP - order * errors
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
    shapes = basis_functions(angle, harmonics)
    periodic = [0, *(index for m in range(1, harmonics + 1) for index in (4 * m, 4 * m + 1))]
    growing = [1, *(index for m in range(1, harmonics + 1) for index in (4 * m + 2, 4 * m + 3))]
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


def key_of(unknown: Unknown, ending: str = "") -> Key:
    """Return the key of an unknown's weights."""
    return unknown.owner, unknown.symbol + ending


def _has_kink(symbol: str) -> bool:
    return symbol in TERMS and TERMS[symbol].effect.has_kink

"""Readings of an accelerometer at known attitudes: at rest, on an arm or on a turntable.

A reading is linear in the coefficients, and nearly linear in the terms of the machine.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.inference.joint.fit import JointFit
from counterspin.inference.joint.series import RATE
from counterspin.inference.joint.unknowns import Unknown, Unknowns
from counterspin.inference.least_squares import Solution
from counterspin.physics.accelerometer import Mounting
from counterspin.physics.motion import Site
from counterspin.physics.station import Stations, mean_products
from counterspin.physics.terms import (
    ACCELEROMETER_TERMS,
    TABLE,
    TERMS,
    accelerometer_name,
    coefficient_of,
    is_term,
    mounting_name,
    term,
)
from counterspin.readings.linear import MIN_RELATIVE_NOISE, LinearReadings

#: Step of derivatives by machine terms, relative to their largest credible sizes.
_RELATIVE_STEP: Final = 1e-2

#: Uncertain input of readings -> step of its derivative, m, m/s^2, rad.
INPUT_STEPS: Final = {"centrifuge.radius": 1e-4, "site.gravity": 1e-3, "site.latitude": 1e-3}

#: Symbol of the relative error of amplitudes of vibration.
AMPLITUDE: Final = "vibration.amplitude"

#: Relative step of derivatives by clocks, rates and amplitudes.
_RATE_STEP: Final = 1e-4

#: Step of derivatives by the angle of the dividing head, rad.
_HEAD_STEP: Final = 1e-5

_SYMBOLS: Final = tuple(TERMS)


@frozen
class Readings:
    """n readings of an accelerometer in one motion, with one kind of noise."""

    accelerometer: str  #: Name of the accelerometer.
    motion: str  #: Motion of all stations.
    names: tuple[str, ...]  #: Names of the readings.
    site: Site  #: Site of the test.
    stations: Stations  #: Axes of the instrument, and state of the machine.
    mountings: tuple[str, ...]  #: Mounting of each reading; empty: none.
    #: Axis of the dividing head in the frame of the station, shape (n, 3); zero without a head.
    head: Array
    u_head: Array  #: Random standard uncertainty of the head angle, rad, shape (n,).
    value: Array  #: Indications in g by the nominal sensitivity, shape (n,).
    u: Array | None  #: Their standard uncertainties, shape (n,); None: estimated, common to all.
    #: Conditions relative to the reference, as in `relative_conditions`, each of shape (n,).
    conditions: Mapping[str, Array]
    repeats: Array  #: Number of repeats at one setting, shape (n,); used if `u` is None.
    scatter: Array  #: Sum of squares of the repeats about their mean, g^2, shape (n,).
    resolution: float = 0.0  #: Smallest unit of the last digit, g; 0: unknown.
    position: tuple[str, ...] = ()  #: Positions whose positioning error is an unknown; empty: none.
    in_si: Array | float = 0.0  #: 1 for a value in m/s^2 that was converted to g, else 0.
    head_angle: Array | float = 0.0  #: Indicated angle of the dividing head, rad, shape (n,).
    #: 1 if the sense of rotation was stated, 0 if it was measured by an angle, shape (n,).
    stated_sense: Array | float = 1.0
    #: Stated rates, rad/s, shape (n,); None: those of the stations.
    stated_rates: tuple[float, ...] | None = None
    u_rate: Array | float = 0.0  #: Relative random standard uncertainty of each rate, shape (n,).
    default_rate: Array | float = 0.0  #: 1 if `u_rate` is the default, else 0, shape (n,).
    #: Relative random standard uncertainty of each amplitude of vibration, shape (n,).
    u_amplitude: Array | float = 0.0
    #: Name of the input that is the clock error of each rate; empty at rest.
    clocks: tuple[str, ...] = ()

    def products(self, machine_terms: Mapping[str, float]) -> Array:
        """Return the mean product of each term at each reading, shape (n, number of `TERMS`).

        machine_terms: Symbol of a machine term -> its deviation from nominal.
        """
        return mean_products(self.stations_with(machine_terms), self.site)

    def stations_with(self, machine_terms: Mapping[str, float]) -> Stations:
        """Return the stations of the readings with given machine terms."""
        stations = self.stations
        for symbol, deviation in machine_terms.items():
            if deviation != 0.0:
                stations = self.perturb(stations, symbol, deviation)
        return stations

    def perturb(self, stations: Stations, symbol: str, deviation: float) -> Stations:
        """Return stations of the readings with the effect of another machine term."""
        steps = deviation * self.affected_mask(symbol)
        if not steps.any():
            return stations
        return stations.perturb(symbol, steps, self.head, self.head_angles)

    @cached_property
    def head_angles(self) -> Array:
        """Indicated angle of the head at each reading, rad, shape (n,)."""
        return np.broadcast_to(self.head_angle, self.size)

    def rotate_head(self, stations: Stations, angles: Array) -> Stations:
        """Return stations with errors of the head angle, rad, shape (n,)."""
        return stations.perturb("head.zero", angles, self.head, self.head_angles)

    def with_rate_errors(self, errors: Array) -> Readings:
        """Return readings at rates or amplitudes larger by relative errors, shape (n,)."""
        rate, amplitude = (
            setting * (1.0 + errors) for setting in (self.stations.rate, self.stations.amplitude)
        )
        return replace(self, stations=replace(self.stations, rate=rate, amplitude=amplitude))

    @property
    def noise_floor(self) -> float:
        """Smallest credible noise of a repeat, g: the rounding of the last digit (GUM F.2.2.1).

        If more digits were written than a readout has, it is `MIN_RELATIVE_NOISE` times the largest
        value. Repeats that scatter by less than the last digit have the same rounding error.
        """
        max_value = float(np.max(np.abs(self.value), initial=1e-3))
        rounding_sd = max(self.resolution / math.sqrt(12.0), MIN_RELATIVE_NOISE * max_value)
        repeat_dof = float(np.sum(self.repeats - 1.0))
        is_below_resolution = float(self.scatter.sum()) < repeat_dof * (self.resolution / 2.0) ** 2
        return (
            rounding_sd * math.sqrt(float(self.repeats.max()))
            if is_below_resolution
            else rounding_sd
        )

    @property
    def replicates(self) -> tuple[tuple[int, ...], ...]:
        """Indices of the readings of each position with several readings."""
        groups: dict[tuple[object, ...], list[int]] = {}
        angles = self.head_angles
        # Directions of axes have rounding errors.
        axes = self.stations.axes.reshape(self.size, 9)
        axes = np.column_stack([axes, np.cos(angles), np.sin(angles)])
        # A repeat has the same stated rate, but not exactly the same measured rate.
        rates = self.stated_rates or self.stations.rate.tolist()
        rows = zip(np.round(axes, 9).tolist(), rates, self.mountings, strict=True)
        for index, (row, rate, mounting) in enumerate(rows):
            groups.setdefault((*row, rate, mounting), []).append(index)
        return tuple(tuple(indices) for indices in groups.values() if len(indices) > 1)

    @property
    def accelerometers(self) -> tuple[str, ...]:
        """The name of the accelerometer that was read."""
        return (self.accelerometer,)

    @property
    def time(self) -> Array:
        """Times from the beginning of the campaign, s, shape (n,)."""
        return self.conditions["time"]

    @property
    def size(self) -> int:
        """The number of readings."""
        return len(self.names)

    @property
    def repeat_dof(self) -> float:
        """Degrees of freedom of repeats at one setting."""
        return float(np.sum(self.repeats - 1.0))

    def linearize(
        self, model: Unknowns, estimate: Array, variance: Array | None = None
    ) -> LinearReadings:
        """Return the readings linearised at an estimate; see `linearize`."""
        return linearize(self, model, estimate, variance)

    @property
    def triad(self) -> tuple[str, ...]:
        """No triad: attitudes are known."""
        return ()

    def start(self, unknowns: Sequence[Unknown], point: Array) -> Array:  # noqa: ARG002
        """Return the given point, because readings need no other start."""
        return point

    def without_positioning_errors(self) -> Readings:
        """Return the readings without positioning errors."""
        return replace(self, position=())

    def with_noise(self, noise: float) -> Readings:
        """Return the readings with a stated noise of one repeat, g."""
        return replace(self, u=noise / np.sqrt(self.repeats))

    def with_rotated_mounting(self, name: str, rotate: Callable[[Mounting], Mounting]) -> Readings:
        """Return the readings with a rotated accelerometer."""
        if self.accelerometer != name:
            return self
        mountings = (Mounting(tuple(map(tuple, axes))) for axes in self.stations.axes.tolist())
        axes = np.array([rotate(mounting).axes for mounting in mountings])
        return replace(self, stations=replace(self.stations, axes=axes))

    def default_candidates(self, model: Unknowns) -> Sequence[Unknown]:  # noqa: ARG002
        """Return no parameter: attitudes are known."""
        return ()

    def find_undetermined(
        self,
        fit: JointFit,  # noqa: ARG002
        model: Unknowns,  # noqa: ARG002
        candidates: Sequence[Unknown],  # noqa: ARG002
    ) -> Sequence[Unknown]:
        """Return no parameter: attitudes are known."""
        return ()

    def curvature(self, model: Unknowns, estimate: Array, steps: Array) -> Array:  # noqa: ARG002
        """Return zeros: a reading is nearly linear in its unknowns."""
        return np.zeros((self.size, steps.shape[1]))

    def insufficient_noise_message(
        self,
        dof: float,
        n_free: int,  # noqa: ARG002
        solution: Solution,  # noqa: ARG002
        model: Unknowns,  # noqa: ARG002
    ) -> str:
        """Return an error message if the residuals do not determine the noise, else ''."""
        if dof >= 0.5:
            return ""
        return (
            f"{self.accelerometer}: {self.size} reading{'s' * (self.size != 1)} ({self.motion}) "
            "without a stated uncertainty cannot determine both the unknowns and the noise; state "
            "the uncertainty, or take more readings than there are unknowns"
        )

    def divergence_message(self, n_iterations: int) -> str:  # noqa: ARG002
        """Return no cause, because the fit names the reading with the largest residual."""
        return ""

    def affected_mask(self, symbol: str) -> Array:
        """Return 1 for each reading that a machine term affects, else 0, shape (n,)."""
        if not is_term(symbol) or self.motion not in term(symbol).motions:
            return np.zeros(self.size)
        name = mounting_name(symbol)
        if not name:
            return np.ones(self.size)
        if accelerometer_name(symbol) not in ("", self.accelerometer):
            return np.zeros(self.size)
        names = self.mountings if term(symbol).per_mounting else self.position
        return np.array(
            [float(reading_name == name) for reading_name in names or ("",) * self.size]
        )

    def design_factor(self, symbol: str) -> Array:
        """Return the factor of a coefficient, or of its slope, shape (n,)."""
        forces = self.stations.radius * self.stations.rate**2 / self.site.gravity
        conditions = {**self.conditions, "force": forces**2}
        return ACCELEROMETER_TERMS[symbol].effect.design_factors(conditions)


def linearize(
    group: Readings, model: Unknowns, estimate: Array, variance: Array | None = None
) -> LinearReadings:
    """Return readings linearised at an estimate; missing considered terms have prior means.

    variance: Variance of each unknown; None: that of its prior.
    """
    unknowns = [*model.unknowns, *model.considered]
    variances = np.array([term.prior[1] ** 2 for term in unknowns])
    if variance is not None:
        variances[: variance.size] = variance
    values = np.append(estimate, [term.prior_mean for term in unknowns[len(estimate) :]])
    symbols = {
        index: unknown.symbol
        for index, unknown in enumerate(unknowns)
        if unknown.owner in ("", group.accelerometer)
    }
    machine_terms = {
        symbol: float(values[index])
        for index, symbol in symbols.items()
        if not unknowns[index].owner and group.affected_mask(symbol).any()
    }
    design_factors = dict(_design_factors(group, symbols))
    operating_point = _OperatingPoint.at(
        group, group.stations_with(machine_terms), values, design_factors
    )
    columns = np.zeros((group.size, len(unknowns)))
    for index, (term_index, factor) in design_factors.items():
        columns[:, index] = operating_point.products[:, term_index] * factor
    indices_by_row: dict[str, list[int]] = {}
    for index, symbol in symbols.items():
        if symbol in machine_terms:
            indices_by_row.setdefault(term(symbol).symbol, []).append(index)
    rate_noise = operating_point.rate_uncertainty(RATE, group.u_rate)
    shift, extra_variance = np.zeros(group.size), operating_point.head_variance() + rate_noise**2
    extra_variance += operating_point.rate_uncertainty(AMPLITUDE, group.u_amplitude) ** 2
    for row, indices in indices_by_row.items():
        # Each of the mountings, or positions, of a row has readings of its own.
        owner_index = np.full(group.size, -1)
        for index in indices:
            owner_index[group.affected_mask(symbols[index]) > 0.0] = index
        affected_rows = np.flatnonzero(owner_index >= 0)
        owner_index, step = owner_index[affected_rows], _RELATIVE_STEP * unknowns[indices[0]].limit
        upper_products, lower_products = operating_point.perturb_both(
            affected_rows, symbols[indices[0]], step
        )
        columns[affected_rows, owner_index] = operating_point.slope(
            upper_products, lower_products, step, affected_rows
        )
        if TABLE[row].scope == "position":
            # A positioning error of either sign reduces the cosine. Its square has a mean and a
            # variance, which is common to all readings of the position.
            curvature_term = (
                operating_point.half_curvature(upper_products, lower_products, step, affected_rows)
                * variances[owner_index]
            )
            shift[affected_rows] += curvature_term
            extra_variance[affected_rows] += (
                np.bincount(owner_index)[owner_index] * 2.0 * curvature_term**2
            )
    indications = np.sum(operating_point.products * operating_point.effective, axis=1)
    offset = indications - columns @ values
    # Derivatives by inputs are computed at their stated values, not at the estimate.
    stated_symbols = [
        s for i, s in symbols.items() if s in machine_terms and not unknowns[i].has_default_prior
    ]
    steps = {**INPUT_STEPS, **dict.fromkeys(group.clocks, _RATE_STEP)}
    for index, name in enumerate(unknown.name for unknown in unknowns):
        if name in steps:
            step = steps[name]
            upper, lower = (perturb_input(group, name, s, stated_symbols) for s in (step, -step))
            products = upper.products(machine_terms), lower.products(machine_terms)
            columns[:, index] = operating_point.slope(*products, step)
        if name == "site.gravity":
            columns[:, index] += group.in_si * indications / group.site.gravity
    linear = LinearReadings.from_columns(
        group,
        model,
        columns,
        group.value - offset - shift,
        group.u,
        group.repeats,
        np.sqrt(extra_variance),
    )
    return replace(linear, rate_sd=rate_noise, u_rate=group.u_rate, default_rate=group.default_rate)


#: Index of an unknown of the accelerometer -> index of its product, and its factor, shape (n,).
_DesignFactors = dict[int, tuple[int, Array]]


def _design_factors(
    group: Readings, symbols: Mapping[int, str]
) -> Iterator[tuple[int, tuple[int, Array]]]:
    """Yield the index of each coefficient or slope, and its entry of `_DesignFactors`."""
    for index, symbol in symbols.items():
        if symbol in ACCELEROMETER_TERMS:
            yield index, (_SYMBOLS.index(coefficient_of(symbol)), group.design_factor(symbol))


@frozen
class _OperatingPoint:
    """A group of readings at the point of linearisation."""

    group: Readings
    stations: Stations  #: Stations with the effects of the machine terms.
    products: Array  #: Mean product of each term, shape (n, number of `TERMS`).
    effective: Array  #: Coefficients under the conditions of each reading, of the same shape.

    @classmethod
    def at(
        cls, group: Readings, stations: Stations, values: Array, design_factors: _DesignFactors
    ) -> _OperatingPoint:
        effective = np.tile([row.nominal for row in TERMS.values()], (group.size, 1))
        for index, (term_index, factor) in design_factors.items():
            effective[:, term_index] += values[index] * factor
        return cls(group, stations, mean_products(stations, group.site), effective)

    def perturb_both(
        self, rows: npt.NDArray[np.intp], symbol: str, step: float
    ) -> tuple[Array, Array]:
        """Return the products of some readings after a positive and a negative step of a term."""
        stations, group = self.stations.take(rows), self.group
        upper_products, lower_products = (
            mean_products(
                stations.perturb(
                    symbol, np.full(rows.size, change), group.head[rows], group.head_angles[rows]
                ),
                group.site,
            )
            for change in (step, -step)
        )
        return upper_products, lower_products

    def slope(
        self, upper_products: Array, lower_products: Array, step: float, rows: Any = slice(None)
    ) -> Array:
        """Return the derivative of the indications from products after both steps."""
        derivative: Array = np.sum(
            (upper_products - lower_products) * self.effective[rows], axis=1
        ) / (2.0 * step)
        return derivative

    def half_curvature(
        self, upper_products: Array, lower_products: Array, step: float, rows: Any
    ) -> Array:
        """Return half the second derivative of the indications."""
        doubled_products = 2.0 * self.products[rows]
        return self.slope(upper_products + lower_products, doubled_products, step, rows) / step

    def rate_uncertainty(self, symbol: str, relative_u: Array | float) -> Array:
        """Return the standard uncertainty due to random errors of rates or amplitudes, g, (n,).

        symbol: Symbol of the rate or amplitude error.
        relative_u: Relative standard uncertainties of the rates or amplitudes, shape (n,).
        """
        group = self.group
        relative_u = np.broadcast_to(relative_u, group.size)
        rows = np.flatnonzero(relative_u)
        uncertainty = np.zeros(group.size)
        if rows.size:
            upper_products, lower_products = self.perturb_both(rows, symbol, _RATE_STEP)
            uncertainty[rows] = (
                np.abs(self.slope(upper_products, lower_products, _RATE_STEP, rows))
                * relative_u[rows]
            )
        return uncertainty

    def head_variance(self) -> Array:
        """Return the variance due to random errors of the head angle, g^2, shape (n,)."""
        group = self.group
        if not group.u_head.any():
            return np.zeros(group.size)
        angle_step = np.full(group.size, _HEAD_STEP)
        station_sets = (
            group.rotate_head(self.stations, angle) for angle in (angle_step, -angle_step)
        )
        upper_products, lower_products = (
            mean_products(stations, group.site) for stations in station_sets
        )
        return np.square(self.slope(upper_products, lower_products, _HEAD_STEP) * group.u_head)


def perturb_input(
    group: Readings, name: str, change: float, stated_symbols: Collection[str]
) -> Readings:
    """Return readings with a changed input.

    name: Name of the input, for a clock including the recorder.
    stated_symbols: Radii of mountings that replace the radius of the centrifuge.
    """
    if name == "site.gravity":
        return replace(group, site=replace(group.site, gravity=group.site.gravity + change))
    if name == "site.latitude":
        return replace(group, site=replace(group.site, latitude=group.site.latitude + change))
    if name in group.clocks:
        is_timed = np.array([clock == name for clock in group.clocks])
        return group.with_rate_errors(change * is_timed)
    if name != "centrifuge.radius":
        return group
    has_own_radius = np.zeros(group.size)
    for symbol in stated_symbols:
        has_own_radius += group.affected_mask(symbol) if symbol.startswith(f"{name}.") else 0.0
    radius = group.stations.radius + np.where(has_own_radius, 0.0, change)
    return replace(group, stations=replace(group.stations, radius=radius))

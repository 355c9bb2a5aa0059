"""Readings of one accelerometer at known attitudes: at rest, on an arm or on a turntable.

A reading is linear in the coefficients and nearly so in the terms of the machine.
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

#: Step of a machine term's derivative, of its largest credible size: large, for little rounding.
_STEP: Final = 1e-2

#: Uncertain inputs that act on readings, and the step of each derivative: m, m/s^2, rad.
INPUT_STEPS: Final = {"centrifuge.radius": 1e-4, "site.gravity": 1e-3, "site.latitude": 1e-3}

#: Error of all amplitudes of a vibration, and the random one of each, relative.
AMPLITUDE: Final = "vibration.amplitude"

#: Step of the derivatives by clocks and by the random errors of settings, relative.
_RATE_STEP: Final = 1e-4

#: Step of the derivative by the dividing head's angle, rad.
_HEAD_STEP: Final = 1e-5

_SYMBOLS: Final = tuple(TERMS)


@frozen
class Readings:
    """Readings of one accelerometer in one motion, n of them, with noise of one kind."""

    #: Its name, and the motion of every station.
    accelerometer: str
    motion: str
    names: tuple[str, ...]  #: Of the readings.
    site: Site  #: Where they were taken.
    stations: Stations  #: Axes and machine of each.
    mountings: tuple[str, ...]  #: Name of each reading's mounting; empty where it has none.
    #: Axis about which the dividing head turned, in the station's frame, shape (n, 3); zero without
    #: one.
    head: Array
    #: Random standard uncertainty of the head's angle at each position, rad, shape (n,).
    u_head: Array
    #: Indication in g by the nominal sensitivity, and its standard uncertainty, shape (n,); None:
    #: one for all, estimated from the residuals.
    value: Array
    u: Array | None
    #: Conditions relative to the reference, as in `relative_conditions`, each of shape (n,).
    conditions: Mapping[str, Array]
    #: How many repeats at one setting each value is the mean of, and the sum of their squares about
    #: it, g^2, shape (n,). Where `u` is None.
    repeats: Array
    scatter: Array
    #: One of the last digit that any of them has, g; 0 where it is not known.
    resolution: float = 0.0
    #: Name of the position of each whose setting error is an unknown; empty where none is.
    position: tuple[str, ...] = ()
    #: 1 where a value was written in m/s^2 and became g by the gravity assumed, else 0.
    in_si: Array | float = 0.0
    #: What the dividing head shows, rad, shape (n,).
    head_angle: Array | float = 0.0
    #: 1 where the description states the sense of the rotation, 0 where an angle shows it, (n,).
    stated_sense: Array | float = 1.0
    #: Rates that the description states, rad/s, shape (n,); None: those of the stations.
    stated_rates: tuple[float, ...] | None = None
    #: Random standard uncertainty of each rate, relative, and 1 where it is the default one, else
    #: 0, shape (n,).
    u_rate: Array | float = 0.0
    default_rate: Array | float = 0.0
    #: Random standard uncertainty of each amplitude of vibration, relative, shape (n,).
    u_amplitude: Array | float = 0.0
    #: Name of the input that is the error of the clock of each rate; empty where nothing turns.
    clocks: tuple[str, ...] = ()

    def products(self, machine: Mapping[str, float]) -> Array:
        """Return every term's mean product at each reading, shape (n, number of `TERMS`).

        machine: The machine's terms that move stations, less nominal, by symbol.
        """
        return mean_products(self.stations_with(machine), self.site)

    def stations_with(self, machine: Mapping[str, float]) -> Stations:
        """Return where the readings were taken, with the machine's terms as given."""
        stations = self.stations
        for symbol, size in machine.items():
            if size != 0.0:
                stations = self.perturb(stations, symbol, size)
        return stations

    def perturb(self, stations: Stations, symbol: str, size: float) -> Stations:
        """Return the readings' stations, moved already, with one more of the machine's terms."""
        steps = size * self.acts_mask(symbol)
        return (
            stations.perturb(symbol, steps, self.head, self.head_angles)
            if steps.any()
            else stations
        )

    @cached_property
    def head_angles(self) -> Array:
        """Indicated angle of the head at each reading, rad, shape (n,)."""
        return np.broadcast_to(self.head_angle, self.size)

    def rotate_head(self, stations: Stations, angles: Array) -> Stations:
        """Return stations with the head's angle off by so much at each, rad, shape (n,)."""
        return stations.perturb("head.zero", angles, self.head, self.head_angles)

    def with_setting_errors(self, errors: Array) -> Readings:
        """Return readings at rates or amplitudes larger by relative errors, shape (n,)."""
        rate, amplitude = (
            setting * (1.0 + errors) for setting in (self.stations.rate, self.stations.amplitude)
        )
        return replace(self, stations=replace(self.stations, rate=rate, amplitude=amplitude))

    @property
    def noise_floor(self) -> float:
        """The least noise that one repeat can be said to have, g: rounding to the last digit.

        Its standard deviation: GUM F.2.2.1. Where more digits were written than any readout has,
        `FINEST` of the largest one. Repeats whose scatter is below the digit are rounded alike.
        """
        largest = float(np.max(np.abs(self.value), initial=1e-3))
        floor = max(self.resolution / math.sqrt(12.0), MIN_RELATIVE_NOISE * largest)
        repeat_dof = float(np.sum(self.repeats - 1.0))
        is_below_resolution = float(self.scatter.sum()) < repeat_dof * (self.resolution / 2.0) ** 2
        return floor * math.sqrt(float(self.repeats.max())) if is_below_resolution else floor

    @property
    def replicates(self) -> tuple[tuple[int, ...], ...]:
        """Places of the readings of each position that was read more than once."""
        groups: dict[tuple[object, ...], list[int]] = {}
        angles = self.head_angles
        # Where an axis points is known to rounding only.
        axes = np.column_stack(
            [self.stations.axes.reshape(self.size, 9), np.cos(angles), np.sin(angles)]
        )
        # A repeat is set to the same rate and turns at nearly the same.
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
        """Degrees of freedom that repeats at one setting have among themselves."""
        return float(np.sum(self.repeats - 1.0))

    def linearize(
        self, model: Unknowns, estimate: Array, variance: Array | None = None
    ) -> LinearReadings:
        """Return their rows at an estimate; parameters as in `linearise`."""
        return linearize(self, model, estimate, variance)

    @property
    def triad(self) -> tuple[str, ...]:
        """No triad: attitudes are known."""
        return ()

    def start(self, unknowns: Sequence[Unknown], point: Array) -> Array:  # noqa: ARG002
        """Return the point that is given: readings need no other."""
        return point

    def without_setting_errors(self) -> Readings:
        """Return the readings without errors of setting their positions."""
        return replace(self, position=())

    def with_noise(self, noise: float) -> Readings:
        """Return the readings with a stated noise of one repeat, g."""
        return replace(self, u=noise / np.sqrt(self.repeats))

    def with_rotated_mounting(self, name: str, rotate: Callable[[Mounting], Mounting]) -> Readings:
        """Return the readings with an accelerometer mounted otherwise."""
        if self.accelerometer != name:
            return self
        mountings = (Mounting(tuple(map(tuple, axes))) for axes in self.stations.axes.tolist())
        axes = np.array([rotate(mounting).axes for mounting in mountings])
        return replace(self, stations=replace(self.stations, axes=axes))

    def default_candidates(self, model: Unknowns) -> Sequence[Unknown]:  # noqa: ARG002
        """Return no parameter: attitudes are known."""
        return ()

    def undetermined(
        self,
        fit: JointFit,  # noqa: ARG002
        model: Unknowns,  # noqa: ARG002
        candidates: Sequence[Unknown],  # noqa: ARG002
    ) -> Sequence[Unknown]:
        """Return no parameter: attitudes are known."""
        return ()

    def curvature(self, model: Unknowns, estimate: Array, moves: Array) -> Array:  # noqa: ARG002
        """Return zeros: a reading is nearly linear in its unknowns."""
        return np.zeros((self.size, moves.shape[1]))

    def lack_of_noise(
        self,
        freedom: float,
        free: int,  # noqa: ARG002
        solution: Solution,  # noqa: ARG002
        model: Unknowns,  # noqa: ARG002
    ) -> str:
        """Return the error that the residuals do not determine their noise; empty: they do."""
        if freedom >= 0.5:
            return ""
        return (
            f"{self.accelerometer}: {self.size} readings ({self.motion}) without a stated "
            "uncertainty cannot determine both the unknowns and the noise; state the "
            "uncertainty, or take more readings than there are unknowns"
        )

    def divergence(self, rounds: int) -> str:  # noqa: ARG002
        """Return no cause: the fit names the reading that is furthest off."""
        return ""

    def acts_mask(self, symbol: str) -> Array:
        """Return 1 for each reading on which a term of the machine acts, else 0, shape (n,)."""
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
    """Return the columns at an estimate; considered terms that it lacks are as assumed.

    variance: What is left open of each unknown, as far as it is known; else its prior's.
    """
    unknowns = [*model.unknowns, *model.considered]
    variances = np.array([term.prior[1] ** 2 for term in unknowns])
    if variance is not None:
        variances[: variance.size] = variance
    at = np.append(estimate, [term.prior_mean for term in unknowns[len(estimate) :]])
    symbols = {
        index: unknown.symbol
        for index, unknown in enumerate(unknowns)
        if unknown.owner in ("", group.accelerometer)
    }
    machine = {
        symbol: float(at[index])
        for index, symbol in symbols.items()
        if not unknowns[index].owner and group.acts_mask(symbol).any()
    }
    factors = dict(_design_factors(group, symbols))
    point = _OperatingPoint.at(group, group.stations_with(machine), at, factors)
    columns = np.zeros((group.size, len(unknowns)))
    for index, (term_index, factor) in factors.items():
        columns[:, index] = point.products[:, term_index] * factor
    rows: dict[str, list[int]] = {}
    for index, symbol in symbols.items():
        if symbol in machine:
            rows.setdefault(term(symbol).symbol, []).append(index)
    rate_u = point.setting_uncertainty(RATE, group.u_rate)
    shift, unseen = np.zeros(group.size), point.head_variance() + rate_u**2
    unseen += point.setting_uncertainty(AMPLITUDE, group.u_amplitude) ** 2
    for row, indices in rows.items():
        # Each of the mountings, or positions, of a row has readings of its own.
        owner_index = np.full(group.size, -1)
        for index in indices:
            owner_index[group.acts_mask(symbols[index]) > 0.0] = index
        affected = np.flatnonzero(owner_index >= 0)
        owner_index, step = owner_index[affected], _STEP * unknowns[indices[0]].limit
        ahead_products, behind_products = point.perturb_both(affected, symbols[indices[0]], step)
        columns[affected, owner_index] = point.slope(
            ahead_products, behind_products, step, affected
        )
        if TABLE[row].scope == "position":
            # A cosine falls whichever way a position is off: a square has a mean and a
            # variance. It is common to all readings there, whose mean is to have it whole.
            curvature_term = (
                point.half_curvature(ahead_products, behind_products, step, affected)
                * variances[owner_index]
            )
            shift[affected] += curvature_term
            unseen[affected] += np.bincount(owner_index)[owner_index] * 2.0 * curvature_term**2
    indications = np.sum(point.products * point.effective, axis=1)
    offset = indications - columns @ at
    # Derivatives by inputs are taken at what is stated of them, and not at the estimate.
    replaced = [s for i, s in symbols.items() if s in machine and not unknowns[i].has_default_prior]
    steps = {**INPUT_STEPS, **dict.fromkeys(group.clocks, _RATE_STEP)}
    for index, name in enumerate(unknown.name for unknown in unknowns):
        if name in steps:
            step = steps[name]
            ahead, behind = (with_input(group, name, s, replaced) for s in (step, -step))
            sides = ahead.products(machine), behind.products(machine)
            columns[:, index] = point.slope(*sides, step)
        if name == "site.gravity":
            columns[:, index] += group.in_si * indications / group.site.gravity
    linear = LinearReadings.from_columns(
        group,
        model,
        columns,
        group.value - offset - shift,
        group.u,
        group.repeats,
        np.sqrt(unseen),
    )
    return replace(linear, rate=rate_u, u_rate=group.u_rate, default_rate=group.default_rate)


#: Of an unknown of the accelerometer: the place of its product, and what that is times, (n,).
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
    """A group of readings at the point where derivatives are taken."""

    group: Readings
    stations: Stations  #: As the machine has moved them.
    products: Array  #: Of every term, shape (n, number of `TERMS`).
    effective: Array  #: The coefficients under each reading's conditions, of the same shape.

    @classmethod
    def at(
        cls, group: Readings, stations: Stations, values: Array, levers: _DesignFactors
    ) -> _OperatingPoint:
        effective = np.tile([row.nominal for row in TERMS.values()], (group.size, 1))
        for index, (term_index, factor) in levers.items():
            effective[:, term_index] += values[index] * factor
        return cls(group, stations, mean_products(stations, group.site), effective)

    def perturb_both(
        self, rows: npt.NDArray[np.intp], symbol: str, step: float
    ) -> tuple[Array, Array]:
        """Return the products where some readings are moved by a step of a term, and back."""
        stations, group = self.stations.take(rows), self.group
        ahead, behind = (
            mean_products(
                stations.perturb(
                    symbol, np.full(rows.size, change), group.head[rows], group.head_angles[rows]
                ),
                group.site,
            )
            for change in (step, -step)
        )
        return ahead, behind

    def slope(self, ahead: Array, behind: Array, step: float, rows: Any = slice(None)) -> Array:
        """Return the derivative of the indications, of products a step ahead and behind."""
        derivative: Array = np.sum((ahead - behind) * self.effective[rows], axis=1) / (2.0 * step)
        return derivative

    def half_curvature(self, ahead: Array, behind: Array, step: float, rows: Any) -> Array:
        """Return half the second derivative of the indications."""
        return self.slope(ahead + behind, 2.0 * self.products[rows], step, rows) / step

    def setting_uncertainty(self, symbol: str, relative_u: Array | float) -> Array:
        """Return the standard uncertainty from random relative errors of settings, g, shape (n,).

        symbol: Of the setting.
        relative_u: Standard uncertainties of the settings, shape (n,).
        """
        group = self.group
        relative_u = np.broadcast_to(relative_u, group.size)
        rows = np.flatnonzero(relative_u)
        uncertainty = np.zeros(group.size)
        if rows.size:
            ahead, behind = self.perturb_both(rows, symbol, _RATE_STEP)
            uncertainty[rows] = (
                np.abs(self.slope(ahead, behind, _RATE_STEP, rows)) * relative_u[rows]
            )
        return uncertainty

    def head_variance(self) -> Array:
        """Return the variance from the random error of the head's angle, g^2, shape (n,)."""
        group = self.group
        if not group.u_head.any():
            return np.zeros(group.size)
        turn = np.full(group.size, _HEAD_STEP)
        station_sets = (group.rotate_head(self.stations, angle) for angle in (turn, -turn))
        ahead, behind = (mean_products(stations, group.site) for stations in station_sets)
        return np.square(self.slope(ahead, behind, _HEAD_STEP) * group.u_head)


def with_input(group: Readings, name: str, change: float, replaced: Collection[str]) -> Readings:
    """Return readings with an input changed.

    name: Of the input; of a clock with its recorder.
    replaced: Radii of mountings that are known in place of the centrifuge's.
    """
    if name == "site.gravity":
        return replace(group, site=replace(group.site, gravity=group.site.gravity + change))
    if name == "site.latitude":
        return replace(group, site=replace(group.site, latitude=group.site.latitude + change))
    if name in group.clocks:
        is_timed = np.array([clock == name for clock in group.clocks])
        return group.with_setting_errors(change * is_timed)
    if name != "centrifuge.radius":
        return group
    radius_owned = np.zeros(group.size)
    for symbol in replaced:
        radius_owned += group.acts_mask(symbol) if symbol.startswith(f"{name}.") else 0.0
    radius = group.stations.radius + np.where(radius_owned, 0.0, change)
    return replace(group, stations=replace(group.stations, radius=radius))

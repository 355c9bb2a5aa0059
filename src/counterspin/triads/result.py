"""Results for three accelerometers as one sensor: NIST's nine parameters, and the poses.

The parameters do not depend on how the triad stands in its frame: three offsets, three
sensitivities and the three angles between the axes along which the accelerometers feel (Geist,
Gaitan et al., Gravity-Based Characterization of Three-Axis Accelerometers in Terms of Intrinsic
Accelerometer Parameters, J. Res. NIST 122 (2017) 32).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import combinations
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.calibration.result_parts import (
    Coefficient,
    Correlation,
    PoseResult,
    PosesInRecord,
    TriadResult,
)
from counterspin.campaign.description import Campaign
from counterspin.frozen import frozen
from counterspin.inference.distributions import countable
from counterspin.inference.identifiability import PRIOR_LEFT
from counterspin.inference.joint.budget import budget_of, by_kind_of
from counterspin.inference.joint.estimation import Estimate
from counterspin.inference.joint.unknowns import Unknown
from counterspin.inference.least_squares import Combination
from counterspin.physics.terms import CONDITION_TERMS, LINEAR, TERMS
from counterspin.readings.fitted import FittedReadings
from counterspin.readings.joining import dof_of
from counterspin.triads.found_poses import FoundPose
from counterspin.triads.poses import PosesAt, TriadPoses, levers

#: Points of what is drawn of the search for rests.
_TRACE_POINTS: Final = 600

_SYMBOLS: Final = tuple(TERMS)

#: A parameter follows unknowns that are not determined if its slope by one is larger, and if the
#: data take away less than half of what their default priors contribute.
_FOLLOWS: Final = 0.5

#: An angle depends no more on where the axes point than by rounding.
_NOTHING: Final = 1e-12


@frozen
class _Parameter:
    """A parameter at an estimate, and how it follows the unknowns."""

    value: float
    slopes: Array  # by the unknowns, (p,)
    unit: str
    limit: float


def triad_result(
    campaign: Campaign,
    estimated: Estimate,
    parts: Sequence[FittedReadings],
    found_poses: Mapping[str, FoundPose],
) -> TriadResult:
    """Return the campaign's triad.

    parts: Readings and poses in the fit.
    found_poses: By name.
    """
    assert campaign.triad is not None
    names = campaign.triad.accelerometers
    places = {
        (unknown.owner, unknown.symbol): place
        for place, unknown in enumerate(estimated.fit.model.unknowns)
    }
    at = _Linear.at(campaign, estimated, places)
    parameters = dict(_parameters(campaign, at, estimated))
    found = {name: _coefficient(estimated, one, parts) for name, one in parameters.items()}
    determined = [name for name, c in found.items() if c.estimated]
    lacking = [name for name, c in found.items() if c.value is None]
    matrix = None if lacking else at.inverse()
    poses: list[PoseResult] = []
    before, after = [], []
    model = estimated.fit.model
    for part in parts:
        group = part.readings
        if not isinstance(group, TriadPoses):
            continue
        there = group.at(model, estimated.fit.solution.estimate)
        poses += _poses(group, part, there, found_poses)
        nominal = np.linalg.inv(group.axes[:, 0])
        before.append(np.linalg.norm(group.value @ nominal.T, axis=1) - 1.0)
        if matrix is not None:
            left = group.value - _second_order(campaign, there) - at.bias
            left -= _changes(group, there, model.asked)
            after.append(np.linalg.norm(left @ matrix.T, axis=1) - 1.0)
    gravity = campaign.gravity.value
    return TriadResult(
        accelerometers=list(names),
        parameters=found,
        correlation=_correlation(estimated, {n: parameters[n] for n in determined}),
        budget={n: budget_of(estimated.fit, parameters[n].slopes) for n in determined},
        by_gravity=_by_gravity(estimated, {n: parameters[n] for n in determined}),
        matrix=None if matrix is None else matrix.tolist(),
        u_matrix=None if matrix is None else _u_matrix(estimated, at, matrix),
        bias=None if matrix is None else at.bias.tolist(),
        why_no_matrix=f"The poses do not determine {', '.join(lacking)}." if lacking else None,
        rms_before=_rms(before, gravity),
        rms_after=_rms(after, gravity),
        poses=poses,
        records=_records(found_poses.values()),
    )


@frozen(eq=False)
class _Linear:
    """Biases of a triad, and the vectors along which its accelerometers feel."""

    names: Sequence[str]
    places: Mapping[tuple[str, str], int]  # of the unknowns, p of them
    count: int  # p
    bias: Array  # (3,), g
    rows: Array  # (3, 3), in the triad's frame
    axes: Array  # (3, 3, 3), I, P and O of each

    @classmethod
    def at(
        cls, campaign: Campaign, estimated: Estimate, places: Mapping[tuple[str, str], int]
    ) -> _Linear:
        assert campaign.triad is not None
        names, estimate = campaign.triad.accelerometers, estimated.fit.solution.estimate

        def value(name: str, symbol: str) -> float:
            place = places.get((name, symbol))
            known = campaign.accelerometers[name].priors.get(symbol)
            if place is not None:
                return TERMS[symbol].nominal + float(estimate[place])
            return TERMS[symbol].nominal if known is None else known.value

        axes = np.array([campaign.accelerometers[name].mounting.matrix for name in names])
        rows = [
            sum(
                (sign * value(name, symbol) * own[axis] for symbol, (axis, sign) in LINEAR.items()),
                np.zeros(3),
            )
            for name, own in zip(names, axes, strict=True)
        ]
        return cls(
            names,
            places,
            len(estimated.fit.model.unknowns),
            np.array([value(name, "K_F") for name in names]),
            np.array(rows),
            axes,
        )

    def inverse(self) -> Array:
        """Return the matrix that takes indications less biases to the triad's frame, (3, 3)."""
        found: Array = np.linalg.inv(self.rows).astype(np.float64) + 0.0  # which leaves no -0.0
        return found

    def slopes(self, name: str, by_symbol: Mapping[str, float]) -> Array:
        """Return slopes by the unknowns, (p,), of what has slopes by an accelerometer's terms."""
        found = np.zeros(self.count)
        for symbol, slope in by_symbol.items():
            if (name, symbol) in self.places:
                found[self.places[name, symbol]] = slope
        return found

    def by_row(self, place: int, slope: Array) -> Array:
        """Return slopes by the unknowns of what has a slope by an accelerometer's vector."""
        own = self.axes[place]
        return self.slopes(
            self.names[place],
            {symbol: sign * float(slope @ own[axis]) for symbol, (axis, sign) in LINEAR.items()},
        )


def _parameters(
    campaign: Campaign, at: _Linear, estimated: Estimate
) -> Iterator[tuple[str, _Parameter]]:
    """Yield the nine parameters, and the terms of second order that were asked for."""
    names, places = at.names, at.places
    for place, name in enumerate(names):
        limit = campaign.limit_of("K_F", name)
        own = at.slopes(name, {"K_F": 1.0})
        yield f"offset.{name}", _Parameter(float(at.bias[place]), own, "g", limit)
    sizes = np.linalg.norm(at.rows, axis=1)
    units = at.rows / sizes[:, None]
    for place, name in enumerate(names):
        limit = campaign.limit_of("K_I", name)
        own = at.by_row(place, units[place])
        own = own + _second_order_slopes(at, name, float(sizes[place]), estimated.fit.model.asked)
        yield f"sensitivity.{name}", _Parameter(float(sizes[place]), own, "g/g", limit)
    for one, other in combinations(range(len(names)), 2):
        a, b = units[one], units[other]
        cosine = float(a @ b)
        angle = math.acos(max(-1.0, min(1.0, cosine)))
        sine = math.sin(angle)
        found = at.by_row(one, -(b - cosine * a) / (sine * sizes[one]))
        found = found + at.by_row(other, -(a - cosine * b) / (sine * sizes[other]))
        limit = max(campaign.limit_of("delta_O", names[k]) for k in (one, other))
        yield f"angle.{names[one]}.{names[other]}", _Parameter(angle, found, "rad", limit)
    for name in names:
        for symbol in campaign.model.terms:
            if symbol in TERMS and symbol not in ("K_F", *LINEAR) and (name, symbol) in places:
                place = places[name, symbol]
                value = TERMS[symbol].nominal + float(estimated.fit.solution.estimate[place])
                limit = campaign.limit_of(symbol, name)
                own = at.slopes(name, {symbol: 1.0})
                yield f"{name}.{symbol}", _Parameter(value, own, TERMS[symbol].unit, limit)


def _second_order_slopes(
    at: _Linear, name: str, size: float, requested: Sequence[Unknown]
) -> Array:
    """Return slopes of a sensitivity, (p,), that stand for the squares of its misalignments.

    A misalignment d adds d^2/2 to the length of a vector. Of one that is not determined, this has
    the mean s^2/2 and the variance s^4/2 over its default prior s; the slope times s is the root
    mean square.
    """
    default = {u.symbol: u.default for u in requested if u.owner == name and u.defaulted}
    across = {symbol: s for symbol, s in default.items() if symbol.startswith("delta_")}
    share = math.sqrt(len(across) / 4.0 + 0.5)
    return at.slopes(name, {symbol: share * s / size for symbol, s in across.items()})


def _coefficient(
    estimated: Estimate, one: _Parameter, read: Sequence[FittedReadings]
) -> Coefficient:
    """Return a parameter as a result shows it; one that is not determined has no value."""
    fit = estimated.fit
    if np.max(np.abs(one.slopes), initial=0.0) < _NOTHING:
        return Coefficient(value=one.value, u=0.0, unit=one.unit, estimated=False)
    combined = fit.solution.combine(one.slopes)
    if not combined.u < one.limit or _follows_defaults(estimated, one, combined):
        return Coefficient(value=None, u=None, unit=one.unit, estimated=False)
    own = np.flatnonzero(np.abs(one.slopes) > _NOTHING)
    known = float(np.linalg.norm(one.slopes[own] * fit.solution.prior_sd[own]))
    if combined.u**2 > PRIOR_LEFT * known**2:
        # What is known beforehand is all there is.
        return Coefficient(value=one.value, u=combined.u, unit=one.unit, estimated=False)
    noise, stated, unstated = by_kind_of(fit, one.slopes)
    return Coefficient(
        value=one.value,
        u=math.hypot(noise, stated, unstated),
        u_noise=noise,
        u_stated=stated,
        u_unstated=unstated,
        dof=countable(_dof(estimated, one.slopes, read)),
        unit=one.unit,
        estimated=True,
    )


def _follows_defaults(estimated: Estimate, one: _Parameter, combined: Combination) -> bool:
    """Return whether a parameter is known only by default priors of undetermined unknowns."""
    fit = estimated.fit
    defaulted = [unknown.defaulted for unknown in fit.model.unknowns]
    slopes, contributed = one.slopes[defaulted], combined.prior[defaulted]
    before = np.linalg.norm(slopes * fit.solution.prior_sd[defaulted])
    large = np.max(np.abs(slopes), initial=0.0) > _FOLLOWS
    return bool(large and np.linalg.norm(contributed) > _FOLLOWS * before)


def _dof(estimated: Estimate, slopes: Array, read: Sequence[FittedReadings]) -> float:
    """Return the degrees of freedom of a parameter; of records' noise the least of its parts."""
    fit, of_records = estimated.fit, math.inf
    if fit.prepared:
        of_records = float(np.min(estimated.dof[np.abs(slopes) > _NOTHING]))
    dof = [part.noise_dof for part in read]
    return dof_of(slopes, fit, dof, of_records)


def _correlation(estimated: Estimate, parameters: Mapping[str, _Parameter]) -> Correlation | None:
    if not parameters:
        return None
    slopes = np.array([one.slopes for one in parameters.values()])
    covariance = slopes @ estimated.fit.solution.covariance @ slopes.T
    u = np.sqrt(np.diag(covariance))
    return Correlation(terms=list(parameters), matrix=(covariance / np.outer(u, u)).tolist())


def _by_gravity(estimated: Estimate, parameters: Mapping[str, _Parameter]) -> dict[str, float]:
    """Return the change of each parameter per m/s^2 of the assumed g; empty if g is exact."""
    model = estimated.fit.model
    for held, terms in ((False, model.unknowns), (True, model.considered)):
        for place, term in enumerate(terms):
            if term.symbol == "site.gravity" and term.prior[1] > 0.0:
                moved = {}
                for name, one in parameters.items():
                    parts = estimated.fit.solution.combine(one.slopes)
                    moved[name] = float((parts.considered if held else parts.prior)[place])
                return {name: by / term.prior[1] for name, by in moved.items()}
    return {}


def _u_matrix(estimated: Estimate, at: _Linear, matrix: Array) -> list[list[float]]:
    """Return the standard uncertainties of the matrix: it moves by -M dR M with the rows R."""
    found = np.zeros((3, 3))
    for row, column in np.ndindex(3, 3):
        slopes = sum(
            (at.by_row(k, -matrix[row, k] * matrix[:, column]) for k in range(3)),
            np.zeros(at.count),
        )
        found[row, column] = estimated.fit.solution.combine(slopes).u
    return found.tolist()


def _poses(
    group: TriadPoses, part: FittedReadings, there: PosesAt, where: Mapping[str, FoundPose]
) -> Iterator[PoseResult]:
    """Yield the poses as a result shows them, and where they were found."""
    for k, name in enumerate(group.names):
        found, z = where[name], part.single[k].standardised
        start = end = samples = None
        if found.record is not None:
            poses, place = found.record.poses, found.place
            start, end = float(poses.start[place]), float(poses.end[place])
            samples = int(poses.count[place])
        growth = float(there.growth[k])
        yield PoseResult(
            name=name,
            start=start,
            end=end,
            samples=samples,
            values=tuple(group.value[k].tolist()),
            direction=tuple(there.direction[k].tolist()),
            residual=float(part.residuals[k]) / growth,
            u=float(part.sigma[k]) / growth,
            z=None if math.isnan(z) else z,
        )


def _second_order(campaign: Campaign, there: PosesAt) -> Array:
    """Return the effect of the requested nonlinear terms on the indications, shape (n, 3)."""
    symbols = [s for s in campaign.model.terms if s in TERMS and s not in ("K_F", *LINEAR)]
    places = [_SYMBOLS.index(symbol) for symbol in symbols]
    added: Array = np.sum(there.products[:, :, places] * there.effective[:, :, places], axis=2)
    return added


def _changes(poses: TriadPoses, there: PosesAt, asked: Sequence[Unknown]) -> Array:
    """Return the effect of the requested slopes on the indications, shape (n, 3)."""
    added, own = np.zeros_like(poses.value), set(asked)
    for index, place, term, lever in levers(poses, there.everything):
        unknown = there.everything[index]
        if unknown.symbol in CONDITION_TERMS and unknown in own:
            added[:, place] += there.products[:, place, term] * lever * there.values[index]
    return added


def _rms(parts: Sequence[Array], gravity: float) -> float | None:
    """Return the root mean square of |f| - g, m/s^2."""
    if not parts:
        return None
    return gravity * float(np.sqrt(np.mean(np.concatenate(parts) ** 2)))


def _records(poses: Iterable[FoundPose]) -> dict[str, PosesInRecord]:
    """Return the results of the records with poses."""
    records = {one.record.name: one.record.poses for one in poses if one.record is not None}
    traces = {name: found.trace(_TRACE_POINTS) for name, found in records.items()}
    return {
        name: PosesInRecord(
            poses=len(found.start),
            threshold=found.threshold,
            contrast=found.contrast if math.isfinite(found.contrast) else None,
            notes=[*found.left_out, *found.doubts],
            time=traces[name][0].round(6).tolist(),
            level=[float(f"{level:.4g}") for level in traces[name][1]],
        )
        for name, found in records.items()
    }

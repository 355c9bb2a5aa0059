"""Results for three accelerometers as one sensor: the nine intrinsic parameters, and the poses.

The parameters do not depend on the orientation of the triad in its frame: three offsets, three
sensitivities and the three angles between the sensitive axes (Geist, Gaitan et al., Gravity-Based
Characterization of Three-Axis Accelerometers in Terms of Intrinsic Accelerometer Parameters,
J. Res. NIST 122 (2017) 32).
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
from counterspin.inference.distributions import finite_dof
from counterspin.inference.identifiability import MAX_VARIANCE_RATIO
from counterspin.inference.joint.budget import combination_budget, u_by_category
from counterspin.inference.joint.estimation import Estimate
from counterspin.inference.joint.unknowns import Unknown
from counterspin.inference.least_squares import Combination
from counterspin.physics.terms import SENSITIVITY_TERMS, TERMS, condition_of
from counterspin.readings.fitted import FittedReadings
from counterspin.readings.joint_data import combination_dof
from counterspin.triads.poses import SolvedPoses, TriadPoses, design_factors
from counterspin.triads.record_poses import LocatedPose

#: Points of the trace of the level that a result stores for its figure.
_TRACE_POINTS: Final = 600

_SYMBOLS: Final = tuple(TERMS)

#: A parameter depends on undetermined unknowns if its slope by one of them is larger than this,
#: and if their default priors still contribute more than this fraction after the fit.
_DEFAULT_FRACTION: Final = 0.5

#: Smaller slopes are rounding errors.
_NEGLIGIBLE_SLOPE: Final = 1e-12


@frozen
class _DerivedParameter:
    """Value of a parameter at an estimate, and its derivatives by the unknowns."""

    value: float
    slopes: Array  # by the unknowns, (p,)
    unit: str
    limit: float


def triad_result(
    campaign: Campaign,
    estimate: Estimate,
    fitted_groups: Sequence[FittedReadings],
    poses_by_name: Mapping[str, LocatedPose],
) -> TriadResult:
    """Return the result for the triad of a campaign.

    fitted_groups: Readings and poses in the fit.
    """
    assert campaign.triad is not None
    names = campaign.triad.accelerometers
    indices = {
        (unknown.owner, unknown.symbol): index
        for index, unknown in enumerate(estimate.fit.model.unknowns)
    }
    linear_model = _LinearModel.at(campaign, estimate, indices)
    parameters = dict(_derive_parameters(campaign, linear_model, estimate))
    coefficients = {
        name: _make_coefficient(estimate, parameter, fitted_groups)
        for name, parameter in parameters.items()
    }
    determined_names = [name for name, coefficient in coefficients.items() if coefficient.estimated]
    undetermined_names = [
        name for name, parameter in coefficients.items() if parameter.value is None
    ]
    matrix = None if undetermined_names else linear_model.inverse()
    poses: list[PoseResult] = []
    norms_before, norms_after = [], []
    model = estimate.fit.model
    for fitted_group in fitted_groups:
        group = fitted_group.readings
        if not isinstance(group, TriadPoses):
            continue
        solved_poses = group.at(model, estimate.fit.solution.estimate)
        poses += _pose_results(group, fitted_group, solved_poses, poses_by_name)
        nominal_inverse = np.linalg.inv(group.axes[:, 0])
        norms_before.append(np.linalg.norm(group.value @ nominal_inverse.T, axis=1) - 1.0)
        if matrix is not None:
            corrected_values = (
                group.value - _nonlinear_effects(campaign, solved_poses) - linear_model.bias
            )
            corrected_values -= _slope_effects(group, solved_poses, model.of_interest)
            norms_after.append(np.linalg.norm(corrected_values @ matrix.T, axis=1) - 1.0)
    gravity = campaign.gravity.value
    return TriadResult(
        accelerometers=list(names),
        parameters=coefficients,
        correlation=_correlation(estimate, {n: parameters[n] for n in determined_names}),
        budget={
            n: combination_budget(estimate.fit, parameters[n].slopes) for n in determined_names
        },
        by_gravity=_gravity_sensitivities(estimate, {n: parameters[n] for n in determined_names}),
        matrix=None if matrix is None else matrix.tolist(),
        u_matrix=None if matrix is None else _u_matrix(estimate, linear_model, matrix),
        bias=None if matrix is None else linear_model.bias.tolist(),
        why_no_matrix=f"The poses do not determine {', '.join(undetermined_names)}."
        if undetermined_names
        else None,
        rms_before=_rms(norms_before, gravity),
        rms_after=_rms(norms_after, gravity),
        poses=poses,
        records=_record_results(poses_by_name.values()),
    )


@frozen(eq=False)
class _LinearModel:
    """Biases and sensitivity vectors of a triad at an estimate."""

    names: Sequence[str]
    indices: Mapping[tuple[str, str], int]  # of the unknowns, p of them
    count: int  # p
    bias: Array  # (3,), g
    rows: Array  # (3, 3), in the triad's frame
    axes: Array  # (3, 3, 3), I, P and O of each

    @classmethod
    def at(
        cls, campaign: Campaign, estimated: Estimate, indices: Mapping[tuple[str, str], int]
    ) -> _LinearModel:
        assert campaign.triad is not None
        names, estimate = campaign.triad.accelerometers, estimated.fit.solution.estimate

        def value(name: str, symbol: str) -> float:
            index = indices.get((name, symbol))
            prior = campaign.accelerometers[name].priors.get(symbol)
            if index is not None:
                return TERMS[symbol].nominal + float(estimate[index])
            return TERMS[symbol].nominal if prior is None else prior.value

        axes = np.array([campaign.accelerometers[name].mounting.matrix for name in names])
        rows = [
            sum(
                (
                    sign * value(name, symbol) * matrix[axis]
                    for symbol, (axis, sign) in SENSITIVITY_TERMS.items()
                ),
                np.zeros(3),
            )
            for name, matrix in zip(names, axes, strict=True)
        ]
        return cls(
            names,
            indices,
            len(estimated.fit.model.unknowns),
            np.array([value(name, "K_F") for name in names]),
            np.array(rows),
            axes,
        )

    def inverse(self) -> Array:
        """Return the matrix from indications minus biases to the frame of the triad, (3, 3)."""
        inverse: Array = np.linalg.inv(self.rows).astype(np.float64) + 0.0  # turns -0.0 into 0.0
        return inverse

    def slopes(self, name: str, slopes_by_symbol: Mapping[str, float]) -> Array:
        """Return slopes by the unknowns, (p,), given the slopes by terms of an accelerometer."""
        derivatives = np.zeros(self.count)
        for symbol, slope in slopes_by_symbol.items():
            if (name, symbol) in self.indices:
                derivatives[self.indices[name, symbol]] = slope
        return derivatives

    def row_slopes(self, index: int, slope: Array) -> Array:
        """Return slopes by the unknowns, (p,), given the slope by a sensitivity vector, (3,)."""
        axes_rows = self.axes[index]
        return self.slopes(
            self.names[index],
            {
                symbol: sign * float(slope @ axes_rows[axis])
                for symbol, (axis, sign) in SENSITIVITY_TERMS.items()
            },
        )


def _derive_parameters(
    campaign: Campaign, linear_model: _LinearModel, estimate: Estimate
) -> Iterator[tuple[str, _DerivedParameter]]:
    """Yield the nine intrinsic parameters, followed by the requested higher-order terms."""
    names, indices = linear_model.names, linear_model.indices
    for index, name in enumerate(names):
        limit = campaign.limit_of("K_F", name)
        slopes, value = linear_model.slopes(name, {"K_F": 1.0}), float(linear_model.bias[index])
        yield f"offset.{name}", _DerivedParameter(value, slopes, "g", limit)
    norms = np.linalg.norm(linear_model.rows, axis=1)
    unit_vectors = linear_model.rows / norms[:, None]
    for index, name in enumerate(names):
        limit = campaign.limit_of("K_I", name)
        slopes = linear_model.row_slopes(index, unit_vectors[index])
        slopes = slopes + _misalignment_slopes(
            linear_model, name, float(norms[index]), estimate.fit.model.of_interest
        )
        yield f"sensitivity.{name}", _DerivedParameter(float(norms[index]), slopes, "g/g", limit)
    for first, second in combinations(range(len(names)), 2):
        first_unit, second_unit = unit_vectors[first], unit_vectors[second]
        cosine = float(first_unit @ second_unit)
        angle = math.acos(max(-1.0, min(1.0, cosine)))
        sine = math.sin(angle)
        angle_slopes = linear_model.row_slopes(
            first, -(second_unit - cosine * first_unit) / (sine * norms[first])
        )
        angle_slopes = angle_slopes + linear_model.row_slopes(
            second, -(first_unit - cosine * second_unit) / (sine * norms[second])
        )
        limit = max(campaign.limit_of("delta_O", names[k]) for k in (first, second))
        yield (
            f"angle.{names[first]}.{names[second]}",
            _DerivedParameter(angle, angle_slopes, "rad", limit),
        )
    for name in names:
        for symbol in campaign.model.terms:
            if (
                symbol in TERMS
                and symbol not in ("K_F", *SENSITIVITY_TERMS)
                and (name, symbol) in indices
            ):
                index = indices[name, symbol]
                value = TERMS[symbol].nominal + float(estimate.fit.solution.estimate[index])
                limit = campaign.limit_of(symbol, name)
                slopes, unit = linear_model.slopes(name, {symbol: 1.0}), TERMS[symbol].unit
                yield f"{name}.{symbol}", _DerivedParameter(value, slopes, unit, limit)


def _misalignment_slopes(
    linear_model: _LinearModel, name: str, sensitivity: float, requested: Sequence[Unknown]
) -> Array:
    """Return slopes of a sensitivity, (p,), for the squares of undetermined misalignments.

    A misalignment d adds d^2/2 to the length of the sensitivity vector. With a default prior of
    standard uncertainty s, this has the mean s^2/2 and the variance s^4/2. The slope times s is
    the root mean square.
    """
    sds = {
        unknown.symbol: unknown.default_sd
        for unknown in requested
        if unknown.owner == name
        and unknown.uses_fallback_prior
        and unknown.symbol.startswith("delta_")
    }
    rms_factor = math.sqrt(len(sds) / 4.0 + 0.5)
    return linear_model.slopes(name, {s: rms_factor * sd / sensitivity for s, sd in sds.items()})


def _make_coefficient(
    estimate: Estimate, parameter: _DerivedParameter, groups: Sequence[FittedReadings]
) -> Coefficient:
    """Return a parameter as a coefficient of the result, without a value if undetermined."""
    fit = estimate.fit
    if np.max(np.abs(parameter.slopes), initial=0.0) < _NEGLIGIBLE_SLOPE:
        return Coefficient(value=parameter.value, u=0.0, unit=parameter.unit, estimated=False)
    combination = fit.solution.combine(parameter.slopes)
    if not combination.u < parameter.limit or _is_default_only(estimate, parameter, combination):
        return Coefficient(value=None, u=None, unit=parameter.unit, estimated=False)
    indices = np.flatnonzero(np.abs(parameter.slopes) > _NEGLIGIBLE_SLOPE)
    prior_u = float(np.linalg.norm(parameter.slopes[indices] * fit.solution.prior_sd[indices]))
    if combination.u**2 > MAX_VARIANCE_RATIO * prior_u**2:
        # The fit adds no information to the prior.
        u, unit = combination.u, parameter.unit
        return Coefficient(value=parameter.value, u=u, unit=unit, estimated=False)
    u_noise, u_stated, u_unstated = u_by_category(fit, parameter.slopes)
    return Coefficient(
        value=parameter.value,
        u=math.hypot(u_noise, u_stated, u_unstated),
        u_noise=u_noise,
        u_stated=u_stated,
        u_unstated=u_unstated,
        dof=finite_dof(_parameter_dof(estimate, parameter.slopes, groups)),
        unit=parameter.unit,
        estimated=True,
    )


def _is_default_only(
    estimate: Estimate, parameter: _DerivedParameter, combination: Combination
) -> bool:
    """Return whether only default priors of undetermined unknowns determine a parameter."""
    fit = estimate.fit
    is_default = [unknown.uses_fallback_prior for unknown in fit.model.unknowns]
    slopes, contributions = parameter.slopes[is_default], combination.prior[is_default]
    prior_norm = np.linalg.norm(slopes * fit.solution.prior_sd[is_default])
    is_dependent = np.max(np.abs(slopes), initial=0.0) > _DEFAULT_FRACTION
    return bool(is_dependent and np.linalg.norm(contributions) > _DEFAULT_FRACTION * prior_norm)


def _parameter_dof(estimate: Estimate, slopes: Array, groups: Sequence[FittedReadings]) -> float:
    """Return the degrees of freedom of a parameter; records count with their smallest number."""
    fit, record_dof = estimate.fit, math.inf
    if fit.design_blocks:
        record_dof = float(np.min(estimate.dof[np.abs(slopes) > _NEGLIGIBLE_SLOPE]))
    dof = [group.noise_dof for group in groups]
    return combination_dof(slopes, fit, dof, record_dof)


def _correlation(
    estimate: Estimate, parameters: Mapping[str, _DerivedParameter]
) -> Correlation | None:
    if not parameters:
        return None
    slopes = np.array([parameter.slopes for parameter in parameters.values()])
    covariance = slopes @ estimate.fit.solution.covariance @ slopes.T
    u = np.sqrt(np.diag(covariance))
    return Correlation(terms=list(parameters), matrix=(covariance / np.outer(u, u)).tolist())


def _gravity_sensitivities(
    estimated: Estimate, parameters: Mapping[str, _DerivedParameter]
) -> dict[str, float]:
    """Return the change of each parameter per m/s^2 of the assumed g; empty if g is exact."""
    model = estimated.fit.model
    for is_considered, terms in ((False, model.unknowns), (True, model.considered)):
        for index, term in enumerate(terms):
            if term.symbol == "site.gravity" and term.prior[1] > 0.0:
                shifts = {}
                for name, parameter in parameters.items():
                    combination = estimated.fit.solution.combine(parameter.slopes)
                    shifts[name] = float(
                        (combination.considered if is_considered else combination.prior)[index]
                    )
                return {name: shift / term.prior[1] for name, shift in shifts.items()}
    return {}


def _u_matrix(estimate: Estimate, linear_model: _LinearModel, matrix: Array) -> list[list[float]]:
    """Return the standard uncertainties of the matrix M, from dM = -M dR M with the rows R."""
    u_values = np.zeros((3, 3))
    for row, column in np.ndindex(3, 3):
        slopes = sum(
            (
                linear_model.row_slopes(axis_index, -matrix[row, axis_index] * matrix[:, column])
                for axis_index in range(3)
            ),
            np.zeros(linear_model.count),
        )
        u_values[row, column] = estimate.fit.solution.combine(slopes).u
    return u_values.tolist()


def _pose_results(
    group: TriadPoses,
    fitted_group: FittedReadings,
    solved_poses: SolvedPoses,
    poses_by_name: Mapping[str, LocatedPose],
) -> Iterator[PoseResult]:
    """Yield the results of the poses in a group."""
    for k, name in enumerate(group.names):
        pose, z = poses_by_name[name], fitted_group.single_readings[k].standardized
        start = end = samples = None
        if pose.record is not None:
            poses, index = pose.record.poses, pose.index
            start, end = float(poses.start[index]), float(poses.end[index])
            samples = int(poses.count[index])
        gain = float(solved_poses.gain[k])
        yield PoseResult(
            name=name,
            start=start,
            end=end,
            samples=samples,
            values=tuple(group.value[k].tolist()),
            direction=tuple(solved_poses.direction[k].tolist()),
            residual=float(fitted_group.residuals[k]) / gain,
            u=float(fitted_group.sigma[k]) / gain,
            z=None if math.isnan(z) else z,
        )


def _nonlinear_effects(campaign: Campaign, solved_poses: SolvedPoses) -> Array:
    """Return the effect of the requested nonlinear terms on the indications, shape (n, 3)."""
    linear_symbols = ("K_F", *SENSITIVITY_TERMS)
    terms = campaign.model.terms
    indices = [_SYMBOLS.index(s) for s in terms if s in TERMS and s not in linear_symbols]
    effect: Array = np.sum(
        solved_poses.products[:, :, indices] * solved_poses.effective[:, :, indices], axis=2
    )
    return effect


def _slope_effects(
    poses: TriadPoses, solved_poses: SolvedPoses, parameters: Sequence[Unknown]
) -> Array:
    """Return the effect of the requested slopes on the indications, shape (n, 3)."""
    effect, requested = np.zeros_like(poses.value), set(parameters)
    for index, axis_index, term, factor in design_factors(poses, solved_poses.unknowns):
        unknown = solved_poses.unknowns[index]
        if condition_of(unknown.symbol) and unknown in requested:
            effect[:, axis_index] += (
                solved_poses.products[:, axis_index, term] * factor * solved_poses.values[index]
            )
    return effect


def _rms(norm_deviations: Sequence[Array], gravity: float) -> float | None:
    """Return the root mean square of |f| - g, m/s^2, or None without poses."""
    if not norm_deviations:
        return None
    return gravity * float(np.sqrt(np.mean(np.concatenate(norm_deviations) ** 2)))


def _record_results(poses: Iterable[LocatedPose]) -> dict[str, PosesInRecord]:
    """Return the results of the records with poses."""
    records = {pose.record.name: pose.record.poses for pose in poses if pose.record is not None}
    traces = {name: intervals.trace(_TRACE_POINTS) for name, intervals in records.items()}
    return {
        name: PosesInRecord(
            poses=len(intervals.start),
            threshold=intervals.threshold,
            contrast=intervals.contrast if math.isfinite(intervals.contrast) else None,
            notes=[*intervals.rejected, *intervals.warnings],
            time=traces[name][0].round(6).tolist(),
            level=[float(f"{level:.4g}") for level in traces[name][1]],
        )
        for name, intervals in records.items()
    }

"""The joint estimate, step by step: outliers, noise, rotation, coefficients, degrees of freedom."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from counterspin.arrays import SIGMA_OF_MAD, Array, semidefinite_root
from counterspin.errors import ConvergenceError
from counterspin.frozen import frozen
from counterspin.inference.joint import encoder
from counterspin.inference.joint.condensed import condense, white_level
from counterspin.inference.joint.fit import JointFit, solve_joint
from counterspin.inference.joint.outliers import outlying
from counterspin.inference.joint.prepared import Prepared, prepare_columns, prepared_for
from counterspin.inference.joint.rotation import find_rotation
from counterspin.inference.joint.series import Series
from counterspin.inference.joint.unknowns import ROTATION, Unknown, Unknowns
from counterspin.inference.noise import variance_components
from counterspin.inference.noise.model import NoiseModel
from counterspin.inference.noise.unseen_noise import lengthened
from counterspin.inference.noise.variance_components import (
    COMPONENTS,
    RecordData,
    VarianceComponents,
)
from counterspin.inference.noise.wander_components import estimate_wandering

Rows = npt.NDArray[np.bool_]

_ROUNDS: Final = 20  #: of outlier rejection

#: Share of a record beyond which what was left out is looked at again.
_MANY: Final = 0.01

#: Least u of a prior in the likelihood, in units of the unknown's credible limit.
_LEAST_PRIOR_U: Final = 1e-12

#: A change of K_I by less than this changes no platform column noticeably.
_SCALE_TOLERANCE: Final = 1e-4


@frozen
class NoiseRequest:
    """Noise of one accelerometer's records: numbers that are given, None to be estimated."""

    #: As in `NoiseModel`.
    white: float | None
    random_walk: float | None
    quantisation: float = 0.0
    flicker: float | None = 0.0
    bias_walk: float | None = 0.0

    @property
    def given(self) -> NoiseModel | None:
        """The noise, if all of it is given."""
        white, walk, flicker, bias_walk = (getattr(self, name) for name in COMPONENTS)
        if white is None or walk is None or flicker is None or bias_walk is None:
            return None
        return NoiseModel(white, walk, self.quantisation, flicker, bias_walk)

    @property
    def wanders(self) -> bool:
        """Whether the bias wanders, or may."""
        return self.flicker != 0.0 or self.bias_walk != 0.0


@frozen
class Estimate:
    """The joint estimate."""

    fit: JointFit  #: The solved problem.
    #: Accelerometer -> its estimated noise; without those whose noise was given.
    components: Mapping[str, VarianceComponents]
    #: Effective degrees of freedom of each unknown, shape (p,); infinite where noise is given.
    dof: Array
    outliers: tuple[Rows, ...] = ()  #: For each series, which of its rows were left out, bool.
    #: The data with these rows, about the rotation that was found where none was recorded.
    series: tuple[Series, ...] = ()
    #: The same fit with what nobody asks for condensed; None where there was nothing to condense.
    core: JointFit | None = None


def estimate(
    series: Sequence[Series],
    model: Unknowns,
    requests: Mapping[str, NoiseRequest],
    *,
    reject: bool = True,
) -> Estimate:
    """Estimate a model from all series.

    reject: Whether outliers are looked for.
    """
    plain = model.without_inputs()
    rough = {name: NoiseModel(1.0, 0.0) for name in requests}
    series = tuple(series)
    before = _scale_factors(series, plain, None)
    if any(unknown.symbol in ROTATION for unknown in model.unknowns):
        series = find_rotation(series, plain, before, rough)
    prepared = prepare_columns(series, plain, before)
    outliers = [np.zeros(record.time.size, dtype=bool) for record in series]
    white = {name: _floor(request) for name, request in requests.items()}
    # Until the end, what nobody asks for is in as few columns as tell the same.
    fit = solve_joint(*condense(prepared, plain, white), rough)
    if reject:
        fit = _reject(fit, series, requests, outliers)
        prepared = _kept(prepared, outliers)
    # Inputs come last, and the noise with them: what it is about will do until then.
    noise, components = _noise(fit.prepared, fit.model, requests, rough=model.has_inputs)
    fit = fit.with_noise(noise)
    whole = encoder.with_encoder(plain, [part.series for part in prepared], noise)
    if whole is not plain:
        # What the encoder has not shown is in the residuals until then.
        prepared = prepared_for(prepared, plain, whole, before, _known(fit))
        fit = solve_joint(*condense(prepared, whole, _white(noise)), noise)
        noise, components = _noise(fit.prepared, fit.model, requests, rough=model.has_inputs)
        fit = fit.with_noise(noise)
    scale_factors = _scale_factors(series, plain, fit)
    moved = any(abs(scale_factors[a] - before[a]) > _SCALE_TOLERANCE for a in before)
    if model.has_inputs or moved:
        first = whole
        whole = Unknowns(
            (*model.unknowns, *first.unknowns[len(plain.unknowns) :]),
            (*model.considered, *first.considered[len(plain.considered) :]),
        )
        prepared = prepared_for(prepared, first, whole, scale_factors, _known(fit))
        fit = solve_joint(*condense(prepared, whole, _white(noise)), noise)
        if model.has_inputs:
            noise, components = _noise(fit.prepared, fit.model, requests)
            fit = fit.with_noise(noise)
    if reject and whole is not plain:
        # What stands out of a wave that only this model has; and what only the wave made stand out.
        clean = _with_all(fit, prepared, series, whole, requests, outliers)
        clean = _reject(clean, series, requests, outliers)
        if clean is not fit:
            everything = prepare_columns(series, whole, scale_factors, _values(whole, fit))
            prepared = _kept(everything, outliers)
            noise, components = _noise(clean.prepared, clean.model, requests)
            fit = clean.with_noise(noise)
    return _finished(prepared, whole, fit, components, outliers=tuple(outliers), series=series)


def estimate_again(
    before: Estimate, fit: JointFit, requests: Mapping[str, NoiseRequest]
) -> Estimate:
    """Return the estimate of another fit to the same rows, its noise found anew."""
    core = solve_joint(*condense(fit.prepared, fit.model, _white(fit.noise)), fit.noise)
    noise, components = _noise(core.prepared, core.model, requests)
    again = _finished(fit.prepared, fit.model, core.with_noise(noise), components)
    return replace(again, outliers=before.outliers, series=before.series)


def _finished(
    prepared: Sequence[Prepared],
    model: Unknowns,
    core: JointFit,
    components: Mapping[str, VarianceComponents],
    **more: Any,
) -> Estimate:
    """Return the estimate of all unknowns with the noise of a condensed fit to the same rows."""
    fit = solve_joint(prepared, model, core.noise)
    core, dof = _with_unseen(core, components, _effective_dof(core, components))
    # In the condensed fit what is asked for comes first; one that has nothing condensed is whole.
    places = [place for place, unknown in enumerate(model.unknowns) if unknown.asked]
    if core.model.unknowns == model.unknowns:
        places = list(range(len(model.unknowns)))
    every = np.full(len(model.unknowns), math.inf)
    every[places] = dof[: len(places)]

    def embedded(covariance: Array) -> Array:
        whole = np.zeros((every.size, every.size))
        whole[np.ix_(places, places)] = covariance[: len(places), : len(places)]
        return whole

    added = core.solution.covariance_unseen
    if added is not None:
        solution = replace(fit.solution, covariance_unseen=embedded(added))
        unseen = {name: (level, embedded(one)) for name, (level, one) in core.unseen.items()}
        fit = replace(fit, solution=solution, unseen=unseen)
    return Estimate(fit, components, every, core=core, **more)


def _floor(request: NoiseRequest) -> float | None:
    """Return the least white noise of a sample, as far as it is given."""
    white = math.hypot(request.white or 0.0, request.quantisation / math.sqrt(12.0))
    return white or None


def _white(noise: Mapping[str, NoiseModel]) -> dict[str, float | None]:
    return {name: math.sqrt(one.sample_variance) or None for name, one in noise.items()}


def _known(fit: JointFit) -> dict[Unknown, float]:
    """Return what a fit says of its unknowns, less nominal."""
    return dict(zip(fit.model.unknowns, fit.solution.estimate.tolist(), strict=True))


def _values(model: Unknowns, fit: JointFit) -> Array:
    """Return what a fit says of a model's unknowns, less nominal; 0 where it has others."""
    known = _known(fit)
    return np.array([known.get(unknown, 0.0) for unknown in model.unknowns])


def _kept(prepared: Sequence[Prepared], outliers: Sequence[Rows]) -> tuple[Prepared, ...]:
    """Return columns without the rows that were left out."""
    return tuple(
        part.without(mask) if mask.any() else part
        for part, mask in zip(prepared, outliers, strict=True)
    )


def unseen_covariance(fit: JointFit, components: Mapping[str, VarianceComponents]) -> Array:
    """Return what walks that the records do not show may add to a fit's covariance, (p, p)."""
    p = len(fit.model.unknowns)
    wider, _ = _with_unseen(fit, components, np.full(p, math.inf))
    added = wider.solution.covariance_unseen
    return np.zeros((p, p)) if added is None else added


def _scale_factors(
    series: Sequence[Series], model: Unknowns, fit: JointFit | None
) -> dict[str, float]:
    """Return K_I of each accelerometer: estimated, or known beforehand, or 1."""
    factors = {record.accelerometer: 1.0 for record in series}
    found = {} if fit is None else {other: k for k, other in enumerate(fit.model.unknowns)}
    for unknown in model.unknowns:
        if unknown.symbol == "K_I":
            place = found.get(unknown)
            if fit is not None and place is not None and fit.solution.u[place] < unknown.limit:
                factors[unknown.owner] = 1.0 + float(fit.solution.estimate[place])
            elif math.isfinite(unknown.prior[1]):
                factors[unknown.owner] = unknown.prior[0]
    factors |= {c.owner: c.prior[0] for c in model.considered if c.symbol == "K_I"}
    return factors


def _reject(
    fit: JointFit,
    series: Sequence[Series],
    requests: Mapping[str, NoiseRequest],
    outliers: list[Rows],
) -> JointFit:
    """Leave outliers out, refitting until there are none; marks them in `outliers`."""
    for _ in range(_ROUNDS):
        further = _standing_out(fit, series, requests, outliers)
        if not any(mask.any() for mask in further):
            return fit
        prepared = tuple(
            part.without(new[~mask]) if new.any() else part
            for part, new, mask in zip(fit.prepared, further, outliers, strict=True)
        )
        for mask, new in zip(outliers, further, strict=True):
            mask[new] = True
        fit = solve_joint(prepared, fit.model, fit.noise)
    where = " and ".join(
        f"{part.run} ({part.accelerometer})"
        for part, mask in zip(fit.prepared, further, strict=True)
        if mask.any()
    )
    raise ConvergenceError(
        f"{where}: outliers were still found after {_ROUNDS} rounds of leaving them out: the "
        "residuals are not noise around a smooth curve; look at the record, for a clock or a "
        "displacement that jumps, or add the missing terms to the model"
    )


def _standing_out(
    fit: JointFit,
    series: Sequence[Series],
    requests: Mapping[str, NoiseRequest],
    outliers: list[Rows],
) -> list[Rows]:
    """Return which rows of each series are outliers besides those that are left out already."""
    further = []
    for index, (part, mask) in enumerate(zip(fit.prepared, outliers, strict=True)):
        time, weight = series[index].time, np.sqrt(series[index].count)
        left = np.full(time.size, np.nan)
        left[~mask] = fit.residuals[index].plain
        step = requests[part.accelerometer].quantisation
        if part.series.jitter > 0.0:
            white = requests[part.accelerometer].white or 0.0
            weight = weight / _jittered(
                left * weight, white, part.series.jitter, series[index].jitter_variance
            )
        further.append(outlying(left, weight, step / math.sqrt(12.0), time))
    return further


def _with_all(
    fit: JointFit,
    prepared: Sequence[Prepared],
    series: Sequence[Series],
    model: Unknowns,
    requests: Mapping[str, NoiseRequest],
    outliers: list[Rows],
) -> JointFit:
    """Take back what no longer stands out, where many were left out; changes `outliers`."""
    if not any(mask.mean() > _MANY for mask in outliers):
        return fit
    factors = {part.accelerometer: part.scale_factor for part in prepared}
    whole = prepare_columns(series, model, factors, _values(model, fit))
    everything, condensed = condense(whole, model, _white(fit.noise))
    kept = _kept(everything, outliers)
    again = solve_joint(kept, condensed, fit.noise)
    none = [np.zeros(record.time.size, dtype=bool) for record in series]
    # The same estimate, held against all rows.
    standing = _standing_out(replace(again, prepared=everything), series, requests, none)
    if not any((mask & ~new).any() for mask, new in zip(outliers, standing, strict=True)):
        return fit
    for mask, new in zip(outliers, standing, strict=True):
        mask[:] = new
    return solve_joint(_kept(everything, standing), condensed, fit.noise)


def _jittered(residuals: Array, white: float, jitter: float, variance: Array) -> Array:
    """Return each row's standard deviation over the rms, noise of the time stamps being uneven.

    What is less than usual counts as half of it: such rows are compared with noisier neighbours.
    """
    scale = SIGMA_OF_MAD * float(np.nanmedian(np.abs(residuals)))
    even = max(white**2, scale**2 - jitter**2)
    ratio: Array = np.sqrt(np.maximum((even + variance) / (even + jitter**2), 0.5))
    return ratio


def _noise(
    prepared: Sequence[Prepared],
    model: Unknowns,
    requests: Mapping[str, NoiseRequest],
    *,
    rough: bool = False,
) -> tuple[dict[str, NoiseModel], dict[str, VarianceComponents]]:
    """Return each accelerometer's noise, given or by restricted maximum likelihood.

    Where `rough`, white noise from what changes from row to row does for what is not given.
    """
    noise: dict[str, NoiseModel] = {}
    components: dict[str, VarianceComponents] = {}
    for name, request in requests.items():
        if request.given is not None:
            noise[name] = request.given
            continue
        own = [part for part in prepared if part.accelerometer == name]
        if rough and (white := max(map(white_level, own))) > 0.0:
            noise[name] = NoiseModel(white)
            continue
        components[name] = _components(own, model, request)
        noise[name] = components[name].noise
    return noise, components


def _components(
    prepared: Sequence[Prepared], model: Unknowns, request: NoiseRequest
) -> VarianceComponents:
    # What is considered is unknown here, or what it does to the records would be taken for noise.
    every, p = (*model.unknowns, *model.considered), len(model.unknowns)
    places = [(*part.unknowns, *(p + place for place in part.considered)) for part in prepared]
    used = sorted({index for own in places for index in own})
    plain = [
        RecordData(
            part.series.time,
            part.series.order,
            np.column_stack([part.design, part.fixed]),
            part.series.error,
            part.series.count,
            part.series.block_spacing,
            [used.index(index) for index in own],
            part.series.trajectory.conditions.start,
        )
        for part, own in zip(prepared, places, strict=True)
    ]
    # Priors are data too; what has none is held as loosely as in the solution.
    chosen = [every[index] for index in used]
    spread = np.array([max(unknown.spread, _LEAST_PRIOR_U * unknown.limit) for unknown in chosen])
    means = np.array([unknown.prior_mean for unknown in chosen])
    known, values = np.diag(1.0 / spread), means / spread

    def found(records: Sequence[RecordData], jitter: float) -> VarianceComponents:
        # Like quantisation, noise of the time stamps is white noise of a known size.
        quantisation = math.sqrt(request.quantisation**2 + 12.0 * jitter)
        if request.wanders:
            whole = replace(request, quantisation=quantisation)
            components = estimate_wandering(records, whole, known, values)
        else:
            components = variance_components.estimate(
                records,
                white=request.white,
                random_walk=request.random_walk,
                quantisation=quantisation,
                prior_rows=known,
                prior_values=values,
            )
        return replace(components, quantisation=request.quantisation)

    added = [part.series.jitter_variance for part in prepared]
    if not any(np.any(part) for part in added):
        return found(plain, 0.0)
    # It is another for each row. What is white beside it, to begin with: all that there is.
    every_row = np.concatenate(
        [
            np.broadcast_to(one, part.series.time.shape)
            for one, part in zip(added, prepared, strict=True)
        ]
    )
    mean = float(np.mean(every_row))
    components = found(plain, mean)
    white = components.noise.sample_variance + mean
    for _ in range(_ROUNDS):
        middle = 1.0 / float(np.mean(1.0 / (white + every_row)))
        records = [
            replace(record, shares=(white + one) / middle)
            for record, one in zip(plain, added, strict=True)
        ]
        before = white
        components = found(records, middle - white)
        white = max(components.noise.sample_variance, 0.1 * before)
        if abs(white - before) <= 1e-3 * middle:
            break
    return components


def _effective_dof(fit: JointFit, components: Mapping[str, VarianceComponents]) -> Array:
    """Return Satterthwaite's degrees of freedom; several accelerometers' 1/dof add up."""
    inverse = np.zeros(len(fit.model.unknowns))
    for name, component in components.items():

        def variances(noise: NoiseModel, name: str = name) -> Array:
            return np.diag(fit.with_noise({name: noise}).solution.covariance)

        inverse += 1.0 / variance_components.effective_dof_of(variances, component)
    with np.errstate(divide="ignore"):
        return 1.0 / inverse


def _with_unseen(
    fit: JointFit, components: Mapping[str, VarianceComponents], dof: Array
) -> tuple[JointFit, Array]:
    """Return the fit with what dropped walks may add to its uncertainty, and the new dof.

    The weights are those that leave the least covariance without the walk, so that its derivative
    by N^2 is what a walk adds to these weights' own (envelope theorem). The least covariance grows
    with the noise, and so does the addition: it is positive semi-definite, and what rounding takes
    from that is given back. Considered terms have no part in the weights, which are not at an
    optimum for them: their part of the covariance stays as it is. Unknowns that are
    not determined, or known exactly, are left as they are.
    """
    solution = fit.solution
    before, total = solution.least_covariance, solution.covariance
    limits = np.array([unknown.limit for unknown in fit.model.unknowns])
    known = (solution.u > 0.0) & (solution.u < limits)
    unseen: dict[str, tuple[float, Array]] = {}
    inverse = 1.0 / dof
    for name, component in components.items():
        if component.unseen is None or not known.any():
            continue
        step = component.unseen.step
        walking = replace(fit.noise[name], random_walk=math.sqrt(step))
        after = fit.with_noise({name: walking}).solution.least_covariance
        root = semidefinite_root(np.where(np.outer(known, known), (after - before) / step, 0.0))
        slope = root @ root.T
        diagonal = np.diag(slope)
        if not diagonal.any():
            continue
        variance = np.where(known, np.diag(total), 1.0)
        level, longer = lengthened(component.unseen, variance, diagonal)
        unseen[name] = math.sqrt(level), level * slope
        share = variance / (variance + level * diagonal)
        inverse = np.where(known, share**2 * inverse + 1.0 / longer, inverse)
    if not unseen:
        return fit, dof
    added: Array = sum((covariance for _, covariance in unseen.values()), np.zeros_like(before))
    wider = replace(fit, solution=replace(solution, covariance_unseen=added), unseen=unseen)
    with np.errstate(divide="ignore"):
        return wider, 1.0 / inverse

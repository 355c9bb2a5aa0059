"""The parts of a joint result that are read off the solution: values, budgets, correlations."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from typing import Final

import numpy as np

from counterspin.calibration.joint_view import AccelerometerView
from counterspin.calibration.readings import readings_noise, residual_of
from counterspin.calibration.result_parts import (
    Coefficient,
    Correlation,
    Knowledge,
    NoiseLine,
    Residual,
)
from counterspin.campaign.description import Campaign
from counterspin.campaign.quantity import Quantity
from counterspin.campaign.settings import OBSERVABLES
from counterspin.inference.distributions import countable
from counterspin.inference.identifiability import Assessment, ConfoundedTerms
from counterspin.inference.joint import encoder
from counterspin.inference.joint.budget import by_kind, kind_of
from counterspin.inference.joint.estimation import Estimate
from counterspin.inference.joint.series import Series
from counterspin.inference.joint.unknowns import ROTATION
from counterspin.inference.noise.model import COMPONENTS, WALK_UNIT, Noise
from counterspin.inference.noise.search import FoundNoise
from counterspin.physics.terms import SHARED_TERMS, TERMS, symbol_of

#: Share of u^2 above which noise that the records do not show is mentioned.
_HIDDEN_SHARE: Final = 0.5


def coefficient(estimate: Estimate, assessment: Assessment, index: int) -> Coefficient:
    """Return one unknown as the result shows it: estimated, or its prior, or nothing."""
    unknown, solution = estimate.fit.model.unknowns[index], estimate.fit.solution
    unit = unknown.unit
    if not assessment.determined[unknown.name]:
        known = math.isfinite(unknown.prior[1])
        return Coefficient(
            value=unknown.prior[0] if known else None,
            u=unknown.prior[1] if known else None,
            unit=unit,
            estimated=False,
        )
    noise, stated, unstated = by_kind(estimate.fit, index)
    dof = float(estimate.dof[index])
    return Coefficient(
        value=float(solution.estimate[index]) + unknown.nominal,
        u=math.hypot(noise, stated, unstated),
        u_noise=noise,
        u_stated=stated,
        u_unstated=unstated,
        dof=countable(dof),
        unit=unit,
        estimated=True,
    )


def knowledge(estimate: Estimate, stated_inputs: Mapping[str, Quantity]) -> list[Knowledge]:
    """Return what an estimate rests on beside its data, in the order of the fit."""
    model, solution = estimate.fit.model, estimate.fit.solution
    rows = []
    for place, other in enumerate((*model.unknowns, *model.considered)):
        if other.asked or other.symbol in encoder.SYMBOLS:
            continue
        stated = stated_inputs.get(other.name)
        base = stated.value if stated else 0.0
        found = u_found = None
        if place < len(model.unknowns):
            found = base + other.nominal + float(solution.estimate[place])
            u_found = float(solution.u[place])
        rows.append(
            Knowledge(
                name=other.name,
                kind=kind_of(other),
                unit=other.unit,
                value=base + other.prior[0],
                u=other.prior[1],
                found=found,
                u_found=u_found,
            )
        )
    return rows


def correlation(view: AccelerometerView) -> Correlation | None:
    """Return the correlations of an accelerometer's own and the platform's coefficients."""
    own = f"{view.name}."
    return _correlation(
        view.estimate,
        {
            place: unknown.name.removeprefix(own)
            for place, unknown in enumerate(view.fit.model.unknowns)
            if view.assessment.determined.get(unknown.name)
            and (unknown.owner == view.name or unknown.symbol not in TERMS)
        },
    )


def whole_correlation(estimate: Estimate, assessment: Assessment) -> Correlation | None:
    """Return the correlations of everything determined, but for the runs' own rotations."""
    return _correlation(
        estimate,
        {
            place: unknown.name
            for place, unknown in enumerate(estimate.fit.model.unknowns)
            if assessment.determined.get(unknown.name) and unknown.symbol not in ROTATION
        },
    )


def _correlation(estimate: Estimate, terms: Mapping[int, str]) -> Correlation | None:
    if not terms:
        return None
    covariance = estimate.fit.solution.covariance[np.ix_(list(terms), list(terms))]
    u = np.sqrt(np.diag(covariance))
    return Correlation(terms=list(terms.values()), matrix=(covariance / np.outer(u, u)).tolist())


def confounded(view: AccelerometerView) -> list[ConfoundedTerms]:
    """Return the sets with terms of an accelerometer's own, its name left out."""
    return [
        item.of(view.name)
        for item in view.assessment.confounded
        if any(name.startswith(f"{view.name}.") for name in item.terms)
    ]


def confounded_platform(assessment: Assessment) -> list[ConfoundedTerms]:
    """Return the sets of shared terms alone, those of a run's own rotation left out."""
    return [
        item
        for item in assessment.confounded
        if all(symbol_of(name) in SHARED_TERMS for name in item.terms)
    ]


def residual(view: AccelerometerView) -> Residual:
    """Return the size of an accelerometer's residuals, a sample, and how well the model fits."""
    if not view.has_records:
        return residual_of(view.parts)
    squares, samples, diagnostics = 0.0, 0.0, view.diagnostics
    for _, prepared, residuals in view.records():
        squares += float(np.sum(residuals.plain**2 * prepared.series.count))
        samples += residuals.plain.size
    return Residual(
        rms=math.sqrt(squares / samples),
        unit=OBSERVABLES[view.accelerometer.observable],
        dof=diagnostics.dof,
        chi2=diagnostics.chi2 if diagnostics.noise_given else None,
        lack_of_fit_p=diagnostics.lack_of_fit_p,
    )


def noise_lines(view: AccelerometerView) -> dict[str, NoiseLine]:
    """Return the noise used, component by component, given or estimated."""
    of_readings = readings_noise(view.parts)
    if not view.has_records:
        return of_readings
    components = view.estimate.components.get(view.name)
    noise, observable = view.fit.noise[view.name], view.accelerometer.observable
    of_records = record_noise(noise, components, observable)
    own = _own_series(view)
    if any(one.relative != 1.0 for one in own):
        line = of_records[observable]
        runs = {one.run: line.value * math.sqrt(one.relative) for one in own}
        of_records[observable] = line.model_copy(update={"runs": runs})
    if timing := _found_timing(view):
        of_records["timing"] = NoiseLine(value=timing, unit="s", estimated=True)
    return from_rest(of_records, view.campaign, noise, observable) | of_readings


def _own_series(view: AccelerometerView) -> list[Series]:
    return [part.series for part in view.fit.prepared if part.accelerometer == view.name]


def _found_timing(view: AccelerometerView) -> float:
    """Return the noise of the time stamps that the residuals of the records show, s; 0: none."""
    stated = view.campaign.noise is not None and view.campaign.noise.timing
    return 0.0 if stated else max((one.timing for one in _own_series(view)), default=0.0)


def other_noise(views: Iterable[AccelerometerView]) -> Iterator[str]:
    """Yield remarks on noise that is not independent, or uneven: rows and weights follow it."""
    for view in views:
        if thinned := {one.run: one.every for one in _own_series(view) if one.every > 1}:
            which = ", ".join(f"every {every}th of {run}" for run, every in thinned.items())
            yield (
                f"{view.name}: rows beside each other have nearly the same error, as a filter of "
                f"the recorder or coarse steps make it. Only independent rows are used: {which}."
            )
        sizes = {one.run: math.sqrt(one.relative) for one in _own_series(view)}
        quiet, loud = (choose(sizes, key=sizes.__getitem__, default="") for choose in (min, max))
        if sizes and sizes[loud] > sizes[quiet]:
            ratio = sizes[loud] / sizes[quiet]
            yield (
                f"{view.name}: the noise of {loud} is {ratio:.2g} times that of {quiet}. Each run "
                "is weighted with its own. Find out why, and whether more than noise differs."
            )
        if timing := _found_timing(view):
            yield (
                f"{view.name}: the noise follows the slope of the signal, as time stamps that "
                f"scatter by {timing * 1e6:.2g} us make it, and rows are weighted accordingly. "
                "If that is what they do, state it as timing in [noise]."
            )


def hidden_walk(views: Iterable[AccelerometerView]) -> Iterator[str]:
    """Yield a remark where most of u^2 of K_II is noise that the records do not show.

    u holds it, so nothing speaks against the result.
    """
    for view in views:
        index, name = view.k_ii, view.name
        if index is None or name not in view.fit.unseen:
            continue
        variance = float(view.fit.unseen[name][1][index, index])
        share = variance / float(view.fit.solution.u[index]) ** 2
        if share > _HIDDEN_SHARE:
            yield (
                f"{name}: {share:.0%} of u^2 of K_II is white noise of the accelerometer that the "
                f"records neither show nor exclude. If it is known, even as zero, state "
                "it as acceleration in [noise]; otherwise record longer runs."
            )


def from_rest(
    lines: dict[str, NoiseLine], campaign: Campaign, noise: Noise, observable: str
) -> dict[str, NoiseLine]:
    """Return lines of noise that say which are from the record at rest, and how well it knows."""
    said = dict(lines)
    keys = (observable, "acceleration", "flicker", "bias_walk") if noise.covariance else ()
    for place, key in enumerate(keys):
        variance, line = noise.covariance[place][place], lines.get(key)
        if variance > 0.0 and line is not None and not line.estimated and campaign.noise:
            u = 0.5 * math.sqrt(variance) / line.value
            said[key] = line.model_copy(update={"u": u, "record": campaign.noise.rest})
    return said


def record_noise(
    noise: Noise, components: FoundNoise | None, observable: str
) -> dict[str, NoiseLine]:
    """Return noise of records, component by component, given or estimated."""
    unit = OBSERVABLES[observable]
    lines = {}
    labels = (observable, "acceleration", "flicker", "bias_walk")
    units = (unit, WALK_UNIT, "m/s^2", "m/s^2/s^0.5")
    for place, (part, label, its_unit) in enumerate(zip(COMPONENTS, labels, units, strict=True)):
        size = float(getattr(noise, part))
        estimated = components is not None and part in components.estimated
        dropped = components is not None and part in components.dropped
        if size == 0.0 and not dropped:
            continue
        u = None
        if components is not None and estimated and size > 0.0:
            # From the variance of a variance to that of its root.
            u = 0.5 * math.sqrt(float(components.covariance[place, place])) / size
        lines[label] = NoiseLine(value=size, u=u, unit=its_unit, estimated=estimated or dropped)
    if noise.quantisation > 0.0:
        lines["quantisation"] = NoiseLine(value=noise.quantisation, unit=unit, estimated=False)
    return lines

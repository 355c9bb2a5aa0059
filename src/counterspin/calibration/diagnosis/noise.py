"""Tests whether residuals agree with the stated or estimated noise, in all or some runs."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Final

from counterspin.calibration.accelerometer_view import AccelerometerView
from counterspin.calibration.result_parts import Finding
from counterspin.campaign.settings import OBSERVABLES
from counterspin.inference.diagnostics import CHI_SQUARE_SIGNIFICANCE, SIGNIFICANCE
from counterspin.inference.joint.estimation import Estimate
from counterspin.inference.joint.fit import solve_joint
from counterspin.inference.joint.heteroscedasticity import noise_by_run
from counterspin.reports.numbers import format_number

#: Noise of a run that is so many times the stated one, or less by as much, is another one.
_MAX_NOISE_RATIO: Final = 1.1


#: Runs that a finding names.
_MAX_NAMED: Final = 3


def reweight_runs(
    views: Sequence[AccelerometerView], estimate: Estimate
) -> tuple[Estimate, list[Finding]]:
    """Weigh each run with its own noise where the stated one is that of some runs only.

    What a noisy run does by chance is no jump of its record. Its noise is taken from third
    differences, in which nothing else shows.
    """
    stated_names = [
        view.name
        for view in views
        if view.has_records and not view.problem.noise[view.name].to_estimate
    ]
    noise_ratios = {name: noise_by_run(estimate.fit, name) for name in stated_names}
    noise_ratios = {name: runs for name, runs in noise_ratios.items() if _deviating_runs(runs)}
    if not noise_ratios:
        return estimate, []
    reweighted_observations = [
        replace(block, series=block.series.scale_noise(noise_ratios.get(block.accelerometer, {})))
        for block in estimate.fit.design_blocks
    ]
    other_observations = estimate.fit.observations[len(reweighted_observations) :]
    fit = solve_joint(
        (*reweighted_observations, *other_observations), estimate.fit.model, estimate.fit.noise
    )
    return replace(estimate, fit=fit), [
        _noise_finding(name, runs) for name, runs in noise_ratios.items()
    ]


def _deviating_runs(runs: Mapping[str, float]) -> list[str]:
    """Return the runs whose noise is another one than stated, the furthest off first."""
    deviating = [
        run for run, ratio in runs.items() if not 1.0 / _MAX_NOISE_RATIO < ratio < _MAX_NOISE_RATIO
    ]
    return sorted(deviating, key=lambda run: -abs(math.log(runs[run])))


def _noise_finding(name: str, runs: Mapping[str, float]) -> Finding:
    deviating = _deviating_runs(runs)
    ratios = [f"{format_number(runs[run], 2)} times" for run in deviating[:_MAX_NAMED]]
    ratios[0] += " the stated noise"
    listing = ", ".join(
        f"{max_ratio} in {run}" for max_ratio, run in zip(ratios, deviating, strict=False)
    )
    contrast = ", and as stated in the other runs" if len(deviating) < len(runs) else ""
    text = (
        f"The differences between adjacent rows show that the noise of {name} is "
        f"{listing}{contrast}. Find the cause. Alternatively, remove the value from [noise], so "
        "that counterspin estimates the noise of each run."
    )
    max_ratio = max(max(ratio, 1.0 / ratio) for ratio in runs.values())
    return Finding(code="wrong-noise", subject=name, text=text, size=max_ratio)


def check_stated_noise(view: AccelerometerView) -> Iterator[Finding]:
    """Yield that the noise is stated wrongly, where nothing else is wrong with it.

    Residuals of another size than the noise, alike in every run and independent of each other.
    """
    tests, name, accelerometer_count = (
        view.diagnostics,
        view.name,
        len(view.campaign.accelerometers),
    )
    p = tests.lack_of_fit_p
    if (
        CHI_SQUARE_SIGNIFICANCE / accelerometer_count
        < p
        < 1.0 - CHI_SQUARE_SIGNIFICANCE / accelerometer_count
    ):
        return
    ratio, threshold = tests.chi2 / tests.dof, SIGNIFICANCE / (3.0 * len(tests.runs))
    for run in tests.runs.values():
        deviation = (run.chi2 / ratio - run.dof) / math.sqrt(2.0 * run.dof)
        if min(run.sign_p, run.peak_p, math.erfc(abs(deviation) / math.sqrt(2.0))) < threshold:
            return
    factor = math.sqrt(ratio)
    white, unit = view.fit.noise[name].white, OBSERVABLES[view.accelerometer.observable]
    noise_text = f", {format_number(factor * white, 3)} {unit}," if white > 0.0 else ""
    text = (
        "The residuals are independent of each other. In every run, they are "
        f"{format_number(factor, 4)} times as large as expected from the stated noise. Noise of "
        f"this size{noise_text} would fit. Check the stated noise, or let counterspin estimate "
        "the noise."
    )
    yield Finding(code="wrong-noise", subject=name, text=text, size=max(factor, 1.0 / factor))

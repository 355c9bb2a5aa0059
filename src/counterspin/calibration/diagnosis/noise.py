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

#: Ratio of estimated to stated noise, or its inverse, above which the noise deviates.
_MAX_NOISE_RATIO: Final = 1.1


#: Largest number of runs that a finding names.
_MAX_NAMED_RUNS: Final = 3


def reweight_runs(
    views: Sequence[AccelerometerView], estimate: Estimate
) -> tuple[Estimate, list[Finding]]:
    """Weight each run by its estimated noise if this noise deviates from the stated one.

    Otherwise, a noisy run could be mistaken for a jump. The noise is estimated from third
    differences, which contain no other effects.
    """
    stated_names = [
        view.name
        for view in views
        if view.has_records and not view.problem.noise[view.name].to_estimate
    ]
    ratios = {name: noise_by_run(estimate.fit, name) for name in stated_names}
    ratios = {name: runs for name, runs in ratios.items() if _deviating_runs(runs)}
    if not ratios:
        return estimate, []
    reweighted_observations = [
        replace(block, series=block.series.scale_noise(ratios.get(block.accelerometer, {})))
        for block in estimate.fit.design_blocks
    ]
    other_observations = estimate.fit.observations[len(reweighted_observations) :]
    fit = solve_joint(
        (*reweighted_observations, *other_observations), estimate.fit.model, estimate.fit.noise
    )
    return replace(estimate, fit=fit), [_noise_finding(name, runs) for name, runs in ratios.items()]


def _deviating_runs(ratios: Mapping[str, float]) -> list[str]:
    """Return the runs whose noise deviates from the stated one, largest deviation first."""
    runs = [
        run
        for run, ratio in ratios.items()
        if not 1.0 / _MAX_NOISE_RATIO < ratio < _MAX_NOISE_RATIO
    ]
    return sorted(runs, key=lambda run: -abs(math.log(ratios[run])))


def _noise_finding(name: str, ratios: Mapping[str, float]) -> Finding:
    runs = _deviating_runs(ratios)
    ratio_texts = [f"{format_number(ratios[run], 2)} times" for run in runs[:_MAX_NAMED_RUNS]]
    ratio_texts[0] += " the stated noise"
    ratios_text = ", ".join(
        f"{ratio_text} in {run}" for ratio_text, run in zip(ratio_texts, runs, strict=False)
    )
    contrast_clause = ", and as stated in the other runs" if len(runs) < len(ratios) else ""
    text = (
        f"The differences between adjacent rows show that the noise of {name} is "
        f"{ratios_text}{contrast_clause}. Find the cause. Alternatively, remove the value from "
        "[noise], so that counterspin estimates the noise of each run."
    )
    max_ratio = max(max(ratio, 1.0 / ratio) for ratio in ratios.values())
    return Finding(code="wrong-noise", subject=name, text=text, size=max_ratio)


def check_stated_noise(view: AccelerometerView) -> Iterator[Finding]:
    """Yield a finding if the stated noise is wrong and the fit shows no other misfit.

    In this case the residuals are independent, and their ratio to the noise is equal in all runs.
    """
    tests, name = view.diagnostics, view.name
    n_accelerometers = len(view.campaign.accelerometers)
    p = tests.lack_of_fit_p
    if (
        CHI_SQUARE_SIGNIFICANCE / n_accelerometers
        < p
        < 1.0 - CHI_SQUARE_SIGNIFICANCE / n_accelerometers
    ):
        return
    ratio, threshold = tests.chi2 / tests.dof, SIGNIFICANCE / (3.0 * len(tests.runs))
    for run in tests.runs.values():
        deviation = (run.chi2 / ratio - run.dof) / math.sqrt(2.0 * run.dof)
        if min(run.sign_p, run.peak_p, math.erfc(abs(deviation) / math.sqrt(2.0))) < threshold:
            return
    factor = math.sqrt(ratio)
    white_noise, unit = view.fit.noise[name].white, OBSERVABLES[view.accelerometer.observable]
    noise_text = f", {format_number(factor * white_noise, 3)} {unit}," if white_noise > 0.0 else ""
    text = (
        "The residuals are independent of each other. In every run, they are "
        f"{format_number(factor, 4)} times as large as expected from the stated noise. Noise of "
        f"this size{noise_text} would fit. Check the stated noise, or let counterspin estimate "
        "the noise."
    )
    yield Finding(code="wrong-noise", subject=name, text=text, size=max(factor, 1.0 / factor))

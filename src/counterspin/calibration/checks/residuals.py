"""Tests of the residuals against the noise, and remarks on the noise."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import Final

from counterspin.calibration.accelerometer_view import AccelerometerView
from counterspin.calibration.findings import lack_of_fit_finding, two_sided_z
from counterspin.calibration.outcome import estimated_timing_noise, summarize_residuals
from counterspin.calibration.result_parts import Finding
from counterspin.inference.diagnostics import FALSE_ALARM_RATE
from counterspin.inference.joint.agreement import compare_slow_residuals
from counterspin.inference.joint.fit import estimate_considered
from counterspin.reports.numbers import format_number

#: Share of u^2 above which a remark reports noise that the records cannot confirm.
_MAX_UNDETECTED_SHARE: Final = 0.5


def residual_findings(view: AccelerometerView) -> list[Finding]:
    """Return the findings of the tests of an accelerometer's residuals."""
    findings = view.reading_data.findings(view)
    if not view.has_records:
        return findings
    diagnostics = view.diagnostics
    if diagnostics.findings:
        findings.insert(
            0, lack_of_fit_finding(view.name, diagnostics.findings, summarize_residuals(view))
        )
    return [*findings, *_compare_run_noise(view)]


def _compare_run_noise(view: AccelerometerView) -> list[Finding]:
    """Return a finding if the estimated noise is larger in one run than in the others."""
    components = view.estimate.estimated_noise.get(view.name)
    if components is None or "random_walk" not in components.estimated:
        return []
    # The tests do not need the nuisance parameters separately.
    run_tests = compare_slow_residuals(
        estimate_considered(view.estimate.compressed_fit or view.fit), view.name
    )
    worst_test = min(run_tests, key=lambda test: test.p, default=None)
    n_tests = len(run_tests) * len(view.campaign.accelerometers)
    if worst_test is None or worst_test.p * n_tests >= FALSE_ALARM_RATE:
        return []
    text = (
        f"The estimated accelerometer noise differs between runs. In {worst_test.run}, it is "
        f"{format_number(math.sqrt(worst_test.ratio), 2)} times as large as in the other runs (p = "
        f"{worst_test.p:.2g}). The fit may have attributed a slow error of this record, or of a "
        "record used for comparison, to noise. Such an error may shift the coefficients by more "
        "than their uncertainty. Inspect the records."
    )
    return [
        Finding(
            code="noise-differs",
            subject=f"{worst_test.run}.{view.name}",
            text=text,
            size=two_sided_z(worst_test.p),
        )
    ]


# Remarks


def noise_remarks(views: Iterable[AccelerometerView]) -> Iterator[str]:
    """Yield remarks on correlated or heteroscedastic noise, to which the fit adapts."""
    for view in views:
        if strides_by_run := {
            series.run: series.thinning for series in view.series if series.thinning > 1
        }:
            stride_text = ", ".join(
                f"one row in {stride} of {run}" for run, stride in strides_by_run.items()
            )
            yield (
                f"{view.name}: adjacent rows have nearly the same error, as if the recorder "
                "had a low-pass filter or a coarse resolution. The fit uses only rows "
                f"with independent errors: {stride_text}."
            )
        noise_ratios = {series.run: math.sqrt(series.variance_ratio) for series in view.series}
        quietest_run, noisiest_run = (
            extremum(noise_ratios, key=noise_ratios.__getitem__, default="")
            for extremum in (min, max)
        )
        if noise_ratios and noise_ratios[noisiest_run] > noise_ratios[quietest_run]:
            ratio = noise_ratios[noisiest_run] / noise_ratios[quietest_run]
            yield (
                f"{view.name}: the noise in {noisiest_run} is {ratio:.2g} times the noise in "
                f"{quietest_run}. The fit weights each run by its noise. Find the cause, and check "
                "whether the runs also differ in other respects."
            )
        if timing_noise := estimated_timing_noise(view):
            symptom, action = (
                "the noise is proportional to the slope of the signal",
                "the fit weights the rows accordingly",
            )
            if any(series.corrected_fraction > 0.0 for series in view.series):
                symptom, action = (
                    "the angle and the signal share an error",
                    "the fit uses the angle to correct the times",
                )
            yield (
                f"{view.name}: {symptom}. This pattern suggests time-stamp jitter of "
                f"{timing_noise * 1e6:.2g} us, and {action}. If the time stamps do have jitter, "
                "enter the jitter as timing in [noise]."
            )


def undetected_walk_remarks(views: Iterable[AccelerometerView]) -> Iterator[str]:
    """Yield a remark if most of u^2 of K_II comes from noise that the records cannot confirm."""
    for view in views:
        index, name = view.k_ii_index, view.name
        if index is None or name not in view.fit.undetected_walks:
            continue
        variance = float(view.fit.undetected_walks[name][1][index, index])
        share = variance / float(view.fit.solution.u[index]) ** 2
        if share > _MAX_UNDETECTED_SHARE:
            yield (
                f"{name}: {100 * share:.0f} % of the variance of K_II comes from accelerometer "
                "white noise that the records can neither confirm nor exclude. If this noise is "
                "known, enter it as acceleration in [noise], even if the value is zero. "
                "Otherwise, record longer runs."
            )

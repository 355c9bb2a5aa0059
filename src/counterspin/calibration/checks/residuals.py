"""Tests of the residuals against the noise, and remarks on the noise."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import Final

from counterspin.calibration.findings import equivalent_deviations, lack_of_fit
from counterspin.calibration.outcome import found_timing, residual
from counterspin.calibration.result_parts import Finding
from counterspin.calibration.view import AccelerometerView
from counterspin.inference.diagnostics import FALSE_ALARMS
from counterspin.inference.joint.agreement import slow_parts
from counterspin.inference.joint.fit import relax
from counterspin.reports.numbers import format_number

#: Share of u^2 above which noise that the records do not show is mentioned.
_HIDDEN_SHARE: Final = 0.5


def residual_findings(view: AccelerometerView) -> list[Finding]:
    """Return the finding of the tests of an accelerometer's residuals, over all records."""
    findings = view.data.findings(view)
    if not view.has_records:
        return findings
    tests = view.diagnostics
    if tests.findings:
        findings.insert(0, lack_of_fit(view.name, tests.findings, residual(view)))
    return [*findings, *_noise_that_differs(view)]


def _noise_that_differs(view: AccelerometerView) -> list[Finding]:
    """Return a finding where one run shows more of the noise that was found than the others."""
    components = view.estimate.components.get(view.name)
    if components is None or "random_walk" not in components.estimated:
        return []
    # What nobody asks for need not be apart.
    parts = slow_parts(relax(view.estimate.core or view.fit), view.name)
    worst = min(parts, key=lambda part: part.p, default=None)
    tests = len(parts) * len(view.campaign.accelerometers)
    if worst is None or worst.p * tests >= FALSE_ALARMS:
        return []
    text = (
        "The estimated noise of the accelerometer differs between runs: "
        f"that of {worst.run} is {format_number(math.sqrt(worst.ratio), 2)} times as large as "
        f"the others' "
        f"(p = {worst.p:.2g}). A slow error of this record, or of one that it is compared with, "
        f"may have been taken for noise and may shift the coefficients by more than their "
        "uncertainty. "
        "Inspect the records."
    )
    return [
        Finding(
            code="noise-differs",
            subject=f"{worst.run}.{view.name}",
            text=text,
            size=equivalent_deviations(worst.p),
        )
    ]


# Remarks


def other_noise(views: Iterable[AccelerometerView]) -> Iterator[str]:
    """Yield remarks on noise that is not independent, or uneven: rows and weights follow it."""
    for view in views:
        if thinned := {one.run: one.every for one in view.series if one.every > 1}:
            which = ", ".join(f"one in {every} of {run}" for run, every in thinned.items())
            yield (
                f"{view.name}: adjacent rows have nearly the same error, as after a filter in the "
                f"recorder or with a coarse resolution. Only independent rows are used: {which}."
            )
        sizes = {one.run: math.sqrt(one.relative) for one in view.series}
        quiet, loud = (choose(sizes, key=sizes.__getitem__, default="") for choose in (min, max))
        if sizes and sizes[loud] > sizes[quiet]:
            ratio = sizes[loud] / sizes[quiet]
            yield (
                f"{view.name}: the noise of {loud} is {ratio:.2g} times that of {quiet}. Each run "
                "is weighted with its own. Find out why, and whether more than noise differs."
            )
        if timing := found_timing(view):
            shown, done = "the noise follows the slope of the signal", "Rows are weighted"
            if any(one.share > 0.0 for one in view.series):
                shown, done = "angle and signal err together", "Times are corrected by the angle"
            yield (
                f"{view.name}: {shown}, as if the time stamps scattered by {timing * 1e6:.2g} us. "
                f"{done} accordingly. If the time stamps do scatter, state it as timing in [noise]."
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
                f"{name}: {share:.0%} of u^2 of K_II comes from white noise of the accelerometer "
                "that the records neither show nor exclude. If it is known, even as zero, state "
                "it as acceleration in [noise]; otherwise record longer runs."
            )

"""Tests of the residuals against the noise, and remarks on the noise."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Final

import numpy as np

from counterspin.arrays import median
from counterspin.calibration.checks.readings import TRIAD, pose_findings, readings_fit
from counterspin.calibration.findings import equivalent_deviations, lack_of_fit
from counterspin.calibration.joint_problem import AccelerometerView
from counterspin.calibration.outcome import found_timing, residual
from counterspin.calibration.result_parts import Finding
from counterspin.inference.diagnostics import CHI_SQUARE_SIGNIFICANCE, FALSE_ALARMS
from counterspin.inference.distributions import chi_square_tail
from counterspin.inference.joint.agreement import slow_parts
from counterspin.inference.joint.fit import relax
from counterspin.inference.linear_readings import Readings
from counterspin.reports.numbers import format_number

#: Noise that is smaller than stated by this factor is worth a remark.
_OVERSTATED: Final = 1.1

#: Fewest degrees of freedom by which the size of residuals is compared with the stated noise.
_FEWEST_FOR_SIZE: Final = 0.5

#: Share of u^2 above which noise that the records do not show is mentioned.
_HIDDEN_SHARE: Final = 0.5


def residual_findings(view: AccelerometerView) -> list[Finding]:
    """Return what the tests of an accelerometer's residuals found: one finding for all records."""
    findings = [*readings_fit(view), *pose_findings(view.fit, view.poses)]
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


def overstated_noise(views: Sequence[AccelerometerView]) -> Iterator[str]:
    """Yield a remark for each group of readings or poses that scatters less than is stated.

    u is then too large, which speaks against nothing.
    """
    stated = {id(part.readings): part for view in views for part in view.parts if part.stated}
    for part in stated.values():
        scale, dof = part.linear.moments_of_noise(views[0].fit.solution)
        if dof < _FEWEST_FOR_SIZE:
            continue
        squares = float(np.sum((part.residuals / part.sigma) ** 2))
        times = math.sqrt(squares / (scale * dof))
        p = 1.0 - chi_square_tail(dof, squares / scale)
        if p >= CHI_SQUARE_SIGNIFICANCE / len(stated) or times * _OVERSTATED > 1.0:
            continue
        u = median(part.sigma)
        shown, said = (f"{format_number(1e6 * size, 2)} ug" for size in (times * u, u))
        name = part.readings.accelerometer if isinstance(part.readings, Readings) else TRIAD
        yield (
            f"{name}: the {part.words} scatter by {shown}, {format_number(times, 2)} times "
            f"the stated uncertainty of {said}. u is too large. "
            "State the noise of single readings, and errors that all of them share as priors."
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

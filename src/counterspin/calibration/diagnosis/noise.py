"""Tests whether residuals agree with the stated or estimated noise, in all or some runs."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Final

from counterspin.calibration.result_parts import Finding
from counterspin.calibration.view import AccelerometerView
from counterspin.campaign.settings import OBSERVABLES
from counterspin.inference.diagnostics import CHI_SQUARE_SIGNIFICANCE, SIGNIFICANCE
from counterspin.inference.joint.estimation import Estimate
from counterspin.inference.joint.fit import solve_joint
from counterspin.inference.joint.uneven_noise import noise_by_run
from counterspin.reports.numbers import format_number

#: Noise of a run that is so many times the stated one, or less by as much, is another one.
_OTHER_NOISE: Final = 1.1


#: Runs that a finding names.
_MOST_NAMED: Final = 3


def with_noise_by_run(
    views: Sequence[AccelerometerView], now: Estimate
) -> tuple[Estimate, list[Finding]]:
    """Weigh each run with its own noise where the stated one is that of some runs only.

    What a noisy run does by chance is no jump of its record. Its noise is taken from third
    differences, in which nothing else shows.
    """
    stated = [v.name for v in views if v.has_records and not v.problem.noise[v.name].wanted]
    sizes = {name: noise_by_run(now.fit, name) for name in stated}
    sizes = {name: runs for name, runs in sizes.items() if _other(runs)}
    if not sizes:
        return now, []
    weighed = [
        replace(part, series=part.series.louder(sizes.get(part.accelerometer, {})))
        for part in now.fit.prepared
    ]
    others = now.fit.observations[len(weighed) :]
    fit = solve_joint((*weighed, *others), now.fit.model, now.fit.noise)
    return replace(now, fit=fit), [_finding(name, runs) for name, runs in sizes.items()]


def _other(runs: Mapping[str, float]) -> list[str]:
    """Return the runs whose noise is another one than stated, the furthest off first."""
    off = [run for run, size in runs.items() if not 1.0 / _OTHER_NOISE < size < _OTHER_NOISE]
    return sorted(off, key=lambda run: -abs(math.log(runs[run])))


def _finding(name: str, runs: Mapping[str, float]) -> Finding:
    off = _other(runs)
    times = [f"{format_number(runs[run], 2)} times" for run in off[:_MOST_NAMED]]
    times[0] += " the stated one"
    own = ", ".join(f"{size} in {run}" for size, run in zip(times, off, strict=False))
    rest = ", and as stated in the others" if len(off) < len(runs) else ""
    text = (
        f"The noise of {name} is {own}{rest}, by the differences between adjacent rows. Find out "
        "why, or leave it out of [noise]: each run is then weighted with its own."
    )
    size = max(max(one, 1.0 / one) for one in runs.values())
    return Finding(code="wrong-noise", subject=name, text=text, size=size)


def wrong_noise(view: AccelerometerView) -> Iterator[Finding]:
    """Yield that the noise is stated wrongly, where nothing else is wrong with it.

    Residuals of another size than the noise, alike in every run and independent of each other.
    """
    tests, name, fits = view.diagnostics, view.name, len(view.campaign.accelerometers)
    p = tests.lack_of_fit_p
    if CHI_SQUARE_SIGNIFICANCE / fits < p < 1.0 - CHI_SQUARE_SIGNIFICANCE / fits:
        return
    ratio, least = tests.chi2 / tests.dof, SIGNIFICANCE / (3.0 * len(tests.runs))
    for run in tests.runs.values():
        off = (run.chi2 / ratio - run.dof) / math.sqrt(2.0 * run.dof)
        if min(run.sign_p, run.peak_p, math.erfc(abs(off) / math.sqrt(2.0))) < least:
            return
    times = math.sqrt(ratio)
    white, unit = view.fit.noise[name].white, OBSERVABLES[view.accelerometer.observable]
    shown = f", {format_number(times * white, 3)} {unit}," if white > 0.0 else ""
    text = (
        f"Noise {format_number(times, 4)} times as large as stated{shown} would fit: the residuals "
        "have this size in every run and are independent of each other. Check the stated noise, "
        "or have it estimated."
    )
    yield Finding(code="wrong-noise", subject=name, text=text, size=max(times, 1.0 / times))

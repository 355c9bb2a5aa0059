"""What speaks against readings: residuals that are no noise, positions off, records of outliers.

- `readings_fit`: residuals that are not noise
- `outlying_readings`: positions that stand out; `outliers_of_means`: records that lost many rows
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

from counterspin.calibration.diagnosis.record_counts import counts_of, many_outliers
from counterspin.calibration.findings import CONTRADICTION_SIGMAS, lack_of_fit
from counterspin.calibration.readings import AccelerometerReadings, residual_of
from counterspin.calibration.result_parts import Finding
from counterspin.inference.diagnostics import SIGNIFICANCE

#: Up to so many positions that are off may each be a mistake. More, and more than this share of
#: all, point to the model.
_MAX_LONE_POSITIONS: Final = 3
_MAX_LONE_SHARE: Final = 0.25


def readings_fit(name: str, parts: Sequence[AccelerometerReadings]) -> list[Finding]:
    """Return a finding for each motion whose residuals are not noise.

    Noise that was stated is what they are compared with; noise that was estimated shows a misfit
    where positions were read more than once.
    """
    findings = []
    for part in parts:
        stated = math.isinf(part.dof)
        residual = residual_of([part])
        p = residual.lack_of_fit_p if stated else part.misfit_of_positions
        if p is None or p >= SIGNIFICANCE:
            continue
        said = (
            f"The residuals of the {part.words} are not the noise that was stated"
            if stated
            else f"Positions of the {part.words} are further off the model than repeats of one "
            "position are from each other"
        )
        findings.append(lack_of_fit(name, [f"{said} (p = {p:.2g})."], residual))
    return findings


def outlying_readings(name: str, parts: Sequence[AccelerometerReadings]) -> list[Finding]:
    """Return a finding for each position that stands out, or one where many of a motion do."""
    findings = []
    for part in parts:
        far_off = part.outlying()
        if len(far_off) <= max(_MAX_LONE_POSITIONS, _MAX_LONE_SHARE * part.readings.size):
            findings += [_outlying(part, name, *one) for one in far_off]
            continue
        worst = max(far_off, key=lambda one: abs(one[2]))
        finding = _outlying(part, name, *worst)
        text = (
            f"{len(far_off)} of {part.readings.size} {part.words} are off the model: so many "
            f"point to the model and not to single readings. {finding.text}"
        )
        findings.append(finding.model_copy(update={"text": text}))
    return findings


def _outlying(
    part: AccelerometerReadings, name: str, reading: str, residual: float, z: float
) -> Finding:
    return Finding(
        code="outlying-reading",
        subject=f"{name}.{reading}",
        text=f'The position "{reading}" reads {residual * 1e6:+.3g} ug off the model, '
        f"{abs(z):.1f} of its standard deviations: look at it, or at what the model lacks.",
        size=abs(z),
        contradicts=abs(z) > CONTRADICTION_SIGMAS and math.isinf(part.dof),
    )


def outliers_of_means(name: str, parts: Sequence[AccelerometerReadings]) -> list[Finding]:
    """Return a finding for each record whose mean is a reading and that lost many rows."""
    return [
        finding
        for part in parts
        for reading, mean in part.means.items()
        for finding in many_outliers(f"{name}.{reading}", counts_of(mean.report))
    ]

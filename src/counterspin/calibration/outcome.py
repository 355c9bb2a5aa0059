"""What a method has found, as the result states it; what each run showed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field

from counterspin.calibration.diagnosis.causes import Cause
from counterspin.calibration.diagnosis.record_counts import counts_of, rejected_of
from counterspin.calibration.notebook.residuals import RunResiduals
from counterspin.calibration.observed import ObservedRun
from counterspin.calibration.result_parts import (
    AccelerometerResult,
    Coefficient,
    Correlation,
    Finding,
    Knowledge,
    ParabolaResult,
    RippleResult,
    RunResult,
    TriadResult,
)
from counterspin.frozen import frozen
from counterspin.inference.identifiability import ConfoundedTerms
from counterspin.inference.joint.unknowns import ROTATION


@frozen
class Outcome:
    """What a method has found; attributes are those of `Result`, but for the last three."""

    model: str
    accelerometers: dict[str, AccelerometerResult]
    runs: dict[str, RunResult]
    platform: dict[str, Coefficient] = field(default_factory=dict)
    triad: TriadResult | None = None
    confounded: list[ConfoundedTerms] = field(default_factory=list)
    correlation: Correlation | None = None
    rests_on: list[Knowledge] = field(default_factory=list)
    findings: list[Finding] = field(default_factory=list)
    causes: tuple[Cause, ...] = ()  #: What may be behind a misfit, the likeliest first.
    remarks: tuple[str, ...] = ()  #: What the result warns of, beside the campaign's own remarks.
    residuals: tuple[RunResiduals, ...] = ()  #: Whole ones, which no file keeps.


def run_result(
    run: ObservedRun,
    *,
    parabolas: Mapping[str, ParabolaResult] | None = None,
    terms: Mapping[str, Coefficient] | None = None,
    fit: Mapping[str, dict[str, float | str | None]] | None = None,
    outliers: int = 0,
) -> RunResult:
    """Return what one run showed of its rotation and its samples."""
    rotation, report = run.rotation, run.record.report
    spindle, own = run.trajectory.spindle, dict(terms or {})
    # Where no angle was recorded the joint fit has found the rotation.
    rotation_terms = {symbol: own.pop(symbol) for symbol in ROTATION if symbol in own}
    _, rate, drift = (rotation_terms.get(symbol) for symbol in ROTATION)
    counts = counts_of(report, outliers)
    ripples = [
        RippleResult(
            harmonic=ripple.harmonic,
            amplitude=ripple.amplitude,
            u_amplitude=u_amplitude,
            phase=ripple.phase,
            u_phase=u_phase,
        )
        for ripple, (u_amplitude, u_phase) in zip(
            spindle.ripples, rotation.u_ripples if rotation else (), strict=True
        )
    ]
    return RunResult(
        rate=rate.value if rate and rate.value is not None else spindle.rate,
        u_rate=rotation.u_rate if rotation else rate.u if rate else None,
        drift=drift.value if drift and drift.value is not None else spindle.drift,
        u_drift=rotation.u_drift if rotation else drift.u if drift else None,
        ripples=ripples,
        angle_rms=rotation.rms if rotation else None,
        samples=report.used,
        rejected=rejected_of(counts),
        counts=counts,
        notes=report.notes(),
        parabolas=dict(parabolas or {}),
        terms=own,
        fit=dict(fit or {}),
    )

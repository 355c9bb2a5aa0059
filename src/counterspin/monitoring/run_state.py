"""What one run shows: in numbers, and what is wrong with it in sentences."""

from __future__ import annotations

import math
from collections.abc import Sequence

from counterspin.calibration.assembly import COMPLETE_PART, RATE_DIFFERENCE
from counterspin.calibration.diagnosis.record_counts import OUTLIER_SHARE
from counterspin.calibration.joint_view import AccelerometerView
from counterspin.calibration.observed import ObservedRun
from counterspin.campaign.description import Campaign
from counterspin.campaign.noise_at_rest import said_noise
from counterspin.campaign.settings import OBSERVABLES
from counterspin.inference.diagnostics import CHI_SQUARE_SIGNIFICANCE
from counterspin.monitoring.observer import record_name
from counterspin.monitoring.result import ResidualState, RunState


def run_state(
    campaign: Campaign, observed: ObservedRun, views: Sequence[AccelerometerView]
) -> RunState:
    """Return what a run shows.

    views: A fit with it, as each accelerometer sees it; empty if there is none.
    """
    run, report, rotation = observed.run, observed.record.report, observed.rotation
    spindle = observed.trajectory.spindle
    ripple = max(spindle.ripples, key=lambda r: abs(r.amplitude), default=None)
    time = observed.record.time
    return RunState(
        run=run.name,
        record=record_name(run.record, campaign.folder),
        state="read",
        rows=report.rows,
        seconds=float(time[-1] - time[0]),
        stated_seconds=run.duration,
        sampling_rate=1.0 / report.step,
        repeated=report.repeated,
        empty=sum(report.empty.values()),
        outliers=sum(report.outliers.values()),
        gaps=report.gap_count,
        longest_gap=max((gap.length for gap in report.gaps), default=0.0),
        rate=spindle.rate if rotation else None,
        u_rate=rotation.u_rate if rotation else None,
        nominal_rate=run.rate,
        drift=spindle.drift if rotation else None,
        ripple=abs(ripple.amplitude) if ripple else None,
        harmonic=ripple.harmonic if ripple else None,
        angle_rms=rotation.rms if rotation else None,
        residuals={
            view.name: state
            for view in views
            if (state := _residuals(campaign, view, run.name)) is not None
        },
    )


def _residuals(campaign: Campaign, view: AccelerometerView, run: str) -> ResidualState | None:
    tests = view.diagnostics.runs.get(run)
    if tests is None:
        return None
    squares = rows = 0.0
    for _, prepared, residuals in view.records():
        if prepared.run == run:
            squares += float((residuals.plain**2 * prepared.series.count).sum())
            rows += residuals.plain.size
    observable = view.accelerometer.observable
    stated = getattr(said_noise(campaign)[view.name].sizes, observable, None)
    return ResidualState(
        rms=math.sqrt(squares / rows),
        stated=stated if isinstance(stated, float) and stated > 0.0 else None,
        ratio=math.sqrt(tests.chi2 / tests.dof),
        p=tests.chi2_p if view.diagnostics.noise_given else None,
        unit=OBSERVABLES[observable],
    )


def remarks_of(
    state: RunState, notes: Sequence[str], views: Sequence[AccelerometerView]
) -> tuple[list[str], bool]:
    """Return what is odd about a run, in sentences, and whether it may be kept as it is."""
    wrong, odd = list[str](), list[str]()
    if state.rate is not None:
        part = state.rate / state.nominal_rate - 1.0
        if abs(part) > RATE_DIFFERENCE:
            wrong.append(
                f"The spindle turned at {state.rate:.6f} rad/s, not at the nominal "
                f"{state.nominal_rate:.6f} rad/s ({part:+.2%})."
            )
    if state.stated_seconds and state.seconds < COMPLETE_PART * state.stated_seconds:
        wrong.append(
            f"The record lasts {state.seconds:.4g} s, the campaign states "
            f"{state.stated_seconds:.4g} s."
        )
    if state.outliers > OUTLIER_SHARE * max(state.rows, 1) * max(len(views), 1):
        wrong.append(f"{state.outliers} of {state.rows} samples are outliers.")
    for view in views:
        found = [f"{view.name}: {text}" for text in view.diagnostics.findings]
        p = view.diagnostics.lack_of_fit_p if view.diagnostics.noise_given else None
        (wrong if p is not None and p < CHI_SQUARE_SIGNIFICANCE else odd).extend(found)
    return [*wrong, *odd, *notes], not wrong

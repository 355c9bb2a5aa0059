"""A record of poses, judged by itself, and which further poses would tell most."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np

from counterspin.calibration.diagnosis.pose_findings import pose_findings
from counterspin.calibration.model import model_of
from counterspin.calibration.posed.found_poses import FoundPose
from counterspin.campaign.description import Campaign
from counterspin.campaign.triads.declared import PoseRecord
from counterspin.campaign.triads.grouped import one_group
from counterspin.inference.poses import TriadPoses
from counterspin.monitoring.goals import FitSoFar
from counterspin.monitoring.observer import record_name
from counterspin.monitoring.result import PosesState, RunState
from counterspin.physics.terms import TERMS
from counterspin.planning.readings.stations import every_up, pointing_up, words_of_up

#: What is known of a combination of which no pose tells anything, in poses: next to nothing.
_NEXT_TO_NOTHING: Final = 1e-9

#: Most directions that are named; a triad of which nothing is known takes nine.
_MOST_MISSING: Final = 12


def poses_state(
    campaign: Campaign, record: PoseRecord, found: Sequence[FoundPose], fit: FitSoFar | None
) -> RunState:
    """Return what a record of poses shows.

    found: Its poses, at least one.
    fit: With it; None if there is none.
    """
    whole = found[0].record
    assert whole is not None
    poses, report = whole.poses, whole.report
    own = {one.pose[0].name for one in found}
    left = [size for name, size in _left(fit) if name in own] if fit else []
    return RunState(
        run=record.name,
        record=record_name(record.record, campaign.folder),
        state="read",
        rows=report.rows,
        seconds=float(poses.time[-1] - poses.time[0]),
        sampling_rate=1.0 / report.step,
        repeated=report.repeated,
        empty=sum(report.empty.values()),
        outliers=sum(report.outliers.values()),
        gaps=report.gap_count,
        longest_gap=max((gap.length for gap in report.gaps), default=0.0),
        nominal_rate=0.0,
        poses=PosesState(
            count=len(found),
            threshold=poses.threshold,
            rms=campaign.gravity.value * float(np.sqrt(np.mean(np.square(left)))) if left else None,
            outlying=[
                name
                for part in (fit.posed if fit else ())
                for name, _, _ in part.outlying()
                if name in own
            ],
            missing=missing_directions(campaign, found, fit),
        ),
    )


def remarks_of_poses(found: Sequence[FoundPose], fit: FitSoFar | None) -> tuple[list[str], bool]:
    """Return what is odd about a record of poses, in sentences, and whether it may be kept."""
    whole = found[0].record
    assert whole is not None
    findings = pose_findings(fit.estimate.fit, fit.posed) if fit else []
    odd = [*whole.poses.doubts, *whole.poses.left_out, *whole.report.notes()]
    may_be_kept = not any(finding.contradicts for finding in findings)
    return [*(finding.text for finding in findings), *odd], may_be_kept


def missing_directions(
    campaign: Campaign, found: Sequence[FoundPose], fit: FitSoFar | None
) -> list[str]:
    """Return the directions in which one pose would say more than all that are there together.

    The most telling comes first, each further one beside those before it. Nine poses that are as
    good as nine can be leave none: in no direction is |f| known worse than by one pose (Kiefer and
    Wolfowitz, Canadian J. Math. 12 (1960) 363).
    """
    model = fit.estimate.fit.model if fit else model_of(campaign)
    point = fit.estimate.fit.solution.estimate if fit else np.zeros(len(model.unknowns))
    group = one_group(campaign, [one.pose for one in found])
    ups = every_up(group.accelerometers)
    known = [
        {
            u.symbol: u.nominal + float(value)
            for u, value in zip(model.unknowns, point, strict=True)
            if u.owner == name and u.symbol in TERMS
        }
        for name in group.accelerometers
    ]
    further = pointing_up(one_group(campaign, [found[0].pose] * len(ups)), ups, known)
    asked = [place for place, u in enumerate(model.asked) if u.owner in group.accelerometers]
    rows = group.linearised(model, point).design[:, asked]
    possible = further.linearised(model, point).design[:, asked]
    information = rows.T @ rows + _NEXT_TO_NOTHING * np.eye(len(asked))
    missing: list[str] = []
    while len(missing) < _MOST_MISSING:
        # u^2 of |f| in each direction over that of one pose.
        unknown = np.einsum("np,pn->n", possible, np.linalg.solve(information, possible.T))
        most = int(np.argmax(unknown))
        if unknown[most] <= 1.0:
            break
        missing.append(words_of_up(ups[most]))
        information += np.outer(possible[most], possible[most])
    return missing


def _left(fit: FitSoFar) -> Iterator[tuple[str, float]]:
    """Yield each pose's name, and by how much the size of its specific force is off, g."""
    model, point = fit.estimate.fit.model, fit.estimate.fit.solution.estimate
    for part in fit.posed:
        poses = part.readings
        assert isinstance(poses, TriadPoses)
        growth = poses.at(model, point).growth
        yield from zip(poses.names, (part.residuals / growth).tolist(), strict=True)

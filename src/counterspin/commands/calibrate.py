"""`counterspin calibrate`: from a campaign folder to the accelerometers' error coefficients.

- `calibrate`: read the campaign, observe its runs, estimate, say how sure
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Final, Literal, get_args

from counterspin._version import __version__
from counterspin.campaign.description import read_campaign
from counterspin.campaign.observed import ObservedRun, observe
from counterspin.campaign.resolved import Campaign
from counterspin.campaign.result import Result
from counterspin.campaign.result_parts import (
    Coefficient,
    Inputs,
    ParabolaResult,
    Provenance,
    RippleResult,
    RunResult,
)
from counterspin.commands.conformity import with_conformity
from counterspin.commands.joint import joint
from counterspin.commands.two_stage import TwoStageOptions, two_stage
from counterspin.errors import CampaignError
from counterspin.inference.joint import ROTATION

Method = Literal["joint", "two-stage"]

#: More outliers than this part of a run's samples are worth a warning.
_MANY_OUTLIERS: Final = 0.05

#: Bytes hashed at once.
_HASH_CHUNK: Final = 1 << 22


def calibrate(
    where: Path | str | Campaign,
    *,
    method: Method = "joint",
    options: TwoStageOptions | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Result:
    """Calibrate every accelerometer of a campaign.

    Parameters
    ----------
    where
        The campaign's folder, its ``campaign.toml``, or a campaign already read.
    method
        ``joint``: all samples of all records in one weighted fit; ``two-stage``: the paper's
        method, on one sample a revolution.
    options
        Of the two-stage method.
    progress
        Called with (runs read, runs in all).

    Returns
    -------
    Result
        Coefficients in g-units of the campaign's gravity.

    Raises
    ------
    CampaignError
        If the campaign file is missing or wrong, the method is unknown, or the joint method is
        given options of the other.
    RecordError
        If a record cannot be used.
    NotIdentifiableError
        If the records cannot determine the unknowns.
    """
    _refuse_mixed(method, options)
    campaign = where if isinstance(where, Campaign) else read_campaign(where)
    files = [campaign.path, *(run.record for run in campaign.runs)]
    # Checksums are taken beside the reading and the fit, on a core that those leave idle.
    with ThreadPoolExecutor(1) as beside:
        checksums = beside.map(_checksum, files)
        observed = _observed(campaign, progress)
        estimated = (
            _jointly(campaign, observed)
            if method == "joint"
            else _in_two_stages(campaign, observed, options or TwoStageOptions())
        )
        inputs = dict(zip((_name(campaign, file) for file in files), checksums, strict=True))
    estimated["warnings"] += _many_outliers(estimated["runs"], len(campaign.accelerometers))
    result = Result(
        method=method,
        title=campaign.title,
        inputs=Inputs(
            gravity=campaign.gravity.value,
            latitude=campaign.latitude.value,
            radius=campaign.radius.value,
        ),
        details=dict(campaign.details),
        provenance=Provenance(
            version=__version__,
            inputs=inputs,
            options=[]
            if method == "joint"
            else ["--method=two-stage", *(options or TwoStageOptions()).words()],
        ),
        **estimated,
    )
    if campaign.specifications is None:
        return result
    return with_conformity(result, campaign.specifications)


def _refuse_mixed(method: str, options: TwoStageOptions | None) -> None:
    """Refuse what would be passed over in silence: half of K_II is at stake."""
    if method not in get_args(Method):
        known = " or ".join(get_args(Method))
        raise CampaignError("calibrate", [f"method: {method!r} is not {known}"])
    if method == "joint" and options not in (None, TwoStageOptions()):
        raise CampaignError(
            "calibrate",
            [
                "the joint method has no model to choose, no sigma, bias, ripple or weights of "
                "its own; with these options say --method two-stage"
            ],
        )


def _jointly(campaign: Campaign, observed: Sequence[ObservedRun]) -> dict[str, Any]:
    outcome = joint(campaign, observed)
    return {
        "model": "exact",
        "accelerometers": outcome.accelerometers,
        "platform": outcome.platform,
        "confounded": outcome.confounded,
        "runs": {
            run.run.name: run_result(
                run,
                terms=outcome.runs[run.run.name],
                fit=outcome.fits[run.run.name],
                outliers=outcome.outliers[run.run.name],
            )
            for run in observed
        },
        "warnings": [*campaign_warnings(campaign, observed), *outcome.warnings],
    }


def _in_two_stages(
    campaign: Campaign, observed: Sequence[ObservedRun], options: TwoStageOptions
) -> dict[str, Any]:
    outcomes = {
        name: two_stage(campaign, observed, accelerometer, options)
        for name, accelerometer in campaign.accelerometers.items()
    }
    return {
        "model": options.model,
        "accelerometers": {name: outcome.result for name, outcome in outcomes.items()},
        "runs": {
            run.run.name: run_result(
                run,
                parabolas={
                    name: outcome.parabolas[run.run.name] for name, outcome in outcomes.items()
                },
            )
            for run in observed
        },
        "warnings": campaign_warnings(campaign, observed),
    }


def _observed(
    campaign: Campaign, progress: Callable[[int, int], None] | None
) -> tuple[ObservedRun, ...]:
    observed = []
    for run in observe(campaign):
        observed.append(run)
        if progress is not None:
            progress(len(observed), len(campaign.runs))
    return tuple(observed)


def _name(campaign: Campaign, file: Path) -> str:
    """Return a file's name as the campaign knows it: relative to its folder where it can be."""
    try:
        return file.relative_to(campaign.folder).as_posix()
    except ValueError:
        return str(file)


def _checksum(file: Path) -> str:
    digest = hashlib.sha256()
    try:
        with file.open("rb") as stream:
            while chunk := stream.read(_HASH_CHUNK):
                digest.update(chunk)
    except OSError:
        # Reading the record says what is wrong with the file, and says it better.
        return "unreadable"
    return f"sha256:{digest.hexdigest()}"


def run_result(
    run: ObservedRun,
    *,
    parabolas: Mapping[str, ParabolaResult] | None = None,
    terms: Mapping[str, Coefficient] | None = None,
    fit: Mapping[str, dict[str, float | str | None]] | None = None,
    outliers: int = 0,
) -> RunResult:
    """Return what one run showed of its rotation and its samples.

    Parameters
    ----------
    run
        The run.
    parabolas
        Its first stages, by accelerometer.
    terms
        The terms that belong to the run itself, such as its tilt.
    fit
        Tests of its residuals, by accelerometer.
    outliers
        How many samples the fit has left out beside those that reading has.
    """
    rotation, report = run.rotation, run.record.report
    spindle, own = run.trajectory.spindle, dict(terms or {})
    # Where no angle was recorded the joint fit has found the rotation.
    found = {symbol: own.pop(symbol) for symbol in ROTATION if symbol in own}
    _, rate, drift = (found.get(symbol) for symbol in ROTATION)
    outliers += sum(report.outliers.values())
    empty = sum(report.empty.values())
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
        rejected=report.repeated + empty + outliers,
        counts={
            "rows": report.rows,
            "repeated": report.repeated,
            "empty": empty,
            "outliers": outliers,
            "gaps": report.gap_count,
            "block": report.block,
        },
        notes=report.notes(),
        parabolas=dict(parabolas or {}),
        terms=own,
        fit=dict(fit or {}),
    )


def _many_outliers(runs: Mapping[str, RunResult], accelerometers: int) -> list[str]:
    return [
        f"{name}: {run.counts['outliers']} samples of {run.counts['rows'] * accelerometers} were "
        "left out as outliers; what remains is only as good as the reason for it. Look at the "
        "record."
        for name, run in runs.items()
        if run.counts["outliers"] > _MANY_OUTLIERS * run.counts["rows"] * accelerometers
    ]


def campaign_warnings(campaign: Campaign, observed: Sequence[ObservedRun]) -> list[str]:
    """Return what a user should know of the campaign as a whole."""
    warnings = []
    if campaign.angle is None:
        warnings.append(
            "The records have no angle: the nominal rates are taken for the rotation, and the "
            "drift of the rate is an unknown."
        )
    for run in observed:
        if run.rotation is None:
            continue
        rate = run.rotation.spindle.rate
        if abs(rate / run.run.rate - 1.0) > 1e-3:
            warnings.append(
                f"{run.run.name}: the spindle turned at {rate:.6f} rad/s, not at the nominal "
                f"{run.run.rate:.6f} rad/s; the recorded angle is what counts."
            )
    return warnings

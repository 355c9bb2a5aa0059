"""`counterspin calibrate`: from a campaign folder to the accelerometers' error coefficients.

- `calibrate`: read the campaign, observe its runs, estimate, say how sure
"""

from __future__ import annotations

import hashlib
import os
import sys
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Final, get_args

from counterspin.campaign.description import read_campaign
from counterspin.campaign.observed import ObservedRun, observe
from counterspin.campaign.resolved import Campaign
from counterspin.commands.method import Method, TwoStageOptions
from counterspin.errors import CampaignError

if TYPE_CHECKING:
    from counterspin.campaign.result import Result

#: Niceness of the thread that takes checksums.
_BEHIND: Final = 10


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
    with ThreadPoolExecutor(2) as beside:
        checksums = beside.submit(_checksums, campaign)
        beside.submit(_load)
        observed = _observed(campaign, progress)
        from counterspin.commands.calibration import calibration

        return calibration(
            campaign, observed, method, options or TwoStageOptions(), checksums.result
        )


def _load() -> None:
    """Load beside the first record what the reading needs, then what comes after it."""
    for name in ("polars", "counterspin.commands.calibration"):
        import_module(name)


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


def _observed(
    campaign: Campaign, progress: Callable[[int, int], None] | None
) -> tuple[ObservedRun, ...]:
    observed = []
    for run in observe(campaign):
        observed.append(run)
        if progress is not None:
            progress(len(observed), len(campaign.runs))
    return tuple(observed)


def _checksums(campaign: Campaign) -> dict[str, str]:
    """Return file name -> checksum, of the description and of every record."""
    if sys.platform == "linux":
        # Nothing waits for a checksum before the end: what reads and fits goes first.
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _BEHIND)
    files = [campaign.path, *(run.record for run in campaign.runs)]
    return {_name(campaign, file): _checksum(file) for file in files}


def _name(campaign: Campaign, file: Path) -> str:
    """Return a file's name as the campaign knows it: relative to its folder where it can be."""
    try:
        return file.relative_to(campaign.folder).as_posix()
    except ValueError:
        return str(file)


def _checksum(file: Path) -> str:
    try:
        with file.open("rb", buffering=0) as stream:
            digest = hashlib.file_digest(stream, "sha256")
    except OSError:
        # Reading the record says what is wrong with the file, and says it better.
        return "unreadable"
    return f"sha256:{digest.hexdigest()}"

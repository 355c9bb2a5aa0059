"""Runs in another attitude that would reduce the uncertainty of a campaign that is recorded."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from counterspin.calibration.observed import ObservedRun
from counterspin.campaign.attitude import attitude_rows
from counterspin.campaign.description import Campaign
from counterspin.campaign.memory.source import source_of
from counterspin.campaign.runs import Run
from counterspin.errors import NotIdentifiableError
from counterspin.frozen import frozen
from counterspin.inference.noise.model import Noise
from counterspin.planning.forecast import forecast
from counterspin.planning.recorded.from_records import as_recorded, rates_of
from counterspin.workers import one_blas_thread

#: Attitudes that a double turntable is easily set to.
_ATTITUDES: Final = (
    "90 deg about east",
    "90 deg about north",
    "180 deg about east",
    "180 deg about north",
)

#: Runs are worth their time if they leave less than this part of what fewer of them would.
_WORTH: Final = 0.8


@frozen
class FurtherRuns:
    """Runs to be added, and what they would give."""

    attitude: str  #: Of all of them.
    runs: list[dict[str, Any]]  #: As in ``[[runs]]``.
    seconds: float  #: That their records take.
    u: float  #: Standard uncertainty of the coefficient then.
    u_now: float  #: And without them, by the same forecast.


@one_blas_thread()
def further_runs(
    campaign: Campaign, observed: Sequence[ObservedRun], noise: Mapping[str, Noise], name: str
) -> FurtherRuns | None:
    """Return the cheapest runs in another attitude that help a coefficient; None if none does.

    campaign: As it was read, all of its runs with records.
    noise: By accelerometer, as it was found.
    name: Of the coefficient, such as ``Qx.K_II``.
    """
    if not campaign.runs:
        return None
    rates = rates_of(observed)

    def u_of(runs: Sequence[dict[str, Any]]) -> float:
        described = list(source_of(campaign).document["runs"])
        changed = campaign.change(runs=[*described, *runs]) if runs else campaign
        fastest = max(rates.values())
        sampled = {run.name: rates.get(run.name, fastest) for run in changed.runs}
        return forecast(as_recorded(changed, observed, noise), sampling_rate=sampled).u[name]

    now = u_of(())
    best: FurtherRuns | None = None
    for attitude, runs in _candidates(as_recorded(campaign, observed, noise)):
        seconds = sum(float(run["duration"].split()[0]) for run in runs)
        try:
            u = u_of(runs)
        except NotIdentifiableError:
            continue
        found = FurtherRuns(attitude, runs, seconds, u, now)
        longer = best is not None and seconds > best.seconds
        if u < _WORTH * now and (best is None or u < (_WORTH if longer else 1.0) * best.u):
            best = found
    return best


def _candidates(campaign: Campaign) -> Iterator[tuple[str, list[dict[str, Any]]]]:
    """Yield runs like those that there are, in other attitudes: the fastest, then all rates."""
    attitudes = [
        words
        for words in _ATTITUDES
        if not any(np.allclose(run.attitude, attitude_rows(words)) for run in campaign.runs)
    ]
    runs = sorted(campaign.runs, key=lambda run: -abs(run.rate))
    by_rate = list({run.rate: run for run in reversed(runs)}.values())[::-1]
    for chosen in ([runs[0]], by_rate)[: 1 + (len(by_rate) > 1)]:
        for words in attitudes:
            yield words, [_turned(campaign, run, words) for run in chosen]


def _turned(campaign: Campaign, run: Run, attitude: str) -> dict[str, Any]:
    """Return a run as it is described that repeats another one in an attitude."""
    taken = {other.name for other in campaign.runs}
    name = next(
        name
        for number in range(1, len(taken) + 2)
        if (name := f"{run.name} turned{'' if number == 1 else f' {number}'}") not in taken
    )
    return {
        "name": name,
        "rate": f"{run.rate:.9g} rad/s",
        "attitude": attitude,
        "duration": f"{run.duration:.6g} s",
        "record": f"{name.replace(' ', '-')}{Path(run.record).suffix}",
    }

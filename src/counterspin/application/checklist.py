"""Optional entries of a description that matter to its result, before a calibration."""

from __future__ import annotations

from collections.abc import Iterator

from counterspin.application.answers import ChecklistEntry
from counterspin.campaign.description import Campaign
from counterspin.physics.terms import COMMON_NAMES, TERMS


def checklist(campaign: Campaign) -> list[ChecklistEntry]:
    """Return the entries of a campaign's checklist; none of them blocks a calibration."""
    return list(_entries(campaign))


def _entries(campaign: Campaign) -> Iterator[ChecklistEntry]:
    for key, symbol in COMMON_NAMES.items():
        yield _prior_entry(campaign, key, symbol)
    if campaign.runs:
        stated = campaign.noise is not None
        effect = "stated (Type B)" if stated else "estimated from the residuals (Type A)"
        yield {"words": "Noise", "stated": stated, "effect": effect, "key": "noise"}
    unnumbered = [n for n, a in campaign.accelerometers.items() if not a.serial_number]
    effect = (
        f"not stated for {', '.join(unnumbered)}; the history and the certificate require this "
        "value"
    )
    first = next(iter([*unnumbered, *campaign.accelerometers]), "")
    yield {
        "words": "Serial number",
        "stated": not unnumbered,
        "effect": effect if unnumbered else "stated",
        "key": f"accelerometers.{first}.serial_number",
    }
    dated = "date" in campaign.details
    effect = "stated" if dated else "not stated; the history requires this value"
    yield {"words": "Date", "stated": dated, "effect": effect, "key": "campaign.date"}


def _prior_entry(campaign: Campaign, key: str, symbol: str) -> ChecklistEntry:
    """Return the entry of a coefficient that can have a prior."""
    unstated = [n for n, a in campaign.accelerometers.items() if symbol not in a.priors]
    owner = next(iter([*unstated, *campaign.accelerometers]), "")
    effect = "stated prior (Type B)"
    if unstated:
        effect = f"not stated for {', '.join(unstated)}; the data alone determine the value"
    words = TERMS[symbol].words
    return {
        "words": f"{words[:1].upper()}{words[1:]}",
        "stated": not unstated,
        "effect": effect,
        "key": f"accelerometers.{owner}.{key}",
    }

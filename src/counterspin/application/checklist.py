"""Checklist before a calibration: optional entries of a description that affect the result."""

from __future__ import annotations

from collections.abc import Iterator

from counterspin.application.answers import ChecklistEntry
from counterspin.campaign.description import Campaign
from counterspin.physics.terms import COMMON_NAMES, TERMS


def make_checklist(campaign: Campaign) -> list[ChecklistEntry]:
    """Return the entries of a campaign's checklist, which do not prevent a calibration."""
    return list(_iterate_entries(campaign))


def _iterate_entries(campaign: Campaign) -> Iterator[ChecklistEntry]:
    for key, symbol in COMMON_NAMES.items():
        yield _prior_entry(campaign, key, symbol)
    if campaign.runs:
        is_noise_stated = campaign.noise is not None
        effect = "stated (Type B)" if is_noise_stated else "estimated from the residuals (Type A)"
        yield {"words": "Noise", "stated": is_noise_stated, "effect": effect, "key": "noise"}
    names_without_serial = [n for n, a in campaign.accelerometers.items() if not a.serial_number]
    effect = (
        f"not stated for {', '.join(names_without_serial)}; the history and the certificate "
        "require this value"
    )
    first_name = next(iter([*names_without_serial, *campaign.accelerometers]), "")
    yield {
        "words": "Serial number",
        "stated": not names_without_serial,
        "effect": effect if names_without_serial else "stated",
        "key": f"accelerometers.{first_name}.serial_number",
    }
    has_date = "date" in campaign.details
    effect = "stated" if has_date else "not stated; the history requires this value"
    yield {"words": "Date", "stated": has_date, "effect": effect, "key": "campaign.date"}


def _prior_entry(campaign: Campaign, key: str, symbol: str) -> ChecklistEntry:
    """Return the entry of the prior of a coefficient."""
    unstated_names = [n for n, a in campaign.accelerometers.items() if symbol not in a.priors]
    owner = next(iter([*unstated_names, *campaign.accelerometers]), "")
    effect = "stated prior (Type B)"
    if unstated_names:
        effect = f"not stated for {', '.join(unstated_names)}; the data alone determine the value"
    description = TERMS[symbol].words
    return {
        "words": f"{description[:1].upper()}{description[1:]}",
        "stated": not unstated_names,
        "effect": effect,
        "key": f"accelerometers.{owner}.{key}",
    }

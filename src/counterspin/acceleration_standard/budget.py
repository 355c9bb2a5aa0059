"""`counterspin applied`: uncertainty budget of the applied acceleration by level."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from counterspin._version import __version__
from counterspin.acceleration_standard.model import (
    UNITS,
    applied_acceleration,
    draw_distributions,
    sensitivities,
)
from counterspin.acceleration_standard.result import (
    AppliedAcceleration,
    AppliedContribution,
    AppliedLevel,
    AppliedSource,
    MonteCarloCheck,
    Origin,
)
from counterspin.calibration.model import resolve_prior
from counterspin.campaign.description import Campaign, read_campaign
from counterspin.campaign.quantity import BARE_NUMBER, NUMBER, Quantity, parse_quantity
from counterspin.errors import CampaignError, UsageError

#: Default levels of a campaign without stated rates, g.
DEFAULT_LEVELS: Final = (1.0, 10.0, 50.0, 100.0)

#: Smallest number of draws: 1e4 / (1 - p) for p = 95 % (JCGM 101, clause 7.2.2).
MIN_DRAWS: Final = 200_000
_MAX_DRAWS: Final = 20_000_000

#: Largest level, g.
_MAX_LEVEL: Final = 1e5

#: Source of the model -> symbol in the table of terms. MOUNTING: name of the mounting.
_SYMBOLS: Final = {
    "radius": "centrifuge.radius",
    "stretch": "centrifuge.stretch",
    "elevation": "fixture.misalignment.MOUNTING.forward",
    "azimuth": "fixture.misalignment.MOUNTING.up",
    "droop": "centrifuge.droop",
    "rate": "centrifuge.rate",
    "clock": "centrifuge.clock",
    "gravity": "site.gravity",
    "latitude": "site.latitude",
}


#: Source of the model -> description.
_DESCRIPTIONS: Final = {
    "radius": "radius",
    "stretch": "stretch of the radius",
    "elevation": "elevation, static",
    "azimuth": "azimuth, static",
    "droop": "elevation, increase",
    "rate": "rate, random",
    "clock": "rate, clock",
    "gravity": "gravity",
    "latitude": "Earth rate and latitude",
}


def applied(
    campaign: Campaign | Path | str,
    levels: str | Sequence[float] | None = None,
    *,
    mounting: str | None = None,
    draws: int = MIN_DRAWS,
    seed: int = 1,
) -> AppliedAcceleration:
    """Return the uncertainty budget of the acceleration that an arm centrifuge applies.

    The sources are the radius and its stretch, the alignment and its change with the squared rate
    (droop), the rate and its clock, gravity, and latitude (Earth rate). A source without a stated
    uncertainty has the default uncertainty of its term.

    Parameters
    ----------
    campaign
        The campaign, its folder or its description.
    levels
        Nominal accelerations in g, or text such as "1,10,50,100g"; None: levels of the stated
        rates.
    mounting
        Mounting whose stated alignment counts; None if the campaign states only one.
    draws
        Number of Monte Carlo draws.
    seed
        Seed of the draws.

    Returns
    -------
    AppliedAcceleration
        Budget by the GUM and by Monte Carlo (JCGM 101) for each level.

    Raises
    ------
    CampaignError
        If the campaign has mistakes or no centrifuge, or if an argument is out of range.
    """
    if not MIN_DRAWS <= draws <= _MAX_DRAWS:
        raise UsageError(
            "applied", [f"`draws`: must be from {MIN_DRAWS} to {_MAX_DRAWS}, not {draws}"]
        )
    if seed < 0:
        raise UsageError("applied", [f"`seed`: must not be negative, not {seed}"])
    description = campaign if isinstance(campaign, Campaign) else read_campaign(campaign)
    if not description.radius.value > 0.0:
        raise CampaignError(
            str(description.path),
            ["centrifuge.radius: missing; the applied acceleration requires [centrifuge]"],
            code="missing-key",
        )
    mounting_name = _choose_mounting(description, mounting)
    sources = _resolve_sources(description, mounting_name)
    radius, gravity = description.radius.value, description.site.gravity
    rates = [] if levels is not None else _stated_rates(description)
    if not rates:
        nominal_levels = DEFAULT_LEVELS if levels is None else _parse_levels(levels, gravity)
        rates = [math.sqrt(level * gravity / radius) for level in nominal_levels]
    values = {source.name: source.value for source in sources}
    u = {source.name: source.u for source in sources}
    distributions = {
        name: quantity.distribution
        for name, quantity in _stated_quantities(description, mounting_name).items()
        if quantity is not None and quantity.distribution.shape != "normal"
    }
    checks = draw_distributions(values, u, rates, draws, seed, distributions)
    return AppliedAcceleration(
        title=description.title,
        version=__version__,
        gravity=gravity,
        mounting=mounting_name,
        draws=draws,
        seed=seed,
        applied_sources=sources,
        levels=[
            _make_level(values, u, rate, distribution)
            for rate, distribution in zip(rates, checks, strict=True)
        ],
    )


def _make_level(
    values: Mapping[str, float], u: Mapping[str, float], rate: float, check: MonteCarloCheck
) -> AppliedLevel:
    """Return acceleration, budget and Monte Carlo check at a rate."""
    derivatives = sensitivities(values, rate)
    acceleration = float(applied_acceleration(values, rate))
    contributions = {name: abs(derivatives[name]) * u[name] for name in UNITS}
    combined_u = math.hypot(*contributions.values())
    budget_lines = [
        AppliedContribution(
            source=name,
            sensitivity=derivatives[name],
            u=contribution,
            share=(contribution / combined_u) ** 2 if combined_u else 0.0,
        )
        for name, contribution in sorted(contributions.items(), key=lambda item: -item[1])
    ]
    return AppliedLevel(
        level=values["radius"] * rate**2 / values["gravity"],
        rate=rate,
        acceleration=acceleration,
        u=combined_u,
        u_relative=combined_u / abs(acceleration),
        dominant=budget_lines[0].source if combined_u else None,
        budget=budget_lines,
        monte_carlo=check,
    )


def _parse_levels(levels: str | Sequence[float], gravity: float) -> list[float]:
    """Return levels in g; CampaignError if one is not a positive acceleration."""
    texts = levels.split(",") if isinstance(levels, str) else [f"{level!r} g" for level in levels]
    unit = re.sub(rf"^\s*{NUMBER}\s*", "", texts[-1]) if texts else ""
    numbers, problems = [], []
    for text in map(str.strip, texts):
        text_with_unit = f"{text} {unit.strip() or 'g'}" if BARE_NUMBER.fullmatch(text) else text
        try:
            quantity = parse_quantity(text_with_unit, "g", gravity=gravity)
        except ValueError as error:
            problems.append(f'`levels`: "{text}": {error}')
            continue
        if quantity.u or not 0.0 < quantity.value <= _MAX_LEVEL:
            problems.append(
                f'`levels`: "{text}" must be an acceleration between 0 and {_MAX_LEVEL:g} g'
            )
        numbers.append(quantity.value)
    if problems or not numbers:
        raise UsageError(
            "applied", problems or ["`levels`: give one or more accelerations, such as 1,10g"]
        )
    return numbers


def _stated_rates(campaign: Campaign) -> list[float]:
    """Return the distinct rates of runs and readings by increasing magnitude, rad/s."""
    rates = {run.rate for run in campaign.runs} | {reading.rate for reading in campaign.readings}
    return sorted({rate for rate in rates if rate}, key=lambda rate: (abs(rate), rate))


def _choose_mounting(campaign: Campaign, mounting: str | None) -> str | None:
    """Return the mounting whose alignment counts; None if no alignment is stated."""
    aligned_mountings = [
        symbol.split(".")[2]
        for symbol in campaign.model.priors
        if symbol.startswith("fixture.misalignment.") and symbol.endswith((".forward", ".up"))
    ]
    names = list(dict.fromkeys(aligned_mountings))
    known_names = dict.fromkeys([*names, *(reading.mounting for reading in campaign.readings)])
    if mounting is not None:
        if mounting not in known_names:
            known_text = ", ".join(filter(None, known_names)) or "none"
            raise CampaignError(
                str(campaign.path),
                [f'`mounting`: unknown mounting "{mounting}"; known: {known_text}'],
                code="unknown-mounting",
            )
        return mounting
    alignments = {
        tuple(
            campaign.model.priors.get(_source_symbol(source, name))
            for source in ("elevation", "azimuth")
        )
        for name in names
    }
    if len(alignments) > 1:
        raise UsageError(
            str(campaign.path),
            [
                (
                    f"the mountings {', '.join(names)} have different stated alignments; select "
                    "one with `mounting`"
                )
            ],
        )
    return names[0] if names else None


def _source_symbol(source: str, mounting: str | None) -> str:
    return _SYMBOLS[source].replace("MOUNTING", mounting or "MOUNTING")


def _stated_quantities(campaign: Campaign, mounting: str | None) -> dict[str, Quantity | None]:
    """Return the sources as the campaign states them; None: not stated."""
    priors = campaign.model.priors
    inputs: dict[str, Quantity | None] = {
        "radius": campaign.radius,
        "gravity": campaign.gravity,
        "latitude": campaign.latitude,
        "clock": campaign.rate_clock or campaign.clock,
        "rate": _stated_rate_error(campaign),
    }
    return {name: inputs.get(name, priors.get(_source_symbol(name, mounting))) for name in UNITS}


def _resolve_sources(campaign: Campaign, mounting: str | None) -> list[AppliedSource]:
    """Return all sources with values and uncertainties, as stated or by default."""
    quantities, sources = _stated_quantities(campaign, mounting), []
    for name, unit in UNITS.items():
        symbol, quantity = _source_symbol(name, mounting), quantities[name]
        (value, u), is_default = resolve_prior(campaign, "", symbol, quantity)
        origin: Origin = "default" if is_default else "stated" if u else "assumed"
        sources.append(
            AppliedSource(
                name=name,
                symbol=symbol,
                words=_DESCRIPTIONS[name],
                value=value,
                u=u,
                unit=unit,
                origin=origin,
            )
        )
    return sources


def _stated_rate_error(campaign: Campaign) -> Quantity | None:
    """Return the largest stated random uncertainty of a rate, relative; None without any."""
    relative_uncertainties = [
        reading.u_rate / abs(reading.rate)
        for reading in campaign.readings
        if reading.rate and reading.u_rate is not None
    ]
    return Quantity(0.0, max(relative_uncertainties), "1") if relative_uncertainties else None

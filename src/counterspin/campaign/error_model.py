"""What is asked for, what is held, what is assumed to be perfect: [model], names resolved.

- `ErrorModel`
- `EVERYTHING`: the name of whatever is not stated
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from counterspin.campaign.quantity import Quantity
from counterspin.frozen import frozen

#: In ``assume``: whatever is not stated.
EVERYTHING: Final = "all"


@frozen
class ErrorModel:
    """Which terms are asked for, which are held, and which are taken as perfect.

    Everything else that acts is an unknown beside what is asked for.

    Attributes
    ----------
    terms
        Symbols asked for; bare names are resolved to the components that act.
    considered
        Symbols that are held: known but not adjusted, their prior's u is carried.
    priors
        Symbol of a shared term -> prior, SI (tilt: one of each run). Those of accelerometer terms
        are in `Accelerometer.priors`.
    limits, typical
        Symbol -> largest credible size, and standard uncertainty to assume where none is stated,
        in the table's unit: where the campaign states them. `Campaign.limit_of` and
        `Campaign.typical_of` know all.
    assume
        What is taken as perfect where nothing is stated: names, ``platform.*``, ``all``.
    """

    terms: tuple[str, ...]
    considered: tuple[str, ...]
    priors: Mapping[str, Quantity]
    limits: Mapping[str, float]
    typical: Mapping[str, float]
    assume: tuple[str, ...] = ()

    def assumes(self, symbol: str) -> bool:
        """Return whether a term, or an input, is taken as perfect where nothing is stated."""
        names = (name.removesuffix("*").removesuffix(".") for name in self.assume)
        return any(
            name in ("", EVERYTHING) or symbol == name or symbol.startswith(f"{name}.")
            for name in names
        )

"""What is asked for, what is held, what is assumed to be perfect: [model], names resolved."""

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
    """

    #: Symbols asked for; bare names are resolved to the components that act.
    terms: tuple[str, ...]
    #: Symbols that are held: known but not adjusted, their prior's u is carried.
    considered: tuple[str, ...]
    #: Symbol of a shared term -> prior, SI (tilt: one of each run). Those of accelerometer terms
    #: are in `Accelerometer.priors`.
    priors: Mapping[str, Quantity]
    #: Symbol -> largest credible size, and standard uncertainty to assume where none is stated, in
    #: the table's unit: where the campaign states them. `Campaign.limit_of` and
    #: `Campaign.typical_of` know all.
    limits: Mapping[str, float]
    typical: Mapping[str, float]
    #: What is taken as perfect where nothing is stated: names, ``platform.*``, ``all``.
    assume: tuple[str, ...] = ()

    def assumes(self, symbol: str) -> bool:
        """Return whether a term, or an input, is taken as perfect where nothing is stated."""
        names = (name.removesuffix("*").removesuffix(".") for name in self.assume)
        return any(
            name in ("", EVERYTHING) or symbol == name or symbol.startswith(f"{name}.")
            for name in names
        )

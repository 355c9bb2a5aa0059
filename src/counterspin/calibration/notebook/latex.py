r"""Symbols, numbers and units as LaTeX, for a formula of one's own paper."""

from __future__ import annotations

import re
from typing import Final

from counterspin.reports.blocks import escape_controls

_SPECIAL: Final = re.compile(r"([\\{}$&#^_~%])")


def latex_symbol(symbol: str) -> str:
    """Return a term's symbol in mathematics; names with dots are set as words."""
    letter, underscore, index = symbol.partition("_")
    if underscore and "." not in symbol and len(letter) == 1:
        return rf"{letter}_{{\mathrm{{{index}}}}}"
    return rf"\text{{{latex_text(symbol)}}}"


def latex_number(text: str) -> str:
    """Return a number such as ``2.70445(37)e-5`` in mathematics."""
    return re.sub(r"e([+-]?\d+)", r" \\times 10^{\1}", text)


def latex_unit(unit: str) -> str:
    """Return a unit such as ``ug/g^2`` in mathematics."""
    upright = re.sub(r"\^(-?\d+)", r"^{\1}", unit.replace(" ", r"\,")).replace("ug", r"\mu g")
    return rf"\mathrm{{{upright}}}"


def latex_text(text: str) -> str:
    """Return words with the characters escaped that LaTeX would act on."""
    named = {"\\": r"\textbackslash{}", "^": r"\^{}", "~": r"\~{}"}
    return _SPECIAL.sub(lambda found: named.get(found[1], rf"\{found[1]}"), escape_controls(text))

"""Elements of DCC and D-SI, of which a Digital Calibration Certificate is made.

Numbers are written with all digits of a double, so that a machine reads back what was computed;
`significantDigit` tells where they are to be rounded, and the words beside them are rounded.
"""

from __future__ import annotations

from base64 import b64encode
from typing import Any, Final

from lxml import etree

from counterspin.certificates.coverage import coverage_factor
from counterspin.inference.conformity import COVERAGE
from counterspin.physics.si_units import SiUnit
from counterspin.reports.characters import Lines, visible
from counterspin.reports.numbers import round_to_uncertainty

DCC: Final = "https://ptb.de/dcc"
SI: Final = "https://ptb.de/si"
NAMESPACES: Final = {"dcc": DCC, "si": SI}

#: Language of the text that counterspin writes.
ENGLISH: Final = "en"

Element = Any  # lxml carries no types
Child = Element | str | None


def dcc(tag: str, *children: Child, **attributes: str | None) -> Element:
    """Return an element of DCC; children and attributes that are None are left out."""
    return _element(DCC, tag, children, attributes)


def si(tag: str, *children: Child) -> Element:
    """Return an element of D-SI; children that are None are left out."""
    return _element(SI, tag, children, {})


def _element(
    space: str, tag: str, children: tuple[Child, ...], attributes: dict[str, str | None]
) -> Element:
    made = etree.Element(f"{{{space}}}{tag}", nsmap=NAMESPACES)
    for key, value in attributes.items():
        if value is not None:
            made.set(key, value)
    for child in children:
        if isinstance(child, str):
            made.text = (made.text or "") + clean(child)
        elif child is not None:
            made.append(child)
    return made


def clean(words: str) -> str:
    """Return text that XML can represent (clause 2.2) and no reader obeys, no blanks around it."""
    return visible(words).strip()


def text(tag: str, words: str, language: str = ENGLISH, **attributes: str | None) -> Element:
    """Return an element with text, such as a name."""
    return dcc(tag, dcc("content", words, lang=language), **attributes)


def rich(tag: str, *lines: str, language: str = ENGLISH) -> Element:
    """Return an element with paragraphs, a line each: a language has one content."""
    if not lines:
        return dcc(tag)
    return dcc(tag, dcc("content", Lines(*map(str.strip, lines)), lang=language))


def attached(tag: str, name: str, media_type: str, data: bytes, description: str) -> Element:
    """Return an element with a file."""
    return dcc(
        tag,
        rich("description", description),
        dcc("fileName", name),
        dcc("mimeType", media_type),
        dcc("dataBase64", b64encode(data).decode("ascii")),
    )


def number(value: float) -> str:
    """Write a number so that it reads back as the same double."""
    return repr(float(value))


def factor(value: float) -> str:
    """Write a coverage factor or probability, which must not have an exponent."""
    return f"{value:.4f}".rstrip("0").rstrip(".")


def real(
    value: float,
    unit: SiUnit | str,
    *,
    label: str | None = None,
    u: float | None = None,
    dof: float | None = None,
) -> Element:
    """Return a quantity with its expanded uncertainty.

    u: Standard uncertainty; None or 0: none is stated.
    dof: Its effective degrees of freedom; None is infinite.
    """
    digits = round_to_uncertainty(value, u) if u else None
    return si(
        "real",
        None if label is None else si("label", label),
        si("value", number(value)),
        si("unit", unit if isinstance(unit, str) else unit.text),
        None if digits is None else si("significantDigit", str(digits.place)),
        si("measurementUncertaintyUnivariate", _expanded(u, dof)) if u else None,
    )


def _expanded(u: float, dof: float | None) -> Element:
    k = coverage_factor(dof)
    return si(
        "expandedMU",
        si("valueExpandedMU", number(k * u)),
        si("coverageFactor", factor(k)),
        si("coverageProbability", factor(COVERAGE)),
        si("distribution", distribution(dof)),
    )


def distribution(dof: float | None) -> str:
    """Return the distribution of the coverage factor."""
    return "normal" if dof is None else "t"

"""Checks that estimates are credible for an instrument and small enough for first order.

With the sign of all readings reversed a fit is as good as before; only its K_I says that something
is wrong, near -1. So each estimate is compared with its largest credible size about what it ideally
is, three of its standard uncertainties allowed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Final

from counterspin.calibration.result_parts import (
    Coefficient,
    Finding,
    Knowledge,
)
from counterspin.physics.grades import GRADES
from counterspin.physics.terms import (
    ACCELEROMETER_TERMS,
    is_term,
    term,
)
from counterspin.reports.numbers import find_display_unit, format_estimate, format_number

#: An estimate may be beyond its largest credible size by so many of its standard uncertainties.
_MAX_SIGMAS: Final = 3.0

#: What is unstated may be so many times its typical size.
_MAX_DEFAULT_SDS: Final = 4.0

#: A scale factor is off by a unit that it is this near to, of its size; 9.8 is not 10.
_RATIO_TOLERANCE: Final = 0.01

_GRAVITY: Final = 9.80665  #: m/s^2

#: Powers of ten that a unit may be off by.
_POWERS: Final = (-9, -6, -4, -3, -2, -1, 1, 2, 3, 4, 6, 9)

#: The first of these that a symbol begins with says what is likely.
_LIKELY_CAUSES: Final = {
    "K_F.temperature": "the unit of the temperatures and their assignment to positions",
    "K_I.temperature": "the unit of the temperatures and their assignment to positions",
    "K_II.temperature": "the unit of the temperatures and their assignment to positions",
    "K_F.trend": "the start times of the runs and the unit of these times",
    "K_F": "the `zero` of the output, the zero of the attitude angles, and other common offsets",
    "delta_": "the zero and the sense of the attitude angles, and the axes",
    "K_": "the rates, the radius, and the linearity of the output at the largest specific force",
    "platform.tilt": "the attitudes and the input axes",
    "platform.": "the units of the records and the stated noise",
    "centrifuge.radius": "the radius and its unit",
    "centrifuge.": "the radius, the rates and their units",
    "fixture.": "the attitudes and axes of this mounting",
    "head.zero": "the zero of the dividing head and the positive sense of its angle",
    "encoder.": "the unit of the angle and the counts per revolution",
}


#: Symbol of a term and its accelerometer, empty of others' -> the largest credible size.
LimitFunction = Callable[[str, str], float]


def widest_limit(symbol: str, owner: str) -> float:  # noqa: ARG001 -- as campaigns answer
    """Return the largest credible size at any grade, for a result that does not say its own."""
    return max(term(symbol).sizes(grade).limit for grade in GRADES)


def check_credibility(
    limit_of: LimitFunction, name: str, coefficients: Mapping[str, Coefficient]
) -> Iterator[Finding]:
    """Yield a finding if coefficients of an accelerometer are beyond what is credible.

    A wrong scale factor makes the others wrong by as much: they stand below it.

    coefficients: Symbol -> estimate, in g-units.
    """
    findings = {
        symbol: finding
        for symbol, c in coefficients.items()
        if symbol in ACCELEROMETER_TERMS
        and (finding := _credibility_finding(limit_of, name, symbol, f"{name}.{symbol}", c))
        is not None
    }
    scale = findings.pop("K_I", None)
    if scale is None:
        yield from findings.values()
    else:
        yield scale.model_copy(update={"explains": list(findings.values())})


def check_shared_credibility(
    limit_of: LimitFunction, coefficients: Iterable[tuple[str, str, Coefficient]]
) -> Iterator[Finding]:
    """Yield the findings on what platform, machine and runs have; deviations from nominal, SI.

    coefficients: Symbol, whole name and estimate; radii of mountings as deviations from the
        centrifuge's.
    """
    for symbol, name, c in coefficients:
        if is_term(symbol):
            finding = _credibility_finding(limit_of, "", symbol, name, c)
            if finding is not None:
                yield finding


def check_default_priors(rests_on: Sequence[Knowledge]) -> Iterator[Finding]:
    """Yield a finding for each thing unstated that comes out far from nothing."""
    for row in rests_on:
        if row.kind != "unstated" or row.found is None or row.u_found is None:
            continue
        ratio = abs(row.found - row.value) / row.u
        if ratio <= _MAX_DEFAULT_SDS:
            continue
        unit, factor = find_display_unit(row.unit)
        estimate = format_estimate(row.found * factor, row.u_found * factor, unit)
        u_text = f"{format_number(row.u * factor, 2)} {unit}"
        text = (
            f"No value is stated for {row.name}. The estimate, {estimate}, is "
            f"{format_number(ratio, 2)} times the default standard uncertainty, {u_text}. State "
            f"a prior for {row.name} in [model.priors], or look for another error with the "
            "same effect."
        )
        yield Finding(code="beyond-typical", subject=row.name, text=text, size=ratio)


def _credibility_finding(
    limit_of: LimitFunction, owner: str, symbol: str, subject: str, c: Coefficient
) -> Finding | None:
    """Return the finding on one estimate; None if it is credible or there is none."""
    if not c.estimated or c.value is None or c.u is None:
        return None
    row, limit = term(symbol), limit_of(symbol, owner)
    excess = abs(c.value - row.nominal) - limit
    if excess <= _MAX_SIGMAS * c.u:
        return None
    deviation = f"deviation from {row.nominal:g}" if row.nominal else "magnitude"
    excess_text = f"its {deviation} exceeds {format_number(limit)} {c.unit}"
    cause = _scale_factor_cause(c.value, limit) if symbol == "K_I" else _likely_cause(symbol)
    grade = f" state the grade of the instrument in accelerometers.{owner}, or" if owner else ""
    text = (
        f"{symbol} = {format_number(c.value, 5)} {c.unit} is not credible, because "
        f"{excess_text}. The records cannot reveal the cause. Check {cause}. If the value is "
        f"real,{grade} raise {symbol} in [model.limits]."
    )
    return Finding(
        code="incredible",
        subject=subject,
        text=text,
        size=excess / c.u if c.u > 0.0 else None,
        contradicts=True,
    )


def _likely_cause(symbol: str) -> str:
    return next(cause for prefix, cause in _LIKELY_CAUSES.items() if symbol.startswith(prefix))


def _scale_factor_cause(value: float, limit: float) -> str:
    """Return the likely cause of an incredible scale factor: a sign, a unit, a column."""
    factors = dict.fromkeys(
        (_GRAVITY, 1.0 / _GRAVITY), "the unit: the values may be in m/s^2 instead of g"
    )
    factors |= {
        10.0**power: f"the unit, which may be wrong by a factor of 1e{power}" for power in _POWERS
    }
    # The true one may be as far from 1 as instruments of its grade are.
    tolerance = max(_RATIO_TOLERANCE, 0.1 * limit)
    matches = [factor for factor in (1.0, *factors) if abs(abs(value) / factor - 1.0) <= tolerance]
    causes = []
    if value < -limit or (value < 0.0 and matches):
        causes.append(
            "the sign of the output, and the senses of the input axis and of the attitudes"
        )
    if 1.0 not in matches and matches:
        causes.append(", or ".join(factors[factor] for factor in matches))
    elif not matches and abs(value) <= limit:
        causes.append("whether columns or accelerometers are swapped")
    return ", and ".join(causes) or (
        "the sensitivity, the unit of the sensitivity, and the range of the readout"
    )

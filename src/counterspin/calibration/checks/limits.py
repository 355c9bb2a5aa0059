"""Checks that estimates are credible for an instrument and small enough for first order.

Some mistakes leave no residuals: with the sign of all readings reversed, only K_I near -1 reveals
the mistake. Therefore, the deviation of each estimate from its nominal value is compared with a
credible limit plus three standard uncertainties.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Final

from counterspin.calibration.result_parts import Coefficient, Finding, Knowledge
from counterspin.physics.grades import GRADES
from counterspin.physics.terms import ACCELEROMETER_TERMS, is_term, term
from counterspin.reports.numbers import find_display_unit, format_estimate, format_number

#: Excess over the credible limit, in standard uncertainties, above which a finding is reported.
_MAX_SIGMAS: Final = 3.0

#: Largest estimate of an unstated term, in default standard uncertainties.
_MAX_DEFAULT_SDS: Final = 4.0

#: Relative tolerance for recognising a wrong unit from a scale factor.
_RATIO_TOLERANCE: Final = 0.01

_STANDARD_GRAVITY: Final = 9.80665  #: m/s^2

#: Powers of ten by which a unit may be wrong.
_UNIT_POWERS: Final = (-9, -6, -4, -3, -2, -1, 1, 2, 3, 4, 6, 9)

#: Prefix of a symbol -> likely cause of an incredible value; the first match applies.
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


#: (symbol, accelerometer) -> credible limit; the accelerometer is empty for shared terms.
LimitFunction = Callable[[str, str], float]


def max_limit(symbol: str, owner: str) -> float:  # noqa: ARG001 -- a LimitFunction
    """Return the largest credible limit of any grade, for a result without a stated grade."""
    return max(term(symbol).sizes(grade).limit for grade in GRADES)


def check_credibility(
    limit_of: LimitFunction, name: str, coefficients: Mapping[str, Coefficient]
) -> Iterator[Finding]:
    """Yield the findings on coefficients of an accelerometer beyond their credible limits.

    A finding on the scale factor explains the others, because it scales all of them.

    coefficients: Symbol -> coefficient, in g-units.
    """
    findings = {
        symbol: finding
        for symbol, coefficient in coefficients.items()
        if symbol in ACCELEROMETER_TERMS
        and (
            finding := _credibility_finding(limit_of, name, symbol, f"{name}.{symbol}", coefficient)
        )
        is not None
    }
    scale_finding = findings.pop("K_I", None)
    if scale_finding is None:
        yield from findings.values()
    else:
        yield scale_finding.model_copy(update={"explains": list(findings.values())})


def check_shared_credibility(
    limit_of: LimitFunction, coefficients: Iterable[tuple[str, str, Coefficient]]
) -> Iterator[Finding]:
    """Yield the findings on terms of platform, machine and runs beyond their credible limits.

    coefficients: Symbol, full name and coefficient in SI; radii of mountings as deviations from
        the radius of the centrifuge.
    """
    for symbol, name, coefficient in coefficients:
        if is_term(symbol):
            finding = _credibility_finding(limit_of, "", symbol, name, coefficient)
            if finding is not None:
                yield finding


def check_default_priors(prior_knowledge: Sequence[Knowledge]) -> Iterator[Finding]:
    """Yield a finding for each unstated term whose estimate is far outside its default prior."""
    for row in prior_knowledge:
        if row.kind != "unstated" or row.found is None or row.u_found is None:
            continue
        ratio = abs(row.found - row.value) / row.u
        if ratio <= _MAX_DEFAULT_SDS:
            continue
        unit, factor = find_display_unit(row.unit)
        estimate_text = format_estimate(row.found * factor, row.u_found * factor, unit)
        u_text = f"{format_number(row.u * factor, 2)} {unit}"
        text = (
            f"No value is stated for {row.name}. The estimate, {estimate_text}, is "
            f"{format_number(ratio, 2)} times the default standard uncertainty, {u_text}. State "
            f"a prior for {row.name} in [model.priors], or look for another error with the "
            "same effect."
        )
        yield Finding(code="beyond-typical", subject=row.name, text=text, size=ratio)


def _credibility_finding(
    limit_of: LimitFunction, owner: str, symbol: str, subject: str, coefficient: Coefficient
) -> Finding | None:
    """Return the finding on one estimate; None if it is credible or there is none."""
    if not coefficient.estimated or coefficient.value is None or coefficient.u is None:
        return None
    row, limit = term(symbol), limit_of(symbol, owner)
    excess = abs(coefficient.value - row.nominal) - limit
    if excess <= _MAX_SIGMAS * coefficient.u:
        return None
    deviation_name = f"deviation from {row.nominal:g}" if row.nominal else "magnitude"
    excess_text = f"its {deviation_name} exceeds {format_number(limit)} {coefficient.unit}"
    cause_text = (
        _scale_factor_cause(coefficient.value, limit) if symbol == "K_I" else _likely_cause(symbol)
    )
    clause = f" state the grade of the instrument in accelerometers.{owner}, or" if owner else ""
    text = (
        f"{symbol} = {format_number(coefficient.value, 5)} {coefficient.unit} is not credible, "
        f"because {excess_text}. The records cannot reveal the cause. Check {cause_text}. If the "
        f"value is real,{clause} raise {symbol} in [model.limits]."
    )
    return Finding(
        code="incredible",
        subject=subject,
        text=text,
        size=excess / coefficient.u if coefficient.u > 0.0 else None,
        contradicts=True,
    )


def _likely_cause(symbol: str) -> str:
    return next(cause for prefix, cause in _LIKELY_CAUSES.items() if symbol.startswith(prefix))


def _scale_factor_cause(value: float, limit: float) -> str:
    """Return the likely cause of an incredible scale factor: a sign, a unit, a column."""
    factors = dict.fromkeys(
        (_STANDARD_GRAVITY, 1.0 / _STANDARD_GRAVITY),
        "the unit: the values may be in m/s^2 instead of g",
    )
    factors |= {
        10.0**power: f"the unit, which may be wrong by a factor of 1e{power}"
        for power in _UNIT_POWERS
    }
    # The true scale factor may deviate from 1 by the limit of the grade.
    tolerance = max(_RATIO_TOLERANCE, 0.1 * limit)
    matching_factors = [
        factor for factor in (1.0, *factors) if abs(abs(value) / factor - 1.0) <= tolerance
    ]
    causes = []
    if value < -limit or (value < 0.0 and matching_factors):
        causes.append(
            "the sign of the output, and the senses of the input axis and of the attitudes"
        )
    if 1.0 not in matching_factors and matching_factors:
        causes.append(", or ".join(factors[factor] for factor in matching_factors))
    elif not matching_factors and abs(value) <= limit:
        causes.append("whether columns or accelerometers are swapped")
    return ", and ".join(causes) or (
        "the sensitivity, the unit of the sensitivity, and the range of the readout"
    )

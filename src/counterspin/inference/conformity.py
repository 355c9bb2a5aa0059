"""Conformity of a quantity, given its estimate and uncertainty (JCGM 106:2012).

What is known of the quantity is a normal distribution about the estimate, or Student's t where the
uncertainty has few degrees of freedom (JCGM 101:2008, 6.4.9). Only global risks use other items.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

from counterspin.frozen import frozen
from counterspin.inference.distributions import expanded_uncertainty, student_cdf
from counterspin.inference.global_risk import Process, global_risk
from counterspin.inference.verdicts import Conformity, RuleName, Verdict

#: Widest guard band of a rule by probability at one limit, in standard uncertainties.
_MAX_BAND: Final = 1e6

_BISECTIONS: Final = 80


@frozen
class DecisionRule:
    """By which rule conformity is decided."""

    #: ``simple``: by the estimate alone (clause 8.2). ``guarded``: pass inside the acceptance
    #: limits, fail where the estimate is outside the tolerance limits by more than the guard band,
    #: undecided between (clause 8.3; ILAC-G8:09/2019 with w = U). ``probability``: pass where the
    #: conformance probability is at least `needed`, fail where that of the contrary is.
    name: RuleName
    #: Guard band over expanded uncertainty, w = guard_factor x U, U of 95 % coverage; of the
    #: guarded rule.
    guard_factor: float = 1.0
    #: Probability that must be reached, above 0.5; of the rule by probability.
    needed: float = 0.95

    def __post_init__(self) -> None:
        if not 0.0 <= self.guard_factor < math.inf:
            raise ValueError(f"a guard factor must not be negative; got {self.guard_factor}")
        if not 0.5 < self.needed < 1.0:
            raise ValueError(
                f"the required probability must be between 0.5 and 1; got {self.needed}"
            )


@frozen
class Specification:
    """Tolerance limits of a coefficient."""

    text: str  #: Specification as written, such as ``abs <= 5e-5 g/g^2``.
    #: In `unit`, low < high; None where there is no such limit, never both.
    low: float | None
    high: float | None
    unit: str  #: That of the coefficient.
    #: Distribution of the coefficient between items of its process; None: not stated.
    process: Process | None = None


def conformance_probability(
    value: float, u: float, dof: float | None, low: float | None, high: float | None
) -> float:
    """Return the probability that the quantity lies between its tolerance limits.

    value, u: Estimate and standard uncertainty, u >= 0; with u = 0 the value is exact.
    dof: Degrees of freedom of u; None is infinite.
    low, high: Tolerance limits in the unit of `value`, low < high; None where there is none.
    """
    below, above = _standardised(value, u, dof, low, high)
    if below > 0.0:
        # Both limits on one side: the difference of the small tails.
        return _distribution(-below, dof) - _distribution(-above, dof)
    return _distribution(above, dof) - _distribution(below, dof)


def nonconformance_probability(
    value: float, u: float, dof: float | None, low: float | None, high: float | None
) -> float:
    """Return the probability that the quantity lies outside; see `conformance_probability`.

    The sum of two tails, so that a small one keeps its digits.
    """
    below, above = _standardised(value, u, dof, low, high)
    return _distribution(below, dof) + _distribution(-above, dof)


def acceptance_limits(
    low: float | None, high: float | None, guard_band: float
) -> tuple[float | None, float | None]:
    """Return the tolerance limits moved inwards by the guard band (JCGM 106:2012, clause 8.3).

    The lower is above the upper where the guard bands leave nothing between them: then nothing
    can be accepted.
    """
    return (
        None if low is None else low + guard_band,
        None if high is None else high - guard_band,
    )


def decide(
    value: float, u: float, dof: float | None, specification: Specification, rule: DecisionRule
) -> Conformity:
    """Decide on one item by a decision rule; `value`, `u` and `dof` as for the probability."""
    low, high = specification.low, specification.high
    inside = conformance_probability(value, u, dof, low, high)
    outside = nonconformance_probability(value, u, dof, low, high)
    guard_band = 0.0
    if rule.name == "guarded":
        guard_band = rule.guard_factor * expanded_uncertainty(u, dof)
    verdict: Verdict = "undecided"
    if rule.name == "probability":
        if max(inside, outside) >= rule.needed:
            verdict = "pass" if inside >= rule.needed else "fail"
        reason = (
            "neither the probability of conformity nor that of non-conformity reaches "
            f"{rule.needed:g}"
        )
    else:
        if _between(value, *acceptance_limits(low, high, guard_band)):
            verdict = "pass"
        elif not _between(value, *acceptance_limits(low, high, -guard_band)):
            verdict = "fail"
        reason = "the distance of the estimate from a tolerance limit is less than the guard band"
    acceptance_interval = _acceptance_interval(u, dof, specification, rule, guard_band)
    return replace(
        undecided(specification, rule, reason),
        global_risk=None
        if specification.process is None
        else global_risk(specification.process, u, dof, (low, high), acceptance_interval),
        guard_band=guard_band,
        verdict=verdict,
        probability=inside,
        risk={"pass": outside, "fail": inside, "undecided": None}[verdict],
        reason=reason if verdict == "undecided" else None,
    )


def _acceptance_interval(
    u: float, dof: float | None, specification: Specification, rule: DecisionRule, guard_band: float
) -> tuple[float | None, float | None]:
    """Return the limits of the estimates that pass; the lower is above the upper if none does."""
    low, high = specification.low, specification.high
    if rule.name != "probability":
        return acceptance_limits(low, high, guard_band)

    def passes(band: float) -> bool:
        value = high - band if high is not None else (low or 0.0) + band
        return conformance_probability(value, u, dof, low, high) >= rule.needed

    # With two limits, the probability grows from a limit to the middle between both.
    reach = 0.5 * (high - low) if low is not None and high is not None else _MAX_BAND * u
    if not passes(reach):
        return math.inf, -math.inf
    outside, inside = 0.0, reach
    for _ in range(_BISECTIONS):
        middle = 0.5 * (outside + inside)
        outside, inside = (outside, middle) if passes(middle) else (middle, inside)
    return acceptance_limits(low, high, inside)


def undecided(specification: Specification, rule: DecisionRule, reason: str) -> Conformity:
    """Return the verdict on an item without a usable estimate."""
    return Conformity(
        specification=specification.text,
        low=specification.low,
        high=specification.high,
        unit=specification.unit,
        rule=rule.name,
        guard_band=None,
        needed=rule.needed if rule.name == "probability" else None,
        verdict="undecided",
        probability=None,
        risk=None,
        reason=reason,
    )


def _between(value: float, low: float | None, high: float | None) -> bool:
    return (low is None or value >= low) and (high is None or value <= high)


def _standardised(
    value: float, u: float, dof: float | None, low: float | None, high: float | None
) -> tuple[float, float]:
    """Return the tolerance limits in standard uncertainties from the estimate."""
    if low is None and high is None:
        raise ValueError("a specification must have a tolerance limit")
    if low is not None and high is not None and not low < high:
        raise ValueError(f"the lower limit {low} is not below the upper limit {high}")
    if not (math.isfinite(value) and 0.0 <= u < math.inf):
        raise ValueError(f"{value} ± {u} is not a valid estimate")
    if dof is not None and not dof > 0.0:
        raise ValueError(f"degrees of freedom must be positive; got {dof}")
    if u == 0.0:
        # Exact: at a limit it conforms.
        return (
            -math.inf if low is None or value >= low else math.inf,
            math.inf if high is None or value <= high else -math.inf,
        )
    return (
        -math.inf if low is None else (low - value) / u,
        math.inf if high is None else (high - value) / u,
    )


def _distribution(x: float, dof: float | None) -> float:
    if math.isinf(x):
        return 1.0 if x > 0.0 else 0.0
    return student_cdf(math.inf if dof is None else dof, x)

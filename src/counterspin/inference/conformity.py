"""Conformity of a quantity, given its estimate and uncertainty (JCGM 106:2012).

The quantity has a normal distribution about the estimate, or Student's t distribution if the
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

#: Largest guard band of the probability rule at a single limit, in standard uncertainties.
_MAX_GUARD_BAND: Final = 1e6

_N_BISECTIONS: Final = 80


@frozen
class DecisionRule:
    """Decision rule of a conformity assessment."""

    #: ``simple``: by the estimate alone (clause 8.2). ``guarded``: pass inside the acceptance
    #: limits, fail where the estimate is outside the tolerance limits by more than the guard band,
    #: undecided between (clause 8.3; ILAC-G8:09/2019 with w = U). ``probability``: pass where the
    #: conformance probability is at least `needed`, fail where the nonconformance probability is.
    name: RuleName
    #: Guard band of the guarded rule over the 95 % expanded uncertainty: w = guard_factor x U.
    guard_factor: float = 1.0
    #: Probability that the probability rule requires, above 0.5.
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
    #: Limits in `unit`, low < high; None: no such limit. At least one limit is given.
    low: float | None
    high: float | None
    unit: str  #: Unit of the coefficient and the limits.
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
    z_low, z_high = _standardise_limits(value, u, dof, low, high)
    if z_low > 0.0:
        # Both limits are above the estimate: use the difference of the small tails.
        return _cdf(-z_low, dof) - _cdf(-z_high, dof)
    return _cdf(z_high, dof) - _cdf(z_low, dof)


def nonconformance_probability(
    value: float, u: float, dof: float | None, low: float | None, high: float | None
) -> float:
    """Return the probability that the quantity lies outside; see `conformance_probability`.

    The sum of two tails keeps the digits of a small probability.
    """
    z_low, z_high = _standardise_limits(value, u, dof, low, high)
    return _cdf(z_low, dof) + _cdf(-z_high, dof)


def acceptance_limits(
    low: float | None, high: float | None, guard_band: float
) -> tuple[float | None, float | None]:
    """Return the tolerance limits moved inwards by the guard band (JCGM 106:2012, clause 8.3).

    If the guard bands overlap, the lower limit is above the upper limit, and no estimate passes.
    """
    return (None if low is None else low + guard_band, None if high is None else high - guard_band)


def decide(
    value: float, u: float, dof: float | None, specification: Specification, rule: DecisionRule
) -> Conformity:
    """Decide on one item by a decision rule; `value`, `u` and `dof` as for the probability."""
    low, high = specification.low, specification.high
    p_conforming = conformance_probability(value, u, dof, low, high)
    p_nonconforming = nonconformance_probability(value, u, dof, low, high)
    guard_band = 0.0
    if rule.name == "guarded":
        guard_band = rule.guard_factor * expanded_uncertainty(u, dof)
    verdict: Verdict = "undecided"
    if rule.name == "probability":
        if max(p_conforming, p_nonconforming) >= rule.needed:
            verdict = "pass" if p_conforming >= rule.needed else "fail"
        reason = (
            "neither the probability of conformity nor that of non-conformity reaches "
            f"{rule.needed:g}"
        )
    else:
        if _is_within(value, *acceptance_limits(low, high, guard_band)):
            verdict = "pass"
        elif not _is_within(value, *acceptance_limits(low, high, -guard_band)):
            verdict = "fail"
        reason = "the distance of the estimate from a tolerance limit is less than the guard band"
    acceptance_interval = _acceptance_interval(u, dof, specification, rule, guard_band)
    return replace(
        undecided_conformity(specification, rule, reason),
        global_risk=None
        if specification.process is None
        else global_risk(specification.process, u, dof, (low, high), acceptance_interval),
        guard_band=guard_band,
        verdict=verdict,
        probability=p_conforming,
        risk={"pass": p_nonconforming, "fail": p_conforming, "undecided": None}[verdict],
        reason=reason if verdict == "undecided" else None,
    )


def _acceptance_interval(
    u: float, dof: float | None, specification: Specification, rule: DecisionRule, guard_band: float
) -> tuple[float | None, float | None]:
    """Return the limits of the estimates that pass; the lower is above the upper if none does."""
    low, high = specification.low, specification.high
    if rule.name != "probability":
        return acceptance_limits(low, high, guard_band)

    def passes(margin: float) -> bool:
        value = high - margin if high is not None else (low or 0.0) + margin
        return conformance_probability(value, u, dof, low, high) >= rule.needed

    # With two limits, the probability grows from a limit to the middle between both.
    max_margin = 0.5 * (high - low) if low is not None and high is not None else _MAX_GUARD_BAND * u
    if not passes(max_margin):
        return math.inf, -math.inf
    failing_margin, passing_margin = 0.0, max_margin
    for _ in range(_N_BISECTIONS):
        midpoint = 0.5 * (failing_margin + passing_margin)
        failing_margin, passing_margin = (
            (failing_margin, midpoint) if passes(midpoint) else (midpoint, passing_margin)
        )
    return acceptance_limits(low, high, passing_margin)


def undecided_conformity(
    specification: Specification, rule: DecisionRule, reason: str
) -> Conformity:
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


def _is_within(value: float, low: float | None, high: float | None) -> bool:
    return (low is None or value >= low) and (high is None or value <= high)


def _standardise_limits(
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
        # An exact value at a limit conforms.
        return (
            -math.inf if low is None or value >= low else math.inf,
            math.inf if high is None or value <= high else -math.inf,
        )
    return (
        -math.inf if low is None else (low - value) / u,
        math.inf if high is None else (high - value) / u,
    )


def _cdf(x: float, dof: float | None) -> float:
    if math.isinf(x):
        return 1.0 if x > 0.0 else 0.0
    return student_cdf(math.inf if dof is None else dof, x)

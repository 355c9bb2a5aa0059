"""Conformance probability, acceptance limits and the three decision rules."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import integrate, stats

from counterspin.inference.conformity import (
    DecisionRule,
    Specification,
    acceptance_limits,
    conformance_probability,
    decide,
    nonconformance_probability,
)
from counterspin.inference.distributions import expanded_uncertainty
from counterspin.validation.cases import cases

RULES = ("simple", "guarded", "probability")

values = st.floats(-50.0, 50.0)
spreads = st.floats(0.01, 30.0)
freedoms = st.one_of(st.none(), st.floats(1.0, 1e4))


@st.composite
def draw_limits(draw):
    low, width = draw(values), draw(st.floats(0.01, 50.0))
    return draw(st.sampled_from([(low, None), (None, low), (low, low + width)]))


def between_limits(low, high):
    return Specification("", low, high, "g")


# The probability


# JCGM 106:2012, worked examples of clause 7, as printed, two digits.
JCGM_106 = [actual_case for actual_case in cases() if actual_case.name.startswith("JCGM 106")]


@pytest.mark.parametrize("example", JCGM_106, ids=lambda example: example.name)
def test_conformance_probability_matches_jcgm_106(example):
    assert conformance_probability(**example.given) == pytest.approx(
        float(example.expected["p"]), abs=0.005
    )


# With one and two degrees of freedom Student's distribution is elementary.
def test_one_degree_of_freedom_matches_arctangent():
    exact = (math.atan(2.0) + math.atan(0.5)) / math.pi
    assert conformance_probability(1.0, 2.0, 1.0, 0.0, 5.0) == pytest.approx(exact, rel=1e-13)


def test_two_degrees_of_freedom_match_closed_form():
    exact = 0.5 + 1.5 / (2.0 * math.sqrt(2.0 + 1.5**2))
    assert conformance_probability(0.0, 2.0, 2.0, None, 3.0) == pytest.approx(exact, rel=1e-13)


def test_probability_is_integral_of_density():
    area, _ = integrate.quad(stats.t(7.5, loc=1.2, scale=0.4).pdf, 0.7, 1.5, epsabs=1e-12)
    assert conformance_probability(1.2, 0.4, 7.5, 0.7, 1.5) == pytest.approx(area, abs=1e-11)


def test_small_tails_have_full_precision():
    # erfc(x/sqrt(2))/2 by mpmath with 30 digits.
    tail = {10.0: 7.619853024160527e-24, 11.0: 1.910659574498669e-28}
    outside = nonconformance_probability(0.0, 1.0, None, None, 10.0)
    assert outside == pytest.approx(tail[10.0], rel=1e-12, abs=0.0)
    inside = conformance_probability(0.0, 1.0, None, 10.0, 11.0)
    assert inside == pytest.approx(tail[10.0] - tail[11.0], rel=1e-12, abs=0.0)
    mirrored = conformance_probability(0.0, 1.0, None, -11.0, -10.0)
    assert mirrored == pytest.approx(inside, rel=1e-12, abs=0.0)


@given(values, spreads, freedoms, draw_limits())
def test_inside_and_outside_probabilities_sum_to_one(value, u, dof, between):
    inside = conformance_probability(value, u, dof, *between)
    outside = nonconformance_probability(value, u, dof, *between)
    assert inside + outside == pytest.approx(1.0, abs=1e-12)
    assert 0.0 <= inside <= 1.0
    assert 0.0 <= outside <= 1.0 + 1e-15


@given(values, spreads, freedoms, draw_limits(), st.floats(0.1, 10.0), values)
def test_probability_is_invariant_under_scale_and_shift(value, u, dof, between, scale, shift):
    moved = [None if limit is None else scale * limit + shift for limit in between]
    assert conformance_probability(scale * value + shift, scale * u, dof, *moved) == pytest.approx(
        conformance_probability(value, u, dof, *between), abs=1e-9
    )


def test_exact_value_has_probability_zero_or_one():
    assert conformance_probability(2.0, 0.0, None, 1.0, 2.0) == 1.0
    assert conformance_probability(2.1, 0.0, None, 1.0, 2.0) == 0.0
    assert nonconformance_probability(0.9, 0.0, 3.0, 1.0, None) == 1.0


@pytest.mark.parametrize(
    ("value", "u", "dof", "low", "high"),
    [
        (0.0, 1.0, None, None, None),
        (0.0, 1.0, None, 2.0, 1.0),
        (0.0, 1.0, None, 1.0, 1.0),
        (0.0, -1.0, None, None, 1.0),
        (math.nan, 1.0, None, None, 1.0),
        (0.0, math.inf, None, None, 1.0),
        (0.0, 1.0, 0.0, None, 1.0),
    ],
)
def test_invalid_estimate_or_limit_raises(value, u, dof, low, high):
    with pytest.raises(ValueError, match=r"limit|estimate|degrees"):
        conformance_probability(value, u, dof, low, high)


# The guard band


def test_expanded_uncertainty_uses_student_t_factor():
    # t of 97.5 % with 1 and 2 degrees of freedom in closed form, and the normal's 1.96.
    assert expanded_uncertainty(2.0, 1.0) == pytest.approx(2.0 * math.tan(0.475 * math.pi))
    assert expanded_uncertainty(1.0, 2.0) == pytest.approx(0.95 * math.sqrt(2.0 / (1.0 - 0.95**2)))
    assert expanded_uncertainty(1.0, None) == pytest.approx(1.959963984540054)


def test_acceptance_limits_are_inside_tolerance():
    assert acceptance_limits(1.0, 4.0, 0.5) == (1.5, 3.5)
    assert acceptance_limits(None, 4.0, 0.5) == (None, 3.5)
    assert acceptance_limits(1.0, None, 0.5) == (1.5, None)


@given(spreads, freedoms, draw_limits(), st.floats(0.0, 3.0))
def test_guard_band_bounds_risk(u, dof, between, factor):
    """At an acceptance limit the risk is that of the tail beyond w, twice at most."""
    w = factor * expanded_uncertainty(u, dof)
    low, high = acceptance_limits(*between, w)
    if low is not None and high is not None and low >= high:
        return
    value = high if high is not None else low
    assert value is not None
    decision = decide(value, u, dof, between_limits(*between), DecisionRule("guarded", factor))
    assert decision.verdict == "pass"
    tail = float(stats.norm.sf(w / u) if dof is None else stats.t.sf(w / u, dof))
    assert decision.risk is not None
    # The limits are rounded, which moves w by an ulp of them.
    assert tail * (1 - 1e-9) - 1e-12 <= decision.risk <= 2.0 * tail * (1 + 1e-9) + 1e-12


def test_guard_band_of_expanded_uncertainty_has_risk_of_2_5_percent():
    for dof in (None, 4.0):
        w = expanded_uncertainty(1.0, dof)
        decision = decide(10.0 - w, 1.0, dof, between_limits(None, 10.0), DecisionRule("guarded"))
        assert decision.guard_band == w
        assert decision.risk == pytest.approx(0.025, rel=1e-9)


# The rules


@pytest.mark.parametrize(
    ("value", "simple", "guarded", "probability"),
    [
        (0.0, "pass", "pass", "pass"),
        (8.0, "pass", "pass", "pass"),  # 2 u inside
        (8.2, "pass", "undecided", "pass"),  # 1.8 u inside: 96.4 %
        (8.5, "pass", "undecided", "undecided"),  # 1.5 u: 93.3 %
        (10.0, "pass", "undecided", "undecided"),
        (10.1, "fail", "undecided", "undecided"),
        (11.7, "fail", "undecided", "fail"),
        (12.1, "fail", "fail", "fail"),
        (-12.1, "fail", "fail", "fail"),
        (-11.9, "fail", "undecided", "fail"),
        (-8.0, "pass", "pass", "pass"),
    ],
)
def test_verdicts_across_limit(value, simple, guarded, probability):
    wanted = dict(zip(RULES, (simple, guarded, probability), strict=True))
    rules = map(DecisionRule, RULES)
    draw_limits = between_limits(-10.0, 10.0)
    decision = {rule.name: decide(value, 1.0, None, draw_limits, rule).verdict for rule in rules}
    assert decision == wanted


def test_wide_guard_bands_never_pass():
    draw_limits, rule = between_limits(-1.0, 1.0), DecisionRule("guarded")
    for value in np.linspace(-3.0, 3.0, 61):
        assert decide(value, 1.0, None, draw_limits, rule).verdict != "pass"


@given(values, spreads, freedoms, draw_limits(), st.sampled_from(RULES), st.floats(0.51, 0.999))
def test_risk_is_probability_of_wrong_verdict(value, u, dof, between, rule, needed):
    decision = decide(value, u, dof, between_limits(*between), DecisionRule(rule, needed=needed))
    contrary = {"pass": 1.0 - decision.probability, "fail": decision.probability}
    if decision.verdict == "undecided":
        assert decision.risk is None
    else:
        assert decision.risk == pytest.approx(contrary[decision.verdict], abs=1e-12)
    if rule == "probability" and decision.risk is not None:
        assert decision.risk <= 1.0 - needed + 1e-12
    if rule == "simple":
        assert decision.verdict != "undecided"


@given(values, spreads, freedoms, draw_limits(), st.floats(0.0, 2.0))
def test_wider_guard_band_never_turns_pass_into_fail(value, u, dof, between, factor):
    narrow, wide = (
        decide(value, u, dof, between_limits(*between), DecisionRule("guarded", f)).verdict
        for f in (factor, factor + 0.5)
    )
    assert (narrow, wide) in {
        ("pass", "pass"),
        ("pass", "undecided"),
        ("fail", "fail"),
        ("fail", "undecided"),
        ("undecided", "undecided"),
    }


def test_zero_guard_band_is_simple_acceptance():
    for value in (-1.1, -1.0, 0.0, 1.0, 1.1):
        bare = decide(value, 0.3, 5.0, between_limits(-1.0, 1.0), DecisionRule("guarded", 0.0))
        simple = decide(value, 0.3, 5.0, between_limits(-1.0, 1.0), DecisionRule("simple"))
        assert replace(bare, rule="simple") == simple


def test_risk_matches_frequency_of_wrong_verdicts():
    """Given the estimate, the value is drawn from what is known of it (JCGM 106, clause 7)."""
    rng = np.random.default_rng(106)
    n = 200_000
    for dof in (None, 3.0):
        noise = rng.standard_normal(n) if dof is None else rng.standard_t(dof, n)
        for value in (0.4, 1.8, 2.5):
            decision = decide(value, 1.0, dof, between_limits(0.0, 2.0), DecisionRule("simple"))
            truth = value + noise
            conforms = (truth >= 0.0) & (truth <= 2.0)
            wrong = float(np.mean(~conforms if decision.verdict == "pass" else conforms))
            spread = math.sqrt(decision.risk * (1.0 - decision.risk) / n)
            assert abs(wrong - decision.risk) < 4.5 * spread


@pytest.mark.parametrize("wrong", [{"guard_factor": -0.1}, {"needed": 0.5}, {"needed": 1.0}])
def test_invalid_rule_raises(wrong):
    with pytest.raises(ValueError, match="got"):
        DecisionRule("guarded", **wrong)

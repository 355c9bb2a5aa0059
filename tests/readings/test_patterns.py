"""The columns that residuals of readings are held against, and the chance of what they gain."""

import math
import os
from dataclasses import replace

import numpy as np
import pytest
from reading_campaigns import (
    TRUTH,
    make_arm_test,
    make_model,
    make_readings,
    make_tumble,
    simulate_readings,
)
from scipy import stats

from counterspin.readings.fit import solve_readings
from counterspin.readings.patterns import (
    APPROACH,
    DRIFT,
    FORCE,
    HEAD,
    HYSTERESIS,
    REVERSED,
    STEP,
    TERM,
    WAVE,
    ResidualGroup,
    _tail_probability,
    best_patterns,
    candidate_columns,
    head_angle,
)

LEVEL = ("K_F", "K_I", "delta_O")


def score_columns(test, values, u, terms=LEVEL):
    """Solve readings, and hold all columns against them."""
    own = make_readings(test, values, u)
    problem = make_model(terms)
    fit = solve_readings([own], problem)
    (actual_group,) = fit.groups
    estimated = u is None
    group = ResidualGroup(
        own,
        0,
        actual_group.sigma,
        np.ones(own.size),
        actual_group.noise_dof if estimated else actual_group.chi2,
        actual_group.noise_dof if estimated else actual_group.residual_dof,
        estimated,
        0.0,
    )
    columns = tuple(candidate_columns(group.readings, group.index, terms, ()))
    return fit.fit, group, columns


def test_head_angle_is_zero_with_input_axis_up():
    angle, there = head_angle(make_readings(make_tumble(8), np.zeros(8), 1.0))
    assert there.all()
    np.testing.assert_allclose(np.cos(angle), np.cos(np.arange(8) * math.pi / 4), atol=1e-12)
    np.testing.assert_allclose(np.sin(angle), np.sin(np.arange(8) * math.pi / 4), atol=1e-12)
    _, none = head_angle(make_readings(make_arm_test(), np.zeros(24), 1.0))
    assert not none.any()


def test_opposite_sense_column_is_change_of_coriolis_force():
    """By 4 R w Omega sin L, of opposite signs inward and outward.

    An angle shows the sense, but not the sign of the latitude.
    """
    test = make_arm_test()
    readings = make_readings(test, np.zeros(len(test[0])), 1e-6)
    (stated, shown, partly_shown) = (
        [
            other
            for other in candidate_columns(replace(readings, stated_sense=sense), 0, {"K_I"}, set())
            if other.kind == REVERSED
        ]
        for sense in (1.0, 0.0, np.arange(len(test[0])) % 2.0)
    )
    rates = readings.stations.rate
    side = np.array([1.0 if name == "inward" else -1.0 for name in readings.mountings])
    expected = -4.0 * side * rates * 7.292115e-5 * math.sin(0.8) / 9.80665
    sense, latitude = "a rotation opposite to the stated sense", "a latitude of the opposite sign"
    assert [other.symbol for other in stated] == [f"{sense} or {latitude}"]
    assert [other.symbol for other in shown] == [latitude]
    assert [other.symbol for other in partly_shown] == [sense, latitude]
    for other in (*stated, *shown, partly_shown[1]):
        np.testing.assert_allclose(other.columns[0], expected, rtol=1e-9)
    np.testing.assert_allclose(
        partly_shown[0].columns[0], expected * (np.arange(len(test[0])) % 2.0), rtol=1e-9
    )


def test_positions_about_other_axis_have_no_head_angle():
    test = make_tumble(8)
    head = test[2].copy()
    head[:2] = [1.0, 0.0, 0.0]
    _, there = head_angle(make_readings((*test[:2], head), np.zeros(8), 1.0))
    assert there.tolist() == [False] * 2 + [True] * 6


def test_candidate_columns_are_missing_from_model():
    _, _, columns = score_columns(
        make_tumble(24), simulate_readings(make_tumble(24), np.random.default_rng(1), 1e-6), 1e-6
    )
    names = {(column.kind, column.symbol) for column in columns}
    assert (WAVE, "cos 2 phi") in names
    assert (TERM, "K_II") in names
    assert (TERM, "K_I") not in names
    assert (DRIFT, "time") in names
    # All positions were approached from one side.
    assert (HYSTERESIS, APPROACH) not in names
    assert (HYSTERESIS, FORCE) in names


def test_head_error_columns_require_two_mountings():
    """Turned by d more, cos phi reads less by d sin phi; d is a wave of what the head shows."""
    angle = np.arange(24) * math.pi / 12
    shown = angle - np.where(np.arange(24) < 12, 0.0, 0.5 * math.pi)
    own = make_readings(make_tumble(24), np.zeros(24), 1e-6)
    group = ResidualGroup(
        replace(own, head_angle=shown), 0, np.ones(24), np.ones(24), 0.0, 1.0, False, 0.0
    )
    columns = {
        c.symbol: c.columns[0]
        for c in candidate_columns(group.readings, 0, (), ())
        if c.kind == HEAD
    }
    assert len(columns) == 8
    turns = {"once": 1, "twice": 2, "three times": 3, "four times": 4}
    for times, n in turns.items():
        for name, wave in (("cos", np.cos), ("sin", np.sin)):
            expected = -np.sin(angle) * wave(n * shown)
            np.testing.assert_allclose(columns[f"{name} {times}"], expected, atol=1e-8)
    there = {
        c.symbol
        for c in candidate_columns(group.readings, 0, ("head.harmonic.2.sin",), ())
        if c.kind == HEAD
    }
    assert there == columns.keys() - {"sin twice"}
    alone = replace(group, readings=replace(own, head_angle=angle - 1.0))
    assert not [
        column for column in candidate_columns(alone.readings, 0, (), ()) if column.kind == HEAD
    ]


def test_approach_direction_changes_sign_within_revolution():
    own = make_readings(make_tumble(12), np.zeros(12), 1e-6)
    group = ResidualGroup(own, 0, np.ones(12), np.ones(12), 0.0, 1.0, False, 0.0)
    first, other = (
        c.columns[0] for c in candidate_columns(group.readings, 0, (), ()) if c.symbol == FORCE
    )
    # From up at 0 to down at 180 deg it falls; how the first position was come to nobody knows.
    np.testing.assert_array_equal(first, [-1.0] * 7 + [1.0] * 5)
    np.testing.assert_array_equal(other, [1.0] + [-1.0] * 6 + [1.0] * 5)


@pytest.mark.parametrize(("count", "tried"), [(3, 0), (4, 1), (12, 9), (100, 24)])
def test_steps_have_two_readings_on_both_sides(count, tried):
    own = make_readings(make_tumble(count), np.zeros(count), 1e-6)
    ones = np.ones(count)
    group = ResidualGroup(own, 0, ones, ones, 0.0, 1.0, False, 0.0)
    steps = [
        column.columns[0]
        for column in candidate_columns(group.readings, 0, (), ())
        if column.kind == STEP
    ]
    assert len(steps) == tried
    for step in steps:
        assert 2 <= step.sum() <= count - 2
        assert np.all(np.diff(step) >= 0.0)


def test_gain_matches_fit_with_column():
    """Rao's score of one more column on a linear problem is exact."""
    test, truth = make_tumble(24), {"K_F": 2e-3, "K_I": 1.0005, "delta_O": 3e-5, "K_II": 15e-6}
    values = simulate_readings(test, np.random.default_rng(2), 2e-6, truth=truth)
    joint, group, columns = score_columns(test, values, 2e-6)
    (actual_best_pattern,) = best_patterns(joint, [group], [columns])
    assert actual_best_pattern.alternatives[0].symbol == "cos 2 phi"
    assert {"K_II", "K_PP"} <= {other.symbol for other in actual_best_pattern.alternatives}
    with_term = solve_readings([make_readings(test, values, 2e-6)], make_model((*LEVEL, "K_II")))
    gain = group.chi2 - with_term.groups[0].chi2
    assert actual_best_pattern.p == pytest.approx(2.0 * stats.norm.sf(math.sqrt(gain)), rel=1e-3)
    estimated, own, columns = score_columns(test, values, None)
    (actual_best_pattern,) = best_patterns(estimated, [own], [columns])
    f = gain / (with_term.groups[0].chi2 / (24 - 4))
    assert actual_best_pattern.p == pytest.approx(stats.f.sf(f, 1, 24 - 4), rel=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("u", [None, 2e-6], ids=["noise estimated", "noise stated"])
def test_false_alarm_rate_matches_significance(u):
    """At 5 %, shared out among the columns: of 50 tumbles no more than 8 (p = 0.0008).

    Of 300 no more than 27 (p = 0.002).
    """
    trials, most = (300, 27) if os.environ.get("COUNTERSPIN_FULL") else (50, 8)
    rng = np.random.default_rng(3)
    truth = {symbol: TRUTH.get(symbol, 3e-5) for symbol in LEVEL}
    blamed = 0
    for _ in range(trials):
        joint, group, columns = score_columns(
            make_tumble(), simulate_readings(make_tumble(), rng, 2e-6, truth=truth), u
        )
        (actual_best_pattern,) = best_patterns(joint, [group], [columns])
        assert 8 <= actual_best_pattern.tests <= len(columns)
        blamed += actual_best_pattern.p * actual_best_pattern.tests < 0.05
    assert blamed <= most


def test_outlying_reading_leads_to_no_column():
    test, rng = make_tumble(24), np.random.default_rng(4)
    truth = {symbol: TRUTH.get(symbol, 3e-5) for symbol in LEVEL}
    values = simulate_readings(test, rng, 2e-6, truth=truth)
    values[0] += 2e-4
    joint, group, columns = score_columns(test, values, 2e-6)
    (without,) = best_patterns(joint, [replace(group, outlier_indices=(0,))], [columns])
    assert without.p * without.tests > 0.01


@pytest.mark.parametrize("columns", [1, 2, 4])
def test_tail_probability_of_gain_matches_f_distribution(columns):
    for dof in (3.0, 7.5, 60.0):
        assert _tail_probability(columns, dof, 9.0) == pytest.approx(
            stats.f.sf(9.0 / columns, columns, dof), rel=1e-9
        )
    assert _tail_probability(columns, math.inf, 9.0) == pytest.approx(
        stats.chi2.sf(9.0, columns), rel=1e-9
    )


def test_wave_is_found_by_sine_and_cosine_jointly():
    """Five times the noise, 9 degrees of freedom: alone, each part leaves the other as noise."""
    rng, angle = np.random.default_rng(5), np.arange(12) * math.pi / 6.0
    truth = {symbol: TRUTH.get(symbol, 3e-5) for symbol in LEVEL}
    exact = simulate_readings(make_tumble(), rng, 2e-6, truth=truth)
    for wave, turns in (
        (1e-5 * np.cos(2.0 * angle + 0.7), "2 phi"),
        (1e-5 * (np.cos(2.0 * angle + 0.7) + np.cos(3.0 * angle - 0.4)), "2 phi and 3 phi"),
    ):
        joint, group, columns = score_columns(make_tumble(), exact + wave, None)
        (actual_best_pattern,) = best_patterns(joint, [group], [columns])
        assert [other.symbol for other in actual_best_pattern.alternatives] == [f"waves of {turns}"]
        assert actual_best_pattern.p * actual_best_pattern.tests < 1e-3

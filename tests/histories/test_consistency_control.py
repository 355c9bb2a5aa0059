"""Limits of an individuals chart and points beyond them."""

import pytest

from counterspin.histories.consistency import individuals_chart


def test_control_limits_closed_form():
    # Changes 2, 4, 2: mean 8/3, divided by 1.1284.
    chart = individuals_chart([1.0, 3.0, -1.0, 1.0], list("abcd"))
    assert (chart.centre, chart.mean_range) == (1.0, pytest.approx(8.0 / 3.0))
    sigma = 8.0 / 3.0 / 1.128379
    warning, action = (1.0 - 2.0 * sigma, 1.0 + 2.0 * sigma), (1.0 - 3.0 * sigma, 1.0 + 3.0 * sigma)
    assert (chart.warning_low, chart.warning_high) == pytest.approx(warning, rel=1e-6)
    assert (chart.action_low, chart.action_high) == pytest.approx(action, rel=1e-6)
    # The factor D4 for two results is 3.267.
    assert chart.range_limit == pytest.approx(3.267 * 8.0 / 3.0, rel=2e-4)
    assert (chart.beyond, chart.leaps) == ([], [])


def test_points_beyond_limits_are_named():
    values = [0.0, 1.0] * 8 + [20.0] + [0.0, 1.0] * 4
    chart = individuals_chart(values, [str(index) for index in range(len(values))])
    assert chart.beyond == ["16"]
    assert chart.leaps == ["16", "17"]


def test_fewer_than_three_results_have_no_limits():
    assert individuals_chart([1.0, 2.0], ["a", "b"]) is None

"""The next due date: when the drift leaves the specification, given its uncertainty."""

from datetime import datetime, timedelta

import pytest

from counterspin.histories.consistency import Drift, next_due_date, probability_within
from counterspin.histories.result import Scatter

START, LAST = datetime(2020, 1, 1), datetime(2024, 1, 1)
YEARS = (LAST - START) / timedelta(days=365.25)


def make_drift(slope, u=0.0, u_value=0.1, birge=1.0):
    return Drift(
        slope=slope,
        u=u,
        p=0.0,
        time=0.0,
        value=0.0,
        u_value=u_value,
        scatter=Scatter(chi2=1.0, dof=3, p=0.5, birge=birge),
    )


def test_known_drift_is_due_when_guarded_limit_is_reached():
    # One-sided: 1.6449 u below the limit of 10, at a slope of 1 per year.
    due = next_due_date(make_drift(1.0), START, LAST, (None, 10.0), 0.95)
    assert (due - START) / timedelta(days=365.25) == pytest.approx(10.0 - 0.164485, abs=2e-4)
    # A Birge ratio above 1 is applied, one below is not.
    due = next_due_date(make_drift(1.0, birge=2.0), START, LAST, (None, 10.0), 0.95)
    assert (due - START) / timedelta(days=365.25) == pytest.approx(10.0 - 0.328971, abs=2e-4)
    assert next_due_date(
        make_drift(1.0, birge=0.5), START, LAST, (None, 10.0), 0.95
    ) == next_due_date(make_drift(1.0), START, LAST, (None, 10.0), 0.95)


def test_uncertain_slope_without_drift_has_due_date():
    # Two-sided: 1.9600 sqrt(0.1^2 + (0.2 t)^2) is 2.
    due = next_due_date(make_drift(0.0, u=0.2), START, LAST, (-2.0, 2.0), 0.95)
    expected = ((2.0 / 1.959964) ** 2 - 0.01) ** 0.5 / 0.2
    assert (due - START) / timedelta(days=365.25) == pytest.approx(expected, abs=2e-4)
    assert probability_within(make_drift(0.0, u=0.2), expected, -2.0, 2.0) == pytest.approx(0.95)


def test_value_outside_is_due_at_once_and_constant_value_never():
    assert next_due_date(make_drift(1.0), START, LAST, (None, 1.0), 0.95) == LAST
    assert next_due_date(make_drift(0.0), START, LAST, (-1.0, 1.0), 0.95) is None
    assert YEARS > 1.0

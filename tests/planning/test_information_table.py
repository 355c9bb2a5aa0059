"""The table of a search among runs whose noise walks."""

import pytest
from raising import raises

from counterspin.errors import CampaignError
from counterspin.planning.plan import plan

WALK = ('displacement = "0.01 m"', 'displacement = "0.01 m"\nacceleration = "3e-6 g/Hz^0.5"')


def test_excessive_run_length_raises(write_starter):
    """Without the bound the rows of 1e9 revolutions would be made."""
    with raises("value-out-of-range", "longest_run", "total_time"):
        plan(write_starter(WALK, ('total_time = "700 s"', 'total_time = "1e9 s"')))


def test_excessive_runs_and_attitudes_raise(write_starter):
    with pytest.raises(CampaignError, match=r"limits\.runs"):
        plan(write_starter(("runs = 14", "runs = 1000000000")))
    turned = ", ".join(f'"{i} deg about east"' for i in range(1, 90))
    new = f"attitudes = [{turned}]\nfewest_revolutions = 5"
    with pytest.raises(CampaignError, match=r"limits\.attitudes"):
        plan(write_starter(("fewest_revolutions = 5", new)))


def test_planned_run_too_long_for_forecast_raises(write_starter):
    with pytest.raises(CampaignError, match="a forecast can have at most"):
        plan(
            write_starter(
                ('total_time = "700 s"', 'total_time = "1e9 s"'), ("runs = 14", "runs = 1")
            )
        )

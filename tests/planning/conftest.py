"""Fixtures of the tests of planning."""

import tomllib
from functools import cache, partial

import pytest
from campaigns import replace_parts, write_description
from planning_setups import PERFECT

from counterspin.planning.plan import plan, write_example


@pytest.fixture
def write_plan(tmp_path):
    """Return a function that writes a plan with pairs of text replaced."""
    return lambda text, *pairs: write_description(
        tmp_path, replace_parts(text, *pairs), "PLAN.toml"
    )


@pytest.fixture
def write_starter(tmp_path, write_plan):
    """Return a function that writes the example plan with pairs of text replaced.

    Default priors are assumed perfect and a single rate is allowed, as in the plan of the paper.
    """
    original = write_example(tmp_path / "starter.toml").read_text(encoding="utf-8")
    return partial(write_plan, replace_parts(original, *PERFECT))


@cache
def _planned(text):
    return plan(tomllib.loads(text))


@pytest.fixture
def plan_starter(write_starter):
    """Return a function that plans the changed example, with a cache."""
    return lambda *pairs: _planned(write_starter(*pairs).read_text(encoding="utf-8"))

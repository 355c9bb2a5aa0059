"""What the tests of planning share."""

import tomllib
from functools import cache, partial

import pytest
from campaigns import changed, write
from planning_setups import PERFECT

from counterspin.planning.plan import plan, write_example


@pytest.fixture
def written(tmp_path):
    """Return what writes a plan, changed by pairs of text."""
    return lambda text, *pairs: write(tmp_path, changed(text, *pairs), "PLAN.toml")


@pytest.fixture
def starter(tmp_path, written):
    """Return what changes the example plan: pairs of text, found and put in its place.

    What is not stated is perfect and one rate will do, as for the paper's plan.
    """
    original = write_example(tmp_path / "starter.toml").read_text(encoding="utf-8")
    return partial(written, changed(original, *PERFECT))


@cache
def _planned(text):
    return plan(tomllib.loads(text))


@pytest.fixture
def plan_of(starter):
    """Return what plans the changed example; what several tests ask for is planned once."""
    return lambda *pairs: _planned(starter(*pairs).read_text(encoding="utf-8"))

"""What the tests of planning share."""

import tomllib
from functools import cache

import pytest

from counterspin.planning.plan import plan, write_example


@pytest.fixture
def starter(tmp_path):
    """Return what changes the example plan: pairs of text, found and put in its place."""
    original = write_example(tmp_path / "starter.toml").read_text(encoding="utf-8")

    def changed(*pairs):
        text = original
        for old, new in pairs:
            assert old in text
            text = text.replace(old, new)
        file = tmp_path / "PLAN.toml"
        file.write_text(text, encoding="utf-8")
        return file

    return changed


@cache
def _planned(text):
    return plan(tomllib.loads(text))


@pytest.fixture
def plan_of(starter):
    """Return what plans the changed example; what several tests ask for is planned once."""
    return lambda *pairs: _planned(starter(*pairs).read_text(encoding="utf-8"))

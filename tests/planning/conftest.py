"""What the tests of planning share."""

import pytest

from counterspin.planning.plan import write_example


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

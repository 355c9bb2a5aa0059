"""Codes of errors, and messages that several rooms share."""

import pickle

import pytest

from counterspin.campaign.validation import Problems
from counterspin.errors import (
    CampaignError,
    CounterspinError,
    InputError,
    Problem,
    RecordError,
    UsageError,
    describe_read_error,
)
from counterspin.physics.correction import NotInvertibleError
from counterspin.units import unit_factor


def test_campaign_problems_have_codes():
    problems = Problems({})
    problems.add(("site",), "is missing", "missing-key")
    problems.add(("runs",), Problem("are two", "duplicate-entry"))
    problems.collect(("site", "gravity"), unit_factor, "furlong", "m")
    error = CampaignError("campaign.toml", problems.lines)
    assert error.codes == ("missing-key", "duplicate-entry", "unknown-unit")
    assert error.code == "missing-key"
    assert len(error.problems) == 3
    assert error.problems[0] == "site: is missing"


def test_error_code_is_from_call_or_class():
    assert RecordError("x", code="no-rows").code == "no-rows"
    assert UsageError("plan", ["y"]).codes == ("wrong-usage",)
    assert CampaignError("a", ["b", "c"], code=("x", "y")).codes == ("x", "y")
    assert InputError("x").code == "invalid-value"
    assert CounterspinError("x").code == "unspecified"


@pytest.mark.parametrize(
    "error",
    [
        RecordError("a: b", code="no-rows"),
        UsageError("plan", ["a: b", "c"]),
        CampaignError("a", ["b", "c"], [None, 3], code=("x", "y")),
        NotInvertibleError(7, "did not converge in"),
    ],
)
def test_error_survives_pickling(error):
    copy = pickle.loads(pickle.dumps(error))
    assert (type(copy), str(copy), vars(copy)) == (type(error), str(error), vars(error))


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (FileNotFoundError(2, "No such file or directory"), "file not found"),
        (PermissionError(13, "denied"), "cannot be read (denied)"),
    ],
)
def test_missing_file_has_uniform_description(error, text):
    assert describe_read_error(error) == text

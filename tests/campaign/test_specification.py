"""[specification]: the grammar of limits, and errors with their keys."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from counterspin.campaign.description import read_campaign
from counterspin.campaign.specification import parse_specification, resolve_specifications
from counterspin.campaign.validation import Problems
from counterspin.errors import CampaignError
from counterspin.inference.conformity import DecisionRule, Specification
from counterspin.physics.terms import TERMS

G = 9.8


@pytest.mark.parametrize(
    ("text", "unit", "low", "high"),
    [
        ("abs <= 5e-5 g/g^2", "g/g^2", -5e-5, 5e-5),
        ("abs<=50ug/g^2", "g/g^2", -5e-5, 5e-5),
        ("  <=  5e-5   g/g^2 ", "g/g^2", None, 5e-5),
        ("≤ 5e-5 g/g^2", "g/g^2", None, 5e-5),
        (">= -1 mg", "g", -1e-3, None),
        (">= −1 mg", "g", -1e-3, None),
        ("0.99 to 1.01 g/g", "g/g", 0.99, 1.01),
        ("-5 to -.2e1 ppm", "g/g", -5e-6, -2e-6),
        ("1 ± 0.01 g/g", "g/g", 0.99, 1.01),
        ("0 +/- 20 ug/g^2", "g/g^2", -2e-5, 2e-5),
        ("0 +- 20 arcsec", "rad", -9.69627362e-5, 9.69627362e-5),
        ("abs <= 0.0098 m/s^2", "g", -1e-3, 1e-3),
    ],
)
def test_limits_are_parsed(text, unit, low, high):
    specification = parse_specification(text, unit, gravity=G)
    assert specification.unit == unit
    assert specification.low == (None if low is None else pytest.approx(low, rel=1e-8))
    assert specification.high == (None if high is None else pytest.approx(high, rel=1e-8))


@given(st.integers(-10_000, 10_000), st.integers(1, 10_000))
def test_range_and_tolerance_are_equivalent(middle, half):
    # Eighths are exact in binary: both forms then differ only by rounding of the units.
    middle, half = middle / 8, half / 8
    low, high = middle - half, middle + half
    spread = parse_specification(f"{middle!r} ± {half!r} ug/g^2", "g/g^2")
    between = parse_specification(f"{low!r} to {high!r} ug/g^2", "g/g^2")
    size = 1e-6 * max(abs(middle), half)
    assert spread.low == pytest.approx(between.low, abs=1e-12 * size)
    assert spread.high == pytest.approx(between.high, abs=1e-12 * size)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (5e-5, "must be a string, such as"),
        ("5e-5 g/g^2", "is not a specification; write"),
        ("", "is not a specification"),
        ("< 5e-5 g/g^2", "is not a specification"),
        ("abs <= 5e-5", "has no unit"),
        ("abs <= 5e-5 g", "is not a unit of"),
        ("abs <= 5e-5 gg", "unknown unit 'gg'"),
        ("abs <= -5e-5 g/g^2", "the limit of a magnitude must be greater than zero"),
        ("abs <= 0 g/g^2", "the limit of a magnitude must be greater than zero"),
        ("abs >= 5e-5 g/g^2", "only have an upper limit"),
        ("<= nan g/g^2", "not a finite number"),
        ("<= 1 ± 0.1 ug/g^2", "remove the ±"),
        ("2 to 1 ug/g^2", "the first limit must be below the second"),
        ("1 to 1 ug/g^2", "the first limit must be below the second"),
        ("1 ug/g^2 to 2 ug/g^2", "is not a specification"),
        ("1 to 2", "is not a specification"),
        ("1 ± 0 ug/g^2", "the tolerance must be greater than zero"),
        ("1 ± -1 ug/g^2", "negative"),
    ],
)
def test_rejects_invalid_specification(text, words):
    with pytest.raises(ValueError, match=r".") as caught:
        parse_specification(text, "g/g^2")
    assert words in str(caught.value)


# The table


def resolve_table(table, accelerometers=("Qx", "Qy")):
    problems = Problems({})
    specifications = resolve_specifications(table, accelerometers, problems=problems, gravity=G)
    assert (specifications is None) == bool(problems.lines)
    return specifications, problems.lines


def test_default_rule_applies_to_all_accelerometers():
    table, _ = resolve_table({"K_II": "abs <= 5e-5 g/g^2"})
    assert table.rule == DecisionRule("guarded", 1.0, 0.95)
    limits = Specification("abs <= 5e-5 g/g^2", -5e-5, 5e-5, "g/g^2")
    assert table.terms == {"Qx": {"K_II": limits}, "Qy": {"K_II": limits}}


def test_accelerometer_limits_override_common_limits():
    table, _ = resolve_table(
        {
            "decision_rule": "probability",
            "conformance_probability": 0.99,
            "K_II": "abs <= 5e-5 g/g^2",
            "Qy": {"K_II": "<= 1e-5 g/g^2", "K_F": "abs <= 5 mg"},
        }
    )
    assert table.rule == DecisionRule("probability", 1.0, 0.99)
    assert set(table.terms["Qx"]) == {"K_II"}
    assert table.terms["Qx"]["K_II"].high == 5e-5
    assert table.terms["Qy"]["K_II"].high == 1e-5
    assert table.terms["Qy"]["K_F"].high == pytest.approx(5e-3)


@pytest.mark.parametrize("symbol", TERMS)
def test_terms_can_be_specified_in_their_unit(symbol):
    unit = TERMS[symbol].unit
    table, _ = resolve_table({symbol: f"abs <= 1e-5 {unit}"})
    assert table.terms["Qx"][symbol] == Specification(f"abs <= 1e-5 {unit}", -1e-5, 1e-5, unit)


def test_all_errors_are_reported_by_key():
    _, lines = resolve_table(
        {
            "decision_rule": "lenient",
            "guard_factor": -1,
            "conformance_probability": 0.4,
            "K_II": "5e-5 g/g^2",
            "K_IV": "abs <= 1 g",
            "decisionrule": "simple",
            "platform.tilt": "abs <= 1 arcsec",
            "Qz": {"K_F": "abs <= 1 mg"},
            "Qx": {"K_F": "abs <= 1 rad", "bias": "abs <= 1 mg"},
        }
    )
    starts = [
        "specification.decision_rule: must be 'simple', 'guarded' or 'probability'",
        "specification.guard_factor: must not be negative",
        "specification.conformance_probability: must be between 0.5 and 1",
        "specification.K_II: '5e-5 g/g^2' is not a specification",
        'specification.K_IV: unknown term "K_IV"; did you mean "K_I',
        'specification.decisionrule: unknown term "decisionrule"; did you mean "deci',
        'specification."platform.tilt": is a machine term',
        'specification.Qz: no accelerometer is named "Qz"',
        "specification.Qx.K_F: ",
        'specification.Qx.bias: unknown term "bias"',
    ]
    assert len(lines) == len(starts)
    for start in starts:
        assert any(line.startswith(start) for line in lines), (start, lines)


@pytest.mark.parametrize(
    ("table", "line"),
    [
        ({}, "specification: contains no term; write, for example, K_II ="),
        ({"decision_rule": "simple", "Qx": {}}, "specification: contains no term"),
        (
            {"decision_rule": "simple", "guard_factor": 1, "K_F": "<= 1 g"},
            "specification.guard_factor: applies to the decision rule 'guarded', not to 'simple'",
        ),
        (
            {"conformance_probability": 0.9, "K_F": "<= 1 g"},
            "specification.conformance_probability: applies to the decision rule 'probability'",
        ),
        ({"guard_factor": "1", "K_F": "<= 1 g"}, "specification.guard_factor: must be a number"),
        ({"guard_factor": {"a": 1}, "K_F": "<= 1 g"}, "specification.guard_factor: must be a num"),
        (
            {"platform.drift.up": "<= 1 deg/h"},
            'specification."platform.drift.up": is a machine term',
        ),
        ({"platform": {"tilt": "<= 1 arcsec"}}, "specification.platform: is a machine term"),
    ],
)
def test_error_in_table_names_key(table, line):
    _, lines = resolve_table(table)
    assert any(found.startswith(line) for found in lines), lines


# In a campaign


def test_campaign_contains_specifications(tmp_path, starter):
    path = tmp_path / "campaign.toml"
    path.write_text(starter + '\n[specification]\nK_II = "abs <= 5e-5 g/g^2"\n', encoding="utf-8")
    specifications = read_campaign(path).specifications
    assert {name: set(terms) for name, terms in specifications.terms.items()} == {
        name: {"K_II"} for name in read_campaign(path).accelerometers
    }
    path.write_text(starter, encoding="utf-8")
    assert read_campaign(path).specifications is None


def test_errors_are_reported_with_those_of_other_sections(tmp_path, starter):
    path = tmp_path / "campaign.toml"
    text = starter + '\n[specification]\nK_II = "5"\n\n[sight]\n'
    path.write_text(text, encoding="utf-8")
    with pytest.raises(CampaignError) as caught:
        read_campaign(path)
    assert any(line.startswith("specification.K_II: ") for line in caught.value.problems)
    assert any(line.startswith("sight: ") for line in caught.value.problems)


@pytest.mark.parametrize("value", ['"text"', "[1]", "5"])
def test_rejects_specification_that_is_not_a_table(tmp_path, starter, value):
    path = tmp_path / "campaign.toml"
    path.write_text(
        starter.replace("schema = 1", f"schema = 1\nspecification = {value}"), encoding="utf-8"
    )
    with pytest.raises(CampaignError, match="specification: must be a table"):
        read_campaign(path)


@pytest.fixture
def starter():
    from importlib.resources import files

    return (files("counterspin.ingest") / "starter.toml").read_text(encoding="utf-8")


def resolve_process(process):
    raw = {"K_II": "abs <= 5e-5 g/g^2", "process": process}
    problems = Problems({"specification": raw})
    return resolve_specifications(raw, ["Qx"], problems=problems, gravity=G), problems.lines


def test_process_has_mean_and_standard_deviation():
    specifications, problems = resolve_process({"K_II": "1 ± 25 ug/g^2"})
    assert problems == []
    process = specifications.terms["Qx"]["K_II"].process
    assert (process.mean, process.sigma) == pytest.approx((1e-6, 25e-6))


@pytest.mark.parametrize(
    ("process", "message"),
    [
        ({"K_II": "1 ug/g^2"}, "specification.process.K_II: needs a standard deviation"),
        ({"K_F": "0 ± 1 mg"}, 'specification.process.K_F: "K_F" has no limits'),
        ({"K_II": "0 ± 1 m"}, "specification.process.K_II: "),
        ({"K_II": 1.0}, "specification.process.K_II: "),
    ],
)
def test_errors_in_process_are_named(process, message):
    specifications, problems = resolve_process(process)
    assert specifications is None
    assert problems[0].startswith(message)

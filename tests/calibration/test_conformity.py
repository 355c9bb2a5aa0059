"""Conformity statements of a calibration by both methods."""

import pytest
from campaigns import SMALL, write_description
from results import make_accelerometer_result

from counterspin.calibration.calibrate import calibrate
from counterspin.calibration.conformity import judge_accelerometer, judge_conformity
from counterspin.calibration.options import TwoStageOptions
from counterspin.calibration.pages.document import result_blocks
from counterspin.calibration.pages.verdict import conformity_blocks
from counterspin.calibration.result import Result
from counterspin.campaign.specification import resolve_specifications
from counterspin.campaign.validation import Problems
from counterspin.inference.conformity import DecisionRule, Specification, decide
from counterspin.simulation.simulate import simulate

# K_II of Qx is 27 and of Qy -32 ug/g^2, u below 0.4 by either method; K_PO is not in the model.
SPECIFIED = (
    SMALL
    + """
[specification]
K_II = "abs <= 50 ug/g^2"
K_PO = "abs <= 50 ug/g^2"

[specification.Qy]
K_II = "abs <= 20 ug/g^2"
"""
)


@pytest.fixture(scope="module")
def records(tmp_path_factory):
    folder = tmp_path_factory.mktemp("specified")
    simulate(write_description(folder, SPECIFIED, "plan.toml"), folder / "records")
    return folder / "records"


@pytest.fixture(scope="module", params=["joint", "two-stage"])
def conformity_result(records, request):
    return calibrate(records, method=request.param)


def test_result_contains_verdicts(conformity_result, tmp_path):
    verdicts = {
        (name, symbol): verdict.verdict
        for name, accelerometer in conformity_result.accelerometers.items()
        for symbol, verdict in accelerometer.conformity.items()
    }
    assert verdicts == {
        ("Qx", "K_II"): "pass",
        ("Qx", "K_PO"): "undecided",
        ("Qy", "K_II"): "fail",
        ("Qy", "K_PO"): "undecided",
    }
    conformity_result.write(tmp_path / "r.json")
    assert Result.read(tmp_path / "r.json") == conformity_result


def test_verdict_follows_from_estimate(conformity_result):
    k_ii = conformity_result.accelerometers["Qx"].coefficients["K_II"]
    verdict = conformity_result.accelerometers["Qx"].conformity["K_II"]
    limits = Specification(verdict.specification, verdict.low, verdict.high, "g/g^2")
    assert verdict == decide(k_ii.value, k_ii.u, k_ii.dof, limits, DecisionRule("guarded"))
    assert (verdict.low, verdict.high) == (pytest.approx(-50e-6), pytest.approx(50e-6))
    assert (verdict.rule, verdict.unit, verdict.reason) == ("guarded", "g/g^2", None)


def test_as_printed_model_has_no_verdict(records):
    printed = calibrate(records, method="two-stage", options=TwoStageOptions(model="as-printed"))
    verdict = printed.accelerometers["Qy"].conformity["K_II"]
    assert verdict.verdict == "undecided"
    assert "half the true K_II" in verdict.reason
    assert verdict.probability is None


def test_campaign_without_specification_has_no_verdict(records, tmp_path):
    for record in records.glob("*.csv"):
        (tmp_path / record.name).write_bytes(record.read_bytes())
    plain = calibrate(write_description(tmp_path, SMALL).parent, method="two-stage")
    assert all(not accelerometer.conformity for accelerometer in plain.accelerometers.values())
    assert list(conformity_blocks(plain)) == []


def make_accelerometer(**k_ii):
    return make_accelerometer_result(coefficients={"K_II": {"unit": "g/g^2", **k_ii}})


def make_specifications(**table):
    problems = Problems({})
    stated = resolve_specifications(table, ["Qx"], problems=problems, gravity=9.8)
    assert problems.lines == []
    return stated


@pytest.mark.parametrize("value", [2e-5, None])
def test_prior_is_not_judged(value):
    stated = make_specifications(K_II="abs <= 5e-5 g/g^2")
    known = make_accelerometer(value=value, u=None if value is None else 1e-6, estimated=False)
    verdict = judge_accelerometer(known, stated.terms["Qx"], stated.rule, model="exact")["K_II"]
    assert verdict.verdict == "undecided"
    assert verdict.reason == "the records do not determine K_II"
    assert (verdict.guard_band, verdict.probability, verdict.risk) == (None, None, None)


@pytest.mark.parametrize(
    ("rule", "reason"),
    [
        ({"decision_rule": "guarded", "guard_factor": 2.0}, "less than the guard band"),
        (
            {"decision_rule": "probability", "conformance_probability": 0.999},
            "reaches 0.999",
        ),
    ],
)
def test_undecided_verdict_has_reason(rule, reason):
    stated = make_specifications(K_II="<= 5e-5 g/g^2", **rule)
    near = make_accelerometer(value=4.8e-5, u=1e-6, dof=5.0, estimated=True)
    verdict = judge_accelerometer(near, stated.terms["Qx"], stated.rule, model="exact")["K_II"]
    assert verdict.verdict == "undecided"
    assert reason in verdict.reason
    assert verdict.risk is None
    assert 0.9 < verdict.probability < 0.999
    assert verdict.needed == rule.get("conformance_probability")


# In the report


def joined_text(blocks):
    return "\n".join(getattr(block, "text", "") for block in blocks)


def test_report_shows_verdicts_before_coefficients(conformity_result):
    blocks = result_blocks(conformity_result)
    places = {getattr(block, "text", None): i for i, block in enumerate(blocks)}
    assert places["Conformity"] < places["Accelerometer Qx"]
    table = blocks[places["Conformity"] + 1]
    cells = [(row[0], row[1], row[3], row[4], *row[5:]) for row in table.rows]
    assert cells == [
        ("Qx", "K_II", "-50 to 50", "ug/g^2", "pass", "> 99.9 %", "< 0.1 %"),
        ("Qx", "K_PO", "-50 to 50", "ug/g^2", "undecided", "-", "-"),
        ("Qy", "K_II", "-20 to 20", "ug/g^2", "fail", "< 0.1 %", "< 0.1 %"),
        ("Qy", "K_PO", "-50 to 50", "ug/g^2", "undecided", "-", "-"),
    ]
    assert table.quiet_rows == {1, 3}
    text = joined_text(blocks)
    assert "K_II of Qy does not meet the specification." in text
    assert (
        "Conformity of K_PO of Qx is undecided, because K_PO is not among the terms of the model."
        in text
    )
    assert "Decision rule: guard bands of width w." in text
    assert "Widths w of the guard bands: K_II of Qx 0." in text


@pytest.mark.parametrize(
    ("rule", "words"),
    [
        (
            {"decision_rule": "simple"},
            "simple acceptance. The verdict depends only on the estimate.",
        ),
        (
            {"decision_rule": "probability", "conformance_probability": 0.99999},
            "with a probability of at least 99.999 %",
        ),
    ],
)
def test_decision_rule_is_stated(conformity_result, rule, words):
    text = joined_text(
        conformity_blocks(
            judge_conformity(conformity_result, make_specifications(K_II="<= 1 g/g^2", **rule))
        )
    )
    assert words in text
    assert "guard bands" not in text


def test_report_has_global_risk_for_stated_process(conformity_result):
    process = {"K_II": "0 ± 25 ug/g^2"}
    raw = {"decision_rule": "simple", "K_II": "abs <= 50 ug/g^2", "process": process}
    specifications = resolve_specifications(
        raw, conformity_result.accelerometers, problems=Problems({}), gravity=None
    )
    judged = judge_conformity(conformity_result, specifications)
    risk = judged.accelerometers["Qx"].conformity["K_II"].global_risk
    assert (risk.mean, risk.sigma) == (0.0, pytest.approx(25e-6))
    assert 0.0 < risk.consumer < risk.producer
    texts = [block.text for block in conformity_blocks(judged) if hasattr(block, "text")]
    assert any("consumer's risk" in text and "0 ± 25 ug/g^2" in text for text in texts)
    assert Result.model_validate_json(judged.to_json()) == judged

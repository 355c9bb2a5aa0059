"""Findings on a result: rank, state and consequences."""

import json
from pathlib import Path

import pytest
from results import make_qx_result

import counterspin as cs
from certificates import LAB, write_lab
from counterspin import cli
from counterspin.calibration.findings import (
    Cause,
    judge_result,
    lack_of_fit_finding,
    not_determined_finding,
    rank_findings,
    refusal_reason,
)
from counterspin.calibration.result import Result
from counterspin.calibration.result_parts import Finding, Residual
from counterspin.inference.distributions import chi_square_tail
from counterspin.results import _compute_seal


def judge_changed(**changes):
    return judge_result(make_qx_result(**changes))


def finding_codes(result):
    return [finding.code for finding in result.findings]


def test_good_result_has_no_findings():
    calibration = judge_changed()
    assert (calibration.state, calibration.findings) == ("good", [])
    assert calibration.accelerometers["Qx"].state == "good"
    assert refusal_reason(calibration, ["Qx"]) is None


def make_jackknife(z, dof=None):
    return [{"run": "slow", "value": 1e-5, "shift": 1e-8, "z": z, "dof": dof}]


def make_two_stage(z):
    return {"value": 1e-5, "u": 1e-9, "difference": 1e-8, "u_difference": 1e-9, "z": z}


def make_residual(times, p=0.0):
    chi2 = 100.0 * times**2
    return {"rms": 0.01, "unit": "m", "dof": 100.0, "chi2": chi2, "lack_of_fit_p": p}


def make_walk_noise(ug):
    noise = {"value": ug * 9.8e-6, "unit": "m/s^2/Hz^0.5", "estimated": True}
    return {"acceleration": noise}


NOTHING = {"K_II": {"value": None, "u": None, "unit": "g/g^2", "estimated": False}}


@pytest.mark.parametrize(
    ("change", "code", "state", "size"),
    [
        ({"residual": make_residual(1.2, 0.02)}, None, "good", None),
        ({"residual": make_residual(1.3, 0.001)}, "lack-of-fit", "reservations", 1.3),
        ({"residual": make_residual(1.9)}, "lack-of-fit", "reservations", 1.9),
        ({"residual": make_residual(2.1)}, "lack-of-fit", "contradicted", 2.1),
        (
            {"residual": {"rms": 1.0, "unit": "m", "dof": 9.0, "lack_of_fit_p": 0.0026998}},
            "lack-of-fit",
            "reservations",
            3.0,
        ),
        ({"jackknife": make_jackknife(2.9)}, None, "good", None),
        ({"jackknife": make_jackknife(-3.1)}, "run-disagrees", "reservations", 3.1),
        ({"jackknife": make_jackknife(-6.1)}, "run-disagrees", "contradicted", 6.1),
        # One of sixteen shifts exceeds 3.2 in 2.2 % of good campaigns.
        ({"jackknife": [*make_jackknife(3.2), *(15 * make_jackknife(0.0))]}, None, "good", None),
        (
            {"jackknife": [*make_jackknife(3.9), *(15 * make_jackknife(0.0))]},
            "run-disagrees",
            "reservations",
            3.9,
        ),
        # Student's t of 3.5 with five degrees of freedom is as rare as a normal 2.38; 9 as 3.63.
        ({"jackknife": make_jackknife(3.5, dof=5.0)}, None, "good", None),
        ({"jackknife": make_jackknife(9.0, dof=5.0)}, "run-disagrees", "reservations", 3.63068),
        ({"two_stage": make_two_stage(2.9)}, None, "good", None),
        ({"two_stage": make_two_stage(-10.0)}, "methods-disagree", "reservations", 10.0),
        ({"noise": make_walk_noise(499.0)}, None, "good", None),
        ({"noise": make_walk_noise(1335.0)}, "noise-implausible", "contradicted", 2.67),
        ({"coefficients": NOTHING}, "not-determined", "reservations", None),
        ({"warnings": ["Qx: something is odd"]}, "warning", "reservations", None),
    ],
)
def test_finding_and_state_of_change(change, code, state, size):
    calibration = judge_changed(**change)
    assert finding_codes(calibration) == ([] if code is None else [code])
    assert calibration.state == calibration.accelerometers["Qx"].state == state
    assert calibration.accelerometers["Qx"].findings == calibration.findings
    if code is not None:
        assert calibration.findings[0].size == (
            None if size is None else pytest.approx(size, rel=1e-4)
        )
        assert calibration.findings[0].contradicts == (state == "contradicted")
        assert calibration.findings[0].subject.startswith("Qx")


def _make_undetermined(symbol="K_III", *, requested=True):
    return not_determined_finding(
        f"Qx.{symbol}", symbol, advice=" Add a run.", is_requested=requested
    )


def test_undetermined_requested_term_has_state_not_determined():
    calibration = judge_changed(
        findings=[_make_undetermined(), _make_undetermined("K_I", requested=False)]
    )
    assert calibration.state == calibration.accelerometers["Qx"].state == "not-determined"
    assert [finding.subject for finding in calibration.findings] == ["Qx.K_III", "Qx.K_I"]
    # Reservations of any size follow it; a contradiction precedes it.
    doubtful = judge_changed(findings=[_make_undetermined()], two_stage=make_two_stage(-10.0))
    assert finding_codes(doubtful) == ["not-determined", "methods-disagree"]
    wrong = judge_changed(findings=[_make_undetermined()], jackknife=make_jackknife(-6.1))
    assert (finding_codes(wrong)[0], wrong.state) == ("run-disagrees", "contradicted")


def test_undetermined_usual_term_is_information():
    calibration = judge_changed(findings=[_make_undetermined(requested=False)])
    assert calibration.state == "reservations"


def test_as_printed_model_is_never_good():
    printed = judge_result(make_qx_result().model_copy(update={"model": "as-printed"}))
    assert finding_codes(printed) == ["as-printed"]
    assert printed.state == "reservations"


def test_findings_are_in_order_of_severity():
    calibration = judge_changed(
        jackknife=make_jackknife(-6.1),
        two_stage=make_two_stage(10.0),
        noise=make_walk_noise(5000.0),
    )
    assert finding_codes(calibration) == ["noise-implausible", "run-disagrees", "methods-disagree"]


def test_cause_that_explains_most_comes_first():
    small = Finding(code="wrong-scale", subject="r2.Qx", text="Scale.", size=10.0)
    above = small.model_copy(update={"explains": [Finding(code="jump", subject="Qx", text="It.")]})
    large = Finding(code="term-missing", subject="Qx.K_4", text="Term.", size=18.0)
    causes = [Cause(large, ("Qx",), {}), Cause(small, ("Qx",), {})]
    assert rank_findings([above, large], causes) == [large, above]
    assert rank_findings([large, above]) == [above, large]  # without information on causes
    grave = above.model_copy(update={"contradicts": True})
    assert rank_findings([large, grave], causes) == [grave, large]


def test_wrong_noise_is_single_finding():
    # All shifts exceed u because the noise is ten times as large as stated.
    judged = judge_changed(
        residual=make_residual(10.0),
        jackknife=make_jackknife(25.0),
        two_stage=make_two_stage(-29.0),
    )
    assert finding_codes(judged) == ["lack-of-fit"]
    calibration = judge_changed(residual=make_residual(10.0), jackknife=make_jackknife(65.0))
    assert finding_codes(calibration) == ["lack-of-fit", "run-disagrees"]


def test_findings_of_checks_are_also_warnings():
    odd = Finding(code="odd", subject="Qx.K_II", text="It is odd.", size=4.0)
    drift = Finding(code="large-drift", subject="platform.drift.north", text="It is large.")
    result = judge_result(make_qx_result(findings=[odd]).model_copy(update={"findings": [drift]}))
    assert finding_codes(result) == ["odd", "large-drift"]
    assert finding_codes(result.accelerometers["Qx"]) == ["odd"]
    assert result.accelerometers["Qx"].warnings == ["Qx: It is odd."]
    assert result.warnings == ["It is large."]


def test_state_of_result_is_worst_of_accelerometers():
    first, second = (
        make_qx_result(**change).accelerometers["Qx"]
        for change in ({}, {"jackknife": make_jackknife(-6.1)})
    )
    both = make_qx_result().model_copy(update={"accelerometers": {"Qx": first, "Qy": second}})
    calibration = judge_result(both)
    assert calibration.accelerometers["Qx"].state == "good"
    assert calibration.accelerometers["Qy"].state == "contradicted"
    assert calibration.state == "contradicted"
    assert refusal_reason(calibration, ["Qx"]) is None
    assert refusal_reason(calibration, ["Qx", "Qy"]).startswith(
        "the records contradict the result for Qy: "
    )


def test_reason_is_stored_only_for_contradicted_result():
    assert judge_result(make_qx_result(), "it is fine").accepted_misfit is None
    calibration = judge_result(make_qx_result(jackknife=make_jackknife(-6.1)), "it is fine")
    assert calibration.state == "contradicted"
    assert calibration.accepted_misfit == "it is fine"
    assert refusal_reason(calibration, ["Qx"]) is None


def test_judging_is_idempotent(tmp_path):
    calibration = judge_changed(jackknife=make_jackknife(-6.1))
    assert judge_result(calibration) == calibration
    calibration.write(tmp_path / "r.json")
    assert judge_result(Result.read(tmp_path / "r.json")) == calibration


@pytest.mark.parametrize(("dof", "contradicts"), [(2.0, False), (40.0, True)])
def test_lack_of_fit_of_few_residuals_may_be_chance(dof, contradicts):
    """2.3 times the noise occurs once in 200 campaigns for two residuals, never for forty."""
    chi2 = dof * 2.3**2
    p = chi_square_tail(dof, chi2)
    residual = Residual(rms=2.3, unit="g", dof=dof, chi2=chi2, lack_of_fit_p=p)
    assert lack_of_fit_finding("A", ["They are large."], residual).contradicts is contradicts


# Edited results


@pytest.fixture
def edited_result(tmp_path, monkeypatch):
    """Return a contradicted result whose state was edited to good."""
    monkeypatch.chdir(tmp_path)
    write_lab(tmp_path)
    (tmp_path / "forces.csv").write_text("Qx\n0.5\n1.0\n")
    document = json.loads(judge_changed(residual=make_residual(2.1)).to_json())
    qx = document["accelerometers"]["Qx"]
    assert (document["state"], qx["state"]) == ("contradicted", "contradicted")
    document["details"] = {"date": "2026-03-01"}
    for part in (document, qx):
        part.update(state="good", findings=[], warnings=[])
    return document


@pytest.mark.parametrize(
    "words",
    [
        ["certificate", "r.json", "LAB.toml", "-o", "c.xml"],
        ["apply", "r.json", "forces.csv", "--accelerometer", "Qx", "-o", "c.csv"],
        ["history", "r.json"],
        ["compare", "r.json", "r.json"],
        ["report", "r.json"],
        ["ledger", "add", "ledger.jsonl", "r.json", "--who", "A", "--why", "B"],
    ],
)
def test_commands_reject_edited_result(edited_result, tmp_path, capsys, words):
    (tmp_path / "r.json").write_text(json.dumps(edited_result))
    before = sorted(tmp_path.iterdir())
    assert cli.main(words) == 1
    captured = capsys.readouterr()
    assert "the seal does not match" in " ".join(f"{captured.out} {captured.err}".split())
    assert sorted(tmp_path.iterdir()) == before


def test_result_without_seal_is_judged_again(edited_result, tmp_path, capsys):
    del edited_result["seal"]
    (tmp_path / "r.json").write_text(json.dumps(edited_result))
    again = judge_result(Result.read("r.json"))
    assert (again.state, finding_codes(again)) == ("contradicted", ["lack-of-fit"])
    assert judge_result(again) == again
    assert cli.main(["certificate", "r.json", "LAB.toml", "-o", "c.xml"]) == 1
    assert "the result for Qx" in capsys.readouterr().err
    assert cli.main(["apply", "r.json", "forces.csv", "--accelerometer", "Qx", "-o", "c.csv"]) == 1


@pytest.mark.parametrize("stated", ["reservations", "contradicted"])
def test_state_without_seal_does_not_improve(edited_result, tmp_path, stated):
    edited_result |= {"seal": None, "state": stated}
    edited_result["accelerometers"]["Qx"] |= {"state": stated, "residual": make_residual(1.0, 0.5)}
    finding = Finding(code="cause", subject="Qx", text="It was wrong.").model_dump()
    for part in (edited_result, edited_result["accelerometers"]["Qx"]):
        part["findings"] = [finding]
    (tmp_path / "r.json").write_text(json.dumps(edited_result))
    again = judge_result(Result.read("r.json"))
    assert again.state == again.accelerometers["Qx"].state == stated
    assert (refusal_reason(again, ["Qx"]) is None) == (stated == "reservations")


def test_explained_findings_are_not_repeated(tmp_path):
    cause = Finding(
        code="cause",
        subject="Qx",
        text="It was wrong.",
        explains=[Finding(code="lack-of-fit", subject="Qx", text="Odd.")],
    )
    document = json.loads(judge_changed(residual=make_residual(2.1)).to_json())
    stated = [cause.model_dump()]
    document |= {"seal": None, "state": "reservations", "findings": stated}
    document["accelerometers"]["Qx"] |= {"state": "reservations", "findings": stated}
    (tmp_path / "r.json").write_text(json.dumps(document))
    again = judge_result(Result.read(tmp_path / "r.json"))
    assert (again.state, finding_codes(again)) == ("reservations", ["cause"])


FROZEN = Path(__file__).parents[1] / "frozen" / "schema-1-joint.json"


def write_earlier_result(folder, **values):
    """Write a changed result of schema 1, which has no check for incredible values."""
    document = json.loads(FROZEN.read_text(encoding="utf-8"))
    for symbol, value in values.items():
        document["accelerometers"]["Qx"]["coefficients"][symbol] |= {
            "value": value,
            "estimated": True,
        }
    (folder / "old.json").write_text(json.dumps(document), encoding="utf-8")
    return judge_result(Result.read(folder / "old.json"))


@pytest.mark.parametrize(
    ("symbol", "value"), [("K_I", -1.0006), ("K_I", 9.8), ("K_F", 3.0), ("K_II", 0.1)]
)
def test_earlier_result_is_checked_for_incredible_values(
    tmp_path, monkeypatch, capsys, symbol, value
):
    monkeypatch.chdir(tmp_path)
    write_lab(tmp_path, LAB.replace('"0815"', '"P-7"'))
    before = write_earlier_result(tmp_path)
    earlier_result = write_earlier_result(tmp_path, **{symbol: value})
    assert not any(f.code == "incredible" for f in before.findings)
    assert earlier_result.state == earlier_result.accelerometers["Qx"].state == "contradicted"
    assert ("incredible", f"Qx.{symbol}") in {(f.code, f.subject) for f in earlier_result.findings}
    assert refusal_reason(earlier_result, ["Qy"]) is None
    assert cli.main(["certificate", "old.json", "LAB.toml", "-o", "c.xml"]) == 1
    assert f"{symbol} = {value:g}" in " ".join(capsys.readouterr().err.split())
    read = cs.history(["old.json"]).left_out
    assert any("is not credible" in one.reason for one in read if one.accelerometer == "Qx")
    assert cs.compare("old.json", "old.json").results[0].state == "contradicted"


def test_earlier_result_may_have_any_grade(tmp_path):
    """The file does not state the grade: a bias of 0.3 g is credible for a consumer grade."""
    earlier_result = write_earlier_result(tmp_path, K_F=0.3)
    assert not any(f.code == "incredible" for f in earlier_result.findings)


def test_platform_and_unstated_terms_of_earlier_result_are_checked(tmp_path):
    document = json.loads(FROZEN.read_text(encoding="utf-8"))
    document["platform"]["platform.drift.north"] |= {"value": 1e-3, "u": 1e-6}
    (tmp_path / "old.json").write_text(json.dumps(document), encoding="utf-8")
    calibration = judge_result(Result.read(tmp_path / "old.json"))
    assert ("incredible", "platform.drift.north") in {
        (f.code, f.subject) for f in calibration.findings
    }
    assert calibration.state == "contradicted"


def test_result_without_seal_is_checked_for_incredible_values(tmp_path):
    document = json.loads(judge_changed().to_json())
    document["seal"] = None
    document["accelerometers"]["Qx"]["coefficients"]["K_II"] |= {"value": 0.1}
    row = {"name": "Qx.K_OO", "kind": "unstated", "value": 0.0, "u": 2e-6, "unit": "g/g^2"}
    document["rests_on"] = [{**row, "found": 1e-5, "u_found": 1e-7}]
    (tmp_path / "r.json").write_text(json.dumps(document), encoding="utf-8")
    again = judge_result(Result.read(tmp_path / "r.json"))
    assert again.state == "contradicted"
    assert finding_codes(again) == ["incredible", "beyond-typical"]
    assert judge_result(again) == again


def test_sealed_result_of_schema_1_is_checked_for_incredible_values(tmp_path):
    document = json.loads((FROZEN.parent / "repeat" / "result.json").read_text(encoding="utf-8"))
    (name,) = document["accelerometers"]
    for sign, state in ((1.0, "good"), (-1.0, "contradicted")):
        document["accelerometers"][name]["coefficients"]["K_I"]["value"] = sign * 1.0006
        document["seal"] = _compute_seal(json.dumps(document))
        (tmp_path / "old.json").write_text(json.dumps(document), encoding="utf-8")
        read = Result.read(tmp_path / "old.json")
        assert (read.sealed, read.state) == (True, "good")
        assert judge_result(read).state == state

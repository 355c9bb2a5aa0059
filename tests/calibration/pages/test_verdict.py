"""Sentences on the state of a result."""

import pytest
from results import make_qx_result

from counterspin.calibration.findings import judge_result
from counterspin.calibration.pages.verdict import misfit_blocks, verdict_blocks, verdict_sentence


def make_sentence(**changes):
    return verdict_sentence("Qx", judge_result(make_qx_result(**changes)).accelerometers["Qx"])


def test_sentence_of_good_result():
    assert make_sentence() == (
        "The result for Qx passed all checks: the residuals are consistent with the stated noise "
        "(p = 0.5); no single run dominates the result; the two-stage result agrees "
        "with the joint result."
    )


def test_reservations_state_most_serious_finding_and_number_of_others():
    sentence = make_sentence(
        warnings=["Qx: one", "Qx: two"],
        jackknife=[{"run": "slow", "value": 1e-5, "shift": 1e-8, "z": -3.1}],
    )
    assert sentence == (
        "The result for Qx is usable with reservations: Omitting slow shifts K_II by 0.01 "
        "ug/g^2, which is 3.1 times the standard uncertainty of the shift. This run is "
        "therefore not consistent with the others. 2 more findings are listed below. Passed "
        "checks: the residuals are consistent with the stated noise (p = 0.5); the two-stage "
        "result agrees with the joint result."
    )


def test_contradicted_result_lists_no_passed_checks():
    sentence = make_sentence(jackknife=[{"run": "slow", "value": 1e-5, "shift": 1e-8, "z": -6.1}])
    assert sentence.startswith(
        "The result for Qx is contradicted by the records and must not be used: Omitting"
    )
    assert "Passed checks" not in sentence


def test_undetermined_result_lists_no_passed_checks():
    lacking = {"code": "not-determined", "subject": "Qx.K_III", "text": "Add a run."}
    lacking["undetermined"] = True
    calibration = judge_result(make_qx_result(findings=[lacking]))
    sentence = verdict_sentence("Qx", calibration.accelerometers["Qx"])
    assert sentence == "The result for Qx is not fully determined by the data: Add a run."
    (first,) = misfit_blocks(calibration)
    assert first.style == "undetermined"
    assert first.text.startswith(
        "The data do not fully determine this result (Qx.K_III). Add a run."
    )
    (paragraph,) = verdict_blocks(calibration)
    assert paragraph.style == "undetermined"


@pytest.mark.parametrize(("z", "lines"), [(1.0, 0), (4.0, 0), (7.0, 1)])
def test_only_contradiction_precedes_numbers(z, lines):
    jackknife = [{"run": "slow", "value": 1e-5, "shift": 1e-8, "z": z}]
    assert len(list(misfit_blocks(judge_result(make_qx_result(jackknife=jackknife))))) == lines


def test_sentence_of_cause_includes_explained_findings():
    misfit = {"code": "lack-of-fit", "subject": "Qx", "text": "The residuals are large."}
    cause = {
        "code": "wrong-input",
        "subject": "centrifuge.radius",
        "text": "A radius of 2.5 m would fit.",
        "explains": [misfit],
    }
    assert make_sentence(findings=[cause]).startswith(
        "The result for Qx is usable with reservations: A radius of 2.5 m would fit. This "
        "explains these other findings: The residuals are large. Passed checks"
    )


def test_contradicted_result_without_findings_has_no_warning():
    result = make_qx_result().model_copy(update={"state": "contradicted"})
    assert list(misfit_blocks(result)) == []

"""Grouping of findings under their cause."""

from results import make_qx_result

from counterspin.calibration.findings import (
    Cause,
    group_by_cause,
    judge_result,
    merge_shared_findings,
)
from counterspin.calibration.result_parts import Finding

MISFIT = Finding(code="lack-of-fit", subject="Qx", text="Large.", size=8.0, contradicts=True)
RUN = Finding(code="run-disagrees", subject="Qx.K_II", text="Run.", size=4.0)
OTHER = Finding(code="methods-disagree", subject="Qx.K_II", text="Other.", size=5.0)
DRIFT = Finding(code="large-drift", subject="platform.drift.north", text="Drift.", size=2.0)
HEAD = Finding(code="wrong-input", subject="centrifuge.radius", text="A radius.", size=900.0)


def make_cause(*remaining, names=("Qx",)):
    return Cause(HEAD, names, {(code, subject): size for code, subject, size in remaining})


def explained_codes(*found, causes, name="Qx"):
    return [
        (finding.code, [other.code for other in finding.explains])
        for finding in group_by_cause(name, found, causes)
    ]


def test_findings_removed_by_cause_are_explained():
    actual_explained_codes = explained_codes(
        MISFIT, RUN, DRIFT, causes=[make_cause(("run-disagrees", "Qx.K_II", 3.9))]
    )
    assert actual_explained_codes == [
        ("wrong-input", ["lack-of-fit"]),
        ("run-disagrees", []),
        ("large-drift", []),
    ]


def test_nearly_removed_finding_is_explained():
    assert explained_codes(MISFIT, causes=[make_cause(("lack-of-fit", "Qx", 1.02))])[0][1] == [
        "lack-of-fit"
    ]
    assert explained_codes(MISFIT, causes=[make_cause(("lack-of-fit", "Qx", 3.0))])[0][1] == []


def test_method_disagreement_is_explained_with_residuals():
    assert explained_codes(OTHER, causes=[make_cause()])[0][1] == ["methods-disagree"]
    assert explained_codes(OTHER, causes=[make_cause(("lack-of-fit", "Qx", 1.5))])[0][1] == []


def test_cause_does_not_explain_other_accelerometer():
    assert explained_codes(MISFIT, causes=[make_cause(names=("Qy",))]) == [("lack-of-fit", [])]


def test_cause_has_severity_of_explained_findings():
    (head,) = group_by_cause("Qx", [MISFIT], [make_cause()])
    assert head.contradicts
    assert not HEAD.contradicts


def test_common_cause_of_two_accelerometers_is_single_finding():
    own = group_by_cause("Qx", [MISFIT], [make_cause()])
    (both,) = merge_shared_findings([*own, HEAD.model_copy(update={"explains": [RUN]})])
    assert [finding.code for finding in both.explains] == ["lack-of-fit", "run-disagrees"]


def test_cause_precedes_unexplained_findings():
    great = RUN.model_copy(update={"size": 5e3})
    changes = {"findings": [MISFIT, great]}
    causes = [make_cause(("run-disagrees", "Qx.K_II", 5e3))]
    judged = judge_result(make_qx_result(**changes), causes=causes)
    assert [finding.code for finding in judged.findings][:2] == ["wrong-input", "run-disagrees"]
    assert judged.state == "contradicted"

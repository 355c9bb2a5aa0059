"""One finding for each cause: what it accounts for stands below it."""

from results import result

from counterspin.calibration.findings import Cause, group_by_cause, judge_result, merge_shared
from counterspin.calibration.result_parts import Finding

MISFIT = Finding(code="lack-of-fit", subject="Qx", text="Large.", size=8.0, contradicts=True)
RUN = Finding(code="run-disagrees", subject="Qx.K_II", text="Run.", size=4.0)
OTHER = Finding(code="methods-disagree", subject="Qx.K_II", text="Other.", size=5.0)
DRIFT = Finding(code="large-drift", subject="platform.drift.north", text="Drift.", size=2.0)
HEAD = Finding(code="wrong-input", subject="centrifuge.radius", text="A radius.", size=900.0)


def cause(*remaining, names=("Qx",)):
    return Cause(HEAD, names, {(code, subject): size for code, subject, size in remaining})


def below(*found, causes, name="Qx"):
    return [
        (one.code, [other.code for other in one.explains])
        for one in group_by_cause(name, found, causes)
    ]


def test_what_is_gone_with_it_stands_below():
    found = below(MISFIT, RUN, DRIFT, causes=[cause(("run-disagrees", "Qx.K_II", 3.9))])
    assert found == [("wrong-input", ["lack-of-fit"]), ("run-disagrees", []), ("large-drift", [])]


def test_what_hardly_remains_is_accounted_for():
    assert below(MISFIT, causes=[cause(("lack-of-fit", "Qx", 1.02))])[0][1] == ["lack-of-fit"]
    assert below(MISFIT, causes=[cause(("lack-of-fit", "Qx", 3.0))])[0][1] == []


def test_the_two_stage_method_is_explained_where_the_residuals_are():
    assert below(OTHER, causes=[cause()])[0][1] == ["methods-disagree"]
    assert below(OTHER, causes=[cause(("lack-of-fit", "Qx", 1.5))])[0][1] == []


def test_another_accelerometer_s_findings_are_its_own():
    assert below(MISFIT, causes=[cause(names=("Qy",))]) == [("lack-of-fit", [])]


def test_a_cause_is_as_grave_as_what_it_accounts_for():
    (head,) = group_by_cause("Qx", [MISFIT], [cause()])
    assert head.contradicts
    assert not HEAD.contradicts


def test_of_two_accelerometers_a_cause_is_one():
    own = group_by_cause("Qx", [MISFIT], [cause()])
    (both,) = merge_shared([*own, HEAD.model_copy(update={"explains": [RUN]})])
    assert [other.code for other in both.explains] == ["lack-of-fit", "run-disagrees"]


def test_a_cause_comes_before_what_has_another_measure():
    great = RUN.model_copy(update={"size": 5e3})
    changes = {"findings": [MISFIT, great]}
    causes = [cause(("run-disagrees", "Qx.K_II", 5e3))]
    judged = judge_result(result(**changes), causes=causes)
    assert [one.code for one in judged.findings][:2] == ["wrong-input", "run-disagrees"]
    assert judged.state == "contradicted"

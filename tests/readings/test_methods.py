"""Kinds of test in one fit: surer together than alone, and a disagreement is named."""

import pytest
from mixed_campaign import KINDS, MixedCampaign, compute_arm_indications
from reading_campaigns import TRUTH

from counterspin.calibration.pages.document import full_report_blocks
from counterspin.calibration.result import Result
from counterspin.cli import main


@pytest.fixture(scope="module")
def campaign_of_three_kinds(tmp_path_factory):
    return MixedCampaign(tmp_path_factory.mktemp("mixed"))


@pytest.fixture(scope="module")
def joint_result(campaign_of_three_kinds):
    return campaign_of_three_kinds.calibrated()


def test_joint_tests_reduce_uncertainty(campaign_of_three_kinds, joint_result):
    a = joint_result.accelerometers["A"]
    assert joint_result.state == "good"
    for symbol, truth in TRUTH.items():
        c = a.coefficients[symbol]
        assert abs(c.value - truth) < 4.0 * c.u
    for kind in ("double turntable", "arm"):
        alone = campaign_of_three_kinds.calibrated([kind]).accelerometers["A"].coefficients["K_II"]
        assert alone.estimated
        assert a.coefficients["K_II"].u < 0.9 * alone.u
    assert (
        not campaign_of_three_kinds.calibrated(["at rest"])
        .accelerometers["A"]
        .coefficients["K_II"]
        .estimated
    )


def test_single_kind_matches_campaign_of_that_kind(campaign_of_three_kinds, joint_result):
    """The records' kind to the digit; readings are linearised at the joint estimate."""
    kinds = joint_result.accelerometers["A"].kinds
    assert [(k.kind, k.count) for k in kinds] == list(zip(KINDS, (3, 12, 24), strict=True))
    for kind in kinds:
        alone = campaign_of_three_kinds.calibrated([kind.kind]).accelerometers["A"].coefficients
        for symbol, c in kind.coefficients.items():
            assert c.estimated == alone[symbol].estimated, (kind.kind, symbol)
            # At rest alone, K_PP and K_OO are considered, which moves u of K_F.
            if c.estimated and (kind.kind, symbol) != ("at rest", "K_F"):
                assert c.value == pytest.approx(alone[symbol].value, rel=1e-6, abs=1e-9)
                assert c.u == pytest.approx(alone[symbol].u, rel=1e-4)


def test_omitted_kind_matches_campaign_without_it(campaign_of_three_kinds, joint_result):
    a = joint_result.accelerometers["A"]
    ks = next(k for k in a.kinds if k.kind == "at rest")
    without = (
        campaign_of_three_kinds.calibrated(["double turntable", "arm"])
        .accelerometers["A"]
        .coefficients
    )
    for symbol, shift in ks.without.items():
        whole, other = a.coefficients[symbol], without[symbol]
        assert shift.shift == pytest.approx(other.value - whole.value, abs=1e-3 * whole.u)
        # Considered is the radius alone, and it moves both alike.
        noise = [c.u_noise**2 + c.u_stated**2 for c in (other, whole)]
        assert shift.u**2 == pytest.approx(noise[0] - noise[1], rel=2e-2)


def test_consistent_tests_have_no_finding(campaign_of_three_kinds):
    """All tests share a level of 1 %: in 10 campaigns at most 1 (p = 0.004)."""
    n_findings = 0
    for seed in range(2, 12):
        campaign_of_three_kinds.draw(seed)
        n_findings += any(
            f.code == "kinds-disagree" for f in campaign_of_three_kinds.calibrated().findings
        )
    assert n_findings <= 1


@pytest.mark.parametrize(
    ("kind", "moved"), [("at rest", "K_F"), ("arm", "K_II")], ids=["at rest", "on the arm"]
)
def test_inconsistent_kind_is_named(tmp_path, capsys, monkeypatch, kind, moved):
    campaign_of_three_kinds = MixedCampaign(tmp_path, u_arm=1e-5)
    if kind == "at rest":
        campaign_of_three_kinds.at_rest = (
            campaign_of_three_kinds.at_rest + 1e-4
        )  # a bias of the bench that the others do not have
    else:
        campaign_of_three_kinds.on_arm = (
            campaign_of_three_kinds.on_arm
            + compute_arm_indications({"K_II": 20e-6})
            - compute_arm_indications({})
        )
    result = campaign_of_three_kinds.calibrated()
    # One cause, one finding: each kind by itself fits its own model.
    codes = [f.code for f in result.findings]
    assert codes.count("kinds-disagree") == 1
    assert not {"outlying-reading", "lack-of-fit"} & set(codes)
    (finding,) = [f for f in result.findings if f.code == "kinds-disagree"]
    assert f"are not consistent: {kind} compared with" in finding.text
    assert finding.contradicts
    assert result.state == "contradicted"
    odd = next(k for k in result.accelerometers["A"].kinds if k.kind == kind)
    assert odd.p < 1e-6
    again = Result.model_validate_json(result.to_json())
    assert again.accelerometers["A"].kinds == result.accelerometers["A"].kinds
    monkeypatch.setenv("COLUMNS", "120")  # or the heads of columns are wrapped
    assert main(["calibrate", str(tmp_path / "all")]) == 1
    out = " ".join(capsys.readouterr().out.split())
    assert f"{kind}, not consistent" in out
    assert "only at rest (12)" in out
    assert any("not consistent" in str(block) for block in full_report_blocks(result))

"""The certificate of a centrifuge: numbers, CMC, missing data and command."""

import pytest
from arm_centrifuge import DESCRIPTION, STATED

import counterspin as cs
from certificates import LAB, SCHEMA, find_elements, needs_schema, write_lab
from counterspin.acceleration_standard.certificate import certify_applied
from counterspin.certificates.schema import check_schema
from counterspin.cli import main
from counterspin.errors import CampaignError

CLOCK = 'stretch = "0 ± 5e-9 s^2/m"\n'
COMPLETE = DESCRIPTION.replace(CLOCK, f'{CLOCK}clock = "0 ± 1e-8"\n') + STATED
LEVELS = [1.0, 10.0]
QUANTITY = "//dcc:result[dcc:name/dcc:content='Levels']/dcc:data/dcc:quantity/si:real"
EXPANDED = f"{QUANTITY}/si:measurementUncertaintyUnivariate/si:expandedMU/si:valueExpandedMU"


@pytest.fixture(scope="module")
def calculate_budget(tmp_path_factory):
    """Return a function that calculates the budget of a description."""

    def calculate(text=COMPLETE):
        folder = tmp_path_factory.mktemp("machine")
        (folder / "campaign.toml").write_text(text, encoding="utf-8")
        return cs.applied(folder, LEVELS)

    return calculate


def read_numbers(certificate, path):
    return [float(element.text) for element in find_elements(certificate.xml, path)]


def test_values_and_expanded_uncertainties_match_budget(calculate_budget, tmp_path):
    result = calculate_budget()
    certificate = certify_applied(result, write_lab(tmp_path))
    assert not certificate.draft
    values = [level.acceleration for level in result.levels]
    assert read_numbers(certificate, f"{QUANTITY}/si:value") == pytest.approx(values, rel=1e-15)
    expanded = [1.96 * level.u for level in result.levels]
    assert read_numbers(certificate, EXPANDED) == pytest.approx(expanded, rel=1e-4)
    assert certificate.pdf().startswith(b"%PDF")


def test_uncertainty_is_at_least_cmc(calculate_budget, tmp_path):
    result = calculate_budget()
    lab = write_lab(tmp_path, LAB + '\n[cmc]\napplied = "5 ppm"\n')
    small, at_capability = read_numbers(certify_applied(result, lab), EXPANDED)
    assert small == pytest.approx(1.96 * result.levels[0].u, rel=1e-4)
    assert at_capability == pytest.approx(5e-6 * result.levels[1].acceleration, rel=1e-9)


def test_uncertainty_covers_monte_carlo_interval_if_not_validated(calculate_budget, tmp_path):
    """A misalignment of 0.02 rad lowers the acceleration by a chi-square variable with 1 dof."""
    azimuth = '"fixture.misalignment.in.up" = "0 ± 0.02 rad"\n'
    result = calculate_budget(COMPLETE + azimuth)
    certificate = certify_applied(result, write_lab(tmp_path))
    for level, expanded in zip(result.levels, read_numbers(certificate, EXPANDED), strict=True):
        assert not level.monte_carlo.validated
        assert expanded == pytest.approx(level.acceleration - level.monte_carlo.low, rel=1e-4)
        # The 97.5 % quantile of beta^2/2 is 5.0239 u^2/2.
        assert expanded == pytest.approx(level.acceleration * 5.0239 * 2e-4, rel=0.02)
    assert b"U covers the Monte Carlo interval" in certificate.xml


@needs_schema
def test_certificate_conforms_to_schema(calculate_budget, tmp_path):
    check_schema(certify_applied(calculate_budget(), write_lab(tmp_path)).xml, SCHEMA, "made")


def test_dominant_default_requires_evidence(calculate_budget, tmp_path):
    result = calculate_budget(DESCRIPTION + STATED)
    draft = certify_applied(result, write_lab(tmp_path))
    assert draft.draft
    assert any(
        note.startswith("evidence.centrifuge.clock: this entry is missing") for note in draft.notes
    )
    evidence = '\n[evidence]\n"centrifuge.clock" = "Counter report 12."\n'
    complete = certify_applied(result, write_lab(tmp_path, LAB + evidence))
    assert not complete.draft
    assert b"Counter report 12." in complete.xml


def test_assumed_source_requires_evidence(calculate_budget, tmp_path):
    exact = '[model]\nassume = ["centrifuge.clock"]\n'
    with pytest.raises(CampaignError, match=r"centrifuge\.clock"):
        certify_applied(calculate_budget(DESCRIPTION + exact + STATED), write_lab(tmp_path))


@pytest.mark.parametrize("text", ["5 m", "-1 ppm", "5 ± 1 ppm"])
def test_rejects_cmc_that_is_not_relative(calculate_budget, tmp_path, text):
    lab = write_lab(tmp_path, LAB + f'\n[cmc]\napplied = "{text}"\n')
    with pytest.raises(CampaignError, match=r"cmc\.applied"):
        certify_applied(calculate_budget(), lab)


def test_command_writes_both_files_and_requires_both_options(tmp_path, capsys):
    (tmp_path / "campaign.toml").write_text(COMPLETE, encoding="utf-8")
    lab, xml = write_lab(tmp_path), tmp_path / "c.xml"
    words = ["applied", str(tmp_path), "--levels", "1,10g"]
    assert main([*words, "--lab", str(lab)]) == 2
    assert "--certificate and --lab" in capsys.readouterr().err
    assert main([*words, "--lab", str(lab), "--certificate", str(xml), "--both"]) == 0
    assert {path.suffix for path in tmp_path.glob("c.*")} == {".xml", ".pdf"}
    assert main(["certificate", "--verify", str(xml)]) == 0
    assert main([*words, "--lab", str(lab), "--certificate", str(xml)]) != 0
    assert "already exists. It" in capsys.readouterr().err

"""Terms fixed at nominal require evidence by the laboratory, which the certificate prints."""

import io
import tomllib

import pypdf
import pytest
from results import make_qx_result

from certificates import LAB, find_elements
from counterspin.certificates.certificate_text import FIXED_TERMS_HEADING
from counterspin.certificates.evidence import is_known_key, terms_without_evidence
from counterspin.certificates.issuing import certificate
from counterspin.errors import CampaignError


@pytest.mark.parametrize(
    ("assumed", "keys", "lacking"),
    [
        ([], [], []),
        (["K_OO"], [], ["K_OO"]),
        (["K_OO"], ["K_OO"], []),
        (["K_OO", "K_PP"], ["K_OO"], ["K_PP"]),
        (["K_OO", "platform.*"], ["all"], []),
        (["all"], ["all"], []),
        (["all"], ["K_OO", "platform.*"], ["all"]),
        (["platform.*"], ["platform.*"], []),
        (["platform.*"], ["platform"], []),
        (["platform.*"], ["platform.tilt.*"], ["platform.*"]),
        (["platform.tilt.north", "platform.tilt.up"], ["platform.*"], []),
        (["platform.tilt.north", "platform.drift.up"], ["platform.tilt"], ["platform.drift.up"]),
        (["Qx.K_OO"], ["K_OO"], []),
        (["K_OO"], ["Qx.K_OO"], ["K_OO"]),
        (["Qx.K_OO", "Qy.K_OO"], ["Qx.K_OO"], ["Qy.K_OO"]),
        (["K_OO"], ["K_O"], ["K_OO"]),
        (["fixture.misalignment.m1.east"], ["fixture.misalignment"], []),
    ],
)
def test_terms_without_evidence(assumed, keys, lacking):
    assert terms_without_evidence(assumed, dict.fromkeys(keys, "a report")) == lacking


@pytest.mark.parametrize(
    ("key", "known"),
    [
        ("all", True),
        ("K_OO", True),
        ("K_*", True),
        ("platform.*", True),
        ("platform.tilt", True),
        ("head.zero", True),
        ("fixture.misalignment.m1.east", True),
        ("Qx.K_OO", True),
        ("Qx.K_*", True),
        ("Qz.K_OO", False),
        ("Qx", False),
        ("K_O", False),
        ("platform.tilts", False),
    ],
)
def test_evidence_key_names_term(key, known):
    assert is_known_key(key, ["Qx"]) == known


STATEMENT = f"//dcc:statement[dcc:name/dcc:content = '{FIXED_TERMS_HEADING}']"


def assume_terms(*terms):
    return make_qx_result().model_copy(update={"assumed": list(terms)})


def make_certificate(calibration, lab_text=""):
    return certificate(calibration, tomllib.loads(LAB + lab_text))


def test_missing_evidence_prevents_certificate():
    with pytest.raises(CampaignError) as error_info:
        make_certificate(
            assume_terms("K_OO", "K_PP", "platform.*"), '[evidence]\nK_PP = "Bericht 1"\n'
        )
    (problem,) = error_info.value.problems
    assert "fixes K_OO, platform.* at nominal values" in problem
    assert 'data sheet: "K_OO" = "..." "platform.*" = "..."' in problem


def test_certificate_contains_evidence():
    evidence_text = (
        '[evidence]\nK_OO = "Typprüfung 4714."\nplatform.tilt = "Bericht 4715."\nK_4 = "Nr. 1"\n'
    )
    issued = make_certificate(assume_terms("K_OO", "platform.tilt.north"), evidence_text)
    (statement,) = find_elements(issued.xml, STATEMENT)
    report = "".join(statement.itertext())
    assert "K_OO (second-order output-axis coefficient): Typprüfung 4714." in report
    assert "platform.tilt: Bericht 4715." in report
    assert "Nr. 1" not in report
    reader = pypdf.PdfReader(io.BytesIO(issued.pdf()))
    text = "\n".join(page.extract_text() for page in reader.pages)
    assert FIXED_TERMS_HEADING in text
    assert "Typprüfung 4714." in text


def test_result_without_assumptions_needs_no_evidence():
    without_fixed_terms = make_certificate(assume_terms(), '[evidence]\nall = "Bericht 1"\n')
    assert not find_elements(without_fixed_terms.xml, STATEMENT)
    with_fixed_terms = make_certificate(
        assume_terms("K_OO", "K_PP"), '[evidence]\nall = "Bericht 1"\n'
    )
    assert "K_OO, K_PP: Bericht 1" in with_fixed_terms.xml.decode()


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ('K_O = "Bericht"', 'evidence.K_O: unknown term "K_O"'),
        ('Qz.K_OO = "Bericht"', 'unknown term "Qz.K_OO"'),
        ('K_OO = "  "', "evidence.K_OO: must not be empty"),
        ("K_OO = 1", "evidence.K_OO: must be a string"),
    ],
)
def test_errors_name_key(text, problem):
    with pytest.raises(CampaignError) as error_info:
        make_certificate(make_qx_result(), f"[evidence]\n{text}\n")
    assert any(problem in line for line in error_info.value.problems), error_info.value.problems

"""A certificate follows PTB's rules of good practice for a DCC (schematron of dcclib)."""

import numpy as np
import pytest
from results import CONFORMITY, make_coefficient, make_qx_result, make_two_accelerometers

import triads
from certificates import LAB, make_document
from counterspin import calibrate
from counterspin.inference.verdicts import Conformity

dcclib = pytest.importorskip("dcclib.validation", reason="PTB's dcclib is not installed")

#: Violation for a list of quantities with several units, which a covariance matrix needs.
LIST_OF_UNITS = ("differing units", "Redundant unit")


@pytest.fixture(scope="session")
def rules():
    """Return PTB's rules: the compiled version and the current dcc.sch."""
    from pathlib import Path

    ready = dcclib.SchematronValidator.for_dcc()
    folder = Path(dcclib.__file__).parent / "schema"
    return [ready, dcclib.SchematronValidator.from_file(str(folder / "dcc.sch"))]


def rule_violations(rules, xml):
    """Return the rule violations of a certificate without remarks."""
    violations = []
    for validator in rules:
        report = validator.validate_str(xml.decode())
        every = [*report.failed_assertions, *report.successful_reports]
        violations += [
            f"{violation.role}: {violation.text}"
            for violation in every
            if violation.role != "information"
        ]
    return [line for line in violations if not any(pattern in line for pattern in LIST_OF_UNITS)]


MORE = """
procedure = "AP-17"
deviations = ["Two rates in place of three."]
customer_data = ["K_I, from the data sheet"]
"""


def make_full_result():
    """Return a result of two accelerometers with all data that a certificate may state."""
    calibration = make_qx_result(
        coefficients={
            "K_F": make_coefficient(0.005, 1e-9, "g"),
            "K_I": {"value": 1.002, "u": 5e-6, "unit": "g/g", "estimated": False},
            "K_II": make_coefficient(-2.7e-5, 1e-9, "g/g^2", dof=3.5),
        },
        warnings=["Qx: hm", "Qx: again"],
    )
    terms = [f"{name}.{symbol}" for name in ("Qx", "Qy") for symbol in ("K_F", "K_II")]
    matrix = [[1.0 if i == j else 0.25 for j in range(4)] for i in range(4)]
    return make_two_accelerometers(calibration, terms, matrix)


@pytest.mark.parametrize("language", ["en", "de"])
def test_ptb_rules_report_no_error(tmp_path, rules, language):
    text = LAB.replace('language = "de"', f'language = "{language}"{MORE}')
    text = text.replace('"0815"', '"0815"\nstate = "after adjustment"')
    verdicts = {"Qx": {"K_II": Conformity(**CONFORMITY)}}
    xml = make_document(
        tmp_path, make_full_result(), text=text + '[cmc]\nK_F = "1 ug"\n', verdicts=verdicts
    )
    violations = rule_violations(rules, xml)
    # With two languages a text has no language attribute, which gives a permitted remark.
    assert [
        line for line in violations if language == "en" or "anguage attribute" not in line
    ] == []


def test_ptb_rules_report_errors_of_invalid_certificate(tmp_path, rules):
    xml = make_document(tmp_path, make_qx_result()).replace(b">v9.9<", b">9.9<")
    assert len([line for line in rule_violations(rules, xml) if line.startswith("error")]) == 2


def test_ptb_rules_report_no_error_for_triad(tmp_path, rules):
    generator = np.random.default_rng(7)
    values = triads.compute_indications(triads.draw_directions(25, generator))
    values = values + 3e-4 * generator.standard_normal(values.shape)
    xml = make_document(
        tmp_path,
        calibrate(triads.write_pose_campaign(tmp_path / "triad", values)),
        text=LAB.replace('language = "de"', 'language = "en"') + '[evidence]\nall = "Type test."\n',
    )
    assert b">Triad X, Y, Z</dcc:content>" in xml
    assert rule_violations(rules, xml) == []

"""Missing data of a certificate are listed by key and make it a draft."""

import pytest
from results import make_qx_result

from certificates import LAB, read_lab_for
from counterspin.certificates.completeness import (
    default_evidence_lines,
    missing_data,
    missing_lines,
)
from counterspin.inference.joint.summary import BudgetLine


def add_default(share):
    """Return a result in which the default prior of K_OO has a share of the variance of K_II."""
    calibration = make_qx_result()
    accelerometer = calibration.accelerometers["Qx"]
    line = BudgetLine(
        source="K_OO",
        kind="unstated",
        u=2e-6,
        unit="g/g^2",
        sensitivity=1.0,
        contribution=2e-6,
        share=share,
    )
    changed = accelerometer.model_copy(update={"budget": {"K_II": [line]}})
    return calibration.model_copy(update={"accelerometers": {"Qx": changed}})


def test_complete_file_has_no_missing_data(tmp_path):
    assert missing_data(read_lab_for(tmp_path, make_qx_result()), make_qx_result()) == []


@pytest.mark.parametrize(("share", "needed"), [(0.93, True), (0.09, False)])
def test_dominant_default_requires_evidence(tmp_path, share, needed):
    calibration = add_default(share)
    missing = missing_data(read_lab_for(tmp_path, calibration), calibration)
    assert [entry.key for entry in missing] == (["evidence.K_OO"] if needed else [])
    assert all("93 % of the variance of K_II of Qx" in entry.message for entry in missing)
    for key in ("K_OO", '"Qx.K_OO"', "all"):
        lab = read_lab_for(tmp_path, calibration, LAB + f'\n[evidence]\n{key} = "type test"\n')
        assert missing_data(lab, calibration) == []
        assert len(default_evidence_lines(lab, calibration)) == needed


def test_keys_with_template_values_share_one_entry(tmp_path):
    text = LAB.replace('"P-1"', '"EX-1"').replace('"0815"', '"000000"').partition("[conditions]")[0]
    template_line, conditions_line = missing_lines(
        missing_data(read_lab_for(tmp_path, make_qx_result(), text), make_qx_result())
    )
    assert template_line.startswith(
        "item.model, item.serial_number: these entries still have the values from the template"
    )
    assert conditions_line.startswith("conditions.temperature: this entry is missing")

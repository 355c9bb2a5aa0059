"""The checklist before a calibration."""

import re

from campaigns import SMALL, write_description

from counterspin.application.checklist import make_checklist
from counterspin.campaign.description import read_campaign

STATED = (
    SMALL.replace(
        "[accelerometers.Qx]", '[accelerometers.Qx]\nserial_number = "17"\nbias = "5e-3 ± 2e-6 g"'
    )
    .replace(
        "[accelerometers.Qy]", '[accelerometers.Qy]\nserial_number = "18"\nbias = "4e-3 ± 2e-6 g"'
    )
    .replace("[site]", '[campaign]\ndate = "2026-01-12"\n\n[site]')
)


def checklist_entries(folder, text):
    write_description(folder, text)
    return {entry["words"]: entry for entry in make_checklist(read_campaign(folder))}


def test_stated_entry_is_marked_and_missing_entry_names_field(tmp_path):
    stated = checklist_entries(tmp_path, STATED)
    assert list(stated) == ["Bias", "Scale factor", "Noise", "Serial number", "Date"]
    assert all(entry["stated"] for entry in stated.values())
    without = checklist_entries(tmp_path, STATED.replace('serial_number = "17"\n', ""))
    assert not without["Serial number"]["stated"]
    assert without["Serial number"]["key"] == "accelerometers.Qx.serial_number"
    assert "not stated for Qx" in without["Serial number"]["effect"]


def test_unstated_bias_and_noise_are_estimated_from_data(tmp_path):
    text = re.sub(r"(?m)^bias = .*$", "", STATED)
    before, _, after = text.partition("[noise]")
    text = before + after[after.index("\n[") :] if after else before
    actual_checklist_entries = checklist_entries(tmp_path, text)
    assert (
        actual_checklist_entries["Bias"]["stated"],
        actual_checklist_entries["Scale factor"]["stated"],
    ) == (False, True)
    assert (
        actual_checklist_entries["Bias"]["effect"]
        == "not stated for Qx, Qy; the data alone determine the value"
    )
    assert actual_checklist_entries["Noise"]["effect"] == "estimated from the residuals (Type A)"

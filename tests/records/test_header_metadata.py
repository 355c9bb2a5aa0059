"""What the head of a LabVIEW measurement file states."""

import pytest

from counterspin.records.formats import read_table
from counterspin.records.header_metadata import parse_header, parse_interval

HEAD = [
    ["LabVIEW Measurement", ""],
    ["Y_Unit_Label", "deg", "m", "Volts"],
    ["X_Dimension", "Time", "Time", "Time"],
    ["Delta_X", "0,02", "0,02", "0,02"],
    ["***End_of_Header***"],
]
NAMES = ["X_Value", "Angle", "East", "Raw", "Comment"]


def test_units_and_step_above_columns_are_parsed():
    units, step = parse_header(HEAD, NAMES, ",")
    assert units == {"X_Value": "s", "Angle": "deg", "East": "m", "Raw": "V"}
    assert step == 0.02


def test_ambiguous_header_has_no_units_or_step():
    assert parse_header([["about"], []], NAMES, ",") == ({}, None)
    frequencies = [["X_Dimension", "Frequency"], ["Delta_X", "0,5"]]
    assert parse_header(frequencies, NAMES, ",") == ({}, None)
    uneven = [*HEAD[:3], ["Delta_X", "0,02", "0,04", "0,02"]]
    assert parse_header(uneven, NAMES, ",")[1] is None
    assert parse_header([*HEAD[:3], ["Delta_X", "x"]], NAMES, ",")[1] is None


@pytest.mark.parametrize(
    ("cells", "interval"),
    [
        (["# Sampling rate: 50 Hz"], 0.02),
        (["Fs = 50"], 0.02),
        (["fs", "=", "50"], 0.02),
        (["Sample Interval", "20", "ms"], 0.02),
        (["Sample rate [Hz]", "50"], 0.02),
        (["ODR", "1.6 kHz"], 0.000625),
        (["Sampling rate", "50 m"], None),
        (["rate of the centrifuge", "1 Hz"], None),
    ],
)
def test_header_rate_is_converted_to_interval(cells, interval):
    assert parse_interval([cells], ".") == interval


def test_names_resembling_quantities_remain_names(tmp_path):
    """The positions of a tumble test precede columns of plain numbers."""
    path = tmp_path / "readings.csv"
    rows = "".join(f"{k} deg,{k},{1.25 + k}\n" for k in (0, 90, 180, 270))
    path.write_text("position,angle_deg,reading_mA\n" + rows)
    assert read_table(path).frame["position"].to_list()[:2] == ["0 deg", "90 deg"]

"""Lines above the names and below the rows of a text table."""

import pytest

from counterspin.records.formats import read_table
from counterspin.records.header_footer import count_footer_lines, parse_header, parse_interval
from counterspin.records.layout import split_cells

HEAD = [
    ["LabVIEW Measurement", ""],
    ["Y_Unit_Label", "deg", "m", "Volts"],
    ["X_Dimension", "Time", "Time", "Time"],
    ["Delta_X", "0,02", "0,02", "0,02"],
    ["***End_of_Header***"],
]
NAMES = ["X_Value", "Angle", "East", "Raw", "Comment"]
ROWS = ["0,5;1,25;-3", "1;1,5;2", "1,5;1,75;2,5e-3", "2;2;"]


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


def split_lines(lines):
    return [split_cells(line, ";") for line in lines]


@pytest.mark.parametrize(
    ("below", "count"),
    [
        ([], 0),
        (["Mean;1,25;1", "Checked by J. D."], 2),
        (["", "End of data"], 2),
        (["0,3;;4"], 0),
        (["Std;0,1;0,2"], 1),
        (["Mittelw.;1,25;1", "Abweichung;0,1;0,2"], 2),
    ],
)
def test_footer_lines_are_counted(below, count):
    assert count_footer_lines(split_lines([*ROWS, *below]), ",") == count


def test_word_in_mounting_column_is_not_footer():
    rows = ["up;0;1,25", *["+1;30;2,5", "-1;42;-3,5"] * 12, "up;0;1,25", "down;0;-1,25"]
    assert count_footer_lines(split_lines(rows), ",") == 0
    assert count_footer_lines(split_lines([*rows, "Mean;12;0,5"]), ",") == 1

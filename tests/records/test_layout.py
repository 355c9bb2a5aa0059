"""What the first lines of a file show of how it is written."""

import pytest

from counterspin.records.dialect import Dialect
from counterspin.records.layout import (
    describe_lines,
    detect_format,
    footer_lines,
    is_plain_format,
    join_quoted_lines,
    plain_format,
    split_cells,
)
from counterspin.records.unit_notation import bracketed_unit, parse_file_unit

ROWS = ["0,5;1,25;-3", "1;1,5;2", "1,5;1,75;2,5e-3", "2;2;"]


def found(lines, **known):
    return detect_format(list(enumerate(lines, 1)), Dialect(**known))


def parted(lines):
    return [split_cells(line, ";") for line in lines]


def test_names_units_and_rows_below_lines_about_the_measurement():
    about = ["Test 7", "Operator;Müller;;", "", "Channel;AI1;AI2"]
    layout = found([*about, "Time;Angle;East", "s;[deg];mm", *ROWS])
    assert (layout.header, layout.before_rows, layout.units_row) == (5, 6, True)
    assert (layout.delimiter, layout.decimal) == (";", ",")
    assert layout.names == ("Time", "Angle", "East")
    assert layout.units == ("s", "deg", "mm")
    assert layout.describe("latin-1") == (
        "names in line 5, a units row, semicolon-separated, decimal commas, latin-1"
    )


def test_units_in_brackets_behind_the_names():
    layout = found(["about", "Time [ms];Angle (raw);East/(m)", *ROWS])
    assert layout.units == ("ms", "", "m")
    assert not layout.units_row


@pytest.mark.parametrize("mark", [".", ","])
def test_the_right_delimiter_makes_the_most_numbers(mark):
    rows = [row.replace(",", mark).replace(";", "\t") for row in ROWS]
    layout = found(["x", "a\tb\tc", *rows])
    assert (layout.delimiter, layout.decimal) == ("\t", mark)
    # Whole numbers do not show their mark.
    whole = found(["x", "a,b,c", *["1,2,3"] * 4])
    assert (whole.delimiter, whole.decimal) == (",", ".")


def test_what_is_said_is_taken():
    lines = ["a;b;c", "d;e;f", "s;s;s", *ROWS]
    assert found(lines).names == ("d", "e", "f")
    assert found(lines, skip_lines=0).names == ("a", "b", "c")
    assert found(lines, units_row=False).names == ("s #1", "s #2", "s #3")
    assert found(lines, delimiter=",") is None


def test_a_decimal_comma_makes_no_second_column():
    """1,25 below one name is one number, and so it is in quotation marks."""
    alone = found(["East", "0,0050", "1,0070", "-1,0005"])
    assert (alone.names, alone.decimal) == (("East",), ",")
    quoted = found(["Time,East", *['"0,5","1,25"'] * 3])
    assert (quoted.names, quoted.delimiter, quoted.decimal) == (("Time", "East"), ",", ",")


def test_a_delimiter_behind_each_row_makes_a_column_without_a_name():
    layout = found(["x", "a;b;c", *[f"{row};" for row in ROWS]])
    assert layout.names == ("a", "b", "c", "")


def test_rows_may_have_remarks():
    layout = found(["x", "Range;10;10;", "a;b;c;note", *[f"{row};ok" for row in ROWS]])
    assert layout.names == ("a", "b", "c", "note")


def test_what_is_no_table_is_not_taken_for_one():
    assert found(["1;2,5;oops", "1;1;1", *ROWS]) is None  # rows, one of them damaged
    assert found(["1;2,5;oops", *ROWS]) is None
    assert found(["only", "words", "here"]) is None
    assert found(["0,5,1,25"] * 5) is None  # two numbers or four


def test_rows_need_no_names():
    layout = found(ROWS)
    assert (layout.header, layout.before_rows) == (0, 0)
    assert layout.names == ("column 1", "column 2", "column 3")
    assert layout.describe("utf-8") == "unnamed columns, semicolon-separated, decimal commas"
    titled = found(["Run 7", "0.5,1.25,3", "1.0,2.5,4", "1.5,2.75,4", "2.0,1.5,1"])
    assert (titled.names, titled.before_rows) == (("column 1", "column 2", "column 3"), 1)


def test_names_may_be_fewer_than_columns():
    layout = found(["a;b", *ROWS])
    assert layout.names == ("column 1", "column 2", "column 3")
    assert "line 1 has 2 names for 3 columns, so the columns are numbered" in layout.describe(
        "utf-8"
    )
    # As R writes a table, the numbers of the rows have no name above them.
    counted = found(["x y", "1 0.5 2", "2 0.75 3", "3 1.0 4"])
    assert counted.names == ("column 1", "x", "y")


@pytest.mark.parametrize(
    "head",
    [
        ["# t ax ay"],
        ["% t ax ay"],
        ["#t ax ay"],
        ["* t ax ay"],
        ["// t ax ay"],
        ["## log of today", "# t ax ay"],
        ["# cols: t ax ay", "# note: quiet lab"],
        ["| t | ax | ay |", "|---|---|---|"],
        ["# t ax ay", "# s m/s^2 m/s^2"],
        ["#  t  ax  ay", "#  (s)  (m/s^2)  (m/s^2)"],
        ["# t ax ay", "#"],
        ["t  ax  ay"],
        ['"t" "ax" "ay"'],
        ["t ax ay", "(s) (m.s-2) (m.s-2)"],
        ["t    ax   ay", "---- ---- ----"],
        ["t ax ay", "s m/s^2 m/s^2", "=============="],
        ["t ax ay", "[s] [m/s^2] [m/s^2]"],
    ],
)
def test_names_stand_above_their_columns_however_the_line_is_written(head):
    rows = ["0.00 0.1 0.2", "0.01 0.1 0.3", "0.02 0.2 0.2", "0.03 0.1 0.2"]
    if head[0].startswith("|"):
        rows = [f"| {row.replace(' ', ' | ')} |" for row in rows]
    layout = found([*head, *rows])
    assert tuple(filter(None, layout.names)) == ("t", "ax", "ay")
    if len(head) > 1 and "s" in head[1]:
        assert layout.units == ("s", "m/s^2", "m/s^2")


@pytest.mark.parametrize(
    ("head", "rows", "told"),
    [
        ("time (s)x (g),y (g),z (g)", ["0.0,0.1,0.2,0.3"] * 4, "line 1 has 3 names for 4 columns"),
        ("t ax ay az temp", ["0.0 0.1 0.2 0.3"] * 4, "line 1 has 5 names for 4 columns"),
        ("t,ax,ay,az,temp", ["0.0,0.1,0.2,0.3"] * 4, "line 1 has 5 names for 4 columns"),
        ("# t ax ay", ["0.0 0.1 0.2 0.3"] * 4, "line 1 has 3 names for 4 columns"),
    ],
)
def test_names_are_never_shifted_against_columns(head, rows, told):
    layout = found([head, *rows])
    assert layout.names == ("column 1", "column 2", "column 3", "column 4")
    assert told in layout.describe("utf-8")


def test_signs_of_comments_within_names_are_kept():
    for name in ("RH %", "no #", "a [m*s^-2]"):
        assert plain_format([(1, f"t,{name}"), (2, "0,1")], Dialect()).names == ("t", name)


def test_quoted_names_may_have_several_lines():
    lines = ['"t', '(s)","ax', '(g)"', "0.00,0.1", "0.01,0.1", "0.02,0.2"]
    numbered = list(enumerate(lines, 1))
    layout = detect_format(join_quoted_lines(numbered), Dialect())
    assert (layout.names, layout.units, layout.before_rows) == (("t (s)", "ax (g)"), ("s", "g"), 3)
    open_mark = [*numbered, (7, '0.03,"0.1')]
    assert join_quoted_lines(open_mark) == open_mark


def test_names_of_rows_have_no_name_above_them():
    """As R's write.table writes a frame, with any names of rows."""
    for names in ('"1" "2" "3" "4"', '"a" "b" "c" "d"', "7 8 9 10"):
        rows = [f"{name} 0.5 2.25" for name in names.split()]
        assert found(['"t" "x"', *rows]).names == ("column 1", "t", "x")


def test_names_may_have_a_blank_within_them():
    layout = found(["Time s  Acc X  Acc Y", *["0.5  1.25  3.5"] * 3])
    assert layout.names == ("Time s", "Acc X", "Acc Y")


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
def test_lines_below_the_rows_are_counted(below, count):
    assert footer_lines(parted([*ROWS, *below]), ",") == count


def test_a_word_among_numbers_of_mountings_does_not_end_the_rows():
    rows = ["up;0;1,25", *["+1;30;2,5", "-1;42;-3,5"] * 12, "up;0;1,25", "down;0;-1,25"]
    assert footer_lines(parted(rows), ",") == 0
    assert footer_lines(parted([*rows, "Mean;12;0,5"]), ",") == 1


def test_any_number_of_blanks_parts_cells():
    layout = found(["# about", "Time [s]  East (mm)", *["  0.5    1.25 "] * 3])
    assert (layout.delimiter, layout.names) == (" ", ("Time [s]", "East (mm)"))
    assert layout.units == ("s", "mm")
    # Commas that part decimals are no delimiter then.
    commas = found(["t x", *["0,5 1,25"] * 3])
    assert (commas.delimiter, commas.decimal) == (" ", ",")


def test_lines_that_make_no_table_are_described():
    told = describe_lines([(1, "Test 12"), (2, ""), (3, "a;1,5;x")])
    assert told.splitlines() == [
        "  line 1: 2 cells, 1 a number: Test 12",
        "  line 3: 3 cells, 1 a number: a;1,5;x",
    ]


def test_plain_files_are_told_by_their_first_rows():
    def plain(*lines):
        return is_plain_format(list(enumerate(lines, 1)))

    assert plain("# about", "a,b", "1,2", "3,nan", "2026-03-01 12:00:00.5,7")
    assert plain("a;b", "1;2.5")
    assert not plain("a;b", "1;2", "2;2,5")
    assert not plain("a,b", "s,m", "1,2")
    assert not plain("a,b")


def test_the_usual_layout_is_taken_where_nothing_shows_another():
    lines = list(enumerate(["x", "a,b", "m,s", "", "q,1"], 1))
    layout = plain_format(lines, Dialect(skip_lines=1, units_row=True))
    assert (layout.names, layout.units, layout.before_rows) == (("a", "b"), ("m", "s"), 4)
    assert plain_format(lines[:1], Dialect(skip_lines=1)) is None


def test_units_as_files_write_them():
    written = ["[s]", "(m/s²)", "Seconds", "°", "µs", "degrees", "counts"]
    assert [parse_file_unit(text) for text in written] == [
        "s",
        "m/s^2",
        "s",
        "deg",
        "us",
        "deg",
        "count",
    ]
    written = ["U/min", "RPM", "min-1", "VDC", "LSB"]
    assert [parse_file_unit(text) for text in written] == ["rpm", "rpm", "1/min", "V", "count"]
    assert [parse_file_unit(text) for text in ("", "raw", "East", "x" * 30)] == [None] * 4
    assert [bracketed_unit(name) for name in ("t [ms]", "t", "t (raw)")] == ["ms", "", ""]

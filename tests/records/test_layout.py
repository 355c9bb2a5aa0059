"""Layout of a text table, detected from its first lines."""

import pytest

from counterspin.records.dialect import Dialect
from counterspin.records.layout import (
    describe_lines,
    detect_format,
    is_plain_format,
    join_quoted_lines,
    plain_format,
)
from counterspin.records.unit_notation import bracketed_unit, parse_file_unit

ROWS = ["0,5;1,25;-3", "1;1,5;2", "1,5;1,75;2,5e-3", "2;2;"]


def detect_layout(lines, **known):
    return detect_format(list(enumerate(lines, 1)), Dialect(**known))


def test_table_below_metadata_lines_is_found():
    about = ["Test 7", "Operator;Müller;;", "", "Channel;AI1;AI2"]
    layout = detect_layout([*about, "Time;Angle;East", "s;[deg];mm", *ROWS])
    assert (layout.header, layout.before_rows, layout.units_row) == (5, 6, True)
    assert (layout.delimiter, layout.decimal) == (";", ",")
    assert layout.names == ("Time", "Angle", "East")
    assert layout.units == ("s", "deg", "mm")
    assert layout.describe("latin-1") == (
        "names in line 5, a units row, semicolon-separated, decimal commas, latin-1"
    )


def test_bracketed_units_after_names_are_found():
    layout = detect_layout(["about", "Time [ms];Angle (raw);East/(m)", *ROWS])
    assert layout.units == ("ms", "", "m")
    assert not layout.units_row


@pytest.mark.parametrize("mark", [".", ","])
def test_delimiter_with_most_numbers_is_chosen(mark):
    rows = [row.replace(",", mark).replace(";", "\t") for row in ROWS]
    layout = detect_layout(["x", "a\tb\tc", *rows])
    assert (layout.delimiter, layout.decimal) == ("\t", mark)
    # Whole numbers do not show their mark.
    layout = detect_layout(["x", "a,b,c", *["1,2,3"] * 4])
    assert (layout.delimiter, layout.decimal) == (",", ".")


def test_stated_layout_takes_precedence():
    lines = ["a;b;c", "d;e;f", "s;s;s", *ROWS]
    assert detect_layout(lines).names == ("d", "e", "f")
    assert detect_layout(lines, skip_lines=0).names == ("a", "b", "c")
    assert detect_layout(lines, units_row=False).names == ("s #1", "s #2", "s #3")
    assert detect_layout(lines, delimiter=",") is None


def test_first_row_of_numbers_is_not_the_stated_units_row():
    """A campaign states `units_row = true` for all runs, but one file lacks this row."""
    lines = ["a,b,c", *[f"{n},{n / 8},0.5" for n in range(5)]]
    layout = plain_format(list(enumerate(lines, 1)), Dialect(units_row=True))
    assert (layout.units_row, layout.before_rows) == (False, 1)


def test_decimal_comma_is_not_delimiter():
    """With a single column name, 1,25 is one number, with or without quotation marks."""
    alone = detect_layout(["East", "0,0050", "1,0070", "-1,0005"])
    assert (alone.names, alone.decimal) == (("East",), ",")
    quoted = detect_layout(["Time,East", *['"0,5","1,25"'] * 3])
    assert (quoted.names, quoted.delimiter, quoted.decimal) == (("Time", "East"), ",", ",")


def test_trailing_delimiter_adds_unnamed_column():
    layout = detect_layout(["x", "a;b;c", *[f"{row};" for row in ROWS]])
    assert layout.names == ("a", "b", "c", "")


def test_rows_may_have_note_column():
    layout = detect_layout(["x", "Range;10;10;", "a;b;c;note", *[f"{row};ok" for row in ROWS]])
    assert layout.names == ("a", "b", "c", "note")


def test_text_without_table_has_no_layout():
    assert detect_layout(["1;2,5;oops", "1;1;1", *ROWS]) is None  # rows, one of them damaged
    assert detect_layout(["1;2,5;oops", *ROWS]) is None
    assert detect_layout(["only", "words", "here"]) is None
    assert detect_layout(["0,5,1,25"] * 5) is None  # two numbers or four


def test_unnamed_columns_are_numbered():
    layout = detect_layout(ROWS)
    assert (layout.header, layout.before_rows) == (0, 0)
    assert layout.names == ("column 1", "column 2", "column 3")
    assert layout.describe("utf-8") == "unnamed columns, semicolon-separated, decimal commas"
    titled = detect_layout(["Run 7", "0.5,1.25,3", "1.0,2.5,4", "1.5,2.75,4", "2.0,1.5,1"])
    assert (titled.names, titled.before_rows) == (("column 1", "column 2", "column 3"), 1)


def test_columns_are_numbered_if_names_are_too_few():
    layout = detect_layout(["a;b", *ROWS])
    assert layout.names == ("column 1", "column 2", "column 3")
    assert "line 1 has 2 names for 3 columns, so the columns are numbered" in layout.describe(
        "utf-8"
    )
    # As R writes a table, the numbers of the rows have no name above them.
    counted = detect_layout(["x y", "1 0.5 2", "2 0.75 3", "3 1.0 4"])
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
def test_header_variants_are_aligned_with_columns(head):
    rows = ["0.00 0.1 0.2", "0.01 0.1 0.3", "0.02 0.2 0.2", "0.03 0.1 0.2"]
    if head[0].startswith("|"):
        rows = [f"| {row.replace(' ', ' | ')} |" for row in rows]
    layout = detect_layout([*head, *rows])
    assert tuple(filter(None, layout.names)) == ("t", "ax", "ay")
    if len(head) > 1 and "s" in head[1]:
        assert layout.units == ("s", "m/s^2", "m/s^2")


@pytest.mark.parametrize(
    ("head", "rows", "message"),
    [
        ("time (s)x (g),y (g),z (g)", ["0.0,0.1,0.2,0.3"] * 4, "line 1 has 3 names for 4 columns"),
        ("t ax ay az temp", ["0.0 0.1 0.2 0.3"] * 4, "line 1 has 5 names for 4 columns"),
        ("t,ax,ay,az,temp", ["0.0,0.1,0.2,0.3"] * 4, "line 1 has 5 names for 4 columns"),
        ("# t ax ay", ["0.0 0.1 0.2 0.3"] * 4, "line 1 has 3 names for 4 columns"),
    ],
)
def test_misaligned_header_numbers_columns(head, rows, message):
    layout = detect_layout([head, *rows])
    assert layout.names == ("column 1", "column 2", "column 3", "column 4")
    assert message in layout.describe("utf-8")


def test_toa5_header_states_names_and_units():
    """A data logger of Campbell writes four header lines: station, names, units, processing."""
    rows = [f'"2026-11-22 10:00:0{n}",{n},{n / 8},0.5' for n in range(6)]
    layout = detect_layout(
        [
            '"TOA5","st","CR6","1234","OS","CPU:x.CR6","999","fast"',
            '"TIMESTAMP","RECORD","angle","east"',
            '"TS","RN","deg","mV"',
            '"","","Smp","Smp"',
            *rows,
        ]
    )
    assert layout.names == ("TIMESTAMP", "RECORD", "angle", "east")
    assert layout.units == ("", "", "deg", "mV")


def test_comment_characters_within_names_are_preserved():
    for name in ("RH %", "no #", "a [m*s^-2]"):
        assert plain_format([(1, f"t,{name}"), (2, "0,1")], Dialect()).names == ("t", name)


def test_quoted_names_may_span_lines():
    lines = ['"t', '(s)","ax', '(g)"', "0.00,0.1", "0.01,0.1", "0.02,0.2"]
    numbered = list(enumerate(lines, 1))
    layout = detect_format(join_quoted_lines(numbered), Dialect())
    assert (layout.names, layout.units, layout.before_rows) == (("t (s)", "ax (g)"), ("s", "g"), 3)
    open_mark = [*numbered, (7, '0.03,"0.1')]
    assert join_quoted_lines(open_mark) == open_mark


def test_row_names_may_lack_header():
    """R's write.table writes row names without a column name."""
    for names in ('"1" "2" "3" "4"', '"a" "b" "c" "d"', "7 8 9 10"):
        rows = [f"{name} 0.5 2.25" for name in names.split()]
        assert detect_layout(['"t" "x"', *rows]).names == ("column 1", "t", "x")


def test_names_may_contain_space():
    layout = detect_layout(["Time s  Acc X  Acc Y", *["0.5  1.25  3.5"] * 3])
    assert layout.names == ("Time s", "Acc X", "Acc Y")


def test_multiple_spaces_are_one_delimiter():
    layout = detect_layout(["# about", "Time [s]  East (mm)", *["  0.5    1.25 "] * 3])
    assert (layout.delimiter, layout.names) == (" ", ("Time [s]", "East (mm)"))
    assert layout.units == ("s", "mm")
    # Commas that part decimals are no delimiter then.
    commas = detect_layout(["t x", *["0,5 1,25"] * 3])
    assert (commas.delimiter, commas.decimal) == (" ", ",")


def test_lines_without_table_are_described():
    lines = describe_lines([(1, "Test 12"), (2, ""), (3, "a;1,5;x")])
    assert lines.splitlines() == [
        "  line 1: 2 cells, 1 a number: Test 12",
        "  line 3: 3 cells, 1 a number: a;1,5;x",
    ]


def test_plain_files_are_recognised_by_first_rows():
    def plain(*lines):
        return is_plain_format(list(enumerate(lines, 1)))

    assert plain("# about", "a,b", "1,2", "3,nan", "2026-03-01 12:00:00.5,7")
    assert plain("a;b", "1;2.5")
    assert not plain("a;b", "1;2", "2;2,5")
    assert not plain("a,b", "s,m", "1,2")
    assert not plain("a,b")


def test_default_layout_is_used_without_rows():
    lines = list(enumerate(["x", "a,b", "m,s", "", "q,1"], 1))
    layout = plain_format(lines, Dialect(skip_lines=1, units_row=True))
    assert (layout.names, layout.units, layout.before_rows) == (("a", "b"), ("m", "s"), 4)
    assert plain_format(lines[:1], Dialect(skip_lines=1)) is None


def test_unit_spellings_in_files_are_parsed():
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
    written = ["ms-2", "ms⁻²", "ms^-2", "m s-2", "m·s⁻²", "m/s**2", "m / s²", "m/sec²", "mps2"]
    assert {parse_file_unit(text) for text in written} == {"m/s^2"}
    written = ["mm/s2", "cm s-2", "ft/sec2", "inch/s^2", "km/s^2"]
    assert [parse_file_unit(text) for text in written] == [
        "mm/s^2",
        "cm/s^2",
        "ft/s^2",
        "in/s^2",
        "km/s^2",
    ]
    assert [bracketed_unit(name) for name in ("t [ms]", "t", "t (raw)")] == ["ms", "", ""]

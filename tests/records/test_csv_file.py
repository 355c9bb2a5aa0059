"""Record files of text: dialects, and what is wrong in which line."""

import numpy as np
import pytest
from record_files import (
    ANGLE,
    SIGNAL,
    TIME,
    format_lines,
    read_error_message,
    read_written_record,
    simulate_columns,
    write_record,
)

from counterspin.errors import RecordError
from counterspin.records import csv_file
from counterspin.records.dialect import Dialect
from counterspin.records.formats import open_columns, read_numbers, read_table
from counterspin.records.record import ColumnSpec


@pytest.mark.parametrize("separator", [",", ";", "\t"])
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_csv_delimiters_and_line_ends_are_read(tmp_path, separator, end):
    columns = simulate_columns(n=400)
    text = format_lines({"note": np.zeros(400), **columns}, separator)
    text[0] = separator.join(['"note"', f" {TIME}", f"{ANGLE} ", SIGNAL])
    text[9] = "# the operator sneezed here"
    path = tmp_path / "run.csv"
    path.write_bytes(("\ufeff# a comment" + end + end.join(text) + end).encode())
    record = read_written_record(path)
    assert record.report.rows == 399
    np.testing.assert_array_equal(record.signals["Qx"], np.delete(columns[SIGNAL], 8))


def test_comments_and_spaces_among_numbers_are_ignored(tmp_path):
    text = format_lines(simulate_columns())
    text[3] = "  " + text[3].replace(",", " , ")
    text.insert(7, "# a comment")
    record = read_written_record(write_record(tmp_path / "run.csv", text))
    np.testing.assert_array_equal(record.signals["Qx"], simulate_columns()[SIGNAL])


def test_blank_lines_after_header_and_at_end_are_ignored(tmp_path):
    text = format_lines(simulate_columns())
    text[1:1] = ["", ""]
    record = read_written_record(write_record(tmp_path / "run.csv", [*text, ""]))
    np.testing.assert_array_equal(record.time, simulate_columns()[TIME])
    text[500] = "10.0,x,1.0"
    message = read_error_message(write_record(tmp_path / "run.csv", text))
    assert "line 501: column 'angle_rad' " in message


@pytest.mark.parametrize("end", ["\n\n", "\r\n\r\n", "\r\r\n", "\n \n"])
def test_blank_line_after_every_row_is_ignored(tmp_path, end):
    """Python's csv module writes such files on Windows without newline=""."""
    columns = simulate_columns()
    cells = [line.rpartition(",") for line in format_lines(columns)]
    text = [f'{row_start},"{last_cell}"' for row_start, _, last_cell in cells]
    path = tmp_path / "run.csv"
    path.write_bytes((end.join(text) + end).encode())
    record = read_written_record(path)
    np.testing.assert_array_equal(record.signals["Qx"], columns[SIGNAL])
    text[3] = text[3].replace(",", ",x", 1)
    path.write_bytes((end.join(text) + end).encode())
    message = read_error_message(path)
    assert f"line {4 if end.count(chr(10)) == 1 else 7}:" in message


@pytest.mark.parametrize("cell", ["None", "*****", "************"])
def test_cell_without_a_value_is_empty(tmp_path, cell):
    text = format_lines(simulate_columns())
    text[50] = text[50].rpartition(",")[0] + f",{cell}"
    record = read_written_record(write_record(tmp_path / "run.csv", text))
    assert record.report.empty == {TIME: 0, ANGLE: 0, SIGNAL: 1}


def test_space_delimited_file_keeps_line_numbers(tmp_path):
    text = [line.replace(",", "   ") for line in format_lines(simulate_columns())]
    text.insert(5, "# the operator sneezed here")
    record = read_written_record(write_record(tmp_path / "run.dat", text))
    np.testing.assert_array_equal(record.signals["Qx"], simulate_columns()[SIGNAL])
    text[40] = text[40].rpartition(" ")[0] + " x"
    assert "line 41: column 'east_m' contains the text 'x'" in read_error_message(
        write_record(tmp_path / "run.asc", text)
    )


@pytest.mark.parametrize("delimiter", [" ", ",", ";", "\t"])
@pytest.mark.parametrize("first", [1, 450])
def test_fortran_exponents_are_parsed(tmp_path, delimiter, first):
    columns = simulate_columns(n=600)
    rows = list(zip(*columns.values(), strict=True))
    text = [
        delimiter.join(
            f"{x:24.16E}".replace("E", "dD"[row % 2] if row >= first else "e") for x in cells
        )
        for row, cells in enumerate(rows)
    ]
    if delimiter == ";":
        text = [line.replace(".", ",") for line in text]
    path = write_record(tmp_path / "run.csv", [delimiter.join(columns), *text])
    read_columns = read_numbers(path, list(columns))
    for name, values in columns.items():
        np.testing.assert_array_equal(read_columns[name], values)


def test_file_without_header_raises(tmp_path):
    path = write_record(tmp_path / "run.log", format_lines(simulate_columns())[1:])
    message = read_error_message(path)
    assert "the file has no column" in message
    assert "first numbers (line 1)" in message
    numbered = {"angle": ColumnSpec("column 2"), "signals": {"Qx": ColumnSpec("column 3")}}
    record = read_written_record(path, time=ColumnSpec("column 1"), **numbered)
    np.testing.assert_array_equal(record.signals["Qx"], simulate_columns()[SIGNAL])


def test_file_without_rows_or_header_raises(tmp_path):
    assert "no rows" in read_error_message(
        write_record(tmp_path / "run.csv", [f"{TIME},{ANGLE},{SIGNAL}"])
    )
    assert "no header" in read_error_message(
        write_record(tmp_path / "run.csv", ["# only this", ""])
    )


@pytest.mark.parametrize("row", [1, 7, 999])
def test_text_in_numeric_cell_raises_with_line(tmp_path, row):
    text = format_lines(simulate_columns())
    text[row] = ",".join([*text[row].split(",")[:2], "abc"])
    text.insert(0, "# a comment line counts too")
    message = read_error_message(write_record(tmp_path / "run.csv", text))
    assert f"line {row + 2}:" in message
    assert "'east_m'" in message
    assert "'abc'" in message


def test_decimal_comma_is_read_and_excess_cells_raise(tmp_path):
    text = [row.replace(".", ",") for row in format_lines(simulate_columns(), ";")]
    path = write_record(tmp_path / "run.csv", text)
    record = read_written_record(path)
    np.testing.assert_allclose(record.signals["Qx"], simulate_columns()[SIGNAL], rtol=1e-15)
    assert record.report.notes() == ["Detected file format: semicolon-separated, decimal commas."]
    text = format_lines(simulate_columns())
    text[5] += ",7"
    assert "line 6: the line has 4 cells" in read_error_message(
        write_record(tmp_path / "run.csv", text)
    )


@pytest.mark.parametrize("content", [bytes(3000), bytes(range(256)) * 40, b"\x89PNG\r\n\x1a\n"])
def test_binary_file_raises(tmp_path, content):
    path = tmp_path / "run.csv"
    path.write_bytes(content)
    assert "line 1: the file is not UTF-8 text" in read_error_message(path)


def test_comments_in_long_record_lose_no_row(tmp_path):
    # Where the fast parser meets a comment it may pass over rows and go on for a while.
    columns = simulate_columns(n=200_000, step=0.005)
    text = format_lines(columns)
    for place in (150_000, 70_000, 30_000, 3):
        text.insert(place, "# a comment")
    path = write_record(tmp_path / "run.csv", text)
    for _ in range(3):
        record = read_written_record(path, block=None)
        np.testing.assert_array_equal(record.time, columns[TIME])


@pytest.mark.parametrize("line", ['"{}', '{}"', '{},"'])
def test_unpaired_quotation_mark_raises_with_line(tmp_path, line):
    text = format_lines(simulate_columns())
    text[500] = line.format(text[500])
    message = read_error_message(write_record(tmp_path / "run.csv", text))
    assert "line 501: a quotation mark" in message


@pytest.mark.parametrize("end", ['"', '"\r', '1.0,2.0,"'])
def test_unclosed_quotation_mark_at_end_raises_with_line(tmp_path, end, capfd):
    """In a numeric cell, Polars would print a backtrace."""
    path = write_record(tmp_path / "run.csv", simulate_columns())
    path.write_bytes(path.read_bytes() + end.encode())
    assert "line 1002: a quotation mark is not closed" in read_error_message(path)
    assert capfd.readouterr().err == ""
    wide = path.read_text("utf-8").encode("utf-16")
    path.write_bytes(wide)
    assert "line 1002: a quotation mark is not closed" in read_error_message(path)
    assert capfd.readouterr().err == ""


def test_quoted_cell_may_end_file(tmp_path):
    text = format_lines(simulate_columns())
    text[-1] = ",".join(f'"{cell}"' for cell in text[-1].split(","))
    path = tmp_path / "run.csv"
    path.write_text("\n".join(text))
    assert len(read_written_record(path).time) == 1000


def test_multiline_notes_in_comments_are_ignored(tmp_path):
    text = [f'{line},"a note, with\na second line"' for line in format_lines(simulate_columns())]
    text[0] = format_lines(simulate_columns())[0] + ",note"
    text.insert(300, "# a comment")
    np.testing.assert_array_equal(
        read_written_record(write_record(tmp_path / "run.csv", text)).time, simulate_columns()[TIME]
    )


@pytest.mark.parametrize("line", [1, 500, 1000])
def test_missing_cells_of_short_lines_are_empty(tmp_path, line):
    text = format_lines(simulate_columns())
    text[line] = text[line].split(",")[0]
    record = read_written_record(write_record(tmp_path / "run.csv", text))
    assert record.report.empty == {TIME: 0, ANGLE: 1, SIGNAL: 1}


def test_overlong_line_raises(tmp_path):
    text = format_lines(simulate_columns())
    text[500] = "1" * 200_000
    assert "line 501: the line is longer than" in read_error_message(
        write_record(tmp_path / "run.csv", text)
    )


@pytest.mark.parametrize("row", [11, 9_000, 49_000])
@pytest.mark.parametrize("later", ["", "closed far below"])
def test_cell_with_unclosed_quotation_mark_is_not_read_to_end(tmp_path, row, later, monkeypatch):
    """Polars would search the whole file for the end of the cell in every pass."""
    text = format_lines(simulate_columns()) * 50
    text[row] = '"' + text[row]
    if later:
        text[row + 500] += '"'
    path = write_record(tmp_path / "run.csv", text)
    monkeypatch.setattr("polars.scan_csv", None)
    words = f"line {row + 1}: a quotation mark is not closed within 100 lines"
    assert words in read_error_message(path)
    with pytest.raises(RecordError, match=words):
        read_table(path)


def test_quotation_marks_in_cells_comments_and_headers_are_read(tmp_path):
    columns = simulate_columns(n=60_000)
    text = format_lines({"note": np.zeros(60_000), **columns})
    text[1:] = [line.replace("0.0,", '"a ""b"" c",', 1) for line in text[1:]]
    text[20_000] = text[20_000].replace("a ", "a \n" * 90)
    text.insert(30_000, '# a wheel of 5" was exchanged')
    text.insert(0, '# made with a 19" rack')
    path = write_record(tmp_path / "run.csv", text)
    np.testing.assert_array_equal(read_numbers(path, [SIGNAL])[SIGNAL], columns[SIGNAL])


@pytest.mark.parametrize("seed", range(20))
def test_open_line_ends_are_counted_across_chunks(seed):
    rng = np.random.default_rng(seed)
    content = bytes(rng.choice([*b'aa"', *b"\n" * 3], 3000).astype(np.uint8))
    count = before = 0
    for chunk in np.array_split(np.frombuffer(content, np.uint8), 40):
        before = csv_file._count_unclosed_line_ends(chunk.tobytes(), before)
        for byte in chunk.tobytes():
            if byte == ord('"'):
                count = 0 if count else 1
            elif byte == ord("\n") and count:
                count += 1
        assert before == count


@pytest.mark.parametrize("encoding", ["utf-8", "latin-1", "utf-16"])
def test_carriage_return_line_ends_are_read(tmp_path, encoding):
    """Programs of older Macintosh computers write such line ends."""
    columns = simulate_columns()
    text = format_lines({"Temperatur °C": np.zeros(1000), **columns})
    path = tmp_path / "run.csv"
    path.write_bytes(("\r".join(text) + "\r").encode(encoding))
    np.testing.assert_array_equal(read_written_record(path).signals["Qx"], columns[SIGNAL])
    assert read_table(path).frame.height == 1000
    text[500] += "x"
    path.write_bytes("\r".join(text).encode(encoding))
    assert f"line 501: column '{SIGNAL}' contains the text" in read_error_message(path)


def test_carriage_return_within_line_raises_with_line(tmp_path):
    text = format_lines(simulate_columns())
    text[500] = text[500].replace(",", ",1\r", 1) + ",1"
    message = read_error_message(write_record(tmp_path / "run.csv", text))
    assert "line 501: the line has 4 cells" in message


def test_footer_longer_than_the_file_leaves_no_rows(tmp_path):
    path = write_record(tmp_path / "run.csv", format_lines(simulate_columns(n=50)))
    with (
        open_columns(path, Dialect(skip_footer=80)) as file,
        pytest.raises(RecordError, match="no rows"),
    ):
        file.read_columns([TIME])

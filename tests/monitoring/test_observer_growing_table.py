"""Growing tables: appended rows are read once, and incomplete rows are not read."""

import numpy as np
import pytest

from counterspin.errors import RecordError
from counterspin.monitoring import observer
from counterspin.monitoring.observer import GrowingTable
from counterspin.records.formats import open_columns, read_numbers

NAMES = ["t", "x"]


def make_lines(first, last):
    return b"".join(b"%.3f,%.6g,ok\n" % (0.01 * k, np.sin(k)) for k in range(first, last))


HEAD = b"# made by a recorder\nt,x,note\n"


@pytest.fixture
def file(tmp_path):
    return tmp_path / "run.csv"


def append(file, content):
    with file.open("ab") as opened:
        opened.write(content)


def test_appended_chunks_are_read_once(file):
    content = HEAD + make_lines(0, 40) + b"# a remark\n" + make_lines(40, 300)
    followed, random = GrowingTable(file, NAMES), np.random.default_rng(1)
    done = 0
    while done < len(content):
        step = int(random.integers(1, 400))
        append(file, content[done : done + step])
        done += step
        followed.read_new_rows()
        assert followed.n_rows <= content[:done].count(b",ok\n")
    whole = read_numbers(file, NAMES)
    assert followed.n_rows == 300
    for name in NAMES:
        assert np.array_equal(followed.table.columns[name], whole[name])
    assert followed.read_new_rows() == (False, None)


def test_incomplete_line_is_not_read(file):
    followed = GrowingTable(file, NAMES)
    append(file, HEAD + make_lines(0, 30) + b"0.300,0.1")
    assert followed.read_new_rows() == (True, None)
    assert followed.n_rows == 30
    append(file, b"4112,ok\n")
    assert followed.read_new_rows() == (True, None)
    assert followed.table.columns["x"][30] == 0.14112


def test_header_without_rows_has_no_data(file):
    followed = GrowingTable(file, NAMES)
    append(file, HEAD)
    assert followed.read_new_rows() == (False, None)
    append(file, make_lines(0, 5))
    assert followed.read_new_rows() == (False, None)
    append(file, make_lines(5, 25))
    assert followed.read_new_rows() == (True, None)
    assert followed.n_rows == 25


def test_delimiter_and_decimal_comma_are_detected(file):
    head = b"Station;7\r\nBegun;2026-03-01\r\nt;x\r\ns;V\r\n"
    rows = b"".join(b"%d,5;-%d,25\r\n" % (k, k) for k in range(400))
    whole, followed = head + rows, GrowingTable(file, NAMES)
    for begin in range(0, len(whole), 700):
        append(file, whole[begin : begin + 700])
        followed.read_new_rows()
    assert followed.n_rows == 400
    assert np.array_equal(followed.table.columns["t"], np.arange(400) + 0.5)
    assert np.array_equal(followed.table.columns["x"], -np.arange(400) - 0.25)


def test_previous_bytes_are_not_read_again(file, monkeypatch):
    read = []
    monkeypatch.setattr(
        observer,
        "open_columns",
        lambda path, dialect: read.append(path.stat().st_size) or open_columns(path, dialect),
    )
    followed = GrowingTable(file, NAMES)
    append(file, HEAD + make_lines(0, 5000))
    followed.read_new_rows()
    before = len(read)
    append(file, make_lines(5000, 5010))
    followed.read_new_rows()
    assert followed.n_rows == 5010
    assert max(read[before:]) < 2000


@pytest.mark.parametrize(
    ("happens", "words"),
    [("replaced", "was replaced"), ("shorter", "became shorter"), ("anew", "was rewritten")],
)
def test_replaced_file_is_reported_and_read_from_start(happens, words, file):
    followed = GrowingTable(file, NAMES)
    append(file, HEAD + make_lines(0, 100))
    followed.read_new_rows()
    if happens == "replaced":
        (file.parent / "other").write_bytes(HEAD + make_lines(7, 60))
        (file.parent / "other").replace(file)
    elif happens == "shorter":
        file.write_bytes(HEAD + make_lines(7, 60))
    else:
        file.write_bytes(HEAD + make_lines(7, 200))
    changed, event = followed.read_new_rows()
    assert changed
    assert words in event
    assert followed.table.columns["t"][0] == 0.07


def test_invalid_row_raises_and_keeps_previous_rows(file):
    followed = GrowingTable(file, NAMES)
    append(file, HEAD + make_lines(0, 600))
    followed.read_new_rows()
    append(file, b"0.1,word,ok\n")
    with pytest.raises(
        RecordError, match=r"run\.csv, line 603: column 't'|'x' contains the text 'word'"
    ):
        followed.read_new_rows()
    assert followed.n_rows == 600
    file.write_bytes(HEAD + make_lines(0, 602))
    followed.read_new_rows()
    assert followed.n_rows == 602

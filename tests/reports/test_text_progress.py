"""The sign of life: shown on a terminal, after a moment, and wiped out again."""

import io
import time

from rich.console import Console

from counterspin.reports.text import progress


def terminal():
    return Console(file=io.StringIO(), force_terminal=True, width=80)


def test_nothing_where_there_is_no_terminal(capsys):
    with progress() as advance:
        assert advance is None
    assert capsys.readouterr().err == ""


def test_short_work_shows_nothing():
    console = terminal()
    with progress(console, patience=60.0) as advance:
        advance(1, 1)
    assert console.file.getvalue() == ""


def test_long_work_says_how_far_it_is_and_leaves_no_trace():
    console = terminal()
    with progress(console, patience=0.0) as advance:
        advance(1, 3)
        give_up = time.monotonic() + 300.0
        while "1/3" not in console.file.getvalue() and time.monotonic() < give_up:
            time.sleep(0.01)
        reading = console.file.getvalue()
        advance(3, 3)
        while "Estimating" not in console.file.getvalue() and time.monotonic() < give_up:
            time.sleep(0.01)
    assert "Reading runs" in reading
    assert "1/3" in reading
    written = console.file.getvalue()
    assert "Estimating" in written
    # The last thing written moves up and erases the line.
    assert written.endswith("\x1b[1A\x1b[2K")


def test_other_work_says_what_it_is():
    console = terminal()
    with progress(console, patience=0.0, words=("Searching", "Points", "Done")) as advance:
        for counts, said in (((0, 0), "Searching"), ((0, 3), "Points"), ((3, 3), "Done")):
            advance(*counts)
            give_up = time.monotonic() + 300.0
            while said not in console.file.getvalue() and time.monotonic() < give_up:
                time.sleep(0.01)
            assert said in console.file.getvalue()

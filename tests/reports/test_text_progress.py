"""Progress on a terminal: shown after a delay and erased at the end."""

import io
import time

from rich.console import Console

from counterspin.reports.text import show_progress


def make_terminal():
    return Console(file=io.StringIO(), force_terminal=True, width=80)


def test_no_progress_without_terminal(capsys):
    with show_progress() as advance:
        assert advance is None
    assert capsys.readouterr().err == ""


def test_short_task_shows_no_progress():
    console = make_terminal()
    with show_progress(console, delay=60.0) as advance:
        advance(1, 1)
    assert console.file.getvalue() == ""


def test_long_task_shows_progress_and_erases_it():
    console = make_terminal()
    with show_progress(console, delay=0.0) as advance:
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
    # The last output moves up and erases the line.
    assert written.endswith("\x1b[1A\x1b[2K")


def test_progress_names_task():
    console = make_terminal()
    with show_progress(console, delay=0.0, labels=("Searching", "Points", "Done")) as advance:
        for counts, label in (((0, 0), "Searching"), ((0, 3), "Points"), ((3, 3), "Done")):
            advance(*counts)
            give_up = time.monotonic() + 300.0
            while label not in console.file.getvalue() and time.monotonic() < give_up:
                time.sleep(0.01)
            assert label in console.file.getvalue()

"""Readers of native code: what they do to their process they do to no other."""

import os
import subprocess
import sys
from pathlib import Path

import misbehaving
import pytest
from raising import raises
from record_files import SIGNAL, read, refusal, table, write

from counterspin.errors import DamagedFileError, RecordError
from counterspin.records import reader_process
from counterspin.records.isolation import run_isolated, uses_reader_process

linux = pytest.mark.skipif(sys.platform != "linux", reason="limits are Linux's")


@pytest.fixture
def file(tmp_path):
    return write(tmp_path / "run.parquet", table())


def test_native_readers_have_a_process_of_their_own_and_csv_has_not(file):
    assert run_isolated(misbehaving.process, file) != os.getpid()
    assert run_isolated(misbehaving.process, file.with_suffix(".csv")) == os.getpid()
    assert [uses_reader_process(Path(f"a{end}")) for end in (".H5", ".mat", ".txt")] == [
        True,
        True,
        False,
    ]


def test_the_process_is_kept_and_survives_a_refusal(file):
    number = run_isolated(misbehaving.process, file)
    with pytest.raises(RecordError, match=r"run\.parquet: no"):
        run_isolated(misbehaving.refuse, file)
    assert run_isolated(misbehaving.process, file) == number


def test_after_a_damaged_file_another_process_reads(file):
    number = run_isolated(misbehaving.process, file)
    parent = run_isolated(misbehaving.parent, file)
    for _ in range(2):
        with pytest.raises(DamagedFileError):
            run_isolated(misbehaving.damage, file)
    assert run_isolated(misbehaving.process, file) != number
    assert len(read(file).time) == 1000
    if sys.platform == "linux":  # forked, with the limits of each file from the start
        assert run_isolated(misbehaving.parent, file) == parent != os.getpid()
        seconds, _ = run_isolated(misbehaving.limits, file)
        assert 5.0 < seconds < 10.0


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="no signals there")
def test_a_crash_is_a_refusal_of_the_file(file):
    with raises("file-damaged", "run.parquet:", "SIGSEGV"):
        run_isolated(misbehaving.crash, file)
    assert len(read(file).time) == 1000


@linux
def test_memory_without_end_is_refused(file):
    with pytest.raises(DamagedFileError, match="more memory than allowed"):
        run_isolated(misbehaving.take_memory, file)


@linux
def test_time_and_memory_are_bounded_by_the_files_size(file):
    seconds, memory = run_isolated(misbehaving.limits, file)
    assert 5.0 < seconds < 10.0
    assert memory < 2 << 30 or memory < (1 << 30) + (8 << 20) * os.cpu_count() + (1 << 30)
    with file.open("ab") as stream:
        stream.truncate(200_000_000)
    more_seconds, more_memory = run_isolated(misbehaving.limits, file)
    assert more_seconds == pytest.approx(seconds + 100.0, abs=2.0)
    assert more_memory - memory == pytest.approx(64 * 200_000_000, rel=0.01)


def test_a_mistake_of_ours_stays_one(file):
    with pytest.raises(ZeroDivisionError, match="by nothing") as caught:
        run_isolated(misbehaving.fail, file)
    assert "misbehaving.py" in caught.value.__notes__[0]  # where it happened


def test_where_no_process_can_be_started_files_are_read_here(file, monkeypatch):
    reader = reader_process._ReaderProcess()
    monkeypatch.setattr(reader_process, "_READER", reader)
    monkeypatch.setattr(sys, "path", [])
    assert run_isolated(misbehaving.process, file) == os.getpid()
    monkeypatch.undo()
    embedding = reader_process._ReaderProcess()
    embedding._startable = False
    monkeypatch.setattr(reader_process, "_READER", embedding)
    assert run_isolated(misbehaving.process, file) == os.getpid()


def test_relative_names_are_of_the_folder_where_they_are_given(file, monkeypatch):
    run_isolated(misbehaving.process, file)
    monkeypatch.chdir(file.parent)
    assert len(read(Path("run.parquet")).time) == 1000


def test_the_process_ends_with_the_one_that_started_it(file):
    program = (
        "import sys; from pathlib import Path; import misbehaving; "
        "from counterspin.records.isolation import run_isolated; "
        "path = Path(sys.argv[1]); "
        "print(run_isolated(misbehaving.process, path), "
        "run_isolated(misbehaving.parent, path))"
    )
    folders = os.pathsep.join([str(Path(misbehaving.__file__).parent), *filter(None, sys.path)])
    done = subprocess.run(
        [sys.executable, "-c", program, str(file)],
        env={**os.environ, "PYTHONPATH": folders},
        capture_output=True,
        check=True,
    )
    assert not [number for number in done.stdout.split() if runs(int(number))]


def runs(number):
    """Return whether a process runs; one that has ended may wait for the system to collect it."""
    status = Path(f"/proc/{number}/stat")
    try:
        return status.read_text("ascii").rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def test_a_refusal_is_the_same_as_here(tmp_path):
    columns = table()
    columns[SIGNAL][7] = float("inf")
    message = refusal(write(tmp_path / "run.parquet", columns))
    assert f"row 8: column '{SIGNAL}' " in message

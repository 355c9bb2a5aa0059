"""Readers of native code: what they do to their process they do to no other."""

import os
import subprocess
import sys
from pathlib import Path

import misbehaving
import pytest
from raising import raises
from record_files import (
    SIGNAL,
    read_error_message,
    read_written_record,
    simulate_columns,
    write_record,
)

from counterspin.errors import DamagedFileError, RecordError
from counterspin.records import reader_process
from counterspin.records.isolation import run_isolated, uses_reader_process

linux = pytest.mark.skipif(sys.platform != "linux", reason="limits are Linux's")


@pytest.fixture
def parquet_file(tmp_path):
    return write_record(tmp_path / "run.parquet", simulate_columns())


def test_native_readers_use_separate_process_and_csv_does_not(parquet_file):
    assert run_isolated(misbehaving.get_process, parquet_file) != os.getpid()
    assert run_isolated(misbehaving.get_process, parquet_file.with_suffix(".csv")) == os.getpid()
    assert [uses_reader_process(Path(f"a{end}")) for end in (".H5", ".mat", ".txt")] == [
        True,
        True,
        False,
    ]


def test_reader_process_is_reused_after_record_error(parquet_file):
    number = run_isolated(misbehaving.get_process, parquet_file)
    with pytest.raises(RecordError, match=r"run\.parquet: no"):
        run_isolated(misbehaving.refuse, parquet_file)
    assert run_isolated(misbehaving.get_process, parquet_file) == number


def test_damaged_file_starts_new_reader_process(parquet_file):
    number = run_isolated(misbehaving.get_process, parquet_file)
    parent = run_isolated(misbehaving.get_parent, parquet_file)
    for _ in range(2):
        with pytest.raises(DamagedFileError):
            run_isolated(misbehaving.damage, parquet_file)
    assert run_isolated(misbehaving.get_process, parquet_file) != number
    assert len(read_written_record(parquet_file).time) == 1000
    if sys.platform == "linux":  # forked, with the limits of each file from the start
        assert run_isolated(misbehaving.get_parent, parquet_file) == parent != os.getpid()
        seconds, _ = run_isolated(misbehaving.get_limits, parquet_file)
        assert 5.0 < seconds < 10.0


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="no signals there")
def test_reader_crash_raises_damaged_file(parquet_file):
    with raises("file-damaged", "run.parquet:", "SIGSEGV"):
        run_isolated(misbehaving.crash, parquet_file)
    assert len(read_written_record(parquet_file).time) == 1000


@linux
def test_excessive_memory_raises(parquet_file):
    with pytest.raises(DamagedFileError, match="more memory than allowed"):
        run_isolated(misbehaving.take_memory, parquet_file)


@linux
def test_time_and_memory_limits_follow_file_size(parquet_file):
    seconds, memory = run_isolated(misbehaving.get_limits, parquet_file)
    assert 5.0 < seconds < 10.0
    assert memory < 2 << 30 or memory < (1 << 30) + (8 << 20) * os.cpu_count() + (1 << 30)
    with parquet_file.open("ab") as stream:
        stream.truncate(200_000_000)
    more_seconds, more_memory = run_isolated(misbehaving.get_limits, parquet_file)
    assert more_seconds == pytest.approx(seconds + 100.0, abs=2.0)
    assert more_memory - memory == pytest.approx(64 * 200_000_000, rel=0.01)


def test_internal_error_is_passed_on(parquet_file):
    with pytest.raises(ZeroDivisionError, match="by nothing") as caught:
        run_isolated(misbehaving.fail, parquet_file)
    assert "misbehaving.py" in caught.value.__notes__[0]  # where it happened


def test_files_are_read_in_process_if_none_can_start(parquet_file, monkeypatch):
    reader = reader_process._ReaderProcess()
    monkeypatch.setattr(reader_process, "_READER", reader)
    monkeypatch.setattr(sys, "path", [])
    assert run_isolated(misbehaving.get_process, parquet_file) == os.getpid()
    monkeypatch.undo()
    embedding = reader_process._ReaderProcess()
    embedding._can_start = False
    monkeypatch.setattr(reader_process, "_READER", embedding)
    assert run_isolated(misbehaving.get_process, parquet_file) == os.getpid()


def test_relative_path_refers_to_current_folder(parquet_file, monkeypatch):
    run_isolated(misbehaving.get_process, parquet_file)
    monkeypatch.chdir(parquet_file.parent)
    assert len(read_written_record(Path("run.parquet")).time) == 1000


def test_reader_process_ends_with_parent(parquet_file):
    program = (
        "import sys; from pathlib import Path; import misbehaving; "
        "from counterspin.records.isolation import run_isolated; "
        "path = Path(sys.argv[1]); "
        "print(run_isolated(misbehaving.get_process, path), "
        "run_isolated(misbehaving.get_parent, path))"
    )
    folders = os.pathsep.join([str(Path(misbehaving.__file__).parent), *filter(None, sys.path)])
    done = subprocess.run(
        [sys.executable, "-c", program, str(parquet_file)],
        env={**os.environ, "PYTHONPATH": folders},
        capture_output=True,
        check=True,
    )
    assert not [number for number in done.stdout.split() if is_running(int(number))]


def is_running(number):
    """Return whether a process runs; one that has ended may wait for the system to collect it."""
    status = Path(f"/proc/{number}/stat")
    try:
        return status.read_text("ascii").rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def test_error_in_reader_process_names_row_and_column(tmp_path):
    columns = simulate_columns()
    columns[SIGNAL][7] = float("inf")
    message = read_error_message(write_record(tmp_path / "run.parquet", columns))
    assert f"row 8: column '{SIGNAL}' " in message

"""Limits of the process that reads a file; those of Linux are tested with the process."""

import ctypes
import os
from functools import partial

import misbehaving
import pytest
from raising import raises
from record_files import simulate_columns, write_record

from counterspin.records import reader_limits, reader_process
from counterspin.records.isolation import run_isolated


class Kernel:
    """Replace kernel32 of Windows and log the calls."""

    def __init__(self, assigned=1):
        self.limits = []
        self.jobs = 0
        self.GetCurrentProcess = lambda: 2**64 - 1
        self.CreateJobObjectW = partial(self.create)
        self.AssignProcessToJobObject = lambda job, process: assigned * job.value
        self.K32GetProcessMemoryInfo = self.count
        self.SetInformationJobObject = self.set

    def create(self, *names):
        assert names == (None, None)
        self.jobs += 1
        return 7

    def count(self, process, counters, size):
        assert size == 72  # size on 64-bit Windows
        counters._obj.PagefileUsage = 10**9

    def set(self, job, kind, limits, size):
        assert (job.value, kind, size) == (7, 9, 144)
        # The fields at their places in the documentation of Windows.
        raw = bytes(limits._obj)
        values = [int.from_bytes(raw[n : n + 8], "little") for n in (0, 16, 112)]
        self.limits.append((values[0] / 1e7, values[1], values[2]))


@pytest.fixture
def windows(monkeypatch):
    def start(kernel):
        monkeypatch.setattr("sys.platform", "win32")
        monkeypatch.setattr(ctypes, "WinDLL", lambda name: kernel, raising=False)
        monkeypatch.setattr(reader_limits, "_JOB", reader_limits._WindowsJob())
        return kernel

    return start


def test_job_object_limits_time_and_memory_on_windows(windows, tmp_path):
    kernel, file = windows(Kernel()), tmp_path / "run.parquet"
    file.write_bytes(b"")
    used = os.times().user
    reader_limits.limit_reading(file)
    with file.open("ab") as stream:
        stream.truncate(20_000_000)
    reader_limits.limit_reading(file)
    reader_limits.limit_reading(tmp_path / "nowhere.parquet")
    (first, flags, memory), (second, _, more) = kernel.limits
    assert kernel.jobs == 1
    assert flags == 0x102
    assert first == pytest.approx(used + 8.0, abs=1.0)
    assert second - first == pytest.approx(10.0, abs=1.0)
    assert memory == 10**9 + (1 << 30) + (8 << 20) * os.cpu_count()
    assert more - memory == 64 * 20_000_000


def test_file_is_read_without_job_object(windows, tmp_path):
    kernel, file = windows(Kernel(assigned=0)), tmp_path / "run.parquet"
    file.touch()
    reader_limits.limit_reading(file)
    assert kernel.limits == []


def test_hanging_reader_is_terminated(tmp_path, monkeypatch):
    """The reader uses no processor time, so no system limit terminates it."""
    file = write_record(tmp_path / "run.parquet", simulate_columns())
    process = run_isolated(misbehaving.get_process, file)
    monkeypatch.setattr(reader_limits, "_WAITING_FACTOR", 0.02)
    with raises("time-limit", "run.parquet:", "longer"):
        run_isolated(misbehaving.wait, file)
    monkeypatch.undo()
    assert run_isolated(misbehaving.get_process, file) != process


@pytest.mark.parametrize(
    ("status", "words"),
    [
        (1816, "takes far longer than expected for its size"),
        (0xC0000005, r"it crashed the reader process \(access violation\)"),
        (3, r"it crashed the reader process \(exit status 3\)"),
    ],
)
def test_exit_status_on_windows_is_described(monkeypatch, status, words):
    monkeypatch.setattr("sys.platform", "win32")
    with pytest.raises(AssertionError, match=words):
        raise AssertionError(reader_process._describe_exit(status))

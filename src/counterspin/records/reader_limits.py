"""Limits of the processor time and the memory of the reader process.

- Linux: resource limits for both.
- macOS: a resource limit on the processor time; the system ignores those on memory.
- Windows: a job object for both.
"""

from __future__ import annotations

import ctypes
import os
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

#: Processor time for reading: seconds for any file, and bytes per second.
_READING_SECONDS: Final = 8.0
_BYTES_PER_SECOND: Final = 2e6
#: Memory for reading: bytes for any file, bytes per byte of the file, and bytes per thread.
_READING_BYTES: Final = 1 << 30
_BYTES_PER_BYTE: Final = 64
_THREAD_BYTES: Final = 8 << 20
#: Timeout of a reader relative to its processor time: the machine may be busy.
_WAITING_FACTOR: Final = 30.0

#: Exit status of a process that exceeds the time of its job object, ERROR_NOT_ENOUGH_QUOTA.
WINDOWS_TIME_STATUS: Final = 1816

#: Number of JOBOBJECT_EXTENDED_LIMIT_INFORMATION, and flags of its limits.
_EXTENDED_LIMITS: Final = 9
_LIMIT_PROCESS_TIME: Final = 0x0000_0002
_LIMIT_PROCESS_MEMORY: Final = 0x0000_0100
#: Time units of Windows, 100 ns.
_TICKS_PER_SECOND: Final = 10_000_000


def processor_seconds(size: int) -> float:
    """Return the processor time to allow for reading a file of a size in bytes, s."""
    return _READING_SECONDS + size / _BYTES_PER_SECOND


def waiting_seconds(path: Path) -> float:
    """Return the timeout for reading a file, s."""
    try:
        size = path.stat().st_size
    except (OSError, ValueError):
        size = 0  # the reader reports the error
    return _WAITING_FACTOR * processor_seconds(size)


def limit_reading(path: Path) -> None:
    """Limit the processor time and the memory of this process, which reads a file next."""
    try:
        size = path.stat().st_size
    except (OSError, ValueError):
        return  # the reader reports the error
    seconds = processor_seconds(size)
    extra_bytes = _READING_BYTES + _BYTES_PER_BYTE * size + _THREAD_BYTES * (os.cpu_count() or 1)
    if sys.platform == "win32":
        _JOB.limit(seconds, extra_bytes)
        return
    import resource

    usage = resource.getrusage(resource.RUSAGE_SELF)
    _set_limit("RLIMIT_CPU", usage.ru_utime + usage.ru_stime + seconds)
    with suppress(OSError, ValueError):
        # The limit applies to writable memory, not to mapped files.
        status = Path("/proc/self/status").read_text("ascii")
        used_bytes = 1024 * int(status.partition("VmData:")[2].split()[0])
        _set_limit("RLIMIT_DATA", used_bytes + extra_bytes)
    omit_core_file()


def omit_core_file() -> None:
    """Keep this process from writing its memory to a file if it crashes."""
    _set_limit("RLIMIT_CORE", 0)


def _set_limit(name: str, limit: float) -> None:
    """Set a limit of this process, at most the hard limit."""
    if sys.platform == "win32":
        return
    import resource

    resource_id: int = getattr(resource, name)
    _, hard_limit = resource.getrlimit(resource_id)
    soft_limit = int(limit) if hard_limit == resource.RLIM_INFINITY else min(int(limit), hard_limit)
    resource.setrlimit(resource_id, (soft_limit, hard_limit))


class _WindowsJob:
    """The job object of this process, created with the first limit."""

    def __init__(self) -> None:
        self._job: Any = None

    def limit(self, seconds: float, n_bytes: int) -> None:
        """Limit the additional processor time, s, and the additional memory, bytes.

        Windows terminates a process after its time, and denies memory beyond the limit.
        """
        if sys.platform != "win32":
            return
        kernel32: Any = ctypes.WinDLL("kernel32")
        kernel32.CreateJobObjectW.restype = kernel32.GetCurrentProcess.restype = ctypes.c_void_p
        process = ctypes.c_void_p(kernel32.GetCurrentProcess())
        if self._job is None:
            job = ctypes.c_void_p(kernel32.CreateJobObjectW(None, None))
            if not kernel32.AssignProcessToJobObject(job, process):
                return  # the job of the parent process does not allow another
            self._job = job
        counters = _MemoryCounters(cb=ctypes.sizeof(_MemoryCounters))
        kernel32.K32GetProcessMemoryInfo(process, ctypes.byref(counters), counters.cb)
        limits = _JobLimits()
        limits.PerProcessUserTimeLimit = int(_TICKS_PER_SECOND * (os.times().user + seconds))
        limits.ProcessMemoryLimit = counters.PagefileUsage + n_bytes
        limits.LimitFlags = _LIMIT_PROCESS_TIME | _LIMIT_PROCESS_MEMORY
        kernel32.SetInformationJobObject(
            self._job, _EXTENDED_LIMITS, ctypes.byref(limits), ctypes.sizeof(limits)
        )


_JOB: Final = _WindowsJob()


class _JobLimits(ctypes.Structure):
    """JOBOBJECT_EXTENDED_LIMIT_INFORMATION of Windows, with nested structures flattened."""

    _fields_ = (
        ("PerProcessUserTimeLimit", ctypes.c_int64),
        ("PerJobUserTimeLimit", ctypes.c_int64),
        ("LimitFlags", ctypes.c_uint32),
        ("MinimumWorkingSetSize", ctypes.c_size_t),
        ("MaximumWorkingSetSize", ctypes.c_size_t),
        ("ActiveProcessLimit", ctypes.c_uint32),
        ("Affinity", ctypes.c_size_t),
        ("PriorityClass", ctypes.c_uint32),
        ("SchedulingClass", ctypes.c_uint32),
        ("IoInfo", ctypes.c_uint64 * 6),
        ("ProcessMemoryLimit", ctypes.c_size_t),
        ("JobMemoryLimit", ctypes.c_size_t),
        ("PeakProcessMemoryUsed", ctypes.c_size_t),
        ("PeakJobMemoryUsed", ctypes.c_size_t),
    )


class _MemoryCounters(ctypes.Structure):
    """PROCESS_MEMORY_COUNTERS of Windows; PagefileUsage is the committed memory."""

    _fields_ = (
        ("cb", ctypes.c_uint32),
        ("PageFaultCount", ctypes.c_uint32),
        ("PeakWorkingSetSize", ctypes.c_size_t),
        ("WorkingSetSize", ctypes.c_size_t),
        ("QuotaPeakPagedPoolUsage", ctypes.c_size_t),
        ("QuotaPagedPoolUsage", ctypes.c_size_t),
        ("QuotaPeakNonPagedPoolUsage", ctypes.c_size_t),
        ("QuotaNonPagedPoolUsage", ctypes.c_size_t),
        ("PagefileUsage", ctypes.c_size_t),
        ("PeakPagefileUsage", ctypes.c_size_t),
    )

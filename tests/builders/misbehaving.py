"""Functions of a file that crash, block or exhaust their process, as damaged files may."""

import os
import signal
import time
from pathlib import Path

from counterspin.errors import DamagedFileError, RecordError

try:
    import resource
except ImportError:
    resource = None


def crash(_path: Path) -> None:
    os.kill(os.getpid(), signal.SIGSEGV)


def take_memory(_path: Path) -> int:
    return len(bytearray(1 << 36))


def wait(_path: Path) -> None:
    time.sleep(1000.0)


def refuse(path: Path) -> None:
    raise RecordError(f"{path}: no")


def fail(_path: Path) -> None:
    raise ZeroDivisionError("by nothing")


def get_process(_path: Path) -> int:
    return os.getpid()


def get_limits(_path: Path) -> tuple[int, int]:
    """Return the remaining processor time and memory, in s and bytes."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    seconds = resource.getrlimit(resource.RLIMIT_CPU)[0] - used.ru_utime - used.ru_stime
    return seconds, resource.getrlimit(resource.RLIMIT_DATA)[0]


def get_parent(_path: Path) -> int:
    return os.getppid()


def damage(path: Path) -> None:
    raise DamagedFileError(f"{path}: damaged")

"""Reading in a process of its own, where a damaged file can crash the reader.

The readers of Parquet, HDF5, MATLAB and Excel files are native code, which a flipped bit can
crash, send round in circles or make ask for all memory. So those files are read in another process,
which is started once, kept, and given up a minute after its last file or after one that it made
nothing of. On Linux a process in between forks it, so that after a damaged file another, with all
that takes long to load, is there at once. It returns little where a record is reduced to block
means.
"""

from __future__ import annotations

import atexit
import importlib
import json
import os
import pickle
import select
import signal
import subprocess
import sys
import threading
import traceback
from collections.abc import Callable
from contextlib import suppress
from itertools import chain
from pathlib import Path
from typing import Any, BinaryIO, Final, NoReturn

from counterspin.errors import CounterspinError, DamagedFileError
from counterspin.records.isolation import NATIVE
from counterspin.records.reader_limits import (
    WINDOWS_TIME_STATUS,
    limit_reading,
    omit_core_file,
    waiting_seconds,
)

#: Those that start threads when they are loaded: what has them does not fork.
_THREADED: Final = ("polars",)
#: Seconds without work after which the reader's process ends.
_IDLE_SECONDS: Final = 60.0

#: Status of a process that another one is to follow.
_RESTART_STATUS: Final = 75
_TIMEOUT_STATUS: Final = (
    "the file is damaged: reading it takes far longer than expected for its size."
)
#: How processes end on Windows -> what that means.
_WINDOWS_DEATHS: Final = {
    0xC000_0005: "access violation",
    0xC000_00FD: "stack overflow",
    0xC000_0409: "abort",
}
#: Seconds that a process is given to end.
_TERMINATION_SECONDS: Final = 5.0

#: What the reader's process runs; its arguments are the path of modules and those to load.
_PROGRAM: Final = (
    "import json, sys; sys.path[:] = json.loads(sys.argv[1]); "
    "from counterspin.records.reader_process import serve; serve(sys.argv[2:])"
)


class _ReaderProcess:
    """The reader's process, seen from the process that asks it."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._ready = False
        # Without an interpreter of its own, as in a program that embeds Python, it cannot start.
        name = Path(sys.executable or "").name.lower()
        self._startable = name.startswith(("python", "pypy")) and not hasattr(sys, "frozen")

    def prepare(self, suffix: str) -> None:
        """Start the process if it does not run."""
        with self._lock:
            self._started(suffix)

    def ask(
        self, suffix: str, path: Path, request: tuple[object, ...]
    ) -> tuple[Any] | BaseException | None:
        """Return (what the process returns,), what it raises, or None if it cannot be started."""
        message = pickle.dumps(request)
        with self._lock:
            try:
                # A process that had nothing to do may end at the very moment it is asked.
                for _ in range(2):
                    process = self._started(suffix)
                    if process is None:
                        return None
                    reply, in_time = self._exchange_with_timeout(process, message, path)
                    if not in_time:
                        self._kill()
                    if reply is not None:
                        return reply
                    if not in_time:
                        return DamagedFileError(f"{path}: {_TIMEOUT_STATUS}", code="time-limit")
                    if not self._ready:
                        self._kill()
                        self._startable = False
                        return None
                    self._ready = False
                    status = process.wait()
                    if status != 0:
                        break
                return DamagedFileError(f"{path}: {_exit_description(status)}")
            except BaseException:
                self._kill()  # what it still answers would be taken for the next answer
                raise

    def _started(self, suffix: str) -> subprocess.Popen[bytes] | None:
        if self._process is not None and self._process.poll() is None:
            return self._process
        self._kill()
        if not self._startable:
            return None
        libraries = NATIVE[suffix]
        command = [sys.executable, "-P", "-c", _PROGRAM, json.dumps(sys.path), *libraries]
        pipe = subprocess.PIPE
        try:
            self._process = subprocess.Popen(
                command,
                stdin=pipe,
                stdout=pipe,
                stderr=subprocess.DEVNULL,
                # Nothing that it does takes more threads than its readers have of their own.
                env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
                process_group=None if sys.platform == "win32" else 0,
            )
        except OSError:
            self._startable = False
        return self._process

    def _exchange_with_timeout(
        self, process: subprocess.Popen[bytes], message: bytes, path: Path
    ) -> tuple[tuple[Any] | BaseException | None, bool]:
        """Return the answer, and whether it came before the process was ended for its time."""
        expired = threading.Event()

        def expire() -> None:
            expired.set()
            _terminate(process)

        timer = threading.Timer(waiting_seconds(path), expire)
        timer.daemon = True
        timer.start()
        try:
            reply = self._exchange(process, message)
        finally:
            timer.cancel()
            timer.join()
        return reply, not expired.is_set()

    def _exchange(
        self, process: subprocess.Popen[bytes], message: bytes
    ) -> tuple[Any] | BaseException | None:
        """Return the answer, or None if the process ended without one."""
        assert process.stdin is not None
        assert process.stdout is not None
        with suppress(OSError):  # it has ended, as shows below
            process.stdin.write(len(message).to_bytes(8, "little") + message)
            process.stdin.flush()
        self._ready = self._ready or bool(process.stdout.read(1))
        length_prefix = process.stdout.read(8)
        if len(length_prefix) < 8:
            return None
        answer = process.stdout.read(int.from_bytes(length_prefix, "little"))
        if len(answer) < int.from_bytes(length_prefix, "little"):
            return None
        reply: tuple[Any] | BaseException = pickle.loads(answer)
        return reply

    def _kill(self) -> None:
        """End the process, if there is one."""
        process, self._process, self._ready = self._process, None, False
        if process is not None:
            for stream in (process.stdin, process.stdout):
                if stream is not None:
                    with suppress(OSError):
                        stream.close()
            if process.poll() is None:
                _terminate(process)

    def close(self) -> None:
        """End the process, at the end of this one."""
        self._kill()

    def forget(self) -> None:
        """Leave the process to the one that this was forked from."""
        self._lock = threading.Lock()
        if self._process is not None:
            self._process.returncode = 0
            self._process = None


_READER: Final = _ReaderProcess()
atexit.register(_READER.close)
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_READER.forget)


def prepare(suffix: str) -> None:
    """Start the process for files of an ending if it does not run."""
    _READER.prepare(suffix)


def run_in_reader(
    function: Callable[..., Any], path: Path, *args: Any
) -> tuple[Any] | BaseException | None:
    """Return (``function(path, *args)``,), its error, or None if no process can be started."""
    return _READER.ask(path.suffix.lower(), path, (_directory(), function, (path, *args)))


def _terminate(process: subprocess.Popen[bytes]) -> None:
    """End a process, and before it the one that it forked."""
    if sys.platform == "win32":
        process.kill()
        process.wait()
        return
    # Asked so, the one that reads ends, and the other once it has seen to that.
    for signal_number in (signal.SIGTERM, signal.SIGKILL):
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal_number)
        with suppress(subprocess.TimeoutExpired):
            process.wait(_TERMINATION_SECONDS)
            return


def serve(libraries: list[str]) -> None:
    """Answer requests on standard input until it ends or none has come for a while."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # for the process that asks to see to
    requests = os.fdopen(os.dup(0), "rb", buffering=0)
    replies = os.fdopen(os.dup(1), "wb")
    # Libraries complain of damaged files on their own.
    nowhere = os.open(os.devnull, os.O_RDWR)
    for number in range(3):
        os.dup2(nowhere, number)
    for name in ("counterspin.records.reading", *set(libraries).difference(_THREADED)):
        _load(name)
    replies.write(b"!")
    replies.flush()
    _read_in_forks(libraries, requests, replies)
    for name in libraries:
        _load(name)
    _answer_all(requests, replies)


def _read_in_forks(libraries: list[str], requests: Any, replies: BinaryIO) -> None:
    """Answer requests in forked processes, where this process may fork; a new one after damage."""
    if sys.platform == "win32":
        return
    while _may_fork():
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        child = os.fork()
        if child == 0:
            signal.signal(signal.SIGTERM, signal.SIG_DFL)
            _read_and_exit(libraries, requests, replies)
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        if status != _RESTART_STATUS:
            _exit_like(status)
        # Where one file is damaged others may be, of any format.
        for name in set(chain(*NATIVE.values())).difference(_THREADED):
            _load(name)


def _load(name: str) -> None:
    with suppress(ImportError):  # the function that needs it says so
        importlib.import_module(name)


def _may_fork() -> bool:
    """Return True if this process can fork: with threads a fork may inherit held locks."""
    try:
        return sys.platform == "linux" and len(os.listdir("/proc/self/task")) == 1  # noqa: PTH208
    except OSError:
        return False


def _read_and_exit(libraries: list[str], requests: Any, replies: BinaryIO) -> NoReturn:
    status = 1
    try:
        for name in libraries:
            _load(name)
        status = 0 if _answer_all(requests, replies) else _RESTART_STATUS
    finally:
        os._exit(status)


def _exit_like(status: int) -> NoReturn:
    """End as the process that was forked did: with its status, or of its signal."""
    if status < 0:
        omit_core_file()
        with suppress(OSError, ValueError):
            signal.signal(-status, signal.SIG_DFL)
        os.kill(os.getpid(), -status)
    os._exit(status if status >= 0 else 1)


def _answer_all(requests: Any, replies: BinaryIO) -> bool:
    """Answer requests until there are none; return False after a file that did harm, perhaps."""
    while _is_readable_in_time(requests.fileno()):
        length_prefix = requests.read(8)
        if len(length_prefix) < 8:
            return True
        reply = _answer(_read_exactly(requests, int.from_bytes(length_prefix, "little")))
        try:
            answer = pickle.dumps(reply)
        except Exception:  # an error that cannot be pickled still tells what it is
            answer = pickle.dumps(RuntimeError(repr(reply)))
        replies.write(len(answer).to_bytes(8, "little"))
        replies.write(answer)
        replies.flush()
        if isinstance(reply, DamagedFileError):
            return False
    return True


def _answer(message: bytes) -> tuple[Any] | BaseException:
    directory, function, (path, *args) = pickle.loads(message)
    try:
        if directory is not None:
            os.chdir(directory)
        limit_reading(path)
        return (function(path, *args),)
    except CounterspinError as error:
        return error
    except MemoryError:
        return DamagedFileError(
            f"{path}: reading the file requires more memory than allowed.", code="out-of-memory"
        )
    except BaseException as error:
        error.add_note(traceback.format_exc())
        return error


def _read_exactly(stream: Any, byte_count: int) -> bytes:
    chunks = []
    while byte_count:
        chunk = stream.read(byte_count)
        if not chunk:
            raise EOFError
        chunks.append(chunk)
        byte_count -= len(chunk)
    return b"".join(chunks)


def _is_readable_in_time(descriptor: int) -> bool:
    if sys.platform == "win32":  # which cannot wait for a pipe
        return True
    return bool(select.select([descriptor], [], [], _IDLE_SECONDS)[0])


def _directory() -> str | None:
    try:
        return os.getcwd()  # noqa: PTH109 - a name that is passed on
    except OSError:
        return None


def _exit_description(status: int) -> str:
    """Say how the reader's process ended: an exit status, or less than 0 for a signal."""
    try:
        name = signal.Signals(-status).name
    except ValueError:
        name = _WINDOWS_DEATHS.get(status, f"exit status {status}")
    if name == "SIGXCPU" or (sys.platform == "win32" and status == WINDOWS_TIME_STATUS):
        return _TIMEOUT_STATUS
    if name == "SIGABRT":
        return (
            "the file is damaged or needs more memory than allowed: the reader process aborted "
            "(SIGABRT)."
        )
    if name == "SIGKILL":
        return (
            "the operating system stopped the reader process, most likely because it ran out of "
            "memory."
        )
    return f"the file is damaged: it crashed the reader process ({name})."

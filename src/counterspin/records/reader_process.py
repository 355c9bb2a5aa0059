"""Separate process for readers that a damaged file can crash.

The readers of Parquet, HDF5, MATLAB and Excel files are native code. A damaged file can crash it,
or cause an endless loop or an excessive memory request. Such files are therefore read in a separate
process, which is started once and ends a minute after its last file, or after a damaged file. On
Linux an intermediate process with all libraries loaded forks the reader, so that a new one starts
immediately. With block means, the reader process returns little data.
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
from counterspin.records.isolation import NATIVE_LIBRARIES
from counterspin.records.reader_limits import (
    WINDOWS_TIME_STATUS,
    limit_reading,
    omit_core_file,
    waiting_seconds,
)

#: Libraries that start threads when they are loaded, after which a process must not fork.
_THREADED_LIBRARIES: Final = ("polars",)
#: Seconds without requests after which the reader process ends.
_IDLE_SECONDS: Final = 60.0

#: Exit status of a process that must be replaced by a new one.
_RESTART_STATUS: Final = 75
_TIMEOUT_MESSAGE: Final = (
    "the file is damaged: reading it takes far longer than expected for its size."
)
#: Exit status of Windows -> cause.
_WINDOWS_EXIT_CAUSES: Final = {
    0xC000_0005: "access violation",
    0xC000_00FD: "stack overflow",
    0xC000_0409: "abort",
}
#: Timeout for the termination of a process, s.
_TERMINATION_SECONDS: Final = 5.0

#: Program of the reader process; its arguments are the module path and the libraries to load.
_PROGRAM: Final = (
    "import json, sys; sys.path[:] = json.loads(sys.argv[1]); "
    "from counterspin.records.reader_process import serve; serve(sys.argv[2:])"
)


class _ReaderProcess:
    """The reader process, as used by the calling process."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._is_ready = False
        # A program that embeds Python has no interpreter to start.
        name = Path(sys.executable or "").name.lower()
        self._can_start = name.startswith(("python", "pypy")) and not hasattr(sys, "frozen")

    def prepare(self, suffix: str) -> None:
        """Start the process if it is not running."""
        with self._lock:
            self._ensure_started(suffix)

    def ask(
        self, suffix: str, path: Path, request: tuple[object, ...]
    ) -> tuple[Any] | BaseException | None:
        """Return (result,), the raised error, or None if the process cannot be started."""
        request_bytes = pickle.dumps(request)
        with self._lock:
            try:
                # An idle process may end just when a request is sent.
                for _ in range(2):
                    process = self._ensure_started(suffix)
                    if process is None:
                        return None
                    reply, is_in_time = self._exchange_with_timeout(process, request_bytes, path)
                    if not is_in_time:
                        self._kill()
                    if reply is not None:
                        return reply
                    if not is_in_time:
                        return DamagedFileError(f"{path}: {_TIMEOUT_MESSAGE}", code="time-limit")
                    if not self._is_ready:
                        self._kill()
                        self._can_start = False
                        return None
                    self._is_ready = False
                    status = process.wait()
                    if status != 0:
                        break
                return DamagedFileError(f"{path}: {_describe_exit(status)}")
            except BaseException:
                self._kill()  # a late reply would be mistaken for the next one
                raise

    def _ensure_started(self, suffix: str) -> subprocess.Popen[bytes] | None:
        if self._process is not None and self._process.poll() is None:
            return self._process
        self._kill()
        if not self._can_start:
            return None
        libraries = NATIVE_LIBRARIES[suffix]
        command = [sys.executable, "-P", "-c", _PROGRAM, json.dumps(sys.path), *libraries]
        pipe = subprocess.PIPE
        try:
            self._process = subprocess.Popen(
                command,
                stdin=pipe,
                stdout=pipe,
                stderr=subprocess.DEVNULL,
                # The readers have their own threads.
                env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
                process_group=None if sys.platform == "win32" else 0,
            )
        except OSError:
            self._can_start = False
        return self._process

    def _exchange_with_timeout(
        self, process: subprocess.Popen[bytes], request_bytes: bytes, path: Path
    ) -> tuple[tuple[Any] | BaseException | None, bool]:
        """Return the reply, and whether it arrived before the timeout."""
        timeout_event = threading.Event()

        def expire() -> None:
            timeout_event.set()
            _terminate(process)

        timer = threading.Timer(waiting_seconds(path), expire)
        timer.daemon = True
        timer.start()
        try:
            reply = self._exchange(process, request_bytes)
        finally:
            timer.cancel()
            timer.join()
        return reply, not timeout_event.is_set()

    def _exchange(
        self, process: subprocess.Popen[bytes], request_bytes: bytes
    ) -> tuple[Any] | BaseException | None:
        """Return the reply, or None if the process ended without one."""
        assert process.stdin is not None
        assert process.stdout is not None
        with suppress(OSError):  # the process has ended; see below
            process.stdin.write(len(request_bytes).to_bytes(8, "little") + request_bytes)
            process.stdin.flush()
        self._is_ready = self._is_ready or bool(process.stdout.read(1))
        length_prefix = process.stdout.read(8)
        if len(length_prefix) < 8:
            return None
        payload = process.stdout.read(int.from_bytes(length_prefix, "little"))
        if len(payload) < int.from_bytes(length_prefix, "little"):
            return None
        reply: tuple[Any] | BaseException = pickle.loads(payload)
        return reply

    def _kill(self) -> None:
        """End the process, if there is one."""
        process, self._process, self._is_ready = self._process, None, False
        if process is not None:
            for stream in (process.stdin, process.stdout):
                if stream is not None:
                    with suppress(OSError):
                        stream.close()
            if process.poll() is None:
                _terminate(process)

    def close(self) -> None:
        """End the process when this one exits."""
        self._kill()

    def detach(self) -> None:
        """Detach from the process in a forked child; it belongs to the parent."""
        self._lock = threading.Lock()
        if self._process is not None:
            self._process.returncode = 0
            self._process = None


_READER: Final = _ReaderProcess()
atexit.register(_READER.close)
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_READER.detach)


def prepare(suffix: str) -> None:
    """Start the process for files with an extension if it is not running."""
    _READER.prepare(suffix)


def run_in_reader(
    function: Callable[..., Any], path: Path, *args: Any
) -> tuple[Any] | BaseException | None:
    """Return (``function(path, *args)``,), its error, or None if no process can be started."""
    return _READER.ask(path.suffix.lower(), path, (_current_folder(), function, (path, *args)))


def _terminate(process: subprocess.Popen[bytes]) -> None:
    """Terminate a process and its forked child."""
    if sys.platform == "win32":
        process.kill()
        process.wait()
        return
    # SIGTERM ends the child, and then the parent.
    for signal_number in (signal.SIGTERM, signal.SIGKILL):
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal_number)
        with suppress(subprocess.TimeoutExpired):
            process.wait(_TERMINATION_SECONDS)
            return


def serve(libraries: list[str]) -> None:
    """Serve requests on standard input until it ends or after an idle time."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # handled by the calling process
    requests = os.fdopen(os.dup(0), "rb", buffering=0)
    replies = os.fdopen(os.dup(1), "wb")
    # Suppress the messages of libraries about damaged files.
    null_device = os.open(os.devnull, os.O_RDWR)
    for descriptor in range(3):
        os.dup2(null_device, descriptor)
    for name in ("counterspin.records.reading", *set(libraries).difference(_THREADED_LIBRARIES)):
        _load_module(name)
    replies.write(b"!")
    replies.flush()
    _read_in_forks(libraries, requests, replies)
    for name in libraries:
        _load_module(name)
    _serve_requests(requests, replies)


def _read_in_forks(libraries: list[str], requests: Any, replies: BinaryIO) -> None:
    """Serve requests in forked processes, with a new one after a damaged file."""
    if sys.platform == "win32":
        return
    while _can_fork():
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        child_pid = os.fork()
        if child_pid == 0:
            signal.signal(signal.SIGTERM, signal.SIG_DFL)
            _read_and_exit(libraries, requests, replies)
        status = os.waitstatus_to_exitcode(os.waitpid(child_pid, 0)[1])
        if status != _RESTART_STATUS:
            _exit_like(status)
        # Load all libraries: further files of any format may be damaged.
        for name in set(chain(*NATIVE_LIBRARIES.values())).difference(_THREADED_LIBRARIES):
            _load_module(name)


def _load_module(name: str) -> None:
    with suppress(ImportError):  # reported by the function that needs it
        importlib.import_module(name)


def _can_fork() -> bool:
    """Return True if this process can fork: with threads, a child could inherit held locks."""
    try:
        return sys.platform == "linux" and len(os.listdir("/proc/self/task")) == 1  # noqa: PTH208
    except OSError:
        return False


def _read_and_exit(libraries: list[str], requests: Any, replies: BinaryIO) -> NoReturn:
    status = 1
    try:
        for name in libraries:
            _load_module(name)
        status = 0 if _serve_requests(requests, replies) else _RESTART_STATUS
    finally:
        os._exit(status)


def _exit_like(status: int) -> NoReturn:
    """Exit like the forked process: with its status or by its signal."""
    if status < 0:
        omit_core_file()
        with suppress(OSError, ValueError):
            signal.signal(-status, signal.SIG_DFL)
        os.kill(os.getpid(), -status)
    os._exit(status if status >= 0 else 1)


def _serve_requests(requests: Any, replies: BinaryIO) -> bool:
    """Serve requests until there are none; return False after a damaged file."""
    while _is_readable_in_time(requests.fileno()):
        length_prefix = requests.read(8)
        if len(length_prefix) < 8:
            return True
        reply = _handle_request(_read_exactly(requests, int.from_bytes(length_prefix, "little")))
        try:
            payload = pickle.dumps(reply)
        except Exception:  # report an error that cannot be pickled by its text
            payload = pickle.dumps(RuntimeError(repr(reply)))
        replies.write(len(payload).to_bytes(8, "little"))
        replies.write(payload)
        replies.flush()
        if isinstance(reply, DamagedFileError):
            return False
    return True


def _handle_request(message: bytes) -> tuple[Any] | BaseException:
    folder, function, (path, *args) = pickle.loads(message)
    try:
        if folder is not None:
            os.chdir(folder)
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


def _read_exactly(stream: Any, n_bytes: int) -> bytes:
    chunks = []
    while n_bytes:
        chunk = stream.read(n_bytes)
        if not chunk:
            raise EOFError
        chunks.append(chunk)
        n_bytes -= len(chunk)
    return b"".join(chunks)


def _is_readable_in_time(descriptor: int) -> bool:
    if sys.platform == "win32":  # Windows cannot wait for a pipe
        return True
    return bool(select.select([descriptor], [], [], _IDLE_SECONDS)[0])


def _current_folder() -> str | None:
    try:
        return os.getcwd()  # noqa: PTH109 - a name that is passed on
    except OSError:
        return None


def _describe_exit(status: int) -> str:
    """Describe how the reader process ended: exit status, or minus the signal number."""
    try:
        name = signal.Signals(-status).name
    except ValueError:
        name = _WINDOWS_EXIT_CAUSES.get(status, f"exit status {status}")
    if name == "SIGXCPU" or (sys.platform == "win32" and status == WINDOWS_TIME_STATUS):
        return _TIMEOUT_MESSAGE
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

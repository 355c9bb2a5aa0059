"""Trace programs and kill them before a system call, with ptrace and seccomp (Linux).

A server process imports the modules of the program once, and forks for each run, so that a run
needs no start-up time. In a run, only the system calls that open, write, move or remove a file stop
the program.

- `Runner`: run a program, count those calls, kill the program before one of them
- `can_trace`: whether this machine allows processes to be traced
- `serve`: main function of the server process
"""

from __future__ import annotations

import atexit
import ctypes
import importlib
import json
import os
import runpy
import select
import signal
import struct
import subprocess
import sys
import tempfile
import threading
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

from fuzz import ROOT

_TRACEME, _CONT, _SETOPTIONS, _GET_SYSCALL_INFO = 0, 7, 0x4200, 0x420E
#: Trace new threads and processes, stop at filtered calls, and kill all if this process ends.
_TRACE_OPTIONS = 0x2 | 0x4 | 0x8 | 0x80 | 0x100000
_SECCOMP_EVENT, _SECCOMP_STOP = 7, 3
_WALL = 0x40000000

#: Architecture -> type of call -> call number -> indices of the arguments: file descriptor, paths,
#: or path and flags.
_FIRST_ARGUMENT = (0,)
_CALLS: dict[str, dict[str, dict[int, tuple[int, ...]]]] = {
    "x86_64": {
        "file": dict.fromkeys((1, 18, 20, 40, 74, 75, 77, 91), _FIRST_ARGUMENT),
        "paths": {
            **dict.fromkeys((76, 83, 84, 87, 90), (0,)),
            **dict.fromkeys((258, 263, 268), (1,)),
            82: (0, 1),
            **dict.fromkeys((264, 265, 316), (1, 3)),
        },
        "open": {2: (0, 1), 257: (1, 2)},
    },
    "aarch64": {
        "file": dict.fromkeys((46, 52, 64, 66, 68, 71, 82, 83), _FIRST_ARGUMENT),
        "paths": {
            45: (0,),
            **dict.fromkeys((34, 35, 53), (1,)),
            **dict.fromkeys((37, 38, 276), (1, 3)),
        },
        "open": {56: (1, 2)},
    },
}
_WRITE_FLAGS = os.O_WRONLY | os.O_RDWR | os.O_CREAT

#: Maximum duration of a command, s.
_MAX_DURATION = 120


class CannotTraceError(Exception):
    """Tracing of processes is not allowed on this machine."""


@dataclass(frozen=True)
class Run:
    """Outcome of a run.

    Attributes
    ----------
    status
        The exit status; None if it was killed, less than 0 if another signal ended it.
    n_calls
        Number of calls on files of the folder; 0 if the run was not traced.
    """

    status: int | None
    n_calls: int


class Runner:
    """Context manager that runs a module as a program, each time in a folder.

    Parameters
    ----------
    module
        Name of the module, as for ``python -m``.
    """

    def __init__(self, module: str = "counterspin") -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-c", "from fuzz.tracing import serve; serve()", module],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=_make_environment(),
        )

    def __enter__(self) -> Runner:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.communicate()

    def run(self, arguments: Sequence[str], folder: Path) -> Run:
        """Run the program without tracing."""
        return self._send_request(arguments, folder, None)

    def count_calls(self, arguments: Sequence[str], folder: Path) -> Run:
        """Run the program and count its calls."""
        return self._send_request(arguments, folder, 0)

    def kill(self, arguments: Sequence[str], folder: Path, kill_at: int) -> bool:
        """Run a command and kill it before a call, the first being 1; return if it came so far."""
        return self._send_request(arguments, folder, kill_at).status is None

    def _send_request(self, arguments: Sequence[str], folder: Path, kill_at: int | None) -> Run:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        request = json.dumps([list(arguments), str(folder.resolve()), kill_at])
        self._process.stdin.write(request.encode() + b"\n")
        self._process.stdin.flush()
        answer = self._process.stdout.readline()
        if not answer:
            raise CannotTraceError
        return Run(*json.loads(answer))


def can_trace() -> bool:
    """Return whether processes can be traced here."""
    if sys.platform != "linux" or os.uname().machine not in _CALLS:
        return False
    with tempfile.TemporaryDirectory() as folder, Runner("calendar") as runner:
        try:
            return runner.count_calls(["2000"], Path(folder)) == Run(0, 0)
        except CannotTraceError:
            return False


def _make_environment() -> dict[str, str]:
    inherited = {k: v for k, v in os.environ.items() if k in ("PATH", "HOME")}
    paths = os.pathsep.join([str(ROOT), *filter(None, sys.path)])
    fixed = {"PYTHONDONTWRITEBYTECODE": "1", "OPENBLAS_NUM_THREADS": "1", "LC_ALL": "C.UTF-8"}
    fixed |= {"SOURCE_DATE_EPOCH": "1800000000", "MPLCONFIGDIR": tempfile.gettempdir()}
    return inherited | fixed | {"PYTHONPATH": paths}


# Server process


def serve() -> None:
    """Run the requests of standard input; write the outcomes to standard output."""
    module = sys.argv[1]
    request_stream, answer_stream = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    null_device = os.open(os.devnull, os.O_RDWR)
    for descriptor in range(3):
        os.dup2(null_device, descriptor)
    loaded: set[str] = set()
    for line in request_stream:
        arguments, folder, kill_at = json.loads(line)
        run = _TracedRun(module, arguments, folder, kill_at)
        status = run.run()
        answer_stream.write(json.dumps([status, run.n_calls]).encode() + b"\n")
        answer_stream.flush()
        for name in run.loaded_modules:  # later runs need not import it again
            if name not in loaded and name != "__main__":
                loaded.add(name)
                with suppress(Exception):
                    importlib.import_module(name)


def _to_exit_status(wait_status: int) -> int | None:
    exit_code = os.waitstatus_to_exitcode(wait_status)
    return None if exit_code == -signal.SIGKILL else exit_code


class _TracedRun:
    """A run; `kill_at`: number of the call to kill at, 0 for none, None to run without tracing."""

    def __init__(
        self, module: str, arguments: Sequence[str], folder: str, kill_at: int | None
    ) -> None:
        self._module, self._arguments, self._folder, self._kill_at = (
            module,
            arguments,
            folder,
            kill_at,
        )
        self._libc = ctypes.CDLL(None, use_errno=True)
        self._libc.ptrace.restype = ctypes.c_long
        self._libc.ptrace.argtypes = [ctypes.c_long, ctypes.c_long, *[ctypes.c_void_p] * 2]
        calls = _CALLS[os.uname().machine]
        self._descriptor_calls, self._path_calls, self._open_calls = (
            calls["file"],
            calls["paths"],
            calls["open"],
        )
        self.n_calls = 0
        self.loaded_modules: list[str] = []

    def run(self) -> int | None:
        """Run the program; return its status as in `Run`."""
        read_end, write_end = os.pipe()
        child = os.fork()
        if child == 0:
            os.close(read_end)
            self._run_module(write_end)
        os.close(write_end)
        with os.fdopen(read_end, "rb", buffering=0) as stream:
            if self._kill_at is None:
                self._read_loaded_modules(stream.read())
                return _to_exit_status(os.waitpid(child, 0)[1])
            status = self._trace(child)
            if select.select([stream], [], [], 0.0)[0]:
                self._read_loaded_modules(os.read(read_end, 1 << 20))
            return status

    def _read_loaded_modules(self, names: bytes) -> None:
        self.loaded_modules = names.decode().split()

    def _trace(self, child: int) -> int | None:
        if not os.WIFSTOPPED(os.waitpid(child, 0)[1]):
            raise CannotTraceError
        self._libc.ptrace(_SETOPTIONS, child, None, _TRACE_OPTIONS)
        self._continue(child, 0)
        threads = {child}
        try:
            while True:
                thread, status = os.waitpid(-1, _WALL)
                if os.WIFEXITED(status) or os.WIFSIGNALED(status):
                    threads.discard(thread)
                    if thread == child:
                        return _to_exit_status(status)
                    continue
                threads.add(thread)
                if status >> 16 == _SECCOMP_EVENT:
                    is_output_call = self._is_output_call(thread)
                    self.n_calls += is_output_call
                    if is_output_call and self.n_calls == self._kill_at:
                        os.kill(child, signal.SIGKILL)
                    else:
                        self._continue(thread, 0)
                else:  # pass signals on, except the stops of new threads
                    stop_signal = os.WSTOPSIG(status)
                    is_start = status >> 16 or stop_signal in (signal.SIGSTOP, signal.SIGTRAP)
                    self._continue(thread, 0 if is_start else stop_signal)
        finally:
            for thread_left in threads:
                with suppress(ProcessLookupError):
                    os.kill(thread_left, signal.SIGKILL)

    def _run_module(self, write_end: int) -> NoReturn:
        status: object = 99
        try:
            os.chdir(self._folder)
            signal.alarm(_MAX_DURATION)
            if self._kill_at is not None:
                self._install_filter()
            sys.argv[1:] = self._arguments
            previous_modules = set(sys.modules)
            try:
                runpy.run_module(self._module, run_name="__main__", alter_sys=True)
                status = 0
            except SystemExit as system_exit:
                status = system_exit.code
            threading._shutdown()  # type: ignore[attr-defined]
            atexit._run_exitfuncs()
            with suppress(OSError):
                os.write(
                    write_end,
                    " ".join(sorted(set(sys.modules) - previous_modules)).encode()[:60_000],
                )
        finally:
            os._exit(status if isinstance(status, int) else int(status is not None))

    def _install_filter(self) -> None:
        """Stop this process now, and at every later output call."""
        numbers = sorted({*self._descriptor_calls, *self._path_calls, *self._open_calls})
        load, equal, return_ = 0x20, 0x15, 0x06
        program = struct.pack("<HBBI", load, 0, 0, 0)
        for index, number in enumerate(numbers):
            program += struct.pack("<HBBI", equal, len(numbers) - index, 0, number)
        program += struct.pack("<HBBI", return_, 0, 0, 0x7FFF0000)
        program += struct.pack("<HBBI", return_, 0, 0, 0x7FF00000)
        instructions = ctypes.create_string_buffer(program)
        header = struct.pack("<HxxxxxxQ", len(program) // 8, ctypes.addressof(instructions))
        self._libc.ptrace(_TRACEME, 0, None, None)
        os.kill(os.getpid(), signal.SIGSTOP)
        if self._libc.prctl(38, 1, 0, 0, 0) or self._libc.prctl(22, 2, header, 0, 0):
            raise CannotTraceError

    def _continue(self, thread: int, signal_number: int) -> None:
        self._libc.ptrace(_CONT, thread, None, signal_number)

    def _is_output_call(self, thread: int) -> bool:
        """Return whether a thread enters a call that changes a file of the folder."""
        info = ctypes.create_string_buffer(88)
        self._libc.ptrace(_GET_SYSCALL_INFO, thread, ctypes.c_void_p(88), info)
        if info.raw[0] != _SECCOMP_STOP:
            return False
        number, *arguments = struct.unpack_from("<7Q", info.raw, 24)
        if number in self._descriptor_calls:
            try:
                target = Path(f"/proc/{thread}/fd/{arguments[0]}").readlink()
            except OSError:
                return False
            return str(target).startswith(self._folder)
        if number in self._open_calls:
            path, flags = self._open_calls[number]
            return bool(arguments[flags] & _WRITE_FLAGS) and self._is_in_folder(
                thread, arguments[path]
            )
        return any(
            self._is_in_folder(thread, arguments[index]) for index in self._path_calls[number]
        )

    def _is_in_folder(self, thread: int, address: int) -> bool:
        """Return whether the path at an address is in the folder."""
        try:
            with Path(f"/proc/{thread}/mem").open("rb", buffering=0) as memory:
                memory.seek(address)
                path = memory.read(4096).partition(b"\0")[0]
        except (OSError, ValueError, OverflowError):
            return False
        # Relative paths start in the folder.
        return path.startswith(os.fsencode(self._folder)) or not path.startswith(b"/")

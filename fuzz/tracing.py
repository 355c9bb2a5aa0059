"""Programs that are killed before a system call: traced (ptrace, seccomp; Linux), and forked.

A process loads what the program needs once, and forks for each run; so a run takes as long as its
work. In a run each system call that opens, writes, moves or removes something stops the program,
and no other one does.

- `Runner`: runs a program's commands, counts those calls, kills before one of them
- `possible`: whether this machine lets processes be traced
- `serve`: what a runner's process does
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
#: Threads and processes that are started are traced too, calls that the filter names stop, and all
#: end with this process.
_OPTIONS = 0x2 | 0x4 | 0x8 | 0x80 | 0x100000
_STOPPED_BY_FILTER, _FILTERED = 7, 3
_WALL = 0x40000000

#: What a call is given: the number of an open file first; or paths, by their places; or a path and
#: flags, of which some write.
_FILE = (0,)
_CALLS: dict[str, dict[str, dict[int, tuple[int, ...]]]] = {
    "x86_64": {
        "file": dict.fromkeys((1, 18, 20, 40, 74, 75, 77, 91), _FILE),
        "paths": {
            **dict.fromkeys((76, 83, 84, 87, 90), (0,)),
            **dict.fromkeys((258, 263, 268), (1,)),
            82: (0, 1),
            **dict.fromkeys((264, 265, 316), (1, 3)),
        },
        "open": {2: (0, 1), 257: (1, 2)},
    },
    "aarch64": {
        "file": dict.fromkeys((46, 52, 64, 66, 68, 71, 82, 83), _FILE),
        "paths": {
            45: (0,),
            **dict.fromkeys((34, 35, 53), (1,)),
            **dict.fromkeys((37, 38, 276), (1, 3)),
        },
        "open": {56: (1, 2)},
    },
}
_WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT

#: Longer than this no command takes; s.
_HANGS = 120


class CannotTraceError(Exception):
    """The machine does not let a process be traced."""


@dataclass(frozen=True)
class Run:
    """How a run ended.

    Attributes
    ----------
    status
        The exit status; None if it was killed, less than 0 if another signal ended it.
    calls
        How many calls there were that had to do with files of the folder, if it was traced.
    """

    status: int | None
    calls: int


class Runner:
    """Runs the commands of a program, a module, each in a folder. A context manager.

    Parameters
    ----------
    module
        What ``python -m`` is given.
    """

    def __init__(self, module: str = "counterspin") -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-c", "from fuzz.tracing import serve; serve()", module],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=_environment(),
        )

    def __enter__(self) -> Runner:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.communicate()

    def run(self, words: Sequence[str], folder: Path) -> Run:
        """Run a command as it is."""
        return self._ask(words, folder, None)

    def count(self, words: Sequence[str], folder: Path) -> Run:
        """Run a command and count its calls."""
        return self._ask(words, folder, 0)

    def kill(self, words: Sequence[str], folder: Path, call: int) -> bool:
        """Run a command and kill it before a call, the first being 1; return if it came so far."""
        return self._ask(words, folder, call).status is None

    def _ask(self, words: Sequence[str], folder: Path, call: int | None) -> Run:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        request = json.dumps([list(words), str(folder.resolve()), call])
        self._process.stdin.write(request.encode() + b"\n")
        self._process.stdin.flush()
        answer = self._process.stdout.readline()
        if not answer:
            raise CannotTraceError
        return Run(*json.loads(answer))


def possible() -> bool:
    """Return whether processes can be traced here."""
    if sys.platform != "linux" or os.uname().machine not in _CALLS:
        return False
    with tempfile.TemporaryDirectory() as place, Runner("calendar") as runner:
        try:
            return runner.count(["2000"], Path(place)) == Run(0, 0)
        except CannotTraceError:
            return False


def _environment() -> dict[str, str]:
    kept = {k: v for k, v in os.environ.items() if k in ("PATH", "HOME")}
    paths = os.pathsep.join([str(ROOT), *filter(None, sys.path)])
    fixed = {"PYTHONDONTWRITEBYTECODE": "1", "OPENBLAS_NUM_THREADS": "1", "LC_ALL": "C.UTF-8"}
    fixed |= {"SOURCE_DATE_EPOCH": "1800000000", "MPLCONFIGDIR": tempfile.gettempdir()}
    return kept | fixed | {"PYTHONPATH": paths}


# The runner's process


def serve() -> None:
    """Run what standard input asks for, and say on standard output how it went."""
    module = sys.argv[1]
    requests, answers = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    nowhere = os.open(os.devnull, os.O_RDWR)
    for number in range(3):
        os.dup2(nowhere, number)
    loaded: set[str] = set()
    for line in requests:
        words, folder, call = json.loads(line)
        one = _Traced(module, words, folder, call)
        status = one.run()
        answers.write(json.dumps([status, one.calls]).encode() + b"\n")
        answers.flush()
        for name in one.needed:  # so that it need not be loaded again
            if name not in loaded and name != "__main__":
                loaded.add(name)
                with suppress(Exception):
                    importlib.import_module(name)


def _status(status: int) -> int | None:
    ended = os.waitstatus_to_exitcode(status)
    return None if ended == -signal.SIGKILL else ended


class _Traced:
    """One run; `call`: None if it is not traced, 0 if no call is to be its last."""

    def __init__(self, module: str, words: Sequence[str], folder: str, call: int | None) -> None:
        self._module, self._words, self._folder, self._kill_at = module, words, folder, call
        self._libc = ctypes.CDLL(None, use_errno=True)
        self._libc.ptrace.restype = ctypes.c_long
        self._libc.ptrace.argtypes = [ctypes.c_long, ctypes.c_long, *[ctypes.c_void_p] * 2]
        kinds = _CALLS[os.uname().machine]
        self._file, self._paths, self._open = kinds["file"], kinds["paths"], kinds["open"]
        self.calls = 0
        self.needed: list[str] = []

    def run(self) -> int | None:
        """Return how it ended, as `Run.status` has it."""
        told, tell = os.pipe()
        child = os.fork()
        if child == 0:
            os.close(told)
            self._become(tell)
        os.close(tell)
        with os.fdopen(told, "rb", buffering=0) as stream:
            if self._kill_at is None:
                self._hear(stream.read())
                return _status(os.waitpid(child, 0)[1])
            ended = self._followed(child)
            if select.select([stream], [], [], 0.0)[0]:
                self._hear(os.read(told, 1 << 20))
            return ended

    def _hear(self, names: bytes) -> None:
        self.needed = names.decode().split()

    def _followed(self, child: int) -> int | None:
        if not os.WIFSTOPPED(os.waitpid(child, 0)[1]):
            raise CannotTraceError
        self._libc.ptrace(_SETOPTIONS, child, None, _OPTIONS)
        self._go_on(child, 0)
        known = {child}
        try:
            while True:
                thread, status = os.waitpid(-1, _WALL)
                if os.WIFEXITED(status) or os.WIFSIGNALED(status):
                    known.discard(thread)
                    if thread == child:
                        return _status(status)
                    continue
                known.add(thread)
                if status >> 16 == _STOPPED_BY_FILTER:
                    matters = self._matters(thread)
                    self.calls += matters
                    if matters and self.calls == self._kill_at:
                        os.kill(child, signal.SIGKILL)
                    else:
                        self._go_on(thread, 0)
                else:  # a signal is handed on; the stops of what was just started are none
                    stop = os.WSTOPSIG(status)
                    started = status >> 16 or stop in (signal.SIGSTOP, signal.SIGTRAP)
                    self._go_on(thread, 0 if started else stop)
        finally:
            for left in known:
                with suppress(ProcessLookupError):
                    os.kill(left, signal.SIGKILL)

    def _become(self, tell: int) -> NoReturn:
        status: object = 99
        try:
            os.chdir(self._folder)
            signal.alarm(_HANGS)
            if self._kill_at is not None:
                self._filter()
            sys.argv[1:] = self._words
            before = set(sys.modules)
            try:
                runpy.run_module(self._module, run_name="__main__", alter_sys=True)
                status = 0
            except SystemExit as end:
                status = end.code
            threading._shutdown()  # type: ignore[attr-defined]
            atexit._run_exitfuncs()
            with suppress(OSError):
                os.write(tell, " ".join(sorted(set(sys.modules) - before)).encode()[:60_000])
        finally:
            os._exit(status if isinstance(status, int) else int(status is not None))

    def _filter(self) -> None:
        """Have this process stopped at the calls that matter, and at the first of all now."""
        numbers = sorted({*self._file, *self._paths, *self._open})
        load, equal, back = 0x20, 0x15, 0x06
        program = struct.pack("<HBBI", load, 0, 0, 0)
        for place, number in enumerate(numbers):
            program += struct.pack("<HBBI", equal, len(numbers) - place, 0, number)
        program += struct.pack("<HBBI", back, 0, 0, 0x7FFF0000)
        program += struct.pack("<HBBI", back, 0, 0, 0x7FF00000)
        kept = ctypes.create_string_buffer(program)
        header = struct.pack("<HxxxxxxQ", len(program) // 8, ctypes.addressof(kept))
        self._libc.ptrace(_TRACEME, 0, None, None)
        os.kill(os.getpid(), signal.SIGSTOP)
        if self._libc.prctl(38, 1, 0, 0, 0) or self._libc.prctl(22, 2, header, 0, 0):
            raise CannotTraceError

    def _go_on(self, thread: int, stop: int) -> None:
        self._libc.ptrace(_CONT, thread, None, stop)

    def _matters(self, thread: int) -> bool:
        """Return whether a thread enters a call that changes a file of the folder."""
        info = ctypes.create_string_buffer(88)
        self._libc.ptrace(_GET_SYSCALL_INFO, thread, ctypes.c_void_p(88), info)
        if info.raw[0] != _FILTERED:
            return False
        number, *arguments = struct.unpack_from("<7Q", info.raw, 24)
        if number in self._file:
            try:
                target = Path(f"/proc/{thread}/fd/{arguments[0]}").readlink()
            except OSError:
                return False
            return str(target).startswith(self._folder)
        if number in self._open:
            path, flags = self._open[number]
            return bool(arguments[flags] & _WRITES) and self._here(thread, arguments[path])
        return any(self._here(thread, arguments[place]) for place in self._paths[number])

    def _here(self, thread: int, address: int) -> bool:
        """Return whether a path that a call is given leads into the folder."""
        try:
            with Path(f"/proc/{thread}/mem").open("rb", buffering=0) as memory:
                memory.seek(address)
                path = memory.read(4096).partition(b"\0")[0]
        except (OSError, ValueError, OverflowError):
            return False
        # Relative ones start there.
        return path.startswith(os.fsencode(self._folder)) or not path.startswith(b"/")

"""Processes killed at the system calls that have to do with an output: nothing may be lost.

A command is traced (ptrace, Linux), and killed with SIGKILL before its n-th such call. Then every
input must be unchanged, every output as it is without a kill, or absent, and every other file that
lies there hidden, as what is not finished is. What was begun must go on, where the command can.

- `Command`: what is run, where, and how it goes on afterwards
- `commands`: all that write
- `count_calls`, `killed_at`: one run of one command
- `kill_all`: many kills, spread over all commands and all calls
"""

from __future__ import annotations

import ctypes
import math
import os
import shutil
import signal
import struct
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import results
from campaigns import SMALL, changed

from certificates import write_lab
from fuzz.formats import STUDY, resource_text

_PTRACE_TRACEME, _PTRACE_SETOPTIONS, _PTRACE_SYSCALL = 0, 0x4200, 24
_PTRACE_GET_SYSCALL_INFO = 0x420E
#: Stops of system calls are told from signals; threads and processes that are started are traced,
#: and end with this one.
_OPTIONS = 0x1 | 0x2 | 0x4 | 0x8 | 0x100000
_WALL = 0x40000000
_ENTRY = 1

#: Machine -> numbers of the calls that write, move or remove, and of those that open.
_CALLS = {
    "x86_64": (
        {1, 18, 20, 40, 74, 75, 76, 77, 82, 83, 84, 87, 90, 91, 258, 263, 264, 265, 268, 316, 326},
        {2, 85, 257, 437},
    ),
    "aarch64": ({34, 35, 37, 38, 45, 46, 52, 53, 64, 66, 68, 71, 82, 83, 276, 285}, {56, 437}),
}
#: Those among them that write to a file that is open, whose number is their first argument.
_WRITING = {"x86_64": {1, 18, 20, 40, 74, 75, 77, 91}, "aarch64": {46, 52, 64, 66, 68, 71, 82, 83}}


@dataclass(frozen=True)
class Command:
    """What is run and what it writes.

    Attributes
    ----------
    words
        Of the command line.
    again
        Words that make it go on, or do it again, where a kill has left something; None: the same.
    """

    words: tuple[str, ...]
    again: tuple[str, ...] | None = None


def commands(folder: Path) -> dict[str, Command]:
    """Write the inputs of all commands into a folder, and return what is run there."""
    short = changed(SMALL, ("revolutions = 20", "revolutions = 8"))
    (folder / "plan").mkdir()
    (folder / "plan" / "campaign.toml").write_text(short, encoding="utf-8")
    from counterspin.campaign.simulation import simulate

    simulate(folder / "plan", folder / "records")
    study = resource_text("reproduction", "paper.toml") + STUDY
    (folder / "study.toml").write_text(study, encoding="utf-8")
    results.result().write(folder / "result.json")
    write_lab(folder)
    rows = "\n".join(f"{0.01 * i},{math.sin(0.1 * i)!r}" for i in range(50))
    (folder / "forces.csv").write_text(f"t,Qx\n{rows}\n", encoding="utf-8")
    apply = ("apply", "result.json", "forces.csv", "--accelerometer", "Qx", "-o", "corrected.csv")
    trials = ("study", "study.toml", "--trials", "24000", "-o", "out", "--keep-trials")
    return {
        "calibrate": Command(("calibrate", "records", "--json", "new.json")),
        "report": Command(("report", "result.json", "-o", "new.html")),
        "report-pdf": Command(("report", "result.json", "-o", "new.pdf")),
        "simulate": Command(
            ("simulate", "plan", "-o", "made"), ("simulate", "plan", "-o", "made", "--overwrite")
        ),
        "apply": Command(apply),
        "certificate": Command(("certificate", "result.json", "LAB.toml", "-o", "new.xml")),
        "study": Command(trials, (*trials, "--resume")),
        "plan": Command(("plan", "--init", "new.toml")),
    }


def possible() -> bool:
    """Return whether processes can be traced here."""
    if sys.platform != "linux" or os.uname().machine not in _CALLS:
        return False
    return _Tracer([sys.executable, "-c", ""], Path.cwd(), 0).run() == 0


class _Tracer:
    """Runs a program and kills it before a call; `calls` counts them."""

    def __init__(self, words: Sequence[str], folder: Path, kill_at: int) -> None:
        self._words, self._folder, self._kill_at = words, str(folder.resolve()), kill_at
        self._libc = ctypes.CDLL(None, use_errno=True)
        self._libc.ptrace.restype = ctypes.c_long
        self._libc.ptrace.argtypes = [
            ctypes.c_long,
            ctypes.c_long,
            ctypes.c_void_p,
            ctypes.c_void_p,
        ]
        machine = os.uname().machine
        self._moving, self._opening = _CALLS[machine]
        self._writing = _WRITING[machine]
        self.calls = 0

    def run(self) -> int | None:
        """Return the exit status, None if it was killed by a signal."""
        child = os.fork()
        if child == 0:
            self._become()
        os.waitpid(child, 0)
        self._libc.ptrace(_PTRACE_SETOPTIONS, child, None, _OPTIONS)
        self._go_on(child, 0)
        while True:
            thread, status = os.waitpid(-1, _WALL)
            if os.WIFEXITED(status) or os.WIFSIGNALED(status):
                if thread == child:
                    return os.WEXITSTATUS(status) if os.WIFEXITED(status) else None
                continue
            stop = os.WSTOPSIG(status)
            if stop == signal.SIGTRAP | 0x80:
                if self._matters(thread):
                    self.calls += 1
                    if self.calls == self._kill_at:
                        os.kill(child, signal.SIGKILL)
                        continue
                self._go_on(thread, 0)
            else:  # a signal is handed on; the stops of what was just started are none
                started = status >> 16 or stop in (signal.SIGSTOP, signal.SIGTRAP)
                self._go_on(thread, 0 if started else stop)

    def _become(self) -> None:
        try:
            os.chdir(self._folder)
            nowhere = os.open(os.devnull, os.O_RDWR)
            for number in range(3):
                os.dup2(nowhere, number)
            self._libc.ptrace(_PTRACE_TRACEME, 0, None, None)
            os.kill(os.getpid(), signal.SIGSTOP)
            os.execve(self._words[0], list(self._words), _environment())
        finally:
            os._exit(99)

    def _go_on(self, thread: int, stop: int) -> None:
        self._libc.ptrace(_PTRACE_SYSCALL, thread, None, stop)

    def _matters(self, thread: int) -> bool:
        """Return whether a thread enters a call that changes a file of the folder."""
        info = ctypes.create_string_buffer(88)
        self._libc.ptrace(_PTRACE_GET_SYSCALL_INFO, thread, ctypes.c_void_p(88), info)
        if info.raw[0] != _ENTRY:
            return False
        number, *arguments = struct.unpack_from("<7Q", info.raw, 24)
        if number in self._writing:
            try:
                target = Path(f"/proc/{thread}/fd/{arguments[0]}").readlink()
                return str(target).startswith(self._folder)
            except OSError:
                return False
        if number in self._opening:
            flags = arguments[1 if number == 2 else 2]
            return bool(flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)) and self._here(
                thread, arguments[0 if number in (2, 85) else 1]
            )
        return number in self._moving and any(
            self._here(thread, address) for address in arguments[:2]
        )

    def _here(self, thread: int, address: int) -> bool:
        """Return whether a path that a call is given leads into the folder."""
        try:
            with Path(f"/proc/{thread}/mem").open("rb", buffering=0) as memory:
                memory.seek(address)
                path = memory.read(4096).partition(b"\0")[0]
        except (OSError, ValueError, OverflowError):
            return False
        # What is no path is not one of the folder; relative ones start there.
        text = os.fsdecode(path)
        return text.startswith(self._folder) or (text[:1].isalnum() and "/" not in text)


def _environment() -> dict[str, str]:
    kept = {k: v for k, v in os.environ.items() if k in ("PATH", "PYTHONPATH", "HOME")}
    fixed = {"PYTHONDONTWRITEBYTECODE": "1", "OPENBLAS_NUM_THREADS": "1", "LC_ALL": "C.UTF-8"}
    return kept | fixed | {"SOURCE_DATE_EPOCH": "1800000000", "MPLCONFIGDIR": tempfile.gettempdir()}


def count_calls(words: Sequence[str], folder: Path) -> int:
    """Run a command in a folder and return how many calls have to do with its outputs."""
    tracer = _Tracer(_program(words), folder, 0)
    status = tracer.run()
    if status != 0:
        raise AssertionError(f"{' '.join(words)} ended with status {status}")
    return tracer.calls


def killed_at(words: Sequence[str], folder: Path, call: int) -> bool:
    """Run a command in a folder and kill it before a call; return whether it came so far."""
    return _Tracer(_program(words), folder, call).run() is None


def _program(words: Sequence[str]) -> list[str]:
    return [sys.executable, "-m", "counterspin", *words]


def _files(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


#: Files in a study's folder that a resumption needs, and which are gone when it is done.
_PROGRESS = ("out/progress",)


class Trial:
    """One command with its inputs, as it ends without a kill."""

    def __init__(self, name: str, inputs: Path, command: Command, place: Path) -> None:
        self.name, self._inputs, self._command, self._place = name, inputs, command, place
        self._before = _files(inputs)
        folder = self._fresh()
        self.calls = count_calls(command.words, folder)
        self._after = _files(folder)

    def _fresh(self) -> Path:
        folder = self._place / self.name
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(self._inputs, folder)
        return folder

    def faults(self, call: int) -> list[str]:
        """Return what a kill before a call has lost or spoilt."""
        folder = self._fresh()
        if not killed_at(self._command.words, folder, call):
            return [f"{self.name}: ended before call {call}"]
        where = f"{self.name}, killed before call {call} of {self.calls}"
        faults = [f"{where}: {fault}" for fault in self._wrong(_files(folder))]
        again = self._command.again or self._command.words
        unfinished = _files(folder).keys() - self._before.keys()
        if any(not _hidden(name) for name in unfinished) and self._command.again is None:
            return faults  # the output is there, and whole
        if again[0] == "study" and "out/progress.npz" not in unfinished:
            again = (*self._command.words, "--overwrite")  # nothing was done yet
        if count_or_none(again, folder) is None:
            return [*faults, f"{where}: does not go on"]
        ended = {name: content for name, content in _files(folder).items() if not _hidden(name)}
        if ended != self._after:
            differing = [
                n for n in ended.keys() | self._after.keys() if ended.get(n) != self._after.get(n)
            ]
            faults.append(f"{where}: gone on, another end: {', '.join(sorted(differing))}")
        return faults

    def _wrong(self, there: dict[str, bytes]) -> list[str]:
        faults = [
            f"{name} is lost or changed"
            for name, content in self._before.items()
            if there.get(name) != content
        ]
        return faults + [
            f"{name} is not whole"
            for name in there.keys() - self._before.keys()
            if not (_hidden(name) or name.startswith(_PROGRESS))
            and there[name] != self._after.get(name)
        ]


def count_or_none(words: Sequence[str], folder: Path) -> int | None:
    """Return as `count_calls`, or None if the command fails."""
    try:
        return count_calls(words, folder)
    except AssertionError:
        return None


def _hidden(name: str) -> bool:
    return Path(name).name.startswith(".")


def kill_all(kills: int, names: Sequence[str] = ()) -> tuple[dict[str, tuple[int, int]], list[str]]:
    """Kill commands at calls spread over all of them.

    Returns
    -------
    dict
        Command -> how many calls it makes, and how many kills there were.
    list
        What was lost or spoilt.
    """
    with tempfile.TemporaryDirectory() as place:
        inputs = Path(place) / "inputs"
        inputs.mkdir()
        known = commands(inputs)
        trials = [Trial(name, inputs, known[name], Path(place)) for name in names or known]
        done, faults = {}, []
        left = kills
        for index, trial in enumerate(sorted(trials, key=lambda trial: trial.calls)):
            # Those with few calls are killed at each of them.
            share = min(trial.calls, -(-left // (len(trials) - index)))
            calls = np.unique(np.linspace(1, trial.calls, share).round().astype(int))
            for call in calls:
                faults += trial.faults(int(call))
            done[trial.name] = (trial.calls, len(calls))
            left -= len(calls)
        return done, faults

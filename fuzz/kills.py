"""Processes killed at the system calls that have to do with an output: nothing may be lost.

A command is killed with SIGKILL before its n-th such call. Then every input must be unchanged,
every output as it is without a kill, or absent, and every other file that lies there hidden, as
what is not finished is. What was begun must go on, where the command can. A certificate that stands
is in its ledger.

- `Command`: what is run, with which files, and how it goes on afterwards
- `COMMANDS`: all that write; `write_inputs`: what they need
- `Trial`: the kills of one command
- `kill_all`: many kills, spread over all commands and all calls
"""

from __future__ import annotations

import math
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import results
from campaigns import SMALL, replace_parts

from certificates import write_lab
from counterspin.certificates.ledger import sha256_hex, verify_ledger
from fuzz.formats import STUDY, resource_text
from fuzz.tracing import Runner


@dataclass(frozen=True)
class Command:
    """What is run and what it writes.

    Attributes
    ----------
    words
        Of the command line.
    needs
        The files and folders that it reads.
    again
        Words that make it go on, or do it again, where a kill has left something; None: the same.
    """

    words: tuple[str, ...]
    needs: tuple[str, ...] = ()
    again: tuple[str, ...] | None = None


#: Trials of the study: of several parts.
_TRIALS = "24000"

_RESULT = "result.json"
_APPLY = ("apply", _RESULT, "forces.csv", "--accelerometer", "Qx", "-o", "corrected.csv")
_MADE = ("simulate", "campaign", "-o", "made")
_STUDY = ("study", "study.toml", "--trials", _TRIALS, "-o", "out", "--keep-trials")
_PLAN_JSON = ("plan", "plan.toml", "--json", "new.json")
_LEDGER = "ledger.jsonl"
_ISSUE = ("certificate", _RESULT, "LAB.toml", "-o")

#: All commands that write.
COMMANDS = {
    "calibrate": Command(("calibrate", "records", "--json", "new.json"), ("records",)),
    "report": Command(("report", _RESULT, "-o", "new.html"), (_RESULT,)),
    "report-md": Command(("report", _RESULT, "-o", "new.md"), (_RESULT,)),
    "report-pdf": Command(("report", _RESULT, "-o", "new.pdf"), (_RESULT,)),
    "simulate": Command(_MADE, ("campaign",), (*_MADE, "--overwrite")),
    "apply": Command(_APPLY, (_RESULT, "forces.csv")),
    "certificate": Command((*_ISSUE, "new.xml"), (_RESULT, "LAB.toml")),
    "certificate-pdf": Command((*_ISSUE, "new.pdf"), (_RESULT, "LAB.toml")),
    "certificate-entered": Command(
        (*_ISSUE, "new.xml", "--ledger", _LEDGER), (_RESULT, "LAB.toml")
    ),
    "history": Command(("history", _RESULT, "--json", "new.json"), (_RESULT,)),
    "study": Command(_STUDY, ("study.toml",), (*_STUDY, "--resume")),
    "plan": Command(("plan", "plan.toml", "-o", "planned"), ("plan.toml",)),
    "plan-json": Command(_PLAN_JSON, ("plan.toml",), (*_PLAN_JSON, "--overwrite")),
    "plan-begin": Command(("plan", "--init", "new.toml")),
    "init": Command(("init", "new")),
    "reproduce": Command(("reproduce", "--json", "new.json")),
}


def write_inputs(folder: Path, names: Iterable[str]) -> None:
    """Write what commands need into a folder."""
    for name in sorted({need for command in names for need in COMMANDS[command].needs}):
        _INPUTS[name](folder / name)


def _write_campaign(path: Path) -> None:
    path.mkdir()
    short = replace_parts(SMALL, ("revolutions = 20", "revolutions = 8"))
    (path / "campaign.toml").write_text(short, encoding="utf-8")


def _write_records(path: Path) -> None:
    from counterspin.simulation.simulate import simulate

    with tempfile.TemporaryDirectory() as place:
        source = Path(place) / "campaign"
        _write_campaign(source)
        simulate(source, path)


def _write_result(path: Path) -> None:
    details = {"date": "2026-03-01", "serial_number": "C-7"}
    results.make_qx_result().model_copy(update={"details": details}).write(path)


def _write_forces(path: Path) -> None:
    rows = "\n".join(f"{0.01 * i},{math.sin(0.1 * i)!r}" for i in range(50))
    path.write_text(f"t,Qx\n{rows}\n", encoding="utf-8")


def _write_plan(path: Path) -> None:
    short = replace_parts(resource_text("planning"), ("runs = 14", "runs = 2"))
    path.write_text(short, encoding="utf-8")


def _write_study(path: Path) -> None:
    path.write_text(resource_text("reproduction", "paper.toml") + STUDY, encoding="utf-8")


_INPUTS: dict[str, Callable[[Path], object]] = {
    "campaign": _write_campaign,
    "records": _write_records,
    _RESULT: _write_result,
    "forces.csv": _write_forces,
    "LAB.toml": lambda path: write_lab(path.parent),
    "plan.toml": _write_plan,
    "study.toml": _write_study,
}


def _files(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


#: Files in a study's folder that a resumption needs, and which are gone when it is done.
_PROGRESS = ("out/progress",)


class Trial:
    """One command with its inputs, as it ends without a kill; AssertionError if it fails.

    Attributes
    ----------
    calls
        How many calls it makes that have to do with its outputs.
    """

    def __init__(
        self, runner: Runner, name: str, command: Command, inputs: Path, place: Path
    ) -> None:
        self.name, self._runner, self._command = name, runner, command
        self._inputs, self._folder = inputs, place / name
        self._before = _files(self._fresh())
        ended = runner.count(command.words, self._folder)
        if ended.status != 0:
            raise AssertionError(f"{name} ended with status {ended.status}")
        self.calls = ended.calls
        self._after = _files(self._folder)

    def _fresh(self) -> Path:
        shutil.rmtree(self._folder, ignore_errors=True)
        self._folder.mkdir()
        for name in self._command.needs:
            source, target = self._inputs / name, self._folder / name
            (shutil.copytree if source.is_dir() else shutil.copyfile)(source, target)
        return self._folder

    def faults(self, call: int) -> list[str]:
        """Return what a kill before a call has lost or spoilt."""
        folder = self._fresh()
        if not self._runner.kill(self._command.words, folder, call):
            return [f"{self.name}: ended before call {call}"]
        where = f"{self.name}, killed before call {call} of {self.calls}"
        there = _files(folder)
        faults = [f"{where}: {fault}" for fault in self._wrong(there)]
        again = self._command.again or self._command.words
        unfinished = there.keys() - self._before.keys() - {_LEDGER}
        if any(not _hidden_files(name) for name in unfinished) and self._command.again is None:
            return faults  # the output is there, and whole
        if self.name == "study" and "out/progress.npz" not in unfinished:
            again = self._command.words  # nothing was done yet, or all
            again += ("--overwrite",) if "out/study.json" in unfinished else ()
        if (status := self._runner.run(again, folder).status) != 0:
            return [*faults, f"{where}: does not go on (status {status})"]
        ended = {
            name: content for name, content in _files(folder).items() if not _hidden_files(name)
        }
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
        if "new.xml" in there and self._command.words[-1] == _LEDGER:
            entered = verify_ledger(self._folder / _LEDGER).entries
            if sha256_hex(there["new.xml"]) not in {e.of.get("file_sha256") for e in entered}:
                faults.append("new.xml stands outside its ledger")
        return faults + [
            f"{name} is not whole"
            for name in there.keys() - self._before.keys()
            if not (_hidden_files(name) or name.startswith((*_PROGRESS, _LEDGER)))
            and there[name] != self._after.get(name)
        ]


def _hidden_files(name: str) -> bool:
    return Path(name).name.startswith(".")


def kill_all(
    kills: int, names: Sequence[str] = (), say: Callable[[str], object] = str
) -> tuple[int, list[str]]:
    """Kill commands at calls spread over all of them.

    Parameters
    ----------
    kills
        How many; one more or less for a command, by rounding.
    names
        Of the commands; all if none is named.
    say
        Is told how far it has come, and each fault.

    Returns
    -------
    int, list
        How many kills there were, and what was lost or spoilt.
    """
    faults: list[str] = []
    done = 0
    with tempfile.TemporaryDirectory(dir=_memory()) as place, Runner() as runner:
        inputs = Path(place) / "inputs"
        inputs.mkdir()
        write_inputs(inputs, names or COMMANDS)
        trials = []
        for name in names or COMMANDS:
            trials.append(Trial(runner, name, COMMANDS[name], inputs, Path(place)))
            say(f"{name}: {trials[-1].calls} calls")
        for index, trial in enumerate(sorted(trials, key=lambda trial: trial.calls)):
            # Those with few calls are killed at each of them.
            share = min(trial.calls, -(-(kills - done) // (len(trials) - index)))
            calls = np.unique(np.linspace(1, trial.calls, share).round().astype(int))
            began = time.monotonic()
            for call in calls:
                found = trial.faults(int(call))
                faults += found
                for fault in found:
                    say(fault)
            done += len(calls)
            each = (time.monotonic() - began) / max(len(calls), 1)
            say(f"{trial.name:<18}{len(calls):>5} of {trial.calls} calls, {each:.2f} s each")
    return done, faults


def _memory() -> Path | None:
    place = Path("/dev/shm")
    return place if os.access(place, os.W_OK) else None

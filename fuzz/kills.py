"""Kill commands at each system call on an output, and check that no data is lost.

A command is killed with SIGKILL before its n-th such call. Afterwards, every input must be
unchanged, every output complete or absent, and every unfinished file hidden. A command that can
resume must then finish. A written certificate must be in its ledger.

- `Command`: arguments, inputs, and arguments that resume the command
- `COMMANDS`: all commands that write; `write_inputs`: write their inputs
- `Trial`: kills of one command
- `kill_all`: many kills, distributed over all commands and calls
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
    """A command that writes files.

    Attributes
    ----------
    arguments
        Arguments of the command line.
    inputs
        Names of the files and folders that it reads.
    resume_arguments
        Arguments that resume or repeat the command after a kill; None: the same arguments.
    """

    arguments: tuple[str, ...]
    inputs: tuple[str, ...] = ()
    resume_arguments: tuple[str, ...] | None = None


#: Number of trials of the study, enough for several batches.
_N_TRIALS = "24000"

_RESULT = "result.json"
_APPLY = ("apply", _RESULT, "forces.csv", "--accelerometer", "Qx", "-o", "corrected.csv")
_SIMULATE = ("simulate", "campaign", "-o", "made")
_STUDY = ("study", "study.toml", "--trials", _N_TRIALS, "-o", "out", "--keep-trials")
_PLAN_JSON = ("plan", "plan.toml", "--json", "new.json")
_LEDGER = "ledger.jsonl"
_ISSUE = ("certificate", _RESULT, "LAB.toml", "-o")

#: All commands that write.
COMMANDS = {
    "calibrate": Command(("calibrate", "records", "--json", "new.json"), ("records",)),
    "report": Command(("report", _RESULT, "-o", "new.html"), (_RESULT,)),
    "report-md": Command(("report", _RESULT, "-o", "new.md"), (_RESULT,)),
    "report-pdf": Command(("report", _RESULT, "-o", "new.pdf"), (_RESULT,)),
    "simulate": Command(_SIMULATE, ("campaign",), (*_SIMULATE, "--overwrite")),
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
    """Write the inputs of commands into a folder."""
    for name in sorted(
        {input_name for command in names for input_name in COMMANDS[command].inputs}
    ):
        _INPUTS[name](folder / name)


def _write_campaign(path: Path) -> None:
    path.mkdir()
    short_campaign = replace_parts(SMALL, ("revolutions = 20", "revolutions = 8"))
    (path / "campaign.toml").write_text(short_campaign, encoding="utf-8")


def _write_records(path: Path) -> None:
    from counterspin.simulation.simulate import simulate

    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "campaign"
        _write_campaign(source)
        simulate(source, path)


def _write_result(path: Path) -> None:
    details = {"date": "2026-03-01", "serial_number": "C-7"}
    results.make_qx_result().model_copy(update={"details": details}).write(path)


def _write_forces(path: Path) -> None:
    rows = "\n".join(f"{0.01 * i},{math.sin(0.1 * i)!r}" for i in range(50))
    path.write_text(f"t,Qx\n{rows}\n", encoding="utf-8")


def _write_plan(path: Path) -> None:
    short_plan = replace_parts(resource_text("planning"), ("runs = 14", "runs = 2"))
    path.write_text(short_plan, encoding="utf-8")


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


def _read_files(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


#: Files in the folder of a study that are needed to resume it, and removed at its end.
_PROGRESS_FILES = ("out/progress",)


class Trial:
    """Kills of one command; the constructor runs it once, and raises AssertionError if it fails.

    Attributes
    ----------
    n_calls
        Number of its system calls on outputs.
    """

    def __init__(
        self, runner: Runner, name: str, command: Command, inputs: Path, parent: Path
    ) -> None:
        self.name, self._runner, self._command = name, runner, command
        self._inputs, self._folder = inputs, parent / name
        self._input_files = _read_files(self._reset_folder())
        result = runner.count_calls(command.arguments, self._folder)
        if result.status != 0:
            raise AssertionError(f"{name} ended with status {result.status}")
        self.n_calls = result.n_calls
        self._expected_files = _read_files(self._folder)

    def _reset_folder(self) -> Path:
        shutil.rmtree(self._folder, ignore_errors=True)
        self._folder.mkdir()
        for name in self._command.inputs:
            source, target = self._inputs / name, self._folder / name
            (shutil.copytree if source.is_dir() else shutil.copyfile)(source, target)
        return self._folder

    def find_faults(self, call: int) -> list[str]:
        """Kill the command before a call; return descriptions of lost or damaged data."""
        folder = self._reset_folder()
        if not self._runner.kill(self._command.arguments, folder, call):
            return [f"{self.name}: ended before call {call}"]
        location = f"{self.name}, killed before call {call} of {self.n_calls}"
        files = _read_files(folder)
        faults = [f"{location}: {fault}" for fault in self._find_file_faults(files)]
        arguments = self._command.resume_arguments or self._command.arguments
        unfinished = files.keys() - self._input_files.keys() - {_LEDGER}
        if (
            any(not _is_hidden(name) for name in unfinished)
            and self._command.resume_arguments is None
        ):
            return faults  # the output is complete
        if self.name == "study" and "out/progress.npz" not in unfinished:
            arguments = self._command.arguments  # no trial is saved, or all are finished
            arguments += ("--overwrite",) if "out/study.json" in unfinished else ()
        if (status := self._runner.run(arguments, folder).status) != 0:
            return [*faults, f"{location}: cannot be resumed (status {status})"]
        final_files = {
            name: content for name, content in _read_files(folder).items() if not _is_hidden(name)
        }
        if final_files != self._expected_files:
            differing = [
                n
                for n in final_files.keys() | self._expected_files.keys()
                if final_files.get(n) != self._expected_files.get(n)
            ]
            faults.append(f"{location}: resumed, but differs: {', '.join(sorted(differing))}")
        return faults

    def _find_file_faults(self, files: dict[str, bytes]) -> list[str]:
        faults = [
            f"{name} is lost or changed"
            for name, content in self._input_files.items()
            if files.get(name) != content
        ]
        if "new.xml" in files and self._command.arguments[-1] == _LEDGER:
            entries = verify_ledger(self._folder / _LEDGER).entries
            if sha256_hex(files["new.xml"]) not in {e.of.get("file_sha256") for e in entries}:
                faults.append("new.xml is not in its ledger")
        return faults + [
            f"{name} is not whole"
            for name in files.keys() - self._input_files.keys()
            if not (_is_hidden(name) or name.startswith((*_PROGRESS_FILES, _LEDGER)))
            and files[name] != self._expected_files.get(name)
        ]


def _is_hidden(name: str) -> bool:
    return Path(name).name.startswith(".")


def kill_all(
    n_kills: int, names: Sequence[str] = (), report: Callable[[str], object] = str
) -> tuple[int, list[str]]:
    """Kill commands at calls distributed over all of them.

    Parameters
    ----------
    n_kills
        Number of kills, up to rounding.
    names
        Names of the commands; default: all.
    report
        Function called with each progress message and fault.

    Returns
    -------
    int, list
        Number of kills, and descriptions of lost or damaged data.
    """
    faults: list[str] = []
    n_done = 0
    with tempfile.TemporaryDirectory(dir=_memory_folder()) as folder, Runner() as runner:
        inputs = Path(folder) / "inputs"
        inputs.mkdir()
        write_inputs(inputs, names or COMMANDS)
        trials = []
        for name in names or COMMANDS:
            trials.append(Trial(runner, name, COMMANDS[name], inputs, Path(folder)))
            report(f"{name}: {trials[-1].n_calls} calls")
        for n_finished, trial in enumerate(sorted(trials, key=lambda trial: trial.n_calls)):
            # Commands with few calls are killed at every call.
            n_calls = min(trial.n_calls, -(-(n_kills - n_done) // (len(trials) - n_finished)))
            calls = np.unique(np.linspace(1, trial.n_calls, n_calls).round().astype(int))
            start = time.monotonic()
            for call in calls:
                call_faults = trial.find_faults(int(call))
                faults += call_faults
                for fault in call_faults:
                    report(fault)
            n_done += len(calls)
            seconds_per_kill = (time.monotonic() - start) / max(len(calls), 1)
            report(
                f"{trial.name:<18}{len(calls):>5} of {trial.n_calls} calls, "
                f"{seconds_per_kill:.2f} s each"
            )
    return n_done, faults


def _memory_folder() -> Path | None:
    folder = Path("/dev/shm")
    return folder if os.access(folder, os.W_OK) else None

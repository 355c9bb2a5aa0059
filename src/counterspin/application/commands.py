"""What a click does, as the words of a command line: whoever has clicked can type it next time.

The one place of the application that knows the options of the command line; a test has the
command line read every one of them back.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from shlex import join


def calibrate_command(campaign: Path, output: Path, method: str, accept_misfit: str | None) -> str:
    """Return the command that calibrates a campaign and writes its result."""
    words = ["calibrate", str(campaign), "--json", str(output), "--overwrite"]
    if method != "joint":
        words.append(f"--method={method}")
    if accept_misfit:
        words.append(f"--accept-misfit={accept_misfit}")
    return _typed(words)


def report_command(result: Path) -> str:
    """Return the command that writes a result's report."""
    return _typed(["report", str(result), "--output", str(result.with_suffix(".html"))])


def init_command(folder: Path, test: str) -> str:
    """Return the command that writes an example campaign."""
    return _typed(["init", str(folder), f"--test={test}"])


def compare_command(results: Sequence[Path]) -> str:
    """Return the command that compares results."""
    return _typed(["compare", *map(str, results)])


def history_command(folder: Path, term: str) -> str:
    """Return the command that follows a coefficient through a folder's results."""
    return _typed(["history", str(folder), f"--term={term}"])


def certificate_command(
    result: Path, lab: Path, output: Path, both: bool, signing: Mapping[str, str]
) -> str:
    """Return the command that issues a result's certificate.

    signing: Options that say who signs, such as `key`, and their values.
    """
    words = ["certificate", str(result), str(lab), "--output", str(output)]
    if both:
        words.append("--both")
    return _typed([*words, *(f"--{name}={value}" for name, value in signing.items())])


def plan_command(file: Path, folder: Path | None) -> str:
    """Return the command that plans, and writes the campaign into a folder if there is one."""
    return _typed(["plan", str(file), *([] if folder is None else ["--output", str(folder)])])


def forecast_command(campaign: Path) -> str:
    """Return the command that says what a campaign will tell."""
    return _typed(["plan", "--check", str(campaign)])


def study_command(campaign: Path, trials: int, output: Path) -> str:
    """Return the command that studies a campaign and writes what it finds."""
    words = ["study", str(campaign), f"--trials={trials}", "--json", str(output), "--overwrite"]
    return _typed(words)


def simulate_command(campaign: Path, folder: Path) -> str:
    """Return the command that makes a campaign's records in another folder."""
    return _typed(["simulate", str(campaign), "--output", str(folder)])


def export_command(
    folder: Path, files: Sequence[Path], answers: Mapping[str, str], test: str
) -> str:
    """Return the command that makes a campaign of a recorder's files."""
    said = [f"--answer={key}={answer}" for key, answer in answers.items()]
    kind = [f"--test={test}"]
    return _typed(["init", str(folder), *kind, "--from", *map(str, files), *said])


def check_command(record: Path, campaign: Path, run: str) -> str:
    """Return the command that judges one record."""
    return _typed(["check", str(record), f"--campaign={campaign}", f"--run={run}"])


def watch_command(campaign: Path, goal: str) -> str:
    """Return the command that follows a campaign's records."""
    return _typed(["watch", str(campaign), *([f"--goal={goal}"] if goal else [])])


def _typed(words: Sequence[str]) -> str:
    return join(["counterspin", *words])

"""The command line of each action of the page.

This module alone knows the options of the command line within the application; a test has the
command line parse every one of them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from counterspin import shell


def calibrate_command(campaign: Path, output: Path, method: str, accept_misfit: str | None) -> str:
    """Return the command that calibrates a campaign and writes its result."""
    arguments = ["calibrate", str(campaign), "--json", str(output), "--overwrite"]
    if method != "joint":
        arguments.append(f"--method={method}")
    if accept_misfit:
        arguments.append(f"--accept-misfit={accept_misfit}")
    return _command_line(arguments)


def report_command(result: Path) -> str:
    """Return the command that writes a result's report."""
    return _command_line(["report", str(result), "--output", str(result.with_suffix(".html"))])


def init_command(folder: Path, test: str) -> str:
    """Return the command that writes an example campaign."""
    return _command_line(["init", str(folder), f"--test={test}"])


def demo_command(folder: Path) -> str:
    """Return the command that simulates and calibrates the demonstration's campaign."""
    return _command_line(["demo", "--output", str(folder)])


def compare_command(results: Sequence[Path]) -> str:
    """Return the command that compares results."""
    return _command_line(["compare", *map(str, results)])


def history_command(folder: Path, term: str) -> str:
    """Return the command that follows a coefficient through a folder's results."""
    return _command_line(["history", str(folder), f"--term={term}"])


def certificate_command(
    result: Path, lab: Path, output: Path, both: bool, signing: Mapping[str, str]
) -> str:
    """Return the command that issues a result's certificate.

    signing: Options for the signer, such as `key`, and their values.
    """
    arguments = ["certificate", str(result), str(lab), "--output", str(output)]
    if both:
        arguments.append("--both")
    return _command_line([*arguments, *(f"--{name}={value}" for name, value in signing.items())])


def plan_command(file: Path, folder: Path | None) -> str:
    """Return the command that plans, and writes the campaign into a folder if there is one."""
    return _command_line(
        ["plan", str(file), *([] if folder is None else ["--output", str(folder)])]
    )


def forecast_command(campaign: Path) -> str:
    """Return the command that predicts a campaign's uncertainties."""
    return _command_line(["plan", "--check", str(campaign)])


def study_command(campaign: Path, trials: int, output: Path) -> str:
    """Return the command that studies a campaign and writes the result."""
    arguments = ["study", str(campaign), f"--trials={trials}", "--json", str(output), "--overwrite"]
    return _command_line(arguments)


def simulate_command(campaign: Path, folder: Path) -> str:
    """Return the command that makes a campaign's records in another folder."""
    return _command_line(["simulate", str(campaign), "--output", str(folder)])


def import_command(
    folder: Path, files: Sequence[Path], answers: Mapping[str, str], test: str
) -> str:
    """Return the command that makes a campaign of a recorder's files."""
    answer_options = [f"--answer={key}={answer}" for key, answer in answers.items()]
    test_option = [f"--test={test}"]
    return _command_line(
        ["init", str(folder), *test_option, "--from", *map(str, files), *answer_options]
    )


def check_command(record: Path, campaign: Path, run: str) -> str:
    """Return the command that judges one record."""
    return _command_line(["check", str(record), f"--campaign={campaign}", f"--run={run}"])


def watch_command(campaign: Path, goal: str) -> str:
    """Return the command that follows a campaign's records."""
    return _command_line(["watch", str(campaign), *([f"--goal={goal}"] if goal else [])])


def _command_line(words: Sequence[str]) -> str:
    return shell.join_command(["counterspin", *words])

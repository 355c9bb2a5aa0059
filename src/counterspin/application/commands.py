"""Equivalent commands for the actions of the page.

Within the application, only this module knows the options of the command line; a test parses all
commands.
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
    return _join_arguments(arguments)


def report_command(result: Path) -> str:
    """Return the command that writes the report of a result."""
    return _join_arguments(["report", str(result), "--output", str(result.with_suffix(".html"))])


def init_command(folder: Path, test: str) -> str:
    """Return the command that writes an example campaign."""
    return _join_arguments(["init", str(folder), f"--test={test}"])


def demo_command(folder: Path) -> str:
    """Return the command that simulates and calibrates the demonstration campaign."""
    return _join_arguments(["demo", "--output", str(folder)])


def compare_command(results: Sequence[Path]) -> str:
    """Return the command that compares results."""
    return _join_arguments(["compare", *map(str, results)])


def history_command(folder: Path, term: str) -> str:
    """Return the command that tracks a coefficient through the results of a folder."""
    return _join_arguments(["history", str(folder), f"--term={term}"])


def certificate_command(
    result: Path, lab: Path, output: Path, write_both: bool, signing: Mapping[str, str]
) -> str:
    """Return the command that issues the certificate of a result.

    signing: Options for the signer, such as `key`, with their values.
    """
    arguments = ["certificate", str(result), str(lab), "--output", str(output)]
    if write_both:
        arguments.append("--both")
    return _join_arguments([*arguments, *(f"--{name}={value}" for name, value in signing.items())])


def plan_command(file: Path, folder: Path | None) -> str:
    """Return the command that computes a plan, and writes its campaign into a folder if given."""
    return _join_arguments(
        ["plan", str(file), *([] if folder is None else ["--output", str(folder)])]
    )


def forecast_command(campaign: Path) -> str:
    """Return the command that predicts the uncertainties of a campaign."""
    return _join_arguments(["plan", "--check", str(campaign)])


def study_command(campaign: Path, trials: int, output: Path) -> str:
    """Return the command that studies a campaign and writes the result."""
    arguments = ["study", str(campaign), f"--trials={trials}", "--json", str(output), "--overwrite"]
    return _join_arguments(arguments)


def simulate_command(campaign: Path, folder: Path) -> str:
    """Return the command that simulates the records of a campaign in another folder."""
    return _join_arguments(["simulate", str(campaign), "--output", str(folder)])


def import_command(
    folder: Path, files: Sequence[Path], prompt_answers: Mapping[str, str], test: str
) -> str:
    """Return the command that writes a campaign for data files."""
    answer_options = [f"--answer={key}={answer}" for key, answer in prompt_answers.items()]
    test_option = [f"--test={test}"]
    return _join_arguments(
        ["init", str(folder), *test_option, "--from", *map(str, files), *answer_options]
    )


def check_command(record: Path, campaign: Path, run: str) -> str:
    """Return the command that checks a record."""
    return _join_arguments(["check", str(record), f"--campaign={campaign}", f"--run={run}"])


def watch_command(campaign: Path, goal: str) -> str:
    """Return the command that monitors the records of a campaign."""
    return _join_arguments(["watch", str(campaign), *([f"--goal={goal}"] if goal else [])])


def _join_arguments(arguments: Sequence[str]) -> str:
    return shell.join_command(["counterspin", *arguments])

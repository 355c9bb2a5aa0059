"""Make the description of a campaign from guesses and answers."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from counterspin.campaign.description import resolve_campaign
from counterspin.campaign.documents import DESCRIPTION_NAME
from counterspin.campaign.field_types import COMPASS_ANGLES
from counterspin.campaign.memory import unused_file_name
from counterspin.campaign.settings import OBSERVABLES
from counterspin.campaign.validation import Problems
from counterspin.errors import CampaignError, CounterspinError, ExistingFileError, UsageError
from counterspin.frozen import frozen
from counterspin.ingest.arm import ArmDraft, make_arm_draft
from counterspin.ingest.column_roles import NO_COLUMN, FileGuess, guess_file, merge_guesses
from counterspin.ingest.contents import FileContents, read_files
from counterspin.ingest.poses import PosesDraft, make_poses_draft
from counterspin.ingest.questions import (
    FILES_KEY,
    SENSES,
    AnsweredDraft,
    FileQuestion,
    complete_guess,
    find_sense,
    make_turntable_questions,
    relative_path,
    validate_answers,
)
from counterspin.ingest.starter import Test
from counterspin.ingest.tumble import TumbleDraft, make_tumble_draft
from counterspin.output import make_folder, write_text
from counterspin.toml_text import format_document

#: Input axis -> default name of the accelerometer.
_NAME_BY_AXIS: Final = {
    "east": "Qx",
    "west": "Qx",
    "north": "Qy",
    "south": "Qy",
    "up": "Qz",
    "down": "Qz",
}
#: Tolerance of an encoder's zero at a compass direction, rad.
_COMPASS_TOLERANCE: Final = math.radians(0.5)
#: Smallest number of rows of a record.
_MIN_ROWS: Final = 16
#: Relative tolerance of round numbers for rates.
_ROUND_RATE_TOLERANCE: Final = 2e-4


@frozen
class Draft(AnsweredDraft):
    """Draft from records of a double turntable, with answers."""

    guesses: tuple[FileGuess, ...]  #: Guess of each file or sheet.
    common_guess: FileGuess  #: Guess that applies to all files.

    @property
    def files(self) -> list[Path]:
        """The files of the runs."""
        return [guess.contents.path for guess in self.guesses]

    @property
    def contents(self) -> FileContents:
        """The contents of the first file, which has the same columns as the others."""
        return self.common_guess.contents

    def make_document(self, folder: Path) -> dict[str, Any]:
        """Make the description from guesses and answers; CampaignError if an answer is missing.

        folder: Folder of the campaign.
        """
        common_guess, answers = self.common_guess, self.complete()
        sense, folder = answers["sense"], folder.resolve()
        document: dict[str, Any] = {
            "schema": 1,
            "campaign": {"title": folder.name},
            "site": {"gravity": answers["gravity"], "latitude": answers["latitude"]},
            "centrifuge": {"radius": answers["radius"]},
            "records": _make_records(common_guess, answers, sense),
            "accelerometers": _make_accelerometers(common_guess),
        }
        return document | {"runs": list(_make_runs(self.guesses, answers, sense, folder, []))}


def make_turntable_draft(
    all_contents: Sequence[FileContents], answers: Mapping[str, str] | None = None
) -> Draft:
    """Make a draft from a recorder's files, one for each run.

    answers: Key of a question -> answer; takes precedence over guesses.
    """
    if not all_contents:
        raise UsageError("init", ["give the run files"])

    def guess_files(valid_answers: Mapping[str, str]) -> tuple[tuple[FileGuess, ...], FileGuess]:
        guesses = tuple(guess_file(contents, valid_answers) for contents in all_contents)
        return guesses, complete_guess(merge_guesses(guesses), valid_answers)

    def make_questions(valid_answers: Mapping[str, str]) -> tuple[FileQuestion, ...]:
        _, common_guess = guess_files(valid_answers)
        return tuple(
            make_turntable_questions(
                common_guess, valid_answers.get("sense") or find_sense(common_guess), valid_answers
            )
        )

    valid_answers, problems = validate_answers(answers, make_questions)
    guesses, common_guess = guess_files(valid_answers)
    unsuitable_files = (
        f"{FILES_KEY}: {why}" for contents in all_contents if (why := _explain_unsuitable(contents))
    )
    wave_sense = find_sense(merge_guesses(guesses))
    problems = (*unsuitable_files, *problems, *_check_sense(valid_answers.get("sense"), wave_sense))
    questions = make_questions(valid_answers)
    statements = tuple(_make_statements(common_guess, guesses, wave_sense))
    return Draft(statements, questions, valid_answers, problems, guesses, common_guess)


def _check_sense(sense: str | None, wave_sense: str | None) -> Iterator[str]:
    """Yield an error if the signals contradict the answered sense."""
    if sense is not None and wave_sense is not None and sense != wave_sense:
        yield (
            "sense: the periodic signals of two axes show that the angle increases "
            f"{wave_sense}. If the angle does not increase in this sense, the direction of one "
            "axis is wrong, for example east instead of west"
        )


def _explain_unsuitable(contents: FileContents) -> str:
    """Explain why a file cannot be the record of a run; empty if it can."""
    n_rows = contents.rows
    if n_rows < _MIN_ROWS:
        return (
            f"{contents.path.name} has {n_rows} rows of numbers in {len(contents.columns)} "
            "columns, which is too few for the record of a run. Export one row per sample and "
            "one column per quantity. If the file is a table of readings, select the test type "
            "for readings"
        )
    for name, cells in contents.first_text_cells.items():
        n_distinct = len(set(cells))
        if 1 < n_distinct < len(cells) / 2 and cells[n_distinct:] == cells[:-n_distinct]:
            return (
                f"several quantities share a column in {contents.path.name}: the values in "
                f"column '{name}' alternate between {', '.join(cells[:n_distinct][:4])}. Export "
                "each quantity as a separate column"
            )
    return ""


#: Draft of any test type.
AnyDraft = Draft | TumbleDraft | ArmDraft | PosesDraft


def make_draft(
    all_contents: Sequence[FileContents], answers: Mapping[str, str], test: Test
) -> AnyDraft:
    """Make a draft from the files of a test."""
    draft_factories: dict[Test, Callable[..., AnyDraft]] = {
        "double-turntable": make_turntable_draft,
        "tumble": make_tumble_draft,
        "arm": make_arm_draft,
        "poses": make_poses_draft,
    }
    return draft_factories[test](all_contents, answers)


def write_description(draft: AnyDraft, folder: Path) -> Path:
    """Write the description to the campaign folder, with the guesses as comments."""
    target = folder / DESCRIPTION_NAME
    if target.exists():
        raise ExistingFileError(f"{target} already exists; edit it, or choose another folder")
    document = draft.make_document(folder)
    problems = Problems(document)
    is_new = not folder.exists()
    make_folder(folder)  # first, because names such as ../run1.csv require an existing folder
    if resolve_campaign(document, target, problems) is None:
        if is_new:
            folder.rmdir()
        raise CampaignError("init", problems.lines)
    names = ", ".join(file.name for file in draft.files)
    comment_lines = [f"Campaign created from {names}.", "Detected in the files (please check):"]
    comment_lines += [f"- {statement}" for statement in draft.statements]
    comments = {
        "site": '± standard uncertainty (k = 1), for example "9.8066 ± 1e-5 m/s^2"',
        "accelerometers": 'If known: bias = "0.005 ± 2e-6 g", and scale_factor in the same form',
        "records": "docs/campaign.md explains every key",
        "readings": "docs/readings.md explains every key",
    }
    text = "".join(f"# {line}\n" for line in comment_lines) + format_document(document, comments)
    write_text(target, text)
    return target


def draft_further_runs(
    files: Sequence[Path], document: Mapping[str, Any], folder: Path
) -> list[dict[str, Any]]:
    """Draft runs of an existing description for further files, with rates from the files.

    document: The description, whose column settings also apply to the further files.
    """
    records, runs = document.get("records", {}), document.get("runs", [])
    time, angle = records.get("time") or {}, records.get("angle") or {}
    known_answers = {
        "time": time.get("column", NO_COLUMN),
        "time unit": time.get("unit"),
        "sampling_rate": time.get("sampling_rate"),
        "angle": angle.get("column", NO_COLUMN),
        "angle unit": angle.get("unit"),
        "per_revolution": angle.get("per_revolution"),
    }
    known_answers = {key: str(value) for key, value in known_answers.items() if value is not None}
    sense = angle.get("sense", SENSES[0])
    if (not angle or angle.get("pulses")) and str(runs[0]["rate"]).startswith("-"):
        sense = SENSES[1]  # without an encoder, assume the sense of the first run
    guesses = [guess_file(contents, known_answers) for contents in read_files(files)]
    for guess in guesses:
        if guess.rate is None or not (guess.time or guess.sampling_rate):
            raise CounterspinError(
                f"{guess.contents.path}: the rate of the centrifuge cannot be determined from "
                "the file; add the run to the description",
                code="missing-answer",
            )
    names = [run["name"] for run in runs]
    return list(_make_runs(guesses, {}, sense, folder.resolve(), names))


def _make_runs(
    guesses: Sequence[FileGuess],
    answers: Mapping[str, str],
    sense: str,
    folder: Path,
    names: list[str],
) -> Iterator[dict[str, Any]]:
    """Yield a run for each file with a new name, which is added to `names`."""
    for guess in guesses:
        name = Path(unused_file_name(guess.contents.title, "", names)).name
        names.append(name)
        run: dict[str, Any] = {
            "name": name,
            "rate": _format_rate(guess, answers, sense),
            "record": relative_path(guess.contents.path, folder),
        }
        dialect_keys = guess.contents.dialect_keys
        yield run | ({"records": dialect_keys} if dialect_keys else {})


# Statements


def _make_statements(
    common_guess: FileGuess, guesses: Sequence[FileGuess], sense: str | None
) -> Iterator[str]:
    time, angle = common_guess.time, common_guess.angle
    yield from common_guess.sampling_text
    if time is not None:
        unit = "time stamps" if time.unit == "iso" else f"in {time.unit or 'an unknown unit'}"
        yield f"time: column '{time.column}', {unit}"
    if rates := [guess.rate for guess in guesses if guess.rate is not None]:
        is_counted = not (time or common_guess.sampling_rate)
        turns = sorted(
            2.0 * math.pi / rate if is_counted else rate / (2.0 * math.pi) for rate in rates
        )
        turns_text = f"{turns[0]:.6g}" + (f" to {turns[-1]:.6g}" if len(turns) > 1 else "")
        yield f"rate: {turns_text} {'rows per revolution' if is_counted else 'rev/s'}"
    if angle is None:
        yield "angle: no angle column was found, so counterspin uses the nominal rates"
    elif angle.pulses:
        yield f"angle: column '{angle.column}' contains pulse times, one pulse per revolution"
    else:
        suffix = f", {angle.per_revolution:.10g} per revolution" if angle.per_revolution else ""
        source = (
            "from the unit in the file" if angle.has_file_unit else "from the column name or values"
        )
        unit = angle.unit or "an unknown unit"
        yield f"angle: column '{angle.column}', in {unit}{suffix} ({source})"
    if sense is not None and angle is not None:
        yield f"sense: {sense}, determined from the phase difference between two axes"
    yield from common_guess.temperature_text
    for signal in common_guess.signals:
        quantity = (signal.observable or "a signal").replace("_", " ")
        axis_text = f"along {signal.axis}" if signal.axis else "axis not detected"
        unit = f" in {signal.unit}" if signal.unit else ""
        unit += " (determined from the radius)" if signal.is_unit_from_radius else ""
        yield f"column '{signal.column}': {quantity}{unit}, {axis_text}"
    if common_guess.signals:
        yield "pendulous axes: assumed down (north if the input axis points up)"
    if common_guess.unused_columns:
        yield f"not used: {', '.join(common_guess.unused_columns[:20])}"


# Parts of the description


def _make_records(
    common_guess: FileGuess, answers: Mapping[str, str], sense: str
) -> dict[str, Any]:
    records: dict[str, Any] = {}
    if common_guess.time is None:
        sampling_rate = answers.get("sampling_rate") or f"{common_guess.sampling_rate:.12g} Hz"
        records["time"] = {"sampling_rate": sampling_rate}
    else:
        records["time"] = {"column": common_guess.time.column, "unit": common_guess.time.unit}
    records |= common_guess.temperature_table
    angle = common_guess.angle
    if angle is None:
        return records
    table: dict[str, Any] = {"column": angle.column, "unit": angle.unit}
    if angle.pulses:
        table["pulses"] = True
        table["unit"] = angle.unit or records["time"].get("unit", "s")
    elif angle.unit == "count":
        counts = angle.per_revolution or math.nan
        table["per_revolution"] = int(counts) if counts.is_integer() else counts
    if sense == SENSES[1] and not angle.pulses:
        table["sense"] = sense
    zero = _find_encoder_zero(common_guess, sense)
    if zero is not None and zero != "east":
        table["zero"] = zero
    return records | {"angle": table}


def _find_encoder_zero(common_guess: FileGuess, sense: str) -> str | None:
    """Return the arm's direction at the encoder's zero, from the phase of a horizontal signal."""
    sense_sign = 1.0 if sense == SENSES[0] else -1.0
    rate_sign = sense_sign if common_guess.is_increasing else -sense_sign
    for signal in common_guess.signals:
        axis = signal.axis
        if signal.phase is None or axis not in COMPASS_ANGLES:
            continue
        derivative_order = list(OBSERVABLES).index(signal.observable or "displacement")
        phase = signal.phase - sense_sign * rate_sign * derivative_order * math.pi / 2.0
        zero = sense_sign * phase + COMPASS_ANGLES[axis]
        for name, direction in COMPASS_ANGLES.items():
            if abs(math.remainder(zero - direction, 2.0 * math.pi)) < _COMPASS_TOLERANCE:
                return name
        return f"{math.degrees(math.remainder(zero, 2.0 * math.pi)):.4f} deg"
    return None


def _make_accelerometers(common_guess: FileGuess) -> dict[str, Any]:
    tables: dict[str, Any] = {}
    for signal in common_guess.signals:
        assert signal.axis is not None
        assert signal.observable is not None
        name, number = _NAME_BY_AXIS[signal.axis], 2
        while name in tables:
            name, number = f"{_NAME_BY_AXIS[signal.axis]}{number}", number + 1
        tables[name] = {
            "input_axis": signal.axis,
            "pendulous_axis": "north" if signal.axis in ("up", "down") else "down",
            signal.observable: {"column": signal.column, "unit": signal.unit},
        }
    return tables


def _format_rate(guess: FileGuess, answers: Mapping[str, str], sense: str) -> str:
    """Format the rate of a run, rounded if it is close to a round number."""
    if guess.rate is None:
        return answers["rate"]
    is_positive_sense = sense == SENSES[0]
    has_encoder = guess.angle is not None and not guess.angle.pulses
    sign = 1.0 if is_positive_sense == (guess.is_increasing or not has_encoder) else -1.0
    rate = guess.rate
    for unit, factor in (("rev/s", 2.0 * math.pi), ("deg/s", math.pi / 180.0), ("rad/s", 1.0)):
        value = rate / factor
        rounded_value = float(np.format_float_positional(value, precision=3, fractional=False))
        if abs(rounded_value / value - 1.0) < _ROUND_RATE_TOLERANCE:
            return f"{sign * rounded_value:g} {unit}"
    return f"{sign * rate:.8g} rad/s"

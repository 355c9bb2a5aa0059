"""Draft a campaign's description from readings of a sensor with three axes in many poses.

Records and tables with one pose per row are detected from their numbers
(`counterspin.ingest.triads`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from counterspin.campaign.memory import unused_file_name
from counterspin.errors import CampaignError, UsageError
from counterspin.frozen import frozen
from counterspin.ingest.column_roles import FileGuess
from counterspin.ingest.contents import FileContents
from counterspin.ingest.questions import (
    AnsweredDraft,
    FileQuestion,
    make_site_questions,
    make_time_questions,
    relative_path,
    validate_answers,
)
from counterspin.ingest.triads import (
    AXES,
    MAX_ROWS,
    N_PARAMETERS,
    UNITS,
    TriadColumns,
    find_triad,
    guess_grade,
    guess_pose_file,
)
from counterspin.physics.grades import GRADES
from counterspin.records.column_file import format_names
from counterspin.triads.static_intervals import MIN_CONTRAST, MIN_DURATION
from counterspin.units import is_convertible

#: Largest number of poses from which noise cannot be estimated with biases and scale factors.
_MAX_POSES_WITHOUT_NOISE: Final = 6


@frozen
class PosesDraft(AnsweredDraft):
    """Draft from records or a table of poses, with answers."""

    guesses: tuple[FileGuess, ...]  #: Guess of each file.
    #: The columns of the three axes, and their poses; None: unknown.
    triad: TriadColumns | None

    @property
    def files(self) -> list[Path]:
        """The files of the records."""
        return [guess.contents.path for guess in self.guesses]

    @property
    def contents(self) -> FileContents:
        """The contents of the first file."""
        return self.guesses[0].contents

    @property
    def column_names(self) -> tuple[str, str, str] | None:
        """The columns of the three axes; None: unknown."""
        return self.triad.columns if self.triad else None

    def make_document(self, folder: Path) -> dict[str, Any]:
        """Make the description from guesses and answers; CampaignError if an answer is missing.

        folder: Folder of the campaign.
        """
        answers, folder = self.complete(), folder.resolve()
        columns = [answers[axis] for axis in AXES]
        if len(set(columns)) < len(columns):
            text = (
                f"each axis must have a separate column, but the columns are {', '.join(columns)}"
            )
            raise CampaignError("init", [text], code="duplicate-entry")
        is_table = self.triad is not None and self.triad.is_table
        accelerometers = {}
        for column, (name, (input_axis, pendulous)) in zip(columns, AXES.items(), strict=True):
            table: dict[str, Any] = {"input_axis": input_axis, "pendulous_axis": pendulous}
            table["grade"] = answers["grade"]
            output = {"unit": answers["unit"]}
            if "sensitivity" in answers:
                output["sensitivity"] = answers["sensitivity"]
            elif is_table and answers["unit"] == "m/s^2":
                output["sensitivity"] = f"{answers['gravity'].partition(' ')[0]} m/s^2/g"
            if f"{name} zero" in answers:
                output["zero"] = answers[f"{name} zero"]
            if len(output) > 1 or is_table:
                table["output"] = output
            if not is_table:
                table["specific_force"] = {"column": column, "unit": answers["unit"]}
            accelerometers[name] = table
        return {
            "schema": 1,
            "campaign": {"title": folder.name},
            "site": {"gravity": answers["gravity"], "latitude": answers["latitude"]},
            "accelerometers": accelerometers,
            "triad": {"accelerometers": list(AXES)},
            **_make_model(self.triad),
        } | (
            self._make_table_keys(columns, answers, folder)
            if is_table
            else self._make_record_keys(answers, folder)
        )

    def _make_table_keys(
        self, columns: Sequence[str], answers: Mapping[str, str], folder: Path
    ) -> dict[str, Any]:
        """Return the keys for a table of poses: file and column roles."""
        contents = self.contents
        readings: dict[str, Any] = {"file": relative_path(contents.path, folder)}
        readings |= contents.dialect_keys
        readings |= {"decimal": ","} if contents.decimal == "," else {}
        role_columns: dict[str, Any] = {"reading": dict(zip(AXES, columns, strict=True))}
        temperature = self.guesses[0].temperature
        role_columns |= {"temperature": temperature[0]} if temperature else {}
        readings |= {"u": answers["u"]} if "u" in answers else {}
        return {"readings": readings | {"attitude": "unknown", "columns": role_columns}}

    def _make_record_keys(self, answers: Mapping[str, str], folder: Path) -> dict[str, Any]:
        """Return the keys for records of poses: time, and one run per record."""
        time = self.guesses[0].time
        pose_keys = {"rest": answers["rest"]} | ({"u": answers["u"]} if "u" in answers else {})
        time_table: dict[str, Any] = {"sampling_rate": answers.get("sampling_rate")}
        if time is not None:
            time_table = {"column": time.column, "unit": time.unit or answers["time unit"]}
        names: list[Any] = []
        runs = []
        dialect_keys = self.contents.dialect_keys
        is_uniform = all(guess.contents.dialect_keys == dialect_keys for guess in self.guesses)
        for contents in (guess.contents for guess in self.guesses):
            names.append(Path(unused_file_name(contents.title, "", names)).name)
            run = {
                "name": names[-1],
                "motion": "static",
                "attitude": "unknown",
                "record": relative_path(contents.path, folder),
                "poses": pose_keys,
            }
            runs.append(run if is_uniform else run | {"records": contents.dialect_keys})
        records = (
            {"time": time_table}
            | (dialect_keys if is_uniform else {})
            | self.guesses[0].temperature_table
        )
        return {"records": records, "runs": runs}


def make_poses_draft(
    all_contents: Sequence[FileContents], answers: Mapping[str, str] | None = None
) -> PosesDraft:
    """Make a draft from records or a table of poses.

    answers: Key of a question -> answer; takes precedence over guesses.
    """
    if not all_contents:
        raise UsageError("init", ["give the record of the poses"])
    guesses: tuple[FileGuess, ...] = ()
    questions: tuple[FileQuestion, ...] = ()
    triad: TriadColumns | None = None

    def make_questions(valid_answers: Mapping[str, str]) -> tuple[FileQuestion, ...]:
        nonlocal guesses, questions, triad
        guesses = tuple(guess_pose_file(contents, valid_answers) for contents in all_contents)
        triad = find_triad(guesses, valid_answers)
        questions = tuple(_make_questions(guesses[0], triad, valid_answers))
        return questions

    valid_answers, problems = validate_answers(answers, make_questions)
    statements = tuple(_make_statements(guesses, triad, valid_answers))
    return PosesDraft(statements, questions, valid_answers, problems, guesses, triad)


def looks_like_poses(all_contents: Sequence[FileContents]) -> bool:
    """Return whether the files seem to be records of a three-axis sensor in many poses."""
    triad = find_triad([guess_pose_file(contents, {}) for contents in all_contents], {})
    if triad is None or triad.unit is not None:
        return triad is not None
    # Clear rests on a sphere show a sensor even if the unit is unknown.
    return triad.poses is not None and any(triad.zero) and triad.poses.contrast > MIN_CONTRAST


def _make_model(triad: TriadColumns | None) -> dict[str, Any]:
    """Return [model] with fewer terms for poses that do not determine all; empty for others."""
    if triad is None or triad.means is None or triad.determines_angles:
        return {}
    return {"model": {"terms": ["K_F", "K_I"]}}


# Questions and statements


def _make_questions(
    guess: FileGuess, triad: TriadColumns | None, answers: Mapping[str, str]
) -> Iterator[FileQuestion]:
    names = tuple(column.name for column in guess.contents.columns)
    is_table = triad is not None and triad.is_table
    yield from make_site_questions(guess.contents)
    yield from () if is_table else make_time_questions(guess, names)
    for index, axis in enumerate(AXES):
        text = f"Which column contains axis {axis} of the sensor?"
        column_name = triad.columns[index] if triad else None
        yield FileQuestion(axis, text, names[min(index, len(names) - 1)], names, column_name)
    text = "What is the unit of the three axes?"
    if triad and math.isfinite(triad.gravity):
        text += f" The magnitude of the vector at rest is {triad.gravity:.4g}."
    unit = answers.get("unit") or (triad.unit if triad else None)
    yield FileQuestion("unit", text, UNITS[0], UNITS, unit)
    if unit is not None and not is_convertible(unit, "m/s^2"):
        text = "What is the nominal sensitivity?"
        gravity = triad.gravity if triad else math.nan
        suggestion = f"{gravity:.4g} {unit}/g" if math.isfinite(gravity) else None
        yield FileQuestion(
            "sensitivity", text, f"1000 {unit}/g", guess=suggestion, quantity=f"{unit}/g"
        )
        zeros = triad.zero.tolist() if triad else []
        for axis, zero in zip(AXES, zeros if any(zeros) else [], strict=False):
            text = f"What is the nominal output of axis {axis} at zero specific force?"
            suggestion = f"{zero:.4g} {unit}"
            yield FileQuestion(f"{axis} zero", text, suggestion, guess=suggestion, quantity=unit)
    if (
        triad is not None
        and triad.means is not None
        and len(triad.means) <= _MAX_POSES_WITHOUT_NOISE
    ):
        pose_unit = "m/s^2" if unit is None or not is_table else unit
        text = (
            f"The noise cannot be estimated from only {len(triad.means)} poses. What is the "
            "standard uncertainty of each axis in a pose?"
        )
        example = "0.01 m/s^2" if pose_unit == "m/s^2" else f"0.001 {pose_unit}"
        yield FileQuestion("u", text, example, quantity=pose_unit)
    if not is_table:
        text = "What is the minimum duration of a rest interval that is used as a pose?"
        duration_text = f"{triad.rest if triad else MIN_DURATION:g} s"
        yield FileQuestion("rest", text, duration_text, guess=duration_text, quantity="s")
    text = "What is the grade of the sensor? The grade determines the default uncertainties."
    grade = guess_grade(triad, guess) if triad else None
    yield FileQuestion("grade", text, "consumer", GRADES, grade)


def _make_statements(
    guesses: Sequence[FileGuess], triad: TriadColumns | None, answers: Mapping[str, str]
) -> Iterator[str]:
    time, sampling_rate = guesses[0].time, guesses[0].sampling_rate
    if triad is not None and triad.is_table:
        yield from _make_table_statements(guesses[0], triad)
        return
    if time is not None:
        yield f"time: column '{time.column}', in {time.unit or 'an unknown unit'}"
    yield from guesses[0].sampling_text
    yield from guesses[0].temperature_text
    if triad is None:
        return
    unit = f" in {triad.unit}" if triad.unit else ""
    yield f"three-axis sensor: columns {format_names(triad.columns)}{unit}"
    poses = triad.poses
    if poses is None:
        yield "no rest interval was found in the record"
        return
    condition = (
        " if the record has 100 rows per second" if time is None and sampling_rate is None else ""
    )
    if len(poses.level) == MAX_ROWS:
        condition = ", first part of the record," + condition
    source = guesses[0].contents.path.name if len(guesses) == 1 else f"{len(guesses)} files"
    yield from _make_pose_warnings(triad)
    threshold_text = f"{poses.threshold:.3g} {triad.unit or ''}".strip()
    yield (
        f"{len(poses.start)} poses in {source}{condition}: rest intervals of at least "
        f"{answers.get('rest', f'{triad.rest:g} s')} in which the combined scatter of the axes "
        f"is below {threshold_text}; the attitudes are unknown"
    )
    yield from poses.warnings
    yield from poses.rejected
    for names in triad.further_columns:
        answer_text = ", ".join(f"{axis}={name}" for axis, name in zip(AXES, names, strict=True))
        yield (
            "three further axes are at rest at the same times. They belong to a second sensor "
            f"and are not used; to calibrate that sensor, answer {answer_text}"
        )
    yield from _list_unused_columns(guesses[0], triad)


def _make_table_statements(guess: FileGuess, triad: TriadColumns) -> Iterator[str]:
    """Yield the statements about a table with one pose per row."""
    assert triad.means is not None
    unit = f" in {triad.unit}" if triad.unit else ""
    yield f"three-axis sensor: columns {format_names(triad.columns)}{unit}"
    yield f"{len(triad.means)} poses, one per row; the attitudes are unknown"
    yield from _make_pose_warnings(triad)
    yield from guess.temperature_text
    yield from _list_unused_columns(guess, triad)


def _make_pose_warnings(triad: TriadColumns) -> Iterator[str]:
    """Yield warnings about too few poses, or poses in too few directions."""
    if not _make_model(triad) or triad.means is None:
        return
    has_few_poses = len(triad.means) <= N_PARAMETERS
    reason = (
        "with nine poses or fewer, the noise and the angles between the axes cannot both be "
        "determined"
        if has_few_poses
        else "poses near the six faces do not determine the angles between the axes"
    )
    advice = (
        "spread over the whole sphere"
        if has_few_poses
        else "halfway between two axes, in both directions"
    )
    yield (
        f"{reason}, so only biases and scale factors are requested. Measure at least twelve poses, "
        f"{advice}"
    )


def _list_unused_columns(guess: FileGuess, triad: TriadColumns) -> Iterator[str]:
    names = [*(signal.column for signal in guess.signals), *guess.unused_columns]
    if unused_names := [name for name in names if name not in triad.columns]:
        yield f"not used: {', '.join(unused_names[:20])}"

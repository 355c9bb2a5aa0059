"""Draft a campaign's description from readings of a sensor with three axes in many poses.

Such a record is detected from its data, and so is a table with a pose in each row
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
    place_questions,
    relative_name,
    time_questions,
    validate_answers,
)
from counterspin.ingest.triads import (
    AXES,
    MOST_ROWS,
    PARAMETERS,
    UNITS,
    TriadColumns,
    find_triad,
    grade_of,
    guessed_poses,
)
from counterspin.physics.grades import GRADES
from counterspin.records.column_file import format_names
from counterspin.triads.static_intervals import MIN_CONTRAST, MIN_DURATION
from counterspin.units import is_convertible

#: Poses that do not tell their noise beside biases and scale factors.
_NO_NOISE: Final = 6


@frozen
class PosesDraft(AnsweredDraft):
    """The contents of a record of poses, and a person's answers."""

    guesses: tuple[FileGuess, ...]  #: Of each file.
    found: (
        TriadColumns | None
    )  #: The columns of the three axes, and their poses; None: not known yet.

    @property
    def files(self) -> list[Path]:
        """The files of the records."""
        return [guess.contents.path for guess in self.guesses]

    @property
    def contents(self) -> FileContents:
        """The contents of the first file."""
        return self.guesses[0].contents

    @property
    def triad(self) -> tuple[str, str, str] | None:
        """The columns of the three axes; None: not known yet."""
        return self.found.columns if self.found else None

    def document(self, folder: Path) -> dict[str, Any]:
        """Return the description made from guesses and answers; CampaignError if one is missing.

        folder: The campaign's.
        """
        said, place = self.complete(), folder.resolve()
        columns = [said[axis] for axis in AXES]
        if len(set(columns)) < len(columns):
            text = (
                f"each axis must have a separate column, but the columns are {', '.join(columns)}"
            )
            raise CampaignError("init", [text], code="duplicate-entry")
        in_table = self.found is not None and self.found.in_table
        instruments = {}
        for column, (name, (input_axis, pendulous)) in zip(columns, AXES.items(), strict=True):
            table: dict[str, Any] = {"input_axis": input_axis, "pendulous_axis": pendulous}
            table["grade"] = said["grade"]
            output = {"unit": said["unit"]}
            if "sensitivity" in said:
                output["sensitivity"] = said["sensitivity"]
            elif in_table and said["unit"] == "m/s^2":
                output["sensitivity"] = f"{said['gravity'].partition(' ')[0]} m/s^2/g"
            if f"{name} zero" in said:
                output["zero"] = said[f"{name} zero"]
            if len(output) > 1 or in_table:
                table["output"] = output
            if not in_table:
                table["specific_force"] = {"column": column, "unit": said["unit"]}
            instruments[name] = table
        return {
            "schema": 1,
            "campaign": {"title": place.name},
            "site": {"gravity": said["gravity"], "latitude": said["latitude"]},
            "accelerometers": instruments,
            "triad": {"accelerometers": list(AXES)},
            **_model(self.found),
        } | (self._table(columns, said, place) if in_table else self._records(said, place))

    def _table(
        self, columns: Sequence[str], said: Mapping[str, str], place: Path
    ) -> dict[str, Any]:
        """Return the keys for a table of poses: its file and the role of its columns."""
        contents = self.contents
        readings: dict[str, Any] = {"file": relative_name(contents.path, place)}
        readings |= contents.dialect_keys
        readings |= {"decimal": ","} if contents.decimal == "," else {}
        read: dict[str, Any] = {"reading": dict(zip(AXES, columns, strict=True))}
        warm = self.guesses[0].temperature
        read |= {"temperature": warm[0]} if warm else {}
        readings |= {"u": said["u"]} if "u" in said else {}
        return {"readings": readings | {"attitude": "unknown", "columns": read}}

    def _records(self, said: Mapping[str, str], place: Path) -> dict[str, Any]:
        """Return the keys for records of poses: their time, and a run for each."""
        time = self.guesses[0].time
        poses = {"rest": said["rest"]} | ({"u": said["u"]} if "u" in said else {})
        rows: dict[str, Any] = {"sampling_rate": said.get("sampling_rate")}
        if time is not None:
            rows = {"column": time.column, "unit": time.unit or said["time unit"]}
        names: list[Any] = []
        runs = []
        keys = self.contents.dialect_keys
        alike = all(guess.contents.dialect_keys == keys for guess in self.guesses)
        for contents in (guess.contents for guess in self.guesses):
            names.append(Path(unused_file_name(contents.title, "", names)).name)
            run = {
                "name": names[-1],
                "motion": "static",
                "attitude": "unknown",
                "record": relative_name(contents.path, place),
                "poses": poses,
            }
            runs.append(run if alike else run | {"records": contents.dialect_keys})
        records = {"time": rows} | (keys if alike else {}) | self.guesses[0].temperature_table
        return {"records": records, "runs": runs}


def poses_draft(
    all_contents: Sequence[FileContents], answers: Mapping[str, str] | None = None
) -> PosesDraft:
    """Return a draft from records of poses, and the open questions.

    answers: By the keys of questions; they take precedence over guesses.
    """
    if not all_contents:
        raise UsageError("init", ["give the record of the poses"])
    guesses: tuple[FileGuess, ...] = ()
    questions: tuple[FileQuestion, ...] = ()
    found: TriadColumns | None = None

    def asked(taken: Mapping[str, str]) -> tuple[FileQuestion, ...]:
        nonlocal guesses, questions, found
        guesses = tuple(guessed_poses(contents, taken) for contents in all_contents)
        found = find_triad(guesses, taken)
        questions = tuple(_questions(guesses[0], found, taken))
        return questions

    taken, problems = validate_answers(answers, asked)
    statements = tuple(_statements(guesses, found, taken))
    return PosesDraft(statements, questions, taken, problems, guesses, found)


def shows_poses(all_contents: Sequence[FileContents]) -> bool:
    """Return whether files seem to be records of a sensor in many poses."""
    found = find_triad([guessed_poses(contents, {}) for contents in all_contents], {})
    if found is None or found.unit is not None:
        return found is not None
    # Whatever its unit may be, what rests on a sphere and moves clearly between is a sensor's.
    return found.poses is not None and any(found.zero) and found.poses.contrast > MIN_CONTRAST


def _model(found: TriadColumns | None) -> dict[str, Any]:
    """Return the requested terms for poses that do not determine all; empty for others."""
    if found is None or found.means is None or found.tells_angles:
        return {}
    return {"model": {"terms": ["K_F", "K_I"]}}


# What is asked, and said


def _questions(
    guess: FileGuess, found: TriadColumns | None, answers: Mapping[str, str]
) -> Iterator[FileQuestion]:
    names = tuple(column.name for column in guess.contents.columns)
    in_table = found is not None and found.in_table
    yield from place_questions(guess.contents)
    yield from () if in_table else time_questions(guess, names)
    for place, axis in enumerate(AXES):
        text = f"Which column contains axis {axis} of the sensor?"
        known = found.columns[place] if found else None
        yield FileQuestion(axis, text, names[min(place, len(names) - 1)], names, known)
    text = "What is the unit of the three axes?"
    if found and math.isfinite(found.gravity):
        text += f" The magnitude of the vector at rest is {found.gravity:.4g}."
    unit = answers.get("unit") or (found.unit if found else None)
    yield FileQuestion("unit", text, UNITS[0], UNITS, unit)
    if unit is not None and not is_convertible(unit, "m/s^2"):
        text = "What is the nominal sensitivity?"
        felt = found.gravity if found else math.nan
        size = f"{felt:.4g} {unit}/g" if math.isfinite(felt) else None
        yield FileQuestion("sensitivity", text, f"1000 {unit}/g", guess=size, quantity=f"{unit}/g")
        zeros = found.zero.tolist() if found else []
        for axis, zero in zip(AXES, zeros if any(zeros) else [], strict=False):
            text = f"What is the nominal output of axis {axis} at zero specific force?"
            size = f"{zero:.4g} {unit}"
            yield FileQuestion(f"{axis} zero", text, size, guess=size, quantity=unit)
    if found is not None and found.means is not None and len(found.means) <= _NO_NOISE:
        said = "m/s^2" if unit is None or not in_table else unit
        text = (
            f"The noise cannot be estimated from only {len(found.means)} poses. What is the "
            "standard uncertainty of each axis in a pose?"
        )
        example = "0.01 m/s^2" if said == "m/s^2" else f"0.001 {said}"
        yield FileQuestion("u", text, example, quantity=said)
    if not in_table:
        text = "What is the minimum duration of a rest interval that is used as a pose?"
        usual = f"{found.rest if found else MIN_DURATION:g} s"
        yield FileQuestion("rest", text, usual, guess=usual, quantity="s")
    text = "What is the grade of the sensor? The grade determines the default uncertainties."
    grade = grade_of(found, guess) if found else None
    yield FileQuestion("grade", text, "consumer", GRADES, grade)


def _statements(
    guesses: Sequence[FileGuess], found: TriadColumns | None, answers: Mapping[str, str]
) -> Iterator[str]:
    time, sampling = guesses[0].time, guesses[0].sampling
    if found is not None and found.in_table:
        yield from _pose_table_messages(guesses[0], found)
        return
    if time is not None:
        yield f"time: column '{time.column}', in {time.unit or 'an unknown unit'}"
    yield from guesses[0].sampling_words
    yield from guesses[0].temperature_words
    if found is None:
        return
    unit = f" in {found.unit}" if found.unit else ""
    yield f"three-axis sensor: columns {format_names(found.columns)}{unit}"
    poses = found.poses
    if poses is None:
        yield "no rest interval was found in the record"
        return
    usual = " if the record has 100 rows per second" if time is None and sampling is None else ""
    usual = ", first part of the record," + usual if len(poses.level) == MOST_ROWS else usual
    where = guesses[0].contents.path.name if len(guesses) == 1 else f"{len(guesses)} files"
    yield from _few(found)
    level = f"{poses.threshold:.3g} {found.unit or ''}".strip()
    yield (
        f"{len(poses.start)} poses in {where}{usual}: rest intervals of at least "
        f"{answers.get('rest', f'{found.rest:g} s')} in which the combined scatter of the axes "
        f"is below {level}; the attitudes are unknown"
    )
    yield from poses.warnings
    yield from poses.rejected
    for axes in found.others:
        named = ", ".join(f"{axis}={name}" for axis, name in zip(AXES, axes, strict=True))
        yield (
            "three further axes are at rest at the same times. They belong to a second sensor "
            f"and are not used; to calibrate that sensor, answer {named}"
        )
    yield from _not_used(guesses[0], found)


def _pose_table_messages(guess: FileGuess, found: TriadColumns) -> Iterator[str]:
    """Yield the messages about a table with a pose in each row."""
    assert found.means is not None
    unit = f" in {found.unit}" if found.unit else ""
    yield f"three-axis sensor: columns {format_names(found.columns)}{unit}"
    yield f"{len(found.means)} poses, one per row; the attitudes are unknown"
    yield from _few(found)
    yield from guess.temperature_words
    yield from _not_used(guess, found)


def _few(found: TriadColumns) -> Iterator[str]:
    """Yield the messages about poses that are too few, or in too few directions."""
    if not _model(found) or found.means is None:
        return
    few = len(found.means) <= PARAMETERS
    why = (
        "with nine poses or fewer, the noise and the angles between the axes cannot both be "
        "determined"
        if few
        else "poses near the six faces do not determine the angles between the axes"
    )
    more = "spread over the whole sphere" if few else "halfway between two axes, in both directions"
    yield (
        f"{why}, so only biases and scale factors are requested. Measure at least twelve poses, "
        f"{more}"
    )


def _not_used(guess: FileGuess, found: TriadColumns) -> Iterator[str]:
    unused = [name for name in guess.unused if name not in found.columns]
    others = [s.column for s in guess.signals if s.column not in found.columns]
    if not_used := [*others, *unused]:
        yield f"not used: {', '.join(not_used[:20])}"

"""Make a campaign's description from guesses and answers."""

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
from counterspin.ingest.arm import ArmDraft, arm_draft
from counterspin.ingest.column_roles import NONE, FileGuess, common_guess, guess_file
from counterspin.ingest.contents import FileContents, read_files
from counterspin.ingest.poses import PosesDraft, poses_draft
from counterspin.ingest.questions import (
    SENSES,
    UNFIT,
    AnsweredDraft,
    FileQuestion,
    complete_guess,
    questions_of,
    relative_name,
    validate_answers,
    waves_sense,
)
from counterspin.ingest.starter import Test
from counterspin.ingest.tumble import TumbleDraft, tumble_draft
from counterspin.output import make_folder, write_text
from counterspin.toml_text import format_document

#: Axis -> usual name of an accelerometer.
_NAMES: Final = {"east": "Qx", "west": "Qx", "north": "Qy", "south": "Qy", "up": "Qz", "down": "Qz"}
#: An encoder's zero is a compass direction if it points there within, rad.
_POINTING_ANGLE: Final = math.radians(0.5)
#: Rows of a record, at least.
_FEWEST_ROWS: Final = 16
#: A rate is a round number if it is one within this part.
_ROUND_RATE_PART: Final = 2e-4


@frozen
class Draft(AnsweredDraft):
    """The contents of records, and a person's answers."""

    guesses: tuple[FileGuess, ...]  #: Of each file, or sheet.
    common: FileGuess  #: What they have in common.

    @property
    def files(self) -> list[Path]:
        """The files of the runs."""
        return [guess.contents.path for guess in self.guesses]

    @property
    def contents(self) -> FileContents:
        """The contents of the first file, which stands for all."""
        return self.common.contents

    def document(self, folder: Path) -> dict[str, Any]:
        """Return the description made from guesses and answers; CampaignError if some are missing.

        folder: The campaign's.
        """
        common, answers = self.common, self.complete()
        sense, place = answers["sense"], folder.resolve()
        document: dict[str, Any] = {
            "schema": 1,
            "campaign": {"title": place.name},
            "site": {"gravity": answers["gravity"], "latitude": answers["latitude"]},
            "centrifuge": {"radius": answers["radius"]},
            "records": _records(common, answers, sense),
            "accelerometers": _accelerometers(common),
        }
        return document | {"runs": list(_runs(self.guesses, answers, sense, place, []))}


def draft(all_contents: Sequence[FileContents], answers: Mapping[str, str] | None = None) -> Draft:
    """Return a draft from a recorder's files, one for each run, and the open questions.

    answers: By the keys of questions; they take precedence over guesses.
    """
    if not all_contents:
        raise UsageError("init", ["give the run files"])

    def seen(taken: Mapping[str, str]) -> tuple[tuple[FileGuess, ...], FileGuess]:
        guesses = tuple(guess_file(contents, taken) for contents in all_contents)
        return guesses, complete_guess(common_guess(guesses), taken)

    def asked(taken: Mapping[str, str]) -> tuple[FileQuestion, ...]:
        _, common = seen(taken)
        return tuple(questions_of(common, taken.get("sense") or waves_sense(common), taken))

    taken, problems = validate_answers(answers, asked)
    guesses, common = seen(taken)
    unfit = (f"{UNFIT}: {why}" for contents in all_contents if (why := _unfit(contents)))
    shown = waves_sense(common_guess(guesses))
    problems = (*unfit, *problems, *_against_waves(taken.get("sense"), shown))
    questions = asked(taken)
    statements = tuple(_statements(common, shown))
    return Draft(statements, questions, taken, problems, guesses, common)


def _against_waves(sense: str | None, shown: str | None) -> Iterator[str]:
    """Yield errors of the answered sense, which the waves contradict."""
    if sense is not None and shown is not None and sense != shown:
        yield (
            f"sense: the periodic signals of two axes show that the angle increases {shown}. If "
            "the angle does not increase in this sense, the direction of one axis is wrong, for "
            "example east instead of west"
        )


def _unfit(contents: FileContents) -> str:
    """Return why a file cannot be a run's record as it is written; empty text if it can."""
    rows = contents.rows
    if rows < _FEWEST_ROWS:
        return (
            f"{contents.path.name} has {rows} rows of numbers in {len(contents.columns)} "
            "columns, which is too few for the record of a run. Export one row per sample and "
            "one column per quantity. If the file is a table of readings, select the test type "
            "for readings"
        )
    for name, cells in contents.first_words.items():
        kinds = len(set(cells))
        if 1 < kinds < len(cells) / 2 and cells[kinds:] == cells[:-kinds]:
            return (
                f"several quantities share a column in {contents.path.name}: the values in "
                f"column '{name}' alternate between {', '.join(cells[:kinds][:4])}. Export "
                "each quantity as a separate column"
            )
    return ""


#: What the files of a test show.
AnyDraft = Draft | TumbleDraft | ArmDraft | PosesDraft


def make_draft(
    all_contents: Sequence[FileContents], answers: Mapping[str, str], test: Test
) -> AnyDraft:
    """Return a draft from the files of a test."""
    makers: dict[Test, Callable[..., AnyDraft]] = {
        "double-turntable": draft,
        "tumble": tumble_draft,
        "arm": arm_draft,
        "poses": poses_draft,
    }
    return makers[test](all_contents, answers)


def write_description(draft: AnyDraft, folder: Path) -> Path:
    """Write the description into the campaign's folder, with the guesses as comments."""
    target = folder / DESCRIPTION_NAME
    if target.exists():
        raise ExistingFileError(f"{target} already exists; edit it, or choose another folder")
    document = draft.document(folder)
    problems = Problems(document)
    new = not folder.exists()
    make_folder(folder)  # first: names such as ../run1.csv lead on from a folder that is there
    if resolve_campaign(document, target, problems) is None:
        if new:
            folder.rmdir()
        raise CampaignError("init", problems.lines)
    names = ", ".join(file.name for file in draft.files)
    head = [f"Campaign created from {names}.", "Detected in the files (please check):"]
    head += [f"- {statement}" for statement in draft.statements]
    comments = {
        "site": '± standard uncertainty (k = 1), for example "9.8066 ± 1e-5 m/s^2"',
        "accelerometers": 'If known: bias = "0.005 ± 2e-6 g", and scale_factor in the same form',
        "records": "docs/campaign.md explains every key",
        "readings": "docs/readings.md explains every key",
    }
    text = "".join(f"# {line}\n" for line in head) + format_document(document, comments)
    write_text(target, text)
    return target


def further_runs(
    files: Sequence[Path], document: Mapping[str, Any], folder: Path
) -> list[dict[str, Any]]:
    """Return runs of a description for further files, each at the rate that its file shows.

    document: The description; the files are read in the same way as those that it has.
    """
    records, runs = document.get("records", {}), document.get("runs", [])
    time, angle = records.get("time") or {}, records.get("angle") or {}
    told = {
        "time": time.get("column", NONE),
        "time unit": time.get("unit"),
        "sampling_rate": time.get("sampling_rate"),
        "angle": angle.get("column", NONE),
        "angle unit": angle.get("unit"),
        "per_revolution": angle.get("per_revolution"),
    }
    told = {key: str(value) for key, value in told.items() if value is not None}
    sense = angle.get("sense", SENSES[0])
    if (not angle or angle.get("pulses")) and str(runs[0]["rate"]).startswith("-"):
        sense = SENSES[1]  # nothing counts down, and the centrifuge turns as it did
    guesses = [guess_file(contents, told) for contents in read_files(files)]
    for guess in guesses:
        if guess.rate is None or not (guess.time or guess.sampling):
            raise CounterspinError(
                f"{guess.contents.path}: the rate of the centrifuge cannot be determined from "
                "the file; add the run to the description",
                code="missing-answer",
            )
    names = [run["name"] for run in runs]
    return list(_runs(guesses, {}, sense, folder.resolve(), names))


def _runs(
    guesses: Sequence[FileGuess],
    answers: Mapping[str, str],
    sense: str,
    place: Path,
    names: list[str],
) -> Iterator[dict[str, Any]]:
    """Yield the run of each file under a name that is not among `names`, and add the name."""
    for guess in guesses:
        name = Path(unused_file_name(guess.contents.title, "", names)).name
        names.append(name)
        run: dict[str, Any] = {
            "name": name,
            "rate": _rate(guess, answers, sense),
            "record": relative_name(guess.contents.path, place),
        }
        keys = guess.contents.dialect_keys
        yield run | ({"records": keys} if keys else {})


# What is said


def _statements(common: FileGuess, sense: str | None) -> Iterator[str]:
    time, angle = common.time, common.angle
    yield from common.sampling_words
    if time is not None:
        unit = "time stamps" if time.unit == "iso" else f"in {time.unit or 'an unknown unit'}"
        yield f"time: column '{time.column}', {unit}"
    if common.rate is not None:
        turns = common.rate / (2.0 * math.pi)
        counted = not (time or common.sampling)
        yield "rate: " + (
            (f"{1 / turns:.6g} rows per revolution") if counted else f"{turns:.6g} rev/s"
        )
    if angle is None:
        yield "angle: no angle column was found, so counterspin uses the nominal rates"
    elif angle.pulses:
        yield f"angle: column '{angle.column}' contains pulse times, one pulse per revolution"
    else:
        counts = f", {angle.per_revolution:.10g} per revolution" if angle.per_revolution else ""
        source = "from the unit in the file" if angle.known else "from the column name or values"
        unit = angle.unit or "an unknown unit"
        yield f"angle: column '{angle.column}', in {unit}{counts} ({source})"
    if sense is not None and angle is not None:
        yield f"sense: {sense}, determined from the phase difference between two axes"
    yield from common.temperature_words
    for signal in common.signals:
        what = (signal.observable or "a signal").replace("_", " ")
        axis = f"along {signal.axis}" if signal.axis else "axis not detected"
        unit = f" in {signal.unit}" if signal.unit else ""
        unit += " (determined from the radius)" if signal.by_radius else ""
        yield f"column '{signal.column}': {what}{unit}, {axis}"
    if common.signals:
        yield "pendulous axes: assumed down (north if the input axis points up)"
    if common.unused:
        yield f"not used: {', '.join(common.unused[:20])}"


# What follows


def _records(common: FileGuess, answers: Mapping[str, str], sense: str) -> dict[str, Any]:
    records: dict[str, Any] = {}
    if common.time is None:
        stated = answers.get("sampling_rate") or f"{common.sampling:.12g} Hz"
        records["time"] = {"sampling_rate": stated}
    else:
        records["time"] = {"column": common.time.column, "unit": common.time.unit}
    records |= common.temperature_table
    angle = common.angle
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
    zero = _zero(common, sense)
    if zero is not None and zero != "east":
        table["zero"] = zero
    return records | {"angle": table}


def _zero(common: FileGuess, sense: str) -> str | None:
    """Return the arm's direction at the encoder's zero, from the wave along a horizontal axis."""
    turned = 1.0 if sense == SENSES[0] else -1.0
    forward = turned if common.rising else -turned
    for signal in common.signals:
        axis = signal.axis
        if signal.phase is None or axis not in COMPASS_ANGLES:
            continue
        derivatives = list(OBSERVABLES).index(signal.observable or "displacement")
        ahead = signal.phase - turned * forward * derivatives * math.pi / 2.0
        zero = turned * ahead + COMPASS_ANGLES[axis]
        for name, direction in COMPASS_ANGLES.items():
            if abs(math.remainder(zero - direction, 2.0 * math.pi)) < _POINTING_ANGLE:
                return name
        return f"{math.degrees(math.remainder(zero, 2.0 * math.pi)):.4f} deg"
    return None


def _accelerometers(common: FileGuess) -> dict[str, Any]:
    tables: dict[str, Any] = {}
    for signal in common.signals:
        assert signal.axis is not None
        assert signal.observable is not None
        name, number = _NAMES[signal.axis], 2
        while name in tables:
            name, number = f"{_NAMES[signal.axis]}{number}", number + 1
        tables[name] = {
            "input_axis": signal.axis,
            "pendulous_axis": "north" if signal.axis in ("up", "down") else "down",
            signal.observable: {"column": signal.column, "unit": signal.unit},
        }
    return tables


def _rate(guess: FileGuess, answers: Mapping[str, str], sense: str) -> str:
    """Return the rate of a run, rounded if it is close to a round number."""
    if guess.rate is None:
        return answers["rate"]
    along = sense == SENSES[0]
    counts = guess.angle is not None and not guess.angle.pulses
    sign = 1.0 if along == (guess.rising or not counts) else -1.0
    size = guess.rate
    for unit, factor in (("rev/s", 2.0 * math.pi), ("deg/s", math.pi / 180.0), ("rad/s", 1.0)):
        value = size / factor
        near = float(np.format_float_positional(value, precision=3, fractional=False))
        if abs(near / value - 1.0) < _ROUND_RATE_PART:
            return f"{sign * near:g} {unit}"
    return f"{sign * size:.8g} rad/s"

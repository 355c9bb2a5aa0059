"""Campaigns from uploaded exports: columns with detrended curves, questions, descriptions."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np

from counterspin.application.desk import Desk, FileCache, export_command
from counterspin.arrays import Array, median
from counterspin.campaign.documents import DESCRIPTION_NAME, load_document, table_of
from counterspin.campaign.settings import OBSERVABLES
from counterspin.errors import CampaignError, CounterspinError
from counterspin.frozen import frozen
from counterspin.ingest.column_roles import FileGuess, counts_rows
from counterspin.ingest.contents import FileColumn, FileContents, read_files
from counterspin.ingest.description import AnyDraft, Draft, write_description
from counterspin.ingest.description import drafted as described_as
from counterspin.ingest.overview import (
    TESTS,
    UndecidedDraft,
    likely_test,
    overview,
    sensor_question,
)
from counterspin.ingest.starter import Test
from counterspin.ingest.tumble import TumbleDraft
from counterspin.units import converts

_CONTENTS: Final = FileCache(2)
#: Rows, and parts of a curve, that are shown before a campaign is written.
_PREVIEW_ROWS: Final = 4
_PREVIEW_PARTS: Final = 160
#: Revolutions of a wave that are shown.
_SHOWN_TURNS: Final = 4.0
#: Relative difference between steps of a time that comes from the rounding of its numbers.
_ROUNDING: Final = 1e-6
#: Words of a column of text that are shown, and characters of each.
_SHOWN_WORDS: Final = 3
_SHOWN_CHARACTERS: Final = 20
#: Unit of a quantity that is asked for -> units of its menu.
UNITS: Final[Mapping[str, tuple[str, ...]]] = {
    "m": ("m", "mm", "um", "in"),
    "m/s^2": ("m/s^2", "mm/s^2"),
    "rad": ("deg", "rad", "arcmin"),
    "rad/s": ("rev/s", "rpm", "deg/s", "rad/s"),
    "Hz": ("Hz", "kHz"),
}
#: Question -> section and key of the description that holds its answer.
_SITE: Final = {
    "gravity": ("site", "gravity"),
    "latitude": ("site", "latitude"),
    "radius": ("centrifuge", "radius"),
}


def _draft(
    desk: Desk, names: Sequence[str], answers: dict[str, str] | None, stated: Test | None
) -> tuple[AnyDraft | UndecidedDraft, Test | None, list[str]]:
    files = [desk.file(name) for name in names]
    said = {key: answer for key, answer in (answers or {}).items() if answer.strip()}
    choice = (said.get("sheet", ""), said.get("select", ""))
    all_contents = _CONTENTS.get((*choice, *files), files, lambda: read_files(files, said))
    seen = overview(all_contents)
    chosen = said.pop("test", None)
    if sensor_question(all_contents) is not None:
        return UndecidedDraft.of(all_contents), None, seen
    said.pop("select", None)
    test = stated or next((test for test in TESTS if test == chosen), likely_test(all_contents))
    if test is None:
        return UndecidedDraft.of(all_contents), None, seen
    return described_as(all_contents, said, test), test, seen


def draft_overview(
    desk: Desk,
    names: list[str],
    answers: dict[str, str] | None = None,
    test: Test | None = None,
) -> dict[str, Any]:
    """Return the contents of files in sentences and columns, the questions and the mistakes."""
    draft, found_test, seen = _draft(desk, names, answers, test)
    guess = draft.common if isinstance(draft, Draft) else None
    questions = [
        vars(question) | {"units": UNITS.get(question.quantity, ())} for question in draft.questions
    ]
    return {
        "test": found_test,
        "statements": [*seen, *draft.statements],
        "questions": questions,
        "problems": list(draft.problems),
        "file": draft.contents.path.name,
        "runs": len(draft.guesses) if isinstance(draft, Draft) else None,
        "columns": [
            *(_text_column(draft.contents, name) for name in draft.contents.others),
            *(_number_column(column, guess) for column in draft.contents.columns),
        ],
        "directions": draft.directions if isinstance(draft, TumbleDraft) else [],
        "remembered": remembered_site(desk),
    }


def _text_column(contents: FileContents, name: str) -> dict[str, Any]:
    """Return the first cells of a column without numbers, and why it is unused."""
    cells = contents.words.get(name) or contents.first_words.get(name, ())
    words = list(dict.fromkeys(cell[:_SHOWN_CHARACTERS] for cell in cells if cell))
    reason = "Empty in every row."
    if words:
        more = " ..." if len(words) > _SHOWN_WORDS else ""
        reason = f"Text, not numbers: {', '.join(words[:_SHOWN_WORDS])}{more}"
    spoilt = next((why for why in contents.spoilt if f"'{name}'" in why), None)
    return {
        "name": name,
        "first": list(cells[:_PREVIEW_ROWS]),
        "curve": None,
        "reason": reason if spoilt is None else spoilt,
    }


def _number_column(column: FileColumn, guess: FileGuess | None) -> dict[str, Any]:
    """Return the first values of a column, its detrended curve, and why it may be unused."""
    return {
        "name": column.name,
        "first": ["" if np.isnan(v) else f"{v:.9g}" for v in column.values[:_PREVIEW_ROWS]],
        "curve": vars(curve_of(column, guess)),
        "role": "temperature" if (column.name,) == _thermometer(guess) else "",
        "reason": _reason(column, guess),
    }


def _thermometer(guess: FileGuess | None) -> tuple[str, ...]:
    """Return the name of the temperature's column; empty without one."""
    return guess.temperature[:1] if guess and guess.temperature else ()


def _reason(column: FileColumn, guess: FileGuess | None) -> str:
    """Return why a column of numbers is unused, if it is."""
    values = column.values[np.isfinite(column.values)]
    if column.stamps:
        return "Contains time stamps in addition to the time."
    if values.min() == values.max():
        return f"Constant: {values[0]:.6g} in every row."
    if counts_rows(column):
        return "Counts the rows."
    if column.unit and not any(converts(column.unit, si) for si in OBSERVABLES.values()):
        return f"Its unit, {column.unit}, is not that of a signal."
    if guess is not None:
        return "Does not vary with the rotation, and its name is not that of a signal."
    return "Neither its name nor its unit identifies the quantity."


@frozen
class Curve:
    """A drawing of a column: the least and greatest value of each part."""

    extent: list[tuple[float, float] | None]  #: None for a part without numbers.
    words: str  #: What was subtracted, and which part is shown.
    size: float  #: Half of the range.
    unit: str  #: Of the range; empty where it is unknown.


def curve_of(column: FileColumn, guess: FileGuess | None) -> Curve:
    """Return the curve of a column with the trend of its role subtracted.

    guess: The roles of a record's columns; None for a table of readings.
    """
    values, words, unit = column.values, "all rows", column.unit
    if guess is not None:
        signal = next((s for s in guess.signals if s.column == column.name), None)
        if guess.time is not None and guess.time.column == column.name:
            values, words = _steps(values), "step from row to row"
            unit = "s" if guess.time.unit == "iso" else guess.time.unit or ""
        elif guess.angle is not None and guess.angle.column == column.name:
            if guess.angle.pulses:
                values, words = _steps(values), "step from pulse to pulse"
            else:
                values, words = _detrended(_unwrapped(values), 1), "minus a straight line"
            unit = guess.angle.unit or ""
        elif signal is not None:
            degree = {"displacement": 2, "velocity": 1}.get(signal.observable or "", 0)
            rows = _rows_of_turns(column, guess)
            trend = ("mean", "straight line", "parabola")[degree]
            part = "" if rows >= len(values) else f", first {_SHOWN_TURNS:g} revolutions"
            turns = _SHOWN_TURNS if rows < len(values) else 0.0
            values, words = _detrended(values[:rows], degree, turns), f"minus its {trend}{part}"
            unit = signal.unit or ""
    extent, size = _extremes(values)
    return Curve(extent, words, size, unit)


def _rows_of_turns(column: FileColumn, guess: FileGuess) -> int:
    """Return the number of rows in which the centrifuge turns a few times; all if unknown."""
    rows, step = len(column.values), 1.0 / (guess.sampling or 1.0)
    if guess.time is not None:
        time = next(c for c in guess.contents.columns if c.name == guess.time.column)
        steps = np.diff(time.values[np.isfinite(time.values)])
        if not (steps > 0.0).any():
            return rows
        step = guess.time.factor * median(steps[steps > 0.0])
    if not guess.rate:
        return rows
    return int(min(rows, max(16.0, _SHOWN_TURNS * 2.0 * np.pi / (guess.rate * step))))


def _unwrapped(values: Array) -> Array:
    """Return an angle without its jumps at the end of a revolution."""
    steps = np.diff(values)
    known = steps[np.isfinite(steps)]
    usual = median(known) if known.size else 0.0
    jumps = np.where(np.abs(steps - usual) > 10.0 * abs(usual), steps - usual, 0.0)
    return np.asarray(values - np.concatenate([[0.0], np.nancumsum(jumps)]), dtype=float)


def _steps(values: Array) -> Array:
    """Return the steps of a column from row to row, without the rounding of its numbers."""
    steps = np.diff(values)
    usual = float(np.nanmedian(steps))
    return np.asarray(
        np.where(np.abs(steps - usual) <= _ROUNDING * abs(usual), usual, steps), float
    )


def _detrended(values: Array, degree: int, turns: float = 0.0) -> Array:
    """Return values minus a polynomial that is fitted to them; unchanged with too few values.

    turns: Revolutions of a wave that is fitted with the polynomial, and stays; 0 without a wave.
    """
    known = np.isfinite(values)
    design = np.vander(np.linspace(-1.0, 1.0, len(values)), degree + 1)
    phase = np.linspace(0.0, 2.0 * np.pi * turns, len(values))
    waves = np.stack([np.cos(phase), np.sin(phase)], axis=1)
    both = np.hstack([design, waves]) if turns else design
    if known.sum() <= both.shape[1]:
        return values
    fitted = np.linalg.lstsq(both[known], values[known], rcond=None)[0]
    return np.asarray(values - design @ fitted[: degree + 1], dtype=float)


def _extremes(values: Array) -> tuple[list[tuple[float, float] | None], float]:
    """Return the least and greatest value of each part of a curve, and half of its range."""
    parts = np.array_split(values, max(1, min(_PREVIEW_PARTS, len(values))))
    known = [part[np.isfinite(part)] for part in parts]
    finite = values[np.isfinite(values)]
    half = float(finite.max() - finite.min()) / 2.0 if finite.size else 0.0
    return [(float(p.min()), float(p.max())) if p.size else None for p in known], half


def remembered_site(desk: Desk) -> dict[str, dict[str, str]]:
    """Return gravity, latitude and radius of the newest measured campaign that states them.

    A simulated campaign, which has true values, is skipped.
    """
    remembered: dict[str, dict[str, str]] = {}
    for name, document in _newest_descriptions(desk):
        for key, (section, entry) in _SITE.items():
            value = table_of(document, section).get(entry)
            if key not in remembered and isinstance(value, str):
                remembered[key] = {"answer": value, "campaign": name}
        if len(remembered) == len(_SITE):
            break
    return remembered


def _newest_descriptions(desk: Desk) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Yield folder and document of each measured campaign, the newest first."""
    paths = [
        folder / DESCRIPTION_NAME
        for folder, files in desk.folder.folders()
        if DESCRIPTION_NAME in files and desk.folder.holds(folder / DESCRIPTION_NAME)
    ]
    for path in sorted(paths, key=lambda path: -path.stat().st_mtime):
        try:
            document = load_document(path)
        except CounterspinError:
            continue
        if "truth" not in document:
            yield desk.folder.name(path.parent) or desk.folder.root.name, document


def begin_drafted(
    desk: Desk,
    folder: str,
    names: list[str],
    answers: dict[str, str] | None = None,
    test: Test | None = None,
) -> dict[str, Any]:
    """Write the campaign from files and answers; return its name and the command."""
    place = desk.place(folder)
    draft, found_test, _ = _draft(desk, names, answers, test)
    if isinstance(draft, UndecidedDraft) or found_test is None:
        raise CampaignError("init", [f"test: {draft.questions[0].text}"])
    write_description(draft, place)
    files = [desk.file(name) for name in names]
    command = export_command(place, files, dict(draft.answers), found_test)
    return {"name": desk.folder.name(place), "command": command}

"""Campaigns from uploaded files: columns with previews, questions and descriptions."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from counterspin.application.answers import (
    ColumnEntry,
    Curve,
    DraftOverview,
    QuestionEntry,
    RememberedAnswer,
    WrittenCampaign,
)
from counterspin.application.app_state import AppState, FileCache
from counterspin.application.commands import import_command
from counterspin.application.served_folder import RequestError
from counterspin.arrays import Array, median
from counterspin.campaign.documents import DESCRIPTION_NAME, load_document, table_of
from counterspin.campaign.quantity import normalize_latitude, parse_quantity
from counterspin.campaign.settings import OBSERVABLES
from counterspin.errors import CampaignError, CounterspinError
from counterspin.ingest.column_roles import FileGuess
from counterspin.ingest.column_values import is_row_counter
from counterspin.ingest.contents import FileColumn, FileContents, read_files
from counterspin.ingest.description import AnyDraft, Draft, write_description
from counterspin.ingest.description import make_draft as make_test_draft
from counterspin.ingest.overview import (
    TEST_LABELS,
    UndecidedDraft,
    describe_files,
    guess_test,
    make_sensor_question,
)
from counterspin.ingest.starter import Test
from counterspin.ingest.tumble import TumbleDraft
from counterspin.units import is_convertible

_FILE_CACHE: Final = FileCache(2)
#: Number of rows, and number of segments of a curve, in the preview of a column.
_N_PREVIEW_ROWS: Final = 4
_N_PREVIEW_SEGMENTS: Final = 160
#: Number of revolutions in the preview of a signal.
_N_CURVE_REVOLUTIONS: Final = 4.0
#: Relative tolerance of time steps, to allow for rounding of the times.
_STEP_RELATIVE_TOLERANCE: Final = 1e-6
#: Number of cells of a text column in a message, and number of characters of each.
_MAX_CELLS: Final = 3
_MAX_CELL_LENGTH: Final = 20
#: Unit of a requested quantity -> units of its menu.
UNIT_CHOICES: Final[Mapping[str, tuple[str, ...]]] = {
    "m": ("m", "mm", "um", "in"),
    "m/s^2": ("m/s^2", "mm/s^2"),
    "rad": ("deg", "rad", "arcmin"),
    "rad/s": ("rev/s", "rpm", "deg/s", "rad/s"),
    "Hz": ("Hz", "kHz"),
}
#: Question -> section and key of the answer in the description, and SI unit.
_SITE_ENTRIES: Final = {
    "gravity": ("site", "gravity", "m/s^2"),
    "latitude": ("site", "latitude", "rad"),
    "radius": ("centrifuge", "radius", "m"),
}


def _make_draft(
    app: AppState, names: Sequence[str], answers: dict[str, str] | None, requested_test: Test | None
) -> tuple[AnyDraft | UndecidedDraft, Test | None, list[str]]:
    if not names:
        raise RequestError("no file was chosen; choose at least one recorder file")
    files = [app.file(name) for name in names]
    given_answers = {key: answer for key, answer in (answers or {}).items() if answer.strip()}
    cache_key = (given_answers.get("sheet", ""), given_answers.get("select", ""))
    contents = _FILE_CACHE.get(
        (*cache_key, *files), files, lambda: read_files(files, given_answers)
    )
    descriptions = describe_files(contents)
    test_answer = given_answers.pop("test", None)
    if make_sensor_question(contents) is not None:
        return UndecidedDraft.from_contents(contents), None, descriptions
    given_answers.pop("select", None)
    selected_test = requested_test or next(
        (test for test in TEST_LABELS if test == test_answer), guess_test(contents)
    )
    if selected_test is None:
        return UndecidedDraft.from_contents(contents), None, descriptions
    return make_test_draft(contents, given_answers, selected_test), selected_test, descriptions


def draft_overview(
    app: AppState, names: list[str], answers: dict[str, str] | None = None, test: Test | None = None
) -> DraftOverview:
    """Return the detected contents of files, questions and mistakes."""
    draft, selected_test, descriptions = _make_draft(app, names, answers, test)
    file_guess = draft.common_guess if isinstance(draft, Draft) else None
    questions: list[QuestionEntry] = [
        {
            "key": question.key,
            "text": question.text,
            "example": question.example,
            "choices": question.choices,
            "guess": question.guess,
            "units": UNIT_CHOICES.get(question.quantity, ()),
        }
        for question in draft.questions
    ]
    return {
        "test": selected_test,
        "statements": [*descriptions, *draft.statements],
        "questions": questions,
        "problems": list(draft.problems),
        "file": draft.contents.path.name,
        "runs": len(draft.guesses) if isinstance(draft, Draft) else None,
        "columns": [
            *(_describe_text_column(draft.contents, name) for name in draft.contents.text_columns),
            *(_describe_number_column(column, file_guess) for column in draft.contents.columns),
        ],
        "directions": draft.directions if isinstance(draft, TumbleDraft) else [],
        "remembered": find_newest_site(app),
    }


def _describe_text_column(contents: FileContents, name: str) -> ColumnEntry:
    """Return the first cells of a text column, and the reason why it is unused."""
    cells = contents.text_cells.get(name) or contents.first_text_cells.get(name, ())
    distinct_cells = list(dict.fromkeys(cell[:_MAX_CELL_LENGTH] for cell in cells if cell))
    reason = "The column has no values."
    if distinct_cells:
        ellipsis = " ..." if len(distinct_cells) > _MAX_CELLS else ""
        cells_text = ", ".join(distinct_cells[:_MAX_CELLS]) + ellipsis
        reason = f"The column contains text, not numbers: {cells_text}"
    unread_reasons = (text for text in contents.unread_reasons if f"'{name}'" in text)
    return {
        "name": name,
        "first": list(cells[:_N_PREVIEW_ROWS]),
        "curve": None,
        "reason": next(unread_reasons, reason),
    }


def _describe_number_column(column: FileColumn, guess: FileGuess | None) -> ColumnEntry:
    """Return the first values of a column, its detrended curve, and why it may be unused."""
    return {
        "name": column.name,
        "first": ["" if np.isnan(v) else f"{v:.9g}" for v in column.values[:_N_PREVIEW_ROWS]],
        "curve": make_detrended_curve(column, guess),
        "reason": _unused_reason(column, guess),
    }


def _unused_reason(column: FileColumn, guess: FileGuess | None) -> str:
    """Return the reason why a numeric column may be unused."""
    values = column.values[np.isfinite(column.values)]
    if column.is_timestamp:
        return "The column contains timestamps, but the time is read from another column."
    if values.min() == values.max():
        return f"The value is {values[0]:.6g} in every row."
    if is_row_counter(column):
        return "The column contains row numbers."
    if column.unit and not any(
        is_convertible(column.unit, si_unit) for si_unit in OBSERVABLES.values()
    ):
        return f"The unit {column.unit} does not match a known signal."
    if guess is not None:
        return (
            "The column does not vary with the rotation, and the column name does not match a "
            "known signal."
        )
    return "Neither the name nor the unit of the column identifies the quantity."


def make_detrended_curve(column: FileColumn, file_guess: FileGuess | None) -> Curve:
    """Return the curve of a column with the trend expected for its role removed.

    file_guess: Roles of the columns of a record; None for a table of readings.
    """
    values, rows_text, unit = column.values, "all rows", column.unit
    if file_guess is not None:
        signal = next((s for s in file_guess.signals if s.column == column.name), None)
        if file_guess.time is not None and file_guess.time.column == column.name:
            values, rows_text = _smooth_steps(values), "row-to-row step"
            unit = "s" if file_guess.time.unit == "iso" else file_guess.time.unit or ""
        elif file_guess.angle is not None and file_guess.angle.column == column.name:
            if file_guess.angle.pulses:
                values, rows_text = _smooth_steps(values), "pulse-to-pulse step"
            else:
                values, rows_text = _detrend(_unwrap_angle(values), 1), "straight line removed"
            unit = file_guess.angle.unit or ""
        elif file_guess.temperature is not None and file_guess.temperature[0] == column.name:
            unit = file_guess.temperature[1]
        elif signal is not None:
            degree = {"displacement": 2, "velocity": 1}.get(signal.observable or "", 0)
            n_rows = _count_preview_rows(column, file_guess)
            trend_name = ("mean", "straight line", "parabola")[degree]
            rows_remark = (
                "" if n_rows >= len(values) else f", first {_N_CURVE_REVOLUTIONS:g} revolutions"
            )
            revolutions = _N_CURVE_REVOLUTIONS if n_rows < len(values) else 0.0
            values = _detrend(values[:n_rows], degree, revolutions)
            rows_text = f"{trend_name} removed{rows_remark}"
            unit = signal.unit or ""
    extent, half_range = _find_extrema(values)
    return {"extent": extent, "words": rows_text, "size": half_range, "unit": unit}


def _count_preview_rows(column: FileColumn, guess: FileGuess) -> int:
    """Return the number of rows of the previewed revolutions; all rows if the rate is unknown."""
    n_rows, sample_interval = len(column.values), 1.0 / (guess.sampling_rate or 1.0)
    if guess.time is not None:
        time_column = next(c for c in guess.contents.columns if c.name == guess.time.column)
        time_steps = np.diff(time_column.values[np.isfinite(time_column.values)])
        if not (time_steps > 0.0).any():
            return n_rows
        sample_interval = guess.time.factor * median(time_steps[time_steps > 0.0])
    if not guess.rate:
        return n_rows
    return int(
        min(n_rows, max(16.0, _N_CURVE_REVOLUTIONS * 2.0 * np.pi / (guess.rate * sample_interval)))
    )


def _unwrap_angle(values: Array) -> Array:
    """Return an unwrapped angle."""
    steps = np.diff(values)
    finite_steps = steps[np.isfinite(steps)]
    typical_step = median(finite_steps) if finite_steps.size else 0.0
    deviations = steps - typical_step
    jumps = np.where(np.abs(deviations) > 10.0 * abs(typical_step), deviations, 0.0)
    return np.asarray(values - np.concatenate([[0.0], np.nancumsum(jumps)]), dtype=float)


def _smooth_steps(values: Array) -> Array:
    """Return the differences between rows, with rounding errors of regular steps removed."""
    steps = np.diff(values)
    typical_step = float(np.nanmedian(steps))
    return np.asarray(
        np.where(
            np.abs(steps - typical_step) <= _STEP_RELATIVE_TOLERANCE * abs(typical_step),
            typical_step,
            steps,
        ),
        float,
    )


def _detrend(values: Array, degree: int, revolutions: float = 0.0) -> Array:
    """Return values minus a fitted polynomial; unchanged if there are too few values.

    revolutions: Number of periods of a sinusoid that is fitted together with the polynomial, but
        not subtracted; 0: no sinusoid.
    """
    is_finite = np.isfinite(values)
    polynomials = np.vander(np.linspace(-1.0, 1.0, len(values)), degree + 1)
    phase = np.linspace(0.0, 2.0 * np.pi * revolutions, len(values))
    harmonics = np.stack([np.cos(phase), np.sin(phase)], axis=1)
    columns = np.hstack([polynomials, harmonics]) if revolutions else polynomials
    if is_finite.sum() <= columns.shape[1]:
        return values
    coefficients = np.linalg.lstsq(columns[is_finite], values[is_finite], rcond=None)[0]
    return np.asarray(values - polynomials @ coefficients[: degree + 1], dtype=float)


def _find_extrema(values: Array) -> tuple[list[tuple[float, float] | None], float]:
    """Return minimum and maximum of each segment of a curve, and half of its range."""
    segments = np.array_split(values, max(1, min(_N_PREVIEW_SEGMENTS, len(values))))
    finite_segments = [segment[np.isfinite(segment)] for segment in segments]
    finite_values = values[np.isfinite(values)]
    half_range = float(np.ptp(finite_values)) / 2.0 if finite_values.size else 0.0
    return [
        (float(segment.min()), float(segment.max())) if segment.size else None
        for segment in finite_segments
    ], half_range


def find_newest_site(app: AppState) -> dict[str, RememberedAnswer]:
    """Return gravity, latitude and radius of the newest measured campaign that states them.

    Simulated campaigns, which have true values, are skipped.
    """
    paths = [
        folder / DESCRIPTION_NAME
        for folder, files in app.folder.folders()
        if DESCRIPTION_NAME in files and app.folder.contains(folder / DESCRIPTION_NAME)
    ]
    return app.cache.get(("site", *paths), paths, lambda: _read_newest_site(app, paths))


def _read_newest_site(app: AppState, paths: Sequence[Path]) -> dict[str, RememberedAnswer]:
    answers: dict[str, RememberedAnswer] = {}
    for name, document in _newest_descriptions(app, paths):
        for key, (section, entry, unit) in _SITE_ENTRIES.items():
            value = table_of(document, section).get(entry)
            if key not in answers and isinstance(value, str) and _is_quantity(value, unit):
                answers[key] = {"answer": value, "campaign": name}
        if len(answers) == len(_SITE_ENTRIES):
            break
    return answers


def _is_quantity(text: str, unit: str) -> bool:
    """Return whether a text is a quantity with the dimension of a unit."""
    try:
        parse_quantity(normalize_latitude(text) if unit == "rad" else text, unit)
    except ValueError:
        return False
    return True


def _newest_descriptions(
    app: AppState, paths: Sequence[Path]
) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Yield folder and document of each measured campaign, the newest first."""
    for path in sorted(paths, key=lambda path: -path.stat().st_mtime):
        try:
            document = load_document(path)
        except CounterspinError:
            continue
        if "truth" not in document:
            yield app.folder.name(path.parent) or app.folder.root.name, document


def write_draft(
    app: AppState,
    folder: str,
    names: list[str],
    answers: dict[str, str] | None = None,
    test: Test | None = None,
) -> WrittenCampaign:
    """Write the campaign for files and answers; return its name and the command."""
    target = app.target_path(folder)
    draft, selected_test, _ = _make_draft(app, names, answers, test)
    if isinstance(draft, UndecidedDraft) or selected_test is None:
        raise CampaignError("init", [f"test: {draft.questions[0].text}"], code="missing-answer")
    write_description(draft, target)
    files = [app.file(name) for name in names]
    command = import_command(target, files, dict(draft.answers), selected_test)
    return {"name": app.folder.name(target), "command": command}

"""Table of readings, in place of many ``[[runs]]``: each row becomes a run."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from counterspin.campaign.columns import Sense
from counterspin.campaign.documents import KeyPath, list_of, table_of, to_toml_value
from counterspin.campaign.field_types import parse_exact
from counterspin.campaign.quantity import HeadTurn, Quantity, parse_quantity
from counterspin.campaign.runs import ReadingAxes
from counterspin.campaign.settings import Output
from counterspin.campaign.validation import Problems, suggest_name
from counterspin.errors import InputError, OutOfRangeError, RecordError, error_code
from counterspin.frozen import frozen
from counterspin.physics.conditions import STATED_CONDITIONS
from counterspin.readings.cells import (
    BLANK,
    DECIMAL_COMMA_PATTERN,
    SENSE_WORDS,
    RateColumn,
    cell_text,
    is_empty,
    mounting_name,
    parse_number,
    replace_decimal_commas,
    to_seconds,
    unit_of_name,
    with_revolutions,
)
from counterspin.readings.entries import MAX_READINGS
from counterspin.readings.section import COLUMNS, TABLE_ENDINGS, MountingSettings, ReadingsSettings
from counterspin.records.dialect import Dialect
from counterspin.records.memory import iter_columns
from counterspin.units import is_same_unit, unit_factor

if TYPE_CHECKING:
    from counterspin.records.formats import StoredTable

#: Name of a table without a file in messages.
_MEMORY_TABLE_NAME: Final = "readings in memory"

#: Largest number of characters in a cell.
_MAX_CHARACTERS: Final = 1000

#: Keys that state the position or rate of a reading.
_STATION_KEYS: Final = {"rate", "attitude", "head", "input"}


def read_table(
    document: Mapping[str, Any],
    folder: Path,
    accelerometers: Mapping[str, Output | None],
    problems: Problems,
    checksums: dict[Path, str],
) -> Iterator[tuple[dict[str, Any], KeyPath]]:
    """Yield the rows of the table that ``[readings]`` names, as runs with their paths.

    Numbers become quantities and rotations; text remains text.
    """
    settings = problems.check(ReadingsSettings, document["readings"], ("readings",))
    if settings is None:
        return
    loaded_table = problems.collect(
        ("readings", "file"), load_table, folder / settings.file, settings.dialect
    )
    if loaded_table is None:
        return
    table, locations, checksums[folder / settings.file] = loaded_table
    frame = table.frame
    if frame.is_empty():
        problems.add(
            ("readings", "file"), f"{settings.file} has no rows below the header row", "no-rows"
        )
        return
    if settings.decimal is None and table.decimal == ",":
        problems.add(
            ("readings", "decimal"),
            f'is missing: {settings.file} has decimal commas; write decimal = ","',
            "missing-key",
        )
        return
    rows = ReadingsTable(settings, accelerometers, problems, document)
    rows.check_units(table.units)
    yield from rows.runs(frame.columns, frame.iter_rows(named=True), locations)


def load_table(path: Path, dialect: Dialect) -> tuple[StoredTable, list[str], str]:
    """Return a table, the locations of its rows, and its checksum.

    Raises ValueError if the file is not a table. Stated decimal commas are replaced by points.
    """
    from counterspin.records.formats import has_sheets, read_small_table

    if path.suffix.lower() not in TABLE_ENDINGS:
        raise InputError(
            f"{path.name}: the name of a readings table must end in {', '.join(TABLE_ENDINGS)}",
            "wrong-file-ending",
        )
    if dialect.sheet is not None and not has_sheets(path):
        raise InputError(f"{path.name}: only a workbook (.xlsx) has sheets", "conflicting-keys")
    try:
        table, locations, checksum = read_small_table(path, dialect)
    except RecordError as error:
        raise InputError(str(error).rstrip("."), error_code(error)) from error
    if (rows := table.frame.height) > MAX_READINGS:
        raise InputError(
            f"{path.name} has {rows} rows; a table of readings may have at most {MAX_READINGS}",
            "too-many-rows",
        )
    if dialect.decimal == ",":
        table = replace(table, frame=replace_decimal_commas(table.frame))
    return table, locations, checksum


def insert_readings(document: dict[str, Any], frame: Any, problems: Problems) -> None:
    """Insert the rows of a data frame into the runs of a document, using its [readings]."""
    raw = document.pop("readings", None)
    if not isinstance(raw, Mapping) or "file" in raw:
        reason = "names a file; omit this key" if isinstance(raw, Mapping) else "is missing"
        problems.add(
            ("readings",),
            f"{reason}: the table is given as a data frame, and `columns` assigns its columns",
        )
        return
    settings = problems.check(ReadingsSettings, {**raw, "file": _MEMORY_TABLE_NAME}, ("readings",))
    columns = {
        name: values.to_list() if hasattr(values, "to_list") else list(values)
        for name, values in iter_columns(_MEMORY_TABLE_NAME, frame)
    }
    if settings is None:
        return
    if len({len(values) for values in columns.values()}) != 1:
        problems.add(
            ("readings",),
            "the columns of the data frame differ in length, or the data frame has no columns",
            "wrong-shape",
        )
        return
    tables = table_of(document, "accelerometers")
    rows = (dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True))
    outputs = {name: _stated_output(table) for name, table in tables.items()}
    table = ReadingsTable(settings, outputs, problems, document)
    table.check_units({})
    new_runs = [run for run, _ in table.runs(list(columns), rows)]
    new_runs = to_toml_value(new_runs, ("readings",), problems.add)
    document["runs"] = [*list_of(document, "runs"), *new_runs]


def _stated_output(table: Any) -> Output | None:
    """Return the stated unit of an accelerometer's readings; None: not stated."""
    output = table.get("output") if isinstance(table, Mapping) else None
    unit = output.get("unit") if isinstance(output, Mapping) else None
    return Output.model_construct(unit=unit) if isinstance(unit, str) else None


@frozen
class ReadingsTable:
    """Conversion of the rows of a table to runs."""

    settings: ReadingsSettings  #: Section of the table.
    accelerometers: Mapping[str, Output | None]  #: Name -> unit of its readings.
    problems: Problems  #: Collector of errors.
    document: Mapping[str, Any]  #: Document with the section.

    def runs(
        self,
        names: Sequence[str],
        rows: Iterable[Mapping[str, Any]],
        locations: Sequence[str] | None = None,
    ) -> Iterator[tuple[dict[str, Any], KeyPath]]:
        """Yield the rows of a table as runs, with their paths.

        names: Column names of the table.
        locations: Locations of the rows; None: the rows are counted.
        """
        problems = self.problems
        n_errors, mountings = len(problems.lines), self.settings.mountings.values()
        if any(entry.reading for entry in mountings):
            self._check_mounting_columns(names)
        else:
            self.check_columns(names)
        if len(problems.lines) > n_errors:
            return
        mounting, last_mounting = self.columns.get("mounting"), None
        mounting = mounting if self.settings.merged else None
        for index, row in enumerate(rows):
            if not self.is_reading_row(row):
                continue
            location = f"row {index + 1}" if locations is None else locations[index]
            path: KeyPath = ("readings", f"{self.settings.file} {location}")
            n_errors = len(problems.lines)
            if any(isinstance(cell, str) and len(cell) > _MAX_CHARACTERS for cell in row.values()):
                problems.add(
                    path, f"a cell has more than {_MAX_CHARACTERS} characters", "file-too-large"
                )
                continue
            if mounting is not None and not is_empty(row[mounting]):
                last_mounting = row[mounting]
            cells = row if mounting is None else {**row, mounting: last_mounting}
            new_runs = []
            for view in self.mounting_views(row):
                new_runs.append(view.make_run(cells, index, path))
                if view is not self:
                    new_runs[-1]["name"] += f", {view.settings.mounting}"
            if len(problems.lines) == n_errors:
                yield from ((run, path) for run in new_runs)

    def is_reading_row(self, row: Mapping[str, Any]) -> bool:
        """Return whether a row contains a reading, or a placeholder of one.

        Many tables end with empty rows or remarks.
        """
        required_names = set(row)
        if _STATION_KEYS & self.columns.keys():
            views = self.mounting_views(row)
            required_names = set().union(*(view.required_columns for view in views))
        return not all(is_empty(row[column]) for column in required_names)

    @cached_property
    def required_columns(self) -> set[str]:
        """Columns of which each row with a reading fills at least one."""
        readings = self.value_columns("reading").values()
        stations = {self.columns[key] for key in _STATION_KEYS & self.columns.keys()}
        return stations.union(*readings)

    def mounting_views(self, row: Mapping[str, Any]) -> list[ReadingsTable]:
        """Return the table for each mounting of a row, if each mounting has its own column."""
        settings = self.settings
        entries = {name: entry for name, entry in settings.mountings.items() if entry.reading}
        # Not every mounting must have a reading at each rate; future readings are blank.
        filled_mountings = [
            name for name, entry in entries.items() if not is_empty(row.get(entry.reading or ""))
        ]
        return [
            replace(
                self,
                settings=settings.model_copy(
                    update={
                        "columns": {**settings.columns, **_mounting_columns(entry)},
                        "mounting": name,
                        "mountings": {name: entry.model_copy(update={"reading": None})},
                    }
                ),
            )
            for name, entry in entries.items()
            if name in filled_mountings or not filled_mountings
        ] or [self]

    @cached_property
    def columns(self) -> dict[str, str]:
        """Key -> column name, for keys with a single column."""
        columns = self.settings.columns
        return {
            key: name for key, name in columns.items() if isinstance(name, str) and key in COLUMNS
        }

    def value_columns(self, key: str) -> dict[str, list[str]]:
        """Return accelerometer -> columns of ``reading`` or ``u``."""
        return self._reading_columns if key == "reading" else self._u_columns

    @cached_property
    def _reading_columns(self) -> dict[str, list[str]]:
        # Without accelerometers, another error is reported.
        return self._resolve_columns("reading", islice(self.accelerometers, 1))

    @cached_property
    def _u_columns(self) -> dict[str, list[str]]:
        return self._resolve_columns("u", self._reading_columns)

    def _resolve_columns(self, key: str, owners: Iterable[str]) -> dict[str, list[str]]:
        columns = self.settings.columns.get(key)
        if columns is None:
            return {}
        if not isinstance(columns, dict):
            columns = dict.fromkeys(owners, columns)
        return {
            name: [value] if isinstance(value, str) else value for name, value in columns.items()
        }

    def check_columns(self, names: Sequence[str]) -> None:
        """Report errors of the configured columns."""
        path: KeyPath = ("readings", "columns")
        stated_columns, problems = self.settings.columns, self.problems
        for key, value in stated_columns.items():
            if key not in (*COLUMNS, "reading", "u"):
                hint = suggest_name(key, (*COLUMNS, "reading", "u"))
                problems.add((*path, key), f"unknown key{hint}", "unknown-key")
            elif key in COLUMNS and not isinstance(value, str):
                problems.add((*path, key), "must be the name of a single column", "wrong-type")
        if not stated_columns.get("reading"):
            problems.add(path, "reading is missing; give the column with the values", "missing-key")
            return
        self._check_quantities()
        if self.settings.mountings and not (self.settings.mounting or "mounting" in stated_columns):
            problems.add(
                path,
                "mounting is missing; give the column with the mounting of each reading",
                "missing-key",
            )
        is_static = self.settings.motion == "static" and "motion" not in stated_columns
        for key, motions in (("rate", ("arm", "counter-rotating")), ("amplitude", ("vibration",))):
            stated_motion = self.settings.motion if "motion" not in stated_columns else ""
            if stated_motion in motions and key not in stated_columns:
                problems.add(
                    path,
                    f"{key} is missing; give the column with the {key} of each reading",
                    "missing-key",
                )
        has_stated_position = self.settings.axes is not None or self.settings.attitude is not None
        if (
            is_static
            and not {"attitude", "input"} & set(stated_columns)
            and not has_stated_position
        ):
            problems.add(
                path,
                "attitude is missing; give the column with the position of each reading",
                "missing-key",
            )
        required_names = [*self.columns.values()]
        for key in ("reading", "u"):
            for owner, columns in self.value_columns(key).items():
                required_names += columns
                if owner not in self.accelerometers:
                    hint = suggest_name(owner, self.accelerometers)
                    problems.add(
                        (*path, key),
                        f'no accelerometer is named "{owner}"' + hint,
                        "unknown-accelerometer",
                    )
        self._check_existence(required_names, names)

    def _check_mounting_columns(self, names: Sequence[str]) -> None:
        """Report errors of tables with a column for each mounting."""
        columns = [entry.reading for entry in self.settings.mountings.values()]
        if len(self.accelerometers) != 1 or not all(columns) or "reading" in self.settings.columns:
            message = (
                "give `reading` for every mounting or for none; if `reading` is given, the "
                "table must have a single accelerometer, and readings.columns must not contain "
                "`reading`"
            )
            self.problems.add(("readings", "mountings"), message)
            return
        n_errors = len(self.problems.lines)
        self.mounting_views({})[0].check_columns(names)
        if len(self.problems.lines) > n_errors:
            return
        self._check_existence(
            [
                column
                for entry in self.settings.mountings.values()
                for column in _mounting_columns(entry).values()
            ],
            names,
        )

    def _check_existence(self, required_names: Iterable[str], names: Sequence[str]) -> None:
        """Report missing columns."""
        for column in dict.fromkeys(required_names):
            if column not in names:
                message = f'{self.settings.file} has no column "{column}"'
                self.problems.add(
                    ("readings", "columns"), message + suggest_name(column, names), "missing-column"
                )

    def _check_quantities(self) -> None:
        """Report invalid quantities and units of the section."""
        settings, problems = self.settings, self.problems
        problems.collect(("readings", "attitude_unit"), unit_factor, settings.attitude_unit, "rad")
        if "rate" in settings.columns:
            problems.collect(("readings", "rate_unit"), self._parse_rate, 1.0, settings.sense)
        units = [("u_attitude", "rad"), ("u_rate", "rad/s")]
        units += [("u", output.unit if output else "g") for output in self.accelerometers.values()]
        for key, unit in units:
            if (text := getattr(settings, key)) is not None:
                problems.collect(("readings", key), _check_uncertainty, text, unit)

    def check_units(self, units: Mapping[str, str]) -> None:
        """Report columns whose unit in the units row or name differs from the description."""
        described_units = {
            self.columns.get("attitude"): self.settings.attitude_unit,
            self.columns.get("head"): self.settings.attitude_unit,
            self.columns.get("rate"): self.settings.rate_unit,
            self.columns.get("u_rate"): self.settings.rate_unit,
            self.columns.get("amplitude"): self.settings.amplitude_unit,
            self.columns.get("u_amplitude"): self.settings.amplitude_unit,
            self.columns.get("bias_acceleration"): self.settings.amplitude_unit,
        }
        for key in ("reading", "u"):
            for view in self.mounting_views({}):
                for name, columns in view.value_columns(key).items():
                    output = self.accelerometers.get(name)
                    described_units |= dict.fromkeys(columns, output.unit if output else "g")
        for column, unit in described_units.items():
            row_unit = units.get(column or "")
            table_unit = row_unit or unit_of_name(column or "", unit)
            if table_unit and not is_same_unit(
                with_revolutions(table_unit), with_revolutions(unit)
            ):
                self.problems.add(
                    ("readings", "columns"),
                    f'{self.settings.file}: column "{column}" is in {table_unit} according to '
                    f"{'the units row' if row_unit else 'its name'}, but in {unit} according to "
                    "the description",
                    "unit-mismatch",
                )

    def make_run(self, row: Mapping[str, Any], index: int, path: KeyPath) -> dict[str, Any]:
        """Return a row as a run, and report its errors."""
        settings, columns = self.settings, self.columns

        def cell(key: str) -> Any:
            value = row[columns[key]] if key in columns else None
            return None if is_empty(value) else value

        run: dict[str, Any] = {"name": cell_text(cell("name")) or f"reading {index + 1}"}
        motion, rate = self._motion_and_rate(cell, (*path, "rate"))
        run["motion"] = motion
        if rate is not None:
            run["rate"] = rate
        run |= self._vibration(cell, path)
        head_reading = self._parse_number(cell("head"), (*path, "head"))
        if head_reading is not None:
            run["head"] = Quantity(head_reading, 0.0, settings.attitude_unit)
        mounting = run["mounting"] = mounting_name(cell("mounting")) or settings.mounting
        axes = {key: cell_text(cell(key)) for key in ("input", "pendulous") if cell(key)}
        stated_axes = self._stated_axes(motion, mounting)
        if axes:
            run["axes"] = axes
        elif stated_axes is not None and (motion != "static" or "attitude" not in columns):
            run["axes"] = stated_axes.model_dump(include={"input", "pendulous"})
        elif settings.mountings and (motion != "static" or self._has_only_mountings):
            hint = suggest_name(mounting, settings.mountings)
            self.problems.add(
                path, f'readings.mountings does not contain "{mounting}"{hint}', "unknown-mounting"
            )
        attitude = settings.attitude if cell("attitude") is None else cell("attitude")
        if "axes" in run or attitude is None:
            pass
        elif (angle := parse_number(attitude)) is not None:
            run["attitude"] = self._head_turn(angle)
        else:
            run["attitude"] = self._attitude(cell_text(attitude))
        for key, unit in STATED_CONDITIONS.items():
            if (value := cell(key)) is not None:
                if key == "time":
                    value = self._time(value, (*path, key))
                number = parse_number(value)
                run[key] = cell_text(value) if number is None else Quantity(number, 0.0, unit)
        readings = self.value_columns("reading")
        run["reading"] = {name: self._reading(row, name, path) for name in readings}
        return run

    @property
    def _has_only_mountings(self) -> bool:
        """Whether nothing else states the axes of readings at rest."""
        return not {"attitude", "input"} & self.columns.keys() and not self.settings.attitude

    def _motion_and_rate(
        self, cell: Callable[[str], Any], path: KeyPath
    ) -> tuple[str, Quantity | None]:
        """Return the motion of a row, and its rate; None for a row at rest."""
        rate_cell, motion = cell("rate"), cell_text(cell("motion")) or self.settings.motion
        if rate := self._parse_number(rate_cell, path):
            sense = cell_text(cell("sense")).lower() or self.settings.sense
            if sense not in SENSE_WORDS:
                message = f"'{sense}' is not one of {', '.join(SENSE_WORDS)}"
                self.problems.add((*path[:-1], "sense"), message, "unknown-choice")
                return motion, None
            u = self._parse_number(cell("u_rate"), (*path[:-1], "u_rate"))
            rate_args = rate, SENSE_WORDS[sense], u
            return motion, self.problems.collect(path, self._parse_rate, *rate_args)
        if motion != "arm" or "motion" in self.columns:
            return motion, None
        if rate_cell is None:
            text = "is missing: a reading on an arm requires a rate; write 0 for readings at rest"
            self.problems.add(path, text, "missing-value")
        return "static", None

    def _vibration(self, cell: Callable[[str], Any], path: KeyPath) -> dict[str, Quantity]:
        """Return amplitude and bias acceleration of a row that has them."""
        if {"amplitude", "u_amplitude", "bias_acceleration"}.isdisjoint(self.columns):
            return {}
        unit = self.settings.amplitude_unit
        u = self._parse_number(cell("u_amplitude"), (*path, "u_amplitude")) or 0.0
        return {
            key: Quantity(number, u if key == "amplitude" else 0.0, unit)
            for key in ("amplitude", "bias_acceleration")
            if (number := self._parse_number(cell(key), (*path, key))) is not None
        }

    def _stated_axes(self, motion: str, mounting: str) -> ReadingAxes | None:
        """Return the axes that the section states for a row."""
        settings = self.settings
        axes_at_rest = settings.axes_at_rest if motion == "static" else None
        return settings.mountings.get(mounting) or axes_at_rest or settings.axes

    def _parse_rate(self, number: float, sense: Sense, u: float | None = None) -> Quantity:
        """Return a rate from its cell and that of its uncertainty; ValueError if it is not one."""
        magnitude, u_rate, unit = self._rate_column.read(number, u)
        return Quantity(-magnitude if sense == "clockwise" else magnitude, u_rate, unit)

    @cached_property
    def _rate_column(self) -> RateColumn:
        return RateColumn(self.settings, self.document)

    def _head_turn(self, angle: float) -> HeadTurn:
        """Return the rotation of the dividing head by an angle."""
        return HeadTurn(
            Quantity(angle, self._u_attitude, self.settings.attitude_unit), self.settings.about
        )

    def _attitude(self, text: str) -> HeadTurn | str:
        """Return an angle with its unit, such as 30°, as a rotation; other text is unchanged."""
        try:
            angle = parse_quantity(text, "rad")
        except ValueError:
            return text
        u = self._u_attitude * unit_factor(self.settings.attitude_unit, "rad")
        return HeadTurn(Quantity(angle.value, angle.u or u, "rad"), self.settings.about)

    def _time(self, value: Any, path: KeyPath) -> Any:
        """Return a date and time in seconds, and report a time of day without a date."""
        value = to_seconds(value)
        if isinstance(value, str) and ":" in value:
            text = f"{value!r} is not a date and time; write 2026-03-01 10:20:00, or seconds"
            self.problems.add(path, text, "not-numeric")
        return value

    @cached_property
    def _u_attitude(self) -> float:
        """Standard uncertainty of a head angle, in the unit of the angle."""
        unit, stated_u = self.settings.attitude_unit, self.settings.u_attitude
        return 0.0 if stated_u is None else parse_exact(stated_u, "rad") / unit_factor(unit, "rad")

    def _reading(self, row: Mapping[str, Any], name: str, path: KeyPath) -> Any:
        """Return the readings of an accelerometer: quantities for numbers, otherwise text."""
        columns = self.value_columns("reading")[name]
        unit = output.unit if (output := self.accelerometers[name]) else "g"
        u = self.u(row, name, path)
        cells: list[Quantity | str] = []
        for column in columns:
            value = row[column]
            if is_empty(value):
                # The number of repeats may differ between readings.
                continue
            number = parse_number(value)
            if number is None:
                self._check_decimal_comma(value, (*path, column))
            cell = cell_text(value) if number is None else Quantity(number, u or 0.0, unit)
            cells.append(cell)
        u_text = f" ± {u!r}" if u is not None else ""
        cells = cells or [f"{BLANK}{u_text} {unit}"] * len(columns)
        return cells[0] if len(columns) == 1 and cells else cells

    def u(self, row: Mapping[str, Any], name: str, path: KeyPath) -> float | None:
        """Return the stated uncertainty of a reading, in the unit of the output."""
        u_columns = self.value_columns("u").get(name, [])
        if u_columns and not is_empty(row[u_columns[0]]):
            return self._parse_number(row[u_columns[0]], (*path, u_columns[0]))
        output, u = self.accelerometers[name], self.settings.u
        return parse_exact(u, output.unit if output else "g") if u else None

    def _parse_number(self, value: Any, path: KeyPath) -> float | None:
        number = None if value is None else parse_number(value)
        if value is not None and number is None and not self._check_decimal_comma(value, path):
            self.problems.add(path, f"{value!r} is not a number", "not-numeric")
        return number

    def _check_decimal_comma(self, value: Any, path: KeyPath) -> bool:
        """Report a number with a decimal comma that is not configured."""
        has_comma = isinstance(value, str) and re.match(DECIMAL_COMMA_PATTERN, value) is not None
        if has_comma:
            message = 'has a decimal comma; write decimal = "," in [readings]'
            self.problems.add(path, f"{value!r} {message}", "missing-key")
        return has_comma


def _check_uncertainty(text: str, unit: str) -> None:
    if parse_exact(text, unit) < 0.0:
        raise OutOfRangeError("a standard uncertainty cannot be negative")


def _mounting_columns(mounting: MountingSettings) -> dict[str, str]:
    """Return key -> column of a mounting."""
    columns = {"reading": mounting.reading, "u": mounting.u}
    return {key: column for key, column in columns.items() if column}

"""A table of readings, in place of many ``[[runs]]``: each of its rows becomes such a run."""

from __future__ import annotations

import datetime
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

from pydantic import AfterValidator

from counterspin.campaign.checking import Path as KeyPath
from counterspin.campaign.checking import Problems, did_you_mean
from counterspin.campaign.columns import TableDialect
from counterspin.campaign.kinds import SettingsSection, Text, described, exact, file_name
from counterspin.campaign.readings import BLANK, ReadingAxes
from counterspin.campaign.resolved import MOST_READINGS
from counterspin.campaign.settings import Output
from counterspin.errors import RecordError
from counterspin.frozen import frozen
from counterspin.physics.station import MotionKind
from counterspin.records.dialect import Dialect
from counterspin.units import same_unit, unit_factor

if TYPE_CHECKING:
    from counterspin.records.tables import FiledTable

#: A column's name, or those of the repeats of one reading.
_Repeats = str | list[str]

#: No cell has more characters.
_MAX_CHARACTERS: Final = 1000

#: Columns that a table may have, beside those of the readings themselves.
_COLUMNS: Final = (
    "name",
    "motion",
    "rate",
    "attitude",
    "head",
    "input",
    "pendulous",
    "temperature",
    "time",
    "mounting",
)

#: A number whose decimals are parted by a comma.
_WITH_COMMA: Final = r"^\s*[+-]?\d*,\d+([eE][+-]?\d+)?\s*$"

_UTC: Final = datetime.UTC


class _TableFile(SettingsSection):
    file: Annotated[Text, AfterValidator(file_name)] = described(
        ".csv, .txt or .tsv (commas, semicolons or tabs), .parquet, or .xlsx "
        "([extra](quickstart.md#extras) `excel`)",
        "readings.csv",
    )


# The fields of the last base come first.
class ReadingsSettings(TableDialect, _TableFile):
    """[readings]: a table in place of many [[runs]]."""

    columns: dict[str, _Repeats | dict[str, _Repeats]] = described(
        "`name`, `motion`, `rate`, `attitude`, `head`, `input`, `pendulous`, `reading`, `u`, "
        "`temperature`, `time`, `mounting` -> column",
        {"attitude": "angle_deg", "reading": "mA"},
        min_length=1,
    )
    motion: MotionKind = described("of every row, where there is no such column", "arm", "static")
    about: Text = described("the axis of angles in the column `attitude`", "east", "north")
    attitude_unit: Text = described("of these angles, and of the column `head`", "arcmin", "deg")
    u_attitude: Text | None = described(
        'random standard uncertainty of these angles, such as `"2 arcsec"`',
        "2 arcsec",
        None,
        absent="0",
    )
    rate_unit: Text = described("of the column `rate`", "rpm", "rad/s")
    axes: ReadingAxes | None = described(
        "of every row that turns", {"input": "inward", "pendulous": "up"}, None, absent="`attitude`"
    )
    mounting: str = described("of every row", "in", "")
    attitude: Literal["unknown"] | None = described(
        "`unknown`: every row is a pose of a [triad](triads.md)", "unknown", None, absent="known"
    )


def read_table(
    raw: Any,
    folder: Path,
    accelerometers: Mapping[str, Output | None],
    problems: Problems,
    checksums: dict[Path, str],
) -> Iterator[tuple[dict[str, Any], KeyPath]]:
    """Yield the rows of the table that ``[readings]`` names, as runs, with where each stands."""
    settings = problems.check(ReadingsSettings, raw, ("readings",))
    if settings is None:
        return
    loaded = problems.attempt(
        ("readings", "file"), load_table, folder / settings.file, settings.dialect
    )
    if loaded is None:
        return
    table, places, checksums[folder / settings.file] = loaded
    frame = table.frame
    if frame.is_empty():
        problems.add(("readings", "file"), f"{settings.file} has no rows below the names")
        return
    if settings.decimal is None and table.decimal == ",":
        problems.add(
            ("readings", "decimal"),
            f'is missing: {settings.file} has decimal commas; write decimal = ","',
        )
        return
    if table.units:
        ReadingsTable(settings, accelerometers, problems).check_units(table.units)
    yield from runs_of(
        settings, frame.columns, frame.iter_rows(named=True), accelerometers, problems, places
    )


def runs_of(
    settings: ReadingsSettings,
    names: Sequence[str],
    rows: Iterable[Mapping[str, Any]],
    accelerometers: Mapping[str, Output | None],
    problems: Problems,
    places: Sequence[str] | None = None,
) -> Iterator[tuple[dict[str, Any], KeyPath]]:
    """Yield the rows of a table as runs, with where each stands.

    names: Of the table's columns.
    places: Where the rows stand; None: they are counted.
    """
    before = len(problems.lines)
    table = ReadingsTable(settings, accelerometers, problems)
    table.check(names)
    if len(problems.lines) > before:
        return
    for index, row in enumerate(rows):
        # Rows without anything in them stand below many a table.
        if all(is_empty(cell) for cell in row.values()):
            continue
        place = f"row {index + 1}" if places is None else places[index]
        path: KeyPath = ("readings", f"{settings.file} {place}")
        before = len(problems.lines)
        if any(isinstance(cell, str) and len(cell) > _MAX_CHARACTERS for cell in row.values()):
            problems.add(path, f"a cell has more than {_MAX_CHARACTERS} characters")
            continue
        run = table.run(row, index, path)
        if len(problems.lines) == before:
            yield run, path


def load_table(path: Path, dialect: Dialect) -> tuple[FiledTable, list[str], str]:
    """Return a table, where its rows stand, and its checksum; ValueError if it is none.

    Where it is said that decimals are parted by commas, its numbers have points.
    """
    from counterspin.records.tables import is_workbook, read_small_table

    if path.suffix.lower() not in (".csv", ".txt", ".tsv", ".parquet", ".xlsx"):
        raise ValueError(f"{path.name}: a table of readings is .csv, .parquet or .xlsx")
    if dialect.sheet is not None and not is_workbook(path):
        raise ValueError(f"{path.name}: only a workbook (.xlsx) has sheets")
    try:
        table, places, checksum = read_small_table(path, dialect)
    except RecordError as error:
        raise ValueError(str(error).rstrip(".")) from error
    if (rows := table.frame.height) > MOST_READINGS:
        raise ValueError(
            f"{path.name} has {rows} rows; a table of readings has at most {MOST_READINGS}"
        )
    if dialect.decimal == ",":
        table = replace(table, frame=_with_points(table.frame))
    return table, places, checksum


@frozen
class ReadingsTable:
    """How the columns of a table make runs."""

    settings: ReadingsSettings  #: The section.
    accelerometers: Mapping[str, Output | None]  #: Names, and what their readings are in.
    problems: Problems  #: Where mistakes are noted.

    @property
    def columns(self) -> dict[str, str]:
        """Key -> column, of what a row says once."""
        given = self.settings.columns
        return {k: v for k, v in given.items() if isinstance(v, str) and k in _COLUMNS}

    def of(self, key: str) -> dict[str, list[str]]:
        """Return accelerometer -> columns, of ``reading`` or of ``u``."""
        given = self.settings.columns.get(key)
        if given is None:
            return {}
        if not isinstance(given, dict):
            # Where no accelerometer is described, that is the mistake.
            given = dict.fromkeys(islice(self.accelerometers, 1), given)
        return {name: [c] if isinstance(c, str) else c for name, c in given.items()}

    def check(self, names: Sequence[str]) -> None:
        """Note what is wrong with the columns that are asked for."""
        path: KeyPath = ("readings", "columns")
        given, problems = self.settings.columns, self.problems
        for key, value in given.items():
            if key not in (*_COLUMNS, "reading", "u"):
                known = (*_COLUMNS, "reading", "u")
                problems.add((*path, key), "unknown key" + did_you_mean(key, known))
            elif key in _COLUMNS and not isinstance(value, str):
                problems.add((*path, key), "must be the name of one column")
        if not given.get("reading"):
            problems.add(path, "reading is missing: the column that holds the values")
            return
        if self.settings.u_attitude is not None:
            problems.attempt(("readings", "u_attitude"), exact, self.settings.u_attitude, "rad")
        problems.attempt(
            ("readings", "attitude_unit"), unit_factor, self.settings.attitude_unit, "rad"
        )
        static = self.settings.motion == "static" and "motion" not in given
        turns = self.settings.motion != "static" and "motion" not in given
        if turns and "rate" not in given:
            problems.add(path, "rate is missing: the column with the rate of each reading")
        stated = self.settings.axes is not None or self.settings.attitude is not None
        if static and not {"attitude", "input"} & set(given) and not stated:
            problems.add(path, "attitude is missing: the column with the position of each reading")
        wanted = [*self.columns.values()]
        for key in ("reading", "u"):
            for owner, columns in self.of(key).items():
                wanted += columns
                if owner not in self.accelerometers:
                    said = did_you_mean(owner, self.accelerometers)
                    problems.add((*path, key), f'no accelerometer is called "{owner}"' + said)
        for column in dict.fromkeys(wanted):
            if column not in names:
                said = did_you_mean(column, names)
                problems.add(path, f'{self.settings.file} has no column "{column}"' + said)

    def check_units(self, units: Mapping[str, str]) -> None:
        """Note columns that are in other units by the table's row of units."""
        stated = {
            self.columns.get("attitude"): self.settings.attitude_unit,
            self.columns.get("head"): self.settings.attitude_unit,
            self.columns.get("rate"): self.settings.rate_unit,
        }
        for key in ("reading", "u"):
            for name, columns in self.of(key).items():
                output = self.accelerometers.get(name)
                stated |= dict.fromkeys(columns, output.unit if output else "g")
        for column, unit in stated.items():
            own = units.get(column or "")
            if own and not same_unit(own, unit):
                self.problems.add(
                    ("readings", "columns"),
                    f'{self.settings.file}: column "{column}" is in {own} by the row of units, but '
                    f"in {unit} by the description",
                )

    def run(self, row: Mapping[str, Any], index: int, path: KeyPath) -> dict[str, Any]:
        """Return a row as a run would be written; mistakes are noted."""
        settings, columns = self.settings, self.columns

        def cell(key: str) -> Any:
            value = row[columns[key]] if key in columns else None
            return None if is_empty(value) else value

        run: dict[str, Any] = {"name": _words(cell("name")) or f"reading {index + 1}"}
        motion = run["motion"] = _words(cell("motion")) or settings.motion
        shown = self._number(cell("head"), (*path, "head"))
        if shown is not None:
            run["head"] = f"{shown!r} {settings.attitude_unit}"
        rate = self._number(cell("rate"), (*path, "rate"))
        if rate:
            run["rate"] = f"{rate!r} {settings.rate_unit}"
        axes = {key: _words(cell(key)) for key in ("input", "pendulous") if cell(key)}
        if axes:
            run["axes"] = axes
        elif settings.axes is not None and (motion != "static" or "attitude" not in columns):
            run["axes"] = settings.axes.model_dump()
        attitude = settings.attitude if cell("attitude") is None else cell("attitude")
        if "axes" in run or attitude is None:
            pass
        elif (angle := _as_number(attitude)) is not None:
            run["attitude"] = self._turn(angle)
        else:
            run["attitude"] = _words(attitude)
        run["mounting"] = _words(cell("mounting")) or settings.mounting
        for key, unit in (("temperature", "degC"), ("time", "s")):
            if (value := cell(key)) is not None:
                if key == "time":
                    value = _since_1970(value)
                number = _as_number(value)
                run[key] = _words(value) if number is None else f"{number!r} {unit}"
        readings = self.of("reading")
        run["reading"] = {name: self._reading(row, name, path) for name in readings}
        return run

    def _turn(self, angle: float) -> str:
        """Return the attitude that an angle of the head makes."""
        settings = self.settings
        unit = settings.attitude_unit
        if settings.u_attitude is None:
            return f"{angle!r} {unit} about {settings.about}"
        u = exact(settings.u_attitude, "rad") / unit_factor(unit, "rad")
        return f"{angle!r} ± {u!r} {unit} about {settings.about}"

    def _reading(self, row: Mapping[str, Any], name: str, path: KeyPath) -> str | list[str]:
        """Return the readings of an accelerometer as they would be written."""
        columns = self.of("reading")[name]
        unit = output.unit if (output := self.accelerometers[name]) else "g"
        beside = self.of("u").get(name, [])
        spread = ""
        if beside and not is_empty(row[beside[0]]):
            u = self._number(row[beside[0]], (*path, beside[0]))
            spread = f" ± {u!r}" if u is not None else ""
        written = []
        for column in columns:
            value = row[column]
            if is_empty(value):
                # Not all readings need have been repeated as often.
                continue
            number = _as_number(value)
            if number is None:
                self._refuse_comma(value, (*path, column))
            written.append(_words(value) if number is None else f"{number!r}{spread} {unit}")
        written = written or [f"{BLANK}{spread} {unit}"] * len(columns)
        return written[0] if len(columns) == 1 and written else written

    def _number(self, value: Any, path: KeyPath) -> float | None:
        number = None if value is None else _as_number(value)
        if value is not None and number is None and not self._refuse_comma(value, path):
            self.problems.add(path, f"{value!r} is not a number")
        return number

    def _refuse_comma(self, value: Any, path: KeyPath) -> bool:
        """Note a number whose decimals are parted by a comma, which nobody has said."""
        comma = isinstance(value, str) and re.match(_WITH_COMMA, value) is not None
        if comma:
            said = 'has a decimal comma; write decimal = "," in [readings]'
            self.problems.add(path, f"{value!r} {said}")
        return comma


def _with_points(frame: Any) -> Any:
    """Return a table whose numbers with a comma have a point; other text stays."""
    import polars as pl

    text = pl.col(pl.String())
    return frame.with_columns(
        pl.when(text.str.contains(_WITH_COMMA)).then(text.str.replace(",", ".")).otherwise(text)
    )


def is_empty(value: Any) -> bool:
    """Return whether a cell holds nothing, or what stands for a value to come."""
    if isinstance(value, str):
        return value.strip().lower() in ("", "nan", BLANK)
    return value is None or (isinstance(value, float) and math.isnan(value))


def _as_number(value: Any) -> float | None:
    """Return a cell as a number, None if it holds something else."""
    if isinstance(value, bool):
        return None
    try:
        number = float(value)
    except (TypeError, ValueError):
        return None
    return number if math.isfinite(number) else None


def _words(value: Any) -> str:
    """Return a cell as text; a whole number without its point."""
    if isinstance(value, float) and value.is_integer():
        return str(int(value))
    return "" if value is None else str(value).strip()


def _since_1970(value: Any) -> Any:
    """Return a date and time in seconds, of which only differences count; else the value."""
    if isinstance(value, str):
        try:
            value = datetime.datetime.fromisoformat(value.strip())
        except ValueError:
            return value
    if isinstance(value, datetime.datetime):
        return value.replace(tzinfo=value.tzinfo or _UTC).timestamp()
    return value

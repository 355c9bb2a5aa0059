"""Tables of readings on the arm of a centrifuge: column roles, mountings, radii and slopes."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from decimal import Decimal
from typing import Final

import numpy as np
import numpy.typing as npt

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.ingest.contents import FileColumn, FileContents
from counterspin.ingest.questions import FileQuestion
from counterspin.ingest.readings import WORD_ROLES, assign_roles, columns_of_role, guess_common_role
from counterspin.readings.cells import SENSE_WORDS, mounting_name
from counterspin.records.unit_notation import unit_in_name
from counterspin.units import STANDARD_GRAVITY, is_convertible, unit_factor

#: Directions in the frame of the arm; the horizontal ones in the order of a rotation about down.
HORIZONTAL: Final = ("inward", "forward", "outward", "backward")
DIRECTIONS: Final = (*HORIZONTAL, "up", "down")
#: Names of columns of rates, periods of revolution, mountings and radii.
_RATE_NAME: Final = re.compile(
    r"(?i)(.*[^a-z])?(rate|rpm|omega|w|n|speed|drehzahl|drehrate|drehfrequenz|u.?min|winkelgeschw)([^a-z]|$)"
)
_PERIOD_NAME: Final = re.compile(r"(?i).*(period|umlauf|t_?rev|rev_?time)")
_MOUNTING_NAME: Final = re.compile(
    r"(?i).*(pos|mount|orient|side|richtung|direction|lage|einbau|platz|stell|polar|vorzeich|aufspann)"
)
_RADIUS_NAME: Final = re.compile(r"(?i)(r|radi[ui]s?|arm|arm_?length|armlänge)([^a-z]|$)")
#: Names of measured values, in contrast to set values.
_MEASURED_NAME: Final = re.compile(r"(?i)(.*[^a-z])?(meas|actual|act|ist|gemessen|true)")
#: Pattern of a unit at the end of a column name -> unit of a rate.
_UNIT_BY_SUFFIX: Final = {
    r"rpm|u.?min|1.?min|rev.?min": "rpm",
    r"rad.?s": "rad/s",
    r"deg.?s|dps|°.?s": "deg/s",
    r"rev.?s|rps|hz": "rev/s",
}
#: Unit of revolutions per time -> unit as in `[readings]`.
_REVOLUTION_UNITS: Final = {"1/min": "rpm", "min^-1": "rpm", "Hz": "rev/s"}
#: Number at the end of a mounting's name, as in "in 1" and "out, 20 g".
_MOUNTING_SUFFIX: Final = re.compile(r"[\s_.,;:#-]*\d*([.,]\d+)?\s*g?$")
#: Boolean mask of rows, shape (n,).
RowMask = npt.NDArray[np.bool_]


@frozen(eq=False)
class ArmTable:
    """The columns of a table of readings, with the answers about their units."""

    contents: FileContents
    roles: Mapping[str, str]
    rate_column: FileColumn | None  #: Column of the rate; None: unknown.
    rate_unit: str | None  #: Unit of the rate; None: unknown.
    mounting_column: str | None  #: Name of the column of mountings; None: not in the table.
    row_mountings: tuple[str, ...]  #: Mounting of each row; empty if unnamed.

    @classmethod
    def from_contents(cls, contents: FileContents, answers: Mapping[str, str]) -> ArmTable:
        """Return a table with the roles of its columns."""
        roles = assign_arm_roles(contents, answers)
        rate_column = next(iter(columns_of_role(contents, roles, "rate")), None)
        rate_unit = answers.get("rate unit") or (
            _guess_rate_unit(rate_column) if rate_column else None
        )
        mounting_column = next((name for name, role in roles.items() if role == "position"), None)
        numbers = next(
            (column.values for column in contents.columns if column.name == mounting_column), None
        )
        cells: Sequence[str] = contents.text_cells.get(mounting_column or "", ())
        if numbers is not None:
            cells = ["" if math.isnan(number) else f"{number:.12g}" for number in numbers]
        n_rows = contents.rows
        cells = [*map(mounting_name, cells), *[""] * n_rows][:n_rows]
        # Remarks below a table contain no numbers.
        is_empty = np.ones(n_rows, dtype=bool)
        for column in filter(None, [rate_column, *columns_of_role(contents, roles, "reading")]):
            is_empty[: len(column.values)] &= np.isnan(column.values)
        row_mountings = ("" if empty else name for name, empty in zip(cells, is_empty, strict=True))
        return cls(contents, roles, rate_column, rate_unit, mounting_column, tuple(row_mountings))

    @property
    def readings(self) -> list[FileColumn]:
        """The columns of readings."""
        return columns_of_role(self.contents, self.roles, "reading")

    def values(self, column: FileColumn | None) -> Array:
        """Return the values of a column, NaN in rows without a value, shape (n,)."""
        values = np.full(len(self.row_mountings), np.nan)
        if column is not None:
            values[: len(column.values)] = column.values
        return values

    @property
    def is_resting(self) -> RowMask:
        """Mask of the rows in which the arm is at rest."""
        return np.asarray(self.values(self.rate_column) == 0.0)

    @property
    def rotating_mountings(self) -> tuple[str, ...]:
        """The mountings with readings at a rate."""
        rotating_rows = np.flatnonzero(np.nan_to_num(self.values(self.rate_column)))
        return tuple(dict.fromkeys(self.row_mountings[row] for row in rotating_rows))

    @property
    def mountings(self) -> tuple[str, ...]:
        """The names of all mountings."""
        return tuple(mounting for mounting in dict.fromkeys(self.row_mountings) if mounting)

    def is_rotating_in(self, mounting: str) -> RowMask:
        """Return the mask of the rows in which the arm rotates in a mounting."""
        return np.array(
            [row_mounting == mounting for row_mounting in self.row_mountings]
        ) & np.logical_not(self.is_resting)

    def radii(self) -> dict[str, list[float]]:
        """Return mounting -> different radii in the table, m; empty without a column of radii."""
        columns = columns_of_role(self.contents, self.roles, "radius")
        if not columns:
            return {}
        units = (columns[0].unit, unit_in_name(columns[0].name))
        unit = next((unit for unit in units if is_convertible(unit, "m")), "m")
        values = self.values(columns[0]) * unit_factor(unit, "m")
        is_rotating = np.nan_to_num(self.values(self.rate_column)) != 0.0
        radii_by_mounting: dict[str, dict[float, None]] = {}
        for row in np.flatnonzero(is_rotating & np.isfinite(values)).tolist():
            radii_by_mounting.setdefault(self.row_mountings[row], {})[float(values[row])] = None
        return {mounting: list(radii) for mounting, radii in radii_by_mounting.items()}

    def acceleration(self, radius: float) -> Array:
        """Return the centripetal acceleration of each row at a radius, m/s^2; NaN: unknown."""
        unit = _REVOLUTION_UNITS.get(self.rate_unit or "", self.rate_unit or "rad/s")
        rates = np.where(self.is_resting, 1.0, np.abs(self.values(self.rate_column)))
        if self.rate_unit is None:
            rates = rates * np.nan
        if is_convertible(unit, "m/s^2"):
            acceleration = rates * unit_factor(unit, "m/s^2", gravity=STANDARD_GRAVITY)
        elif is_convertible(unit, "s"):
            acceleration = radius * (2.0 * math.pi / (rates * unit_factor(unit, "s"))) ** 2
        else:
            acceleration = radius * (rates * unit_factor(unit, "rad/s")) ** 2
        return np.asarray(np.where(self.is_resting, 0.0, acceleration))

    def fit_lines(self, column: FileColumn, radius: float) -> tuple[dict[str, float], float]:
        """Fit readings linearly to the acceleration; return mounting -> slope, and the zero.

        Slopes (per g) and zero (output without acceleration) are in the column's unit; empty and
        NaN if unknown.
        """
        acceleration, readings = self.acceleration(radius) / STANDARD_GRAVITY, self.values(column)
        is_used = np.nan_to_num(acceleration * readings) != 0.0
        mountings = [
            mounting
            for mounting in self.rotating_mountings
            if np.any(is_used & self.is_rotating_in(mounting))
        ]
        if not mountings:
            return {}, math.nan
        columns = [
            np.where(self.is_rotating_in(mounting), acceleration, 0.0)[is_used]
            for mounting in mountings
        ]
        design = np.column_stack([np.ones(is_used.sum()), *columns])
        zero, *slopes = np.linalg.lstsq(design, readings[is_used], rcond=None)[0].tolist()
        return dict(zip(mountings, slopes, strict=True)), zero

    def rate_step(self) -> float:
        """Return the largest relative change of the force by the last digit of a rate."""
        rates = self.values(self.rate_column)
        magnitudes = np.abs(rates[np.nan_to_num(rates) != 0.0])
        if not len(magnitudes) or self.rate_unit is None:
            return 0.0
        exponents = (
            Decimal(repr(magnitude)).normalize().as_tuple().exponent
            for magnitude in magnitudes.tolist()
        )
        exponent = 1.0 if is_convertible(self.rate_unit, "m/s^2") else 2.0
        return float(exponent * 10.0 ** min(map(int, exponents)) / magnitudes.min())


def assign_arm_roles(contents: FileContents, answers: Mapping[str, str]) -> dict[str, str]:
    """Return the role of each column."""
    rate_columns = [column for column in contents.columns if _is_rate(column)]
    rate_columns.sort(key=_rate_rank)
    # A period of revolution, whatever its name, decreases in later rows.
    rate_columns += [
        column
        for column in contents.columns
        if guess_common_role(column) == "time" and _is_decreasing(column)
    ]
    direction_columns = [
        name for name, cells in contents.text_cells.items() if any(map(parse_direction, cells))
    ]
    sense_columns = [name for name, cells in contents.text_cells.items() if _contains_senses(cells)]
    # Names of mountings are repeated, names of rows are not.
    named_columns = [
        name
        for name, cells in contents.text_cells.items()
        if len(set(cells)) < len(cells) and _MOUNTING_NAME.match(name) and name not in sense_columns
    ]
    numbered_columns = [
        column.name for column in contents.columns if _MOUNTING_NAME.match(column.name)
    ]
    unique_roles = {
        "rate": rate_columns[0].name if rate_columns else None,
        "position": next(iter([*direction_columns, *named_columns, *numbered_columns]), None),
    }
    roles = assign_roles(contents, answers, _guess_role, unique_roles)
    unassigned_columns = [
        name for name in sense_columns if roles[name] in WORD_ROLES and f"{name} is" not in answers
    ]
    return roles | dict.fromkeys(unassigned_columns[:1], "sense")


def _rate_rank(column: FileColumn) -> tuple[bool, bool, bool]:
    """Return the sort key of a candidate for the rate; the smallest is preferred."""
    is_period, is_measured = _PERIOD_NAME.match(column.name), _MEASURED_NAME.match(column.name)
    return bool(is_period), not is_measured, _guess_rate_unit(column) is None


def _is_decreasing(column: FileColumn) -> bool:
    """Return whether the numbers of a column decrease between two rows."""
    values = column.values[np.isfinite(column.values)]
    return not column.is_timestamp and bool(np.any(np.diff(values) < 0.0))


def _contains_senses(cells: Sequence[str]) -> bool:
    """Return whether all cells state a sense of rotation."""
    words = {cell.lower() for cell in cells if cell}
    return bool(words) and words <= set(SENSE_WORDS)


def _guess_role(column: FileColumn) -> str:
    if _is_rate(column):
        return "rate"
    common_role = guess_common_role(column)
    if common_role != "reading":
        return common_role
    if is_convertible(column.unit, "m") or _RADIUS_NAME.match(column.name):
        return "radius"
    return "position" if _MOUNTING_NAME.match(column.name) else common_role


def _is_rate(column: FileColumn) -> bool:
    """Return whether a column is a rate or a period of revolution, by its unit or name."""
    unit = _REVOLUTION_UNITS.get(column.unit, column.unit)
    if _PERIOD_NAME.match(column.name):
        return not unit or is_convertible(unit, "s")
    return is_convertible(unit, "rad/s") or bool(not unit and _RATE_NAME.match(column.name))


def _guess_rate_unit(column: FileColumn) -> str | None:
    """Return the unit of a rate, from the file or from the end of its name; or None."""
    if column.unit:
        return column.unit
    name = column.name.lower()
    suffix_units = [
        unit
        for suffix, unit in _UNIT_BY_SUFFIX.items()
        if re.fullmatch(rf"(.*[^a-z])?({suffix})", name)
    ]
    target_unit = "s" if _PERIOD_NAME.match(column.name) else "rad/s"
    units = [
        _REVOLUTION_UNITS.get(unit, unit) for unit in [*suffix_units, unit_in_name(column.name)]
    ]
    target_units = (target_unit,) if _is_rate(column) else ("rad/s", "s")
    return next(
        (unit for unit in units if any(is_convertible(unit, target) for target in target_units)),
        None,
    )


def parse_direction(name: str) -> str | None:
    """Return the direction in a name, which may contain numbers and other words; or None."""
    for text in (name, _MOUNTING_SUFFIX.sub("", name)):
        if direction := _match_direction(text):
            return direction
    candidates = (_match_direction(part) for part in re.split(r"[\W\d_]+", name) if len(part) > 1)
    directions = set(filter(None, candidates))
    return directions.pop() if len(directions) == 1 else None


def _match_direction(text: str) -> str | None:
    try:
        return FileQuestion("axis", "", "", DIRECTIONS).parse_answer(text)
    except ValueError:
        return None

"""The rates and mountings that a table of readings on a centrifuge arm shows."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from decimal import Decimal
from itertools import accumulate
from typing import Final

import numpy as np
import numpy.typing as npt

from counterspin.arrays import Array
from counterspin.campaign.columns import SENSE_WORDS, mounting_of
from counterspin.frozen import frozen
from counterspin.ingest.column_roles import NONE, STANDARD_GRAVITY, converts, unit_in_name
from counterspin.ingest.contents import FileColumn, FileContents
from counterspin.ingest.questions import FileQuestion
from counterspin.ingest.readings import (
    ACCELEROMETERS,
    SEVERAL,
    WORD_ROLES,
    kind_of_columns,
    of_role,
    roles_of,
    usual_role,
)
from counterspin.units import unit_factor

#: Directions in the frame of the arm; the horizontal ones as a turn about down passes them.
HORIZONTAL: Final = ("inward", "forward", "outward", "backward")
DIRECTIONS: Final = (*HORIZONTAL, "up", "down")
#: The answer that a row without a mounting has the one above.
ABOVE: Final = "the one above"
#: What has the rate, the time of a revolution or the acceleration, by name.
_RATE: Final = re.compile(
    r"(?i)(.*[^a-z])?(rate|rpm|omega|w|n|speed|drehzahl|drehrate|drehfrequenz|u.?min|winkelgeschw)([^a-z]|$)"
)
_PERIOD: Final = re.compile(r"(?i).*(period|umlauf|t_?rev|rev_?time)")
_ACCELERATION: Final = re.compile(r"(?i)(.*[^a-z])?(acc|beschl|level|g_?level|last|centri|zentri)")
_POSITION: Final = re.compile(
    r"(?i).*(pos|mount|orient|side|richtung|direction|lage|einbau|platz|stell|polar|vorzeich|aufspann)"
)
_RADIUS: Final = re.compile(r"(?i)(r|radi[ui]s?|arm|arm_?length|armlänge)([^a-z]|$)")
#: How the unit of a rate stands at the end of a name -> the unit.
_ENDINGS: Final = {
    r"rpm|u.?min|1.?min|rev.?min": "rpm",
    r"rad.?s": "rad/s",
    r"deg.?s|dps|°.?s": "deg/s",
    r"rev.?s|rps|hz": "rev/s",
    r"m.?s2": "m/s^2",
    r"g|g.?levels?|g.?load": "g",
}
#: Of two columns the one that was measured, not set.
_MEASURED: Final = re.compile(r"(?i)(.*[^a-z])?(meas|actual|act|ist|gemessen|true)")
#: A column has a unit of a rate, of a time, of an acceleration.
_KINDS: Final = ("rad/s", "s", "m/s^2")
#: What counts revolutions, as `[readings]` reads it.
_REVOLUTIONS: Final = {"1/min": "rpm", "min^-1": "rpm", "Hz": "rev/s"}
#: What stands behind the word of a mounting, in "in 1" and "out, 20 g".
_BEHIND: Final = re.compile(r"[\s_.,;:#-]*\d*([.,]\d+)?\s*g?$")

#: The answer that columns of readings are mountings of one accelerometer, side by side.
MOUNTINGS: Final = "mountings"
#: They are if some slopes are the others' negative, but for this part.
_OPPOSITE_PART: Final = 0.1

#: Whether something holds, row by row.
Rows = npt.NDArray[np.bool_]


@frozen(eq=False)
class ArmTable:
    """The columns of a table of readings, with the answers about their units."""

    contents: FileContents
    roles: Mapping[str, str]
    rate: FileColumn | None  #: None: not known yet.
    unit: str | None  #: Of the rate; None: not known yet.
    position: str | None  #: The column of mountings; None: there is none.
    words: tuple[str, ...]  #: The mounting of each row, empty where none is said.
    #: What a row has that names no mounting, by its cells; None: each names one, or none does.
    gaps: str | None

    @classmethod
    def of(
        cls, contents: FileContents, roles: Mapping[str, str], answers: Mapping[str, str]
    ) -> ArmTable:
        """Return a table with columns of these roles."""
        rate = next(iter(of_role(contents, roles, "rate")), None)
        unit = answers.get("rate unit") or (_rate_unit(rate) if rate else None)
        position = next((name for name, role in roles.items() if role == "position"), None)
        numbers = next((c.values for c in contents.columns if c.name == position), None)
        words: Sequence[str] = contents.words.get(position or "", ())
        if numbers is not None:
            words = ["" if math.isnan(value) else f"{value:.12g}" for value in numbers]
        words = [mounting_of(word) for word in words]
        rows = max(len(column.values) for column in contents.columns)
        remarks = _without_numbers([rate, *of_role(contents, roles, "reading")], rows)
        words = (*words, *[""] * rows)[:rows]
        words = tuple("" if only else word for word, only in zip(words, remarks, strict=True))
        gaps = _gaps(rate, words)
        if answers.get("empty mounting", gaps) == ABOVE:
            words = tuple(accumulate(words, lambda above, own: own or above))
        return cls(contents, roles, rate, unit, position, words, gaps)

    def values(self, column: FileColumn | None) -> Array:
        """Return a column, NaN in rows without a value."""
        values = np.full(len(self.words), np.nan)
        if column is not None:
            values[: len(column.values)] = column.values
        return values

    @property
    def rests(self) -> Rows:
        """Flag the rows in which the arm rests."""
        return np.asarray(self.values(self.rate) == 0.0)

    @property
    def turning(self) -> tuple[str, ...]:
        """The mountings in which the arm turns."""
        rows = np.flatnonzero(np.nan_to_num(self.values(self.rate)))
        return tuple(dict.fromkeys(self.words[row] for row in rows))

    @property
    def mountings(self) -> tuple[str, ...]:
        """The names of the mountings, at rest too."""
        return tuple(word for word in dict.fromkeys(self.words) if word)

    def radii(self) -> dict[str, list[float]]:
        """Return the radii of each mounting from the column, m; empty without one."""
        columns = of_role(self.contents, self.roles, "radius")
        if not columns:
            return {}
        values = self.values(columns[0]) * unit_factor(_radius_unit(columns[0]), "m")
        turns = np.nan_to_num(self.values(self.rate)) != 0.0
        found: dict[str, dict[float, None]] = {}
        for row in np.flatnonzero(turns & np.isfinite(values)).tolist():
            found.setdefault(self.words[row], {})[float(values[row])] = None
        return {word: list(radii) for word, radii in found.items()}

    def acceleration(self, radius: float) -> Array:
        """Return the centripetal acceleration at a radius, m/s^2, row by row; NaN: not known."""
        unit = _REVOLUTIONS.get(self.unit or "", self.unit or "rad/s")
        size = np.where(self.rests, 1.0, np.abs(self.values(self.rate)))
        if self.unit is None:
            size = size * np.nan
        if converts(unit, "m/s^2"):
            felt = size * unit_factor(unit, "m/s^2", gravity=STANDARD_GRAVITY)
        elif converts(unit, "s"):
            felt = radius * (2.0 * math.pi / (size * unit_factor(unit, "s"))) ** 2
        else:
            felt = radius * (size * unit_factor(unit, "rad/s")) ** 2
        return np.asarray(np.where(self.rests, 0.0, felt))

    def lines(self, column: FileColumn, radius: float) -> tuple[dict[str, float], float]:
        """Return the slope of readings by the acceleration, for each mounting, and their zero.

        Slopes are per g, the zero is the output without acceleration, both in the column's unit;
        empty and NaN where unknown.
        """
        felt, read = self.acceleration(radius) / STANDARD_GRAVITY, self.values(column)
        rows = np.nan_to_num(felt * read) != 0.0
        words = [word for word in self.turning if np.any(rows & self.turns_in(word))]
        if not words:
            return {}, math.nan
        each = [np.where(self.turns_in(word), felt, 0.0)[rows] for word in words]
        zero, *slopes = np.linalg.lstsq(
            np.column_stack([np.ones(rows.sum()), *each]), read[rows], rcond=None
        )[0].tolist()
        return dict(zip(words, slopes, strict=True)), zero

    def rate_step(self) -> float:
        """Return the largest relative change of the force by the last written digit of a rate."""
        rates = self.values(self.rate)
        sizes = np.abs(rates[np.nan_to_num(rates) != 0.0])
        if not len(sizes) or self.unit is None:
            return 0.0
        ends = (Decimal(repr(size)).normalize().as_tuple().exponent for size in sizes.tolist())
        last = min(int(end) for end in ends)
        power = 1.0 if self.rate is not None and converts(self.unit, "m/s^2") else 2.0
        return float(power * 10.0**last / sizes.min())

    def turns_in(self, word: str) -> Rows:
        """Flag the rows in which the arm turns in a mounting."""
        return np.array([own == word for own in self.words]) & np.logical_not(self.rests)


def arm_roles(contents: FileContents, answers: Mapping[str, str]) -> dict[str, str]:
    """Return the role of each column."""
    rates = [column for column in contents.columns if _kind(column) is not None]
    rates.sort(key=_preference)
    # The time of a revolution, whatever it is called, does not go on from row to row.
    rates += [
        column for column in contents.columns if usual_role(column) == "time" and _falls(column)
    ]
    words = [name for name, cells in contents.words.items() if any(map(direction_of, cells))]
    senses = [name for name, cells in contents.words.items() if _are_senses(cells)]
    named = [
        name
        for name, cells in contents.words.items()
        if _repeat(cells) and _POSITION.match(name) and name not in senses
    ]
    numbered = [c.name for c in contents.columns if _POSITION.match(c.name)]
    parts = {
        "rate": rates[0].name if rates else None,
        "position": next(iter([*words, *named, *numbered]), None),
    }
    roles = roles_of(contents, answers, _role, parts)
    free = [name for name in senses if roles[name] in WORD_ROLES and f"{name} is" not in answers]
    return roles | dict.fromkeys(free[:1], "sense")


def _preference(column: FileColumn) -> tuple[int, bool, bool]:
    """Return the rank of a column among the candidates for the rate; the smallest is preferred."""
    kind = _KINDS.index(_kind(column) or _KINDS[-1])
    return kind, not _MEASURED.match(column.name), _rate_unit(column) is None


def _falls(column: FileColumn) -> bool:
    """Return whether numbers are smaller in a later row."""
    values = column.values[np.isfinite(column.values)]
    return not column.stamps and bool(np.any(np.diff(values) < 0.0))


def _without_numbers(columns: Sequence[FileColumn | None], rows: int) -> Rows:
    """Return the rows that have no number in any of the columns: remarks below a table."""
    empty = np.ones(rows, dtype=bool)
    for column in columns:
        if column is not None:
            empty[: len(column.values)] &= np.isnan(column.values)
    return empty


def _gaps(rate: FileColumn | None, words: Sequence[str]) -> str | None:
    """Return rows that name no mounting: in a spreadsheet cells may be merged."""
    if not any(words) or all(words):
        return None
    rates = [] if rate is None else rate.values.tolist()
    turning = any(rate and not word for rate, word in zip(rates, words, strict=False))
    return ABOVE if words[0] and turning else NONE


def _are_senses(cells: Sequence[str]) -> bool:
    """Return whether cells state the sense of the arm's rotation, row by row."""
    written = {cell.lower() for cell in cells if cell}
    return bool(written) and written <= set(SENSE_WORDS)


def _repeat(cells: Sequence[str]) -> bool:
    """Return whether words repeat in several rows: names of mountings do, names of rows do not."""
    return len(set(cells)) < len(cells)


def _role(column: FileColumn) -> str:
    if _kind(column) is not None:
        return "rate"
    usual = usual_role(column)
    if usual != "reading":
        return usual
    if converts(column.unit, "m") or _RADIUS.match(column.name):
        return "radius"
    return "position" if _POSITION.match(column.name) else usual


def _kind(column: FileColumn) -> str | None:
    """Return the form in which a column gives the rate, of `_KINDS`; None if it gives none."""
    unit = _REVOLUTIONS.get(column.unit, column.unit)
    if converts(unit, "rad/s") or (not unit and _RATE.match(column.name)):
        return "rad/s"
    if _PERIOD.match(column.name) and (not unit or converts(unit, "s")):
        return "s"
    accelerates = _ACCELERATION.match(column.name) and (not unit or converts(unit, "m/s^2"))
    return "m/s^2" if accelerates else None


def _rate_unit(column: FileColumn) -> str | None:
    """Return the unit of a rate, from the file or from the end of its name."""
    if column.unit:
        return column.unit
    name = column.name.lower()
    known = [u for end, u in _ENDINGS.items() if re.fullmatch(rf"(.*[^a-z])?({end})", name)]
    kinds = _KINDS if (kind := _kind(column)) is None else (kind,)
    units = [_REVOLUTIONS.get(unit, unit) for unit in [*known, unit_in_name(column.name)]]
    return next((unit for unit in units if any(converts(unit, one) for one in kinds)), None)


def _radius_unit(column: FileColumn) -> str:
    units = (column.unit, unit_in_name(column.name))
    return next((unit for unit in units if converts(unit, "m")), "m")


def kind_of_arm_columns(table: ArmTable) -> str:
    """Return the role of several columns of readings: mountings, if they have opposite signs."""
    columns = of_role(table.contents, table.roles, "reading")
    if table.position is None and len(columns) > 1 and table.rate is not None:
        felt = table.acceleration(1.0)
        slopes = np.array([_slope(felt, table.values(column)) for column in columns])
        if np.ptp(np.abs(slopes)) < _OPPOSITE_PART * slopes.max() and slopes.min() < 0.0:
            return MOUNTINGS
    return kind_of_columns(columns) if len(columns) > 1 else ACCELEROMETERS


def _slope(felt: Array, read: Array) -> float:
    """Return the slope of readings by the acceleration; only its sign at a single rate."""
    rows = np.isfinite(felt * read)
    line = np.column_stack([np.ones(rows.sum()), felt[rows]])
    return float(np.linalg.lstsq(line, read[rows], rcond=None)[0][1])


def below_each_other(
    contents: FileContents, roles: Mapping[str, str], answers: Mapping[str, str]
) -> tuple[FileContents, Mapping[str, str]]:
    """Return a table in long format if its columns of readings are those of mountings."""
    table, columns = ArmTable.of(contents, roles, answers), of_role(contents, roles, "reading")
    kind = answers.get(SEVERAL) or kind_of_arm_columns(table)
    if kind != MOUNTINGS or table.position is not None or not columns:
        return contents, roles
    rows, count, names = len(table.words), len(columns), [column.name for column in columns]
    tall = [
        replace(column, values=np.tile(table.values(column), count))
        for column in contents.columns
        if column not in columns
    ]
    read = replace(columns[0], values=np.concatenate([table.values(c) for c in columns]))
    words = {MOUNTINGS: [word for word in mountings_beside(columns) for _ in range(rows)]}
    kept = {name: role for name, role in roles.items() if name not in names[1:]}
    below = replace(contents, columns=(*tall, read), words=words, others=(MOUNTINGS,))
    return below, {**kept, MOUNTINGS: "position"}


def mountings_beside(columns: Sequence[FileColumn]) -> list[str]:
    """Return the names of mountings in adjacent columns: the columns' names without the unit."""
    names = [column.name for column in columns]
    bare = [re.sub(r"\s*[\[(][^\[\]()]*[\])]$", "", name) for name in names]
    return [mounting_of(name) for name in (bare if len({*bare, ""}) > len(bare) else names)]


def as_acceleration(column: FileColumn) -> bool:
    """Return whether a column has accelerations instead of rates, by its name and unit."""
    return _kind(column) == "m/s^2"


def direction_of(word: str) -> str | None:
    """Return the direction that a word means; a number may follow it, and a word may precede it."""
    for text in (word, _BEHIND.sub("", word)):
        if found := _direction(text):
            return found
    parts = (_direction(part) for part in re.split(r"[\W\d_]+", word) if len(part) > 1)
    known = set(filter(None, parts))
    return known.pop() if len(known) == 1 else None


def _direction(text: str) -> str | None:
    try:
        return FileQuestion("axis", "", "", DIRECTIONS).judged(text)
    except ValueError:
        return None

"""The blocks of a report: words, cells and curves, in characters that may be shown.

Names and words come from other people's files and can contain anything. Every text of a block
passes `escape_controls` when the block is made, and so does every other text that a renderer shows.

A renderer draws the blocks that it can: the terminal and Markdown leave pictures out, whose numbers
are also in tables. Every character of a text is visible once it is in a block
(`counterspin.reports.blocks`).
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Final, Literal

from counterspin.characters import escape_controls
from counterspin.frozen import frozen

Style = Literal[
    "plain", "answer", "reserved", "undetermined", "warning", "quiet", "equation", "command"
]

#: Styles of what was asked for: as it is, and with reservations.
ANSWERS: Final[tuple[Style, ...]] = ("answer", "reserved")


class _Words:
    """A block of words: attributes that are text, or rows of it, are made visible."""

    def __post_init__(self) -> None:
        """Make all words visible."""
        for name, value in self.__dict__.items():
            if isinstance(value, str) or (value and isinstance(value, tuple)):
                self.__dict__[name] = _all_visible(value)


def _all_visible(value: Any) -> Any:
    match value:
        case str():
            return escape_controls(value)
        case tuple() if value and isinstance(value[0], str | tuple):
            return tuple(map(_all_visible, value))
    return value


@frozen
class Heading(_Words):
    """A heading; level 1 is the report's own, 2 a chapter's, 3 what is in it."""

    text: str
    level: Literal[1, 2, 3] = 2


@frozen
class Paragraph(_Words):
    """A paragraph and what kind of thing it says."""

    text: str
    style: Style = "plain"


@frozen
class Column(_Words):
    """A column: numbers are kept in one piece, words may be wrapped."""

    title: str  #: Above it.
    align: Literal["left", "right"] = "left"  #: Of title and cells.
    wraps: bool = False  #: Whether words may be wrapped.
    narrowest: int = 0  #: Characters a line that wrapped words get at least in the terminal.


@frozen
class Table(_Words):
    """A table; rows whose index is in `quiet` hold nothing that the data determined.

    Cells may be `Lines`, but for those of the first column, which say what a row is about.
    """

    columns: tuple[Column, ...]
    rows: tuple[tuple[str, ...], ...]
    quiet: frozenset[int] = frozenset()

    def without_empty_columns(self) -> Table:
        """Return the table without the columns in which no row has anything."""
        full = [k for k in range(len(self.columns)) if any(row[k] for row in self.rows)]
        return Table(
            tuple(self.columns[k] for k in full),
            tuple(tuple(row[k] for k in full) for row in self.rows),
            self.quiet,
        )


@frozen
class PlotSeries(_Words):
    """One line, row of points, band or histogram of a plot."""

    label: str  #: What it is; empty: not in the legend.
    #: Of equal length; None in y is a gap.
    x: tuple[float, ...]
    y: tuple[float | None, ...]
    #: A band about a line, or error bars at points; both or neither.
    low: tuple[float | None, ...] | None = None
    high: tuple[float | None, ...] | None = None
    #: How it is drawn; "columns" stand on zero about equally spaced x, and touch.
    kind: Literal["line", "points", "band", "columns"] = "line"
    stands_out: bool = False  #: Drawn in the colour of warnings.
    #: Place in the row of colours and markers; None: the next one. Series of the same thing, such
    #: as points and the curve through them, or a run in several plots, share a colour. "muted":
    #: what others are compared with.
    colour: int | Literal["muted"] | None = None


@frozen
class Plot(_Words):
    """Curves over a common axis."""

    title: str  #: What is shown; also what is read to those who do not see it.
    #: With units.
    x_label: str
    y_label: str
    series: tuple[PlotSeries, ...]  #: What is drawn, the first below the others.
    levels: tuple[float, ...] = ()  #: Heights of horizontal lines for comparison.
    x_names: tuple[str, ...] = ()  #: Names in place of numbers at x = 0, 1, 2...; empty: numbers.
    #: Logarithmic axes.
    log_x: bool = False
    log_y: bool = False
    zoom: bool = False  #: Worth a closer look: many points over a long axis.
    dates: bool = False  #: x is a time in days since 1970-01-01, and the axis shows dates.
    #: Ends of the axes, such as those that plots have in common; None: what holds the series.
    x_range: tuple[float, float] | None = None
    y_range: tuple[float, float] | None = None
    height: float = 1.0  #: In heights of a usual plot.


@frozen
class Bars(_Words):
    """Horizontal bars, the first on top; `texts` are at their ends.

    If `stacked`, each begins at the end of the one above it: a stacked bar with a row for each
    part. `colours` are indices in the row of colours; absent: the first for all.
    """

    title: str
    labels: tuple[str, ...]
    values: tuple[float, ...]
    texts: tuple[str, ...]
    stacked: bool = False
    colours: tuple[int, ...] = ()


@frozen
class HeatMap(_Words):
    """A square matrix of numbers from -1 to 1 between things with names."""

    title: str
    labels: tuple[str, ...]
    values: tuple[tuple[float, ...], ...]


@frozen
class Sphere(_Words):
    """Directions as points on a sphere, each with a name and coloured by a value."""

    title: str
    axes: tuple[str, str, str]  #: Names of the three axes.
    points: tuple[tuple[float, float, float], ...]  #: Unit vectors.
    values: tuple[float, ...]
    names: tuple[str, ...]
    value_label: str  #: What the values are, with their unit.
    stands_out: frozenset[int] = frozenset()  #: Places of points drawn in the colour of warnings.


Picture = Plot | Bars | HeatMap | Sphere
Block = Heading | Paragraph | Table | Picture
Words = Heading | Paragraph | Table


def without_pictures(blocks: Iterable[Block]) -> list[Words]:
    """Return the blocks that are no pictures, without headings that stood over pictures alone."""
    kept: list[Words] = []
    drawn = False
    for block in [*blocks, None]:
        if isinstance(block, Picture):
            drawn = True
            continue
        while drawn and kept and isinstance(empty := kept[-1], Heading):
            if isinstance(block, Heading) and block.level > empty.level:
                break
            kept.pop()
        drawn = False
        if block is not None:
            kept.append(block)
    return kept

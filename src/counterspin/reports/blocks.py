"""Blocks of a report: text, tables and curves, with escaped control characters.

Names and texts come from users' files and can contain anything. Every text of a block passes
`escape_controls` when the block is made, and so does every other text that a renderer shows.

A renderer draws the blocks that it supports: the terminal and Markdown omit pictures, whose numbers
are also in tables.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any, Final, Literal

from counterspin.characters import escape_controls
from counterspin.frozen import frozen

Style = Literal[
    "plain", "answer", "reserved", "undetermined", "warning", "quiet", "equation", "command"
]

#: Rows of a table that a terminal shows; JSON, Markdown and HTML have all.
MAX_TERMINAL_ROWS: Final = 200

#: Styles of a requested value: unconditional, and with reservations.
VALUE_STYLES: Final[tuple[Style, ...]] = ("answer", "reserved")


class _TextBlock:
    """Base class of blocks: escapes the control characters of all text attributes."""

    def __post_init__(self) -> None:
        """Escape the control characters of all texts."""
        for name, value in self.__dict__.items():
            if isinstance(value, str) or (value and isinstance(value, tuple)):
                self.__dict__[name] = _escape_strings(value)


def _escape_strings(value: Any) -> Any:
    match value:
        case str():
            return escape_controls(value)
        case tuple() if value and isinstance(value[0], str | tuple):
            return tuple(map(_escape_strings, value))
    return value


@frozen
class Heading(_TextBlock):
    """A heading: level 1 of the report, 2 of a chapter, 3 of a section."""

    text: str
    level: Literal[1, 2, 3] = 2


@frozen
class Paragraph(_TextBlock):
    """A paragraph with its style."""

    text: str
    style: Style = "plain"


@frozen
class Column(_TextBlock):
    """A column of a table: numbers are never broken, text may be wrapped."""

    title: str  #: Title above the column.
    align: Literal["left", "right"] = "left"  #: Alignment of title and cells.
    wraps: bool = False  #: Whether text may be wrapped.
    min_width: int = 0  #: Smallest width of wrapped text in the terminal, in characters.


@frozen
class Table(_TextBlock):
    """A table; rows with an index in `quiet_rows` contain no value determined by the data.

    Cells may be `MultilineText`, except those of the first column, which label the rows.
    """

    columns: tuple[Column, ...]
    rows: tuple[tuple[str, ...], ...]
    quiet_rows: frozenset[int] = frozenset()
    n_omitted: int = 0  #: Number of further rows that a terminal does not show.

    def without_empty_columns(self) -> Table:
        """Return the table without empty columns."""
        columns = [k for k in range(len(self.columns)) if any(row[k] for row in self.rows)]
        return Table(
            tuple(self.columns[k] for k in columns),
            tuple(tuple(row[k] for k in columns) for row in self.rows),
            self.quiet_rows,
            self.n_omitted,
        )


@frozen
class PlotSeries(_TextBlock):
    """A line, row of points, band or histogram of a plot."""

    label: str  #: Label in the legend; empty: not in the legend.
    #: Coordinates of equal length; None in y is a gap.
    x: tuple[float, ...]
    y: tuple[float | None, ...]
    #: Limits of a band about a line, or of error bars; both or neither.
    low: tuple[float | None, ...] | None = None
    high: tuple[float | None, ...] | None = None
    #: Type of drawing; "columns": adjoining bars from zero at equally spaced x.
    kind: Literal["line", "points", "band", "columns"] = "line"
    is_highlighted: bool = False  #: True: drawn in the colour of warnings.
    #: Index of colour and marker; None: the next one. Series of the same object, such as points and
    #: the curve through them, or a run in several plots, share a colour. "muted": a reference.
    colour: int | Literal["muted"] | None = None


@frozen
class Plot(_TextBlock):
    """Curves over a common axis."""

    title: str  #: Title, also the text for screen readers.
    #: Labels of the axes, with units.
    x_label: str
    y_label: str
    series: tuple[PlotSeries, ...]  #: Series, in the order of drawing.
    levels: tuple[float, ...] = ()  #: y of horizontal reference lines.
    x_names: tuple[str, ...] = ()  #: Names in place of numbers at x = 0, 1, 2...; empty: numbers.
    #: Logarithmic axes.
    log_x: bool = False
    log_y: bool = False
    zoom: bool = False  #: Whether to offer zooming: many points over a long axis.
    is_date_axis: bool = False  #: x is a time in days since 1970-01-01, and the axis shows dates.
    #: Ranges of the axes, such as a common range of several plots; None: that of the series.
    x_range: tuple[float, float] | None = None
    y_range: tuple[float, float] | None = None
    height: float = 1.0  #: Height, relative to a usual plot.


@frozen
class Bars(_TextBlock):
    """Horizontal bars, the first on top, with `texts` at their ends.

    If `stacked`, each bar begins at the end of the previous one: a stacked bar with a row for each
    part. `colours` are indices of colours; empty: the first for all.
    """

    title: str
    labels: tuple[str, ...]
    values: tuple[float, ...]
    texts: tuple[str, ...]
    stacked: bool = False
    colours: tuple[int, ...] = ()
    x_label: str = ""  #: Label of the axis, with its unit; empty: no axis.


@frozen
class HeatMap(_TextBlock):
    """A square matrix of numbers from -1 to 1 with labelled rows and columns."""

    title: str
    labels: tuple[str, ...]
    values: tuple[tuple[float, ...], ...]


@frozen
class Sphere(_TextBlock):
    """Directions as points on a sphere, with names, coloured by value."""

    title: str
    axes: tuple[str, str, str]  #: Names of the three axes.
    points: tuple[tuple[float, float, float], ...]  #: Unit vectors.
    values: tuple[float, ...]
    names: tuple[str, ...]
    value_label: str  #: Label of the values, with their unit.
    #: Indices of points drawn in the colour of warnings.
    highlighted_points: frozenset[int] = frozenset()


@frozen
class Share(_TextBlock):
    """A share of a variance, drawn as a segment of a stacked bar."""

    label: str
    fraction: float  #: From 0 to 1.
    is_default: bool = False  #: Whether it is from a default prior.


@frozen
class Check(_TextBlock):
    """A quality check and its outcome."""

    title: str
    outcome: Literal["passed", "failed", "open"]  #: "open": not checked.
    text: str


@frozen
class Card(_TextBlock):
    """Summary of the result of one instrument; text renderers show `paragraphs` instead."""

    title: str
    detail: str
    #: State of the result, as a name for styles and as text.
    state: str
    state_text: str
    #: Value with its standard uncertainty, and its unit; empty: no value.
    symbol: str
    value: str
    unit: str
    remarks: tuple[str, ...]  #: Lines below the value.
    shares: tuple[Share, ...]  #: Shares of the variance, in descending order.
    note: str
    checks: tuple[Check, ...]
    paragraphs: tuple[Paragraph, ...]


Picture = Plot | Bars | HeatMap | Sphere
Block = Heading | Paragraph | Table | Picture | Card
TextBlock = Heading | Paragraph | Table


def expand_cards(blocks: Iterable[Block]) -> Iterator[Heading | Paragraph | Table | Picture]:
    """Yield the blocks, with the paragraphs of a card in its place."""
    for block in blocks:
        if isinstance(block, Card):
            yield from block.paragraphs
        else:
            yield block


def remove_pictures(blocks: Iterable[Block]) -> list[TextBlock]:
    """Return the blocks except pictures, without headings of sections with pictures only."""
    kept_blocks: list[TextBlock] = []
    follows_picture = False
    for block in [*expand_cards(blocks), None]:
        if isinstance(block, Picture):
            follows_picture = True
            continue
        while follows_picture and kept_blocks and isinstance(heading := kept_blocks[-1], Heading):
            if isinstance(block, Heading) and block.level > heading.level:
                break
            kept_blocks.pop()
        follows_picture = False
        if block is not None:
            kept_blocks.append(block)
    return kept_blocks

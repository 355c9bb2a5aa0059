"""The space of a chart's words, and the visible points of a series.

Margins come from the widths of words instead of matplotlib's layout engines, which draw twice.
"""

from __future__ import annotations

import itertools
import math
from bisect import bisect
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.reports.blocks import Plot, PlotSeries
from counterspin.reports.typography import RAISED

#: Of every drawing, and of one with axes; in points.
WIDTH: Final = 504.0
HEIGHT: Final = 172.0

_FONT_SIZE: Final = 9.0

#: A drawing shows a series in this many columns: finer than a reader sees, coarse enough to be
#: drawn in an instant.
_COLUMNS: Final = 360

#: How many more points are kept of what has more: with the extremes alone there would be a hole
#: in the middle.
_FURTHER_POINTS: Final = 1200

#: Dates that have room on an axis, and years.
_MOST_DATES: Final = 10
_MOST_YEARS: Final = 15


@lru_cache(maxsize=4096)
def text_width(text: str, weight: str = "normal") -> float:
    """Return the width of words of the common size, in points."""
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import text_to_path

    font = FontProperties(size=_FONT_SIZE, weight=weight)
    width, _, _ = text_to_path.get_text_width_height_descent(text, font, ismath=False)
    return float(width)


def shorten_words(text: str, room: float) -> str:
    """Return words shortened to a width, in points."""
    if text_width(text) <= room:
        return text
    fitting = bisect(range(len(text)), room, key=lambda length: text_width(f"{text[:length]}…"))
    return f"{text[: max(fitting - 1, 0)].rstrip()}…"


def in_lines(text: str, room: float) -> str:
    """Return the words in as many lines as they need, where each has so much room, in points."""
    lines = [""]
    for word in text.split():
        longer = f"{lines[-1]} {word}".lstrip()
        if text_width(longer) <= room or not lines[-1]:
            lines[-1] = longer
        else:
            lines.append(word)
    return "\n".join(shorten_words(line, room) for line in lines)


def legend_columns(labels: Sequence[str]) -> int:
    """Return the number of labels in a row above a drawing, at least one."""
    room = WIDTH - 60.0
    widest = max(map(text_width, labels), default=0.0) + 32.0
    return max(1, min(len(labels), int(room / widest)))


@frozen
class Margins:
    """Room about axes, and the height of all of it, in points."""

    left: float
    right: float
    top: float
    bottom: float
    height: float
    #: Between axes and title.
    pad: float


def margins(
    axes: Any, height: float, *, legend_rows: int = 0, top: float = 4.0, right: float = 6.0
) -> Margins:
    """Return the room that tick labels, names, legend and title leave to axes."""
    left = _widest(axes.yaxis) + (22.0 if axes.get_ylabel() else 7.0)
    ticks = axes.xaxis.get_tick_params()
    bottom = 2.0 if not axes.get_xlabel() and not len(axes.get_xticks()) else 18.0
    bottom += 12.0 if axes.get_xlabel() else 0.0
    if ticks.get("labeltop"):
        bottom = 2.0
    elif not ticks.get("labelbottom", True):
        bottom = 6.0
        height -= 24.0
    elif names := _names(axes.xaxis):
        if _crowded(axes, names, WIDTH - left - right):
            axes.tick_params(axis="x", labelrotation=90.0)
            bottom += _widest(axes.xaxis) - 9.0
            height += _widest(axes.xaxis) - 9.0
        else:
            # The last one stands about its tick, which may be at the end of the axis.
            low, high = axes.get_xlim()
            beyond = (high - max(axes.get_xticks())) / (high - low) * (WIDTH - left - right)
            right = max(right, 0.5 * text_width(names[-1]) + 2.0 - beyond)
    above = 14.0 * legend_rows
    # The common power of ten stands above the axis.
    offset = bool(axes.yaxis.get_major_formatter().get_offset())
    top += 11.0 if offset and not legend_rows else 0.0
    pad = above + (16.0 if offset else 5.0)
    above += 18.0 if axes.get_title(loc="left") else 0.0
    return Margins(left, right, top + above, bottom, height + above, pad)


def place(figure: Any, panels: Sequence[tuple[Any, Margins]]) -> None:
    """Give a figure its size and put its axes below each other, with their left ends aligned."""
    total = sum(room.height for _, room in panels)
    figure.set_size_inches(WIDTH / 72.0, total / 72.0)
    left = max(room.left for _, room in panels)
    below = total
    for axes, room in panels:
        below -= room.height
        width = max(WIDTH - left - room.right, 20.0)
        height = max(room.height - room.top - room.bottom, 10.0)
        axes.set_position(
            (left / WIDTH, (below + room.bottom) / total, width / WIDTH, height / total)
        )
        if title := axes.get_title(loc="left"):
            # One wider than its axes begins further left; on whole pixels it is a little wider.
            start = min(max(width - 1.02 * text_width(title, "bold"), -left), 0.0)
            axes.set_title(title, pad=room.pad, x=start / width)
        if axes.get_ylabel():
            axes.yaxis.set_label_coords((11.0 - left) / width, 0.5)


def date_ticks(low: float, high: float) -> tuple[list[float], list[str]]:
    """Return places and names of up to a dozen dates on an axis: whole years, months or days.

    low, high: Ends of the axis, days since 1970-01-01.
    """
    for unit, step in (*(("D", n) for n in (1, 2, 5, 10)), *(("M", n) for n in (1, 2, 3, 6))):
        if (ticks := _dates(low, high, unit, step)).size <= _MOST_DATES:
            break
    else:
        step = 1
        while (ticks := _dates(low, high, "Y", step)).size > _MOST_YEARS:
            step += 1
    days = ticks.astype("datetime64[D]").astype(float)
    return days.tolist(), [str(tick) for tick in ticks]


def _dates(low: float, high: float, unit: str, step: int) -> NDArray[np.datetime64]:
    first, last = (
        int(np.datetime64(math.floor(end), "D").astype(f"datetime64[{unit}]").astype(int))
        for end in (low, high)
    )
    every = np.arange(first - first % step, last + 1, step).astype(f"datetime64[{unit}]")
    days = every.astype("datetime64[D]").astype(float)
    return every[(days >= low) & (days <= high)]


def decades(axis: Any) -> None:
    """Put a logarithmic axis's ticks at powers of ten, and between them where these are few."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    low, high = axis.get_view_interval()
    if low > 0.0 and high > low:
        few = high < 100.0 * low
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if few else (1.0,), numticks=9))
        axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda value, _: _power(value)))


def _power(value: float) -> str:
    mantissa, _, exponent = f"{value:.0e}".partition("e")
    if -3 <= int(exponent) <= 4:
        return f"{value:g}"
    power = "10" + str(int(exponent)).translate(RAISED)
    return power if mantissa == "1" else f"{mantissa}·{power}"


def _labels(axis: Any) -> list[str]:
    low, high = sorted(axis.get_view_interval())
    places = [place for place in axis.get_majorticklocs() if low <= place <= high]
    return [str(label) for label in axis.get_major_formatter().format_ticks(places)]


def _widest(axis: Any) -> float:
    lines = (line for label in _labels(axis) for line in label.split("\n"))
    return max(map(text_width, lines), default=0.0)


def _names(axis: Any) -> list[str]:
    """Return the labels of an axis that has names of things, such as runs, or dates."""
    from matplotlib.ticker import FixedLocator

    return _labels(axis) if isinstance(axis.get_major_locator(), FixedLocator) else []


def _crowded(axes: Any, names: Sequence[str], room: float) -> bool:
    """Return whether names would touch."""
    low, high = axes.get_xlim()
    distances = np.diff(axes.get_xticks()) * room / (high - low)
    pairs = itertools.pairwise(map(text_width, names))
    return any(
        0.5 * (left + right) + 6.0 > distance
        for (left, right), distance in zip(pairs, distances, strict=True)
    )


def thinned(
    series: PlotSeries, *, log_x: bool, log_y: bool
) -> tuple[Array, Array, Array | None, Array | None]:
    """Return the visible points of a series: the lowest and highest in each column of the drawing.

    log_x, log_y: True for logarithmic axes; values that are not positive are then left out.
    Returns: equal lengths; gaps are NaN; low and high are None where the series has none.
    """
    x = np.asarray(series.x, dtype=float)
    y, low, high = (
        None if values is None else np.array(values, dtype=float)
        for values in (series.y, series.low, series.high)
    )
    assert y is not None
    if log_y:
        y[~(y > 0.0)] = np.nan
    seen = np.flatnonzero(np.isfinite(x) & ((x > 0.0) | (not log_x)))
    if x[seen].size > (2 * _FURTHER_POINTS if series.kind == "points" else 2 * _COLUMNS):
        height = y if low is None or high is None or np.isfinite(y).any() else high - low
        seen = seen[_extremes(np.log(x[seen]) if log_x else x[seen], height[seen], series.kind)]
    return (
        x[seen],
        y[seen],
        None if low is None else low[seen],
        None if high is None else high[seen],
    )


def _extremes(x: Array, y: Array, kind: str) -> NDArray[np.intp]:
    """Return the indices to keep, in their order."""
    if kind != "points" and (np.diff(x) < 0.0).any():
        # A curve that turns back has no columns.
        return np.arange(x.size)
    span = float(np.ptp(x)) or 1.0
    column = np.minimum((x - x.min()) / span * _COLUMNS, _COLUMNS - 1).astype(int)
    gap = ~np.isfinite(y)
    there = np.flatnonzero(~gap)
    order = there[np.lexsort((y[there], column[there]))]
    first = np.flatnonzero(np.diff(column[order], prepend=-1))
    last = np.append(first[1:], order.size) - 1
    # A gap's first sample stands for it.
    begins = np.flatnonzero(gap & ~np.concatenate([[False], gap[:-1]]))
    between = there[:: max(there.size // _FURTHER_POINTS, 1)] if kind == "points" else there[:0]
    return np.unique(np.concatenate([order[first], order[last], between, begins]))


def whole_numbers(plot: Plot) -> range:
    """Return the whole numbers at which a plot has points; none where it is another kind of plot.

    Up to twenty, such as the harmonics of a revolution, and nothing but points.
    """
    places = {x for series in plot.series for x in series.x}
    if not places or plot.log_x or any(series.kind != "points" for series in plot.series):
        return range(0)
    whole = all(float(place).is_integer() for place in places)
    if not whole or max(places) - min(places) > 20.0:
        return range(0)
    return range(int(min(places)), int(max(places)) + 1)


def spread_points(series: Sequence[PlotSeries]) -> list[PlotSeries]:
    """Move rows of points that share their places to the side, so that none hides another."""
    rows = [row for row in series if row.kind == "points"]
    step = min(0.12, 0.7 / max(len(rows), 1))
    moves = iter(step * (place - 0.5 * (len(rows) - 1)) for place in range(len(rows)))
    return [
        replace(row, x=tuple(x + move for x in row.x))
        if row.kind == "points" and (move := next(moves))
        else row
        for row in series
    ]


def dots(axes: Any, x: Array, y: Array, size: float, **style: Any) -> None:
    """Draw many points as one line of round dots: a marker for each would take ten times as long.

    x, y: Shape (n,).
    **style: Of matplotlib's lines.
    """
    gap = np.full(x.size, np.nan)
    # From each point to itself: a line without length, whose round ends make the dot.
    axes.plot(
        np.column_stack([x, x, gap]).ravel(),
        np.column_stack([y, y, gap]).ravel(),
        linewidth=size,
        solid_capstyle="round",
        **style,
    )

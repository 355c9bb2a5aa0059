"""Layout of charts: margins, ticks, and thinning of series.

Margins follow from text widths instead of matplotlib's layout engines, which draw twice.
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
from counterspin.reports.typography import SUPERSCRIPTS

#: Width of drawings, and height of drawings with axes, in points.
DRAWING_WIDTH: Final = 504.0
AXES_HEIGHT: Final = 172.0

_FONT_SIZE: Final = 9.0

#: Number of columns for thinning a series: finer than visible, but fast to draw.
_THINNING_COLUMNS: Final = 360

#: Number of points kept in addition to the extremes, which alone would leave a gap in the middle.
_EXTRA_POINTS: Final = 1200

#: Largest number of dates, and of years, on an axis.
_MAX_DATES: Final = 10
_MAX_YEARS: Final = 15


@lru_cache(maxsize=4096)
def text_width(text: str, weight: str = "normal") -> float:
    """Return the width of a text of the common font size, in points."""
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import text_to_path

    font = FontProperties(size=_FONT_SIZE, weight=weight)
    width, _, _ = text_to_path.get_text_width_height_descent(text, font, ismath=False)
    return float(width)


def shorten_text(text: str, max_width: float) -> str:
    """Return a text shortened to a width, in points."""
    if text_width(text) <= max_width:
        return text
    fitting_length = bisect(
        range(len(text)), max_width, key=lambda length: text_width(f"{text[:length]}…")
    )
    return f"{text[: max(fitting_length - 1, 0)].rstrip()}…"


def wrap_text(text: str, max_width: float) -> str:
    """Return a text wrapped to a width, in points."""
    lines = [""]
    for word in text.split():
        extended_line = f"{lines[-1]} {word}".lstrip()
        if text_width(extended_line) <= max_width or not lines[-1]:
            lines[-1] = extended_line
        else:
            lines.append(word)
    return "\n".join(shorten_text(line, max_width) for line in lines)


def count_legend_columns(labels: Sequence[str]) -> int:
    """Return the number of labels in a row above a drawing, at least one."""
    available_width = DRAWING_WIDTH - 60.0
    label_width = max(map(text_width, labels), default=0.0) + 32.0
    return max(1, min(len(labels), int(available_width / label_width)))


@frozen
class Margins:
    """Margins of axes, and the total height, in points."""

    left: float
    right: float
    top: float
    bottom: float
    height: float
    #: Distance between axes and title.
    pad: float


def compute_margins(
    axes: Any, height: float, *, legend_rows: int = 0, top: float = 4.0, right: float = 6.0
) -> Margins:
    """Return the margins for tick labels, axis labels, legend and title."""
    left = _max_label_width(axes.yaxis) + (22.0 if axes.get_ylabel() else 7.0)
    tick_parameters = axes.xaxis.get_tick_params()
    bottom = 2.0 if not axes.get_xlabel() and not len(axes.get_xticks()) else 18.0
    bottom += 12.0 if axes.get_xlabel() else 0.0
    if tick_parameters.get("labeltop"):
        bottom = 2.0
    elif not tick_parameters.get("labelbottom", True):
        bottom = 6.0
        height -= 24.0
    elif names := _fixed_labels(axes.xaxis):
        if _labels_overlap(axes, names, DRAWING_WIDTH - left - right):
            axes.tick_params(axis="x", labelrotation=90.0)
            bottom += _max_label_width(axes.xaxis) - 9.0
            height += _max_label_width(axes.xaxis) - 9.0
        else:
            # The last label is centred at its tick, which may be at the end of the axis.
            low, high = axes.get_xlim()
            distance_to_end = (
                (high - max(axes.get_xticks())) / (high - low) * (DRAWING_WIDTH - left - right)
            )
            right = max(right, 0.5 * text_width(names[-1]) + 2.0 - distance_to_end)
    header_height = 14.0 * legend_rows
    # The common power of ten is above the axis.
    has_offset = bool(axes.yaxis.get_major_formatter().get_offset())
    top += 11.0 if has_offset and not legend_rows else 0.0
    pad = header_height + (16.0 if has_offset else 5.0)
    header_height += 18.0 if axes.get_title(loc="left") else 0.0
    return Margins(left, right, top + header_height, bottom, height + header_height, pad)


def arrange_axes(figure: Any, panels: Sequence[tuple[Any, Margins]]) -> None:
    """Set the size of a figure and stack its axes, with their left ends aligned."""
    total_height = sum(margins.height for _, margins in panels)
    figure.set_size_inches(DRAWING_WIDTH / 72.0, total_height / 72.0)
    left = max(margins.left for _, margins in panels)
    bottom = total_height
    for axes, margins in panels:
        bottom -= margins.height
        width = max(DRAWING_WIDTH - left - margins.right, 20.0)
        height = max(margins.height - margins.top - margins.bottom, 10.0)
        axes.set_position(
            (
                left / DRAWING_WIDTH,
                (bottom + margins.bottom) / total_height,
                width / DRAWING_WIDTH,
                height / total_height,
            )
        )
        if title := axes.get_title(loc="left"):
            # A title wider than its axes begins further left.
            title_start = min(max(width - 1.02 * text_width(title, "bold"), -left), 0.0)
            axes.set_title(title, pad=margins.pad, x=title_start / width)
        if axes.get_ylabel():
            axes.yaxis.set_label_coords((11.0 - left) / width, 0.5)


def date_ticks(low: float, high: float) -> tuple[list[float], list[str]]:
    """Return positions and labels of up to a dozen dates on an axis: whole years, months or days.

    low, high: Ends of the axis, days since 1970-01-01.
    """
    for unit, step in (*(("D", n) for n in (1, 2, 5, 10)), *(("M", n) for n in (1, 2, 3, 6))):
        if (ticks := _regular_dates(low, high, unit, step)).size <= _MAX_DATES:
            break
    else:
        step = 1
        while (ticks := _regular_dates(low, high, "Y", step)).size > _MAX_YEARS:
            step += 1
    days = ticks.astype("datetime64[D]").astype(float)
    return days.tolist(), [str(tick) for tick in ticks]


def _regular_dates(low: float, high: float, unit: str, step: int) -> NDArray[np.datetime64]:
    first_index, last_index = (
        int(np.datetime64(math.floor(limit), "D").astype(f"datetime64[{unit}]").astype(int))
        for limit in (low, high)
    )
    dates = np.arange(first_index - first_index % step, last_index + 1, step).astype(
        f"datetime64[{unit}]"
    )
    days = dates.astype("datetime64[D]").astype(float)
    return dates[(days >= low) & (days <= high)]


def set_decade_ticks(axis: Any) -> None:
    """Set the ticks of a logarithmic axis at powers of ten, and between them if these are few."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    low, high = axis.get_view_interval()
    if low > 0.0 and high > low:
        is_short = high < 100.0 * low
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if is_short else (1.0,), numticks=9))
        axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda value, _: _format_power(value)))


def _format_power(value: float) -> str:
    mantissa, _, exponent = f"{value:.0e}".partition("e")
    if -3 <= int(exponent) <= 4:
        return f"{value:g}"
    power = "10" + str(int(exponent)).translate(SUPERSCRIPTS)
    return power if mantissa == "1" else f"{mantissa}·{power}"


def _tick_labels(axis: Any) -> list[str]:
    low, high = sorted(axis.get_view_interval())
    positions = [position for position in axis.get_majorticklocs() if low <= position <= high]
    return [str(label) for label in axis.get_major_formatter().format_ticks(positions)]


def _max_label_width(axis: Any) -> float:
    lines = (line for label in _tick_labels(axis) for line in label.split("\n"))
    return max(map(text_width, lines), default=0.0)


def _fixed_labels(axis: Any) -> list[str]:
    """Return the tick labels of an axis with fixed labels, such as runs or dates."""
    from matplotlib.ticker import FixedLocator

    return _tick_labels(axis) if isinstance(axis.get_major_locator(), FixedLocator) else []


def _labels_overlap(axes: Any, labels: Sequence[str], width: float) -> bool:
    """Return whether labels would overlap."""
    low, high = axes.get_xlim()
    distances = np.diff(axes.get_xticks()) * width / (high - low)
    width_pairs = itertools.pairwise(map(text_width, labels))
    return any(
        0.5 * (left_width + right_width) + 6.0 > distance
        for (left_width, right_width), distance in zip(width_pairs, distances, strict=True)
    )


def thin_series(
    series: PlotSeries, *, log_x: bool, log_y: bool
) -> tuple[Array, Array, Array | None, Array | None]:
    """Return the visible points of a series: the lowest and highest in each column of the drawing.

    log_x, log_y: True for logarithmic axes; non-positive values are then omitted.
    Returns: arrays of equal length; gaps are NaN; low and high are None if the series has none.
    """
    x = np.asarray(series.x, dtype=float)
    y, low, high = (
        None if values is None else np.array(values, dtype=float)
        for values in (series.y, series.low, series.high)
    )
    assert y is not None
    if log_y:
        y[~(y > 0.0)] = np.nan
    indices = np.flatnonzero(np.isfinite(x) & ((x > 0.0) | (not log_x)))
    if x[indices].size > (2 * _EXTRA_POINTS if series.kind == "points" else 2 * _THINNING_COLUMNS):
        height = y if low is None or high is None or np.isfinite(y).any() else high - low
        indices = indices[
            _find_extremes(
                np.log(x[indices]) if log_x else x[indices], height[indices], series.kind
            )
        ]
    return (
        x[indices],
        y[indices],
        None if low is None else low[indices],
        None if high is None else high[indices],
    )


def _find_extremes(x: Array, y: Array, series_type: str) -> NDArray[np.intp]:
    """Return the indices to keep, in their order."""
    if series_type != "points" and (np.diff(x) < 0.0).any():
        # A curve with non-monotonic x has no columns.
        return np.arange(x.size)
    span = float(np.ptp(x)) or 1.0
    column = np.minimum((x - x.min()) / span * _THINNING_COLUMNS, _THINNING_COLUMNS - 1).astype(int)
    is_gap = ~np.isfinite(y)
    finite_indices = np.flatnonzero(~is_gap)
    order = finite_indices[np.lexsort((y[finite_indices], column[finite_indices]))]
    column_starts = np.flatnonzero(np.diff(column[order], prepend=-1))
    column_ends = np.append(column_starts[1:], order.size) - 1
    # Keep the first sample of a gap.
    gap_starts = np.flatnonzero(is_gap & ~np.concatenate([[False], is_gap[:-1]]))
    extra = (
        finite_indices[:: max(finite_indices.size // _EXTRA_POINTS, 1)]
        if series_type == "points"
        else finite_indices[:0]
    )
    return np.unique(np.concatenate([order[column_starts], order[column_ends], extra, gap_starts]))


def integer_positions(plot: Plot) -> range:
    """Return the integers from the smallest to the largest x of a plot.

    Empty unless the plot has only points, all at integers (such as harmonics) at most 20 apart.
    """
    positions = {x for series in plot.series for x in series.x}
    if not positions or plot.log_x or any(series.kind != "points" for series in plot.series):
        return range(0)
    has_integers_only = all(float(position).is_integer() for position in positions)
    if not has_integers_only or max(positions) - min(positions) > 20.0:
        return range(0)
    return range(int(min(positions)), int(max(positions)) + 1)


def spread_points(series: Sequence[PlotSeries]) -> list[PlotSeries]:
    """Shift series of points with equal x sideways, so that they do not overlap."""
    points = [row for row in series if row.kind == "points"]
    step = min(0.12, 0.7 / max(len(points), 1))
    shifts = iter(step * (index - 0.5 * (len(points) - 1)) for index in range(len(points)))
    return [
        replace(row, x=tuple(x + shift for x in row.x))
        if row.kind == "points" and (shift := next(shifts))
        else row
        for row in series
    ]


def draw_dots(axes: Any, x: Array, y: Array, diameter: float, **style: Any) -> None:
    """Draw many points as one line of round dots, ten times as fast as markers.

    x, y: Shape (n,).
    **style: Properties of matplotlib's lines.
    """
    nan_values = np.full(x.size, np.nan)
    # A line of zero length from each point to itself: its round caps make the dot.
    axes.plot(
        np.column_stack([x, x, nan_values]).ravel(),
        np.column_stack([y, y, nan_values]).ravel(),
        linewidth=diameter,
        solid_capstyle="round",
        **style,
    )

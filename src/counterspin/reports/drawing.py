"""Drawing of pictures with matplotlib, which is imported on first use."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import zip_longest
from types import ModuleType
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from counterspin.arrays import Array
from counterspin.reports.blocks import Bars, HeatMap, Picture, Plot, PlotSeries, Sphere
from counterspin.reports.chart_layout import (
    HEIGHT,
    WIDTH,
    Margins,
    arrange_axes,
    date_ticks,
    draw_dots,
    legend_columns,
    margins,
    set_decade_ticks,
    shorten_text,
    spread_points,
    text_width,
    thin_series,
    whole_numbers,
    wrap_text,
)
from counterspin.reports.sphere import draw_sphere

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Colours of Okabe and Ito that contrast with white and are safe for colour-blind readers; the
#: markers distinguish the series without colour.
COLOURS: Final = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
MARKERS: Final = ("o", "^", "s", "D", "v", "P")

PAPER_COLOURS: Final = {
    "ink": "#1a1c1f",
    "muted": "#5c6670",
    "grid": "#e3e6e9",
    "ground": "#ffffff",
    **{f"series-{index}": colour for index, colour in enumerate(COLOURS, 1)},
    "warning": "#b3261e",
    "negative": "#2166ac",
    "positive": "#b35806",
}

Palette = Mapping[str, str]

#: Largest opacity of a heat map's cell: text on it keeps a contrast of 4.5 (WCAG 2.1, 1.4.3).
_MAX_SHADE: Final = 0.6

#: Largest number of points drawn with markers; more are drawn as dots.
_MAX_MARKERS: Final = 150

#: Largest heat map with numbers in its cells.
_MAX_NUMBERED_CELLS: Final = 16


def _matplotlib() -> ModuleType:
    """Load matplotlib, without the working folder's settings where that may be anybody's.

    It looks for them there first, and nothing but a lie prevents that: they can make it run LaTeX,
    wait for a pipe, or fail. PYTHONSAFEPATH says that the folder is not to be trusted; the command
    sets it, for itself and for what it starts.
    """
    exists = os.path.exists
    if os.environ.get("PYTHONSAFEPATH"):
        os.path.exists = lambda path: path != "matplotlibrc" and exists(path)
    try:
        import matplotlib as mpl
    finally:
        os.path.exists = exists
    return mpl


@contextmanager
def settings(palette: Palette) -> Iterator[None]:
    """Set matplotlib's parameters while figures are made and written, and put them back after.

    The same picture gives the same file: no random names are in it.
    """
    mpl = _matplotlib()
    parameters: dict[Any, Any] = {
        "svg.hashsalt": "counterspin",
        "svg.fonttype": "none",
        "pdf.fonttype": 42,
        "figure.facecolor": palette["ground"],
        "axes.facecolor": "none",
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.grid": True,
        "axes.axisbelow": True,
        "axes.edgecolor": palette["muted"],
        "axes.labelcolor": palette["ink"],
        "axes.linewidth": 0.7,
        "axes.titlelocation": "left",
        "axes.titlesize": "medium",
        "axes.titleweight": "bold",
        "axes.titlecolor": palette["ink"],
        # No common offset above the axis: show all digits at each tick.
        "axes.formatter.useoffset": False,
        "axes.formatter.use_mathtext": False,
        "font.size": 9.0,
        "lines.markeredgewidth": 0.9,
        # Path simplification would drop the lines of zero length of `draw_dots`.
        "path.simplify": False,
        "text.color": palette["ink"],
        # User text may contain dollar signs.
        "text.parse_math": False,
        "xtick.color": palette["muted"],
        "ytick.color": palette["muted"],
        "xtick.labelcolor": palette["ink"],
        "ytick.labelcolor": palette["ink"],
        "xtick.major.size": 2.5,
        "ytick.major.size": 2.5,
        "grid.color": palette["grid"],
        "grid.linewidth": 0.6,
        "legend.frameon": False,
        "legend.borderpad": 0.0,
        "legend.borderaxespad": 0.3,
        "legend.handlelength": 1.6,
        "legend.columnspacing": 1.4,
    }
    with mpl.rc_context(parameters), warnings.catch_warnings():
        # Text stays text, so missing glyphs of matplotlib's font do not matter.
        warnings.filterwarnings("ignore", "Glyph")
        yield


def draw_pictures(pictures: Sequence[Picture], palette: Palette, *, titled: bool) -> Figure:
    """Draw stacked pictures, within `settings`.

    titled: True to draw each title above its picture, if nothing else shows it.
    """
    from matplotlib.figure import Figure

    figure = Figure()
    panels = []
    for picture, below in zip_longest(pictures, pictures[1:]):
        axes = figure.add_subplot()
        title = picture.title if titled else ""
        panels.append((axes, _draw_picture(axes, picture, palette, title, below)))
    arrange_axes(figure, panels)
    return figure


def draw_on_axes(axes: Any, picture: Picture) -> None:
    """Draw a picture with its title on given axes, within `settings`."""
    room = _draw_picture(axes, picture, PAPER_COLOURS, picture.title, None)
    axes.set_title(picture.title, pad=room.pad)


def _draw_picture(
    axes: Any, picture: Picture, palette: Palette, title: str, below: Picture | None
) -> Margins:
    match picture:
        case Plot():
            return _draw_plot(axes, picture, palette, title, below)
        case Bars():
            return _draw_bars(axes, picture, palette, title)
        case HeatMap():
            return _draw_heat_map(axes, picture, palette, title)
        case Sphere():
            return draw_sphere(axes, picture, palette, title)


def _draw_plot(
    axes: Any, plot: Plot, palette: Palette, title: str, below: Picture | None
) -> Margins:
    counts = whole_numbers(plot)
    rows = spread_points(plot.series) if counts or plot.x_names else plot.series
    for series, place_in_row in zip(rows, colour_indices(plot.series), strict=True):
        colour, marker = palette["muted"], MARKERS[0]
        if series.stands_out:
            colour, marker = palette["warning"], "X"
        elif place_in_row is not None:
            colour = palette[f"series-{place_in_row + 1}"]
            marker = MARKERS[place_in_row]
        _draw_series(axes, series, plot, palette["ground"], (colour, marker))
    for level in plot.levels:
        axes.axhline(level, color=palette["muted"], linewidth=0.8, dashes=(4.0, 2.0), zorder=1.5)
    for axis, name, logarithmic in ((axes.xaxis, "x", plot.log_x), (axes.yaxis, "y", plot.log_y)):
        if logarithmic:
            axes.set(**{f"{name}scale": "log"})
            set_decade_ticks(axis)
    axes.margins(x=0.06 if plot.x_names else 0.015, y=0.06)
    if counts:
        axes.set_xlim(counts[0] - 0.6, counts[-1] + 0.6)
        axes.set_xticks(counts)
    axes.set(xlim=plot.x_range, ylim=plot.y_range, title=title, ylabel=plot.y_label)
    if plot.x_names:
        room = max(90.0, (WIDTH - 80.0) / len(plot.x_names))
        axes.set_xticks(
            range(len(plot.x_names)), [shorten_text(name, room) for name in plot.x_names]
        )
        axes.grid(visible=False, axis="x")
    if plot.dates:
        axes.set_xticks(*date_ticks(*axes.get_xlim()))
    if _shares_axis(plot, below):
        axes.tick_params(axis="x", labelbottom=False)
    else:
        axes.set_xlabel(plot.x_label)
    labels = [series.label for series in plot.series if series.label]
    columns = legend_columns(labels)
    if labels:
        axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=columns)
    return margins(axes, plot.height * HEIGHT, legend_rows=-(-len(labels) // columns))


def colour_indices(rows: Sequence[PlotSeries]) -> list[int | None]:
    """Return the colour index of each series; None for muted series and warnings."""
    places: list[int | None] = []
    taken = 0
    for row in rows:
        if row.stands_out or row.colour == "muted":
            places.append(None)
        elif row.colour is not None:
            places.append(row.colour % len(COLOURS))
        elif row.kind == "band" and not row.label:
            places.append(None)
        else:
            places.append(taken % len(COLOURS))
            taken += 1
    return places


def _shares_axis(plot: Plot, below: Picture | None) -> bool:
    """Return whether the picture below has the same axis, so that labels can be omitted."""
    return (
        isinstance(below, Plot)
        and bool(plot.x_range or plot.x_names)
        and (plot.x_label, plot.x_range, plot.x_names)
        == (below.x_label, below.x_range, below.x_names)
    )


def _draw_series(
    axes: Any, series: PlotSeries, plot: Plot, ground: str, look: tuple[str, str]
) -> None:
    colour, marker = look
    x, y, low, high = thin_series(series, log_x=plot.log_x, log_y=plot.log_y)
    if series.kind == "points":
        if low is not None:
            axes.vlines(x, low, high, colors=colour, linewidth=0.9)
        above = 2.6 if series.stands_out else 2.2
        style = {"linestyle": "none", "marker": marker, "color": colour, "zorder": above}
        if x.size > _MAX_MARKERS:
            draw_dots(axes, x, y, 1.6, color=colour, zorder=above)
            axes.plot([], [], label=series.label or None, **style | {"marker": "o"}, markersize=3.0)
        else:
            filled = colour if series.stands_out else ground
            axes.plot(
                x, y, label=series.label or None, markersize=4.5, markerfacecolor=filled, **style
            )
        return
    if series.kind == "columns":
        width = float(x[1] - x[0]) if x.size > 1 else 1.0
        axes.bar(x, y, width, label=series.label or None, facecolor=(colour, 0.4), linewidth=0.0)
    if low is not None:
        band = axes.fill_between(x, low, high, facecolor=(colour, 0.18), linewidth=0.0, zorder=1.2)
        if series.kind == "band":
            # The edge makes a band of single samples visible.
            band.set(label=series.label or None, edgecolor=(colour, 0.6), linewidth=0.4)
    if series.kind == "line":
        axes.plot(x, y, color=colour, linewidth=1.1, label=series.label or None, zorder=2.1)
        seen = np.concatenate([[False], np.isfinite(y), [False]])
        alone = seen[1:-1] & ~seen[:-2] & ~seen[2:]
        if alone.any():
            draw_dots(axes, x[alone], y[alone], 2.5, color=colour, zorder=2.1)


def _draw_bars(axes: Any, bars: Bars, palette: Palette, title: str) -> Margins:
    place = range(len(bars.labels))
    values = np.asarray(bars.values, dtype=float)
    chosen = [palette[f"series-{k + 1}"] for k in bars.colours or (0,) * len(bars.labels)]
    starts = np.cumsum(values) - values if bars.stacked else np.zeros(values.size)
    axes.barh(place, values, 0.62, left=starts, color=chosen)
    values = values + starts
    largest = float(np.max(np.abs(values), initial=0.0)) or 1.0
    left = 0.45 * WIDTH
    labels = [wrap_text(label, left) for label in bars.labels]
    widest = max((text_width(line) for label in labels for line in label.split("\n")), default=0.0)
    axes.set_yticks(place, labels)
    axes.tick_params(axis="y", length=0.0)
    axes.grid(visible=False)
    if bars.x_label:
        axes.set_xlabel(bars.x_label)
    else:
        axes.set_xticks([])
        axes.spines[["bottom"]].set_visible(False)
    axes.set_ylim(len(labels) - 0.4, -0.6)
    for at, value, text in zip(place, values, bars.texts, strict=True):
        axes.annotate(
            text,
            (value, at),
            xytext=(4.0 if value >= 0.0 else -4.0, 0.0),
            textcoords="offset points",
            horizontalalignment="left" if value >= 0.0 else "right",
            verticalalignment="center",
        )
    # The texts have fixed widths; the bars get the remaining width.
    words = max(map(text_width, bars.texts), default=0.0) + 6.0
    room = WIDTH - widest - 12.0
    both_ways = bool((values < 0.0).any())
    reach = largest * room / max(room - words * (2.0 if both_ways else 1.0), 0.3 * room)
    axes.set_xlim(-reach if both_ways else 0.0, reach)
    if bars.x_label:
        # None beyond the bars, where their texts are.
        axes.set_xticks([x for x in axes.get_xticks() if abs(x) < 1.001 * largest])
    if both_ways:
        axes.axvline(0.0, color=palette["muted"], linewidth=0.7)
        axes.spines[["left"]].set_visible(False)
    axes.set_title(title)
    row = 17.0 + 11.0 * max((label.count("\n") for label in labels), default=0)
    return margins(axes, 6.0 + row * max(len(labels), 1), right=2.0)


def _draw_heat_map(axes: Any, heat_map: HeatMap, palette: Palette, title: str) -> Margins:
    from matplotlib.collections import PolyCollection

    size = len(heat_map.labels)
    values = np.asarray(heat_map.values, dtype=float).reshape(size, size)
    rows, columns = (at.ravel() for at in np.indices((size, size)))
    corners = np.array([[0.03, 0.04], [0.97, 0.04], [0.97, 0.96], [0.03, 0.96]])
    cells = np.stack([columns, rows], axis=1)[:, None, :] + corners
    axes.add_collection(
        PolyCollection(cells, facecolors=_cell_colours(values, palette), linewidths=0.0)
    )
    labels = [shorten_text(label, 130.0) for label in heat_map.labels]
    widest = max(map(text_width, labels), default=0.0)
    wide = min(46.0, (WIDTH - widest - 12.0) / max(size, 1))
    if size <= _MAX_NUMBERED_CELLS:
        for row, column, value in zip(rows, columns, values.ravel(), strict=True):
            text = "1" if row == column else f"{round(value, 2) + 0.0:.2f}".replace("-", "−")
            axes.text(
                column + 0.5,
                row + 0.5,
                text,
                horizontalalignment="center",
                verticalalignment="center_baseline",
                fontsize=min(8.5, 0.36 * wide),
                color=palette["muted" if row == column else "ink"],
            )
    upright = widest > wide - 4.0
    axes.set_xticks(np.arange(size) + 0.5, labels, rotation=90.0 if upright else 0.0)
    axes.set_yticks(np.arange(size) + 0.5, labels)
    axes.tick_params(length=0.0, labelbottom=False, labeltop=True)
    axes.grid(visible=False)
    axes.spines[:].set_visible(False)
    axes.set(xlim=(0.0, max(size, 1)), ylim=(max(size, 1), 0.0))
    top = (widest if upright else 9.0) + 8.0
    height = min(22.0, wide) * size
    axes.set_title(title)
    right = WIDTH - widest - 12.0 - wide * size
    return margins(axes, top + height + 2.0, top=top, right=right)


def _cell_colours(values: Array, palette: Palette) -> Array:
    """Return a colour and an opacity for every cell, shape (n n, 4); the diagonal is grey."""
    from matplotlib.colors import to_rgba

    tints = np.array(
        [to_rgba(palette["positive" if v >= 0.0 else "negative"]) for v in values.flat]
    )
    tints = tints.reshape(-1, 4)
    tints[:, 3] = _MAX_SHADE * np.minimum(np.abs(values.ravel()), 1.0)
    tints[:: len(values) + 1] = to_rgba(palette["grid"])
    return tints

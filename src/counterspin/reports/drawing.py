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
    AXES_HEIGHT,
    DRAWING_WIDTH,
    Margins,
    arrange_axes,
    compute_margins,
    count_legend_columns,
    date_ticks,
    draw_dots,
    integer_positions,
    set_decade_ticks,
    shorten_text,
    spread_points,
    text_width,
    thin_series,
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
_MAX_OPACITY: Final = 0.6

#: Largest number of points drawn with markers; more are drawn as dots.
_MAX_MARKERS: Final = 150

#: Largest heat map with numbers in its cells.
_MAX_NUMBERED_CELLS: Final = 16


def _import_matplotlib() -> ModuleType:
    """Import matplotlib, ignoring a matplotlibrc in an untrusted working folder.

    Matplotlib reads it first, and only a patched `os.path.exists` prevents this: such settings can
    make it run LaTeX, block on a pipe, or fail. PYTHONSAFEPATH marks the folder as untrusted; the
    command line sets it for itself and its child processes.
    """
    path_exists = os.path.exists
    if os.environ.get("PYTHONSAFEPATH"):
        os.path.exists = lambda path: path != "matplotlibrc" and path_exists(path)
    try:
        import matplotlib as mpl
    finally:
        os.path.exists = path_exists
    return mpl


@contextmanager
def drawing_parameters(palette: Palette) -> Iterator[None]:
    """Set matplotlib's parameters temporarily, for drawing and writing figures.

    The same picture gives the same file, because ids are not random.
    """
    mpl = _import_matplotlib()
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


def draw_pictures(pictures: Sequence[Picture], palette: Palette, *, show_titles: bool) -> Figure:
    """Draw stacked pictures, within `drawing_parameters`.

    show_titles: True to draw each title above its picture, if nothing else shows it.
    """
    from matplotlib.figure import Figure

    figure = Figure()
    panels = []
    for picture, next_picture in zip_longest(pictures, pictures[1:]):
        axes = figure.add_subplot()
        title = picture.title if show_titles else ""
        panels.append((axes, _draw_picture(axes, picture, palette, title, next_picture)))
    arrange_axes(figure, panels)
    return figure


def draw_on_axes(axes: Any, picture: Picture) -> None:
    """Draw a picture with its title on given axes, within `drawing_parameters`."""
    margins = _draw_picture(axes, picture, PAPER_COLOURS, picture.title, None)
    axes.set_title(picture.title, pad=margins.pad)


def _draw_picture(
    axes: Any, picture: Picture, palette: Palette, title: str, next_picture: Picture | None
) -> Margins:
    match picture:
        case Plot():
            return _draw_plot(axes, picture, palette, title, next_picture)
        case Bars():
            return _draw_bars(axes, picture, palette, title)
        case HeatMap():
            return _draw_heat_map(axes, picture, palette, title)
        case Sphere():
            return draw_sphere(axes, picture, palette, title)


def _draw_plot(
    axes: Any, plot: Plot, palette: Palette, title: str, next_picture: Picture | None
) -> Margins:
    integer_ticks = integer_positions(plot)
    drawn_series = spread_points(plot.series) if integer_ticks or plot.x_names else plot.series
    for series, colour_index in zip(drawn_series, colour_indices(plot.series), strict=True):
        colour, marker = palette["muted"], MARKERS[0]
        if series.is_highlighted:
            colour, marker = palette["warning"], "X"
        elif colour_index is not None:
            colour = palette[f"series-{colour_index + 1}"]
            marker = MARKERS[colour_index]
        _draw_series(axes, series, plot, palette["ground"], (colour, marker))
    for level in plot.levels:
        axes.axhline(level, color=palette["muted"], linewidth=0.8, dashes=(4.0, 2.0), zorder=1.5)
    for axis, name, is_logarithmic in (
        (axes.xaxis, "x", plot.log_x),
        (axes.yaxis, "y", plot.log_y),
    ):
        if is_logarithmic:
            axes.set(**{f"{name}scale": "log"})
            set_decade_ticks(axis)
    axes.margins(x=0.06 if plot.x_names else 0.015, y=0.06)
    if integer_ticks:
        axes.set_xlim(integer_ticks[0] - 0.6, integer_ticks[-1] + 0.6)
        axes.set_xticks(integer_ticks)
    axes.set(xlim=plot.x_range, ylim=plot.y_range, title=title, ylabel=plot.y_label)
    if plot.x_names:
        label_width = max(90.0, (DRAWING_WIDTH - 80.0) / len(plot.x_names))
        axes.set_xticks(
            range(len(plot.x_names)), [shorten_text(name, label_width) for name in plot.x_names]
        )
        axes.grid(visible=False, axis="x")
    if plot.is_date_axis:
        axes.set_xticks(*date_ticks(*axes.get_xlim()))
    if _shares_axis(plot, next_picture):
        axes.tick_params(axis="x", labelbottom=False)
    else:
        axes.set_xlabel(plot.x_label)
    labels = [series.label for series in plot.series if series.label]
    columns = count_legend_columns(labels)
    if labels:
        axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=columns)
    return compute_margins(axes, plot.height * AXES_HEIGHT, legend_rows=-(-len(labels) // columns))


def colour_indices(all_series: Sequence[PlotSeries]) -> list[int | None]:
    """Return the colour index of each series; None for muted series and warnings."""
    indices: list[int | None] = []
    n_used = 0
    for series in all_series:
        if series.is_highlighted or series.colour == "muted":
            indices.append(None)
        elif series.colour is not None:
            indices.append(series.colour % len(COLOURS))
        elif series.kind == "band" and not series.label:
            indices.append(None)
        else:
            indices.append(n_used % len(COLOURS))
            n_used += 1
    return indices


def _shares_axis(plot: Plot, next_picture: Picture | None) -> bool:
    """Return whether the picture below has the same axis, so that labels can be omitted."""
    return (
        isinstance(next_picture, Plot)
        and bool(plot.x_range or plot.x_names)
        and (plot.x_label, plot.x_range, plot.x_names)
        == (next_picture.x_label, next_picture.x_range, next_picture.x_names)
    )


def _draw_series(
    axes: Any, series: PlotSeries, plot: Plot, background: str, colour_and_marker: tuple[str, str]
) -> None:
    colour, marker = colour_and_marker
    x, y, low, high = thin_series(series, log_x=plot.log_x, log_y=plot.log_y)
    if series.kind == "points":
        if low is not None:
            axes.vlines(x, low, high, colors=colour, linewidth=0.9)
        zorder = 2.6 if series.is_highlighted else 2.2
        style = {"linestyle": "none", "marker": marker, "color": colour, "zorder": zorder}
        if x.size > _MAX_MARKERS:
            draw_dots(axes, x, y, 1.6, color=colour, zorder=zorder)
            axes.plot([], [], label=series.label or None, **style | {"marker": "o"}, markersize=3.0)
        else:
            face_colour = colour if series.is_highlighted else background
            axes.plot(
                x,
                y,
                label=series.label or None,
                markersize=4.5,
                markerfacecolor=face_colour,
                **style,
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
        is_finite = np.concatenate([[False], np.isfinite(y), [False]])
        is_isolated = is_finite[1:-1] & ~is_finite[:-2] & ~is_finite[2:]
        if is_isolated.any():
            draw_dots(axes, x[is_isolated], y[is_isolated], 2.5, color=colour, zorder=2.1)


def _draw_bars(axes: Any, bars: Bars, palette: Palette, title: str) -> Margins:
    positions = range(len(bars.labels))
    values = np.asarray(bars.values, dtype=float)
    colours = [palette[f"series-{k + 1}"] for k in bars.colours or (0,) * len(bars.labels)]
    bar_starts = np.cumsum(values) - values if bars.stacked else np.zeros(values.size)
    axes.barh(positions, values, 0.62, left=bar_starts, color=colours)
    values = values + bar_starts
    max_value = float(np.max(np.abs(values), initial=0.0)) or 1.0
    max_label_width = 0.45 * DRAWING_WIDTH
    labels = [wrap_text(label, max_label_width) for label in bars.labels]
    lines = (line for label in labels for line in label.split("\n"))
    label_width = max(map(text_width, lines), default=0.0)
    axes.set_yticks(positions, labels)
    axes.tick_params(axis="y", length=0.0)
    axes.grid(visible=False)
    if bars.x_label:
        axes.set_xlabel(bars.x_label)
    else:
        axes.set_xticks([])
        axes.spines[["bottom"]].set_visible(False)
    axes.set_ylim(len(labels) - 0.4, -0.6)
    for position, value, text in zip(positions, values, bars.texts, strict=True):
        axes.annotate(
            text,
            (value, position),
            xytext=(4.0 if value >= 0.0 else -4.0, 0.0),
            textcoords="offset points",
            horizontalalignment="left" if value >= 0.0 else "right",
            verticalalignment="center",
        )
    # The texts have fixed widths; the bars get the remaining width.
    text_margin = max(map(text_width, bars.texts), default=0.0) + 6.0
    available_width = DRAWING_WIDTH - label_width - 12.0
    has_negative = bool((values < 0.0).any())
    axis_limit = (
        max_value
        * available_width
        / max(available_width - text_margin * (2.0 if has_negative else 1.0), 0.3 * available_width)
    )
    axes.set_xlim(-axis_limit if has_negative else 0.0, axis_limit)
    if bars.x_label:
        # No ticks beyond the bars, where the texts are.
        axes.set_xticks([x for x in axes.get_xticks() if abs(x) < 1.001 * max_value])
    if has_negative:
        axes.axvline(0.0, color=palette["muted"], linewidth=0.7)
        axes.spines[["left"]].set_visible(False)
    axes.set_title(title)
    row_height = 17.0 + 11.0 * max((label.count("\n") for label in labels), default=0)
    return compute_margins(axes, 6.0 + row_height * max(len(labels), 1), right=2.0)


def _draw_heat_map(axes: Any, heat_map: HeatMap, palette: Palette, title: str) -> Margins:
    from matplotlib.collections import PolyCollection

    n_labels = len(heat_map.labels)
    values = np.asarray(heat_map.values, dtype=float).reshape(n_labels, n_labels)
    rows, columns = (index_grid.ravel() for index_grid in np.indices((n_labels, n_labels)))
    corner_offsets = np.array([[0.03, 0.04], [0.97, 0.04], [0.97, 0.96], [0.03, 0.96]])
    cells = np.stack([columns, rows], axis=1)[:, None, :] + corner_offsets
    colours = _cell_colours(values, palette)
    axes.add_collection(PolyCollection(cells, facecolors=colours, linewidths=0.0))
    labels = [shorten_text(label, 130.0) for label in heat_map.labels]
    label_width = max(map(text_width, labels), default=0.0)
    cell_width = min(46.0, (DRAWING_WIDTH - label_width - 12.0) / max(n_labels, 1))
    if n_labels <= _MAX_NUMBERED_CELLS:
        for row, column, value in zip(rows, columns, values.ravel(), strict=True):
            text = "1" if row == column else f"{round(value, 2) + 0.0:.2f}".replace("-", "−")
            axes.text(
                column + 0.5,
                row + 0.5,
                text,
                horizontalalignment="center",
                verticalalignment="center_baseline",
                fontsize=min(8.5, 0.36 * cell_width),
                color=palette["muted" if row == column else "ink"],
            )
    is_vertical = label_width > cell_width - 4.0
    axes.set_xticks(np.arange(n_labels) + 0.5, labels, rotation=90.0 if is_vertical else 0.0)
    axes.set_yticks(np.arange(n_labels) + 0.5, labels)
    axes.tick_params(length=0.0, labelbottom=False, labeltop=True)
    axes.grid(visible=False)
    axes.spines[:].set_visible(False)
    axes.set(xlim=(0.0, max(n_labels, 1)), ylim=(max(n_labels, 1), 0.0))
    top_margin = (label_width if is_vertical else 9.0) + 8.0
    height = min(22.0, cell_width) * n_labels
    axes.set_title(title)
    right_margin = DRAWING_WIDTH - label_width - 12.0 - cell_width * n_labels
    return compute_margins(axes, top_margin + height + 2.0, top=top_margin, right=right_margin)


def _cell_colours(values: Array, palette: Palette) -> Array:
    """Return colour and opacity of each cell, shape (n**2, 4); the diagonal is grey."""
    from matplotlib.colors import to_rgba

    colours = np.array(
        [to_rgba(palette["positive" if value >= 0.0 else "negative"]) for value in values.flat]
    )
    colours = colours.reshape(-1, 4)
    colours[:, 3] = _MAX_OPACITY * np.minimum(np.abs(values.ravel()), 1.0)
    colours[:: len(values) + 1] = to_rgba(palette["grid"])
    return colours

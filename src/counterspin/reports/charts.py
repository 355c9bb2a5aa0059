"""Pictures of a report as SVG: for paper, and for a page that chooses its own colours and font.

matplotlib is imported only when a picture is drawn. The same picture gives the same text, byte for
byte. A picture's title is not drawn, for whoever shows the picture sets it in words; it is the
SVG's ``<title>``, which is read to those who do not see it.

- `svg`: one picture, without prolog, to stand in a page or in a file
- `COLOURS_OF_PAPER`: name of each colour and what it is on paper

For the theme "page" every colour is a CSS custom property, which falls back to its colour on
paper: ``--ink`` (words and axes; falls back to ``currentColor``), ``--muted`` (levels, ticks),
``--grid``, ``--ground`` (what is behind: the inside of markers), ``--series-1`` to ``--series-6``,
``--warning`` (what stands out), ``--negative`` and ``--positive`` (ends of the heat map, laid over
the ground with an opacity of at most 0.6, so that words in ink are read on both). Words take the
font of the page. All is drawn 504 units wide with words 9 units high, and scales to the width that
it gets; at 700 pixels and more the words are as large as the page's.
"""

from __future__ import annotations

import hashlib
import io
import re
import warnings
from html import escape
from typing import Any, Final, Literal

import numpy as np

from counterspin.arrays import Array
from counterspin.reports.blocks import Bars, HeatMap, Picture, Plot, PlotSeries
from counterspin.reports.chart_layout import (
    HEIGHT,
    WIDTH,
    decades,
    dots,
    legend_columns,
    set_margins,
    shortened,
    spread,
    text_width,
    thinned,
    whole_numbers,
)
from counterspin.reports.figure import COLOURS, MARKERS, SETTINGS

Theme = Literal["light", "page"]

COLOURS_OF_PAPER: Final = {
    "ink": "#1a1c1f",
    "muted": "#5c6670",
    "grid": "#e3e6e9",
    "ground": "#ffffff",
    **{f"series-{index}": colour for index, colour in enumerate(COLOURS, 1)},
    "warning": "#b3261e",
    "negative": "#2166ac",
    "positive": "#b35806",
}

#: What each colour is while it is drawn: a colour that is found again in the text afterwards.
_DRAWN: Final = {name: f"#01{index:02x}fe" for index, name in enumerate(COLOURS_OF_PAPER)}
_NAMES: Final = {drawn: name for name, drawn in _DRAWN.items()}

_FONT_OF_PAPER: Final = "'Libertinus Serif', 'DejaVu Sans', serif"

#: Words over the strongest cell of a heat map keep a contrast of 4.5 (WCAG 2.1, 1.4.3).
_STRONGEST: Final = 0.6

#: More points than this are drawn as dots.
_CROWD: Final = 150

#: Numbers are written into the cells of heat maps up to this size.
_NUMBERED: Final = 16

_SETTINGS: Final[dict[Any, Any]] = {
    **SETTINGS,
    "figure.facecolor": "none",
    "axes.facecolor": "none",
    "axes.edgecolor": _DRAWN["muted"],
    "axes.labelcolor": _DRAWN["ink"],
    "axes.linewidth": 0.7,
    "lines.markeredgewidth": 0.9,
    # It would drop the lines without length that `dots` draws.
    "path.simplify": False,
    "axes.axisbelow": True,
    "axes.formatter.useoffset": False,
    "axes.formatter.use_mathtext": False,
    "text.color": _DRAWN["ink"],
    # What a person wrote may hold dollar signs.
    "text.parse_math": False,
    "xtick.color": _DRAWN["muted"],
    "ytick.color": _DRAWN["muted"],
    "xtick.labelcolor": _DRAWN["ink"],
    "ytick.labelcolor": _DRAWN["ink"],
    "xtick.major.size": 2.5,
    "ytick.major.size": 2.5,
    "grid.color": _DRAWN["grid"],
    "legend.borderpad": 0.0,
    "legend.borderaxespad": 0.3,
    "legend.handlelength": 1.6,
    "legend.columnspacing": 1.4,
}


def svg(picture: Picture, *, theme: Theme = "light") -> str:
    """Draw a picture.

    Parameters
    ----------
    picture
        What is drawn.
    theme
        "light": for paper. "page": every colour is a CSS custom property, and words take the
        font of the page in which the SVG stands.

    Returns
    -------
    str
        An ``<svg>`` element that fills the width it is given. Its ids differ from those of every
        other picture.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context(_SETTINGS), warnings.catch_warnings():
        # Words are written as words: that matplotlib's own font lacks a letter does not matter.
        warnings.filterwarnings("ignore", "Glyph")
        figure = Figure()
        axes = figure.add_subplot()
        match picture:
            case Plot():
                _draw_plot(axes, picture)
            case Bars():
                _draw_bars(axes, picture)
            case HeatMap():
                _draw_heat_map(axes, picture)
        stream = io.StringIO()
        figure.savefig(stream, format="svg", transparent=True, metadata={"Date": None})
    return _cleaned(stream.getvalue(), picture, theme)


# The three kinds


def _draw_plot(axes: Any, plot: Plot) -> None:
    taken = 0
    counts = whole_numbers(plot)
    for series in spread(plot.series) if counts or plot.x_names else plot.series:
        colour, marker = _DRAWN["muted"], MARKERS[0]
        if series.stands_out:
            colour, marker = _DRAWN["warning"], "X"
        elif series.label or series.kind != "band":
            colour = _DRAWN[f"series-{taken % len(COLOURS) + 1}"]
            marker = MARKERS[taken % len(MARKERS)]
            taken += 1
        _draw_series(axes, series, plot, colour, marker)
    for level in plot.levels:
        axes.axhline(level, color=_DRAWN["muted"], linewidth=0.8, dashes=(4.0, 2.0), zorder=1.5)
    for axis, name, logarithmic in ((axes.xaxis, "x", plot.log_x), (axes.yaxis, "y", plot.log_y)):
        if logarithmic:
            axes.set(**{f"{name}scale": "log"})
            decades(axis)
    axes.margins(x=0.06 if plot.x_names else 0.015, y=0.06)
    if counts:
        axes.set_xlim(counts[0] - 0.6, counts[-1] + 0.6)
        axes.set_xticks(counts)
    if plot.x_names:
        axes.set_xticks(range(len(plot.x_names)), [shortened(name, 90.0) for name in plot.x_names])
        axes.grid(visible=False, axis="x")
    axes.set_xlabel(plot.x_label)
    axes.set_ylabel(plot.y_label)
    labels = [series.label for series in plot.series if series.label]
    columns = legend_columns(labels)
    if labels:
        axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=columns)
    set_margins(axes, HEIGHT, legend_rows=-(-len(labels) // columns))


def _draw_series(axes: Any, series: PlotSeries, plot: Plot, colour: str, marker: str) -> None:
    x, y, low, high = thinned(series, log_x=plot.log_x, log_y=plot.log_y)
    if series.kind == "points":
        if low is not None:
            axes.vlines(x, low, high, colors=colour, linewidth=0.9)
        above = 2.6 if series.stands_out else 2.2
        style = {"linestyle": "none", "marker": marker, "color": colour, "zorder": above}
        if x.size > _CROWD:
            dots(axes, x, y, 1.6, color=colour, zorder=above)
            axes.plot([], [], label=series.label or None, **style | {"marker": "o"}, markersize=3.0)
        else:
            filled = colour if series.stands_out else _DRAWN["ground"]
            axes.plot(
                x, y, label=series.label or None, markersize=4.5, markerfacecolor=filled, **style
            )
        return
    if low is not None:
        band = axes.fill_between(x, low, high, facecolor=(colour, 0.18), linewidth=0.0, zorder=1.2)
        if series.kind == "band":
            # With an edge: a band of single samples has no width, and yet is seen.
            band.set(label=series.label or None, edgecolor=(colour, 0.6), linewidth=0.4)
    if series.kind == "line":
        axes.plot(x, y, color=colour, linewidth=1.1, label=series.label or None, zorder=2.1)
        seen = np.concatenate([[False], np.isfinite(y), [False]])
        alone = seen[1:-1] & ~seen[:-2] & ~seen[2:]
        if alone.any():
            dots(axes, x[alone], y[alone], 2.5, color=colour, zorder=2.1)


def _draw_bars(axes: Any, bars: Bars) -> None:
    place = range(len(bars.labels))
    values = np.asarray(bars.values, dtype=float)
    axes.barh(place, values, 0.62, color=_DRAWN["series-1"])
    largest = float(np.max(np.abs(values), initial=0.0)) or 1.0
    left = 0.45 * WIDTH
    labels = [shortened(label, left) for label in bars.labels]
    axes.set_yticks(place, labels)
    axes.tick_params(axis="y", length=0.0)
    axes.set_xticks([])
    axes.grid(visible=False)
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
    # The words at the ends are as wide as they are, so the bars get what is left.
    words = max(map(text_width, bars.texts), default=0.0) + 6.0
    room = WIDTH - max(map(text_width, labels), default=0.0) - 12.0
    both_ways = bool((values < 0.0).any())
    reach = largest * room / max(room - words * (2.0 if both_ways else 1.0), 0.3 * room)
    axes.set_xlim(-reach if both_ways else 0.0, reach)
    if both_ways:
        axes.axvline(0.0, color=_DRAWN["muted"], linewidth=0.7)
        axes.spines[["left"]].set_visible(False)
    set_margins(axes, 6.0 + 17.0 * max(len(labels), 1), right=2.0)


def _draw_heat_map(axes: Any, heat_map: HeatMap) -> None:
    from matplotlib.collections import PolyCollection

    size = len(heat_map.labels)
    values = np.asarray(heat_map.values, dtype=float).reshape(size, size)
    rows, columns = (at.ravel() for at in np.indices((size, size)))
    corners = np.array([[0.03, 0.04], [0.97, 0.04], [0.97, 0.96], [0.03, 0.96]])
    cells = np.stack([columns, rows], axis=1)[:, None, :] + corners
    axes.add_collection(PolyCollection(cells, facecolors=_tints(values), linewidths=0.0))
    labels = [shortened(label, 130.0) for label in heat_map.labels]
    widest = max(map(text_width, labels), default=0.0)
    wide = min(46.0, (WIDTH - widest - 12.0) / max(size, 1))
    if size <= _NUMBERED:
        for row, column, value in zip(rows, columns, values.ravel(), strict=True):
            text = "1" if row == column else f"{round(value, 2) + 0.0:.2f}".replace("-", "−")
            axes.text(
                column + 0.5,
                row + 0.5,
                text,
                horizontalalignment="center",
                verticalalignment="center_baseline",
                fontsize=min(8.5, 0.36 * wide),
                color=_DRAWN["muted" if row == column else "ink"],
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
    set_margins(axes, top + height + 2.0, top=top, right=WIDTH - widest - 12.0 - wide * size)


def _tints(values: Array) -> Array:
    """Return a colour and an opacity for every cell, shape (n n, 4); the diagonal is grey."""
    from matplotlib.colors import to_rgba

    tints = np.array([to_rgba(_DRAWN["positive" if v >= 0.0 else "negative"]) for v in values.flat])
    tints = tints.reshape(-1, 4)
    tints[:, 3] = _STRONGEST * np.minimum(np.abs(values.ravel()), 1.0)
    tints[:: len(values) + 1] = to_rgba(_DRAWN["grid"])
    return tints


# From matplotlib's file to an element of a page


def _cleaned(text: str, picture: Picture, theme: Theme) -> str:
    """Return matplotlib's SVG without prolog, metadata, size, foreign font and common ids."""
    text = text[text.index("<svg") :].rstrip()
    text = re.sub(r"\s*<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    # It would hold for the whole page.
    text = re.sub(r"\s*<defs>\s*<style.*?</style>\s*</defs>", "", text, flags=re.DOTALL)
    text = re.sub(r"\s*<!--.*?-->", "", text, flags=re.DOTALL)
    used = set(re.findall(r'(?:href="#|url\(#)([^")]+)', text))
    salt = (
        "p"
        + hashlib.sha256(f"{picture.title}{theme}{text}".encode(errors="replace")).hexdigest()[:10]
    )

    def cleaned_tag(found: re.Match[str]) -> str:
        # Words between tags stay as they are, whatever they look like.
        tag = re.sub(r' transform="rotate\(-?0 [^"]*\)"| font-family: [^;"]*;?', "", found[0])
        tag = re.sub(r' id="([^"]*)"', lambda at: at[0] if at[1] in used else "", tag)
        tag = re.sub(r' d="([^"]*)"', lambda at: f' d="{" ".join(at[1].split())}"', tag)
        tag = re.sub(r'( id="|href="#|url\(#)', rf"\g<1>{salt}-", tag)
        return re.sub(r"#01[0-9a-f]{2}fe", lambda at: _colour(_NAMES[at[0]], theme), tag)

    text = re.sub(r"<[^>]+>", cleaned_tag, text)
    text = re.sub(r"\n *<g>\n *</g>", "", text)
    head, _, body = text.partition(">")
    box = re.search(r'viewBox="[^"]*"', head)
    assert box is not None
    font = f' font-family="{_FONT_OF_PAPER}"' if theme == "light" else ""
    return (
        '<svg xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink" '
        f'width="100%" {box[0]} role="img" stroke-linejoin="round"{font}>\n'
        f" <title>{escape(_printable(picture.title), quote=False)}</title>{_printable(body)}"
    )


def _colour(name: str, theme: Theme) -> str:
    paper = COLOURS_OF_PAPER[name]
    if theme == "light":
        return paper
    return f"var(--{name}, {'currentColor' if name == 'ink' else paper})"


def _printable(text: str) -> str:
    """Return the text without the characters that XML 1.0 forbids (section 2.2)."""
    return re.sub("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]", "\ufffd", text)

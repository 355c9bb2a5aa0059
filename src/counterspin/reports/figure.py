"""The figure of the two-stage method: displacement error at the strobes, its parabola, residuals.

matplotlib is imported only when a figure is drawn. The same data give the same file, byte for
byte: no date and no random names are in it.

- `StrobePanel`: one run as it is drawn
- `displacement_figure`: the figure
- `save`, `check_format`: to SVG, PNG or PDF, whole or not at all
- `as_words`: a name that is no formula
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from counterspin.arrays import Array
from counterspin.errors import CounterspinError
from counterspin.output import write_whole

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: What a file of each kind says of its making; a date would make every file another.
_METADATA: Final[Mapping[str, Mapping[str, str | None]]] = {
    ".svg": {"Creator": "counterspin", "Date": None},
    ".png": {"Software": "counterspin"},
    ".pdf": {"Creator": "counterspin", "Producer": None, "CreationDate": None},
}

#: Of every figure: the same data give the same file.
SETTINGS: Final[dict[Any, Any]] = {
    "svg.hashsalt": "counterspin",
    "svg.fonttype": "none",
    "pdf.fonttype": 42,
    "font.size": 9.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "0.9",
    "grid.linewidth": 0.6,
    "legend.frameon": False,
}

#: Okabe and Ito's colours that stand out on white, told apart by colour-blind readers; the
#: markers say the same without colour.
COLOURS: Final = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
MARKERS: Final = ("o", "^", "s", "D", "v", "P")


@dataclass(frozen=True)
class StrobePanel:
    """One run: what its strobes show and the parabola through them.

    Attributes
    ----------
    run_name
        The run's name.
    rate
        rad/s; negative for the other sense.
    time
        Of the strobes, s, shape (m,).
    error
        Displacement error at the strobes, m, shape (m,).
    fitted
        The parabola there, m, shape (m,).
    residual
        Error less parabola, m, shape (m,).
    sigma
        Standard deviation of one strobe, m.
    """

    run_name: str
    rate: float
    time: Array
    error: Array
    fitted: Array
    residual: Array
    sigma: float


def displacement_figure(panels: Sequence[StrobePanel], *, title: str = "") -> Figure:
    """Draw displacement error against time with the fitted parabolas, and the residuals below.

    Parameters
    ----------
    panels
        The runs of one accelerometer, at least one.
    title
        Above the figure; empty for none.

    Returns
    -------
    matplotlib.figure.Figure
        Not bound to any window; `save` writes it.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context(SETTINGS):
        figure = Figure(figsize=(7.0, 4.6 + 0.9 * len(panels)), layout="constrained")
        heights = [3.2, *(1.0 for _ in panels)]
        upper, *lower = figure.subplots(
            1 + len(panels), 1, sharex=True, gridspec_kw={"height_ratios": heights}
        )
        if title:
            upper.set_title(as_words(title), loc="left", fontweight="bold")
        for index, (panel, axes) in enumerate(zip(panels, lower, strict=True)):
            colour = COLOURS[index % len(COLOURS)]
            marker = MARKERS[index % len(MARKERS)]
            _draw_error(upper, panel, colour, marker)
            _draw_residuals(axes, panel, colour, marker)
        upper.set_ylabel("displacement error / m")
        upper.legend(loc="upper left", title="strobes and fitted parabola", alignment="left")
        upper.margins(x=0.01)
        lower[0].set_title(
            "strobes less parabola; band: ± 2 standard deviations", loc="left", fontsize="medium"
        )
        lower[len(lower) // 2].set_ylabel("residual / mm")
        lower[-1].set_xlabel("time / s")
        bound = 1.15 * max(_extent(panel) for panel in panels)
        for axes in lower:
            axes.set_ylim(-bound, bound)
        figure.align_ylabels()
    return figure


def check_format(path: Path) -> str:
    """Return the format that a figure's name asks for; CounterspinError if there is no such one."""
    kind = path.suffix.lower()
    if kind not in _METADATA:
        raise CounterspinError(
            f"{path}: a figure is written as {', '.join(_METADATA)}; choose one of these endings"
        )
    return kind


def save(figure: Figure, path: Path) -> None:
    """Write a figure as SVG, PNG or PDF, by the ending of the file's name.

    Raises
    ------
    CounterspinError
        If the ending is none of these, or the file cannot be written; nothing is left behind.
    """
    import matplotlib as mpl

    kind = check_format(path)
    with mpl.rc_context(SETTINGS), warnings.catch_warnings():
        # A letter that the font lacks is drawn as a box, which speaks for itself.
        warnings.filterwarnings("ignore", r"Glyph \d+", UserWarning)
        write_whole(
            path,
            lambda part: figure.savefig(
                part, format=kind[1:], dpi=160, metadata=dict(_METADATA[kind])
            ),
        )


def as_words(name: str) -> str:
    """Return a name as matplotlib draws it letter by letter, and never reads it as a formula."""
    return name.replace("$", r"\$")


def _draw_error(axes: Any, panel: StrobePanel, colour: str, marker: str) -> None:
    time = np.linspace(panel.time[0], panel.time[-1], 200)
    # Through its own values at the strobes, so that the curve is smooth where strobes are few.
    span = float(np.ptp(panel.time))
    parabola = np.polynomial.polynomial.polyfit(panel.time / span, panel.fitted, 2)
    curve = np.polynomial.polynomial.polyval(time / span, parabola)
    # Every strobe would hide the curve; the residuals below show them all.
    shown = slice(None, None, max(1, panel.time.size // 25))
    axes.plot(time, curve, color=colour, linewidth=1.2)
    axes.plot(
        panel.time[shown],
        panel.error[shown],
        linestyle="none",
        marker=marker,
        markersize=4.5,
        markerfacecolor="white",
        color=colour,
        label=f"{as_words(panel.run_name)}, {panel.rate:.4f} rad/s",
    )


def _draw_residuals(axes: Any, panel: StrobePanel, colour: str, marker: str) -> None:
    ends, band = panel.time[[0, -1]], 2e3 * panel.sigma
    axes.fill_between(ends, -band, band, color=colour, alpha=0.12, linewidth=0)
    axes.plot(ends, [0.0, 0.0], color="0.4", linewidth=0.8)
    axes.plot(
        panel.time,
        1e3 * panel.residual,
        linestyle="none",
        marker=marker,
        markersize=2.5,
        color=colour,
    )
    axes.annotate(
        as_words(panel.run_name),
        (1.0, 0.97),
        xycoords="axes fraction",
        horizontalalignment="right",
        verticalalignment="top",
        color=colour,
    )


def _extent(panel: StrobePanel) -> float:
    """Return the height that holds a panel's residuals and band, mm."""
    return 1e3 * max(2.0 * panel.sigma, float(np.max(np.abs(panel.residual))), 1e-12)

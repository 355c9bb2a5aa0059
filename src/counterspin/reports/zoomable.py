"""Plots that can be zoomed: what a page's script draws them from, and their still picture.

The arrays travel as whole numbers, rounded to what a screen shows even after much zooming.

- `can_zoom`: whether a plot is worth it
- `plot_data`: a plot as JSON for a page
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Final

from counterspin.reports.blocks import Plot
from counterspin.reports.figure import COLOURS

#: Steps that an axis is divided into at least.
_STEPS: Final = 2e4


def can_zoom(plot: Plot) -> bool:
    """Tell whether a plot is worth a closer look and has an axis of numbers to look along."""
    return plot.zoom and not plot.x_names and len({x for one in plot.series for x in one.x}) > 1


def plot_data(plot: Plot) -> str:
    """Return a plot as JSON that can stand in a page's script element."""
    series = []
    for one, colour in zip(plot.series, _colours(plot), strict=True):
        series.append(
            {
                "label": one.label,
                "kind": one.kind,
                "stands_out": one.stands_out,
                "colour": colour,
                "x": _packed(one.x, plot.log_x),
                "y": None if one.kind == "band" else _packed(one.y, plot.log_y),
                "low": None if one.low is None else _packed(one.low, plot.log_y),
                "high": None if one.high is None else _packed(one.high, plot.log_y),
            }
        )
    made = {
        "x_label": plot.x_label,
        "y_label": plot.y_label,
        "log_x": plot.log_x,
        "log_y": plot.log_y,
        "levels": plot.levels,
        "series": series,
    }
    text = json.dumps(made, separators=(",", ":"), allow_nan=False)
    # Neither </script> nor <!-- may stand there; to JSON it is the same.
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _colours(plot: Plot) -> Iterator[str]:
    """Yield the CSS property that holds each series' colour, the same as in the still picture."""
    taken = 0
    for series in plot.series:
        if series.stands_out:
            yield "--warning"
        elif series.kind == "band" and not series.label:
            yield "--muted"
        else:
            yield f"--series-{taken % len(COLOURS) + 1}"
            taken += 1


def _packed(values: Sequence[float | None], log: bool) -> dict[str, Any]:
    """Return an array as whole numbers of equal steps, which takes a third of the characters."""
    finite = [value for value in values if value is not None and math.isfinite(value)]
    if log:
        return {
            "step": 1,
            "values": [_kept(value, lambda v: float(f"{v:.4g}")) for value in values],
        }
    spread = max(finite, default=0.0) - min(finite, default=0.0)
    spread = spread or max(map(abs, finite), default=0.0) or 1.0
    step = 10.0 ** math.floor(math.log10(spread / _STEPS))
    return {"step": step, "values": [_kept(value, lambda v: round(v / step)) for value in values]}


def _kept(value: float | None, rounded: Callable[[float], float]) -> float | None:
    return None if value is None or not math.isfinite(value) else rounded(value)

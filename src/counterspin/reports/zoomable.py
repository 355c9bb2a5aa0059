"""Plots that can be zoomed: what a page's script draws them from, and their still picture.

The arrays travel as whole numbers, rounded to what a screen shows even after much zooming.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Final

from counterspin.reports.blocks import Plot
from counterspin.reports.drawing import colours_in_row

#: Steps that an axis is divided into at least.
_STEPS: Final = 2e4


def can_zoom(plot: Plot) -> bool:
    """Tell whether a plot is worth a closer look and has an axis of numbers to look along."""
    return (
        plot.zoom and not plot.x_names and len({x for series in plot.series for x in series.x}) > 1
    )


def plot_data(plot: Plot) -> str:
    """Return a plot as JSON that can stand in a page's script element."""
    rows = []
    for series, colour in zip(plot.series, _colours(plot), strict=True):
        low, high = (
            None if ends is None else _packed(ends, plot.log_y)
            for ends in (series.low, series.high)
        )
        rows.append(
            {
                "label": series.label,
                "kind": series.kind,
                "stands_out": series.stands_out,
                "colour": colour,
                "x": _packed(series.x, plot.log_x),
                "y": None if series.kind == "band" else _packed(series.y, plot.log_y),
                "low": low,
                "high": high,
            }
        )
    data = {
        "x_label": plot.x_label,
        "y_label": plot.y_label,
        "log_x": plot.log_x,
        "log_y": plot.log_y,
        "levels": plot.levels,
        "series": rows,
    }
    text = json.dumps(data, separators=(",", ":"), allow_nan=False)
    # Neither </script> nor <!-- may stand there; to JSON it is the same.
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _colours(plot: Plot) -> Iterator[str]:
    """Yield the CSS property that holds each series' colour, the same as in the still picture."""
    for series, place in zip(plot.series, colours_in_row(plot.series), strict=True):
        if place is None:
            yield "--warning" if series.stands_out else "--muted"
        else:
            yield f"--series-{place + 1}"


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

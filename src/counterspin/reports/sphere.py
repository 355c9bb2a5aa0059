"""Drawing of points on a sphere: two hemispheres side by side, in an equal-area projection."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from counterspin.arrays import Array
from counterspin.reports.blocks import Sphere
from counterspin.reports.chart_layout import WIDTH, Margins, margins, shorten_text
from counterspin.reports.numbers import format_number

#: Radius of a hemisphere in points, and distance of its centre from the middle, in radii.
_RADIUS: Final = 92.0
_CENTRE_OFFSET: Final = 1.3

#: Heights of the drawing and of the colour bar below, in points.
_HEIGHT: Final = 238.0
_COLOUR_ROW: Final = 24.0

#: Largest number of points with names.
_MAX_NAMED: Final = 60

#: Opacity of points with value zero and with the largest value.
_MIN_OPACITY: Final = 0.06
_MAX_OPACITY: Final = 0.95


def draw_sphere(axes: Any, sphere: Sphere, palette: Mapping[str, str], title: str) -> Margins:
    """Draw the hemispheres about the third axis, the positive one at the left."""
    points = np.asarray(sphere.points, dtype=float).reshape(-1, 3)
    values = np.asarray(sphere.values, dtype=float)
    largest = float(np.max(np.abs(values), initial=0.0))
    for sign in (1.0, -1.0):
        _draw_half(axes, sphere, sign, palette)
        here = points[:, 2] * sign > 0.0 if sign > 0.0 else points[:, 2] <= 0.0
        at = _project(points[here], sign)
        for (x, y), value, k in zip(at, values[here], np.flatnonzero(here), strict=True):
            _draw_point(axes, x, y, value / (largest or 1.0), palette, out=k in sphere.stands_out)
            if len(points) <= _MAX_NAMED:
                axes.annotate(
                    shorten_text(sphere.names[k], 60.0),
                    (x, y),
                    xytext=(4.5, 3.5),
                    textcoords="offset points",
                    fontsize=7.0,
                    color=palette["warning" if k in sphere.stands_out else "muted"],
                )
    _draw_colours(axes, sphere, largest, palette)
    wide, high = (WIDTH - 7.0 - 6.0) / _RADIUS, _HEIGHT / _RADIUS
    axes.set(
        xlim=(-wide / 2.0, wide / 2.0),
        ylim=(-high / 2.0 - 0.08, high / 2.0 - 0.08),
        xticks=[],
        yticks=[],
        title=title,
    )
    axes.set_aspect("equal")
    axes.grid(visible=False)
    axes.spines[:].set_visible(False)
    return margins(axes, _HEIGHT + 4.0 + 2.0)


def _project(points: Array, sign: float) -> Array:
    """Return a hemisphere's points in Lambert's equal-area projection, shape (n, 2)."""
    across = np.hypot(points[:, 0], points[:, 1])
    reach = np.sqrt(np.maximum(1.0 - np.abs(points[:, 2]), 0.0))
    scale = np.divide(reach, across, out=np.zeros_like(reach), where=across > 0.0)
    # Each hemisphere is seen from outside: the second is mirrored about its vertical axis.
    at: Array = points[:, :2] * scale[:, None] * [sign, 1.0]
    at[:, 0] -= sign * _CENTRE_OFFSET
    return at


def _draw_half(axes: Any, sphere: Sphere, sign: float, palette: Mapping[str, str]) -> None:
    from matplotlib.patches import Circle

    middle = -sign * _CENTRE_OFFSET
    for height in (30.0, 60.0):
        radius = math.sqrt(1.0 - math.sin(math.radians(height)))
        axes.add_patch(Circle((middle, 0.0), radius, fill=False, color=palette["grid"], lw=0.6))
    for angle in np.radians(np.arange(0.0, 180.0, 45.0)):
        x, y = math.cos(angle), math.sin(angle)
        axes.plot([middle - x, middle + x], [-y, y], color=palette["grid"], lw=0.6, zorder=1.0)
    edge = Circle((middle, 0.0), 1.0, fill=False, color=palette["muted"], lw=0.7)
    axes.add_patch(edge)
    first, second, third = sphere.axes
    minus = "\u2212"
    right, left = (first, minus + first) if sign > 0.0 else (minus + first, first)
    for text, x, y, align in (
        (right, 1.06, 0.0, "left"),
        (left, -1.06, 0.0, "right"),
        (second, 0.0, 1.08, "center"),
        (minus + second, 0.0, -1.1, "center"),
    ):
        axes.text(middle + x, y, text, ha=align, va="center", fontsize=8.0, color=palette["muted"])
    half = third if sign > 0.0 else minus + third
    axes.text(middle - 1.2, 1.08, f"seen from {half}", ha="left", va="center", color=palette["ink"])


def _draw_point(
    axes: Any, x: float, y: float, value: float, palette: Mapping[str, str], *, out: bool
) -> None:
    colour = palette["positive" if value >= 0.0 else "negative"]
    opacity = _MIN_OPACITY + (_MAX_OPACITY - _MIN_OPACITY) * abs(value)
    axes.plot(
        [x],
        [y],
        marker="X" if out else "o",
        markersize=7.0 if out else 6.0,
        markerfacecolor=(colour, opacity),
        markeredgecolor=palette["warning"] if out else colour,
        linestyle="none",
        clip_on=False,
        zorder=2.6 if out else 2.2,
    )


def _draw_colours(axes: Any, sphere: Sphere, largest: float, palette: Mapping[str, str]) -> None:
    """Draw the colour bar below the hemispheres."""
    y = -1.08 - _COLOUR_ROW / _RADIUS
    axes.text(-0.72, y, sphere.value_label, ha="right", va="center", color=palette["ink"])
    for place, value in enumerate((-1.0, -0.5, 0.0, 0.5, 1.0) if largest else (0.0,)):
        x = -0.6 + 0.62 * place
        _draw_point(axes, x, y, value, palette, out=False)
        text = format_number(value * largest, 2).replace("-", "\u2212")
        axes.text(x + 0.07, y, text, ha="left", va="center", color=palette["ink"])

"""Drawing of points on a sphere as two hemispheres, in an equal-area projection."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from counterspin.arrays import Array
from counterspin.reports.blocks import Sphere
from counterspin.reports.chart_layout import DRAWING_WIDTH, Margins, compute_margins, shorten_text
from counterspin.reports.numbers import format_number

#: Radius of a hemisphere in points, and distance of its centre from the middle, in radii.
_RADIUS: Final = 92.0
_CENTRE_OFFSET: Final = 1.3

#: Heights of the drawing and of the colour bar below, in points.
_HEIGHT: Final = 238.0
_COLOUR_BAR_HEIGHT: Final = 24.0

#: Largest number of points with names.
_MAX_NAMED_POINTS: Final = 60

#: Opacity of points with value zero and with the largest value.
_MIN_OPACITY: Final = 0.06
_MAX_OPACITY: Final = 0.95


def draw_sphere(axes: Any, sphere: Sphere, palette: Mapping[str, str], title: str) -> Margins:
    """Draw the hemispheres about the third axis, the positive one at the left."""
    points = np.asarray(sphere.points, dtype=float).reshape(-1, 3)
    values = np.asarray(sphere.values, dtype=float)
    max_value = float(np.max(np.abs(values), initial=0.0))
    for sign in (1.0, -1.0):
        _draw_hemisphere(axes, sphere, sign, palette)
        in_hemisphere = points[:, 2] * sign > 0.0 if sign > 0.0 else points[:, 2] <= 0.0
        positions = _project_points(points[in_hemisphere], sign)
        for (x, y), value, point_index in zip(
            positions, values[in_hemisphere], np.flatnonzero(in_hemisphere), strict=True
        ):
            _draw_point(
                axes,
                x,
                y,
                value / (max_value or 1.0),
                palette,
                is_highlighted=point_index in sphere.highlighted_points,
            )
            if len(points) <= _MAX_NAMED_POINTS:
                axes.annotate(
                    shorten_text(sphere.names[point_index], 60.0),
                    (x, y),
                    xytext=(4.5, 3.5),
                    textcoords="offset points",
                    fontsize=7.0,
                    color=palette[
                        "warning" if point_index in sphere.highlighted_points else "muted"
                    ],
                )
    _draw_colour_bar(axes, sphere, max_value, palette)
    width, height = (DRAWING_WIDTH - 7.0 - 6.0) / _RADIUS, _HEIGHT / _RADIUS
    axes.set(
        xlim=(-width / 2.0, width / 2.0),
        ylim=(-height / 2.0 - 0.08, height / 2.0 - 0.08),
        xticks=[],
        yticks=[],
        title=title,
    )
    axes.set_aspect("equal")
    axes.grid(visible=False)
    axes.spines[:].set_visible(False)
    return compute_margins(axes, _HEIGHT + 4.0 + 2.0)


def _project_points(points: Array, sign: float) -> Array:
    """Return a hemisphere's points in Lambert's equal-area projection, shape (n, 2)."""
    horizontal_distance = np.hypot(points[:, 0], points[:, 1])
    projected_radius = np.sqrt(np.maximum(1.0 - np.abs(points[:, 2]), 0.0))
    scale = np.divide(
        projected_radius,
        horizontal_distance,
        out=np.zeros_like(projected_radius),
        where=horizontal_distance > 0.0,
    )
    # Both hemispheres are viewed from outside, so the second is mirrored about its vertical axis.
    positions: Array = points[:, :2] * scale[:, None] * [sign, 1.0]
    positions[:, 0] -= sign * _CENTRE_OFFSET
    return positions


def _draw_hemisphere(axes: Any, sphere: Sphere, sign: float, palette: Mapping[str, str]) -> None:
    from matplotlib.patches import Circle

    centre = -sign * _CENTRE_OFFSET
    for elevation in (30.0, 60.0):
        radius = math.sqrt(1.0 - math.sin(math.radians(elevation)))
        axes.add_patch(Circle((centre, 0.0), radius, fill=False, color=palette["grid"], lw=0.6))
    for angle in np.radians(np.arange(0.0, 180.0, 45.0)):
        x, y = math.cos(angle), math.sin(angle)
        axes.plot([centre - x, centre + x], [-y, y], color=palette["grid"], lw=0.6, zorder=1.0)
    outline = Circle((centre, 0.0), 1.0, fill=False, color=palette["muted"], lw=0.7)
    axes.add_patch(outline)
    first_axis, second_axis, third_axis = sphere.axes
    minus = "\u2212"
    right_label, left_label = (
        (first_axis, minus + first_axis) if sign > 0.0 else (minus + first_axis, first_axis)
    )
    for text, x, y, align in (
        (right_label, 1.06, 0.0, "left"),
        (left_label, -1.06, 0.0, "right"),
        (second_axis, 0.0, 1.08, "center"),
        (minus + second_axis, 0.0, -1.1, "center"),
    ):
        axes.text(centre + x, y, text, ha=align, va="center", fontsize=8.0, color=palette["muted"])
    axis = third_axis if sign > 0.0 else minus + third_axis
    axes.text(centre - 1.2, 1.08, f"seen from {axis}", ha="left", va="center", color=palette["ink"])


def _draw_point(
    axes: Any, x: float, y: float, value: float, palette: Mapping[str, str], *, is_highlighted: bool
) -> None:
    colour = palette["positive" if value >= 0.0 else "negative"]
    opacity = _MIN_OPACITY + (_MAX_OPACITY - _MIN_OPACITY) * abs(value)
    axes.plot(
        [x],
        [y],
        marker="X" if is_highlighted else "o",
        markersize=7.0 if is_highlighted else 6.0,
        markerfacecolor=(colour, opacity),
        markeredgecolor=palette["warning"] if is_highlighted else colour,
        linestyle="none",
        clip_on=False,
        zorder=2.6 if is_highlighted else 2.2,
    )


def _draw_colour_bar(
    axes: Any, sphere: Sphere, max_value: float, palette: Mapping[str, str]
) -> None:
    """Draw the colour bar below the hemispheres."""
    y = -1.08 - _COLOUR_BAR_HEIGHT / _RADIUS
    axes.text(-0.72, y, sphere.value_label, ha="right", va="center", color=palette["ink"])
    for index, value in enumerate((-1.0, -0.5, 0.0, 0.5, 1.0) if max_value else (0.0,)):
        x = -0.6 + 0.62 * index
        _draw_point(axes, x, y, value, palette, is_highlighted=False)
        text = format_number(value * max_value, 2).replace("-", "\u2212")
        axes.text(x + 0.07, y, text, ha="left", va="center", color=palette["ink"])

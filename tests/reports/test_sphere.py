"""Plots of directions on two hemispheres."""

import math

import numpy as np
import pytest

from counterspin.reports.blocks import Sphere
from counterspin.reports.charts import render_svg
from counterspin.reports.drawing import PAPER_COLOURS, draw_pictures, drawing_parameters


def markers(sphere):
    """Return positions, opacities and colours of the markers, those of the legend last."""
    from matplotlib.colors import to_rgba

    with drawing_parameters(PAPER_COLOURS):
        (axes,) = draw_pictures([sphere], PAPER_COLOURS, show_titles=False).axes
    lines = [line for line in axes.lines if line.get_marker() in ("o", "X")]
    places = np.array([[line.get_xdata()[0], line.get_ydata()[0]] for line in lines])
    return places, [to_rgba(line.get_markerfacecolor()) for line in lines], lines


def test_projection_preserves_area():
    # A cap up to polar angle t has the fraction 1 - cos t of a hemisphere.
    angles = np.radians([0.0, 20.0, 60.0, 89.9])
    points = [(math.sin(t), 0.0, math.cos(t)) for t in angles]
    sphere = Sphere("", ("X", "Y", "Z"), tuple(points), (1.0,) * 4, tuple("abcd"), "")
    places = markers(sphere)[0][:4]
    radius = places[:, 0] - places[0, 0]
    assert radius**2 == pytest.approx(1.0 - np.cos(angles), abs=1e-12)


def test_hemispheres_are_viewed_from_outside():
    eighth = math.pi / 8.0
    near = math.sin(eighth) / math.sqrt(2.0)
    points = ((near, near, math.cos(eighth)), (near, near, -math.cos(eighth)))
    sphere = Sphere("", ("X", "Y", "Z"), points, (1.0, 1.0), ("a", "b"), "")
    up, down = markers(sphere)[0][:2]
    # From above X is on the right, from below on the left; Y is at the top.
    assert up[0] < 0.0 < down[0]
    assert up[0] + 1.3 == pytest.approx(1.3 - down[0])
    assert up[1] == pytest.approx(down[1])
    assert up[0] > -1.3


def test_colours_show_sign_and_magnitude():
    points = tuple((0.0, math.sin(t), math.cos(t)) for t in (0.1, 0.5, 0.9))
    values, out = (4.0, -2.0, 0.0), frozenset({1})
    sphere = Sphere("", ("X", "Y", "Z"), points, values, ("a", "b", "c"), "z", out)
    _, colours, lines = markers(sphere)
    from matplotlib.colors import to_rgb

    assert colours[0][:3] == to_rgb(PAPER_COLOURS["positive"])
    assert colours[1][:3] == to_rgb(PAPER_COLOURS["negative"])
    assert colours[0][3] > colours[1][3] > colours[2][3]
    assert [line.get_marker() for line in lines[:3]] == ["o", "X", "o"]
    text = render_svg(sphere)
    for word in ("seen from Z", "\u22122", "4", "b"):
        assert f">{word}<" in text

"""What the drawings of the machine show is what the program computes with."""

import math
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest

from counterspin.campaign.quantity import attitude_rows, read_direction
from counterspin.physics.accelerometer import Mounting
from counterspin.reports.chart_layout import _FONT_SIZE, text_width
from counterspin.reports.machine import DRAWINGS, machine_svg
from counterspin.reports.machine_canvas import SIZE, WIDTH

IMAGES = Path(__file__).parents[2] / "docs" / "images"
NAMESPACE = "{http://www.w3.org/2000/svg}"

every_drawing = pytest.mark.parametrize("name", DRAWINGS)


def directions(name):
    """Return the words at each arrow of a drawing, and which way it points."""
    return [(arrow.words, np.array(arrow.direction)) for arrow in DRAWINGS[name]().arrows]


def one(name, words):
    (found,) = [way for said, way in directions(name) if said == words]
    return found


@every_drawing
def test_the_documentation_has_the_drawing(name):
    """`make pictures` writes them."""
    assert (IMAGES / f"machine-{name}.svg").read_text("utf-8") == machine_svg(name)


@every_drawing
def test_a_drawing_has_words_for_who_does_not_see_it(name):
    root = ET.fromstring(machine_svg(name))
    assert root.get("role") == "img"
    assert len(root.find(f"{NAMESPACE}title").text) > 10
    assert len(root.find(f"{NAMESPACE}desc").text) > 80


@every_drawing
def test_words_lie_inside_and_on_no_other_words(name):
    canvas = DRAWINGS[name]()
    boxes = []
    for (x, y), words, anchor in canvas.labels:
        wide = text_width(words) * SIZE / _FONT_SIZE
        left = x - wide * {"start": 0.0, "middle": 0.5, "end": 1.0}[anchor]
        boxes.append((left, y - 0.75 * SIZE, left + wide, y + 0.2 * SIZE, words))
    for left, top, right, bottom, words in boxes:
        assert left >= 0.0, words
        assert right <= WIDTH, words
        assert top >= 0.0, words
        assert bottom <= canvas.height, words
    for place, (left, top, right, bottom, words) in enumerate(boxes):
        for other in boxes[:place]:
            apart = right <= other[0] or other[2] <= left or bottom <= other[1] or other[3] <= top
            assert apart, (words, other[4])


@every_drawing
def test_arrows_point_on_the_canvas_as_they_do_in_the_frame(name):
    """One that points east leads to the right, one that points up leads upwards."""
    for arrow in DRAWINGS[name]().arrows:
        (x0, y0), (x1, y1) = arrow.start, arrow.end
        east, north, up = arrow.direction
        if east in (1.0, -1.0):
            assert (x1 - x0) * east > 0.0, arrow
        if up in (1.0, -1.0):
            assert (y0 - y1) * up > 0.0, arrow
        if north in (1.0, -1.0) and name != "tumble":
            assert (y0 - y1) * north > 0.0, arrow


@pytest.mark.parametrize("name", ["accelerometer", "double-turntable"])
def test_the_output_axis_is_input_cross_pendulous(name):
    """As the model of the accelerometer has it."""
    given, pendulous = one(name, "input axis"), one(name, "pendulous axis")
    model = Mounting.from_axes(tuple(given), tuple(pendulous))
    assert one(name, "output axis") == pytest.approx(model.matrix[2], abs=1e-15)
    # As the example campaign has them.
    assert tuple(given) == read_direction("east")
    assert tuple(pendulous) == read_direction("down")


def test_the_paper_s_axes_are_those_of_its_equation_8():
    """a_I = a_x, a_P = -a_z, a_O = a_y."""
    x, y, z = (one("paper-figure-1", f"{axis}_p") for axis in "xyz")
    assert one("paper-figure-1", "Ix, input") == pytest.approx(x)
    assert one("paper-figure-1", "Px, pendulous") == pytest.approx(-z)
    assert one("paper-figure-1", "Ox, output") == pytest.approx(y)


def test_the_paper_s_acceleration_points_inward_and_is_that_of_equation_8():
    """a_xn = -R w^2 cos w t, and so for y with the sine."""
    inward = one("paper-figure-2", "a_c")
    angle = math.radians(42.0)
    assert inward == pytest.approx([-math.cos(angle), -math.sin(angle), 0.0], abs=1e-15)


def test_the_head_of_a_tumble_turns_as_attitudes_do():
    """The example's axes at 0, and at 30 degrees about north."""
    rows = attitude_rows("30 deg about north")
    zero = [np.array(read_direction(way)) for way in ("up", "west")]
    turned = Mounting.from_axes("up", "west").turned(rows)
    found = directions("tumble")
    for way in zero:
        assert [said for said, there in found if np.allclose(there, way, atol=1e-15)]
    for words, way in zip(("input axis", "pendulous axis"), turned.matrix, strict=False):
        assert one("tumble", words) == pytest.approx(way, abs=1e-12)
    assert one("tumble", "input axis")[0] > 0.0


def test_the_force_on_the_arm_points_inward_whatever_the_mounting():
    """East is along the arm and outward there."""
    ways = [way[0] for words, way in directions("arm") if not words]
    assert ways == [-1.0, -1.0, 1.0, -1.0]

"""Lines, arrows and words on a canvas, and the view of what has three dimensions."""

import math
import xml.etree.ElementTree as ET

import numpy as np
import pytest

from counterspin.reports.machine_canvas import Canvas, View

NAMESPACE = "{http://www.w3.org/2000/svg}"
EAST, NORTH, UP = np.eye(3)


def test_a_view_shows_the_frame_as_an_eye_in_the_south_sees_it():
    """East to the right, up upwards, north away: upwards too, the eye standing higher."""
    view = View((100.0, 50.0), 10.0)
    assert view.at((0, 0, 0)) == (100.0, 50.0)
    for axis, right, higher in ((EAST, True, None), (UP, None, True), (NORTH, None, True)):
        x, y = view.at(axis)
        assert right is None or (x > 100.0) == right
        assert higher is None or (y < 50.0) == higher


def test_a_view_keeps_what_lies_in_its_plane():
    """From straight above lengths on the ground are kept, from the horizon heights."""
    above = View((0.0, 0.0), 7.0, elevation=math.pi / 2.0, azimuth=0.0)
    assert above.at((3, 4, 9)) == pytest.approx((21.0, -28.0), abs=1e-12)
    level = View((0.0, 0.0), 7.0, elevation=0.0, azimuth=0.0)
    assert level.at((3, 4, 9)) == pytest.approx((21.0, -63.0), abs=1e-12)
    # A view is a rotation and a projection: its two rows are of length 1, at right angles.
    oblique = np.array([View((0.0, 0.0), 1.0, 0.7, -0.4).at(axis) for axis in np.eye(3)]).T
    assert oblique @ oblique.T == pytest.approx(np.eye(2), abs=1e-15)


def test_a_circle_counts_from_east_towards_north():
    above = View((0.0, 0.0), 1.0, elevation=math.pi / 2.0, azimuth=0.0)
    arc = above.circle((1, 1, 0), 2.0, 0.0, math.pi / 2.0)
    assert arc[0] == pytest.approx((3.0, -1.0))
    assert arc[-1] == pytest.approx((1.0, -3.0))
    assert all(math.hypot(x - 1.0, y + 1.0) == pytest.approx(2.0) for x, y in arc)


def test_words_are_escaped_and_read_aloud():
    canvas = Canvas("A <title> & more", "Words with <tags>.", 50.0)
    canvas.text((10.0, 20.0), "w_0t < 1 & R", "start")
    root = ET.fromstring(canvas.svg())
    assert root.find(f"{NAMESPACE}title").text == "A <title> & more"
    assert root.find(f"{NAMESPACE}desc").text == "Words with <tags>."
    for how, tag in (("labelledby", "title"), ("describedby", "desc")):
        assert root.get(f"aria-{how}") == root.find(f"{NAMESPACE}{tag}").get("id")
    text = "".join(root.find(f"{NAMESPACE}text").itertext())
    assert text.replace("\u200b", "") == "w0t < 1 & R"


def test_an_arrow_has_its_head_at_its_end():
    canvas = Canvas("Title", "Words.", 50.0)
    canvas.axis(View((20.0, 30.0), 10.0, 0.0, 0.0), (0, 0, 0), (2.0, 0.0, 0.0), "x", length=3.0)
    (arrow,) = canvas.arrows
    assert arrow.direction == (1.0, 0.0, 0.0)
    assert (arrow.start, arrow.end) == ((20.0, 30.0), pytest.approx((50.0, 30.0)))
    heads = [path for path in ET.fromstring(canvas.svg()) if "stroke:none" in path.get("style", "")]
    assert [head.get("d").split("L")[0] for head in heads] == ["M50.0 30.0"]


@pytest.mark.parametrize("theme", ["light", "page"])
def test_colours_are_of_the_paper_or_of_the_page(theme):
    canvas = Canvas("Title", "Words.", 50.0)
    canvas.line([(0.0, 0.0), (1.0, 1.0)], "series-1")
    drawn = canvas.svg(theme)
    assert ("var(--series-1, #0072B2)" in drawn) == (theme == "page")
    assert "{" not in drawn

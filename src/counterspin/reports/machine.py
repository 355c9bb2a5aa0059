"""Drawings of the machine: which way its axes point, where an angle begins, which way it counts.

Each is drawn from the vectors of the frame (east, north, up), so that what is drawn is what is
computed; every arrow states the direction that it shows (`Arrow`), for tests to compare.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.reports.machine_canvas import Canvas, Point, Theme, View

EAST, NORTH, UP = np.eye(3)

#: Colours of the three axes of an accelerometer, in every drawing.
INPUT: Final = "series-1"
PENDULOUS: Final = "series-2"
OUTPUT: Final = "series-3"


def _direction(angle: float) -> Array:
    """Return the level direction at an angle from east towards north, rad."""
    return np.array([math.cos(angle), math.sin(angle), 0.0])


def _compass(canvas: Canvas, centre: Point, length: float = 38.0) -> None:
    """Draw east, north and up."""
    view = View(centre, length)
    canvas.axis(view, (0, 0, 0), EAST, "east", aside=(4, 5), colour="muted")
    canvas.axis(view, (0, 0, 0), NORTH, "north", aside=(6, -3), colour="muted")
    canvas.axis(view, (0, 0, 0), UP, "up", aside=(0, -5), colour="muted")


def _platform(canvas: Canvas, view: View, at: Array, radius: float, *, faint: bool = False) -> None:
    """Draw a level platform that keeps its directions, with a mark that points north."""
    disc = view.circle(at, radius)
    canvas.area(disc, "ground")
    canvas.area(disc, "muted", 0.08 if faint else 0.18)
    canvas.line(disc, "muted" if faint else "ink", 1.0 if faint else 1.6)
    canvas.line(
        [view.at(at + 0.55 * radius * NORTH), view.at(at + radius * NORTH)],
        "muted" if faint else "ink",
        1.2 if faint else 2.4,
    )


def double_turntable() -> Canvas:
    """Return the double turntable: arm, platform, sense and zero of the angle, axes."""
    canvas = Canvas(
        "Double turntable",
        "The arm turns about the vertical spindle by the angle theta, counted from east towards "
        "north; a positive rate turns it that way, counterclockwise seen from above. At the end "
        "of the arm, at the radius R, the platform turns back by the same angle, so that its mark "
        "points north at every place, and the accelerometer's input axis stays east, its "
        "pendulous axis down and its output axis north.",
        300.0,
    )
    view, angle, other = (
        View((182.0, 162.0), 132.0, elevation=math.radians(46.0)),
        math.radians(68.0),
        math.radians(218.0),
    )
    path = view.circle((0, 0, 0), 1.0)
    canvas.line(path, "muted", 1.0, "4 4")
    canvas.line([view.at((0, 0, 0)), view.at(1.28 * EAST)], "muted", 1.0, "4 4")
    canvas.text(
        (view.at(1.28 * EAST)[0] + 4, view.at(1.28 * EAST)[1] + 4), "θ = 0", "start", "muted"
    )
    _platform(canvas, view, _direction(other), 0.26, faint=True)
    canvas.line([view.at((0, 0, 0)), view.at(0.74 * _direction(other))], "muted", 1.0)
    canvas.arrow(view.circle((0, 0, 0), 0.46, 0.0, angle), "ink", 1.6)
    middle = view.at(0.57 * _direction(0.45 * angle))
    canvas.text((middle[0], middle[1] + 4), "θ")
    sense = view.circle((0, 0, 0), 1.0, math.radians(112.0), math.radians(165.0))
    canvas.arrow(sense, "ink", 2.0)
    canvas.text((sense[len(sense) // 2][0] - 12, sense[len(sense) // 2][1] - 10), "rate > 0", "end")
    end = _direction(angle)
    canvas.line([view.at((0, 0, 0)), view.at(end)], "ink", 5.0)
    canvas.text((view.at(0.5 * end)[0] - 10, view.at(0.5 * end)[1] - 6), "R", "middle")
    canvas.line([view.at(-0.22 * UP), view.at(0.3 * UP)], "ink", 3.0)
    canvas.dot(view.at((0, 0, 0)), "ink", 5.0)
    canvas.text((view.at(0.3 * UP)[0] - 8, view.at(0.3 * UP)[1] - 2), "spindle", "end")
    _platform(canvas, view, end, 0.26)
    back = view.circle(end, 0.33, math.radians(120.0), math.radians(50.0))
    canvas.arrow(back, "muted", 1.6)
    canvas.text((back[0][0] - 4, back[0][1] - 8), "turns back by θ", "end", "muted")
    canvas.axis(view, end, EAST, "input axis", length=0.52, colour=INPUT, aside=(3, -9))
    canvas.axis(view, end, NORTH, "output axis", length=0.46, colour=OUTPUT, aside=(12, -4))
    canvas.axis(
        view,
        end,
        -UP,
        "pendulous axis",
        length=0.42,
        colour=PENDULOUS,
        aside=(8, 8),
    )
    canvas.dot(view.at(end), "ink", 3.5)
    _compass(canvas, (30.0, 272.0))
    return canvas


def accelerometer() -> Canvas:
    """Return an accelerometer: a pendulum, its input, pendulous and output axis."""
    canvas = Canvas(
        "Axes of an accelerometer",
        "A pendulum hangs on a hinge. The input axis is the way in which it can swing: a force "
        "along it is measured. The pendulous axis points from the hinge to the proof mass. The "
        "output axis is that of the hinge, at right angles to both: input x pendulous.",
        270.0,
    )
    view = View((205.0, 96.0), 110.0)
    corners = [(-0.75, -0.42), (0.75, -0.42), (0.75, 0.42), (-0.75, 0.42)]
    for height in (-1.22, 0.3):
        ring = [view.at((x, y, height)) for x, y in (*corners, corners[0])]
        canvas.line(ring, "muted", 1.0, "4 4")
    for x, y in corners:
        canvas.line([view.at((x, y, -1.22)), view.at((x, y, 0.3))], "muted", 1.0, "4 4")
    canvas.line([view.at(-0.42 * NORTH), view.at(0.42 * NORTH)], OUTPUT, 5.0)
    mass = np.array([0.0, 0.0, -0.86])
    canvas.line([view.at((0, 0, 0)), view.at(mass)], "ink", 3.0)
    block = [(-0.16, -0.12), (0.16, -0.12), (0.16, 0.12), (-0.16, 0.12)]
    low = [view.at((x, y, -0.98)) for x, y in block]
    high = [view.at((x, y, -0.74)) for x, y in block]
    for face in ([low[0], low[1], high[1], high[0]], [low[1], low[2], high[2], high[1]], high):
        canvas.area(face, "ground")
        canvas.area(face, "ink", 0.3)
        canvas.line([*face, face[0]], "ink", 1.2)
    canvas.axis(view, mass, EAST, "input axis", length=1.15, colour=INPUT, aside=(6, 5))
    canvas.axis(
        view,
        mass,
        -UP,
        "pendulous axis",
        length=0.58,
        colour=PENDULOUS,
        aside=(9, 2),
    )
    canvas.axis(
        view,
        (0, 0, 0),
        NORTH,
        "output axis",
        length=0.95,
        colour=OUTPUT,
        aside=(9, -2),
    )
    canvas.text((view.at((0, 0, 0))[0] - 26, view.at((0, 0, 0))[1] + 2), "hinge", "end")
    canvas.text((view.at(mass)[0] - 30, view.at(mass)[1] - 2), "proof mass", "end")
    # Swing of the pendulum, in the plane of input and pendulous axis.
    swing = [
        view.at(0.5 * math.sin(a) * EAST - 0.5 * math.cos(a) * UP)
        for a in np.linspace(-0.5, 0.5, 25)
    ]
    canvas.arrow(swing, "muted", 1.4)
    canvas.arrow(swing[::-1], "muted", 1.4)
    return canvas


def _turned(axis: Array, vector: Array, angle: float) -> Array:
    """Return a vector after a right-handed rotation about an axis of length 1."""
    cos, sin = math.cos(angle), math.sin(angle)
    return (
        cos * vector
        + sin * np.cross(axis, vector)
        + (1.0 - cos) * float(np.dot(axis, vector)) * axis
    )


def tumble() -> Canvas:
    """Return the head of a tumble, seen along its axis towards north."""
    canvas = Canvas(
        "Head of a multi-position tumble",
        "A dividing head with a level axis, which points north, away from the eye. At the angle 0 "
        "the input axis points up and the pendulous axis west. A positive angle is a right-handed "
        "turn about north: up goes to east, clockwise as seen here, and the pendulous axis from "
        "west to up. At rest the specific force is one g upwards, of which the input axis feels "
        "the cosine of the angle.",
        330.0,
    )
    # Seen from the south: east to the right, up upwards.
    view = View((214.0, 172.0), 100.0, elevation=0.0, azimuth=0.0)
    ring = [view.at(1.02 * _turned(NORTH, UP, a)) for a in np.linspace(0.0, 2.0 * math.pi, 97)]
    canvas.area(ring, "muted", 0.1)
    canvas.line(ring, "muted", 1.2)
    for degrees in range(0, 360, 30):
        ray = _turned(NORTH, UP, math.radians(degrees))
        canvas.line([view.at(0.96 * ray), view.at(1.02 * ray)], "muted", 1.2)
        if degrees % 90 == 0 or degrees == 30:
            x, y = view.at(1.2 * ray)
            if degrees not in (0, 30):
                lower = 22 if degrees == 270 else 5
                canvas.text((x, y + lower), f"{degrees}°", "middle", "muted")
    angle = math.radians(30.0)
    for turn, faint in ((0.0, True), (angle, False)):
        kind = ("muted", "muted") if faint else (INPUT, PENDULOUS)
        words = ("", "") if faint else ("input axis", "pendulous axis")
        ahead, down = (_turned(NORTH, one, turn) for one in (UP, -EAST))
        for along, word, colour, aside in zip(
            (ahead, down), words, kind, ((6, -2), (0, -8)), strict=True
        ):
            canvas.axis(view, (0, 0, 0), along, word, length=1.3, colour=colour, aside=aside)
    canvas.text((view.at(1.3 * UP)[0], view.at(1.3 * UP)[1] - 6), "0°", "middle", "muted")
    arc = [view.at(0.62 * _turned(NORTH, UP, a)) for a in np.linspace(0.0, angle, 17)]
    canvas.arrow(arc, "ink", 1.8)
    # Between the two axes, above the arrow.
    x, y = view.at(0.86 * _turned(NORTH, UP, 0.5 * angle))
    canvas.text((x, y), "angle", "middle")
    x, y = view.at((0, 0, 0))
    canvas.line([(x + 8 * math.cos(a), y + 8 * math.sin(a)) for a in np.linspace(0, 6.2832, 33)])
    canvas.line([(x - 5.6, y - 5.6), (x + 5.6, y + 5.6)])
    canvas.line([(x - 5.6, y + 5.6), (x + 5.6, y - 5.6)])
    canvas.text((x, y + 44), "axis of the head:")
    canvas.text((x, y + 62), "north, away from you")
    canvas.axis(
        View((424.0, 250.0), 90.0, elevation=0.0, azimuth=0.0),
        (0, 0, 0),
        UP,
        "1 g",
        colour="warning",
        aside=(0, -7),
    )
    canvas.text((424, 270), "specific force", "middle", "warning")
    canvas.text((424, 287), "at rest", "middle", "warning")
    corner = View((36.0, 306.0), 34.0, elevation=0.0, azimuth=0.0)
    canvas.axis(corner, (0, 0, 0), EAST, "east", aside=(4, 5), colour="muted")
    canvas.axis(corner, (0, 0, 0), UP, "up", aside=(0, -5), colour="muted")
    return canvas


def arm() -> Canvas:
    """Return an arm centrifuge from above, with the input axis inward and outward."""
    canvas = Canvas(
        "Arm centrifuge, both mountings",
        "Seen from above. The accelerometer is fixed to the arm and turns with it. Whatever the "
        "sense of the rate, the specific force points inward, to the spindle, and is R w^2; "
        "gravity adds one g upwards. Mounted with its input axis inward the accelerometer reads "
        "plus R w^2, outward minus R w^2. Forward is the way in which the arm moves at a positive "
        "rate, counterclockwise.",
        300.0,
    )
    for row, (middle, words, way, sign) in enumerate(
        (((70.0, 95.0), "inward", -1.0, "+"), ((70.0, 232.0), "outward", 1.0, "−"))
    ):
        # East is along the arm here, and outward with it.
        view = View(middle, 100.0, elevation=math.pi / 2.0, azimuth=0.0)
        canvas.line([view.at((0, 0, 0)), view.at(2.9 * EAST)], "muted", 7.0)
        canvas.dot(view.at((0, 0, 0)), "ink", 6.0)
        end = 2.3 * EAST
        x, y = view.at(end)
        box = [(x - 24, y - 17), (x + 24, y - 17), (x + 24, y + 17), (x - 24, y + 17)]
        canvas.area(box, "ground")
        canvas.line([*box, box[0]], "ink", 1.6)
        canvas.axis(view, end, way * EAST, "", length=0.86, colour=INPUT, aside=(0, 0))
        canvas.text((x + 46.0 * way, y - 25), f"input axis {words}", "middle", INPUT)
        below = end + np.array([0.0, -0.34, 0.0])
        canvas.axis(view, below, -EAST, "", length=1.3, colour="warning")
        canvas.text(
            (x - 56, y + 53), f"specific force R w², read as {sign}R w²", "middle", "warning"
        )
        if row == 0:
            canvas.text((middle[0], y + 26), "spindle")
            canvas.axis(
                view,
                end + np.array([0.42, 0.17, 0.0]),
                NORTH,
                "forward (rate > 0)",
                length=0.5,
                colour="muted",
                aside=(8, 6),
            )
            turn = [view.at(0.42 * _direction(a)) for a in np.linspace(0.5, 2.2, 33)]
            canvas.arrow(turn, "muted", 1.6)
    return canvas


def paper_instruments() -> Canvas:
    """Return the paper's Figure 1: the axes of Qx on the platform, as Eq. 8 has them."""
    canvas = Canvas(
        "The paper's Figure 1: axes of the accelerometer Qx",
        "The platform's axes x_p, y_p, z_p, which track east, north and up, and those of the "
        "accelerometer Qx as Eq. 8 states them: input axis Ix along x_p, pendulous axis Px "
        "against z_p, to the ground, output axis Ox along y_p.",
        210.0,
    )
    view = View((150.0, 112.0), 120.0)
    half = [(-0.9, -0.75), (1.25, -0.75), (1.25, 0.75), (-0.9, 0.75)]
    plate = [view.at((x, y, 0.0)) for x, y in half]
    canvas.area(plate, "muted", 0.12)
    canvas.line([*plate, plate[0]], "muted", 1.2)
    canvas.axis(view, (-0.6, -0.4, 0), EAST, "x_p", length=0.5, colour="muted", aside=(6, 5))
    canvas.axis(
        view,
        (-0.6, -0.4, 0),
        NORTH,
        "y_p",
        length=0.5,
        colour="muted",
        aside=(6, -2),
    )
    canvas.axis(view, (-0.6, -0.4, 0), UP, "z_p", length=0.5, colour="muted", aside=(0, -6))
    at = np.array([0.62, 0.05, 0.0])
    canvas.axis(view, at, EAST, "Ix, input", length=1.0, colour=INPUT, aside=(6, 5))
    canvas.axis(view, at, NORTH, "Ox, output", length=1.05, colour=OUTPUT, aside=(8, -2))
    canvas.axis(view, at, -UP, "Px, pendulous", length=0.66, colour=PENDULOUS, aside=(9, 4))
    canvas.dot(view.at(at), "ink", 5.0)
    canvas.text((view.at(at)[0] - 10, view.at(at)[1] - 8), "Qx", "end", bold=True)
    return canvas


def paper_profile() -> Canvas:
    """Return the paper's Figure 2: the platform on its circle, seen from above."""
    canvas = Canvas(
        "The paper's Figure 2: acceleration on the centrifuge",
        "Seen from above. The platform moves on a circle of radius R_0 at the angle w_0 t from "
        "east; its axes x_p and y_p keep to east and north, z_p points up to the eye. The "
        "centripetal acceleration a_c always points to the spindle; its component along x_p is "
        "- R_0 w_0^2 cos w_0 t.",
        340.0,
    )
    view = View((200.0, 176.0), 118.0, elevation=math.pi / 2.0, azimuth=0.0)
    canvas.line(view.circle((0, 0, 0), 1.0), "muted", 1.0, "4 4")
    canvas.line([view.at((0, 0, 0)), view.at(1.45 * EAST)], "muted", 1.0, "4 4")
    canvas.text(
        (view.at(1.45 * EAST)[0] + 4, view.at(1.45 * EAST)[1] + 5), "east", "start", "muted"
    )
    canvas.dot(view.at((0, 0, 0)), "ink", 4.0)
    angle = math.radians(42.0)
    for place, faint in ((angle, False), (math.radians(165.0), True)):
        at = _direction(place)
        inks = ("muted", "muted", "muted") if faint else (INPUT, OUTPUT, "warning")
        names = ("", "", "") if faint else ("x_p", "y_p", "a_c")
        canvas.line([view.at((0, 0, 0)), view.at(at)], "muted", 1.0)
        canvas.axis(view, at, -at, names[2], length=0.5, colour=inks[2], aside=(-14, -2))
        canvas.axis(view, at, EAST, names[0], length=0.45, colour=inks[0], aside=(6, 5))
        canvas.axis(view, at, NORTH, names[1], length=0.45, colour=inks[1], aside=(6, 0))
        canvas.dot(view.at(at), "ink", 3.5)
    canvas.arrow(view.circle((0, 0, 0), 0.36, 0.0, angle), "ink", 1.6)
    canvas.text(
        (
            view.at(0.5 * _direction(0.45 * angle))[0] + 4,
            view.at(0.5 * _direction(0.45 * angle))[1] + 5,
        ),
        "w_0t",
        "start",
    )
    x, y = view.at(0.72 * _direction(math.radians(165.0)))
    canvas.text((x + 14, y + 20), "R")
    canvas.text(
        (view.at(_direction(-1.2))[0] + 10, view.at(_direction(-1.2))[1] + 18),
        "path of the platform",
        "start",
        "muted",
    )
    return canvas


#: Name of a file -> what makes the drawing.
DRAWINGS: Final[Mapping[str, Callable[[], Canvas]]] = {
    "accelerometer": accelerometer,
    "arm": arm,
    "double-turntable": double_turntable,
    "paper-figure-1": paper_instruments,
    "paper-figure-2": paper_profile,
    "tumble": tumble,
}


def machine_svg(name: str, theme: Theme = "light") -> str:
    """Return a drawing as SVG, by its name."""
    return DRAWINGS[name]().svg(theme)

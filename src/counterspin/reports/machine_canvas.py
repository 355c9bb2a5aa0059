"""Lines, arrows and words as SVG, and a view of what has three dimensions.

Lengths on the canvas are in px of a drawing that is 480 wide, from its upper left corner.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape
from typing import Final, Literal

import numpy as np
import numpy.typing as npt

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.reports.drawing import COLOURS_OF_PAPER

Point = tuple[float, float]
#: Fixed colours on paper, or those of the page that the drawing stands in.
Theme = Literal["light", "page"]
Anchor = Literal["start", "middle", "end"]

#: Width of every drawing, and size of its words, px.
WIDTH: Final = 480
SIZE: Final = 14

_HEAD: Final = 9.0
_HEAD_WIDTH: Final = 3.6
#: Points of a whole turn.
_STEPS: Final = 96


@frozen
class Arrow:
    """An arrow, and which way it points in the frame."""

    words: str  #: At its head.
    direction: tuple[float, float, float]  #: East, north, up; of length 1.
    start: Point
    end: Point


@frozen
class View:
    """The view of the frame from the south and above, without perspective."""

    centre: Point  #: Where the origin is drawn.
    scale: float  #: px of a length of 1.
    elevation: float = math.radians(32.0)  #: Of the eye over the horizon, rad.
    azimuth: float = math.radians(-22.0)  #: By how much the eye stands west of south, rad.

    def at(self, place: npt.ArrayLike) -> Point:
        """Return the position in the drawing of a point (east, north, up)."""
        east, north, up = np.asarray(place, dtype=float)
        cos, sin = math.cos(self.azimuth), math.sin(self.azimuth)
        right, away = east * cos - north * sin, east * sin + north * cos
        height = up * math.cos(self.elevation) + away * math.sin(self.elevation)
        return self.centre[0] + self.scale * right, self.centre[1] - self.scale * height

    def circle(
        self, centre: npt.ArrayLike, radius: float, begin: float = 0.0, end: float = 2.0 * math.pi
    ) -> list[Point]:
        """Return a level arc, between two angles from east towards north, rad."""
        count = max(3, math.ceil(_STEPS * abs(end - begin) / (2.0 * math.pi)) + 1)
        east, north, up = np.asarray(centre, dtype=float)
        return [
            self.at((east + radius * math.cos(a), north + radius * math.sin(a), up))
            for a in np.linspace(begin, end, count)
        ]


class Canvas:
    """A drawing that is made part by part."""

    def __init__(self, title: str, words: str, height: float) -> None:
        self.title = title
        self.words = words
        self.height = height
        self.arrows: list[Arrow] = []
        self.labels: list[tuple[Point, str, Anchor]] = []
        self._parts: list[str] = []

    def line(
        self, points: Sequence[Point], colour: str = "ink", width: float = 1.4, dash: str = ""
    ) -> None:
        """Draw a line through points."""
        dashes = f";stroke-dasharray:{dash}" if dash else ""
        style = f"fill:none;stroke:{{{colour}}};stroke-width:{width}{dashes}"
        self._parts.append(f'<path d="{_path(points)}" style="{style}"/>')

    def area(self, points: Sequence[Point], colour: str, shade: float = 1.0) -> None:
        """Fill what lies within points."""
        style = f"fill:{{{colour}}};fill-opacity:{shade};stroke:none"
        self._parts.append(f'<path d="{_path(points)}Z" style="{style}"/>')

    def dot(self, point: Point, colour: str = "ink", radius: float = 3.0) -> None:
        """Draw a dot."""
        x, y = point
        style = f"fill:{{{colour}}}"
        self._parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius}" style="{style}"/>')

    def arrow(
        self, points: Sequence[Point], colour: str = "ink", width: float = 2.0, dash: str = ""
    ) -> None:
        """Draw a line with a head at its last point."""
        (x0, y0), (x1, y1) = points[-2], points[-1]
        length = math.hypot(x1 - x0, y1 - y0) or 1.0
        dx, dy = (x1 - x0) / length, (y1 - y0) / length
        neck = (x1 - 0.8 * _HEAD * dx, y1 - 0.8 * _HEAD * dy)
        if len(points) == 2 or length > _HEAD:
            self.line([*points[:-1], neck], colour, width, dash)
        else:
            self.line(points, colour, width, dash)
        back = (x1 - _HEAD * dx, y1 - _HEAD * dy)
        side = (_HEAD_WIDTH * dy, -_HEAD_WIDTH * dx)
        head = [
            (x1, y1),
            (back[0] + side[0], back[1] + side[1]),
            (back[0] - side[0], back[1] - side[1]),
        ]
        self.area(head, colour)

    def axis(
        self,
        view: View,
        start: npt.ArrayLike,
        direction: Sequence[float] | Array,
        words: str,
        *,
        length: float = 1.0,
        colour: str = "ink",
        aside: Point = (0.0, 0.0),
    ) -> None:
        """Draw an arrow along a direction in the frame, with words at its head.

        aside: Position of the words relative to the head, px; they extend away from it to the side.
        """
        unit = np.asarray(direction, dtype=float)
        unit = unit / np.linalg.norm(unit)
        origin = np.asarray(start, dtype=float)
        begin, end = view.at(origin), view.at(origin + length * unit)
        self.arrow([begin, end], colour)
        east, north, up = (float(part) for part in unit)
        self.arrows.append(Arrow(words, (east, north, up), begin, end))
        if words:
            anchor: Anchor = "start" if aside[0] > 0 else "end" if aside[0] < 0 else "middle"
            self.text((end[0] + aside[0], end[1] + aside[1]), words, anchor, colour)

    def text(
        self,
        point: Point,
        words: str,
        anchor: Anchor = "middle",
        colour: str = "ink",
        *,
        bold: bool = False,
    ) -> None:
        """Write words, with ``_x`` after a letter as a subscript."""
        x, y = point
        weight = ";font-weight:600" if bold else ""
        style = f"fill:{{{colour}}};font-size:{SIZE}px{weight}"
        letters = escape(words, quote=False)
        for name, index in (("w_0", "0"), ("a_c", "c"), ("x_p", "p"), ("y_p", "p"), ("z_p", "p")):
            lowered = (
                f'{name[0]}<tspan dy="3" font-size="10">{index}</tspan><tspan dy="-3"> </tspan>'
            )
            letters = letters.replace(name, lowered.replace("> </tspan>", ">\u200b</tspan>"))
        self.labels.append((point, words, anchor))
        self._parts.append(
            f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" style="{style}">{letters}</text>'
        )

    def svg(self, theme: Theme = "light") -> str:
        """Return the drawing; on paper with a ground of its own, and of the size that it has."""
        name = "".join(part for part in self.title.lower() if part.isalnum())
        size = f'width="{WIDTH}" height="{self.height:g}"' if theme == "light" else 'width="100%"'
        font = ' font-family="Helvetica, Arial, sans-serif"' if theme == "light" else ""
        ground = ""
        if theme == "light":
            ground = f'<path d="M0 0H{WIDTH}V{self.height:g}H0Z" style="fill:{{ground}}"/>\n'
        body = "\n".join(self._parts)
        for colour, on_paper in COLOURS_OF_PAPER.items():
            value = on_paper
            if theme == "page":
                value = f"var(--{colour}, {'currentColor' if colour == 'ink' else on_paper})"
            body = body.replace(f"{{{colour}}}", value)
            ground = ground.replace(f"{{{colour}}}", value)
        return (
            f'<svg xmlns="http://www.w3.org/2000/svg" {size} '
            f'viewBox="0 0 {WIDTH} {self.height:g}" role="img" '
            f'aria-labelledby="{name}-title" aria-describedby="{name}-words" '
            f'stroke-linejoin="round"{font}>\n'
            f'<title id="{name}-title">{escape(self.title, quote=False)}</title>\n'
            f'<desc id="{name}-words">{escape(self.words, quote=False)}</desc>\n'
            f"{ground}{body}\n</svg>\n"
        )


def _path(points: Sequence[Point]) -> str:
    return "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in points)

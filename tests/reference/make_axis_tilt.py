"""Make axis_tilt.json: specific forces on a centrifuge whose axis is tilted, to 22 digits.

Run from this folder: ``python make_axis_tilt.py`` (seconds; needs mpmath, which comes with sympy).
Nothing here uses counterspin. As in make_arm_forces.py the position is written down in an inertial
frame and differentiated twice in 60-digit arithmetic; here the circle is turned as a whole by the
tilt of the axis, with all its orders. On the arm the force is given along the axes of the machine,
which lean with it. On a double turntable, whose platform stays level, the derivative of the force
by the tilt is given, in east-north-up.
"""

import json
import pathlib

from make_arm_forces import DIGITS, EARTH_RATE, GRAVITY, earth
from mpmath import cos, diff, eye, matrix, mp, mpf, nstr, sin, sqrt

mp.dps = 60

CASES = [
    {
        "rate": rate,
        "radius": radius,
        "latitude": latitude,
        "angle": angle,
        "east": "1e-3",
        "north": "-7e-4",
    }
    for rate, radius in (("3.125", "2.5"), ("-9.9", "1.0"))
    for latitude in ("0.8", "-0.3")
    for angle in ("0", "1.1", "4.0")
]


def tilted(east, north):
    """Return the rotation by a small vector about east and north (Rodrigues)."""
    size = sqrt(east**2 + north**2)
    if size == 0:
        return eye(3)
    cross = matrix([[0, 0, north], [0, 0, -east], [-north, east, 0]]) / size
    return eye(3) + sin(size) * cross + (1 - cos(size)) * cross * cross


def level_force(rate, radius, latitude, angle, turn):
    """Return the specific force in east-north-up."""

    def place(t, axis):
        theta = angle + rate * t
        local = turn * matrix([radius * cos(theta), radius * sin(theta), 0])
        return (earth(t, latitude) * local)[axis]

    inertial = matrix([diff(lambda t, axis=axis: place(t, axis), 0, 2) for axis in range(3)])
    return earth(mpf(0), latitude).T * inertial + matrix([0, 0, GRAVITY])


def on_the_arm(rate, radius, latitude, angle, east, north):
    """Return outward, forward and up parts along the axes of the leaning machine."""
    turn = tilted(east, north)
    x, y, up = turn.T * level_force(rate, radius, latitude, angle, turn)
    return cos(angle) * x + sin(angle) * y, cos(angle) * y - sin(angle) * x, up


def derivative(rate, radius, latitude, angle, about):
    """Return the change of the force in east-north-up per rad of tilt about east or north."""
    step = mpf("1e-15")
    forces = []
    for sign in (1, -1):
        tilt = [sign * step if name == about else mpf(0) for name in ("east", "north")]
        forces.append(level_force(rate, radius, latitude, angle, tilted(*tilt)))
    return (forces[0] - forces[1]) / (2 * step)


def make():
    """Return the content of the file."""
    assert mpf("7.3e-5") > EARTH_RATE
    cases = []
    for case in CASES:
        numbers = {k: mpf(v) for k, v in case.items()}
        place = {k: v for k, v in numbers.items() if k not in ("east", "north")}
        cases.append(
            {
                **case,
                "arm": [nstr(f, DIGITS) for f in on_the_arm(**numbers)],
                **{
                    f"by_{about}": [nstr(f, DIGITS) for f in derivative(**place, about=about)]
                    for about in ("east", "north")
                },
            }
        )
    return {
        "made_by": pathlib.Path(__file__).name,
        "gravity": nstr(GRAVITY, DIGITS),
        "cases": cases,
    }


if __name__ == "__main__":
    data = pathlib.Path(__file__).parents[2] / "src" / "counterspin" / "validation" / "data"
    target = data / "axis_tilt.json"
    target.write_text(json.dumps(make(), indent=1) + "\n", encoding="utf-8")

"""Make arm_forces.json: specific forces on the arm of a centrifuge, to 22 digits.

Run from this folder: ``python make_arm_forces.py`` (seconds; needs mpmath, which comes with sympy).
Nothing here uses counterspin. The position of the instrument is written down in an inertial frame,
as the turning Earth carries it, and differentiated twice in 60-digit arithmetic; gravitation is
what makes the specific force at the spindle's axis (0, 0, g). The turn of the plumb line across
the radius is left out, the square of the Earth's rate times the radius is in.
"""

import json
import pathlib

from mpmath import cos, diff, matrix, mp, mpf, nstr, pi, sin

mp.dps = 60

EARTH_RATE, GRAVITY = mpf("7.292115e-5"), mpf("9.80665")
DIGITS = 22
CASES = [
    {"rate": rate, "radius": radius, "latitude": latitude, "angle": angle}
    for rate, radius in (("3.125", "2.5"), ("-6.28", "1.0"), ("9.9", "1.0"))
    for latitude in ("0.8", "-0.3")
    for angle in ("0", "1.1", "4.0")
]


def earth(t, latitude):
    """Return the rotation from east-north-up to an inertial frame at a time."""
    turn = EARTH_RATE * t
    # East, north and up of a place whose longitude is the angle that the Earth has turned.
    return matrix(
        [
            [-sin(turn), -sin(latitude) * cos(turn), cos(latitude) * cos(turn)],
            [cos(turn), -sin(latitude) * sin(turn), cos(latitude) * sin(turn)],
            [0, cos(latitude), sin(latitude)],
        ]
    )


def force(rate, radius, latitude, angle):
    """Return outward, forward and up parts of the specific force when the arm is at an angle."""

    def place(t, axis):
        theta = angle + rate * t
        local = matrix([radius * cos(theta), radius * sin(theta), 0])
        return (earth(t, latitude) * local)[axis]

    inertial = matrix([diff(lambda t, axis=axis: place(t, axis), 0, 2) for axis in range(3)])
    east, north, up = earth(mpf(0), latitude).T * inertial
    up += GRAVITY
    return (
        cos(angle) * east + sin(angle) * north,
        -sin(angle) * east + cos(angle) * north,
        up,
    )


def make():
    """Return the content of the file."""
    assert abs(pi - mpf("3.14159265358979323846264338327950288")) < mpf("1e-34")
    return {
        "made_by": pathlib.Path(__file__).name,
        "gravity": nstr(GRAVITY, DIGITS),
        "earth_rate": nstr(EARTH_RATE, DIGITS),
        "cases": [
            {
                **case,
                "force": [nstr(f, DIGITS) for f in force(**{k: mpf(v) for k, v in case.items()})],
            }
            for case in CASES
        ],
    }


if __name__ == "__main__":
    data = pathlib.Path(__file__).parents[2] / "src" / "counterspin" / "validation" / "data"
    target = data / "arm_forces.json"
    target.write_text(json.dumps(make(), indent=1) + "\n", encoding="utf-8")

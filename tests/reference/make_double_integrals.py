"""Make double_integrals.json: time integrals of specific-force products, to 22 digits.

Run from this folder: ``python make_double_integrals.py`` (about two minutes; needs mpmath, which
comes with sympy). Nothing here uses counterspin: the motion, the products and the platform's
errors are written out from their definitions in 40-digit arithmetic.

The integral from 0 to T, once and twice, is that of f(t) and (T - t) f(t). It is summed by
Gauss-Legendre with 24 nodes on panels of a quarter turn at most that end at every zero of every
accelerometer's input-axis force, because a_I*|a_I| and |a_I| have a kink there and sign(a_I)
jumps. The zeros are roots found by mpmath. Everything is done again with 48 nodes a panel and must
agree to 28 digits.
"""

import itertools
import json
import pathlib

from mpmath import cos, findroot, floor, mp, mpf, nstr, pi, sin
from mpmath.calculus.quadrature import GaussLegendre

mp.dps = 40

GRAVITY, RADIUS, LATITUDE, EARTH_RATE = mpf("9.80665"), mpf("2.5"), mpf("0.8"), mpf("7.292115e-5")
DIGITS = 22

# Input, pendulous, output axis, each as (sign, east-north-up index).
MOUNTINGS = {
    "QX": ((1, 0), (-1, 2), (1, 1)),
    "QY": ((1, 1), (-1, 2), (-1, 0)),
    "QZ": ((1, 2), (1, 0), (1, 1)),
}

PRODUCTS = {
    "1": lambda i, p, o: mpf(1),
    "a_I": lambda i, p, o: i,
    "a_I^2": lambda i, p, o: i * i,
    "a_I^3": lambda i, p, o: i * i * i,
    "a_I^4": lambda i, p, o: i * i * i * i,
    "a_I^5": lambda i, p, o: i * i * i * i * i,
    "a_I*a_P": lambda i, p, o: i * p,
    "a_I*a_O": lambda i, p, o: i * o,
    "a_P*a_O": lambda i, p, o: p * o,
    "a_P^2": lambda i, p, o: p * p,
    "a_O^2": lambda i, p, o: o * o,
    "a_I*|a_I|": lambda i, p, o: i * abs(i),
    "sign(a_I)/2": lambda i, p, o: mp.sign(i) / 2,
    "|a_I|/2": lambda i, p, o: abs(i) / 2,
    "a_P": lambda i, p, o: p,
    "a_O": lambda i, p, o: o,
}

TURN = "6.283185307179586476925286766559005768394338798750"
CASES = [
    {
        "label": "uniform",
        "rate": "3.141592653589793238462643383279502884197169399375",
        "times": ["2.5", "20.5", "80.5"],
    },
    {
        "label": "drift and ripple",
        "rate": TURN,
        "drift": "1e-5",
        "ripples": [[1, "6.283185307179586476925286766559e-4", "0.523598775598298873077107230547"]],
        "times": ["1.25", "10.25", "40.25"],
    },
    {
        "label": "drift, two ripples, Earth rate",
        "rate": "1.570796326794896619231321691639751442098584699688",
        "drift": "-3e-6",
        "earth_rate": True,
        "ripples": [
            [1, "7.853981633974483096156608458199e-7", "0.523598775598298873077107230547"],
            [2, "1e-5", "2"],
        ],
        "times": ["5", "41", "161"],
        "platform": True,
    },
    {
        "label": "negative rate, start angle, third harmonic, Earth rate",
        "rate": "-2",
        "drift": "1e-6",
        "start_angle": "0.9",
        "earth_rate": True,
        "ripples": [[3, "1e-4", "-1"]],
        "times": ["3", "50", "126"],
        "platform": True,
    },
]


def cross(a, b):
    return [
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    ]


class Motion:
    """Describe the circular motion, the spindle angle and the specific force."""

    def __init__(self, case):
        self.rate = mpf(case["rate"])
        self.drift = mpf(case.get("drift", "0"))
        self.start = mpf(case.get("start_angle", "0"))
        self.ripples = [(n, mpf(a), mpf(p)) for n, a, p in case.get("ripples", [])]
        earth = EARTH_RATE if case.get("earth_rate") else mpf(0)
        self.earth = [mpf(0), earth * cos(LATITUDE), earth * sin(LATITUDE)]

    def angle(self, t):
        w0 = self.rate
        theta = self.start + w0 * t + self.drift * w0 * t * t / 2
        for n, a, phase in self.ripples:
            theta -= a / (n * w0) * (cos(n * w0 * t + phase) - cos(phase))
        return theta

    def place(self, t):
        """Position, velocity and specific force in east-north-up."""
        w0, theta = self.rate, self.angle(t)
        w = w0 * (1 + self.drift * t)
        alpha = self.drift * w0
        for n, a, phase in self.ripples:
            w += a * sin(n * w0 * t + phase)
            alpha += a * n * w0 * cos(n * w0 * t + phase)
        c, s = RADIUS * cos(theta), RADIUS * sin(theta)
        r, v = [c, s, mpf(0)], [-w * s, w * c, mpf(0)]
        acceleration = [-w * w * c - alpha * s, -w * w * s + alpha * c, mpf(0)]
        coriolis = cross(self.earth, v)
        force = [x + 2 * y for x, y in zip(acceleration, coriolis, strict=True)]
        force[2] += GRAVITY
        return r, v, force

    def gained(self, t, r, v):
        """Integral of the specific force from 0 to t."""
        r0, v0, _ = self.place(mpf(0))
        turned = cross(self.earth, [x - y for x, y in zip(r, r0, strict=True)])
        gain = [x - y + 2 * z for x, y, z in zip(v, v0, turned, strict=True)]
        gain[2] += GRAVITY * t
        return gain

    def quarter_turns(self, end, offset):
        """Times in (0, end) at which the angle passes multiples of a quarter turn + offset."""
        first, last = sorted([self.angle(mpf(0)), self.angle(end)])
        lowest = int(floor((first - offset) / (pi / 2)))
        highest = int(floor((last - offset) / (pi / 2))) + 1
        for k in range(lowest, highest + 1):
            aim = offset + k * pi / 2
            yield findroot(lambda t, aim=aim: self.angle(t) - aim, (aim - self.start) / self.rate)

    def kinks(self, end):
        """Zeros in (0, end) of the horizontal components of the specific force."""
        for guess in self.quarter_turns(end, mpf(0)):
            # At a multiple of a quarter turn one of the two components is near its zero.
            force = self.place(guess)[2]
            axis = 0 if abs(force[0]) < abs(force[1]) else 1
            root = findroot(lambda t, axis=axis: self.place(t)[2][axis], guess)
            if abs(root - guess) > abs(pi / 8 / self.rate):
                raise ArithmeticError("a kink was found in the wrong place")
            if 0 < root < end:
                yield root


def integrands(motion, t, platform):
    """Every function to be integrated, m/s^2 per unit coefficient, in a fixed order."""
    r, v, force = motion.place(t)
    for axes in MOUNTINGS.values():
        ipo = [sign * force[axis] / GRAVITY for sign, axis in axes]
        yield from (GRAVITY * product(*ipo) for product in PRODUCTS.values())
    if not platform:
        return
    gain = [x / GRAVITY for x in motion.gained(t, r, v)]
    for (sign, axis), _, _ in MOUNTINGS.values():
        # The platform turned by the small psi senses f - psi x f.
        seen = []
        for k in range(3):
            unit = [mpf(int(k == m)) for m in range(3)]
            seen.append(-sign * cross(unit, force)[axis])
        yield from seen
        yield from (t * s for s in seen)
        yield from (g * s for s in seen for g in gain)
        # A platform that leans follows the force of the moment.
        yield from (f / GRAVITY * s for s in seen for f in force)


def names(platform):
    """Labels of the integrands: (mounting, name), in the order of `integrands`."""
    result = [(m, p) for m in MOUNTINGS for p in PRODUCTS]
    if platform:
        level, own = ("east", "north", "up"), "xyz"
        labels = [f"platform.tilt.{n}" for n in level] + [f"platform.drift.{n}" for n in level]
        labels += [f"platform.g_sensitivity.{i}{j}" for i in own for j in own]
        labels += [f"platform.compliance.{i}{j}" for i in own for j in own]
        result += [(m, label) for m in MOUNTINGS for label in labels]
    return result


def integrals(case, degree=4):
    """Single and double integrals of every integrand at every time, two lists of rows."""
    motion, platform = Motion(case), case.get("platform", False)
    times = [mpf(t) for t in case["times"]]
    end = times[-1]
    edges = [mpf(0), *times, *motion.kinks(end)]
    edges += [t for t in motion.quarter_turns(end, pi / 4) if 0 < t < end]
    edges = sorted(edges)
    nodes = GaussLegendre(mp).calc_nodes(degree, mp.prec)
    size = len(names(platform))
    moment0, moment1 = [mpf(0)] * size, [mpf(0)] * size
    single, double = [], []
    for left, right in itertools.pairwise(edges):
        middle, half = (left + right) / 2, (right - left) / 2
        for x, weight in nodes if half else ():
            t = middle + half * x
            w0 = half * weight
            w1 = w0 * t
            for index, value in enumerate(integrands(motion, t, platform)):
                moment0[index] += w0 * value
                moment1[index] += w1 * value
        if right in times:
            single.append(list(moment0))
            double.append([right * a - b for a, b in zip(moment0, moment1, strict=True)])
    return single, double


def worked(case):
    """Return a case of the file."""
    results, again = integrals(case), integrals(case, degree=5)
    for a, b in zip(itertools.chain(*results), itertools.chain(*again), strict=True):
        scale = max(abs(x) for x in b)
        if any(abs(x - y) > mpf(10) ** -28 * scale for x, y in zip(a, b, strict=True)):
            raise ArithmeticError(f"{case['label']}: the two rules do not agree")
    motion = Motion(case)
    out = {**case, "angle": [nstr(motion.angle(mpf(t)), DIGITS) for t in case["times"]]}
    labels = names(case.get("platform", False))
    for observable, rows in zip(("velocity", "displacement"), results, strict=True):
        table = {mounting: {} for mounting in MOUNTINGS}
        for (mounting, label), *values in zip(labels, *rows, strict=True):
            # What the rules leave of an exact zero is not a value.
            table[mounting][label] = [
                nstr(v, DIGITS) if abs(v) > mpf("1e-30") else "0.0" for v in values
            ]
        out[observable] = table
    return out


def main():
    document = {
        "about": (
            "Single (velocity) and double (displacement) time integrals from 0 of g x product of "
            "a_I, a_P, a_O in g, and of the platform's errors, in m/s and m per unit coefficient; "
            "made by make_double_integrals.py in 40-digit arithmetic"
        ),
        "gravity": str(GRAVITY),
        "radius": str(RADIUS),
        "latitude": str(LATITUDE),
        "earth_rate": nstr(EARTH_RATE, DIGITS),
        "cases": [worked(case) for case in CASES],
    }
    data = pathlib.Path(__file__).parents[2] / "src" / "counterspin" / "validation" / "data"
    target = data / "double_integrals.json"
    target.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()

"""Make random_walk.json: noise of a velocity record by restricted maximum likelihood, 22 digits.

Run from this folder: ``python make_random_walk.py`` (a minute; needs mpmath, which comes with
sympy). Nothing here uses counterspin. The record is white noise and a random walk of the generator
of make_joint_fit.py, rounded to micrometres a second; beside its start value a straight line is
unknown. The restricted likelihood is that of the dense covariance, V = w (I + r min(t_i, t_j)):

    2 log L = -log|V| - log|X' V^-1 X| - y' (V^-1 - V^-1 X (X' V^-1 X)^-1 X' V^-1) y

For a ratio r its greatest value has w = (y' ... y at w = 1)/(n - p); r is where the derivative of
what is left is zero, in 40-digit arithmetic.
"""

import json
import pathlib

from make_double_integrals import DIGITS
from make_joint_fit import normals
from mpmath import diff, eye, findroot, inverse, log, lu, matrix, mp, mpf, nint, nstr, sqrt

mp.dps = 40

SAMPLES, STEP = 32, mpf("0.5")
WHITE, WALK = mpf("1e-3"), mpf("2e-3")


def record():
    """Times, and the recorded velocity as it is written."""
    random, walked, rows = normals(7), mpf(0), []
    for i in range(SAMPLES):
        value = mpf("0.4") - mpf("0.01") * STEP * i + walked + WHITE * next(random)
        rows.append((STEP * i, nint(value * 10**6) / 10**6))
        walked += WALK * sqrt(STEP) * next(random)
    return rows


def log_det(matrix_):
    return sum(log(abs(pivot)) for pivot in _pivots(matrix_))


def _pivots(matrix_):
    _, _, upper = lu(matrix_)
    return [upper[i, i] for i in range(upper.rows)]


def parts(rows, ratio):
    """log|V| + log|X' V^-1 X| and the weighted sum of squared residuals, both at w = 1."""
    design = matrix([[1, t] for t, _ in rows])
    seen = matrix([y for _, y in rows])
    noise = eye(len(rows))
    for i, (a, _) in enumerate(rows):
        for j, (b, _) in enumerate(rows):
            noise[i, j] += ratio * min(a, b)
    weight = inverse(noise)
    information = design.T * weight * design
    right = design.T * weight * seen
    rest = (seen.T * weight * seen)[0] - (right.T * inverse(information) * right)[0]
    return log_det(noise) + log_det(information), rest


def twice_log_likelihood(rows, ratio):
    """Return the value at the best w, up to a constant."""
    free = len(rows) - 2
    dets, rest = parts(rows, ratio)
    return -dets - free * log(rest / free) - free


def main():
    rows = record()
    start = log(WALK**2 / WHITE**2)

    def slope(log_ratio):
        return diff(lambda x: twice_log_likelihood(rows, mp.exp(x)), log_ratio, h=mpf("1e-12"))

    grid = [start + mpf(k) / 2 for k in range(-8, 9)]
    best = max(grid, key=lambda x: twice_log_likelihood(rows, mp.exp(x)))
    ratio = mp.exp(findroot(slope, (best, best + mpf("0.1")), tol=mpf("1e-20")))
    white = sqrt(parts(rows, ratio)[1] / (SAMPLES - 2))
    gain = (twice_log_likelihood(rows, ratio) - twice_log_likelihood(rows, mpf(0))) / 2
    document = {
        "about": (
            "White noise (m/s), random walk (m/s/s^0.5) and gain in restricted log-likelihood of a "
            "velocity record; made by make_random_walk.py in 40-digit arithmetic"
        ),
        "time": [float(t) for t, _ in rows],
        "velocity": [nstr(y, 8) for _, y in rows],
        "white": nstr(white, DIGITS),
        "random_walk": nstr(white * sqrt(ratio), DIGITS),
        "gain": nstr(gain, DIGITS),
    }
    data = pathlib.Path(__file__).parents[2] / "src" / "counterspin" / "validation" / "data"
    (data / "random_walk.json").write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()

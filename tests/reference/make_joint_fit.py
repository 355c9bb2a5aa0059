"""Make the campaign of the joint fit's case and joint_fit.json: its estimates, to 22 digits.

Run from this folder: ``python make_joint_fit.py`` (a minute; needs mpmath, which comes with sympy).
Nothing here uses counterspin. Two records are written as a recorder would: the circle's position
along east, what the error terms add, the noise of a linear congruential generator, all rounded to
nanometres. What was written is then read as exact and fitted by generalised least squares in
40-digit arithmetic, with the covariance of white noise and an integrated random walk in full:

    x = (A' V^-1 A + P)^-1 (A' V^-1 y + P m),  G = (A' V^-1 A + P)^-1 A' V^-1

A are the double integrals of the products of specific force and, for each run, start offset and
velocity; P and m are the prior of K_III. u_noise^2 is the diagonal of G V G', u_stated^2 that of
(A' V^-1 A + P)^-1 P (A' V^-1 A + P)^-1 and of B B', B being G times the column of K_PP times its u.
"""

import itertools
import json
import pathlib

from make_double_integrals import DIGITS, GRAVITY, LATITUDE, MOUNTINGS, PRODUCTS, RADIUS, Motion
from mpmath import cos, diag, inverse, log, matrix, mp, mpf, nint, nstr, pi, sqrt, zeros
from mpmath.calculus.quadrature import GaussLegendre

mp.dps = 40

RUNS = {
    "slow": {"rate": "2", "start_angle": "0.3", "step": "0.2", "earth_rate": True},
    "fast": {"rate": "-4", "start_angle": "1.1", "step": "0.1", "earth_rate": True},
}
SAMPLES = 101
TERMS = {"K_F": "1", "K_I": "a_I", "K_II": "a_I^2", "K_III": "a_I^3"}
CONSIDERED = "a_P^2"
TRUTH = {"K_F": "5e-3", "K_I": "1.002", "K_II": "2.7e-5", "K_III": "1e-6", "K_PP": "1e-6"}
WHITE, WALK = mpf("1e-3"), mpf("1e-6") * GRAVITY  # m, m/s/s^0.5
PRIOR_OF_K_III, U_OF_K_PP = mpf("1e-5"), mpf("2e-6")

CAMPAIGN = f"""schema = 1

[campaign]
title = "Reference case of the joint fit: made by tests/reference/make_joint_fit.py"

[site]
gravity = "{GRAVITY} m/s^2"
latitude = "{LATITUDE} rad"

[centrifuge]
radius = "{RADIUS} m"

[records]
time = {{ column = "time_s", unit = "s" }}
angle = {{ column = "angle_rad", unit = "rad" }}

[accelerometers.Qx]
input_axis = "east"
pendulous_axis = "down"
displacement = {{ column = "east_m", unit = "m" }}

[noise]
displacement = "1e-3 m"
acceleration = "1e-6 g/Hz^0.5"

[model]
assume = "all"
terms = ["K_F", "K_I", "K_II", "K_III"]
hold = ["K_PP"]

[model.priors]
K_III = "0 ± 1e-5 g/g^3"
K_PP = "0 ± 2e-6 g/g^2"

[[runs]]
name = "slow"
rate = "2 rad/s"
record = "slow.csv"

[[runs]]
name = "fast"
rate = "-4 rad/s"
record = "fast.csv"
"""


def normals(seed):
    """Numbers of a standard normal law (Box and Muller), of a generator of Numerical Recipes."""
    state = seed
    while True:
        pair = []
        for _ in range(2):
            state = (1664525 * state + 1013904223) % 2**32
            pair.append((mpf(state) + mpf(1) / 2) / 2**32)
        yield sqrt(-2 * log(pair[0])) * cos(2 * pi * pair[1])


def columns(motion, times):
    """Double integrals at the times of the products that are asked for, a list of rows."""
    wanted = [PRODUCTS[name] for name in (*TERMS.values(), CONSIDERED)]
    nodes = GaussLegendre(mp).calc_nodes(3, mp.prec)
    single, double = [mpf(0)] * len(wanted), [mpf(0)] * len(wanted)
    rows = [list(double)]
    for left, right in itertools.pairwise(times):
        middle, half = (left + right) / 2, (right - left) / 2
        for index in range(len(wanted)):
            double[index] += (right - left) * single[index]
        for x, weight in nodes:
            t = middle + half * x
            force = motion.place(t)[2]
            ipo = [sign * force[axis] / GRAVITY for sign, axis in MOUNTINGS["QX"]]
            for index, product in enumerate(wanted):
                value = half * weight * GRAVITY * product(*ipo)
                single[index] += value
                double[index] += (right - t) * value
        rows.append(list(double))
    return rows


def covariance(times):
    """Of white noise and of an integrated random walk."""
    result = zeros(len(times))
    for i, a in enumerate(times):
        for j, b in enumerate(times):
            low, high = min(a, b), max(a, b)
            result[i, j] = WALK**2 * low * low * (high / 2 - low / 6)
        result[i, i] += WHITE**2
    return result


def recorded(motion, times, table, seed):
    """Return the recorded angle and the position along east with its errors, nm."""
    random = normals(seed)
    velocity, drifted, rows = mpf(0), mpf(0), []
    step = times[1] - times[0]
    errors = [mpf(TRUTH[s]) - (1 if s == "K_I" else 0) for s in (*TERMS, "K_PP")]
    for t, row in zip(times, table, strict=True):
        east = motion.place(t)[0][0]
        error = sum((e * c for e, c in zip(errors, row, strict=True)), mpf(0))
        value = east + error + mpf("0.02") - mpf("1e-3") * t + drifted + WHITE * next(random)
        # A walk of the velocity with steps of the variance N^2 dt, and its integral.
        change = WALK * sqrt(step) * next(random)
        drifted += step * (velocity + change / 2)
        velocity += change
        rows.append((t, motion.angle(t), nint(value * 10**9) / 10**9))
    return rows


def fitted(runs):
    """Estimate and parts of the uncertainty of each term, and the correlations of all."""
    size = len(TERMS) + 2 * len(runs)
    information, right = zeros(size), zeros(size, 1)
    gains, considered = [], matrix(size, 1)
    for place, (motion, times, table, rows) in enumerate(runs):
        design, seen, last = matrix(SAMPLES, size), matrix(SAMPLES, 1), matrix(SAMPLES, 1)
        for i, (t, row, (_, _, value)) in enumerate(zip(times, table, rows, strict=True)):
            for j in range(len(TERMS)):
                design[i, j] = row[j]
            design[i, len(TERMS) + 2 * place] = 1
            design[i, len(TERMS) + 2 * place + 1] = t
            # The perfect system has K_I = 1 and records the position.
            seen[i] = value - motion.place(t)[0][0] + row[1]
            last[i] = row[-1]
        noise = covariance(times)
        weighted = (inverse(noise) * design).T
        information += weighted * design
        right += weighted * seen
        gains.append((weighted, noise))
        considered += weighted * last
    prior = diag([mpf(0)] * 3 + [1 / PRIOR_OF_K_III**2] + [mpf(0)] * (size - 4))
    spread = inverse(information + prior)
    estimate = spread * right
    of_noise = zeros(size)
    for weighted, noise in gains:
        of_noise += spread * weighted * noise * (spread * weighted).T
    of_prior = spread * prior * spread
    by_k_pp = spread * considered * U_OF_K_PP
    whole = of_noise + of_prior + by_k_pp * by_k_pp.T
    expected = {}
    for j, symbol in enumerate(TERMS):
        parts = [of_noise[j, j], of_prior[j, j] + by_k_pp[j] ** 2]
        numbers = [estimate[j], sqrt(whole[j, j]), *map(sqrt, parts)]
        expected[f"Qx.{symbol}"] = [*(nstr(number, DIGITS) for number in numbers), "0"]
    correlation = [
        nstr(whole[i, j] / sqrt(whole[i, i] * whole[j, j]), DIGITS)
        for i in range(len(TERMS))
        for j in range(len(TERMS))
    ]
    return {**expected, "correlation of Qx": correlation}


def main():
    data = pathlib.Path(__file__).parents[2] / "src" / "counterspin" / "validation" / "data"
    folder = data / "campaign"
    folder.mkdir(exist_ok=True)
    (folder / "campaign.toml").write_text(CAMPAIGN, encoding="utf-8")
    runs = []
    for seed, (name, run) in enumerate(RUNS.items(), 1):
        motion = Motion(run)
        times = [mpf(run["step"]) * i for i in range(SAMPLES)]
        table = columns(motion, times)
        rows = recorded(motion, times, table, seed)
        runs.append((motion, times, table, rows))
        lines = [f"{nstr(t, 6)},{nstr(a, 18)},{nstr(y, 14)}" for t, a, y in rows]
        text = "\n".join(["time_s,angle_rad,east_m", *lines]) + "\n"
        (folder / f"{name}.csv").write_text(text, encoding="utf-8")
    document = {
        "about": (
            "Estimate, u, u_noise, u_stated and u_unstated of each term of the campaign in the "
            "folder campaign, and their correlations, row by row; made by make_joint_fit.py in "
            "40-digit arithmetic"
        ),
        "joint_fit": {"expected": fitted(runs)},
    }
    (data / "joint_fit.json").write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()

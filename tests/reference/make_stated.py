"""Make stated.json: corrected forces and a certificate's numbers, of given coefficients.

Run from this folder: ``python make_stated.py`` (seconds; needs mpmath, which comes with sympy).
Nothing here uses counterspin; all is 40-digit arithmetic. A corrected force a solves

    K_F + K_I a + K_II a^2 + K_III a^3 + K_IP a p + K_IO a o + K_PP p^2 + delta_O p - delta_P o = y

for the indication y, of two accelerometers on one platform together, each the other's o; its u is
that of the solution's derivatives (by differences of solutions) by every coefficient and known
force. A certificate states K g^n and U = k u, k of Student's t for 95 % and rounded to four
decimals; an uncertain g that moves K by s moves K g^n by g^n (s + n K/g).
"""

import json
import pathlib

from mpmath import betainc, findroot, mp, mpf, nint, nstr, sqrt

mp.dps = 40
DIGITS = 20
G = mpf("9.8")
STEP = mpf("1e-15")

#: Coefficients: value, u; and what is uncorrelated is left out of the correlations.
X = {
    **{"K_F": ("5e-3", "2e-6"), "K_I": ("1.002", "8e-6"), "K_II": ("3e-5", "4e-7")},
    **{"K_III": ("-2e-6", "1e-7"), "K_IP": ("4e-6", "1e-6"), "K_PP": ("-3e-6", "5e-7")},
    **{"K_IO": ("6e-6", "2e-6"), "delta_O": ("2e-4", "3e-6"), "delta_P": ("-1e-4", "2e-5")},
}
Y = {
    **{"K_F": ("-2e-3", "3e-6"), "K_I": ("0.9991", "5e-6"), "K_II": ("-4e-5", "6e-7")},
    "delta_P": ("3e-4", "1e-5"),
}
RELATED = {("K_F", "K_II"): "-0.4", ("K_I", "K_III"): "-0.7", ("K_F", "K_I"): "0.2"}


def signal(own, a, p, o):
    """Indicated force in g."""
    k = {symbol: own.get(symbol, mpf(0)) for symbol in X}
    polynomial = k["K_F"] + k["K_I"] * a + k["K_II"] * a**2 + k["K_III"] * a**3
    crossed = k["K_IP"] * a * p + k["K_IO"] * a * o + k["K_PP"] * p**2
    return polynomial + crossed + k["delta_O"] * p - k["delta_P"] * o


def numbers(table, which):
    return {symbol: mpf(pair[which]) for symbol, pair in table.items()}


def alone(y, own, p, o):
    return findroot(lambda a: signal(own, a, p, o) - y, y)


def both(y, x_own, y_own, p):
    """Forces east and north; the output axes are north of X and west of Y."""
    solution = findroot(
        lambda a, b: [signal(x_own, a, p, b) - y[0], signal(y_own, b, p, -a) - y[1]], y
    )
    return solution[0], solution[1]


def variance(slopes, table):
    """Of derivatives by coefficients, shape as `table`."""
    u = numbers(table, 1)
    total = sum((slopes[s] * u[s]) ** 2 for s in table)
    for (one, other), r in RELATED.items():
        if {one, other} <= set(table):
            total += 2 * mpf(r) * slopes[one] * u[one] * slopes[other] * u[other]
    return total


def changed(table, symbol):
    own = numbers(table, 0)
    return {**own, symbol: own[symbol] + STEP}


def corrected_alone(indicated, p, u_p, o):
    """Force and u in the unit of the indication, m/s^2; p known with u, o a number."""
    own, answer = numbers(X, 0), []
    for y in indicated:
        a = alone(y / G, own, p, o)
        slopes = {s: (alone(y / G, changed(X, s), p, o) - a) / STEP for s in X}
        by_p = (alone(y / G, own, p + STEP, o) - a) / STEP
        answer.append((a * G, sqrt(variance(slopes, X) + (by_p * u_p) ** 2) * G))
    return answer


def corrected_together(pairs, p):
    """Force east and u in g, where the other accelerometer senses north."""
    answer, (x_own, y_own) = [], (numbers(X, 0), numbers(Y, 0))
    for y in pairs:
        a, _ = both(y, x_own, y_own, p)
        by_x = {s: (both(y, changed(X, s), y_own, p)[0] - a) / STEP for s in X}
        by_y = {s: (both(y, x_own, changed(Y, s), p)[0] - a) / STEP for s in Y}
        answer.append((a, sqrt(variance(by_x, X) + variance(by_y, Y))))
    return answer


def student(dof):
    """k for 95 % in the middle."""

    def tail(t):
        return betainc(dof / 2, mpf("0.5"), 0, dof / (dof + t**2), regularized=True) - mpf("0.05")

    return findroot(tail, 2)


def rounded(number):
    return nint(number * 10**4) / 10**4


def certified(gravity_u, coefficients, related):
    """Value, U and k in SI; covariance; k of the region of two."""
    g, estimates = G, []
    for value, u, dof, power, sensitivity in coefficients:
        scale = g**power
        kept = sensitivity * gravity_u * scale
        shift = kept + power * value * scale / g * gravity_u
        without = sqrt((u * scale) ** 2 - kept**2)
        whole = sqrt(without**2 + shift**2)
        freedom = dof * (whole / (u * scale)) ** 4
        k = rounded(student(freedom))
        estimates.append((value * scale, whole, k, freedom, u * scale, kept, shift))
    (_, u1, _, _, old1, kept1, shift1), (_, u2, _, _, old2, kept2, shift2) = estimates
    # What both numbers have of g in g-units goes, and what they have in SI comes.
    together = related * old1 * old2 - kept1 * kept2 + shift1 * shift2
    least = min(estimate[3] for estimate in estimates)
    # F of two quantities in closed form: P = 1 - (1 + 2 F/dof)^(-dof/2).
    region = sqrt(least * (mpf("0.05") ** (-2 / least) - 1))
    lines = [[v, k * u, k] for v, u, k, *_ in estimates]
    return lines, [u1**2, together, together, u2**2], rounded(region)


def texts(values):
    return [nstr(v, DIGITS) for v in values]


def main():
    table = {"Qx": X, "Qy": Y}
    related = [[one, other, r] for (one, other), r in RELATED.items()]
    single = [mpf(y) for y in ("0.3", "9.8", "-25", "98")]
    pairs = [tuple(map(mpf, pair)) for pair in (("0", "1"), ("4", "-3"), ("-10", "10"))]
    corrected = corrected_alone(single, mpf(-1), mpf("2e-4"), mpf("0.5"))
    coupled = corrected_together(pairs, mpf(-1))
    stated = [
        (mpf("0.005"), mpf("1e-6"), mpf(12), 1, mpf("-5e-4")),
        (mpf("2.7e-5"), mpf("2e-9"), mpf(50), -1, mpf("4e-7")),
    ]
    lines, together, region = certified(mpf("1e-3"), stated, mpf("0.25"))
    document = {
        "made_by": pathlib.Path(__file__).name,
        "coefficients": table,
        "correlation": related,
        "alone": {"corrected": texts(a for a, _ in corrected), "u": texts(u for _, u in corrected)},
        "together": {"corrected": texts(a for a, _ in coupled), "u": texts(u for _, u in coupled)},
        "certificate": {
            "K_F": texts(lines[0]),
            "K_II": texts(lines[1]),
            "covariance": texts(together),
            "k of the region": [nstr(region, 6)],
        },
    }
    data = pathlib.Path(__file__).parents[2] / "src" / "counterspin" / "validation" / "data"
    text = json.dumps(document, indent=1) + "\n"
    (data / "stated.json").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()

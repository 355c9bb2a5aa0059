"""Make the records of the campaigns in validation/data/fits, and fits.json: what fits say of them.

Run from this folder: ``python make_fits.py``, or with the names of some campaigns (minutes; needs
NumPy, and mpmath, which comes with sympy). Nothing here uses counterspin. Each campaign stands
there twice: as a description in ``campaign.toml``, written by hand as a laboratory would, and here
as what `dense_fit` takes.
Records and readings are those of the model of `dense_fit` with errors of every kind in them, and
noise of a linear congruential generator; what is then in the files is read as exact and fitted.
Typical sizes are those that docs/physics.md states.
"""

import json
import math
import pathlib
import re
import sys
from dataclasses import replace

import numpy as np
from dense_fit import (
    AXES,
    ON_THE_ARM,
    Instrument,
    Place,
    Reading,
    Rows,
    Run,
    Unknown,
    fit,
    reading,
    record,
    rotated,
    walk,
)
from mpmath import gammainc
from restricted import Likelihood, hidden

DATA = pathlib.Path(__file__).parents[2] / "src" / "counterspin" / "validation" / "data"
ARCSEC = math.pi / 648000.0
DEGREE_PER_HOUR = math.pi / 180.0 / 3600.0
G = 9.8066  #: of all campaigns, m/s^2
COMPASS = ("east", "north", "up")

#: Typical sizes: of an accelerometer of navigation grade, of the platform, of the path, of inputs.
OWN = {
    **{"K_F": 1e-4, "K_I": 1e-4, "K_II": 1e-5, "K_III": 1e-6, "K_4": 1e-9, "K_OQ": 1e-6},
    **{"K_5": 1e-8, "K_0_asym": 5e-6, "K_I_asym": 1e-5},
    **dict.fromkeys(("K_IP", "K_IO", "K_PO", "K_PP", "K_OO"), 2e-6),
    **dict.fromkeys(("delta_O", "delta_P"), 5e-5),
    **{"K_F.temperature": 5e-6, "K_I.temperature": 1e-4, "K_II.temperature": 1e-8},
    **{"K_F.trend": 1.7e-9, "K_F.heating": 1e-7},
}
#: Beside these where temperatures were taken.
WARM = {
    **{"K_F.temperature.2": 5e-8, "K_F.temperature.3": 5e-10},
    **{"K_I.temperature.2": 1e-6, "K_I.temperature.3": 1e-8},
}
PLATFORM = {
    **{f"platform.drift.{e}": 0.01 * DEGREE_PER_HOUR for e in COMPASS},
    **{f"platform.g_sensitivity.{i}{j}": 0.01 * DEGREE_PER_HOUR for i in "xyz" for j in "xyz"},
    **{f"platform.g2_sensitivity.{e}": 1e-4 * DEGREE_PER_HOUR for e in COMPASS},
    **{f"platform.compliance.{i}{j}": 0.1 * ARCSEC for i in "xyz" for j in "xyz"},
}
AXIS_TILT = {f"centrifuge.axis_tilt.{e}": 10.0 * ARCSEC for e in ("east", "north")}
PATH = {
    "centrifuge.stretch": 4.6e-9,
    **{f"centrifuge.imbalance.{n}.{q}": 1e-6 for n in (1, 2) for q in ("cos", "sin")},
    **AXIS_TILT,
    **{f"encoder.harmonic.{n}.{q}": ARCSEC for n in (1, 2, 3, 4) for q in ("cos", "sin")},
}
LATITUDE, DELAY = {"site.latitude": 5e-6}, {"records.timing_offset": 1e-5}
RATE_CLOCK = {"centrifuge.clock": 2e-5}
MOUNTED_RADIUS, RANDOM_RATE = 1e-3, 1e-7

#: The beginning of the name of the random error of the rate of a reading.
RATE = "rate of "

#: How far a number may be off, as a part of u; derivatives by inputs are taken once, not as here.
CLOSE = 3e-4
#: The same where noise is estimated: the search for it ends at 0.3 % of a level, and levels of
#: noise that does not show are summed in steps of a factor e.
CLOSE_OF_FOUND = 5e-3


class Normals:
    """Numbers of a standard normal law (Box and Muller), of a generator of Numerical Recipes."""

    def __init__(self, seed):
        self.state = seed

    def one(self):
        pair = []
        for _ in range(2):
            self.state = (1664525 * self.state + 1013904223) % 2**32
            pair.append((self.state + 0.5) / 2**32)
        return math.sqrt(-2.0 * math.log(pair[0])) * math.cos(2.0 * math.pi * pair[1])

    def many(self, size):
        return np.array([self.one() for _ in range(size)])

    def of(self, covariance):
        """Draw noise with a covariance; entries without variance have no noise."""
        there = np.diag(covariance) > 0.0
        noise = np.zeros(len(covariance))
        root = np.linalg.cholesky(covariance[np.ix_(there, there)])
        noise[there] = root @ self.many(int(there.sum()))
        return noise


class Answers:
    """Contain the compared numbers of a case by name, with tolerances."""

    def __init__(self):
        self.expected, self.limits = {}, {}

    def add(self, name, values, off):
        self.expected[name] = [float(f"{v:.12g}") for v in np.ravel(values)]
        self.limits[name] = [float(f"{v:.3g}") for v in np.ravel(off)]

    def lines(self, fit_result, names, close=CLOSE, more=None):
        """Value, u and its parts; `more` is what a value is larger by in the result."""
        for name in names:
            line = np.array(fit_result.line(name))
            line[0] += (more or {}).get(name, 0.0)
            self.add(name, line, np.full(5, close * line[1]))

    def correlation(self, fit_result, owner):
        """Return the correlations of the parameters of interest by row."""
        names = sorted(n for n in asked_of(fit_result) if n.startswith(owner + "."))
        matrix = fit_result.correlation(names)
        self.add(f"correlation of {owner}", matrix, np.full(matrix.shape, 2.0 * CLOSE))

    def budget(self, fit_result, name):
        """Add the contribution of each source to u, if it exceeds a hundredth of u.

        The random errors of all rates are a single source.
        """
        k, u = fit_result.names.index(name), fit_result.line(name)[1]
        contributions = {}
        for prior, moved in fit_result.priors.items():
            source = "centrifuge.rate" if prior.startswith(RATE) else prior
            contributions[source] = math.hypot(contributions.get(source, 0.0), moved[k])
        for source, contribution in contributions.items():
            if contribution > 1e-2 * u:
                self.add(f"contribution of {source} to {name}", [contribution], [CLOSE * u])

    def rests_on(self, fit_result):
        """Return posterior value and u of nuisance parameters that the data inform."""
        for unknown in fit_result.unknowns:
            value, u, *_ = fit_result.line(unknown.name)
            random = unknown.name.startswith(RATE)
            if unknown.kind != "asked" and not random and u < 0.9 * unknown.sd:
                self.add(f"posterior of {unknown.name}", [value - unknown.mean, u], [CLOSE * u] * 2)

    def misfit(self, fit_result, owner, groups):
        """Chi-square, degrees of freedom, and the probability of a worse fit."""
        chi2, dof = fit_result.misfit(groups)
        p = float(gammainc(dof / 2.0, chi2 / 2.0, regularized=True))
        self.add(f"chi-square test of {owner}", [chi2, dof, p], [1e-3 * chi2, 1e-5 * dof, 2e-3])

    def dof(self, name, value, close):
        self.add(f"degrees of freedom of {name}", [value], [close * value])

    def output(self, fit_result, name, per_g):
        """Bias and scale factor in the unit of the readings."""
        for key, symbol in (("bias", "K_F"), ("scale_factor", "K_I")):
            value, u, *_ = fit_result.line(f"{name}.{symbol}")
            size = np.array([value, u]) * per_g
            self.add(f"{key} of {name}", size, [CLOSE * size[1]] * 2)


def asked_of(fit_result):
    return [u.name for u in fit_result.unknowns if u.kind == "asked" and "spindle" not in u.name]


def unknowns_of(asked, stated, unstated, held=None):
    """Return all unknowns.

    asked: names, some of which may be stated too; stated, held: name -> value and u; unstated:
    name -> u.
    """
    held = held or {}

    def nominal(name):
        return 1.0 if name.endswith(".K_I") else 0.0

    free = [Unknown(n, nominal(n), step=1e-4) for n in asked if n not in stated]
    wanted = [Unknown(n, *stated[n], "asked") for n in asked if n in stated]
    known = [Unknown(n, *pair, "stated") for n, pair in stated.items() if n not in asked]
    there = {*asked, *stated, *held}
    typical = [Unknown(n, nominal(n), u, "unstated") for n, u in unstated.items() if n not in there]
    return [*free, *wanted, *known, *typical, *(Unknown(n, *p, "held") for n, p in held.items())]


def written(folder, name, columns, formats):
    """Write a record by column name and return the rounded values, shape (columns, n).

    What is no number becomes an empty cell.
    """
    path = folder / f"{name}.csv"
    rows = zip(*columns.values(), strict=True)
    lines = [
        ",".join("" if np.isnan(v) else f % v for f, v in zip(formats, row, strict=True))
        for row in rows
    ]
    path.write_text("\n".join([",".join(columns), *lines]) + "\n", encoding="utf-8")
    return np.genfromtxt(path, delimiter=",", skip_header=1).T


def start_errors(run, instrument):
    """Columns of start offset and start velocity, as far as the observable has them."""
    order = {"displacement": 2, "velocity": 1, "force": 0}[instrument.observable]
    return np.vander(run.times, order, increasing=True)


def model_of(place, run, instrument):
    return lambda x: record(place, run, instrument, x)


def readings_of(place, name, readings, per_g):
    """Rows of readings in their own unit, with the dividing head's part in their covariance."""

    def values(x):
        return per_g * np.array([reading(place, one, name, x) for one in readings])

    def covariance(x):
        step, variances = 1e-5, []
        for new_reading in readings:
            turned = [
                reading(place, new_reading, name, {**x, f"head of {new_reading.name}": s * step})
                for s in (1, -1)
            ]
            by_head = per_g * (turned[0] - turned[1]) / (2.0 * step) * new_reading.u_head
            variances.append(new_reading.u**2 + by_head**2)
        return np.diag(variances)

    read = np.array([reading.value for reading in readings])
    return Rows(values, read, covariance, np.zeros((read.size, 0)))


def read(place, name, readings, truth, per_g, normals, digits):
    """The readings with values as they are written: of the truth, with the noise of each."""
    there = []
    for new_reading in readings:
        off = (
            {f"head of {new_reading.name}": new_reading.u_head * normals.one()}
            if new_reading.u_head
            else {}
        )
        if new_reading.u_rate:
            off[RATE + new_reading.name] = new_reading.u_rate * normals.one()
        value = (
            per_g * reading(place, new_reading, name, {**truth, **off})
            + new_reading.u * normals.one()
        )
        there.append(replace(new_reading, value=round(value, digits)))
    return there


def fill(folder, values, form):
    """Put values into the readings of a description, in their order."""
    path, left = folder / "campaign.toml", iter(values)
    text = path.read_text(encoding="utf-8")
    text = re.sub(r'reading = "[-.\d]+', lambda _: f'reading = "{next(left):{form}}', text)
    path.write_text(text, encoding="utf-8")


# Three accelerometers, a record of each kind of each of three runs, one of them turned; nothing is
# assumed, so that every term and input that there is counts.


def observables(folder):
    instruments = [
        Instrument("Qx", "east", "down", "displacement"),
        Instrument("Qy", "north", "down", "velocity"),
        Instrument("Qz", "up", "east", "force", per_g=1.25),
    ]
    place = Place(G, math.radians(45.75), 2.5)
    truth = {
        **{"Qx.K_F": 5e-3, "Qx.K_I": 1.002, "Qx.K_II": 2.7e-5, "Qx.K_OO": 1e-7, "Qx.K_PP": 8e-7},
        **{"Qy.K_F": 2.11e-3, "Qy.K_I": 0.9985, "Qy.K_II": -1.2e-5, "Qy.K_IO": 1.5e-6},
        **{"Qz.K_F": -1e-3, "Qz.K_I": 1.0011, "Qz.K_II": 1.8e-5, "Qz.K_PP": 9e-7},
        **{"platform.drift.north": 3e-8, "platform.compliance.zy": 3e-7},
        **{"slow.platform.tilt.north": 4e-6, "turned.platform.tilt.east": -7e-6},
        **{"centrifuge.radius": -8e-6, "encoder.harmonic.1.sin": 3e-6, "records.clock": 4e-6},
        "centrifuge.stretch": 6e-8,
    }
    turn, later = (math.radians(50.0), "east"), {"begins": 12.0, "warmth": 0.1}
    runs = [
        Run("slow", 2.0, 0.2 * np.arange(61), 0.3, drift=2e-5, warmth=-0.5),
        Run("fast", -math.radians(240.0), 0.1 * np.arange(61), 1.1, ripple=(2e-4, 0.7), **later),
        Run("turned", math.pi, 0.125 * np.arange(57), -0.4, turn=turn, begins=18.0, warmth=0.3),
    ]
    # White noise, in the file's unit the factor that it has.
    white = {"displacement": 1e-4, "velocity": 1e-4, "force": 2e-5 * 1.25}
    per, density = {"displacement": 1e3}, (2e-6 * G) ** 2
    normals, groups = Normals(11), []
    for run in runs:
        covariances, columns = [], {"time_s": run.times, "angle_rad": run.angle(run.times)[0]}
        for new_instrument, column in zip(
            instruments, ("east_mm", "north_m_s", "up_mA"), strict=True
        ):
            covariance = white[new_instrument.observable] ** 2 * np.eye(run.times.size)
            if new_instrument.observable == "force":
                # The accelerometer's white noise in the mean over a sample's own time.
                own = density * (1.25 / G) ** 2 / (run.times[1] - run.times[0])
                covariance += own * np.eye(run.times.size)
            else:
                covariance += walk(
                    run.times, density, 1 + (new_instrument.observable == "displacement")
                )
            clean = record(place, run, new_instrument, truth)
            columns[column] = (clean + normals.of(covariance)) * per.get(
                new_instrument.observable, 1.0
            )
            covariances.append(covariance)
        there = written(folder, run.name, columns, ["%.6g", "%.15g", "%.6f", "%.9f", "%.9f"])
        for new_instrument, covariance, values in zip(
            instruments, covariances, there[2:], strict=True
        ):
            model, free = model_of(place, run, new_instrument), start_errors(run, new_instrument)
            groups.append(
                Rows(model, values / per.get(new_instrument.observable, 1.0), covariance, free)
            )
    names = [instrument.name for instrument in instruments]
    texts = [f"{a}.{s}" for a in names for s in ("K_F", "K_I", "K_II")]
    stated = {
        **{"site.gravity": (0.0, 2e-5), "centrifuge.radius": (0.0, 2e-5)},
        **{"records.clock": (0.0, 5e-6), "centrifuge.stretch": (5e-8, 3e-8)},
        "Qy.K_F": (2.1e-3, 2e-5),
        **{f"{a}.K_OO": (0.0, 2e-7) for a in names},
        **{f"{r.name}.platform.tilt.{e}": (0.0, 2.0 * ARCSEC) for r in runs for e in COMPASS},
    }
    unstated = {f"{a}.{s}": v for a in names for s, v in (OWN | WARM).items()}
    unstated |= {**PLATFORM, **PATH, **LATITUDE, **DELAY}
    held = {f"{a}.K_PP": (1e-6, 5e-7) for a in names}
    texts.append("platform.drift.north")
    fit_result = fit(groups, unknowns_of(texts, stated, unstated, held))
    answers = Answers()
    answers.lines(fit_result, texts)
    answers.rests_on(fit_result)
    answers.output(fit_result, "Qz", 1.25)
    # Whether it fits is asked of a fit that adjusts what is held too.
    loose = fit(groups, unknowns_of(texts, {**stated, **held}, unstated))
    for k, name in enumerate(names):
        answers.correlation(fit_result, name)
        answers.budget(fit_result, f"{name}.K_II")
        answers.misfit(loose, name, [k, k + 3, k + 6])
    return answers


def steepness(place, run, instrument, truth):
    """Slope of a record at each row, by a difference; at the first, forward."""
    step, ahead = 1e-4, np.append(0.0, run.times + 1e-4)
    later = record(place, replace(run, times=ahead), instrument, truth)
    now = record(place, run, instrument, truth)
    behind = np.append(0.0, run.times[1:] - step)
    earlier = record(place, replace(run, times=behind), instrument, truth)
    return np.append(later[1] - now[0], 0.5 * (later[2:] - earlier[1:])) / step


# One accelerometer in many positions at rest and on the arm, read as a current.


def readings(folder):
    place, per_g = Place(G, math.radians(45.75), 0.8), 1.25
    instrument = Instrument("A", "up", "west")
    truth = {
        **{"A.K_F": 2.1e-3, "A.K_I": 1.0008, "A.K_II": 1.6e-5, "A.K_III": 2e-6, "A.delta_O": 3e-4},
        **{"A.K_PP": -7e-7, "A.K_IP": 1.2e-6, "A.K_F.temperature": 2.4e-6, "head.zero": 1.5e-5},
        "A.K_F.hysteresis": -8e-6,
        **{"head.harmonic.1.sin": -3e-6, "head.harmonic.2.cos": 9e-6, "A.K_I_asym": -7e-6},
        **{"head.harmonic.3.sin": 6e-6, "head.harmonic.4.cos": -8e-6, "A.K_0_asym": 4e-6},
        **{"centrifuge.radius.in": 1.2e-4, "centrifuge.stretch": 4e-9, "centrifuge.droop": 1.1e-7},
        **{"centrifuge.radius.A.out": -7e-5, "centrifuge.clock": 1.5e-5},
        "fixture.misalignment.out.forward": 4e-5,
    }
    at_rest, on_arm = [], []
    for k in range(15):
        axes = rotated(instrument.axes(), math.radians(24.0 * k), np.array(AXES["north"]))
        head = {"head": AXES["north"], "u_head": 3.0 * ARCSEC, "head_angle": math.radians(24.0 * k)}
        # Up by half a kelvin each to the eighth, and down again.
        when = {"warmth": 0.5 * min(k, 14 - k) - 1.5, "begins": 120.0 * k}
        when["way"] = 0.5 if k < 8 else -0.5
        at_rest.append(Reading(f"{24 * k} deg", "static", axes, **head, **when, u=2.5e-6))
    for k, rate in enumerate((5.0, 5.0, -9.0, -9.0, 13.0, 13.0, -16.0, 16.0)):
        mounting, ahead = (("in", "inward"), ("out", "outward"))[k % 2]
        axes = Instrument("A", ahead, "up").axes(ON_THE_ARM)
        when = {"warmth": round(0.1 * k - 0.3, 1), "way": -0.5, "begins": 60.0 * (40 + 3 * k)}
        arm = (f"arm {k}", "arm", axes, rate, mounting, RANDOM_RATE)
        on_arm.append(Reading(*arm, **when, u=2e-6))
    normals = Normals(5)
    at_rest = read(place, "A", at_rest, truth, per_g, normals, 7)
    on_arm = read(place, "A", on_arm, truth, per_g, normals, 7)
    lines = [
        f"{one.name},{24 * k},{one.value:.7f},2.5e-6,{23.0 + one.warmth:.1f},{one.begins:g}"
        for k, one in enumerate(at_rest)
    ]
    text = "\n".join(["position,angle_deg,reading_mA,u_mA,degC,time_s", *lines]) + "\n"
    (folder / "tumble.csv").write_text(text, encoding="utf-8")
    fill(folder, [one.value for one in on_arm], ".7f")
    stated = {
        **{"site.gravity": (0.0, 3e-5), "A.K_PP": (0.0, 1e-6), "head.zero": (0.0, 4.0 * ARCSEC)},
        **{"centrifuge.radius": (0.0, 5e-4), "centrifuge.radius.in": (0.0, 2e-4)},
        **{"centrifuge.droop": (1e-7, 2e-8), "head.harmonic.1.sin": (0.0, ARCSEC)},
    }
    sides = [(m, e) for m in ("in", "out") for e in ("outward", "forward", "up")]
    unstated = {f"A.{s}": v for s, v in (OWN | WARM).items()} | AXIS_TILT | LATITUDE
    unstated |= {"centrifuge.stretch": 4.6e-9, "A.K_F.hysteresis": 2e-5}
    waves = [f"{n}.{q}" for n in (1, 2, 3, 4) for q in ("cos", "sin")]
    unstated |= {f"head.harmonic.{wave}": 1e-5 for wave in waves if wave != "1.sin"}
    unstated |= {f"fixture.misalignment.{m}.{e}": 5e-5 for m, e in sides}
    # Of the mounting "in" the radius to the proof mass is stated.
    unstated |= RATE_CLOCK | {"centrifuge.radius.A.out": MOUNTED_RADIUS}
    unstated |= {RATE + one.name: one.u_rate for one in on_arm}
    texts = ["A.K_F", "A.K_I", "A.K_II", "A.K_III", "A.delta_O"]
    held = {"A.K_F.temperature": (2e-6, 1e-6)}
    groups = [readings_of(place, "A", each, per_g) for each in (at_rest, on_arm)]
    fit_result = fit(groups, unknowns_of(texts, stated, unstated, held))
    answers = Answers()
    answers.lines(fit_result, texts)
    answers.correlation(fit_result, "A")
    answers.rests_on(fit_result)
    answers.output(fit_result, "A", per_g)
    for name in ("A.K_F", "A.K_I", "A.K_II"):
        answers.budget(fit_result, name)
    return answers


# One accelerometer by every kind of test: a record of displacement without an angle, readings at
# rest and on the arm, where each mounting's radius is asked for.


def mixed(folder):
    place, arm = Place(G, math.radians(-33.5), 2.5), 2.4
    instrument = Instrument("A", "up", "east", "displacement")
    truth = {
        **{"A.K_F": -8e-4, "A.K_I": 0.9992, "A.K_II": 2.2e-5, "A.K_IP": 4e-6, "A.delta_O": -2e-4},
        **{"A.K_PP": 1.5e-6, "A.K_III": 6e-7},
        **{"centrifuge.radius.in": arm + 3e-4 - 2.5, "centrifuge.radius.out": arm - 5e-4 - 2.5},
    }
    # Nobody recorded the angle: the spindle is not quite where it should be, nor as fast.
    rotation = {"start_angle": 1e-3, "rate": 2e-5, "drift": 3e-7}
    rotation = {f"turntable.spindle.{s}": v for s, v in rotation.items()}
    turn = (-math.pi / 2.0, "north")
    run = Run("turntable", -2.0 * math.pi / 3.0, 0.15 * np.arange(81), turn=turn)
    normals, step, stamps = Normals(21), 5e-4, 5e-5
    values = record(place, run, instrument, truth | rotation) + 0.02 - 1e-3 * run.times
    # What a time stamp moves goes with the slope; no row counts as free of it.
    jitter = (stamps * steepness(place, run, instrument, truth)) ** 2
    jitter = np.maximum(jitter, 0.02 * jitter.mean())
    values += np.sqrt(2e-4**2 + jitter) * normals.many(81)
    values = np.round(values / step) * step
    columns = {"time_ms": 1e3 * run.times, "along_m": values}
    values = written(folder, "turntable", columns, ["%g", "%.4f"])[1]
    covariance = np.diag(2e-4**2 + jitter + step**2 / 12.0)
    model, free = model_of(place, run, instrument), start_errors(run, instrument)
    at_rest, on_arm = [], []
    for angle in range(0, 360, 60):
        axes = rotated(instrument.axes(), math.radians(angle), np.array(AXES["south"]))
        at_rest.append(Reading(f"rest {angle}", "static", axes, u=3e-6))
    for k, rate in enumerate((3.0, -4.0, -7.0, 7.0, 5.0, 2.5)):
        mounting, ahead = (("in", "inward"), ("out", "outward"))[k % 2]
        axes = Instrument("A", ahead, "down").axes(ON_THE_ARM)
        on_arm.append(Reading(f"arm {k}", "arm", axes, rate, mounting, u=4e-6))
    at_rest, on_arm = (read(place, "A", each, truth, 1.0, normals, 8) for each in (at_rest, on_arm))
    fill(folder, [one.value for one in (*at_rest, *on_arm)], ".8f")
    groups = [Rows(model, values, covariance, free)]
    groups += [readings_of(place, "A", each, 1.0) for each in (at_rest, on_arm)]
    radii = [f"centrifuge.radius.{m}" for m in ("in", "out")]
    requested = [*(f"A.{s}" for s in ("K_F", "K_I", "K_II", "K_IP", "delta_O")), *radii]
    stated = {
        **{"A.K_PP": (0.0, 2e-6), "A.K_IP": (0.0, 5e-6), "A.K_III": (0.0, 1e-6)},
        **{"centrifuge.radius": (0.0, 1e-5), **dict.fromkeys(radii, (arm - 2.5, 1e-3))},
    }
    steps = {"start_angle": 1e-4, "rate": 1e-5, "drift": 1e-6}
    spindle = [Unknown(f"turntable.spindle.{s}", 0.0, step=v) for s, v in steps.items()]
    fit_result = fit(groups, [*unknowns_of(requested, stated, {}), *spindle], rounds=5)
    answers = Answers()
    answers.lines(fit_result, requested, more=dict.fromkeys(radii, 2.5))
    answers.correlation(fit_result, "A")
    answers.budget(fit_result, "A.K_F")
    answers.misfit(fit_result, "A", [0])
    return answers


# Records so dense that means over blocks are taken: with rows missing, without, and with cells
# empty; the last block is short.


def dense(folder):
    instruments = [
        Instrument("Qx", "west", "up", "displacement"),
        Instrument("Qy", "south", "up", "force", per_g=1e3),
    ]
    place, step = Place(G, math.radians(10.0), 0.5), 0.006
    truth = {
        **{"Qx.K_F": 2e-3, "Qx.K_I": 1.004, "Qx.K_II": 3e-5},
        **{"Qy.K_F": -1e-3, "Qy.K_I": 0.998, "Qy.K_II": -4e-5},
    }
    there = np.delete(np.arange(425), [150, 151, 152, 153, 154, 300])
    runs = [
        Run("gaps", -2.5 * math.pi, step * there, start_angle=0.8),
        Run("even", 1.6 * math.pi, step * np.arange(632), start_angle=-1.7),
        Run("empty", 1.6 * math.pi, step * np.arange(630), start_angle=2.4),
    ]
    normals, groups = Normals(3), []
    for run in runs:
        eye = np.eye(run.times.size)
        covariances = [
            1e-8 * eye + walk(run.times, (1e-4 * G) ** 2, 2),
            (0.2**2 + 0.1**2 / step) * eye,
        ]
        signals = [
            record(place, run, each, truth) + normals.of(covariance)
            for each, covariance in zip(instruments, covariances, strict=True)
        ]
        if run.name == "empty":
            signals[0][[10, 77, 78, 79]] = np.nan
        # The encoder counts clockwise from north: 90 deg less the angle from east.
        columns = {
            "time_s": run.times,
            "angle_deg": 90.0 - np.degrees(run.angle(run.times)[0]),
            "west_m": signals[0],
            "south_mg": signals[1],
        }
        signals = written(folder, run.name, columns, ["%.3f", "%.9f", "%.6f", "%.3f"])[2:]
        means = block_means(run, step, np.isfinite(signals))
        for each, values, covariance, mean in zip(
            instruments, signals, covariances, means, strict=True
        ):
            groups.append(
                Rows(
                    lambda x, run=run, each=each, mean=mean: mean @ record(place, run, each, x),
                    mean @ np.nan_to_num(values),
                    mean @ covariance @ mean.T,
                    mean @ start_errors(run, each),
                )
            )
    texts = [f"{a}.{s}" for a in ("Qx", "Qy") for s in ("K_F", "K_I", "K_II")]
    fit_result = fit(groups, unknowns_of(texts, {}, {}))
    answers = Answers()
    answers.lines(fit_result, texts)
    for k, name in enumerate(("Qx", "Qy")):
        answers.correlation(fit_result, name)
        answers.misfit(fit_result, name, [k, k + 2, k + 4])
    return answers


def block_means(run, step, numbers):
    """Matrix of each signal, (blocks, rows), that takes its rows to means over blocks.

    A block is as many rows as fit into 1/64 revolution; of one that has lost rows, the others. Its
    mean is of the rows where all signals are numbers; a signal that lacks more than half of them
    goes without the block, and the others lose nothing.
    numbers: Whether each value is one, (signals, rows).
    """
    size = int(2.0 * math.pi / 64.0 / abs(run.rate) / step)
    block = np.round(run.times / step).astype(int) // size
    inside = np.array([block == k for k in np.unique(block)])
    for k, rows in enumerate(inside):
        lacks = 2 * numbers[:, rows].sum(axis=1) < rows.sum()
        inside[k] = rows & numbers[~lacks].all(axis=0)
    mean = inside / inside.sum(axis=1)[:, None]
    return [mean[~(inside & ~own).any(axis=1)] for own in numbers]


# Readings whose u nobody states: two repeats at each setting.


def found_readings(folder):
    place, per_g = Place(G, math.radians(45.0), 0.0), 0.5
    instrument = Instrument("A", "up", "north")
    truth, normals = {"A.K_F": 1e-3, "A.K_I": 1.0004, "A.delta_O": -5e-4}, Normals(8)
    lines, every = [], []
    for k in range(8):
        axes = rotated(instrument.axes(), math.radians(45.0 * k), np.array(AXES["west"]))
        reading = Reading(f"p{k}", "static", axes, u=4e-6)
        pair = read(place, "A", [reading, reading], truth, per_g, normals, 7)
        lines.append(f"p{k},{45 * k},{pair[0].value:.7f},{pair[1].value:.7f}")
        every += pair
    text = "\n".join(["position,angle_deg,first_V,second_V", *lines]) + "\n"
    (folder / "readings.csv").write_text(text, encoding="utf-8")
    texts = ["A.K_F", "A.K_I", "A.delta_O"]
    # One noise for all: the squares that a fit leaves over the rows less the unknowns.
    left, dof = fit([readings_of(place, "A", every, per_g)], unknowns_of(texts, {}, {})).misfit([0])
    every = [replace(one, u=4e-6 * math.sqrt(left / dof)) for one in every]
    fit_result = fit([readings_of(place, "A", every, per_g)], unknowns_of(texts, {}, {}))
    answers = Answers()
    answers.lines(fit_result, texts)
    for name in texts:
        answers.dof(name, dof, 1e-6)
    return answers


# Records whose noise nobody states: white noise alone, and white noise with a walk that shows.


def found_noise(folder):
    instruments = [
        Instrument("Qx", "east", "down", "displacement"),
        Instrument("Qy", "north", "down", "velocity"),
    ]
    place = Place(G, math.radians(45.0), 2.5)
    truth = {
        **{"Qx.K_F": 1e-3, "Qx.K_I": 1.00005, "Qx.K_II": 4e-5},
        **{"Qy.K_F": 2e-3, "Qy.K_I": 0.9997, "Qy.K_II": 1e-5},
    }
    runs = [Run("slow", 1.5, 0.25 * np.arange(65)), Run("fast", 3.5, 0.1 * np.arange(65), 2.0)]
    density, normals, signals = (3e-4 * G) ** 2, Normals(77), {"Qx": [], "Qy": []}
    for run in runs:
        t, white = run.times, 1e-6 * np.eye(65)
        noise = normals.of(white), normals.of(white + walk(t, density, 1))
        columns = {"time_s": t, "angle_rad": run.angle(t)[0]}
        for instrument, own, name in zip(instruments, noise, ("east_m", "north_m_s"), strict=True):
            columns[name] = record(place, run, instrument, truth) + own
        there = written(folder, run.name, columns, ["%.6g", "%.15g", "%.6f", "%.6f"])
        for instrument, values in zip(instruments, there[2:], strict=True):
            model, free = model_of(place, run, instrument), start_errors(run, instrument)
            signals[instrument.name].append(Rows(model, values, white, free))
    answers = Answers()
    for instrument, integrations in zip(instruments, (2, 1), strict=True):
        stated = {"Qx.K_I": (1.0, 1e-4)} if instrument.name == "Qx" else {}
        unknowns = unknowns_of(
            [f"{instrument.name}.{s}" for s in ("K_F", "K_I", "K_II")], stated, {}
        )
        with_found_noise(answers, signals[instrument.name], runs, integrations, unknowns, density)
    return answers


def with_found_noise(answers, groups, runs, integrations, unknowns, about):
    """Add the answers of an accelerometer with estimated noise near this walk."""
    times = [run.times for run in runs]
    likelihood = Likelihood(groups, times, integrations, unknowns)
    alone = likelihood.best_white(0.0, 1e-6)
    both = likelihood.best(1e-6, about)
    shows = 2.0 * (likelihood.value(*both) - likelihood.value(alone)) > 2.706
    levels = both if shows else np.array([alone])

    def solved(white, n2=0.0):
        rows = [
            replace(g, covariance=white * np.eye(t.size) + n2 * walk(t, 1.0, integrations))
            for g, t in zip(groups, times, strict=True)
        ]
        return fit(rows, unknowns)

    # Satterthwaite: u^2 is as sure as the levels that it goes with.
    fit_result, step = solved(*levels), 1e-2
    variance = np.diag(fit_result.covariance)
    slopes = []
    for k in range(levels.size):
        up, down = (
            np.diag(solved(*(levels * np.exp(s * step * np.eye(levels.size)[k]))).covariance)
            for s in (1, -1)
        )
        slopes.append((up - down) / (2.0 * step))
    slopes, spread = np.array(slopes).T, likelihood.spread(levels)
    dof = 2.0 * variance**2 / np.einsum("pi,ij,pj->p", slopes, spread, slopes)
    if not shows:
        tiny = 1e-9 * alone
        by_walk = (np.diag(solved(alone, tiny).covariance) - variance) / tiny
        level, longer = hidden(likelihood, alone, variance, by_walk)
        fit_result.of_noise[:] += np.diag(level * by_walk)
        share = variance / (variance + level * by_walk)
        dof = 1.0 / (share**2 / dof + 1.0 / longer)
    answers.lines(fit_result, fit_result.names, CLOSE_OF_FOUND)
    for name, value in zip(fit_result.names, dof, strict=True):
        answers.dof(name, value, 2.0 * CLOSE_OF_FOUND)
    owner = fit_result.names[0].partition(".")[0]
    observable = "displacement" if integrations == 2 else "velocity"
    for name, level in zip((observable, "acceleration"), np.sqrt(levels), strict=False):
        answers.add(f"{name} noise of {owner}", [level], [CLOSE_OF_FOUND * level])


CAMPAIGNS = (observables, readings, mixed, dense, found_readings, found_noise)


def main():
    path = DATA / "fits.json"
    document = json.loads(path.read_text(encoding="utf-8"))
    for make in [m for m in CAMPAIGNS if m.__name__ in sys.argv[1:] or not sys.argv[1:]]:
        answers = make(DATA / "fits" / make.__name__)
        document[make.__name__] = {"expected": answers.expected, "limits": answers.limits}
    text = json.dumps(document, indent=0)
    text = re.sub(r"\n(?=[-\d\]])", "", text).replace(",-", ", -")
    path.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()

"""Make the records of the campaigns in validation/data/fits, and their reference fits, fits.json.

Run from this folder: ``python make_fits.py``, optionally with names of campaigns (minutes; needs
NumPy, and mpmath, which comes with sympy). Nothing here uses counterspin. Each campaign is
described twice: in a hand-written ``campaign.toml``, and here for `dense_fit`.

Records and readings are simulated with the model of `dense_fit`, with errors of every kind and
noise of a linear congruential generator. The rounded values in the files are then fitted. Typical
sizes are those of docs/physics.md.
"""

import json
import math
import pathlib
import re
import sys
from dataclasses import replace

import numpy as np
from dense_fit import (
    ARM_AXES,
    AXES,
    Instrument,
    Reading,
    Rows,
    Run,
    Site,
    Unknown,
    fit,
    rotate,
    simulate_reading,
    simulate_record,
    walk_covariance,
)
from mpmath import gammainc
from restricted import Likelihood, estimate_hidden_walk

DATA = pathlib.Path(__file__).parents[2] / "src" / "counterspin" / "validation" / "data"
ARCSEC = math.pi / 648000.0
DEGREE_PER_HOUR = math.pi / 180.0 / 3600.0
GRAVITY = 9.8066  #: m/s^2
COMPASS = ("east", "north", "up")

#: Typical sizes: accelerometer of navigation grade, then platform, path and inputs.
ACCELEROMETER_SIZES = {
    **{"K_F": 1e-4, "K_I": 1e-4, "K_II": 1e-5, "K_III": 1e-6, "K_4": 1e-9, "K_OQ": 1e-6},
    **{"K_5": 1e-8, "K_0_asym": 5e-6, "K_I_asym": 1e-5},
    **dict.fromkeys(("K_IP", "K_IO", "K_PO", "K_PP", "K_OO"), 2e-6),
    **dict.fromkeys(("delta_O", "delta_P"), 5e-5),
    **{"K_F.temperature": 5e-6, "K_I.temperature": 1e-4, "K_II.temperature": 1e-8},
    **{"K_F.trend": 1.7e-9, "K_F.heating": 1e-7},
}
#: Additional terms of campaigns with temperatures.
TEMPERATURE_SIZES = {
    **{"K_F.temperature.2": 5e-8, "K_F.temperature.3": 5e-10},
    **{"K_I.temperature.2": 1e-6, "K_I.temperature.3": 1e-8},
}
PLATFORM_SIZES = {
    **{f"platform.drift.{e}": 0.01 * DEGREE_PER_HOUR for e in COMPASS},
    **{f"platform.g_sensitivity.{i}{j}": 0.01 * DEGREE_PER_HOUR for i in "xyz" for j in "xyz"},
    **{f"platform.g2_sensitivity.{e}": 1e-4 * DEGREE_PER_HOUR for e in COMPASS},
    **{f"platform.compliance.{i}{j}": 0.1 * ARCSEC for i in "xyz" for j in "xyz"},
}
AXIS_TILT_SIZES = {f"centrifuge.axis_tilt.{e}": 10.0 * ARCSEC for e in ("east", "north")}
PATH_SIZES = {
    "centrifuge.stretch": 4.6e-9,
    **{f"centrifuge.imbalance.{n}.{q}": 1e-6 for n in (1, 2) for q in ("cos", "sin")},
    **AXIS_TILT_SIZES,
    **{f"encoder.harmonic.{n}.{q}": ARCSEC for n in (1, 2, 3, 4) for q in ("cos", "sin")},
}
LATITUDE_SIZE, DELAY_SIZE = {"site.latitude": 5e-6}, {"records.timing_offset": 1e-5}
RATE_CLOCK_SIZE = {"centrifuge.clock": 2e-5}
MOUNTED_RADIUS_SIZE, RANDOM_RATE_U = 1e-3, 1e-7

#: Prefix of the name of the random error of the rate of a reading.
RATE_PREFIX = "rate of "

#: Tolerance relative to u; counterspin evaluates the derivatives by inputs only once.
TOLERANCE = 3e-4
#: Tolerance with estimated noise: its search ends at 0.3 % of a level, and levels of an undetected
#: walk are summed in steps of a factor e.
ESTIMATED_NOISE_TOLERANCE = 5e-3


class NormalGenerator:
    """Standard normal generator (Box-Muller), with a generator of Numerical Recipes."""

    def __init__(self, seed):
        self.state = seed

    def draw(self):
        uniforms = []
        for _ in range(2):
            self.state = (1664525 * self.state + 1013904223) % 2**32
            uniforms.append((self.state + 0.5) / 2**32)
        return math.sqrt(-2.0 * math.log(uniforms[0])) * math.cos(2.0 * math.pi * uniforms[1])

    def draw_array(self, n):
        return np.array([self.draw() for _ in range(n)])

    def draw_correlated(self, covariance):
        """Draw noise with a covariance; entries without variance have no noise."""
        has_noise = np.diag(covariance) > 0.0
        noise = np.zeros(len(covariance))
        root = np.linalg.cholesky(covariance[np.ix_(has_noise, has_noise)])
        noise[has_noise] = root @ self.draw_array(int(has_noise.sum()))
        return noise


class ReferenceNumbers:
    """Expected numbers of a case by name, with their tolerances (limits)."""

    def __init__(self):
        self.expected, self.limits = {}, {}

    def add(self, name, values, tolerances):
        self.expected[name] = [float(f"{v:.12g}") for v in np.ravel(values)]
        self.limits[name] = [float(f"{v:.3g}") for v in np.ravel(tolerances)]

    def add_coefficients(self, fit_result, names, tolerance=TOLERANCE, offsets=None):
        """Add value, u and its components; `offsets`: name -> offset of the value in the result."""
        for name in names:
            numbers = np.array(fit_result.summary(name))
            numbers[0] += (offsets or {}).get(name, 0.0)
            self.add(name, numbers, np.full(5, tolerance * numbers[1]))

    def add_correlations(self, fit_result, owner):
        """Add the correlations of the parameters of interest, by row."""
        names = sorted(n for n in requested_names(fit_result) if n.startswith(owner + "."))
        matrix = fit_result.correlation(names)
        self.add(f"correlation of {owner}", matrix, np.full(matrix.shape, 2.0 * TOLERANCE))

    def add_contributions(self, fit_result, name):
        """Add the contribution of each source to u, if it exceeds a hundredth of u.

        The random errors of all rates are a single source.
        """
        k, u = fit_result.names.index(name), fit_result.summary(name)[1]
        contributions = {}
        for prior, effects in fit_result.prior_effects.items():
            source = "centrifuge.rate" if prior.startswith(RATE_PREFIX) else prior
            contributions[source] = math.hypot(contributions.get(source, 0.0), effects[k])
        for source, contribution in contributions.items():
            if contribution > 1e-2 * u:
                self.add(f"contribution of {source} to {name}", [contribution], [TOLERANCE * u])

    def add_posteriors(self, fit_result):
        """Add posterior value and u of nuisance parameters that the data inform."""
        for unknown in fit_result.unknowns:
            value, u, *_ = fit_result.summary(unknown.name)
            is_random_rate = unknown.name.startswith(RATE_PREFIX)
            if unknown.kind != "requested" and not is_random_rate and u < 0.9 * unknown.sd:
                self.add(
                    f"posterior of {unknown.name}", [value - unknown.mean, u], [TOLERANCE * u] * 2
                )

    def add_chi_square_test(self, fit_result, owner, groups):
        """Add chi-square, degrees of freedom, and the probability of a worse fit."""
        chi2, dof = fit_result.misfit(groups)
        p = float(gammainc(dof / 2.0, chi2 / 2.0, regularized=True))
        self.add(f"chi-square test of {owner}", [chi2, dof, p], [1e-3 * chi2, 1e-5 * dof, 2e-3])

    def add_dof(self, name, value, tolerance):
        self.add(f"degrees of freedom of {name}", [value], [tolerance * value])

    def add_output_units(self, fit_result, name, per_g):
        """Add bias and scale factor in the unit of the readings."""
        for key, symbol in (("bias", "K_F"), ("scale_factor", "K_I")):
            value, u, *_ = fit_result.summary(f"{name}.{symbol}")
            numbers = np.array([value, u]) * per_g
            self.add(f"{key} of {name}", numbers, [TOLERANCE * numbers[1]] * 2)


def requested_names(fit_result):
    return [
        u.name for u in fit_result.unknowns if u.kind == "requested" and "spindle" not in u.name
    ]


def make_unknowns(requested, stated, default_sizes, considered=None):
    """Return all unknowns.

    requested: Names, which may also be stated.
    stated, considered: Name -> value and u.
    default_sizes: Name -> u.
    """
    considered = considered or {}

    def nominal(name):
        return 1.0 if name.endswith(".K_I") else 0.0

    free = [Unknown(n, nominal(n), step=1e-4) for n in requested if n not in stated]
    requested_with_prior = [Unknown(n, *stated[n], "requested") for n in requested if n in stated]
    nuisances = [Unknown(n, *prior, "stated") for n, prior in stated.items() if n not in requested]
    specified = {*requested, *stated, *considered}
    defaults = [
        Unknown(n, nominal(n), u, "default") for n, u in default_sizes.items() if n not in specified
    ]
    return [
        *free,
        *requested_with_prior,
        *nuisances,
        *defaults,
        *(Unknown(n, *p, "considered") for n, p in considered.items()),
    ]


def write_record(folder, name, columns, formats):
    """Write a record by column name and return the rounded values, shape (columns, n).

    NaN becomes an empty cell.
    """
    path = folder / f"{name}.csv"
    rows = zip(*columns.values(), strict=True)
    lines = [
        ",".join("" if np.isnan(v) else f % v for f, v in zip(formats, row, strict=True))
        for row in rows
    ]
    path.write_text("\n".join([",".join(columns), *lines]) + "\n", encoding="utf-8")
    return np.genfromtxt(path, delimiter=",", skip_header=1).T


def start_error_columns(run, instrument):
    """Return the columns of start offset and start velocity that the observable has."""
    order = {"displacement": 2, "velocity": 1, "force": 0}[instrument.observable]
    return np.vander(run.times, order, increasing=True)


def make_model(site, run, instrument):
    return lambda x: simulate_record(site, run, instrument, x)


def make_reading_rows(site, name, readings, per_g):
    """Return the rows of readings in their unit; the covariance includes the dividing head."""

    def values(x):
        return per_g * np.array([simulate_reading(site, reading, name, x) for reading in readings])

    def covariance(x):
        step, variances = 1e-5, []
        for reading in readings:
            displaced = [
                simulate_reading(site, reading, name, {**x, f"head of {reading.name}": s * step})
                for s in (1, -1)
            ]
            head_effect = per_g * (displaced[0] - displaced[1]) / (2.0 * step) * reading.u_head
            variances.append(reading.u**2 + head_effect**2)
        return np.diag(variances)

    reading_values = np.array([reading.value for reading in readings])
    return Rows(values, reading_values, covariance, np.zeros((reading_values.size, 0)))


def draw_readings(site, name, readings, truth, per_g, generator, digits):
    """Return the readings with rounded values: those of the true instrument plus noise."""
    drawn = []
    for reading in readings:
        errors = (
            {f"head of {reading.name}": reading.u_head * generator.draw()} if reading.u_head else {}
        )
        if reading.u_rate:
            errors[RATE_PREFIX + reading.name] = reading.u_rate * generator.draw()
        value = (
            per_g * simulate_reading(site, reading, name, {**truth, **errors})
            + reading.u * generator.draw()
        )
        drawn.append(replace(reading, value=round(value, digits)))
    return drawn


def fill_readings(folder, values, format_):
    """Write values into the readings of a description, in order."""
    path, remaining = folder / "campaign.toml", iter(values)
    text = path.read_text(encoding="utf-8")
    text = re.sub(r'reading = "[-.\d]+', lambda _: f'reading = "{next(remaining):{format_}}', text)
    path.write_text(text, encoding="utf-8")


# Three accelerometers with one observable each, and three runs, one with a turned platform. No term
# is fixed at nominal.


def observables(folder):
    instruments = [
        Instrument("Qx", "east", "down", "displacement"),
        Instrument("Qy", "north", "down", "velocity"),
        Instrument("Qz", "up", "east", "force", per_g=1.25),
    ]
    site = Site(GRAVITY, math.radians(45.75), 2.5)
    truth = {
        **{"Qx.K_F": 5e-3, "Qx.K_I": 1.002, "Qx.K_II": 2.7e-5, "Qx.K_OO": 1e-7, "Qx.K_PP": 8e-7},
        **{"Qy.K_F": 2.11e-3, "Qy.K_I": 0.9985, "Qy.K_II": -1.2e-5, "Qy.K_IO": 1.5e-6},
        **{"Qz.K_F": -1e-3, "Qz.K_I": 1.0011, "Qz.K_II": 1.8e-5, "Qz.K_PP": 9e-7},
        **{"platform.drift.north": 3e-8, "platform.compliance.zy": 3e-7},
        **{"slow.platform.tilt.north": 4e-6, "turned.platform.tilt.east": -7e-6},
        **{"centrifuge.radius": -8e-6, "encoder.harmonic.1.sin": 3e-6, "records.clock": 4e-6},
        "centrifuge.stretch": 6e-8,
    }
    platform_turn, run_conditions = (
        (math.radians(50.0), "east"),
        {"start_time": 12.0, "temperature_change": 0.1},
    )
    runs = [
        Run("slow", 2.0, 0.2 * np.arange(61), 0.3, drift=2e-5, temperature_change=-0.5),
        Run(
            "fast",
            -math.radians(240.0),
            0.1 * np.arange(61),
            1.1,
            ripple=(2e-4, 0.7),
            **run_conditions,
        ),
        Run(
            "turned",
            math.pi,
            0.125 * np.arange(57),
            -0.4,
            turn=platform_turn,
            start_time=18.0,
            temperature_change=0.3,
        ),
    ]
    # White noise by observable, and factors to the units of the files.
    white = {"displacement": 1e-4, "velocity": 1e-4, "force": 2e-5 * 1.25}
    factors, density = {"displacement": 1e3}, (2e-6 * GRAVITY) ** 2
    generator, groups = NormalGenerator(11), []
    for run in runs:
        covariances, columns = [], {"time_s": run.times, "angle_rad": run.angle(run.times)[0]}
        for instrument, column in zip(instruments, ("east_mm", "north_m_s", "up_mA"), strict=True):
            covariance = white[instrument.observable] ** 2 * np.eye(run.times.size)
            if instrument.observable == "force":
                # White noise of the accelerometer, averaged over a sampling interval.
                noise_variance = density * (1.25 / GRAVITY) ** 2 / (run.times[1] - run.times[0])
                covariance += noise_variance * np.eye(run.times.size)
            else:
                covariance += walk_covariance(
                    run.times, density, 1 + (instrument.observable == "displacement")
                )
            clean = simulate_record(site, run, instrument, truth)
            columns[column] = (clean + generator.draw_correlated(covariance)) * factors.get(
                instrument.observable, 1.0
            )
            covariances.append(covariance)
        written = write_record(folder, run.name, columns, ["%.6g", "%.15g", "%.6f", "%.9f", "%.9f"])
        for instrument, covariance, values in zip(
            instruments, covariances, written[2:], strict=True
        ):
            model, free = make_model(site, run, instrument), start_error_columns(run, instrument)
            groups.append(
                Rows(model, values / factors.get(instrument.observable, 1.0), covariance, free)
            )
    names = [instrument.name for instrument in instruments]
    requested = [f"{a}.{s}" for a in names for s in ("K_F", "K_I", "K_II")]
    stated = {
        **{"site.gravity": (0.0, 2e-5), "centrifuge.radius": (0.0, 2e-5)},
        **{"records.clock": (0.0, 5e-6), "centrifuge.stretch": (5e-8, 3e-8)},
        "Qy.K_F": (2.1e-3, 2e-5),
        **{f"{a}.K_OO": (0.0, 2e-7) for a in names},
        **{f"{r.name}.platform.tilt.{e}": (0.0, 2.0 * ARCSEC) for r in runs for e in COMPASS},
    }
    default_sizes = {
        f"{a}.{s}": v for a in names for s, v in (ACCELEROMETER_SIZES | TEMPERATURE_SIZES).items()
    }
    default_sizes |= {**PLATFORM_SIZES, **PATH_SIZES, **LATITUDE_SIZE, **DELAY_SIZE}
    considered = {f"{a}.K_PP": (1e-6, 5e-7) for a in names}
    requested.append("platform.drift.north")
    fit_result = fit(groups, make_unknowns(requested, stated, default_sizes, considered))
    reference = ReferenceNumbers()
    reference.add_coefficients(fit_result, requested)
    reference.add_posteriors(fit_result)
    reference.add_output_units(fit_result, "Qz", 1.25)
    # The chi-square test uses a fit that also estimates the considered parameters.
    fit_with_considered = fit(
        groups, make_unknowns(requested, {**stated, **considered}, default_sizes)
    )
    for k, name in enumerate(names):
        reference.add_correlations(fit_result, name)
        reference.add_contributions(fit_result, f"{name}.K_II")
        reference.add_chi_square_test(fit_with_considered, name, [k, k + 3, k + 6])
    return reference


def record_slopes(site, run, instrument, truth):
    """Return the slope of a record at each row: central differences, forward at the first row."""
    step, later_times = 1e-4, np.append(0.0, run.times + 1e-4)
    later = simulate_record(site, replace(run, times=later_times), instrument, truth)
    records = simulate_record(site, run, instrument, truth)
    earlier_times = np.append(0.0, run.times[1:] - step)
    earlier = simulate_record(site, replace(run, times=earlier_times), instrument, truth)
    return np.append(later[1] - records[0], 0.5 * (later[2:] - earlier[1:])) / step


# One accelerometer with current output, in many positions at rest and on the arm.


def readings(folder):
    site, per_g = Site(GRAVITY, math.radians(45.75), 0.8), 1.25
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
        axes = rotate(instrument.axes(), math.radians(24.0 * k), np.array(AXES["north"]))
        head_arguments = {
            "head": AXES["north"],
            "u_head": 3.0 * ARCSEC,
            "head_angle": math.radians(24.0 * k),
        }
        # Warmer by half a kelvin per reading up to the eighth, then cooler again.
        run_conditions = {"temperature_change": 0.5 * min(k, 14 - k) - 1.5, "start_time": 120.0 * k}
        run_conditions["temperature_direction"] = 0.5 if k < 8 else -0.5
        at_rest.append(
            Reading(f"{24 * k} deg", "static", axes, **head_arguments, **run_conditions, u=2.5e-6)
        )
    for k, rate in enumerate((5.0, 5.0, -9.0, -9.0, 13.0, 13.0, -16.0, 16.0)):
        mounting, direction = (("in", "inward"), ("out", "outward"))[k % 2]
        axes = Instrument("A", direction, "up").axes(ARM_AXES)
        run_conditions = {
            "temperature_change": round(0.1 * k - 0.3, 1),
            "temperature_direction": -0.5,
            "start_time": 60.0 * (40 + 3 * k),
        }
        arguments = (f"arm {k}", "arm", axes, rate, mounting, RANDOM_RATE_U)
        on_arm.append(Reading(*arguments, **run_conditions, u=2e-6))
    generator = NormalGenerator(5)
    at_rest = draw_readings(site, "A", at_rest, truth, per_g, generator, 7)
    on_arm = draw_readings(site, "A", on_arm, truth, per_g, generator, 7)
    lines = [
        f"{reading.name},{24 * k},{reading.value:.7f},2.5e-6,"
        f"{23.0 + reading.temperature_change:.1f},{reading.start_time:g}"
        for k, reading in enumerate(at_rest)
    ]
    text = "\n".join(["position,angle_deg,reading_mA,u_mA,degC,time_s", *lines]) + "\n"
    (folder / "tumble.csv").write_text(text, encoding="utf-8")
    fill_readings(folder, [reading.value for reading in on_arm], ".7f")
    stated = {
        **{"site.gravity": (0.0, 3e-5), "A.K_PP": (0.0, 1e-6), "head.zero": (0.0, 4.0 * ARCSEC)},
        **{"centrifuge.radius": (0.0, 5e-4), "centrifuge.radius.in": (0.0, 2e-4)},
        **{"centrifuge.droop": (1e-7, 2e-8), "head.harmonic.1.sin": (0.0, ARCSEC)},
    }
    misalignments = [(m, e) for m in ("in", "out") for e in ("outward", "forward", "up")]
    default_sizes = (
        {f"A.{s}": v for s, v in (ACCELEROMETER_SIZES | TEMPERATURE_SIZES).items()}
        | AXIS_TILT_SIZES
        | LATITUDE_SIZE
    )
    default_sizes |= {"centrifuge.stretch": 4.6e-9, "A.K_F.hysteresis": 2e-5}
    waves = [f"{n}.{q}" for n in (1, 2, 3, 4) for q in ("cos", "sin")]
    default_sizes |= {f"head.harmonic.{wave}": 1e-5 for wave in waves if wave != "1.sin"}
    default_sizes |= {f"fixture.misalignment.{m}.{e}": 5e-5 for m, e in misalignments}
    # The radius to the proof mass is stated for the mounting "in".
    default_sizes |= RATE_CLOCK_SIZE | {"centrifuge.radius.A.out": MOUNTED_RADIUS_SIZE}
    default_sizes |= {RATE_PREFIX + reading.name: reading.u_rate for reading in on_arm}
    requested = ["A.K_F", "A.K_I", "A.K_II", "A.K_III", "A.delta_O"]
    considered = {"A.K_F.temperature": (2e-6, 1e-6)}
    groups = [make_reading_rows(site, "A", group, per_g) for group in (at_rest, on_arm)]
    fit_result = fit(groups, make_unknowns(requested, stated, default_sizes, considered))
    reference = ReferenceNumbers()
    reference.add_coefficients(fit_result, requested)
    reference.add_correlations(fit_result, "A")
    reference.add_posteriors(fit_result)
    reference.add_output_units(fit_result, "A", per_g)
    for name in ("A.K_F", "A.K_I", "A.K_II"):
        reference.add_contributions(fit_result, name)
    return reference


# One accelerometer with every type of test: a displacement record without angle, and readings at
# rest and on the arm, where the radius of each mounting is requested.


def mixed(folder):
    site, arm_radius = Site(GRAVITY, math.radians(-33.5), 2.5), 2.4
    instrument = Instrument("A", "up", "east", "displacement")
    truth = {
        **{"A.K_F": -8e-4, "A.K_I": 0.9992, "A.K_II": 2.2e-5, "A.K_IP": 4e-6, "A.delta_O": -2e-4},
        **{"A.K_PP": 1.5e-6, "A.K_III": 6e-7},
        **{
            "centrifuge.radius.in": arm_radius + 3e-4 - 2.5,
            "centrifuge.radius.out": arm_radius - 5e-4 - 2.5,
        },
    }
    # Without a recorded angle, the start angle and rate of the spindle have errors.
    rotation = {"start_angle": 1e-3, "rate": 2e-5, "drift": 3e-7}
    rotation = {f"turntable.spindle.{s}": v for s, v in rotation.items()}
    turn = (-math.pi / 2.0, "north")
    run = Run("turntable", -2.0 * math.pi / 3.0, 0.15 * np.arange(81), turn=turn)
    generator, step, time_stamp_sd = NormalGenerator(21), 5e-4, 5e-5
    values = simulate_record(site, run, instrument, truth | rotation) + 0.02 - 1e-3 * run.times
    # The effect of time-stamp jitter is proportional to the slope, with a lower limit.
    jitter_variance = (time_stamp_sd * record_slopes(site, run, instrument, truth)) ** 2
    jitter_variance = np.maximum(jitter_variance, 0.02 * jitter_variance.mean())
    values += np.sqrt(2e-4**2 + jitter_variance) * generator.draw_array(81)
    values = np.round(values / step) * step
    columns = {"time_ms": 1e3 * run.times, "along_m": values}
    values = write_record(folder, "turntable", columns, ["%g", "%.4f"])[1]
    covariance = np.diag(2e-4**2 + jitter_variance + step**2 / 12.0)
    model, free = make_model(site, run, instrument), start_error_columns(run, instrument)
    at_rest, on_arm = [], []
    for angle in range(0, 360, 60):
        axes = rotate(instrument.axes(), math.radians(angle), np.array(AXES["south"]))
        at_rest.append(Reading(f"rest {angle}", "static", axes, u=3e-6))
    for k, rate in enumerate((3.0, -4.0, -7.0, 7.0, 5.0, 2.5)):
        mounting, direction = (("in", "inward"), ("out", "outward"))[k % 2]
        axes = Instrument("A", direction, "down").axes(ARM_AXES)
        on_arm.append(Reading(f"arm {k}", "arm", axes, rate, mounting, u=4e-6))
    at_rest, on_arm = (
        draw_readings(site, "A", group, truth, 1.0, generator, 8) for group in (at_rest, on_arm)
    )
    fill_readings(folder, [reading.value for reading in (*at_rest, *on_arm)], ".8f")
    groups = [Rows(model, values, covariance, free)]
    groups += [make_reading_rows(site, "A", group, 1.0) for group in (at_rest, on_arm)]
    radii = [f"centrifuge.radius.{m}" for m in ("in", "out")]
    requested = [*(f"A.{s}" for s in ("K_F", "K_I", "K_II", "K_IP", "delta_O")), *radii]
    stated = {
        **{"A.K_PP": (0.0, 2e-6), "A.K_IP": (0.0, 5e-6), "A.K_III": (0.0, 1e-6)},
        **{"centrifuge.radius": (0.0, 1e-5), **dict.fromkeys(radii, (arm_radius - 2.5, 1e-3))},
    }
    steps = {"start_angle": 1e-4, "rate": 1e-5, "drift": 1e-6}
    spindle = [Unknown(f"turntable.spindle.{s}", 0.0, step=v) for s, v in steps.items()]
    fit_result = fit(groups, [*make_unknowns(requested, stated, {}), *spindle], n_iterations=5)
    reference = ReferenceNumbers()
    reference.add_coefficients(fit_result, requested, offsets=dict.fromkeys(radii, 2.5))
    reference.add_correlations(fit_result, "A")
    reference.add_contributions(fit_result, "A.K_F")
    reference.add_chi_square_test(fit_result, "A", [0])
    return reference


# Records so dense that they are averaged over blocks: with missing rows, complete, and with empty
# cells; the last block is short.


def dense(folder):
    instruments = [
        Instrument("Qx", "west", "up", "displacement"),
        Instrument("Qy", "south", "up", "force", per_g=1e3),
    ]
    site, step = Site(GRAVITY, math.radians(10.0), 0.5), 0.006
    truth = {
        **{"Qx.K_F": 2e-3, "Qx.K_I": 1.004, "Qx.K_II": 3e-5},
        **{"Qy.K_F": -1e-3, "Qy.K_I": 0.998, "Qy.K_II": -4e-5},
    }
    row_numbers = np.delete(np.arange(425), [150, 151, 152, 153, 154, 300])
    runs = [
        Run("gaps", -2.5 * math.pi, step * row_numbers, start_angle=0.8),
        Run("even", 1.6 * math.pi, step * np.arange(632), start_angle=-1.7),
        Run("empty", 1.6 * math.pi, step * np.arange(630), start_angle=2.4),
    ]
    generator, groups = NormalGenerator(3), []
    for run in runs:
        eye = np.eye(run.times.size)
        covariances = [
            1e-8 * eye + walk_covariance(run.times, (1e-4 * GRAVITY) ** 2, 2),
            (0.2**2 + 0.1**2 / step) * eye,
        ]
        signals = [
            simulate_record(site, run, instrument, truth) + generator.draw_correlated(covariance)
            for instrument, covariance in zip(instruments, covariances, strict=True)
        ]
        if run.name == "empty":
            signals[0][[10, 77, 78, 79]] = np.nan
        # The encoder counts clockwise from north: 90 deg minus the angle from east.
        columns = {
            "time_s": run.times,
            "angle_deg": 90.0 - np.degrees(run.angle(run.times)[0]),
            "west_m": signals[0],
            "south_mg": signals[1],
        }
        signals = write_record(folder, run.name, columns, ["%.3f", "%.9f", "%.6f", "%.3f"])[2:]
        means = block_means(run, step, np.isfinite(signals))
        for instrument, values, covariance, mean in zip(
            instruments, signals, covariances, means, strict=True
        ):
            groups.append(
                Rows(
                    lambda x, run=run, instrument=instrument, mean=mean: (
                        mean @ simulate_record(site, run, instrument, x)
                    ),
                    mean @ np.nan_to_num(values),
                    mean @ covariance @ mean.T,
                    mean @ start_error_columns(run, instrument),
                )
            )
    requested = [f"{a}.{s}" for a in ("Qx", "Qy") for s in ("K_F", "K_I", "K_II")]
    fit_result = fit(groups, make_unknowns(requested, {}, {}))
    reference = ReferenceNumbers()
    reference.add_coefficients(fit_result, requested)
    for k, name in enumerate(("Qx", "Qy")):
        reference.add_correlations(fit_result, name)
        reference.add_chi_square_test(fit_result, name, [k, k + 2, k + 4])
    return reference


def block_means(run, step, is_number):
    """Return for each signal the matrix that averages its rows over blocks, (blocks, rows).

    A block contains the rows in 1/64 revolution. Its mean includes the rows where all signals are
    finite. A signal with less than half of its values finite omits the block, and does not affect
    the other signals.

    is_number: Whether each value is finite, (signals, rows).
    """
    rows_per_block = int(2.0 * math.pi / 64.0 / abs(run.rate) / step)
    block_numbers = np.round(run.times / step).astype(int) // rows_per_block
    is_in_block = np.array([block_numbers == k for k in np.unique(block_numbers)])
    for k, rows in enumerate(is_in_block):
        lacks_rows = 2 * is_number[:, rows].sum(axis=1) < rows.sum()
        is_in_block[k] = rows & is_number[~lacks_rows].all(axis=0)
    mean = is_in_block / is_in_block.sum(axis=1)[:, None]
    return [mean[~(is_in_block & ~row_is_number).any(axis=1)] for row_is_number in is_number]


# Readings without stated u: two repeats at each setting.


def found_readings(folder):
    site, per_g = Site(GRAVITY, math.radians(45.0), 0.0), 0.5
    instrument = Instrument("A", "up", "north")
    truth, generator = {"A.K_F": 1e-3, "A.K_I": 1.0004, "A.delta_O": -5e-4}, NormalGenerator(8)
    lines, all_readings = [], []
    for k in range(8):
        axes = rotate(instrument.axes(), math.radians(45.0 * k), np.array(AXES["west"]))
        reading = Reading(f"p{k}", "static", axes, u=4e-6)
        repeats = draw_readings(site, "A", [reading, reading], truth, per_g, generator, 7)
        lines.append(f"p{k},{45 * k},{repeats[0].value:.7f},{repeats[1].value:.7f}")
        all_readings += repeats
    text = "\n".join(["position,angle_deg,first_V,second_V", *lines]) + "\n"
    (folder / "readings.csv").write_text(text, encoding="utf-8")
    requested = ["A.K_F", "A.K_I", "A.delta_O"]
    # Common noise: residual sum of squares over degrees of freedom.
    chi_square, dof = fit(
        [make_reading_rows(site, "A", all_readings, per_g)], make_unknowns(requested, {}, {})
    ).misfit([0])
    all_readings = [
        replace(reading, u=4e-6 * math.sqrt(chi_square / dof)) for reading in all_readings
    ]
    fit_result = fit(
        [make_reading_rows(site, "A", all_readings, per_g)], make_unknowns(requested, {}, {})
    )
    reference = ReferenceNumbers()
    reference.add_coefficients(fit_result, requested)
    for name in requested:
        reference.add_dof(name, dof, 1e-6)
    return reference


# Records without stated noise: white noise alone, and white noise with a detectable walk.


def found_noise(folder):
    instruments = [
        Instrument("Qx", "east", "down", "displacement"),
        Instrument("Qy", "north", "down", "velocity"),
    ]
    site = Site(GRAVITY, math.radians(45.0), 2.5)
    truth = {
        **{"Qx.K_F": 1e-3, "Qx.K_I": 1.00005, "Qx.K_II": 4e-5},
        **{"Qy.K_F": 2e-3, "Qy.K_I": 0.9997, "Qy.K_II": 1e-5},
    }
    runs = [Run("slow", 1.5, 0.25 * np.arange(65)), Run("fast", 3.5, 0.1 * np.arange(65), 2.0)]
    density, generator, signals = (3e-4 * GRAVITY) ** 2, NormalGenerator(77), {"Qx": [], "Qy": []}
    for run in runs:
        t, white = run.times, 1e-6 * np.eye(65)
        noise = (
            generator.draw_correlated(white),
            generator.draw_correlated(white + walk_covariance(t, density, 1)),
        )
        columns = {"time_s": t, "angle_rad": run.angle(t)[0]}
        for instrument, record_noise, name in zip(
            instruments, noise, ("east_m", "north_m_s"), strict=True
        ):
            columns[name] = simulate_record(site, run, instrument, truth) + record_noise
        written = write_record(folder, run.name, columns, ["%.6g", "%.15g", "%.6f", "%.6f"])
        for instrument, values in zip(instruments, written[2:], strict=True):
            model, free = make_model(site, run, instrument), start_error_columns(run, instrument)
            signals[instrument.name].append(Rows(model, values, white, free))
    reference = ReferenceNumbers()
    for instrument, integrations in zip(instruments, (2, 1), strict=True):
        stated = {"Qx.K_I": (1.0, 1e-4)} if instrument.name == "Qx" else {}
        unknowns = make_unknowns(
            [f"{instrument.name}.{s}" for s in ("K_F", "K_I", "K_II")], stated, {}
        )
        add_estimated_noise_fit(
            reference, signals[instrument.name], runs, integrations, unknowns, density
        )
    return reference


def add_estimated_noise_fit(reference, groups, runs, integrations, unknowns, start_density):
    """Add the reference numbers of an accelerometer with estimated noise.

    start_density: Start value of the walk density.
    """
    times = [run.times for run in runs]
    likelihood = Likelihood(groups, times, integrations, unknowns)
    white_variance = likelihood.fit_white(0.0, 1e-6)
    both_levels = likelihood.fit(1e-6, start_density)
    is_significant = (
        2.0 * (likelihood.log_likelihood(*both_levels) - likelihood.log_likelihood(white_variance))
        > 2.706
    )
    levels = both_levels if is_significant else np.array([white_variance])

    def solve(white, n2=0.0):
        rows = [
            replace(
                g, covariance=white * np.eye(t.size) + n2 * walk_covariance(t, 1.0, integrations)
            )
            for g, t in zip(groups, times, strict=True)
        ]
        return fit(rows, unknowns)

    # Satterthwaite approximation: propagate the uncertainty of the noise levels to u^2.
    fit_result, step = solve(*levels), 1e-2
    variance = np.diag(fit_result.covariance)
    slopes = []
    for k in range(levels.size):
        upper, lower = (
            np.diag(solve(*(levels * np.exp(s * step * np.eye(levels.size)[k]))).covariance)
            for s in (1, -1)
        )
        slopes.append((upper - lower) / (2.0 * step))
    slopes, spread = np.array(slopes).T, likelihood.log_covariance(levels)
    dof = 2.0 * variance**2 / np.einsum("pi,ij,pj->p", slopes, spread, slopes)
    if not is_significant:
        density_step = 1e-9 * white_variance
        walk_slopes = (
            np.diag(solve(white_variance, density_step).covariance) - variance
        ) / density_step
        level, walk_dof = estimate_hidden_walk(likelihood, white_variance, variance, walk_slopes)
        fit_result.covariance_noise[:] += np.diag(level * walk_slopes)
        share = variance / (variance + level * walk_slopes)
        dof = 1.0 / (share**2 / dof + 1.0 / walk_dof)
    reference.add_coefficients(fit_result, fit_result.names, ESTIMATED_NOISE_TOLERANCE)
    for name, value in zip(fit_result.names, dof, strict=True):
        reference.add_dof(name, value, 2.0 * ESTIMATED_NOISE_TOLERANCE)
    owner = fit_result.names[0].partition(".")[0]
    observable = "displacement" if integrations == 2 else "velocity"
    for name, level in zip((observable, "acceleration"), np.sqrt(levels), strict=False):
        reference.add(f"{name} noise of {owner}", [level], [ESTIMATED_NOISE_TOLERANCE * level])


CAMPAIGNS = (observables, readings, mixed, dense, found_readings, found_noise)


def main():
    path = DATA / "fits.json"
    document = json.loads(path.read_text(encoding="utf-8"))
    for make_campaign in [m for m in CAMPAIGNS if m.__name__ in sys.argv[1:] or not sys.argv[1:]]:
        reference = make_campaign(DATA / "fits" / make_campaign.__name__)
        document[make_campaign.__name__] = {
            "expected": reference.expected,
            "limits": reference.limits,
        }
    text = json.dumps(document, indent=0)
    text = re.sub(r"\n(?=[-\d\]])", "", text).replace(",-", ", -")
    path.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()

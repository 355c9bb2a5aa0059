"""Calls of the functions that cases name, and the compared values of their results.

Functions are looked up in their modules on each call, so that a case tests the function in use.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from importlib import import_module
from itertools import combinations
from typing import Any, Final

import numpy as np

from counterspin.arrays import Array
from counterspin.validation import files
from counterspin.validation.cases import (
    Case,
    compared_forces,
    compared_integrals,
    document,
    select_motion,
)
from counterspin.validation.files import NotAvailableError

__all__ = ["NotAvailableError", "run_case"]

Given = Mapping[str, Any]
Values = Mapping[str, Any]


def run_case(case: Case) -> dict[str, Any]:
    """Return the result of a case's function: name -> values, in the shapes of `expected`."""
    module, _, name = case.kernel.partition(":")
    return dict(_KERNELS[name](import_module(module), case.given))


def _spindle(given: Given) -> Any:
    from counterspin.physics.spindle import Ripple, Spindle

    ripples = tuple(Ripple(n, float(a), float(p)) for n, a, p in given.get("ripples", []))
    start = float(given.get("start_angle", 0.0))
    return Spindle(float(given["rate"]), float(given.get("drift", 0.0)), ripples, start)


def _columns(module: Any, given: Given) -> Values:
    from counterspin.physics import accelerometer
    from counterspin.physics.motion import Site, Trajectory

    data, motion = document(given["file"]), select_motion(given)
    earth_rate = float(data["earth_rate"]) if motion.get("earth_rate") else 0.0
    site = Site(float(data["gravity"]), float(data["latitude"]), earth_rate)
    trajectory = Trajectory(_spindle(motion), float(data["radius"]), site)
    times = np.array(motion["times"], np.float64)
    values = dict[str, Any]()
    for name, symbols in compared_integrals(given).items():
        mounting = getattr(accelerometer, name)
        table = module.columns(trajectory, mounting, symbols, times, given["observable"])
        values |= {f"{s} of {name}": column for s, column in zip(symbols, table.T, strict=True)}
    return values


def _angle(_: Any, given: Given) -> Values:
    motion = select_motion(given)
    return {"angle": _spindle(motion).angle(np.array(motion["times"], np.float64))}


def _fit_spindle(module: Any, given: Given) -> Values:
    time = np.linspace(0.0, given["duration"], given["samples"])
    spindle = module.fit_spindle(time, _spindle(given).angle(time), given["rate"]).spindle
    return {name: getattr(spindle, name) for name in ("rate", "drift", "start_angle")}


def _force(module: Any, given: Given) -> Values:
    from counterspin.physics.accelerometer import Mounting
    from counterspin.physics.motion import Site

    data, mounting = (
        document(given["file"]),
        Mounting.from_axes(*(module.FRAMES["arm"][name] for name in ("outward", "up"))),
    )
    forces = []
    for position in compared_forces(given):
        tilt = tuple(float(position.get(axis, 0.0)) for axis in ("east", "north"))
        station = module.Stations.at(
            "arm",
            mounting.matrix[None],
            rate=float(position["rate"]),
            radius=float(position["radius"]),
            axis_tilt=tilt,
        )
        site = Site(float(data["gravity"]), float(position["latitude"]))
        forces.append(station.forces(site, np.array([float(position["angle"])]))[0, 0])
    return {"force": forces}


def _normal_gravity(module: Any, given: Given) -> Values:
    return {"gravity": module.normal_gravity(math.radians(given["degrees"]))}


def _indicated(module: Any, given: Given) -> Values:
    force = np.array([given["force"]])
    return {"indicated": module.indicated(module.QX, given["coefficients"], force)[0]}


def _parabola(module: Any, given: Given) -> Values:
    from counterspin.physics.accelerometer import QX

    inputs = (given["rate"], given["radius"], given["gravity"])
    return {"parabola": module.parabola(given["symbol"], QX, *inputs)}


def _second_stage_columns(module: Any, given: Given) -> Values:
    constants = (given["radius"], given["gravity"], given["scale_factor"])
    table = module.second_stage_columns(np.array(given["rates"]), *constants)
    if "sigma_b2" not in given:
        return {"columns": table}
    # Eq. 33 and 34, unweighted as in the paper.
    row = np.linalg.pinv(table)[0] * np.array(given["sigma_b2"])
    return {"sigma": math.sqrt(float(row @ row))}


def _fit(module: Any, given: Given) -> Values:
    if "polynomial" in given:
        design = np.vander(np.array(given["x"], float), given["polynomial"] + 1, increasing=True)
    else:
        design = np.array(given["design"], float)
    answer = module.fit(design, np.array(given["y"], float), given.get("sigma"))
    return {
        "estimate": answer.estimate,
        "u": answer.u,
        "sigma": answer.sigma,
        "chi2": answer.chi2,
        "dof": answer.dof,
        "covariance": answer.covariance[0, -1],
    }


def _solve(module: Any, given: Given) -> Values:
    from counterspin.inference.least_squares import reduce_block

    block = reduce_block(given["design"], given["y"], None, given.get("considered"))
    priors = {
        key: np.array(given[key], np.float64)
        for key in ("prior_mean", "prior_sd", "considered_sd")
        if key in given
    }
    answer = module.solve([block], **priors)
    return {"estimate": answer.estimate, "u": np.sqrt(np.diag(answer.covariance))}


def _effective_dof(module: Any, given: Given) -> Values:
    variances = np.square(np.array(given["u"], np.float64))
    covariance = np.diag(2.0 * variances**2 / np.array(given["dof"]))
    gradient = np.ones((1, variances.size))
    return {"dof": module.effective_dof([variances.sum()], gradient, covariance)[0]}


def _variance(module: Any, given: Given) -> Values:
    from counterspin.inference.noise.likelihood import RecordData
    from counterspin.inference.noise.model import ESTIMATE, Noise

    y = np.array(given["y"], np.float64)
    record = RecordData(np.arange(y.size, dtype=np.float64), 0, np.ones((y.size, 1)), y)
    return {"white": module.estimate_noise([record], Noise(ESTIMATE)).noise.white}


def _first_stage(module: Any, given: Given) -> Values:
    from counterspin.inference.two_stage.first_stage import Strobes

    time = np.arange(float(given["strobes"]))
    error = np.polynomial.polynomial.polyval(time, given["coefficients"])
    answer = module.first_stage(Strobes(time, error, np.ones(time.size), 0), given["sigma"])
    return {"coefficients": answer.coefficients, "u_b2": answer.u_b2}


def _walk(module: Any, given: Given) -> Values:
    return {"covariance": module.walk_covariance(np.array(given["time"]))}


def _flicker(module: Any, given: Given) -> Values:
    lag = np.array(given["lag"])
    answer = module.flicker_autocovariance(lag, given["low"], given["high"])
    return {"autocovariance": answer}


def _acceptance_limits(module: Any, given: Given) -> Values:
    low, high = module.acceptance_limits(**given)
    return {"low": low, "high": high}


def _decide(module: Any, given: Given) -> Values:
    """Return the verdict as a number: 1 pass, 0 undecided, -1 fail."""
    limits = module.Specification("", given["low"], given["high"], "")
    item = (given[key] for key in ("value", "u", "dof"))
    answer = module.decide(*item, limits, module.DecisionRule(**given["rule"]))
    verdict = {"pass": 1.0, "undecided": 0.0, "fail": -1.0}[answer.verdict]
    risk = {} if answer.risk is None else {"risk": answer.risk}
    return {"verdict": verdict, "guard_band": answer.guard_band, **risk}


def _random_walk(module: Any, given: Given) -> Values:
    from counterspin.inference.noise.likelihood import RecordData
    from counterspin.inference.noise.model import ESTIMATE, Noise

    data = document(given["file"])
    time, velocity = (np.array(data[key], np.float64) for key in ("time", "velocity"))
    line = np.stack([np.ones_like(time), time], axis=1)
    noise = Noise(given.get("white", ESTIMATE), ESTIMATE)
    answer = module.estimate_noise([RecordData(time, 1, line, velocity)], noise)
    levels = {"white": answer.noise.white, "random_walk": answer.noise.random_walk}
    if "white" in given:
        return levels
    with_walk, white_only = (
        answer.log_likelihoods[key] for key in (("white", "random_walk"), ("white",))
    )
    return levels | {"gain": with_walk - white_only}


def _noise(module: Any, given: Given) -> Values:
    return _random_walk(module, given) if "file" in given else _variance(module, given)


def _quotients(given: Given) -> tuple[dict[str, Any], Array]:
    """Return R, X and Z of GUM H.2 as quotients by I, and the correlations of their numerators.

    The conversion of a coefficient in g/g^2 to SI divides it by g, and g and the coefficient are
    correlated: V cos(phi), V sin(phi) and V over I have the same structure.
    """
    observed = np.array(given["observations"], np.float64)
    v, current, phase = observed.mean(axis=0)
    cos, sin = math.cos(phase), math.sin(phase)
    jacobian = np.array(
        [[cos, 0.0, -v * sin], [sin, 0.0, v * cos], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
    )
    mean_covariance = jacobian @ np.cov(observed.T) @ jacobian.T / len(observed)
    u = np.sqrt(np.diag(mean_covariance))
    estimates = {}
    for index, (name, value) in enumerate(zip("RXZ", (v * cos, v * sin, v), strict=True)):
        sensitivity = mean_covariance[index, 3] / mean_covariance[3, 3]
        estimates[name] = {
            "value": value,
            "u": float(u[index]),
            "unit": "g/g^2",
            "gravity": {"value": current, "u": float(u[3]), "sensitivity": sensitivity},
        }
    return estimates, mean_covariance[:3, :3] / np.outer(u[:3], u[:3])


def _si_estimate(module: Any, given: Given) -> Values:
    inputs = _quotients(given)[0] if "observations" in given else {"": given}
    answer = dict[str, Any]()
    for name, given_estimate in inputs.items():
        gravity = module.StatedGravity(**given_estimate["gravity"])
        estimate = module.si_estimate(
            given_estimate["value"],
            given_estimate["u"],
            given_estimate["unit"],
            given_estimate.get("dof"),
            gravity,
        )
        answer |= {name or "value": estimate.value, f"u({name})" if name else "u": estimate.u}
        if estimate.dof is not None:
            answer["dof"] = estimate.dof
    return answer


def _si_covariance(module: Any, given: Given) -> Values:
    from counterspin.calibration.result_parts import Correlation
    from counterspin.calibration.si_estimates import StatedGravity, convert_to_si

    if "observations" in given:
        inputs, correlation_matrix = _quotients(given)
    else:
        inputs, correlation_matrix = given["estimates"], np.array(given["correlation"])
    estimates = {
        name: convert_to_si(
            given_estimate["value"],
            given_estimate["u"],
            given_estimate["unit"],
            None,
            StatedGravity(**given_estimate["gravity"]),
        )
        for name, given_estimate in inputs.items()
    }
    correlation = Correlation(terms=list(inputs), matrix=correlation_matrix.tolist())
    answer = dict[str, Any]()
    for first, second in combinations(inputs, 2):
        covariance = module.covariance(correlation, estimates, first, second)
        u = estimates[first].u * estimates[second].u if "observations" in given else 1.0
        answer[f"{first}, {second}"] = covariance / u
    return answer


def _forecast(module: Any, given: Given) -> Values:
    from counterspin.campaign.memory import make_campaign

    runs = [
        {
            "name": name,
            "motion": "static",
            "axes": {"input": name, "pendulous": "east"},
            "reading": f"{value} ± {given['sigma']!r} g",
        }
        for name, value in (("up", 1.0), ("down", -1.0))
    ]
    campaign = make_campaign(
        {
            "site": {"gravity": "9.8 m/s^2", "latitude": "0 deg"},
            "accelerometers": {"A": {"input_axis": "up", "pendulous_axis": "east"}},
            "model": {"terms": ["K_F", "K_I"], "assume": "all"},
            "runs": runs,
        }
    )
    answer = module.forecast(campaign)
    estimated = [unknown.symbol for unknown in answer.fit.model.unknowns]
    u = np.sqrt(np.diag(answer.fit.solution.covariance))
    return {symbol: u[estimated.index(symbol)] for symbol in ("K_F", "K_I")}


def _individuals(module: Any, given: Given) -> Values:
    values = given["values"]
    answer = module.individuals_chart(values, [str(index) for index in range(len(values))])
    limits = {"low": answer.action_low, "high": answer.action_high}
    return {"centre": answer.centre, "mean_range": answer.mean_range, **limits}


def _weighted_mean(module: Any, given: Given) -> Values:
    answer = module.weighted_mean(given["values"], given["u"])
    return {"value": answer.value, "u": answer.u}


def _en_score(module: Any, given: Given) -> Values:
    return {"E_n": module.en_score(tuple(given["first"]), tuple(given["second"]))}


def _factors(module: Any, given: Given) -> Values:
    g = given["gravity"]
    return {
        unit: module.unit_factor(unit, target, gravity=g) for unit, target in given["units"].items()
    }


def _number(name: str, key: str) -> Callable[[Any, Given], Values]:
    """Return the call of a function with keyword arguments that returns a number."""
    return lambda module, given: {key: getattr(module, name)(**given)}


_KERNELS: Final[Mapping[str, Callable[[Any, Given], Values]]] = {
    "columns": _columns,
    "Spindle.angle": _angle,
    "fit_spindle": _fit_spindle,
    "Stations.forces": _force,
    "normal_gravity": _normal_gravity,
    "indicated": _indicated,
    "parabola": _parabola,
    "second_stage_columns": _second_stage_columns,
    "fit": _fit,
    "solve": _solve,
    "effective_dof": _effective_dof,
    "estimate_noise": _noise,
    "first_stage": _first_stage,
    "walk_covariance": _walk,
    "flicker_autocovariance": _flicker,
    "student_quantile": _number("student_quantile", "t"),
    "student_cdf": _number("student_cdf", "p"),
    "normal_quantile": _number("normal_quantile", "z"),
    "normal_cdf": _number("normal_cdf", "p"),
    "chi_square_tail": _number("chi_square_tail", "p"),
    "expanded_uncertainty": _number("expanded_uncertainty", "U"),
    "conformance_probability": _number("conformance_probability", "p"),
    "nonconformance_probability": _number("nonconformance_probability", "p"),
    "acceptance_limits": _acceptance_limits,
    "decide": _decide,
    "calibrate": files.fitted_numbers,
    "forecast": _forecast,
    "certificate": files.certificate_numbers,
    "apply": files.corrected_forces,
    "unit_factor": _factors,
    "read_certificate": files.read_estimates,
    "check_schema": files.check_schema,
    "verify": files.verify,
    "si_estimate": _si_estimate,
    "covariance": _si_covariance,
    "to_si": _number("to_si", "si"),
    "from_si": _number("from_si", "value"),
    "en_score": _en_score,
    "individuals_chart": _individuals,
    "weighted_mean": _weighted_mean,
    "read_record": files.read_record,
}

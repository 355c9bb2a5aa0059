"""Calls of the functions under test, and the values to compare.

Each call looks the function up in its module, so that a case tests the function in use.
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
    compared_positions,
    compared_symbols,
    find_motion,
    load_document,
)
from counterspin.validation.files import NotAvailableError

__all__ = ["NotAvailableError", "run_case"]

Inputs = Mapping[str, Any]
Outputs = Mapping[str, Any]


def run_case(case: Case) -> dict[str, Any]:
    """Call the function of a case; return name -> values, in the shapes of `Case.expected`."""
    module, _, name = case.kernel.partition(":")
    return dict(_KERNELS[name](import_module(module), case.given))


def _make_spindle(inputs: Inputs) -> Any:
    from counterspin.physics.spindle import Ripple, Spindle

    ripples = tuple(
        Ripple(order, float(amplitude), float(phase))
        for order, amplitude, phase in inputs.get("ripples", [])
    )
    start_angle = float(inputs.get("start_angle", 0.0))
    return Spindle(float(inputs["rate"]), float(inputs.get("drift", 0.0)), ripples, start_angle)


def _run_columns(module: Any, inputs: Inputs) -> Outputs:
    from counterspin.physics import accelerometer
    from counterspin.physics.motion import Site, Trajectory

    reference, motion = load_document(inputs["file"]), find_motion(inputs)
    earth_rate = float(reference["earth_rate"]) if motion.get("earth_rate") else 0.0
    site = Site(float(reference["gravity"]), float(reference["latitude"]), earth_rate)
    trajectory = Trajectory(_make_spindle(motion), float(reference["radius"]), site)
    times = np.array(motion["times"], np.float64)
    values = dict[str, Any]()
    for name, symbols in compared_symbols(inputs).items():
        mounting = getattr(accelerometer, name)
        table = module.columns(trajectory, mounting, symbols, times, inputs["observable"])
        values |= {
            f"{symbol} of {name}": column for symbol, column in zip(symbols, table.T, strict=True)
        }
    return values


def _run_angle(_: Any, inputs: Inputs) -> Outputs:
    motion = find_motion(inputs)
    return {"angle": _make_spindle(motion).angle(np.array(motion["times"], np.float64))}


def _run_fit_spindle(module: Any, inputs: Inputs) -> Outputs:
    time = np.linspace(0.0, inputs["duration"], inputs["samples"])
    spindle = module.fit_spindle(time, _make_spindle(inputs).angle(time), inputs["rate"]).spindle
    return {name: getattr(spindle, name) for name in ("rate", "drift", "start_angle")}


def _run_forces(module: Any, inputs: Inputs) -> Outputs:
    from counterspin.physics.accelerometer import Mounting
    from counterspin.physics.motion import Site

    reference = load_document(inputs["file"])
    mounting = Mounting.from_axes(*(module.FRAMES["arm"][name] for name in ("outward", "up")))
    forces = []
    for position in compared_positions(inputs):
        tilt = tuple(float(position.get(axis, 0.0)) for axis in ("east", "north"))
        station = module.Stations.at(
            "arm",
            mounting.matrix[None],
            rate=float(position["rate"]),
            radius=float(position["radius"]),
            axis_tilt=tilt,
        )
        site = Site(float(reference["gravity"]), float(position["latitude"]))
        forces.append(station.forces(site, np.array([float(position["angle"])]))[0, 0])
    return {"force": forces}


def _run_normal_gravity(module: Any, inputs: Inputs) -> Outputs:
    return {"gravity": module.normal_gravity(math.radians(inputs["degrees"]))}


def _run_indicated_force(module: Any, inputs: Inputs) -> Outputs:
    force = np.array([inputs["force"]])
    return {"indicated": module.indicated(module.QX, inputs["coefficients"], force)[0]}


def _run_parabola(module: Any, inputs: Inputs) -> Outputs:
    from counterspin.physics.accelerometer import QX

    motion = (inputs["rate"], inputs["radius"], inputs["gravity"])
    return {"parabola": module.parabola(inputs["symbol"], QX, *motion)}


def _run_second_stage_columns(module: Any, inputs: Inputs) -> Outputs:
    constants = (inputs["radius"], inputs["gravity"], inputs["scale_factor"])
    table = module.second_stage_columns(np.array(inputs["rates"]), *constants)
    if "sigma_b2" not in inputs:
        return {"columns": table}
    # Eq. 33 and 34, unweighted as in the paper.
    row = np.linalg.pinv(table)[0] * np.array(inputs["sigma_b2"])
    return {"sigma": math.sqrt(float(row @ row))}


def _run_fit(module: Any, inputs: Inputs) -> Outputs:
    if "polynomial" in inputs:
        design = np.vander(np.array(inputs["x"], float), inputs["polynomial"] + 1, increasing=True)
    else:
        design = np.array(inputs["design"], float)
    fit = module.fit(design, np.array(inputs["y"], float), inputs.get("sigma"))
    return {
        "estimate": fit.estimate,
        "u": fit.u,
        "sigma": fit.sigma,
        "chi2": fit.chi2,
        "dof": fit.dof,
        "covariance": fit.covariance[0, -1],
    }


def _run_solve(module: Any, inputs: Inputs) -> Outputs:
    from counterspin.inference.least_squares import reduce_block

    block = reduce_block(inputs["design"], inputs["y"], None, inputs.get("considered"))
    priors = {
        key: np.array(inputs[key], np.float64)
        for key in ("prior_mean", "prior_sd", "considered_sd")
        if key in inputs
    }
    solution = module.solve([block], **priors)
    return {"estimate": solution.estimate, "u": np.sqrt(np.diag(solution.covariance))}


def _run_effective_dof(module: Any, inputs: Inputs) -> Outputs:
    variances = np.square(np.array(inputs["u"], np.float64))
    covariance = np.diag(2.0 * variances**2 / np.array(inputs["dof"]))
    gradient = np.ones((1, variances.size))
    return {"dof": module.effective_dof([variances.sum()], gradient, covariance)[0]}


def _run_white_noise(module: Any, inputs: Inputs) -> Outputs:
    from counterspin.inference.noise.likelihood import RecordData
    from counterspin.inference.noise.model import ESTIMATE, Noise

    y = np.array(inputs["y"], np.float64)
    record = RecordData(np.arange(y.size, dtype=np.float64), 0, np.ones((y.size, 1)), y)
    return {"white": module.estimate_noise([record], Noise(ESTIMATE)).noise.white}


def _run_first_stage(module: Any, inputs: Inputs) -> Outputs:
    from counterspin.inference.two_stage.first_stage import Strobes

    time = np.arange(float(inputs["strobes"]))
    error = np.polynomial.polynomial.polyval(time, inputs["coefficients"])
    parabola = module.first_stage(Strobes(time, error, np.ones(time.size), 0), inputs["sigma"])
    return {"coefficients": parabola.coefficients, "u_b2": parabola.u_b2}


def _run_walk_covariance(module: Any, inputs: Inputs) -> Outputs:
    return {"covariance": module.walk_covariance(np.array(inputs["time"]))}


def _run_flicker_autocovariance(module: Any, inputs: Inputs) -> Outputs:
    lag = np.array(inputs["lag"])
    autocovariance = module.flicker_autocovariance(lag, inputs["low"], inputs["high"])
    return {"autocovariance": autocovariance}


def _run_acceptance_limits(module: Any, inputs: Inputs) -> Outputs:
    low, high = module.acceptance_limits(**inputs)
    return {"low": low, "high": high}


def _run_decide(module: Any, inputs: Inputs) -> Outputs:
    """Return the verdict as a number: 1 pass, 0 undecided, -1 fail."""
    specification = module.Specification("", inputs["low"], inputs["high"], "")
    estimate = (inputs[key] for key in ("value", "u", "dof"))
    decision = module.decide(*estimate, specification, module.DecisionRule(**inputs["rule"]))
    verdict_number = {"pass": 1.0, "undecided": 0.0, "fail": -1.0}[decision.verdict]
    risk_output = {} if decision.risk is None else {"risk": decision.risk}
    return {"verdict": verdict_number, "guard_band": decision.guard_band, **risk_output}


def _run_random_walk(module: Any, inputs: Inputs) -> Outputs:
    from counterspin.inference.noise.likelihood import RecordData
    from counterspin.inference.noise.model import ESTIMATE, Noise

    series = load_document(inputs["file"])
    time, velocity = (np.array(series[key], np.float64) for key in ("time", "velocity"))
    design = np.stack([np.ones_like(time), time], axis=1)
    noise = Noise(inputs.get("white", ESTIMATE), ESTIMATE)
    estimate = module.estimate_noise([RecordData(time, 1, design, velocity)], noise)
    levels = {"white": estimate.noise.white, "random_walk": estimate.noise.random_walk}
    if "white" in inputs:
        return levels
    full_log_likelihood, white_log_likelihood = (
        estimate.log_likelihoods[key] for key in (("white", "random_walk"), ("white",))
    )
    return levels | {"gain": full_log_likelihood - white_log_likelihood}


def _run_estimate_noise(module: Any, inputs: Inputs) -> Outputs:
    run = _run_random_walk if "file" in inputs else _run_white_noise
    return run(module, inputs)


def _quotient_estimates(inputs: Inputs) -> tuple[dict[str, Any], Array]:
    """Return R, X and Z of GUM H.2 as quotients by I, and the correlations of their numerators.

    The conversion of a coefficient in g/g^2 to SI divides it by g, and g and the coefficient are
    correlated: V cos(phi), V sin(phi) and V over I have the same structure.
    """
    observations = np.array(inputs["observations"], np.float64)
    voltage, current, phase = observations.mean(axis=0)
    cos, sin = math.cos(phase), math.sin(phase)
    jacobian = np.array(
        [[cos, 0.0, -voltage * sin], [sin, 0.0, voltage * cos], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
    )
    mean_covariance = jacobian @ np.cov(observations.T) @ jacobian.T / len(observations)
    u = np.sqrt(np.diag(mean_covariance))
    estimates = {}
    for index, (name, value) in enumerate(
        zip("RXZ", (voltage * cos, voltage * sin, voltage), strict=True)
    ):
        sensitivity = mean_covariance[index, 3] / mean_covariance[3, 3]
        estimates[name] = {
            "value": value,
            "u": float(u[index]),
            "unit": "g/g^2",
            "gravity": {"value": current, "u": float(u[3]), "sensitivity": sensitivity},
        }
    return estimates, mean_covariance[:3, :3] / np.outer(u[:3], u[:3])


def _run_convert_to_si(module: Any, inputs: Inputs) -> Outputs:
    estimates = _quotient_estimates(inputs)[0] if "observations" in inputs else {"": inputs}
    outputs = dict[str, Any]()
    for name, entry in estimates.items():
        gravity = module.StatedGravity(**entry["gravity"])
        si = module.convert_to_si(
            entry["value"], entry["u"], entry["unit"], entry.get("dof"), gravity
        )
        outputs |= {name or "value": si.value, f"u({name})" if name else "u": si.u}
        if si.dof is not None:
            outputs["dof"] = si.dof
    return outputs


def _run_covariance(module: Any, inputs: Inputs) -> Outputs:
    from counterspin.calibration.result_parts import Correlation
    from counterspin.calibration.si_estimates import StatedGravity, convert_to_si

    if "observations" in inputs:
        entries, correlation_matrix = _quotient_estimates(inputs)
    else:
        entries, correlation_matrix = inputs["estimates"], np.array(inputs["correlation"])
    estimates = {
        name: convert_to_si(
            entry["value"], entry["u"], entry["unit"], None, StatedGravity(**entry["gravity"])
        )
        for name, entry in entries.items()
    }
    correlation = Correlation(terms=list(entries), matrix=correlation_matrix.tolist())
    outputs = dict[str, Any]()
    for first, second in combinations(entries, 2):
        covariance = module.covariance(correlation, estimates, first, second)
        scale = estimates[first].u * estimates[second].u if "observations" in inputs else 1.0
        outputs[f"{first}, {second}"] = covariance / scale
    return outputs


def _run_forecast(module: Any, inputs: Inputs) -> Outputs:
    from counterspin.campaign.memory import make_campaign

    runs = [
        {
            "name": name,
            "motion": "static",
            "axes": {"input": name, "pendulous": "east"},
            "reading": f"{value} ± {inputs['sigma']!r} g",
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
    forecast = module.forecast(campaign)
    symbols = [unknown.symbol for unknown in forecast.fit.model.unknowns]
    u = np.sqrt(np.diag(forecast.fit.solution.covariance))
    return {symbol: u[symbols.index(symbol)] for symbol in ("K_F", "K_I")}


def _run_individuals_chart(module: Any, inputs: Inputs) -> Outputs:
    values = inputs["values"]
    chart = module.individuals_chart(values, [str(index) for index in range(len(values))])
    limits = {"low": chart.action_low, "high": chart.action_high}
    return {"centre": chart.centre, "mean_range": chart.mean_range, **limits}


def _run_weighted_mean(module: Any, inputs: Inputs) -> Outputs:
    mean = module.weighted_mean(inputs["values"], inputs["u"])
    return {"value": mean.value, "u": mean.u}


def _run_en_score(module: Any, inputs: Inputs) -> Outputs:
    return {"E_n": module.en_score(tuple(inputs["first"]), tuple(inputs["second"]))}


def _run_unit_factor(module: Any, inputs: Inputs) -> Outputs:
    gravity = inputs["gravity"]
    return {
        unit: module.unit_factor(unit, target, gravity=gravity)
        for unit, target in inputs["units"].items()
    }


def _call_with_keywords(name: str, key: str) -> Callable[[Any, Inputs], Outputs]:
    """Return a kernel that passes the inputs as keywords to a function and returns a number."""
    return lambda module, inputs: {key: getattr(module, name)(**inputs)}


_KERNELS: Final[Mapping[str, Callable[[Any, Inputs], Outputs]]] = {
    "columns": _run_columns,
    "Spindle.angle": _run_angle,
    "fit_spindle": _run_fit_spindle,
    "Stations.forces": _run_forces,
    "normal_gravity": _run_normal_gravity,
    "indicated": _run_indicated_force,
    "parabola": _run_parabola,
    "second_stage_columns": _run_second_stage_columns,
    "fit": _run_fit,
    "solve": _run_solve,
    "effective_dof": _run_effective_dof,
    "estimate_noise": _run_estimate_noise,
    "first_stage": _run_first_stage,
    "walk_covariance": _run_walk_covariance,
    "flicker_autocovariance": _run_flicker_autocovariance,
    "student_quantile": _call_with_keywords("student_quantile", "t"),
    "student_cdf": _call_with_keywords("student_cdf", "p"),
    "normal_quantile": _call_with_keywords("normal_quantile", "z"),
    "normal_cdf": _call_with_keywords("normal_cdf", "p"),
    "chi_square_tail": _call_with_keywords("chi_square_tail", "p"),
    "expanded_uncertainty": _call_with_keywords("expanded_uncertainty", "U"),
    "conformance_probability": _call_with_keywords("conformance_probability", "p"),
    "nonconformance_probability": _call_with_keywords("nonconformance_probability", "p"),
    "acceptance_limits": _run_acceptance_limits,
    "decide": _run_decide,
    "calibrate": files.fitted_values,
    "forecast": _run_forecast,
    "certificate": files.certificate_values,
    "apply": files.corrected_forces,
    "unit_factor": _run_unit_factor,
    "read_certificate": files.certified_estimates,
    "check_schema": files.check_schema,
    "verify": files.verify_signatures,
    "convert_to_si": _run_convert_to_si,
    "covariance": _run_covariance,
    "to_si": _call_with_keywords("to_si", "si"),
    "from_si": _call_with_keywords("from_si", "value"),
    "en_score": _run_en_score,
    "individuals_chart": _run_individuals_chart,
    "weighted_mean": _run_weighted_mean,
    "read_record": files.read_record,
}

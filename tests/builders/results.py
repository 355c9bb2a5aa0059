"""Manually built results, minimal or with every section filled, with simple numbers."""

import copy
import json
from pathlib import Path

from counterspin.calibration.result import Result
from counterspin.calibration.result_parts import AccelerometerResult, Correlation

CONFORMITY = {
    "specification": "abs <= 5e-5 g/g^2",
    "low": -5e-5,
    "high": 5e-5,
    "unit": "g/g^2",
    "rule": "simple",
    "guard_band": 0.0,
    "verdict": "pass",
    "probability": 1.0,
    "risk": 0.0,
}


def make_coefficient(value, u, unit, **more):
    """Return a coefficient whose uncertainty is all noise."""
    return {"value": value, "u": u, "u_noise": u, "unit": unit, "estimated": True, **more}


def make_trace(**more):
    """Return a trace of three stretches."""
    return {
        "time": [0.5, 1.5, 2.5],
        "low": [-0.01, -0.02, -0.015],
        "high": [0.01, 0.03, 0.02],
        "left_out": [(1.2, 0.4)],
        "by_angle": {"low": [-0.01, None], "mean": [0.001, None], "high": [0.01, None]},
        "spectrum": {"frequency": [0.1, 1.0], "power": [0.9, 1.1]},
        "quantiles": {"normal": [-1.2, 0.0, 1.2], "found": [-1.0, 0.1, 1.5]},
        **more,
    }


def make_accelerometer_result(**parts):
    """Return an accelerometer result with these parts and a residual."""
    residual = {"rms": 0.01, "unit": "m", "dof": 1000.0}
    defaults = {"coefficients": {}, "correlation": None, "residual": residual}
    return AccelerometerResult.model_validate(defaults | parts)


def make_run(**changes):
    """Return a run without findings."""
    return {"rate": 3.0, "drift": 0.0, "samples": 1000, "rejected": 0} | changes


def make_bare_result(**parts):
    """Return a result with these parts and a single run."""
    defaults = {
        "method": "joint",
        "model": "exact",
        "accelerometers": {},
        "runs": {"run1": make_run()},
        "inputs": {"gravity": 9.8066, "latitude": 0.8, "radius": 2.5},
        "provenance": {"version": "9.9", "inputs": {"campaign.toml": "sha256:" + "0f" * 32}},
    }
    return Result.model_validate(defaults | parts)


def make_qx_result(**changes):
    """Return a result of accelerometer Qx and two runs; `changes` apply to Qx."""
    qx = {
        "serial_number": "Q-104",
        "coefficients": {
            "K_F": make_coefficient(0.005, 1e-6, "g"),
            "K_II": make_coefficient(2.7e-5, 1e-9, "g/g^2", dof=50.0),
        },
        "known": {"K_I": {"value": 1.002, "u": 0.0, "unit": "g/g", "estimated": False}},
        "axes": [(1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0)],
        "observable": "displacement",
        "correlation": {"terms": ["K_F", "K_II"], "matrix": [[1.0, 0.25], [0.25, 1.0]]},
        "residual": {"rms": 0.01, "unit": "m", "dof": 100.0, "chi2": 98.0, "lack_of_fit_p": 0.5},
        "budget": {
            "K_II": [
                {
                    "source": "noise of Qx",
                    "kind": "noise",
                    "u": None,
                    "unit": "",
                    "sensitivity": None,
                    "contribution": 0.8e-9,
                    "share": 0.64,
                },
                {
                    "source": "K_I",
                    "kind": "stated",
                    "u": 5e-6,
                    "unit": "g/g",
                    "sensitivity": -1.2e-4,
                    "contribution": 0.6e-9,
                    "share": 0.36,
                },
            ]
        },
        "jackknife": [
            {"run": "slow", "value": 2.7001e-5, "shift": 1e-9, "z": 0.5},
            {"run": "fast", "value": None, "shift": None, "z": None},
        ],
        "two_stage": {
            "value": 2.702e-5,
            "u": 4e-9,
            "difference": 2e-8,
            "u_difference": 2e-8,
            "z": 1.0,
        },
        "conformity": {"K_II": CONFORMITY},
        "traces": {"slow": make_trace(), "fast": make_trace(left_out=[])},
        **changes,
    }
    ripple = {"harmonic": 1, "amplitude": 3e-6, "u_amplitude": 3e-7, "phase": 0.1, "u_phase": 0.01}
    run_values = {"u_rate": 1e-9, "drift": 1e-9, "u_drift": 1e-10, "rejected": 2}
    run_values |= {"counts": {"outliers": 2}}
    return make_bare_result(
        title="By hand",
        accelerometers={"Qx": qx},
        platform={"platform.drift.north": make_coefficient(1e-8, 1e-9, "rad/s")},
        runs={
            "slow": make_run(rate=-3.0, ripples=[ripple], **run_values),
            "fast": make_run(rate=6.0, ripples=[], **run_values),
        },
        inputs={"gravity": 9.8, "latitude": 0.7, "radius": 2.5},
    )


#: A result of a real calibration, as an earlier version wrote it.
FROZEN_DOCUMENT = json.loads(
    (Path(__file__).parents[1] / "frozen" / "schema-1-joint.json").read_text(encoding="utf-8")
)


def make_dated_document(
    value=2.7e-5, date="2024-03-05", serial="Q-104", *, u=5e-8, run=None, **changes
):
    """Return the frozen result's document, only with Qx, with changed K_II, date and records."""
    document = copy.deepcopy(FROZEN_DOCUMENT) | changes
    qx = document["accelerometers"]["Qx"]
    qx["coefficients"]["K_II"] |= {"value": value, "u": u}
    if serial is not None:
        qx["serial_number"] = serial
    document["accelerometers"] = {"Qx": qx}
    document["details"] = {} if date is None else {"date": date}
    document["provenance"]["inputs"] = {
        "campaign.toml": "sha256:00",
        "run1.csv": f"sha256:{run or f'{value}{date}'}",
    }
    return document


def seal_document(document):
    """Return the text of a result file with a valid seal for a document."""
    return Result.model_validate(document).to_json()


def remove_seal(path):
    """Remove the seal from a result's file."""
    document = json.loads(path.read_text(encoding="utf-8"))
    del document["seal"]
    path.write_text(json.dumps(document), encoding="utf-8")


def make_two_accelerometers(result, terms, matrix):
    """Return a result whose Qy has the values of Qx, with correlations between both."""
    accelerometers = dict.fromkeys(("Qx", "Qy"), result.accelerometers["Qx"])
    correlation = Correlation(terms=terms, matrix=matrix)
    return result.model_copy(update={"accelerometers": accelerometers, "correlation": correlation})

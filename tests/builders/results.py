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


def coefficient(value, u, unit, **more):
    """Return a coefficient whose uncertainty is all noise."""
    return {"value": value, "u": u, "u_noise": u, "unit": unit, "estimated": True, **more}


def trace(**more):
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


def accelerometer(**parts):
    """Return an accelerometer result with these parts and a residual."""
    residual = {"rms": 0.01, "unit": "m", "dof": 1000.0}
    bare = {"coefficients": {}, "correlation": None, "residual": residual}
    return AccelerometerResult.model_validate(bare | parts)


def run(**changes):
    """Return a run without findings."""
    return {"rate": 3.0, "drift": 0.0, "samples": 1000, "rejected": 0} | changes


def bare_result(**parts):
    """Return a result with these parts and a single run."""
    bare = {
        "method": "joint",
        "model": "exact",
        "accelerometers": {},
        "runs": {"run1": run()},
        "inputs": {"gravity": 9.8066, "latitude": 0.8, "radius": 2.5},
        "provenance": {"version": "9.9", "inputs": {"campaign.toml": "sha256:" + "0f" * 32}},
    }
    return Result.model_validate(bare | parts)


def result(**changes):
    """Return a result of accelerometer Qx and two runs; `changes` apply to Qx."""
    qx = {
        "serial_number": "Q-104",
        "coefficients": {
            "K_F": coefficient(0.005, 1e-6, "g"),
            "K_II": coefficient(2.7e-5, 1e-9, "g/g^2", dof=50.0),
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
        "traces": {"slow": trace(), "fast": trace(left_out=[])},
        **changes,
    }
    ripple = {"harmonic": 1, "amplitude": 3e-6, "u_amplitude": 3e-7, "phase": 0.1, "u_phase": 0.01}
    found = {"u_rate": 1e-9, "drift": 1e-9, "u_drift": 1e-10, "rejected": 2}
    found |= {"counts": {"outliers": 2}}
    return bare_result(
        title="By hand",
        accelerometers={"Qx": qx},
        platform={"platform.drift.north": coefficient(1e-8, 1e-9, "rad/s")},
        runs={
            "slow": run(rate=-3.0, ripples=[ripple], **found),
            "fast": run(rate=6.0, ripples=[], **found),
        },
        inputs={"gravity": 9.8, "latitude": 0.7, "radius": 2.5},
    )


#: A result of a real calibration, as an earlier version wrote it.
FROZEN = json.loads(
    (Path(__file__).parents[1] / "frozen" / "schema-1-joint.json").read_text(encoding="utf-8")
)


def make_dated_document(
    value=2.7e-5, date="2024-03-05", serial="Q-104", *, u=5e-8, run=None, **changes
):
    """Return the frozen result's document, only with Qx, with changed K_II, date and records."""
    made = copy.deepcopy(FROZEN) | changes
    qx = made["accelerometers"]["Qx"]
    qx["coefficients"]["K_II"] |= {"value": value, "u": u}
    if serial is not None:
        qx["serial_number"] = serial
    made["accelerometers"] = {"Qx": qx}
    made["details"] = {} if date is None else {"date": date}
    made["provenance"]["inputs"] = {
        "campaign.toml": "sha256:00",
        "run1.csv": f"sha256:{run or f'{value}{date}'}",
    }
    return made


def seal_document(document):
    """Return the text of a result file with a valid seal for a document."""
    return Result.model_validate(document).to_json()


def remove_seal(path):
    """Remove the seal from a result's file."""
    document = json.loads(path.read_text(encoding="utf-8"))
    del document["seal"]
    path.write_text(json.dumps(document), encoding="utf-8")


def two_accelerometers(given, terms, matrix):
    """Return a result whose Qy has the values of Qx, with correlations between both."""
    both = dict.fromkeys(("Qx", "Qy"), given.accelerometers["Qx"])
    correlation = Correlation(terms=terms, matrix=matrix)
    return given.model_copy(update={"accelerometers": both, "correlation": correlation})

"""The result of a calibration: one object, its JSON, and reading it back.

The JSON is a contract with users' own programs: keys keep their names and meaning within one
`SCHEMA`, new keys may be added. Coefficients are in g-units of the stated gravity; everything
else is SI unless its unit stands beside it.

- `Result`; its parts are in `counterspin.calibration.result_parts`
- `described`: what a result repeats of an accelerometer's description
- `read_result`, `write_result`: `Result.read` and `Result.write` as functions
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sized
from typing import Any

from counterspin.calibration.result_parts import (
    AccelerometerResult,
    Coefficient,
    ConfoundedTerms,
    Finding,
    Inputs,
    Provenance,
    RunResult,
    State,
    Trace,
)
from counterspin.campaign.resolved import Accelerometer
from counterspin.physics.accelerometer import TERMS
from counterspin.results import ResultFile


class Result(ResultFile):
    """A calibration's result; see the parts.

    `state` is the worst of the accelerometers' and of the campaign's own; `findings` are those of
    all of them. `accepted_misfit` is the reason for which a contradicted result is used all the
    same.
    """

    method: str
    model: str
    state: State | None = None
    findings: list[Finding] = []
    accepted_misfit: str | None = None
    title: str = ""
    accelerometers: dict[str, AccelerometerResult]
    platform: dict[str, Coefficient] = {}
    confounded: list[ConfoundedTerms] = []
    runs: dict[str, RunResult]
    inputs: Inputs
    details: dict[str, str] = {}
    warnings: list[str] = []
    provenance: Provenance

    def faults(self) -> Iterator[str]:
        """Yield what would be applied or shown wrongly, though each part looks like one."""
        if not 0.0 < self.inputs.gravity < math.inf:
            yield f"the gravity is {self.inputs.gravity} m/s^2"
        if not self.accelerometers:
            yield "it has no accelerometers"
        for name, run in self.runs.items():
            if not 0.0 < abs(run.rate) < math.inf:
                yield f"the rate of {name} is {run.rate} rad/s"
        for name, accelerometer in self.accelerometers.items():
            yield from _faults_of(name, accelerometer)


read_result = Result.read
write_result = Result.write


def described(accelerometer: Accelerometer, shown: Collection[str]) -> dict[str, Any]:
    """Return what is needed of an accelerometer's description to apply its result without it.

    Parameters
    ----------
    accelerometer
        The description.
    shown
        The symbols of its coefficients, which are not repeated.

    Returns
    -------
    dict
        `serial_number`, `known`, `axes` and `observable` of `AccelerometerResult`.
    """
    return {
        "serial_number": accelerometer.serial_number,
        "known": {
            symbol: Coefficient(value=prior.value, u=prior.u, unit=prior.unit, estimated=False)
            for symbol, prior in accelerometer.priors.items()
            if symbol not in shown
        },
        "axes": list(accelerometer.mounting.axes),
        "observable": accelerometer.observable,
    }


def _faults_of(name: str, accelerometer: AccelerometerResult) -> Iterator[str]:
    if not accelerometer.coefficients:
        yield f"{name} has no coefficients"
    for symbol, c in {
        **accelerometer.known,
        **accelerometer.coefficients,
        **accelerometer.second_unknown,
    }.items():
        if symbol in TERMS and c.unit != TERMS[symbol].unit:
            yield f"{symbol} of {name} is in {c.unit}, not in {TERMS[symbol].unit}"
        if not (math.isfinite(c.value or 0.0) and 0.0 <= (c.u or 0.0) < math.inf):
            yield f"{symbol} of {name} is {c.value} ± {c.u}"
        if c.dof is not None and not 0.0 < c.dof < math.inf:
            yield f"{symbol} of {name} has {c.dof} degrees of freedom"
    if accelerometer.correlation:
        size = len(accelerometer.correlation.terms)
        if [len(row) for row in accelerometer.correlation.matrix] != [size] * size:
            yield f"the correlation matrix of {name} is not one of {size} terms"
    for run, trace in accelerometer.traces.items():
        if any(len(set(map(len, together))) > 1 for together in _drawn_together(trace)):
            yield f"lists in the trace of {name} in {run} are of unequal length"


def _drawn_together(trace: Trace) -> Iterator[tuple[Sized, ...]]:
    yield trace.time, trace.low, trace.high
    if (spectrum := trace.spectrum) is not None:
        yield spectrum.frequency, spectrum.power
    if (quantiles := trace.quantiles) is not None:
        yield quantiles.normal, quantiles.found

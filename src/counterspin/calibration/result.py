"""The result of a calibration: one object, its JSON, and reading it back.

The JSON is a contract with users' own programs: keys keep their names and meaning within one
`SCHEMA`, new keys may be added. Coefficients are in g-units of the stated gravity; everything
else is SI unless its unit stands beside it.

- `Result`; its parts are in `counterspin.calibration.result_parts`
- `described`: what a result repeats of an accelerometer's description
- `write_result`, `read_result`
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Collection, Iterator, Sized
from pathlib import Path
from typing import Annotated, Any, Final

from pydantic import Field, ValidationError

from counterspin.calibration.result_parts import (
    AccelerometerResult,
    Coefficient,
    ConfoundedTerms,
    Inputs,
    Provenance,
    ResultPart,
    RunResult,
    Trace,
)
from counterspin.campaign.resolved import Accelerometer
from counterspin.errors import RecordError
from counterspin.output import write_text
from counterspin.physics.accelerometer import TERMS

SCHEMA: Final = 1  #: version of the JSON

#: A list of numbers and nulls as it stands in JSON; no text has such line breaks in it.
_NUMBERS: Final = re.compile(r"\[\n[-+.\denul,\s]+\]")


class Result(ResultPart):
    """A calibration's result; see the parts."""

    schema_version: Annotated[int, Field(alias="schema")] = SCHEMA
    method: str
    model: str
    title: str = ""
    accelerometers: dict[str, AccelerometerResult]
    platform: dict[str, Coefficient] = Field(default={})
    confounded: list[ConfoundedTerms] = Field(default=[])
    runs: dict[str, RunResult]
    inputs: Inputs
    details: dict[str, str] = Field(default={})
    warnings: list[str] = Field(default=[])
    provenance: Provenance

    def to_json(self) -> str:
        """Return the JSON text, with a newline at the end; NaN and infinity become null."""
        text = self.model_dump_json(by_alias=True, indent=1)
        # A list of numbers is one line, however many they are.
        return _NUMBERS.sub(lambda found: re.sub(r"\s+", " ", found[0]), text) + "\n"


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


def write_result(result: Result, path: Path | str) -> None:
    """Write the JSON file, whole or not at all; raises CounterspinError if it cannot."""
    write_text(Path(path), result.to_json())


def read_result(path: Path | str) -> Result:
    """Read a result file.

    Raises
    ------
    RecordError
        If the file is missing, damaged, of a newer schema or not a result.
    """
    path = Path(path)
    try:
        document = json.loads(path.read_text(encoding="utf-8"), parse_constant=_not_a_number)
    except OSError as error:
        raise RecordError(f"{path}: cannot be read ({error.strerror})") from error
    except (ValueError, RecursionError) as error:
        raise RecordError(
            f"{path}: not a result file, or a damaged one ({error}); write it again with "
            "`write_result`"
        ) from error
    schema = document.get("schema") if isinstance(document, dict) else None
    if isinstance(schema, int) and schema > SCHEMA:
        raise RecordError(
            f"{path}: written by a newer counterspin (schema {schema}; this one reads up to "
            f"{SCHEMA}); update counterspin"
        )
    try:
        result = Result.model_validate(document)
    except ValidationError as error:
        first = error.errors()[0]
        where = "".join(f"{key}: " for key in first["loc"])
        raise RecordError(f"{path}: not a result file: {where}{first['msg']}") from error
    for fault in _faults(result):
        raise RecordError(f"{path}: a damaged result: {fault}")
    return result


def _not_a_number(word: str) -> None:
    raise ValueError(f"{word} is not a number that JSON knows")


def _faults(result: Result) -> Iterator[str]:
    """Yield what would be applied or shown wrongly, though each part looks like one."""
    if not 0.0 < result.inputs.gravity < math.inf:
        yield f"the gravity is {result.inputs.gravity} m/s^2"
    if not result.accelerometers:
        yield "it has no accelerometers"
    for name, run in result.runs.items():
        if not 0.0 < abs(run.rate) < math.inf:
            yield f"the rate of {name} is {run.rate} rad/s"
    for name, found in result.accelerometers.items():
        yield from _faults_of(name, found)


def _faults_of(name: str, found: AccelerometerResult) -> Iterator[str]:
    if not found.coefficients:
        yield f"{name} has no coefficients"
    for symbol, c in {**found.known, **found.coefficients, **found.second_unknown}.items():
        if symbol in TERMS and c.unit != TERMS[symbol].unit:
            yield f"{symbol} of {name} is in {c.unit}, not in {TERMS[symbol].unit}"
        if not (math.isfinite(c.value or 0.0) and 0.0 <= (c.u or 0.0) < math.inf):
            yield f"{symbol} of {name} is {c.value} ± {c.u}"
        if c.dof is not None and not 0.0 < c.dof < math.inf:
            yield f"{symbol} of {name} has {c.dof} degrees of freedom"
    if found.correlation:
        size = len(found.correlation.terms)
        if [len(row) for row in found.correlation.matrix] != [size] * size:
            yield f"the correlation matrix of {name} is not one of {size} terms"
    for run, trace in found.traces.items():
        if any(len(set(map(len, together))) > 1 for together in _drawn_together(trace)):
            yield f"lists in the trace of {name} in {run} are of unequal length"


def _drawn_together(trace: Trace) -> Iterator[tuple[Sized, ...]]:
    yield trace.time, trace.low, trace.high
    if (spectrum := trace.spectrum) is not None:
        yield spectrum.frequency, spectrum.power
    if (quantiles := trace.quantiles) is not None:
        yield quantiles.normal, quantiles.found

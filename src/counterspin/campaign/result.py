"""The result of a calibration: one object, its JSON, and reading it back.

The JSON is a contract with users' own programs: keys keep their names and meaning within one
`SCHEMA`, new keys may be added. Coefficients are in g-units of the stated gravity; everything
else is SI unless its unit stands beside it.

- `Result` and its parts
- `described`: what a result repeats of an accelerometer's description
- `write_result`, `read_result`
"""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from counterspin.campaign.output import write_text
from counterspin.campaign.resolved import Accelerometer
from counterspin.errors import RecordError
from counterspin.physics.accelerometer import TERMS

SCHEMA: Final = 1  #: version of the JSON


class Part(BaseModel):
    """A part of the result; unknown keys are kept out so that a slip is seen at once."""

    model_config = ConfigDict(extra="forbid", frozen=True, ser_json_inf_nan="null")


class Coefficient(Part):
    """One coefficient and where its uncertainty comes from.

    Attributes
    ----------
    value, u
        Estimate and combined standard uncertainty; None if the data do not determine the
        coefficient and nothing is known beforehand. If not `estimated`, the prior.
    u_noise, u_prior, u_considered
        Parts of `u` from the records' noise, from priors of estimated terms, and from considered
        terms and uncertain inputs; u^2 is the sum of their squares.
    dof
        Effective degrees of freedom; None is infinite. Intervals use Student's t.
    unit
        g-units, or SI for platform terms.
    estimated
        Whether the data determine it.
    """

    value: float | None
    u: float | None
    u_noise: float | None = None
    u_prior: float | None = None
    u_considered: float | None = None
    dof: float | None = None
    unit: str
    estimated: bool


class Correlation(Part):
    """Correlation matrix of the estimated coefficients, rows in the order of `terms`."""

    terms: list[str]
    matrix: list[list[float]]


class Confounded(Part):
    """Terms that the data cannot tell apart, or hardly, and the combination they do determine.

    `correlation` is that of the data alone, priors left aside.
    """

    terms: list[str]
    correlation: float
    determined: str
    value: float | None = None
    u: float | None = None


class Residual(Part):
    """Size of the residuals and how well the model fits.

    `chi2` and `lack_of_fit_p` need a noise that was given; they are None where it was estimated
    from these residuals.
    """

    rms: float
    unit: str
    dof: float
    chi2: float | None = None
    lack_of_fit_p: float | None = None


class BudgetLine(Part):
    """One source of uncertainty: contribution = |sensitivity| x u; share of u^2.

    For noise the sensitivity is None: it is a different one for every sample.
    """

    source: str
    u: float | None
    unit: str
    sensitivity: float | None
    contribution: float
    share: float


class NoiseLine(Part):
    """One noise component: its size, whether it was estimated, and its uncertainty then."""

    value: float
    u: float | None = None
    unit: str
    estimated: bool


class Jackknife(Part):
    """K_II with one run left out; `z` is its shift over the shift's standard uncertainty."""

    run: str
    value: float | None
    shift: float | None
    z: float | None


class Comparison(Part):
    """K_II by the two-stage method beside the joint fit; `z` is the difference over its u."""

    value: float
    u: float
    difference: float
    u_difference: float
    z: float


class LeftOut(Part):
    """A term that the model leaves out: what one unit of it would move K_II by, in g/g^2."""

    sensitivity: float
    unit: str


class AccelerometerResult(Part):
    """All that was found out about one accelerometer.

    Attributes
    ----------
    coefficients
        The terms that the campaign asked for.
    known
        Further terms of which something is known beforehand, as the campaign states it; the fit
        has taken their values away.
    axes
        Where the input, pendulous and output axes point, as rows, in east-north-up while the
        platform is level.
    observable
        What was recorded: ``displacement``, ``velocity`` or ``specific_force``.
    """

    coefficients: dict[str, Coefficient]
    known: dict[str, Coefficient] = {}
    axes: list[tuple[float, float, float]] | None = None
    observable: str | None = None
    correlation: Correlation | None
    confounded: list[Confounded] = []
    residual: Residual
    noise: dict[str, NoiseLine] = {}
    budget: dict[str, list[BudgetLine]] = {}
    second_unknown: dict[str, Coefficient] = {}
    jackknife: list[Jackknife] = []
    two_stage: Comparison | None = None
    left_out: dict[str, LeftOut] = {}
    warnings: list[str] = []


class RippleResult(Part):
    """One ripple of the rate; amplitude in rad/s, phase in rad."""

    harmonic: int
    amplitude: float
    u_amplitude: float
    phase: float
    u_phase: float | None


class ParabolaResult(Part):
    """First stage of the two-stage method: b0 (m), b1 (m/s), b2 (m/s^2) of one accelerometer."""

    b0: float
    b1: float
    b2: float
    u_b2: float
    sigma: float
    sigma_from_residuals: bool
    strobes: int


class RunResult(Part):
    """What one run showed: its rotation, its samples, its own terms.

    `rejected` counts every sample, of any accelerometer, that was recorded but not used: repeated
    rows, empty cells and outliers; `counts` says how many of each.
    """

    rate: float
    u_rate: float | None = None
    rate_unit: Literal["rad/s"] = "rad/s"
    drift: float
    u_drift: float | None = None
    drift_unit: Literal["1/s"] = "1/s"
    ripples: list[RippleResult] = []
    angle_rms: float | None = None
    samples: int
    rejected: int
    counts: dict[str, int] = {}
    notes: list[str] = []
    terms: dict[str, Coefficient] = {}
    parabolas: dict[str, ParabolaResult] = {}
    fit: dict[str, dict[str, float | str | None]] = {}


class Inputs(Part):
    """What the result depends on beside the records."""

    gravity: float
    gravity_unit: Literal["m/s^2"] = "m/s^2"
    latitude: float
    latitude_unit: Literal["rad"] = "rad"
    radius: float
    radius_unit: Literal["m"] = "m"


class Provenance(Part):
    """Program version and SHA-256 of every input file."""

    version: str
    inputs: dict[str, str]


class Result(Part):
    """A calibration's result; see the parts."""

    schema_version: Annotated[int, Field(alias="schema")] = SCHEMA
    method: str
    model: str
    title: str = ""
    accelerometers: dict[str, AccelerometerResult]
    platform: dict[str, Coefficient] = {}
    confounded: list[Confounded] = []
    runs: dict[str, RunResult]
    inputs: Inputs
    details: dict[str, str] = {}
    warnings: list[str] = []
    provenance: Provenance

    def to_json(self) -> str:
        """Return the JSON text, with a newline at the end; NaN and infinity become null."""
        return self.model_dump_json(by_alias=True, indent=1) + "\n"


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
        `known`, `axes` and `observable` of `AccelerometerResult`.
    """
    return {
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
    except ValueError as error:
        raise RecordError(
            f"{path}: not a result file, or a damaged one ({error}); write it again with "
            "`counterspin calibrate DIR --json FILE`"
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
    """Yield what would be applied wrongly, though each part looks like one."""
    for name, found in result.accelerometers.items():
        if not found.coefficients:
            yield f"{name} has no coefficients"
        for symbol, c in {**found.known, **found.coefficients}.items():
            if symbol in TERMS and c.unit != TERMS[symbol].unit:
                yield f"{symbol} of {name} is in {c.unit}, not in {TERMS[symbol].unit}"
            if not (math.isfinite(c.value or 0.0) and 0.0 <= (c.u or 0.0) < math.inf):
                yield f"{symbol} of {name} is {c.value} ± {c.u}"
        if found.correlation:
            size = len(found.correlation.terms)
            if [len(row) for row in found.correlation.matrix] != [size] * size:
                yield f"the correlation matrix of {name} is not one of {size} terms"

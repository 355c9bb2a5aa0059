"""The parts that a result is made of; `counterspin.calibration.result` puts them together.

Coefficients are in g-units of the stated gravity; everything else is SI unless its unit stands
beside it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from pydantic import PrivateAttr, field_validator

from counterspin.arrays import Array
from counterspin.calibration.si_estimates import SiEstimate, StatedGravity, si_estimate
from counterspin.campaign.quantity import Quantity
from counterspin.characters import escape_controls
from counterspin.frozen import frozen
from counterspin.inference.distributions import expanded_uncertainty
from counterspin.inference.identifiability import ConfoundedTerms
from counterspin.inference.joint.summary import BudgetLine, Jackknife, Kind, WhatIf
from counterspin.inference.verdicts import Conformity
from counterspin.loading import load_name
from counterspin.reports.numbers import NOT_DETERMINED, field_unit, format_compact
from counterspin.results import NamedParts, ResultPart
from counterspin.units import unit_factor

if TYPE_CHECKING:
    import polars as pl

#: Whether what a calibration says may be relied on: fully, with what its findings say in mind, or
#: not, for its records contradict it.
State = Literal["good", "reservations", "not-determined", "contradicted"]


class Coefficient(ResultPart):
    """One coefficient and where its uncertainty comes from."""

    #: The estimate; the prior if not `estimated`; None if the records do not determine it and
    #: nothing is known beforehand.
    value: float | None
    #: Combined standard uncertainty; u^2 is the sum of the squares of its three parts.
    u: float | None
    #: Its part from noise of the records and of the encoder, with noise that may not show in them.
    u_noise: float | None = None
    #: Its part from what the description states with an uncertainty: priors, inputs, held terms.
    u_stated: float | None = None
    u_unstated: float | None = None  #: Its part from what it does not state, at typical sizes.
    #: Effective degrees of freedom of `u`, for Student's t; None is infinite, or more than 1e9.
    dof: float | None = None
    unit: str  #: Of value and uncertainties: g-units, or SI for platform terms.
    estimated: bool  #: Whether the records determine it.

    _gravity: StatedGravity | None = PrivateAttr(default=None)

    def __str__(self) -> str:
        """Return such as ``27.04160(72) ug/g^2``, in the unit of the field."""
        unit, factor = field_unit(self.unit)
        if self.value is None or self.u is None:
            return NOT_DETERMINED
        text = f"{format_compact(self.value * factor, self.u * factor)} {unit}"
        return text if self.estimated else f"{text} (prior, {NOT_DETERMINED})"

    __repr__ = __str__

    def interval(self, coverage: float = 0.95) -> tuple[float, float]:
        """Return the coverage interval by Student's t, in `unit` (GUM G.3).

        coverage: Its probability, between 0 and 1.
        """
        if not 0.0 < coverage < 1.0:
            raise ValueError(f"a coverage probability lies between 0 and 1; got {coverage}")
        value, u = self._stated()
        half = expanded_uncertainty(u, self.dof, coverage)
        return value - half, value + half

    def in_units(self, unit: str | None = None) -> Quantity:
        """Return value and uncertainty in another unit of the same kind; `to_si` leads to SI.

        unit: Such as ``ug/g^2`` or ``arcsec``. None: the one in which tables and texts show it.
        """
        value, u = self._stated()
        shown, factor = field_unit(self.unit)
        if unit is not None:
            shown, factor = unit, unit_factor(self.unit, unit)
        return Quantity(value * factor, u * factor, shown)

    def to_si(self, gravity: float | None = None) -> SiEstimate:
        """Return the coefficient in SI, where much of what an uncertain g does to it cancels.

        gravity: An exact g of the unit, m/s^2. None: that of the result which the coefficient is
            of.
        """
        stated = self._gravity if gravity is None else StatedGravity(gravity)
        if stated is None:
            raise ValueError(
                "this coefficient belongs to no result: give the `gravity` of its unit"
            )
        return si_estimate(*self._stated(), self.unit, self.dof, stated)

    def _stated(self) -> tuple[float, float]:
        if self.value is None or self.u is None:
            raise ValueError("the records do not determine this coefficient")
        return self.value, self.u


class Correlation(ResultPart):
    """Correlation matrix of the estimated coefficients, rows in the order of `terms`."""

    terms: list[str]  #: Order of rows and columns.
    matrix: list[list[float]]  #: Correlation coefficients.

    def frame(self) -> pl.DataFrame:
        """Return a polars frame: the names in the column ``term``, and a column for each."""
        return matrix_frame(self.terms, np.array(self.matrix))


@frozen(eq=False)
class Covariance:
    """Covariance matrix of the coefficients of a result."""

    terms: tuple[str, ...]  #: Names such as ``Qx.K_II``, p of them.
    matrix: Array  #: Covariances in the units of the coefficients, shape (p, p).
    units: tuple[str, ...]  #: Those units, p of them.

    def frame(self) -> pl.DataFrame:
        """Return a polars frame: the names in the column ``term``, and a column for each."""
        return matrix_frame(self.terms, self.matrix)


def matrix_frame(terms: Sequence[str], matrix: Array) -> pl.DataFrame:
    """Return a square matrix as a polars frame with the names of its rows and columns."""
    import polars as pl

    return pl.DataFrame({"term": terms, **dict(zip(terms, matrix.T, strict=True))})


class Residual(ResultPart):
    """Size of the residuals and how well the model fits.

    `chi2` and `lack_of_fit_p` need a noise that was given; they are None where it was estimated
    from these residuals.
    """

    rms: float  #: Root mean square of the residuals.
    unit: str  #: Of the root mean square.
    dof: float  #: Degrees of freedom.
    chi2: float | None = None  #: Against the noise that was given; null where it was estimated.
    lack_of_fit_p: float | None = None  #: Probability of a worse fit if the model is right.


class Knowledge(ResultPart):
    """What a result rests on beside its data: a term or an input that nobody asked for."""

    #: Such as ``Qx.K_OO`` or ``run1.platform.tilt.north``; SI, or g-units.
    name: str
    kind: Kind  #: Whether it is stated, unstated or held.
    unit: str  #: Of the numbers: SI, or g-units.
    value: float  #: Before the data: as the description states it, else what it ideally is.
    u: float  #: Its standard uncertainty there: as stated, else the typical size.
    found: float | None = None  #: After the data, in the same fit; None where it was held.
    u_found: float | None = None  #: Its standard uncertainty then.


class NoiseLine(ResultPart):
    """One noise component: its size, whether it was estimated, and its uncertainty then."""

    value: float  #: Standard deviation a sample; of ``acceleration``, the random-walk coefficient.
    u: float | None = None  #: Its uncertainty where it was estimated, or found in another record.
    unit: str  #: Of value and uncertainty.
    estimated: bool  #: Whether it was estimated from the residuals; else as given.
    #: The record at rest that it was found in; None where it was stated or estimated.
    record: str | None = None
    #: By run: its own size, where runs differ; `value` is then the rms over the rows of all.
    runs: dict[str, float] = {}


class Comparison(ResultPart):
    """K_II by the two-stage method beside the joint fit; `z` is the difference over its u."""

    value: float  #: K_II by the two-stage method.
    u: float  #: Its standard uncertainty.
    difference: float  #: Its difference from the joint K_II.
    u_difference: float  #: Standard uncertainty of the difference.
    z: float  #: Difference over its uncertainty; beyond 3 they do not agree.


class Finding(ResultPart):
    """One thing that speaks against a result, whatever its checks saw of it."""

    code: str  #: What kind of thing, such as ``lack-of-fit``; stays the same.
    #: What it concerns: an accelerometer, one of its coefficients (``Qx.K_II``), a run, a platform
    #: term, or empty: the campaign.
    subject: str
    text: str  #: In sentences: what was found, and what to do.
    #: How strong it is, in standard uncertainties or in units of what would be expected; None where
    #: it has no size.
    size: float | None = None
    #: Whether the records contradict the result, so that it must not be used.
    contradicts: bool = False
    #: Whether the state is ``not-determined`` because of it: the coefficient is the campaign's
    #: purpose, or ``[model] terms`` names it. Of other coefficients this is information.
    undetermined: bool = False
    #: Of a cause: what else was found and would not be if this were put right.
    explains: list[Finding] = []
    #: Of a cause: subjects of others that would explain the records as well, the likeliest first.
    as_well: list[str] = []


class Fold(ResultPart):
    """Residuals against the spindle's angle: equal parts of a revolution from angle 0 on.

    A part without a sample has None.
    """

    low: list[float | None]  #: Smallest residual.
    mean: list[float | None]  #: Mean residual.
    high: list[float | None]  #: Largest residual.


class Spectrum(ResultPart):
    """Spectrum of whitened residuals; frequency in Hz, power 1 for white noise.

    `lines` counts those of the periodogram of which each power is the mean.
    """

    frequency: list[float]  #: Middle of each band, Hz.
    power: list[float]  #: Mean power in it; 1 for white noise.
    lines: list[int] = []  #: How many lines of the periodogram that is the mean of.


class Quantiles(ResultPart):
    """Ordered whitened residuals beside what a standard normal distribution would show."""

    normal: list[float]  #: What a standard normal distribution would show.
    found: list[float]  #: Ordered whitened residuals.


class Trace(ResultPart):
    """The residuals of one accelerometer in one run, thinned for pictures."""

    rows: int | None = None  #: How many residuals there are.
    rms: float | None = None  #: Their root mean square, in the observable's unit.
    time: list[float]  #: Middle of each stretch, s from the start of the run.
    low: list[float]  #: Smallest residual in it, in the observable's unit.
    high: list[float]  #: Largest residual in it, in the observable's unit.
    #: Time and residual of samples taken for outliers, the largest ones if there are many.
    left_out: list[tuple[float, float]] = []
    by_angle: Fold | None = None  #: The residuals over the revolution.
    spectrum: Spectrum | None = None  #: Of the whitened residuals.
    quantiles: Quantiles | None = None  #: Of the whitened residuals.


class NominalOutput(ResultPart):
    """By which an output is taken for a specific force, g: (output - zero) / sensitivity."""

    unit: str  #: Of the output.
    sensitivity: float  #: Output per g; K_I is the true one over it.
    zero: float = 0.0  #: Output where no force is felt; K_F is what is there beside it.

    @property
    def words(self) -> str:
        """Such as ``1.25 mA/g from 4 mA``."""
        start = f" from {self.zero:.9g} {self.unit}" if self.zero else ""
        return f"{self.sensitivity:.9g} {self.unit}/g{start}"


class ReadingResult(ResultPart):
    """One reading: value, standard uncertainty and residual in g; `z` is None where it fits wholly.

    `rate` in rad/s; `z` over the residual's own standard deviation. Axes: east, north, up; outward,
    forward, up on an arm. `samples` used, `counts`, `notes` of a record's mean: as of `RunResult`.
    """

    name: str  #: Of the run or the row.
    motion: str  #: ``static``, ``arm`` or ``counter-rotating``.
    mounting: str = ""  #: Of the instrument on the arm; empty where none is named.
    #: Its direction: east, north, up; on an arm outward, forward, up.
    input_axis: tuple[float, ...] = ()
    pendulous_axis: tuple[float, ...] = ()  #: That of its pendulum, likewise.
    rate: float  #: Of the spindle, rad/s.
    value: float  #: By the nominal sensitivity, g.
    u: float  #: Its standard uncertainty, stated or estimated, g.
    residual: float  #: Reading less model, g.
    #: Residual over its own standard deviation; null where the fit follows the reading wholly.
    z: float | None
    samples: int | None = None  #: Rows used of a record whose mean it is; else null.
    #: Of its rows those that are ``repeated``, ``empty`` or ``outliers``, and ``gaps``; empty where
    #: it is no mean of a record.
    counts: dict[str, int] = {}
    notes: list[str] = []  #: What reading the record found.


class PoseResult(ResultPart):
    """One pose of a triad at an unknown attitude, in g.

    `z` is the residual over its own standard deviation, None where the fit follows it wholly.
    """

    name: str  #: Of the run or the row; of a pose in a record, when it begins too.
    start: float | None = None  #: When it begins in its record, s; null of what was read.
    end: float | None = None  #: When it ends there, s.
    samples: int | None = None  #: Rows of the record that it is the mean of.
    values: tuple[float, ...]  #: Indications by the nominal sensitivities, in the triad's order.
    #: Where the specific force points in the triad's frame, as the fit has found it.
    direction: tuple[float, ...]
    residual: float  #: Indication less model along the force.
    u: float  #: Standard uncertainty of what is indicated along the force, stated or estimated.
    z: float | None  #: Residual over its own standard deviation.


class PosesInRecord(ResultPart):
    """What was found in a record with poses."""

    poses: int  #: How many were taken.
    threshold: float  #: Scatter below which the triad rests, m/s^2.
    #: Scatter in motion over that at rest, in the median; null where nothing moves.
    contrast: float | None
    notes: list[str] = []  #: Rests that were left out, and what makes the threshold doubtful.
    time: list[float] = []  #: Where parts of the record begin, s, to draw the search for rest.
    #: Largest scatter of the three together in each part, m/s^2, which is held to the threshold.
    level: list[float] = []


class TriadResult(ResultPart):
    """Three accelerometers of one sensor in one frame.

    The parameters are those of NIST: ``offset.X`` (g), ``sensitivity.X`` (g/g) and ``angle.X.Y``
    (rad) between the axes along which two of them feel; beside them second-order terms of the
    accelerometers that were asked for, such as ``X.K_II``.
    """

    accelerometers: list[str]  #: Their names, in the order of all that follows.
    parameters: dict[str, Coefficient]  #: Offsets, sensitivities, angles; second-order terms.
    correlation: Correlation | None = None  #: Of those that are determined.
    #: Where the u of each of these comes from, the largest part first, terms named in full; empty
    #: in files of earlier versions.
    budget: dict[str, list[BudgetLine]] = {}
    #: What each of these moves by per m/s^2 of the g assumed; empty where g is exact.
    by_gravity: dict[str, float] = {}
    #: f = matrix (y - bias): the specific force in the triad's frame, g, of the indications y by
    #: the nominal sensitivities, g; null where the matrix is not determined.
    matrix: list[list[float]] | None = None
    u_matrix: list[list[float]] | None = None  #: Standard uncertainties of the matrix.
    bias: list[float] | None = None  #: The three offsets, g; null with the matrix.
    #: Why the matrix is not given; null where it is given, and in files of earlier versions.
    why_no_matrix: str | None = None
    #: Root mean square over the poses of the size of f less g, by the nominal sensitivities, m/s^2;
    #: null without poses.
    rms_before: float | None = None
    #: The same by matrix and bias, once second-order terms that were asked for are taken away.
    rms_after: float | None = None
    poses: list[PoseResult] = []  #: Those at unknown attitudes.
    records: dict[str, PosesInRecord] = {}  #: By run: records in which poses were found.

    def frame(self, library: str = "polars") -> Any:
        """Return the parameters as a frame with the columns of `Result.frame`.

        Parameters
        ----------
        library
            ``polars`` or ``pandas``.

        Returns
        -------
        polars.DataFrame or pandas.DataFrame
            The owner is ``triad``, the term such as ``angle.X.Y``; in the units of the field.
        """
        made = load_name("counterspin.calibration.result_conversion:rows_frame")
        return made((("triad", n, c) for n, c in self.parameters.items()), library)

    def __repr__(self) -> str:
        """Return the parameters, a line each, and what the poses were off before and are now."""
        lines = [f"Triad {', '.join(self.accelerometers)}: {len(self.poses)} poses"]
        width = max(map(len, self.parameters), default=0)
        lines += [
            f"  {escape_controls(name):<{width}}  {c!r}" for name, c in self.parameters.items()
        ]
        if self.rms_before is not None and self.rms_after is not None:
            rms = f"{self.rms_before:.3g} m/s^2 before, {self.rms_after:.3g} m/s^2 after"
            lines.append(f"  rms of |f| - g: {rms}")
        return "\n".join(lines)

    __str__ = __repr__


class Shift(ResultPart):
    """How far a coefficient moves when something is left out; `z` is the shift over its u."""

    shift: float  #: Estimate without it less the estimate from everything.
    u: float  #: Standard uncertainty of the shift, what both share counted once.
    z: float  #: Shift over its u.


class MethodAgreement(ResultPart):
    """What one test method says of an accelerometer, and how far it agrees with the others."""

    kind: str  #: ``at rest``, ``arm`` or ``double turntable``.
    count: int  #: Of its records and readings.
    #: By this method alone, with all that is known beforehand, without `dof`; None where it does
    #: not determine one.
    coefficients: dict[str, Coefficient]
    #: By coefficient that the others determine: how far it moves when this method is left out.
    without: dict[str, Shift] = {}
    chi2: float  #: Squares of what the method says less what the others predict, over variances.
    dof: int  #: In how many directions both know something.
    p: float | None  #: Probability of more if they agree; None where the others predict nothing.


class AccelerometerResult(ResultPart):
    """All that was found out about one accelerometer."""

    #: Whether it may be relied on: ``good``, ``reservations``, ``not-determined`` or
    #: ``contradicted``.
    state: State | None = None
    findings: list[Finding] = []  #: What speaks against it, the gravest first.
    #: Single faults of typical size that the residuals of its readings would not show, and by how
    #: much each would move a coefficient; the worst first.
    unseen_faults: list[str] = []
    serial_number: str | None = None  #: As the campaign states it.
    #: The terms that the campaign asked for.
    coefficients: dict[str, Coefficient]
    #: Further terms of which something is known beforehand, as the campaign states it; the fit has
    #: taken their values away.
    known: dict[str, Coefficient] = {}
    #: Where the input, pendulous and output axes point, as rows, in east-north-up while the
    #: platform is level.
    axes: list[tuple[float, float, float]] | None = None
    #: What was recorded: ``displacement``, ``velocity`` or ``specific_force``.
    observable: str | None = None
    correlation: Correlation | None  #: Of the estimated coefficients; None if there are none.
    confounded: list[ConfoundedTerms] = []  #: Terms that cannot be told apart.
    residual: Residual  #: How well the model fits.
    noise: dict[str, NoiseLine] = {}  #: By component: the noise that was used.
    budget: dict[str, list[BudgetLine]] = {}  #: By term: where the uncertainty comes from.
    #: What an update of the uncertainties needs if something were known better; None where nothing
    #: that counts could be.
    what_if: WhatIf | None = None
    #: What the two-stage method estimated beside K_II and K_F.
    second_unknown: dict[str, Coefficient] = {}
    jackknife: list[Jackknife] = []  #: K_II with each run left out, joint method.
    two_stage: Comparison | None = None  #: The two-stage K_II beside the joint one, joint method.
    conformity: dict[str, Conformity] = {}  #: By term: where the campaign states a specification.
    traces: dict[str, Trace] = {}  #: By run: residuals thinned for pictures, joint method.
    readings: list[ReadingResult] = []  #: Single values, at rest, on an arm or on a turntable.
    #: Each test method beside the others; empty where there is one only.
    kinds: list[MethodAgreement] = []
    #: ``bias`` and ``scale_factor`` in the unit of its readings; empty where that is g.
    output: dict[str, Coefficient] = {}
    #: By what its readings, and an output such as a current, were taken for a specific force; null
    #: where they are in g or m/s^2.
    nominal: NominalOutput | None = None
    warnings: list[str] = []  #: The findings in words.

    @field_validator("coefficients")
    @classmethod
    def _suggest_names(cls, parts: dict[str, Any]) -> dict[str, Any]:
        return NamedParts(parts)

    def __repr__(self) -> str:
        """Return state and coefficients, a line each."""
        width = max(map(len, self.coefficients), default=0)
        lines = [f"{symbol.ljust(width)}  {c}" for symbol, c in self.coefficients.items()]
        return "\n".join([f"Accelerometer, {self.state or 'not judged'}", *lines])

    __str__ = __repr__


class RippleResult(ResultPart):
    """One ripple of the rate; amplitude in rad/s, phase in rad."""

    harmonic: int  #: Times a revolution.
    amplitude: float  #: Amplitude w_n of the rate, rad/s.
    u_amplitude: float  #: Its standard uncertainty.
    phase: float  #: Its phase at time zero, rad.
    u_phase: float | None  #: Its standard uncertainty.


class ParabolaResult(ResultPart):
    """First stage of the two-stage method: b0 (m), b1 (m/s), b2 (m/s^2) of one accelerometer."""

    b0: float  #: Its constant part, m.
    b1: float  #: Its linear part, m/s.
    b2: float  #: Its quadratic part, m/s^2.
    u_b2: float  #: Standard uncertainty of b2 (Eq. 31).
    sigma: float  #: Standard deviation of a sample, m.
    sigma_from_residuals: bool  #: Whether that is from the residuals; else as given.
    strobes: int  #: How many strobes it was fitted to.


class RunResult(ResultPart):
    """What one run showed: its rotation, its samples, its own terms.

    `rejected` counts every sample, of any accelerometer, that was recorded but not used: repeated
    rows, empty cells and outliers; `counts` says how many of each.
    """

    rate: float  #: Identified rate w0, in `rate_unit`.
    u_rate: float | None = None  #: Its standard uncertainty; null without a recorded angle.
    rate_unit: Literal["rad/s"] = "rad/s"  #: Of the rate and its uncertainty.
    drift: float  #: Relative drift C of the rate, in `drift_unit`.
    u_drift: float | None = None  #: Its standard uncertainty.
    drift_unit: Literal["1/s"] = "1/s"  #: Of the drift and its uncertainty.
    ripples: list[RippleResult] = []  #: Fluctuations of the rate that the angle supports.
    angle_rms: float | None = None  #: Recorded angle less its model, rad.
    samples: int  #: Rows used.
    rejected: int  #: Samples not used: repeated rows, empty cells, outliers.
    #: By kind, how many of each; ``block`` is the number of rows averaged.
    counts: dict[str, int] = {}
    notes: list[str] = []  #: What reading the record found.
    terms: dict[str, Coefficient] = {}  #: Coefficients of this run, such as its tilt.
    parabolas: dict[str, ParabolaResult] = {}  #: By accelerometer, two-stage method.
    #: By accelerometer, tests of the residuals: chi-square, signs, largest peak of the spectrum.
    fit: dict[str, dict[str, float | str | None]] = {}


class Inputs(ResultPart):
    """What the result depends on beside the records; u is 0 where it was stated as exact."""

    gravity: float  #: The g of all g-units, in `gravity_unit`.
    u_gravity: float = 0.0  #: Its standard uncertainty; 0 where it was stated as exact.
    gravity_unit: Literal["m/s^2"] = "m/s^2"  #: Of gravity and its uncertainty.
    latitude: float  #: Of the site, in `latitude_unit`.
    u_latitude: float = 0.0  #: Its standard uncertainty.
    latitude_unit: Literal["rad"] = "rad"  #: Of the latitude and its uncertainty.
    radius: float  #: Of the centrifuge, in `radius_unit`.
    u_radius: float = 0.0  #: Its standard uncertainty.
    radius_unit: Literal["m"] = "m"  #: Of the radius and its uncertainty.
    #: From which slopes with temperature count, K; null where no temperature was stated.
    reference_temperature: float | None = None
    #: The lowest and the highest of its runs and readings, K; empty where none was stated.
    temperatures: list[float] = []


class Provenance(ResultPart):
    """What made the result: program, options and inputs."""

    version: str  #: Of counterspin.
    #: By file, its SHA-256; of what was in memory, that of the file's text as it would be written,
    #: or of the arrays.
    inputs: dict[str, str]
    #: Those of them that no file says, and why: ``made in Python``, ``changed`` and the keys, or
    #: ``arrays``.
    in_memory: dict[str, str] = {}
    options: list[str] = []  #: Of the command, as they are typed, where they are not the defaults.
    #: What computed it beside counterspin: Python, NumPy, SciPy and the machine; empty in results
    #: of versions that did not state it.
    environment: dict[str, str] = {}

    @property
    def shown(self) -> list[tuple[str, str]]:
        """The inputs as a report lists them, each with its checksum."""
        return [
            (f"{name} (in memory)" if name in self.in_memory else name, checksum)
            for name, checksum in self.inputs.items()
        ]

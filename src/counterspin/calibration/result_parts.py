"""The parts of a result; see `counterspin.calibration.result`.

Coefficients are in g-units of the stated gravity; all other numbers are in SI units unless a unit
is given.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from pydantic import PrivateAttr, field_validator

from counterspin.arrays import Array
from counterspin.calibration.si_estimates import SiEstimate, StatedGravity, convert_to_si
from counterspin.campaign.quantity import Quantity
from counterspin.characters import escape_controls
from counterspin.frozen import frozen
from counterspin.inference.distributions import expanded_uncertainty
from counterspin.inference.identifiability import ConfoundedTerms
from counterspin.inference.joint.summary import BudgetLine, Jackknife, Kind, WhatIf
from counterspin.inference.verdicts import Conformity
from counterspin.loading import load_name
from counterspin.reports.numbers import NOT_DETERMINED, find_display_unit, format_compact
from counterspin.results import NamedParts, ResultPart
from counterspin.units import unit_factor

if TYPE_CHECKING:
    import polars as pl

#: State of a result: usable, usable with reservations (see the findings), not fully determined, or
#: contradicted by the records.
State = Literal["good", "reservations", "not-determined", "contradicted"]


class MonteCarloInterval(ResultPart):
    """Coverage interval of a coefficient by Monte Carlo (JCGM 101), probability 95 %."""

    trials: int  #: Number of trials.
    u: float  #: Standard deviation of the coefficient over the trials.
    low: float  #: Lower end of the shortest interval.
    high: float  #: Upper end of the shortest interval.
    tolerance: float  #: Half a unit of the second significant digit of the coefficient's u.
    #: Whether both ends agree with the GUM interval, `Coefficient.interval`, within `tolerance`
    #: (JCGM 101, 8.2); null if there are too few trials to decide.
    gum_validated: bool | None = None
    #: Largest difference between the linear prediction and full fits with one source shifted
    #: by ±2 u.
    linear_difference: float | None = None
    #: Sources whose difference exceeds `tolerance`; trials include their second-order effects.
    second_order: list[str] = []
    #: Largest difference with all sources shifted together; null for fewer than two sources.
    joint_difference: float | None = None


class Coefficient(ResultPart):
    """One coefficient with its uncertainty contributions."""

    #: Estimate, or the prior value if `estimated` is false; null if the records do not determine
    #: the coefficient and it has no prior.
    value: float | None
    u: float | None  #: Combined standard uncertainty; u^2 = u_noise^2 + u_stated^2 + u_unstated^2.
    #: Contribution to u from the noise of the records and the encoder, including noise that the
    #: records may not reveal.
    u_noise: float | None = None
    #: Contribution to u from stated uncertainties: priors, inputs and considered (held) terms.
    u_stated: float | None = None
    #: Contribution to u from the default standard uncertainties of unstated terms and inputs.
    u_unstated: float | None = None
    #: Effective degrees of freedom of u (Student's t); null means infinite or more than 1e9.
    dof: float | None = None
    unit: str  #: Unit of the value and its uncertainties: g-units, or SI units for platform terms.
    estimated: bool  #: Whether the records determine the coefficient.

    _gravity: StatedGravity | None = PrivateAttr(default=None)

    def __str__(self) -> str:
        """Return such as ``27.04160(72) ug/g^2``, in the unit of the field."""
        unit, factor = find_display_unit(self.unit)
        if self.value is None or self.u is None:
            return NOT_DETERMINED
        text = f"{format_compact(self.value * factor, self.u * factor)} {unit}"
        return text if self.estimated else f"{text} (prior, {NOT_DETERMINED})"

    __repr__ = __str__

    def interval(self, coverage: float = 0.95) -> tuple[float, float]:
        """Return the coverage interval by Student's t, in `unit` (GUM G.3).

        coverage: Coverage probability, between 0 and 1.
        """
        if not 0.0 < coverage < 1.0:
            raise ValueError(f"a coverage probability must be between 0 and 1; got {coverage}")
        value, u = self._require_value()
        half_width = expanded_uncertainty(u, self.dof, coverage)
        return value - half_width, value + half_width

    def in_units(self, unit: str | None = None) -> Quantity:
        """Return value and uncertainty in another unit of the same dimension; see also `to_si`.

        unit: Unit such as ``ug/g^2`` or ``arcsec``. None: the unit of tables and texts.
        """
        value, u = self._require_value()
        target_unit, factor = find_display_unit(self.unit)
        if unit is not None:
            target_unit, factor = unit, unit_factor(self.unit, unit)
        return Quantity(value * factor, u * factor, target_unit)

    def to_si(self, gravity: float | None = None) -> SiEstimate:
        """Return the coefficient in SI units, in which the effects of an uncertain g partly cancel.

        gravity: Exact g of the unit, m/s^2. None: g of the result.
        """
        stated_gravity = self._gravity if gravity is None else StatedGravity(gravity)
        if stated_gravity is None:
            raise ValueError(
                "this coefficient does not belong to a result; give `gravity`, the g of its unit"
            )
        return convert_to_si(*self._require_value(), self.unit, self.dof, stated_gravity)

    def _require_value(self) -> tuple[float, float]:
        if self.value is None or self.u is None:
            raise ValueError("the records do not determine this coefficient")
        return self.value, self.u


class Correlation(ResultPart):
    """Correlation matrix of the estimated coefficients, rows in the order of `terms`."""

    terms: list[str]  #: Names of the rows and columns, in the order of the matrix.
    matrix: list[list[float]]  #: Correlation coefficients.

    def frame(self) -> pl.DataFrame:
        """Return a polars frame: the names in the column ``term``, and a column for each."""
        return matrix_frame(self.terms, np.array(self.matrix))


@frozen(eq=False)
class Covariance:
    """Covariance matrix of the coefficients of a result."""

    terms: tuple[str, ...]  #: Names such as ``Qx.K_II``, p of them.
    matrix: Array  #: Covariances in the units of the coefficients, shape (p, p).
    units: tuple[str, ...]  #: Units of the coefficients, p of them.

    def frame(self) -> pl.DataFrame:
        """Return a polars frame: the names in the column ``term``, and a column for each."""
        return matrix_frame(self.terms, self.matrix)


def matrix_frame(terms: Sequence[str], matrix: Array) -> pl.DataFrame:
    """Return a square matrix as a polars frame with the names of its rows and columns."""
    import polars as pl

    return pl.DataFrame({"term": terms, **dict(zip(terms, matrix.T, strict=True))})


class Residual(ResultPart):
    """Size of the residuals and goodness of fit.

    `chi2` requires a stated noise; it is None if the noise was estimated from these residuals.
    """

    rms: float  #: Root mean square of the residuals.
    unit: str  #: Unit of the root mean square.
    dof: float  #: Degrees of freedom.
    #: Chi-square relative to the stated noise; null if the noise was estimated.
    chi2: float | None = None
    #: p-value of the fit: probability of a larger chi-square if the model is correct.
    lack_of_fit_p: float | None = None


class Knowledge(ResultPart):
    """Prior information on a nuisance parameter: a term or an input."""

    name: str  #: Name of the term or input, such as ``Qx.K_OO`` or ``run1.platform.tilt.north``.
    kind: Kind  #: Kind of the prior: stated, unstated (default) or held (considered).
    unit: str  #: Unit of the numbers, an SI unit or a g-unit.
    value: float  #: Prior value: the stated value if there is one, otherwise the ideal value.
    u: float  #: Prior standard uncertainty: the stated u if there is one, otherwise the default.
    found: float | None = None  #: Posterior value from the same fit; null if the term was held.
    u_found: float | None = None  #: Posterior standard uncertainty.


class NoiseLine(ResultPart):
    """One noise component: its size, whether it was estimated, and its uncertainty then."""

    #: Standard deviation per sample; for ``acceleration``, the random-walk coefficient.
    value: float
    u: float | None = None  #: Standard uncertainty of the value, if the noise was estimated.
    unit: str  #: Unit of the value and its uncertainty.
    #: Whether the noise was estimated from the residuals; if false, the noise is as stated.
    estimated: bool
    #: Static record from which the noise was estimated; null if the noise was stated or estimated
    #: from the residuals.
    record: str | None = None
    #: Noise of each run, if the runs differ; `value` is then the root mean square over all rows.
    runs: dict[str, float] = {}


class Comparison(ResultPart):
    """Comparison of K_II by the two-stage method with the joint fit."""

    value: float  #: Estimate of K_II by the two-stage method.
    u: float  #: Standard uncertainty.
    difference: float  #: Difference from the joint estimate of K_II.
    u_difference: float  #: Standard uncertainty of the difference.
    z: float  #: Difference divided by its standard uncertainty; above 3, the methods disagree.


class Finding(ResultPart):
    """A finding of a check that reduces the reliability of a result."""

    code: str  #: Stable code that identifies the kind of finding, such as ``lack-of-fit``.
    #: Subject of the finding: an accelerometer, a coefficient (``Qx.K_II``), a run or a platform
    #: term; empty for the campaign.
    subject: str
    text: str  #: Description of the finding and of the action to take.
    #: Size of the effect, in standard uncertainties or relative to the expected size; null if the
    #: finding has no size.
    size: float | None = None
    #: Whether the records contradict the result; do not use a contradicted result.
    contradicts: bool = False
    #: Whether this finding sets the state ``not-determined``. This happens only for a coefficient
    #: that the campaign is meant to determine or that ``[model] terms`` requests.
    undetermined: bool = False
    #: Other findings that would disappear if this cause were removed (for causes only).
    explains: list[Finding] = []
    #: Subjects of other causes that explain the records equally well, most likely first.
    as_well: list[str] = []


class Fold(ResultPart):
    """Residuals against the spindle angle, in equal intervals of a revolution from angle 0.

    An interval without samples contains None.
    """

    low: list[float | None]  #: Smallest residual.
    mean: list[float | None]  #: Mean residual.
    high: list[float | None]  #: Largest residual.


class Spectrum(ResultPart):
    """Spectrum of whitened residuals, in bands."""

    frequency: list[float]  #: Centre frequency of each band, Hz.
    power: list[float]  #: Mean power in each band; 1 for white noise.
    lines: list[int] = []  #: Number of periodogram lines in each band.


class Quantiles(ResultPart):
    """Ordered whitened residuals and quantiles of a standard normal distribution."""

    normal: list[float]  #: Quantiles of the standard normal distribution.
    found: list[float]  #: Ordered whitened residuals.


class Trace(ResultPart):
    """The residuals of one accelerometer in one run, thinned for pictures."""

    rows: int | None = None  #: Number of residuals.
    rms: float | None = None  #: Root mean square of the residuals, in SI units.
    time: list[float]  #: Time at the centre of each interval, in s from the start of the run.
    low: list[float]  #: Smallest residual in each interval, in SI units.
    high: list[float]  #: Largest residual in each interval, in SI units.
    #: Times and residuals of rejected outliers; if there are many, only the largest ones.
    left_out: list[tuple[float, float]] = []
    by_angle: Fold | None = None  #: Residuals against the spindle angle.
    spectrum: Spectrum | None = None  #: Spectrum of the whitened residuals.
    quantiles: Quantiles | None = None  #: Quantiles of the whitened residuals.


class NominalOutput(ResultPart):
    """Nominal conversion of an output to a specific force, g: (output - zero) / sensitivity."""

    unit: str  #: Unit of the output.
    sensitivity: float  #: Nominal output per g; K_I is the true sensitivity divided by this value.
    #: Nominal output at zero specific force; K_F is the true output minus this value.
    zero: float = 0.0

    @property
    def words(self) -> str:
        """Text such as ``1.25 mA/g from 4 mA``."""
        zero_text = f" from {self.zero:.9g} {self.unit}" if self.zero else ""
        return f"{self.sensitivity:.9g} {self.unit}/g{zero_text}"


class ReadingResult(ResultPart):
    """One reading: value, standard uncertainty and residual in g.

    Axes are in east-north-up coordinates, or outward-forward-up on an arm. For the mean of a
    record, `samples`, `counts` and `notes` are as in `RunResult`.
    """

    name: str  #: Name of the run or of the table row.
    motion: str  #: Type of motion: ``static``, ``vibration``, ``arm`` or ``counter-rotating``.
    mounting: str = ""  #: Mounting of the instrument on the arm; empty if no mounting is named.
    #: Direction of the input axis in east-north-up coordinates (outward-forward-up on an arm).
    input_axis: tuple[float, ...] = ()
    pendulous_axis: tuple[float, ...] = ()  #: Direction of the pendulous axis, in the same frame.
    rate: float  #: Rate of the spindle, rad/s.
    amplitude: float | None = None  #: Peak acceleration of a vibration, m/s^2; otherwise null.
    value: float  #: Reading in g, converted with the nominal sensitivity.
    u: float  #: Stated or estimated standard uncertainty of the reading, g.
    residual: float  #: Reading minus model, g.
    #: Residual divided by its standard deviation; null if the fit reproduces the reading exactly.
    z: float | None
    #: Number of averaged rows if the reading is the mean of a record; otherwise null.
    samples: int | None = None
    #: Number of rows that are ``repeated``, ``empty`` or ``outliers``, and number of ``gaps``;
    #: empty if the reading is not the mean of a record.
    counts: dict[str, int] = {}
    notes: list[str] = []  #: Remarks on how the record was read.


class PoseResult(ResultPart):
    """One pose of a triad at an unknown attitude, in g.

    `z` is the residual divided by its standard deviation; None if the fit follows it exactly.
    """

    name: str  #: Name of the run or table row; for a pose in a record, with its start time.
    start: float | None = None  #: Start time in the record, s; null for a stated reading.
    end: float | None = None  #: End time in the record, s.
    samples: int | None = None  #: Number of rows averaged.
    #: Outputs converted with the nominal sensitivities, in the order of the triad.
    values: tuple[float, ...]
    direction: tuple[float, ...]  #: Estimated direction of the specific force in the triad's frame.
    residual: float  #: Output minus model, in the direction of the specific force.
    u: float  #: Stated or estimated standard uncertainty of the output along the specific force.
    z: float | None  #: Residual divided by its standard deviation.


class PosesInRecord(ResultPart):
    """Poses detected in a record."""

    poses: int  #: Number of poses.
    threshold: float  #: Scatter below which counterspin treats the triad as being at rest, m/s^2.
    #: Median scatter in motion divided by the median scatter at rest; null if the record contains
    #: no motion.
    contrast: float | None
    notes: list[str] = []  #: Remarks on rejected rest periods and on the threshold.
    #: Start times of the intervals of the record, s, for a plot of the detected rest periods.
    time: list[float] = []
    #: Largest combined scatter of the three outputs in each interval, m/s^2, for comparison with
    #: the threshold.
    level: list[float] = []


class TriadResult(ResultPart):
    """Three accelerometers of one sensor in one frame.

    The parameters are those of NIST: ``offset.X`` (g), ``sensitivity.X`` (g/g) and ``angle.X.Y``
    (rad) between the input axes of two accelerometers, and requested second-order terms of the
    accelerometers, such as ``X.K_II``.
    """

    accelerometers: list[str]  #: Names of the accelerometers, in the order of the other fields.
    parameters: dict[str, Coefficient]  #: Offsets, sensitivities, angles and second-order terms.
    correlation: Correlation | None = None  #: Correlations of the determined parameters.
    #: Uncertainty budget of each parameter, with full names of terms, largest contribution first;
    #: empty in files of earlier versions.
    budget: dict[str, list[BudgetLine]] = {}
    #: Sensitivity of each parameter to the assumed gravity, per m/s^2; empty if gravity is exact.
    by_gravity: dict[str, float] = {}
    #: Matrix of the correction f = matrix (y - bias); f is the specific force in g in the triad's
    #: frame, and y are the outputs in g, converted with the nominal sensitivities; null if the
    #: matrix is not determined.
    matrix: list[list[float]] | None = None
    u_matrix: list[list[float]] | None = None  #: Standard uncertainties of the matrix elements.
    #: Offsets of the three accelerometers, g; null if the matrix is null.
    bias: list[float] | None = None
    #: Reason why there is no matrix; null if there is a matrix, and in files of earlier versions.
    why_no_matrix: str | None = None
    #: Root mean square of norm(f) - g over the poses, with the nominal sensitivities, m/s^2; null
    #: if there are no poses.
    rms_before: float | None = None
    #: Root mean square of norm(f) - g over the poses after correction by the matrix, the bias and
    #: the requested second-order terms, m/s^2.
    rms_after: float | None = None
    poses: list[PoseResult] = []  #: Poses at unknown attitudes.
    records: dict[str, PosesInRecord] = {}  #: Records in which poses were detected, by run.

    def frame(self, library: str = "polars") -> Any:
        """Return the parameters as a frame with the columns of `Result.table`.

        Parameters
        ----------
        library
            ``polars`` or ``pandas``.

        Returns
        -------
        polars.DataFrame or pandas.DataFrame
            Frame with the owner ``triad`` and terms such as ``angle.X.Y``, in units of the field.
        """
        make_frame = load_name("counterspin.calibration.result_conversion:rows_frame")
        return make_frame(
            (("triad", name, coefficient) for name, coefficient in self.parameters.items()), library
        )

    def __repr__(self) -> str:
        """Return the parameters, one per line, and the rms of the poses before and after."""
        lines = [f"Triad {', '.join(self.accelerometers)}: {len(self.poses)} poses"]
        width = max(map(len, self.parameters), default=0)
        lines += [
            f"  {escape_controls(name):<{width}}  {coefficient!r}"
            for name, coefficient in self.parameters.items()
        ]
        if self.rms_before is not None and self.rms_after is not None:
            rms_text = f"{self.rms_before:.3g} m/s^2 before, {self.rms_after:.3g} m/s^2 after"
            lines.append(f"  rms of |f| - g: {rms_text}")
        return "\n".join(lines)

    __str__ = __repr__


class Shift(ResultPart):
    """Shift of a coefficient without one test method; `z` is the shift over its u."""

    shift: float  #: Estimate without the omitted method minus the estimate from all methods.
    u: float  #: Standard uncertainty of the shift; shared contributions count only once.
    z: float  #: Shift divided by its standard uncertainty.


class MethodAgreement(ResultPart):
    """Records and readings of a test method, and their agreement with the other methods."""

    kind: str  #: Test method: ``at rest``, ``arm`` or ``double turntable``.
    count: int  #: Number of records and readings of this method.
    #: Coefficients from this method alone with all priors, without `dof`; null for a coefficient
    #: that this method does not determine.
    coefficients: dict[str, Coefficient]
    #: Shift of each coefficient due to omitting this method, if the other methods also determine
    #: the coefficient.
    without: dict[str, Shift] = {}
    chi2: float  #: Chi-square of the differences between this method and the other methods.
    dof: int  #: Number of combinations that this method and the other methods determine.
    #: p-value: probability of a larger chi-square if the methods agree; null if the other methods
    #: determine none of the combinations.
    p: float | None


class AccelerometerResult(ResultPart):
    """Result of one accelerometer."""

    #: State of the result: ``good``, ``reservations``, ``not-determined`` or ``contradicted``.
    state: State | None = None
    findings: list[Finding] = []  #: Findings on this accelerometer, most severe first.
    #: Typical faults that the residuals of the readings would not reveal, as text, each with the
    #: resulting shift of a coefficient; largest shift first.
    unseen_faults: list[str] = []
    serial_number: str | None = None  #: Serial number, as stated in the campaign.
    coefficients: dict[str, Coefficient]  #: Coefficients of the requested terms.
    #: Further terms with stated priors; the fit subtracted the effects of these terms.
    known: dict[str, Coefficient] = {}
    #: Stated correlations between priors, as a table of correlations for each term; terms of other
    #: accelerometers have full names.
    prior_correlations: dict[str, dict[str, float]] = {}
    #: Directions of the input, pendulous and output axes (one row for each axis) in east-north-up
    #: coordinates, for a level platform.
    axes: list[tuple[float, float, float]] | None = None
    #: Recorded quantity: ``displacement``, ``velocity`` or ``specific_force``.
    observable: str | None = None
    correlation: Correlation | None  #: Correlation matrix of the estimates, if there are any.
    confounded: list[ConfoundedTerms] = []  #: Sets of terms that cannot be separated.
    residual: Residual  #: Residuals and goodness of fit.
    noise: dict[str, NoiseLine] = {}  #: Noise used, by component.
    budget: dict[str, list[BudgetLine]] = {}  #: Uncertainty budget of each term.
    #: Monte Carlo coverage interval of each estimated coefficient; empty if it was not requested.
    monte_carlo: dict[str, MonteCarloInterval] = {}
    #: Data for recalculating u with a more accurate input; null if no input affects u.
    what_if: WhatIf | None = None
    #: Further unknown of the two-stage method, in addition to K_II and K_F.
    second_unknown: dict[str, Coefficient] = {}
    jackknife: list[Jackknife] = []  #: Leave-one-run-out results for K_II (joint method only).
    two_stage: Comparison | None = None  #: Comparison with the two-stage K_II (joint method only).
    conformity: dict[str, Conformity] = {}  #: Conformity of each term with its specification.
    traces: dict[str, Trace] = {}  #: Residuals of each run for plotting (joint method only).
    readings: list[ReadingResult] = []  #: Readings taken at rest, on an arm or on a turntable.
    #: Comparison of the test methods; empty if the campaign uses a single method.
    kinds: list[MethodAgreement] = []
    #: ``bias`` and ``scale_factor`` in the unit of the readings; empty if this unit is g.
    output: dict[str, Coefficient] = {}
    #: Nominal sensitivity and zero for the conversion of the output to specific force; null if the
    #: output is in g or m/s^2.
    nominal: NominalOutput | None = None
    warnings: list[str] = []  #: Findings as text.

    @field_validator("coefficients", "budget", "conformity")
    @classmethod
    def _suggest_names(cls, values: dict[str, Any]) -> dict[str, Any]:
        return NamedParts(values)

    def __repr__(self) -> str:
        """Return state and coefficients, one per line."""
        width = max(map(len, self.coefficients), default=0)
        lines = [
            f"{symbol.ljust(width)}  {coefficient}"
            for symbol, coefficient in self.coefficients.items()
        ]
        return "\n".join([f"Accelerometer, {self.state or 'not judged'}", *lines])

    __str__ = __repr__


class RippleResult(ResultPart):
    """One ripple of the rate; amplitude in rad/s, phase in rad."""

    harmonic: int  #: Frequency of the ripple, in cycles per revolution.
    amplitude: float  #: Amplitude w_n of the rate, rad/s.
    u_amplitude: float  #: Standard uncertainty of the amplitude.
    phase: float  #: Phase at time zero, rad.
    u_phase: float | None  #: Standard uncertainty of the phase.


class ParabolaResult(ResultPart):
    """First stage of the two-stage method: b0 (m), b1 (m/s), b2 (m/s^2) of one accelerometer."""

    b0: float  #: Constant coefficient, m.
    b1: float  #: Linear coefficient, m/s.
    b2: float  #: Quadratic coefficient, m/s^2.
    u_b2: float  #: Standard uncertainty of b2 (Eq. 31).
    sigma: float  #: Standard deviation per sample, m.
    #: Whether sigma was estimated from the residuals; if false, sigma is as stated.
    sigma_from_residuals: bool
    strobes: int  #: Number of strobes in the fit.


class RunResult(ResultPart):
    """Results of a run: its rotation, its samples and its terms.

    `rejected` is the number of recorded samples that were not used: repeated rows, empty cells and
    outliers of all accelerometers; `counts` is the number of each kind.
    """

    rate: float  #: Identified rate w0, in `rate_unit`.
    u_rate: float | None = None  #: Standard uncertainty of the rate; null if no angle was recorded.
    rate_unit: Literal["rad/s"] = "rad/s"  #: Unit of the rate and its uncertainty.
    drift: float  #: Relative drift C of the rate, in `drift_unit`.
    u_drift: float | None = None  #: Standard uncertainty of the drift.
    drift_unit: Literal["1/s"] = "1/s"  #: Unit of the drift and its uncertainty.
    ripples: list[RippleResult] = []  #: Ripple components of the rate, identified from the angle.
    angle_rms: float | None = None  #: Root mean square of the encoder residual, rad.
    samples: int  #: Number of rows used.
    rejected: int  #: Number of rejected samples: repeated rows, empty cells and outliers.
    #: Number of rejected samples of each kind; ``block`` is the number of rows in each average.
    counts: dict[str, int] = {}
    notes: list[str] = []  #: Remarks on how the record was read.
    terms: dict[str, Coefficient] = {}  #: Terms of this run, such as its tilt.
    parabolas: dict[str, ParabolaResult] = {}  #: Parabola of each accelerometer (two-stage method).
    #: Residual tests of each accelerometer: chi-square, sign test and largest peak of the spectrum.
    fit: dict[str, dict[str, float | str | None]] = {}


class Inputs(ResultPart):
    """Stated inputs of the calibration; u is 0 for an input that was stated as exact."""

    gravity: float  #: Gravity that defines g in all g-units, in `gravity_unit`.
    u_gravity: float = 0.0  #: Standard uncertainty of gravity; 0 if gravity was stated as exact.
    gravity_unit: Literal["m/s^2"] = "m/s^2"  #: Unit of gravity and its uncertainty.
    latitude: float  #: Latitude of the site, in `latitude_unit`.
    u_latitude: float = 0.0  #: Standard uncertainty of the latitude.
    latitude_unit: Literal["rad"] = "rad"  #: Unit of the latitude and its uncertainty.
    radius: float  #: Radius of the centrifuge, in `radius_unit`.
    u_radius: float = 0.0  #: Standard uncertainty of the radius.
    radius_unit: Literal["m"] = "m"  #: Unit of the radius and its uncertainty.
    #: Reference temperature of the temperature slopes, K; null if no temperature was stated.
    reference_temperature: float | None = None
    #: Lowest and highest temperature of the runs and readings, K; empty if none was stated.
    temperatures: list[float] = []


class Provenance(ResultPart):
    """Provenance of the result: program, options and inputs."""

    version: str  #: Version of counterspin.
    #: SHA-256 of each input file; for data in memory, SHA-256 of the text that would be written, or
    #: of the arrays.
    inputs: dict[str, str]
    #: Inputs without a file, each with the reason: ``made in Python``, ``changed`` with the changed
    #: keys, or ``arrays``.
    in_memory: dict[str, str] = {}
    options: list[str] = []  #: Options of the command that differ from the defaults, as typed.
    #: Versions of Python, NumPy and SciPy, and the machine; empty in results of earlier
    #: versions.
    environment: dict[str, str] = {}

    @property
    def shown(self) -> list[tuple[str, str]]:
        """Names of the inputs in a report, each with its checksum."""
        return [
            (f"{name} (in memory)" if name in self.in_memory else name, checksum)
            for name, checksum in self.inputs.items()
        ]

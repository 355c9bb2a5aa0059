"""The parts that a result is made of; `counterspin.calibration.result` puts them together.

Coefficients are in g-units of the stated gravity; everything else is SI unless its unit stands
beside it.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import PrivateAttr

from counterspin.arrays import Array
from counterspin.calibration.notebook.labelled import Labelled
from counterspin.calibration.notebook.latex import latex_number, latex_unit
from counterspin.calibration.notebook.si_estimate import SiEstimate, StatedGravity, si_estimate
from counterspin.inference.conformity import Conformity, expanded_uncertainty
from counterspin.inference.identifiability import ConfoundedTerms
from counterspin.inference.joint.budget import BudgetLine, Kind
from counterspin.inference.joint.runs_left_out import Jackknife
from counterspin.reports.numbers import NOT_DETERMINED, field_unit, format_compact
from counterspin.results import ResultPart

#: Whether what a calibration says may be relied on: fully, with what its findings say in mind, or
#: not, for its records contradict it.
State = Literal["good", "reservations", "contradicted"]


class Coefficient(ResultPart):
    """One coefficient and where its uncertainty comes from."""

    #: Estimate and combined standard uncertainty; None if the data do not determine the coefficient
    #: and nothing is known beforehand. If not `estimated`, the prior.
    value: float | None
    u: float | None
    #: Parts of `u` from noise, from what the description states with an uncertainty, and from what
    #: it does not state, taken at typical sizes; u^2 is the sum of their squares.
    u_noise: float | None = None
    u_stated: float | None = None
    u_unstated: float | None = None
    #: Effective degrees of freedom of `u`; None is infinite. Intervals use Student's t.
    dof: float | None = None
    unit: str  #: g-units, or SI for platform terms.
    estimated: bool  #: Whether the data determine it.

    _gravity: StatedGravity | None = PrivateAttr(default=None)

    def __str__(self) -> str:
        """Return such as ``27.04160(72) ug/g^2``, in the unit of the field."""
        unit, factor = field_unit(self.unit)
        if self.value is None or self.u is None:
            return NOT_DETERMINED
        text = f"{format_compact(self.value * factor, self.u * factor)} {unit}"
        return text if self.estimated else f"{text} (prior, {NOT_DETERMINED})"

    __repr__ = __str__

    def _repr_latex_(self) -> str:
        unit, factor = field_unit(self.unit)
        if self.value is None or self.u is None:
            return NOT_DETERMINED
        number = latex_number(format_compact(self.value * factor, self.u * factor))
        return rf"${number}\,{latex_unit(unit)}$"

    def interval(self, coverage: float = 0.95) -> tuple[float, float]:
        """Return the coverage interval by Student's t, in `unit` (GUM G.3).

        coverage: Its probability, between 0 and 1.
        """
        if not 0.0 < coverage < 1.0:
            raise ValueError(f"a coverage probability lies between 0 and 1; got {coverage}")
        value, u = self._stated()
        half = expanded_uncertainty(u, self.dof, coverage)
        return value - half, value + half

    def to_si(self, gravity: float | None = None) -> SiEstimate:
        """Return the coefficient in SI, where much of what an uncertain g does to it cancels.

        gravity: An exact g of the unit, m/s^2. None: that of the result which the coefficient is
            of.
        """
        stated = self._gravity if gravity is None else StatedGravity(gravity)
        if stated is None:
            raise ValueError("this coefficient stands in no result: say which `gravity` it is in")
        return si_estimate(*self._stated(), self.unit, self.dof, stated)

    def _stated(self) -> tuple[float, float]:
        if self.value is None or self.u is None:
            raise ValueError("the records do not determine this coefficient")
        return self.value, self.u


class Correlation(ResultPart, Labelled):
    """Correlation matrix of the estimated coefficients, rows in the order of `terms`.

    ``correlation["K_F", "K_II"]`` is one of them, ``np.asarray(correlation)`` all.
    """

    terms: list[str]
    matrix: list[list[float]]

    @property
    def labels(self) -> tuple[str, ...]:
        """The terms."""
        return tuple(self.terms)

    @property
    def values(self) -> Array:
        """The correlations, shape (p, p)."""
        return np.array(self.matrix)

    __repr__ = Labelled.__repr__
    __str__ = Labelled.__repr__


class Residual(ResultPart):
    """Size of the residuals and how well the model fits.

    `chi2` and `lack_of_fit_p` need a noise that was given; they are None where it was estimated
    from these residuals.
    """

    rms: float
    unit: str
    dof: float
    chi2: float | None = None
    lack_of_fit_p: float | None = None


class Knowledge(ResultPart):
    """What a result rests on beside its data: a term or an input that nobody asked for."""

    #: Such as ``Qx.K_OO`` or ``run1.platform.tilt.north``; SI, or g-units.
    name: str
    kind: Kind  #: Whether it is stated, unstated or held.
    unit: str
    #: Before the data: as the description states it, or nominal and typical.
    value: float
    u: float
    #: After them, in the same fit; None where it was held.
    found: float | None = None
    u_found: float | None = None


class NoiseLine(ResultPart):
    """One noise component: its size, whether it was estimated, and its uncertainty then."""

    value: float
    u: float | None = None
    unit: str
    estimated: bool


class Comparison(ResultPart):
    """K_II by the two-stage method beside the joint fit; `z` is the difference over its u."""

    value: float
    u: float
    difference: float
    u_difference: float
    z: float


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
    #: Of a cause: what else was found and would not be if this were put right.
    explains: list[Finding] = []


class Fold(ResultPart):
    """Residuals against the spindle's angle: equal parts of a revolution from angle 0 on.

    A part without a sample has None.
    """

    low: list[float | None]
    mean: list[float | None]
    high: list[float | None]


class Spectrum(ResultPart):
    """Spectrum of whitened residuals; frequency in Hz, power 1 for white noise.

    `lines` counts those of the periodogram of which each power is the mean.
    """

    frequency: list[float]
    power: list[float]
    lines: list[int] = []


class Quantiles(ResultPart):
    """Ordered whitened residuals beside what a standard normal distribution would show."""

    normal: list[float]
    found: list[float]


class Trace(ResultPart):
    """The residuals of one accelerometer in one run, thinned for pictures."""

    #: How many residuals there are, and their root mean square in the observable's unit.
    rows: int | None = None
    rms: float | None = None
    time: list[float]  #: Middle of each stretch, s from the start of the run.
    #: Smallest and largest residual in it, in the observable's unit.
    low: list[float]
    high: list[float]
    #: Time and residual of samples judged outliers, the largest ones if there are many.
    left_out: list[tuple[float, float]] = []
    by_angle: Fold | None = None  #: The residuals over the revolution.
    #: Of the whitened residuals.
    spectrum: Spectrum | None = None
    quantiles: Quantiles | None = None


class ReadingResult(ResultPart):
    """One reading: value, standard uncertainty and residual in g; `z` is None where it fits wholly.

    `rate` in rad/s; `z` over the residual's own standard deviation. Axes: east, north, up; outward,
    forward, up on an arm. `samples` used, `counts`, `notes` of a record's mean: as of `RunResult`.
    """

    name: str
    motion: str
    mounting: str = ""
    input_axis: tuple[float, ...] = ()
    pendulous_axis: tuple[float, ...] = ()
    rate: float
    value: float
    u: float
    residual: float
    z: float | None
    samples: int | None = None
    counts: dict[str, int] = {}
    notes: list[str] = []


class Shift(ResultPart):
    """How far a coefficient moves when something is left out; `z` is the shift over its u."""

    shift: float
    u: float
    z: float


class KindOfTest(ResultPart):
    """What one kind of test says of an accelerometer, and how far it agrees with the others."""

    kind: str  #: ``at rest``, ``arm`` or ``double turntable``.
    count: int  #: Of its records and readings.
    #: By this kind alone, with all that is known beforehand; None where it does not determine one.
    coefficients: dict[str, Coefficient]
    #: By coefficient that the others determine: how far it moves when this kind is left out.
    without: dict[str, Shift] = {}
    #: Squares of what the kind says less what the others predict over their variances, in how many
    #: directions, and the probability of more; None where the others predict nothing of it.
    chi2: float
    dof: int
    p: float | None


class AccelerometerResult(ResultPart):
    """All that was found out about one accelerometer."""

    #: Whether it may be relied on, and what speaks against it, the gravest first.
    state: State | None = None
    findings: list[Finding] = []
    serial_number: str | None = None  #: As the campaign states it.
    coefficients: dict[str, Coefficient]  #: The terms that the campaign asked for.
    #: Further terms of which something is known beforehand, as the campaign states it; the fit has
    #: taken their values away.
    known: dict[str, Coefficient] = {}
    #: Where the input, pendulous and output axes point, as rows, in east-north-up while the
    #: platform is level.
    axes: list[tuple[float, float, float]] | None = None
    #: What was recorded: ``displacement``, ``velocity`` or ``specific_force``.
    observable: str | None = None
    correlation: Correlation | None
    confounded: list[ConfoundedTerms] = []
    residual: Residual
    noise: dict[str, NoiseLine] = {}
    budget: dict[str, list[BudgetLine]] = {}
    second_unknown: dict[str, Coefficient] = {}
    jackknife: list[Jackknife] = []
    two_stage: Comparison | None = None
    conformity: dict[str, Conformity] = {}  #: By term: where the campaign states a specification.
    traces: dict[str, Trace] = {}  #: By run: residuals for pictures.
    readings: list[ReadingResult] = []  #: Single values, at rest, on an arm or on a turntable.
    #: Each kind of test beside the others; empty where there is one kind only.
    kinds: list[KindOfTest] = []
    #: ``bias`` and ``scale_factor`` in the unit of its readings; empty where that is g.
    output: dict[str, Coefficient] = {}
    warnings: list[str] = []


class RippleResult(ResultPart):
    """One ripple of the rate; amplitude in rad/s, phase in rad."""

    harmonic: int
    amplitude: float
    u_amplitude: float
    phase: float
    u_phase: float | None


class ParabolaResult(ResultPart):
    """First stage of the two-stage method: b0 (m), b1 (m/s), b2 (m/s^2) of one accelerometer."""

    b0: float
    b1: float
    b2: float
    u_b2: float
    sigma: float
    sigma_from_residuals: bool
    strobes: int


class RunResult(ResultPart):
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


class Inputs(ResultPart):
    """What the result depends on beside the records; u is 0 where it was stated as exact."""

    gravity: float
    u_gravity: float = 0.0
    gravity_unit: Literal["m/s^2"] = "m/s^2"
    latitude: float
    u_latitude: float = 0.0
    latitude_unit: Literal["rad"] = "rad"
    radius: float
    u_radius: float = 0.0
    radius_unit: Literal["m"] = "m"


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

"""What is known of a campaign while it is recorded, and its JSON.

SI units, coefficients in g-units.
"""

from __future__ import annotations

from typing import ClassVar, Literal

from counterspin.reports.shown import ShownResult
from counterspin.results import ResultPart


class ResidualState(ResultPart):
    """Residuals of one accelerometer in one run."""

    rms: float  #: Root mean square, a sample, in `unit`.
    stated: float | None  #: White noise that the campaign states; None where it is to be estimated.
    ratio: float  #: Whitened residuals over what the noise lets expect: near 1.
    p: float | None  #: Probability of larger ones; None where the noise was estimated from them.
    unit: str  #: Of ``rms`` and ``stated``.


class PosesState(ResultPart):
    """The poses of a triad that one record has so far."""

    count: int  #: How many there are.
    threshold: float  #: Scatter below which the sensor rests, m/s^2.
    #: Root mean square of what is felt more or less than g in them, m/s^2; None where nothing is
    #: fitted yet.
    rms: float | None
    outlying: list[str]  #: Names of those that deviate from the model.
    #: Directions in which one more pose would say more than all that are there, the most telling
    #: first: ``+X -Y up`` is halfway between X up and Y down.
    missing: list[str]


class RunState(ResultPart):
    """What one run shows so far."""

    run: str  #: Its name.
    record: str  #: Its file.
    #: ``waiting``: no file, or too little of it; ``read``; ``failed``: it cannot be used as it
    #: stands.
    state: Literal["waiting", "read", "failed"]
    why: str | None = None  #: What is waited for, or what is wrong.
    rows: int = 0  #: Read so far.
    seconds: float = 0.0  #: Recorded so far.
    #: How long it is to be; None where the campaign does not say.
    stated_seconds: float | None = None
    sampling_rate: float | None = None  #: Rows a second, Hz.
    repeated: int = 0  #: Rows that repeat a time.
    empty: int = 0  #: Empty cells.
    outliers: int = 0  #: Samples left out.
    gaps: int = 0  #: Stretches of missing rows.
    longest_gap: float = 0.0  #: The longest of them, s.
    rate: float | None = None  #: Of rotation, rad/s.
    u_rate: float | None = None  #: Its standard uncertainty; None without a recorded angle.
    nominal_rate: float  #: As stated, rad/s; 0 at rest.
    drift: float | None = None  #: Of the rate, 1/s.
    ripple: float | None = None  #: Largest one of the rate, rad/s; None: none seen.
    harmonic: int | None = None  #: Which harmonic that is.
    angle_rms: float | None = None  #: Of the recorded angle about the model, rad.
    residuals: dict[str, ResidualState] = {}  #: By accelerometer.
    poses: PosesState | None = None  #: Of a record of poses of unknown attitude.


class ReachedCoefficient(ResultPart):
    """A coefficient by the records that are there; None where they do not determine it."""

    name: str  #: Such as ``Qx.K_II``.
    value: float | None  #: None where it is not determined.
    u: float | None  #: Standard uncertainty.
    unit: str  #: Of both.


class GoalState(ResultPart):
    """A goal: the u that is wanted of a coefficient, the u reached, and whether that is enough."""

    name: str  #: Of the coefficient.
    wanted: float  #: The u that is wanted of it.
    u: float | None  #: Reached so far; None: not determined.
    unit: str  #: Of both.
    met: bool  #: Whether that is enough.


class WatchState(ShownResult):
    """A campaign whose records grow, at one moment.

    Attributes
    ----------
    title
        The campaign's.
    runs
        In the order of the description.
    coefficients
        K_II of each accelerometer, all of a triad in poses, and what goals name.
    goals
        What is wanted.
    events
        What happened to files since the state before, in sentences.
    trouble
        Why the records that are there cannot be fitted together; None if they can.
    complete
        Whether every run is read and as long as the campaign states.
    """

    BLOCKS: ClassVar[str] = "counterspin.monitoring.page:watch_blocks"
    KIND: ClassVar[str] = "watch"

    title: str  #: Of the campaign.
    runs: list[RunState]  #: In the order of the description.
    #: K_II of each accelerometer, all of a triad in poses, and what goals name.
    coefficients: list[ReachedCoefficient]
    goals: list[GoalState]  #: What is wanted.
    events: list[str]  #: What happened to files since the state before.
    trouble: str | None  #: Why the records cannot be fitted together; None if they can.
    complete: bool  #: Whether every run is read and as long as is stated.

    @property
    def met(self) -> bool:
        """Whether there are goals, and all of them are met."""
        return bool(self.goals) and all(goal.met for goal in self.goals)


class CheckedRun(ShownResult):
    """One record, judged.

    Attributes
    ----------
    run
        What it shows, fitted by itself.
    remarks
        What is wrong or odd, in sentences; empty if nothing is.
    good
        Whether it may be kept as it is.
    others
        The other runs of the campaign whose records are there.
    reached
        Coefficients by this record and those others.
    expected
        What the whole campaign will know, its other runs being made as described.
    why_not
        Why that cannot be said; None if it can.
    """

    BLOCKS: ClassVar[str] = "counterspin.monitoring.page:check_blocks"
    KIND: ClassVar[str] = "check"

    run: RunState  #: What it shows, fitted by itself.
    remarks: list[str]  #: What is wrong or odd.
    good: bool  #: Whether it may be kept.
    others: list[str]  #: Other runs whose records are there.
    reached: list[ReachedCoefficient]  #: Coefficients by this record and those.
    expected: list[ReachedCoefficient]  #: u of the whole campaign; values are None.
    why_not: str | None = None  #: Why that cannot be said.

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
    unit: str


class RunState(ResultPart):
    """What one run shows so far."""

    #: Its name and its file.
    run: str
    record: str
    #: ``waiting``: no file, or too little of it; ``read``; ``failed``: it cannot be used as it
    #: stands.
    state: Literal["waiting", "read", "failed"]
    why: str | None = None  #: What is waited for, or what is wrong.
    #: Read so far.
    rows: int = 0
    seconds: float = 0.0
    #: How long it is to be; None where the campaign does not say.
    stated_seconds: float | None = None
    sampling_rate: float | None = None  #: Hz.
    #: Rows that repeat a time, empty cells, samples left out, gaps and the longest of them, s.
    repeated: int = 0
    empty: int = 0
    outliers: int = 0
    gaps: int = 0
    longest_gap: float = 0.0
    #: rad/s; u_rate is None without a recorded angle.
    rate: float | None = None
    u_rate: float | None = None
    nominal_rate: float
    drift: float | None = None  #: Of the rate, 1/s.
    #: Largest ripple of the rate, rad/s, and which harmonic it is; None if none is seen.
    ripple: float | None = None
    harmonic: int | None = None
    angle_rms: float | None = None  #: Of the recorded angle about the model, rad.
    residuals: dict[str, ResidualState] = {}  #: By accelerometer.


class ReachedCoefficient(ResultPart):
    """A coefficient by the records that are there; None where they do not determine it."""

    name: str
    value: float | None
    u: float | None
    unit: str


class GoalState(ResultPart):
    """A goal: the u that is wanted of a coefficient, the u reached, and whether that is enough."""

    name: str
    wanted: float
    u: float | None
    unit: str
    met: bool


class WatchState(ShownResult):
    """A campaign whose records grow, at one moment.

    Attributes
    ----------
    title
        The campaign's.
    runs
        In the order of the description.
    coefficients
        K_II of each accelerometer, and what goals name.
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

    title: str
    runs: list[RunState]
    coefficients: list[ReachedCoefficient]
    goals: list[GoalState]
    events: list[str]
    trouble: str | None
    complete: bool

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

    run: RunState
    remarks: list[str]
    good: bool
    others: list[str]
    reached: list[ReachedCoefficient]
    expected: list[ReachedCoefficient]
    why_not: str | None = None

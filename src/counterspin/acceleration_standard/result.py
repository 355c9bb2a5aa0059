"""Uncertainty budget of the applied acceleration, and its JSON."""

from __future__ import annotations

from typing import Any, ClassVar, Final, Literal

from counterspin.results import ReportableResult, ResultPart, make_frame

#: Origin of a source: stated in the campaign, default uncertainty, or assumed perfect.
Origin = Literal["stated", "default", "assumed"]


class AppliedSource(ResultPart):
    """A source of uncertainty, the same at all levels."""

    name: str  #: Name of the source, such as ``radius`` or ``droop``.
    symbol: str  #: Symbol of the corresponding term or input.
    words: str  #: Description.
    value: float  #: Value used, in `unit`.
    u: float  #: Standard uncertainty, in `unit`.
    unit: str  #: SI unit; 1 for a relative error.
    origin: Origin  #: ``stated``, ``default`` or ``assumed``.


class AppliedContribution(ResultPart):
    """The contribution of a source at a level."""

    source: str  #: Name of the source.
    sensitivity: float  #: Partial derivative of the acceleration, m/s^2 per unit of the source.
    u: float  #: Contribution to the standard uncertainty, m/s^2.
    share: float  #: Share of the variance, from 0 to 1.


class MonteCarloCheck(ResultPart):
    """Distribution of the acceleration by Monte Carlo, compared with the GUM interval."""

    mean: float  #: Mean of the draws, m/s^2.
    u: float  #: Standard deviation of the draws, m/s^2.
    low: float  #: Lower endpoint of the symmetric 95 % interval, m/s^2.
    high: float  #: Upper endpoint of the symmetric 95 % interval, m/s^2.
    distance: float  #: Largest endpoint difference from the GUM interval, m/s^2.
    tolerance: float  #: Largest difference at which the GUM interval is validated, m/s^2.
    #: Whether the GUM interval is validated to two digits of u (JCGM 101, clause 8).
    validated: bool


class AppliedLevel(ResultPart):
    """The applied acceleration at a level, with its budget."""

    level: float  #: Nominal acceleration, g.
    rate: float  #: Rate of the centrifuge, rad/s; negative in the clockwise sense.
    acceleration: float  #: Applied acceleration, mean over a revolution, m/s^2.
    u: float  #: First-order standard uncertainty (GUM method), m/s^2.
    u_relative: float  #: `u` divided by the acceleration.
    dominant: str | None  #: Source with the largest share; None if all sources are exact.
    budget: list[AppliedContribution]  #: Contributions, the largest first.
    monte_carlo: MonteCarloCheck  #: Result by Monte Carlo.


_COLUMNS: Final = ("level", "rate", "acceleration", "u", "u_relative", "dominant")


class AppliedAcceleration(ReportableResult):
    """The uncertainty budget of the acceleration that a centrifuge applies, by level."""

    BLOCKS: ClassVar[str] = "counterspin.acceleration_standard.page:applied_blocks"
    REPORT_BLOCKS: ClassVar[str | None] = "counterspin.acceleration_standard.page:report_blocks"
    KIND: ClassVar[str] = "budget of applied acceleration"

    title: str  #: Title of the campaign.
    version: str  #: Version of counterspin.
    gravity: float  #: Gravity at the site, m/s^2; also defines the unit g of the levels.
    mounting: str | None  #: Mounting whose alignment is used; None if none is stated.
    draws: int  #: Number of Monte Carlo draws.
    seed: int  #: Seed of the draws.
    applied_sources: list[AppliedSource]  #: Sources of uncertainty.
    levels: list[AppliedLevel]  #: Levels, in the order given.

    def source(self, name: str) -> AppliedSource:
        """Return the source with a name."""
        return next(source for source in self.applied_sources if source.name == name)

    def table(self, library: str = "polars") -> Any:
        """Return the levels as a frame, a row for each level.

        Parameters
        ----------
        library
            ``polars``, or ``pandas`` where it is installed.

        Returns
        -------
        polars.DataFrame or pandas.DataFrame
            Level in g, rate in rad/s, acceleration and u in m/s^2.

        Raises
        ------
        ValueError
            If the library is unknown.
        """
        columns = {name: [getattr(level, name) for level in self.levels] for name in _COLUMNS}
        return make_frame(columns, _COLUMNS[:5], library)

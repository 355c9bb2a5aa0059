"""A linear model: what a fit estimates or holds, and observations whose rows are linear in that.

Observations are records (`counterspin.inference.joint.design_blocks`), or readings and poses
(`counterspin.readings.linear`). Whatever is asked of a fit, such as another noise, a run
left out or one more column, is asked of its observations alike.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping, Sequence
from dataclasses import field, replace
from typing import Final, Self

import numpy as np

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.inference.joint.series import ResidualSeries, input_affects
from counterspin.inference.least_squares import REGULARISATION, Block, Solution
from counterspin.inference.noise.model import Noise
from counterspin.physics.terms import (
    ACCELEROMETER_TERMS,
    INPUTS,
    LEVER_ARM,
    SHARED_TERMS,
    TERMS,
    affects_readings,
    term,
)

#: Rotation of a run as unknowns, where no angle is recorded.
ROTATION: Final = ("spindle.start_angle", "spindle.rate", "spindle.drift")

#: As printed: w_p sin(phi) in rad/s, or (w_p/w0) sin(phi).
RIPPLE: Final = "spindle.ripple"

_UNITS: Final = dict(zip((*ROTATION, RIPPLE), ("rad", "rad/s", "1/s", "rad/s"), strict=True))


def unit_of(symbol: str) -> str:
    """Return the unit of a term, of an unknown of the rotation or of an uncertain input."""
    return _UNITS.get(symbol) or term(symbol).unit


@frozen
class Unknown:
    """One unknown of the joint fit."""

    #: Name of the accelerometer, the run, or the recorder of a clock; empty for what all share.
    owner: str
    #: A term of the table, one of `ROTATION` or of `counterspin.inference.joint.encoder.SYMBOLS`.
    symbol: str
    #: (value, standard uncertainty) of the coefficient; infinite: nothing known. Of an input, its
    #: deviation from what the description states.
    prior: tuple[float, float]
    limit: float  #: Largest credible size.
    #: Whether anybody wants to know it; else it is there because others depend on it.
    is_of_interest: bool = True
    #: Whether the description does not state the prior's uncertainty, which then is the typical one
    #: of the table of terms.
    has_default_prior: bool = False
    #: Default standard uncertainty of a requested parameter without a prior, which it gets if the
    #: directions of a triad's poses do not determine it; infinite: none.
    default_sd: float = math.inf
    #: Names of other unknowns -> stated correlation of the priors.
    correlations: Mapping[str, float] = field(default_factory=dict, compare=False)

    @property
    def uses_fallback_prior(self) -> bool:
        """True for a requested parameter that is not determined and has its default prior."""
        return self.is_of_interest and self.has_default_prior and self.prior[1] == self.default_sd

    @property
    def unit(self) -> str:
        """The coefficient's unit: g-units, or SI for what is no accelerometer's."""
        return unit_of(self.symbol)

    @property
    def nominal(self) -> float:
        """Value of the coefficient in a perfect system."""
        return TERMS[self.symbol].nominal if self.symbol in TERMS else 0.0

    @property
    def prior_mean(self) -> float:
        """The prior's value less nominal; where nothing is known, nominal itself, which is 0."""
        return self.prior[0] - self.nominal if math.isfinite(self.prior[1]) else 0.0

    @property
    def prior_sd(self) -> float:
        """The prior's u; where nothing is known, that of the solver's numerical regularisation."""
        return self.prior[1] if math.isfinite(self.prior[1]) else REGULARISATION * self.limit

    @property
    def name(self) -> str:
        """Owner and symbol in one word."""
        return f"{self.owner}.{self.symbol}" if self.owner else self.symbol

    def affects(self, series: ResidualSeries) -> bool:
        """Return whether the unknown can show in a series."""
        if self.symbol in ACCELEROMETER_TERMS or self.symbol == LEVER_ARM:
            return self.owner == series.accelerometer
        if self.symbol in INPUTS:
            return input_affects(series, self.symbol, self.owner)
        if self.symbol not in SHARED_TERMS and affects_readings(self.symbol):
            return False
        return self.owner in ("", series.run)


@frozen
class Considered(Unknown):
    """A term that is held: its prior's value is taken, its uncertainty carried (Schmidt)."""


@frozen
class Unknowns:
    """Estimated and considered unknowns."""

    #: In the order of the solution's rows and considered columns; unknowns that are asked for come
    #: first.
    unknowns: tuple[Unknown, ...]
    considered: tuple[Considered, ...] = ()

    @property
    def of_interest(self) -> tuple[Unknown, ...]:
        """Parameters of interest: the first of the unknowns."""
        return tuple(unknown for unknown in self.unknowns if unknown.is_of_interest)

    def with_default_priors(self, selected_unknowns: Collection[Unknown]) -> Unknowns:
        """Return the model with the default priors of some requested parameters."""
        return replace(
            self,
            unknowns=tuple(
                replace(
                    unknown, prior=(unknown.nominal, unknown.default_sd), has_default_prior=True
                )
                if unknown in selected_unknowns
                else unknown
                for unknown in self.unknowns
            ),
        )

    @property
    def has_inputs(self) -> bool:
        """True if an input is among the estimated or considered unknowns."""
        return any(unknown.symbol in INPUTS for unknown in (*self.unknowns, *self.considered))

    def without_inputs(self) -> Unknowns:
        """Return the model with every input as the description states it."""
        return self.without(INPUTS)

    def without(self, symbols: Collection[str]) -> Unknowns:
        """Return the model with terms and inputs of these symbols as they should be."""
        return Unknowns(
            tuple(unknown for unknown in self.unknowns if unknown.symbol not in symbols),
            tuple(term for term in self.considered if term.symbol not in symbols),
        )

    @property
    def considered_means(self) -> list[float]:
        """Assumed values of the solution's considered columns, less nominal."""
        return [term.prior_mean for term in self.considered]

    @property
    def considered_sds(self) -> list[float]:
        """Standard uncertainties of the solution's considered columns."""
        return [term.prior[1] for term in self.considered]


@frozen
class Observation(ABC):
    """Joint measurement of n rows, and its columns."""

    #: Which of the model's unknowns and considered columns the columns below belong to.
    unknowns: tuple[int, ...]
    #: Their columns, shapes (n, m) and (n, c).
    design: Array
    considered: tuple[int, ...]
    fixed: Array

    @property
    @abstractmethod
    def source(self) -> str:
        """Name of its noise in a budget and among the noises of a fit."""

    @property
    @abstractmethod
    def run(self) -> str:
        """The run in which it was measured, or what else it is called where that is left out."""

    @property
    @abstractmethod
    def motion(self) -> str:
        """The kind of test: counter-rotating for records."""

    @abstractmethod
    def block(self, noise: Mapping[str, Noise]) -> Block:
        """Return its information on its columns, by the noise of its source."""

    def rate_variances(self, solution: Solution, weights: Array) -> tuple[float, float]:  # noqa: ARG002
        """Return the variances of a combination by random errors of rates: stated, and default.

        weights: Of the unknowns in the combination, shape (p,).
        """
        return 0.0, 0.0

    @property
    def rate_uncertainties(self) -> tuple[Array, Array]:
        """Relative standard uncertainties of its rates: stated, and default; else 0, shape (n,)."""
        return np.zeros(0), np.zeros(0)

    def with_considered_estimated(self, count: int) -> Self:
        """Return it with what is considered among the unknowns, behind `count` others."""
        indices = tuple(count + index for index in self.considered)
        extended_observation = self.with_columns(indices, self.fixed.T)
        return replace(extended_observation, considered=(), fixed=self.fixed[:, :0])

    def with_columns(self, indices: Sequence[int], columns: Sequence[Array] | Array) -> Self:
        """Return it with further unknowns: their places and what each shows, shape (n,)."""
        if not len(indices):
            return self
        return replace(
            self,
            unknowns=(*self.unknowns, *indices),
            design=np.column_stack([self.design, *columns]),
        )

    def block_in(self, model: Unknowns, noise: Mapping[str, Noise]) -> Block:
        """Return its information, with its columns at their places in a model."""
        block = self.block(noise)
        factor = np.zeros((block.factor.shape[0], len(model.unknowns)))
        factor[:, list(self.unknowns)] = block.factor
        fixed_columns = np.zeros((block.factor.shape[0], len(model.considered)))
        fixed_columns[:, list(self.considered)] = block.considered
        return replace(block, factor=factor, considered=fixed_columns)

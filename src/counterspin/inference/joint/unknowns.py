"""Linear model: estimated and considered unknowns, and the interface for observations.

Observations are records (`counterspin.inference.joint.design_blocks`), or readings and poses
(`counterspin.readings.linear`).
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
    """Return the unit of a term, a rotation parameter or an uncertain input."""
    return _UNITS.get(symbol) or term(symbol).unit


@frozen
class Unknown:
    """An unknown of the joint fit."""

    #: Name of the accelerometer, the run, or the recorder of a clock; empty: shared by all.
    owner: str
    #: A term of the table, one of `ROTATION` or of `counterspin.inference.joint.encoder.SYMBOLS`.
    symbol: str
    #: Value and standard uncertainty (infinite: no prior) of the coefficient; for an input,
    #: deviation from the stated value.
    prior: tuple[float, float]
    limit: float  #: Largest credible size.
    is_of_interest: bool = True  #: False for a nuisance parameter.
    #: True if the prior has the default standard uncertainty of the table of terms.
    has_default_prior: bool = False
    #: Default standard uncertainty of a parameter of interest, used if the poses of a triad do not
    #: determine it; infinite: none.
    default_sd: float = math.inf
    #: Names of other unknowns -> stated correlation of the priors.
    correlations: Mapping[str, float] = field(default_factory=dict, compare=False)

    @property
    def uses_fallback_prior(self) -> bool:
        """True for a parameter of interest that is not determined and has its default prior."""
        return self.is_of_interest and self.has_default_prior and self.prior[1] == self.default_sd

    @property
    def unit(self) -> str:
        """Unit of the coefficient: g-units for accelerometers, SI for other unknowns."""
        return unit_of(self.symbol)

    @property
    def nominal(self) -> float:
        """Value of the coefficient in a perfect system."""
        return TERMS[self.symbol].nominal if self.symbol in TERMS else 0.0

    @property
    def prior_mean(self) -> float:
        """Prior value minus nominal value; 0 without a prior."""
        return self.prior[0] - self.nominal if math.isfinite(self.prior[1]) else 0.0

    @property
    def prior_sd(self) -> float:
        """Standard uncertainty of the prior, or of the solver's regularisation without a prior."""
        return self.prior[1] if math.isfinite(self.prior[1]) else REGULARISATION * self.limit

    @property
    def name(self) -> str:
        """Owner and symbol, separated by a point."""
        return f"{self.owner}.{self.symbol}" if self.owner else self.symbol

    def affects(self, series: ResidualSeries) -> bool:
        """Return whether the unknown affects a series."""
        if self.symbol in ACCELEROMETER_TERMS or self.symbol == LEVER_ARM:
            return self.owner == series.accelerometer
        if self.symbol in INPUTS:
            return input_affects(series, self.symbol, self.owner)
        if self.symbol not in SHARED_TERMS and affects_readings(self.symbol):
            return False
        return self.owner in ("", series.run)


@frozen
class Considered(Unknown):
    """A considered term (Schmidt): fixed at its prior, with its uncertainty propagated."""


@frozen
class Unknowns:
    """Estimated and considered unknowns."""

    #: In the order of the rows of the solution; parameters of interest come first.
    unknowns: tuple[Unknown, ...]
    considered: tuple[Considered, ...] = ()

    @property
    def of_interest(self) -> tuple[Unknown, ...]:
        """Parameters of interest: the first of the unknowns."""
        return tuple(unknown for unknown in self.unknowns if unknown.is_of_interest)

    def with_default_priors(self, selected_unknowns: Collection[Unknown]) -> Unknowns:
        """Return the model with the default priors of some parameters of interest."""
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
        """Return the model with all inputs fixed at their stated values."""
        return self.without(INPUTS)

    def without(self, symbols: Collection[str]) -> Unknowns:
        """Return the model with terms and inputs of these symbols fixed at nominal."""
        return Unknowns(
            tuple(unknown for unknown in self.unknowns if unknown.symbol not in symbols),
            tuple(term for term in self.considered if term.symbol not in symbols),
        )

    @property
    def considered_means(self) -> list[float]:
        """Assumed values of the considered terms minus nominal values."""
        return [term.prior_mean for term in self.considered]

    @property
    def considered_sds(self) -> list[float]:
        """Standard uncertainties of the considered terms."""
        return [term.prior[1] for term in self.considered]


@frozen
class Observation(ABC):
    """Observation of n rows that are linear in the unknowns."""

    unknowns: tuple[int, ...]  #: Indices of its unknowns in the model.
    design: Array  #: Columns of these unknowns, shape (n, m).
    considered: tuple[int, ...]  #: Indices of its considered terms in the model.
    considered_design: Array  #: Columns of these considered terms, shape (n, c).

    @property
    @abstractmethod
    def source(self) -> str:
        """Name of the noise in a budget and in `JointFit.noise`."""

    @property
    @abstractmethod
    def run(self) -> str:
        """Name of the run, or of the group of readings, for the jackknife."""

    @property
    @abstractmethod
    def motion(self) -> str:
        """Test type: counter-rotating for records."""

    @abstractmethod
    def block(self, noise: Mapping[str, Noise]) -> Block:
        """Return the square-root information on the columns for given noise."""

    def rate_variances(self, solution: Solution, weights: Array) -> tuple[float, float]:  # noqa: ARG002
        """Return the variances of a combination due to random rate errors: stated, and default.

        weights: Weights of the unknowns in the combination, shape (p,).
        """
        return 0.0, 0.0

    @property
    def rate_uncertainties(self) -> tuple[Array, Array]:
        """Relative standard uncertainties of the rates: stated, and default; else 0, shape (n,)."""
        return np.zeros(0), np.zeros(0)

    def with_considered_estimated(self, count: int) -> Self:
        """Return the observation with considered terms as unknowns after `count` others."""
        indices = tuple(count + index for index in self.considered)
        extended = self.with_columns(indices, self.considered_design.T)
        return replace(extended, considered=(), considered_design=self.considered_design[:, :0])

    def with_columns(self, indices: Sequence[int], columns: Sequence[Array] | Array) -> Self:
        """Return the observation with additional unknowns: their indices and columns, (n,) each."""
        if not len(indices):
            return self
        return replace(
            self,
            unknowns=(*self.unknowns, *indices),
            design=np.column_stack([self.design, *columns]),
        )

    def expand_block(self, model: Unknowns, noise: Mapping[str, Noise]) -> Block:
        """Return the square-root information on all unknowns of a model."""
        block = self.block(noise)
        factor = np.zeros((block.factor.shape[0], len(model.unknowns)))
        factor[:, list(self.unknowns)] = block.factor
        fixed_columns = np.zeros((block.factor.shape[0], len(model.considered)))
        fixed_columns[:, list(self.considered)] = block.considered
        return replace(block, factor=factor, considered=fixed_columns)

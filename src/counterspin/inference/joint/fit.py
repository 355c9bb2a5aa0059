"""Joint estimation from all that was measured, in one fit.

Each observation, such as the record of one accelerometer in one run, is whitened and reduced to a
block of square-root information about the shared unknowns. All blocks are solved together with the
priors and the considered terms. Whatever is asked next (another noise level, a run left out, one
more considered input) starts from the prepared columns or the blocks, not from the records.

What a model assumes can only be held to the records where it may give way. Hence a fit in which
what is considered is estimated, its prior being one more observation; and one that has further
columns, such as those of a mistake that somebody may have made.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import field, replace
from functools import cached_property
from itertools import compress

import numpy as np

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.inference import least_squares
from counterspin.inference.identifiability import Assessment, assess
from counterspin.inference.joint.prepared import Prepared
from counterspin.inference.joint.unknowns import Observation, Unknown, Unknowns
from counterspin.inference.least_squares import NO_PRIOR, Block, Solution
from counterspin.inference.noise.model import Noise


@frozen
class Residuals:
    """Residuals of one series."""

    plain: Array  #: In the series' own unit, shape (n,).
    #: In rows of unit variance, shape (m,), m <= n: differences belong to the later rows.
    whitened: Array


@frozen
class JointFit:
    """A solved joint problem."""

    model: Unknowns  #: What was solved.
    solution: Solution  #: Estimates less nominal, covariances by source, sensitivities.
    #: What was measured, records first, and the square-root information of each.
    observations: tuple[Observation, ...]
    blocks: tuple[Block, ...]
    noise: Mapping[str, Noise]  #: By accelerometer, or group of readings whose noise was found.
    #: By accelerometer, where there is any: a random walk that the records do not show, N in
    #: (m/s^2)/Hz^0.5, and what it adds to the covariance, shape (p, p).
    unseen: Mapping[str, tuple[float, Array]] = field(default_factory=dict)

    @cached_property
    def prepared(self) -> tuple[Prepared, ...]:
        """The records among what was measured: the first of it."""
        return tuple(one for one in self.observations if isinstance(one, Prepared))

    def with_noise(self, noise: Mapping[str, Noise]) -> JointFit:
        """Return the fit with other noise; what keeps its noise remains as it is reduced."""
        every = {**self.noise, **noise}
        blocks = tuple(
            one.block_in(self.model, every) if one.source in noise else block
            for block, one in zip(self.blocks, self.observations, strict=True)
        )
        solution = solve_blocks(blocks, self.model)
        return replace(self, solution=solution, blocks=blocks, noise=every, unseen={})

    def only(self, kept: Sequence[bool]) -> JointFit:
        """Return the fit of some of the observations."""
        blocks = tuple(compress(self.blocks, kept))
        return replace(
            self,
            observations=tuple(compress(self.observations, kept)),
            blocks=blocks,
            solution=solve_blocks(blocks, self.model),
            unseen={},
        )

    def without_run(self, run: str) -> Solution | None:
        """Return the solution without one run; None if nothing is left."""
        if run not in self._without:
            every = zip(self.blocks, self.observations, strict=True)
            kept = [block for block, one in every if one.run != run]
            self._without[run] = solve_blocks(kept, self.model) if kept else None
        return self._without[run]

    @cached_property
    def _without(self) -> dict[str, Solution | None]:
        """The solutions that were asked for: all accelerometers ask for the same."""
        return {}

    @cached_property
    def relaxed(self) -> Solution:
        """The solution with considered terms estimated too, each held by its prior.

        Its unknowns are those of the model, then the considered ones. It is what the records and
        everything known beforehand say together, and so what they are compared with: a considered
        term that is not what was assumed is no lack of fit as long as its uncertainty allows it.
        """
        if not self.model.considered:
            return self.solution
        return solve_relaxed(self.blocks, self.model)

    @cached_property
    def assessment(self) -> Assessment:
        """Mask of the parameters of interest that are determined."""
        asked = self.model.asked
        assessment = assess(
            self.solution,
            [unknown.name for unknown in asked],
            nominal=[unknown.nominal for unknown in asked],
        )
        not_determined = {unknown.name: False for unknown in asked if unknown.defaulted}
        return replace(assessment, determined=assessment.determined | not_determined)

    @cached_property
    def residuals(self) -> tuple[Residuals, ...]:
        """Residuals of each series, with considered terms at their estimates."""
        return tuple(self._residuals_of(prepared) for prepared in self.prepared)

    def _residuals_of(self, prepared: Prepared) -> Residuals:
        series, estimate, p = prepared.series, self.relaxed.estimate, len(self.model.unknowns)
        left = series.error - prepared.design @ estimate[list(prepared.unknowns)]
        left = left - prepared.fixed @ estimate[[p + place for place in prepared.considered]]
        whiten = series.whitener(self.noise[series.accelerometer])
        if whiten.polynomials == 0:
            # The differences have removed the start errors; the plain residuals need them back.
            own = series.polynomials(series.order)
            start = np.linalg.lstsq(own, left, rcond=None)[0]
            return Residuals(left - own @ start, whiten.apply(left))
        own = series.polynomials(whiten.polynomials)
        rows = whiten.apply(np.column_stack([own, left]))
        start = np.linalg.lstsq(rows[:, :-1], rows[:, -1], rcond=None)[0]
        return Residuals(left - own @ start, rows[:, -1] - rows[:, :-1] @ start)

    @cached_property
    def degrees_of_freedom(self) -> tuple[float, ...]:
        """Degrees of freedom of each observation's residuals.

        Rows less its own unknowns, less what the fit of all observations and priors follows.
        """
        ends = np.cumsum([block.factor.shape[0] for block in self.blocks])
        leverages = self.relaxed.leverages[: ends[-1]]
        followed = np.add.reduceat(leverages, np.append(0, ends[:-1]))
        return tuple(
            block.rows - block.nuisance - float(part)
            for block, part in zip(self.blocks, followed, strict=True)
        )


def solve_joint(
    observations: Sequence[Observation], model: Unknowns, noise: Mapping[str, Noise]
) -> JointFit:
    """Solve a prepared problem for given noise."""
    blocks = tuple(one.block_in(model, noise) for one in observations)
    return JointFit(model, solve_blocks(blocks, model), tuple(observations), blocks, noise)


def solve_blocks(blocks: Sequence[Block], model: Unknowns) -> Solution:
    """Solve blocks with the priors and considered terms of a model."""
    return least_squares.solve(
        blocks,
        prior_mean=[unknown.prior_mean for unknown in model.unknowns],
        prior_sd=[unknown.prior[1] for unknown in model.unknowns],
        considered_mean=model.considered_means,
        considered_sd=model.considered_sizes,
        limits=[unknown.limit for unknown in model.unknowns],
    )


def relaxed_block(block: Block) -> Block:
    """Return a block whose considered terms are unknowns, after the others."""
    return replace(
        block,
        factor=np.hstack([block.factor, block.considered]),
        considered=block.considered[:, :0],
    )


def solve_relaxed(blocks: Sequence[Block], model: Unknowns) -> Solution:
    """Solve blocks with considered terms estimated too, as `JointFit.relaxed`."""
    unknowns = (*model.unknowns, *model.considered)
    return least_squares.solve(
        [relaxed_block(block) for block in blocks],
        prior_mean=[unknown.prior_mean for unknown in unknowns],
        prior_sd=[unknown.prior[1] for unknown in unknowns],
        limits=[unknown.limit for unknown in unknowns],
    )


# More unknowns ---------------------------------------------------------------------------------


def relax(fit: JointFit) -> JointFit:
    """Return the fit with all that is considered as unknowns, each with its prior.

    The unknowns of the model come first, in their order, then the considered ones. Noise that
    the records do not show is left out.
    """
    model = fit.model
    if not model.considered:
        return replace(fit, unseen={})
    p = len(model.unknowns)
    considered = [
        Unknown(other.owner, other.symbol, other.prior, other.limit, other.asked, other.unstated)
        for other in model.considered
    ]
    whole = Unknowns((*model.unknowns, *considered))
    return replace(
        fit,
        model=whole,
        solution=fit.relaxed,
        observations=tuple(one.relaxed(p) for one in fit.observations),
        blocks=tuple(relaxed_block(block) for block in fit.blocks),
        unseen={},
    )


def widened(
    fit: JointFit, columns: Sequence[Mapping[int, Array]]
) -> tuple[tuple[Observation, ...], tuple[Block, ...]]:
    """Return observations and blocks of a relaxed fit with further columns, behind the unknowns'.

    columns: Of each: the place of an observation -> what it shows of one unit, shape (n,); one
        that is not named shows nothing.
    """
    p, m = len(fit.model.unknowns), len(columns)
    added = [Unknown("", str(place), NO_PRIOR, 1.0) for place in range(m)]
    model = replace(fit.model, unknowns=(*fit.model.unknowns, *added))
    observations, blocks = [], []
    for i, (one, block) in enumerate(zip(fit.observations, fit.blocks, strict=True)):
        shown = {p + k: column[i] for k, column in enumerate(columns) if i in column}
        observations.append(one.with_columns(tuple(shown), tuple(shown.values())))
        blocks.append(
            observations[-1].block_in(model, fit.noise)
            if shown
            else replace(block, factor=np.pad(block.factor, ((0, 0), (0, m))))
        )
    return tuple(observations), tuple(blocks)


def extended(
    fit: JointFit, unknowns: Sequence[Unknown], columns: Sequence[Mapping[int, Array]]
) -> JointFit:
    """Return a relaxed fit with further unknowns; columns as of `widened`."""
    observations, blocks = widened(fit, columns)
    model = replace(fit.model, unknowns=(*fit.model.unknowns, *unknowns))
    solution = solve_blocks(blocks, model)
    return replace(fit, model=model, solution=solution, observations=observations, blocks=blocks)

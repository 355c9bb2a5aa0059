"""Joint estimation from full records: every sample of every run and accelerometer in one fit.

Each `Series` (one accelerometer in one run) is whitened and reduced to a block of square-root
information about the shared unknowns, its own start offset and velocity projected out. All blocks
are solved together with the priors and the considered terms. Whatever is asked next (another
noise level, a run left out, one more considered input) starts from the prepared columns or the
blocks, not from the records.

The problem is an `Unknowns` (`counterspin.inference.joint.unknowns`) beside the series
(`counterspin.inference.joint.series`).

- `prepare`, `prepare_again`: the columns, each computed once
- `solve_joint`, `with_noise`, `JointFit`: the answer
- `residuals`, `freedom`, `unexplained`, `leave_out`: checks of it
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from counterspin.arrays import Array
from counterspin.errors import NotIdentifiableError
from counterspin.inference import least_squares
from counterspin.inference.blocks import Block, reduce_block
from counterspin.inference.joint import encoder
from counterspin.inference.joint.inputs import INPUTS, TIMING, input_column, rotation_column
from counterspin.inference.joint.series import Series
from counterspin.inference.joint.unknowns import ROTATION, Considered, Unknown, Unknowns
from counterspin.inference.least_squares import Solution
from counterspin.inference.noise.model import NoiseModel
from counterspin.physics.accelerometer import PLATFORM_TERMS, TERMS

__all__ = [
    "INPUTS",
    "ROTATION",
    "TIMING",
    "Considered",
    "JointFit",
    "Prepared",
    "Unknown",
    "freedom",
    "leave_out",
    "prepare",
    "prepare_again",
    "residuals",
    "solve_joint",
    "unexplained",
    "with_noise",
]


@dataclass(frozen=True)
class Prepared:
    """A series and its columns, ready to be weighted with any noise.

    Attributes
    ----------
    series
        The series.
    scale_factor
        K_I with which it sees the platform's errors.
    unknowns, considered
        Which of the model's unknowns and considered columns the columns below belong to.
    design, fixed
        Their columns, shapes (n, m) and (n, c).
    """

    series: Series
    scale_factor: float
    unknowns: tuple[int, ...]
    design: Array
    considered: tuple[int, ...]
    fixed: Array


def prepare(
    series: Sequence[Series],
    model: Unknowns,
    scale_factors: Mapping[str, float],
    estimate: Array | None = None,
) -> tuple[Prepared, ...]:
    """Compute every column of a problem.

    Parameters
    ----------
    series
        The data.
    model
        What is estimated and considered.
    scale_factors
        K_I of each accelerometer, with which it sees the platform's errors.
    estimate
        Values of the unknowns, less nominal, shape (p,), at which the uncertain inputs'
        derivatives are taken; None: those of a perfect system.
    """
    values = np.zeros(len(model.unknowns)) if estimate is None else estimate
    return tuple(
        _prepare(one, model, scale_factors[one.accelerometer], values, {}) for one in series
    )


def prepare_again(
    fit: JointFit, model: Unknowns, scale_factors: Mapping[str, float]
) -> tuple[Prepared, ...]:
    """Return the columns of a solved problem for another model or for other scale factors.

    A record shows of a term what it did, but for the scale factor with which it shows the
    platform's: only what is new is computed. Derivatives that depend on the unknowns are taken at
    the fit's estimate; unknowns that it did not have count as nominal.

    Parameters
    ----------
    fit
        The solved problem.
    model, scale_factors
        As for `prepare`.
    """
    found = dict(zip(fit.model.unknowns, fit.solution.estimate.tolist(), strict=True))
    values = np.array([found.get(unknown, 0.0) for unknown in model.unknowns])
    return tuple(
        _prepare(one.series, model, factor, values, _terms_shown(one, fit.model, factor))
        for one in fit.prepared
        for factor in (scale_factors[one.series.accelerometer],)
    )


def _terms_shown(prepared: Prepared, model: Unknowns, scale_factor: float) -> dict[str, Array]:
    """Return term -> its column, of those that stay as they are whatever the estimate is."""
    columns = [*prepared.design.T, *prepared.fixed.T]
    terms = [model.unknowns[i].symbol for i in prepared.unknowns]
    terms += [model.considered[i].symbol for i in prepared.considered if i < len(model.considered)]
    ratio = scale_factor / prepared.scale_factor
    return {
        symbol: ratio * column if symbol in PLATFORM_TERMS else column
        for symbol, column in zip(terms, columns, strict=False)
        if symbol not in encoder.SYMBOLS
    }


def _prepare(
    series: Series,
    model: Unknowns,
    scale_factor: float,
    estimate: Array,
    shown: Mapping[str, Array],
) -> Prepared:
    """Compute the columns of one series, but for those that are known already."""
    unknowns = tuple(i for i, unknown in enumerate(model.unknowns) if unknown.concerns(series))
    considered = tuple(i for i, other in enumerate(model.considered) if other.concerns(series))
    symbols = [model.unknowns[i].symbol for i in unknowns]
    ignored = [model.considered[i].symbol for i in considered]
    turned = [symbol for symbol in (*symbols, *ignored) if symbol in ROTATION]
    encoded = [symbol for symbol in (*symbols, *ignored) if symbol in encoder.SYMBOLS]
    terms = [symbol for symbol in (*symbols, *ignored) if symbol not in (*turned, *encoded)]
    new = [symbol for symbol in terms if symbol not in shown]
    table = dict(shown)
    table |= dict(zip(new, series.columns(new, scale_factor).T, strict=True))
    table |= {s: rotation_column(series, s) for s in turned if s not in shown}
    known = {s: v for s, v in zip(symbols, estimate[list(unknowns)], strict=True) if s in terms}
    own = {"K_I": scale_factor - 1.0} | {s: v for s, v in known.items() if s in TERMS}
    table |= dict(zip(encoded, encoder.columns(series, encoded, own).T, strict=True))
    n = series.time.size
    design = np.column_stack([table[s] for s in symbols] or [np.empty((n, 0))])
    fixed = [table[symbol] for symbol in ignored]
    first_input = len(model.considered)
    for name in model.inputs or ():
        fixed.append(input_column(series, name, scale_factor, known, table))
    inputs = tuple(range(first_input, first_input + len(model.inputs or ())))
    return Prepared(
        series,
        scale_factor,
        unknowns,
        design,
        considered + inputs,
        np.column_stack(fixed or [np.empty((n, 0))]),
    )


@dataclass(frozen=True)
class JointFit:
    """A solved joint problem.

    Attributes
    ----------
    model
        What was solved.
    solution
        Estimates less nominal, covariances by source, sensitivities.
    prepared, blocks
        The columns and each series' square-root information, in the order of the series.
    noise
        By accelerometer.
    unseen
        By accelerometer, where there is any: a random walk that the records do not show, N in
        (m/s^2)/Hz^0.5, and what it adds to the covariance, shape (p, p).
    """

    model: Unknowns
    solution: Solution
    prepared: tuple[Prepared, ...]
    blocks: tuple[Block, ...]
    noise: Mapping[str, NoiseModel]
    unseen: Mapping[str, tuple[float, Array]] = field(default_factory=dict)

    @cached_property
    def known_residuals(self) -> dict[int, tuple[Array, Array]]:
        """What `residuals` has worked out already, for several checks ask for the same."""
        return {}


def solve_joint(
    prepared: Sequence[Prepared], model: Unknowns, noise: Mapping[str, NoiseModel]
) -> JointFit:
    """Solve a prepared problem for given noise.

    Parameters
    ----------
    prepared
        From `prepare`, for the same model.
    model
        What is estimated and considered.
    noise
        By accelerometer.

    Returns
    -------
    JointFit

    Raises
    ------
    NotIdentifiableError
        If a record is too short for its own start offset and velocity.
    """
    blocks = tuple(_block(one, model, noise[one.series.accelerometer]) for one in prepared)
    return JointFit(model, _solve(blocks, model), tuple(prepared), blocks, noise)


def with_noise(fit: JointFit, noise: Mapping[str, NoiseModel]) -> JointFit:
    """Return the fit with other noise; records whose noise stays remain as they are reduced.

    Parameters
    ----------
    fit
        A solved problem.
    noise
        By accelerometer, of those whose noise is another.
    """
    blocks = list(fit.blocks)
    for index, one in enumerate(fit.prepared):
        name = one.series.accelerometer
        if name in noise:
            before = fit.noise[name]
            blocks[index] = _block_again(blocks[index], one, fit.model, before, noise[name])
    solution = _solve(blocks, fit.model)
    return JointFit(fit.model, solution, fit.prepared, tuple(blocks), {**fit.noise, **noise})


def _block_again(
    block: Block, prepared: Prepared, model: Unknowns, before: NoiseModel, after: NoiseModel
) -> Block:
    """Reduce a series again; where only the level of its white noise is another, scale it."""
    was, now = (prepared.series.total(noise) for noise in (before, after))
    if was.random_walk > 0.0 or now.random_walk > 0.0 or now.sample_variance == 0.0:
        return _block(prepared, model, after)
    ratio = math.sqrt(was.sample_variance / now.sample_variance)
    return replace(
        block,
        factor=ratio * block.factor,
        target=ratio * block.target,
        considered=ratio * block.considered,
        rss=ratio**2 * block.rss,
    )


def _block(prepared: Prepared, model: Unknowns, noise: NoiseModel) -> Block:
    """Whiten one series and reduce it, then put its columns where the model has them."""
    series = prepared.series
    if series.time.size <= series.order:
        raise NotIdentifiableError(
            f"{series.accelerometer} in {series.run}: {series.time.size} samples do not determine "
            "the record's own start offset and start velocity; the record is too short"
        )
    whiten = series.whitener(noise)
    own = series.polynomials(whiten.polynomials)
    rows = whiten.apply(np.column_stack([own, prepared.design, prepared.fixed, series.error]))
    m, p = whiten.polynomials, prepared.design.shape[1]
    block = reduce_block(rows[:, m : m + p], rows[:, -1], rows[:, :m], rows[:, m + p : -1])
    factor = np.zeros((block.factor.shape[0], len(model.unknowns)))
    factor[:, list(prepared.unknowns)] = block.factor
    fixed = np.zeros((block.factor.shape[0], len(model.considered_names)))
    fixed[:, list(prepared.considered)] = block.considered
    return replace(block, factor=factor, considered=fixed)


def _solve(blocks: Sequence[Block], model: Unknowns) -> Solution:
    inputs = model.inputs or {}
    return least_squares.solve(
        blocks,
        prior_mean=_prior_means(model.unknowns),
        prior_sd=[unknown.prior[1] for unknown in model.unknowns],
        considered_mean=[*_prior_means(model.considered), *(0.0 for _ in inputs)],
        considered_sd=[*(other.prior[1] for other in model.considered), *inputs.values()],
        limits=[unknown.limit for unknown in model.unknowns],
    )


def _prior_means(unknowns: Sequence[Unknown]) -> list[float]:
    """Return prior values less nominal; where nothing is known, nominal itself."""
    return [
        unknown.prior[0] - unknown.nominal if np.isfinite(unknown.prior[1]) else 0.0
        for unknown in unknowns
    ]


def unexplained(prepared: Prepared, model: Unknowns) -> Array:
    """Return a series' error less what the considered terms' assumed values put into it, (n,)."""
    means = np.array(_prior_means(model.considered) + [0.0] * len(model.inputs or ()))
    left: Array = prepared.series.error - prepared.fixed @ means[list(prepared.considered)]
    return left


def leave_out(fit: JointFit, run: str) -> Solution | None:
    """Return the solution without one run; None if nothing is left."""
    kept = [
        block for block, one in zip(fit.blocks, fit.prepared, strict=True) if one.series.run != run
    ]
    return _solve(kept, fit.model) if kept else None


def freedom(fit: JointFit) -> list[float]:
    """Return the degrees of freedom of each series' residuals.

    Rows less the series' own unknowns, less what the fit of all series and priors follows of it.
    """
    ends = np.cumsum([block.factor.shape[0] for block in fit.blocks])
    followed = np.add.reduceat(fit.solution.leverages, np.append(0, ends[:-1]))
    return [
        block.rows - block.nuisance - float(part)
        for block, part in zip(fit.blocks, followed, strict=True)
    ]


def residuals(fit: JointFit, index: int) -> tuple[Array, Array]:
    """Return the residuals of one series: in its own unit (n,), and whitened (m,).

    Parameters
    ----------
    fit
        The solved problem.
    index
        Which series.
    """
    if index not in fit.known_residuals:
        fit.known_residuals[index] = _residuals(fit, index)
    return fit.known_residuals[index]


def _residuals(fit: JointFit, index: int) -> tuple[Array, Array]:
    prepared = fit.prepared[index]
    series = prepared.series
    left = unexplained(prepared, fit.model)
    left = left - prepared.design @ fit.solution.estimate[list(prepared.unknowns)]
    whiten = series.whitener(fit.noise[series.accelerometer])
    if whiten.polynomials == 0:
        # The differences have removed the start errors; the plain residuals need them back.
        own = series.polynomials(series.order)
        start = np.linalg.lstsq(own, left, rcond=None)[0]
        return left - own @ start, whiten.apply(left)
    own = series.polynomials(whiten.polynomials)
    rows = whiten.apply(np.column_stack([own, left]))
    start = np.linalg.lstsq(rows[:, :-1], rows[:, -1], rcond=None)[0]
    return left - own @ start, rows[:, -1] - rows[:, :-1] @ start

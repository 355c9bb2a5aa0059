"""Trials of the joint fit without records: its estimate straight from its distribution.

Given the rotation, the joint fit is linear, so that with Gaussian noise of known size its estimate
is normal about a linear function of what is true. Each series is whitened and reduced once, the
columns of what is true carried along as considered terms; a trial then costs as many normals as
there are unknowns. A radius that varies enters every column as a polynomial of the third degree,
exactly, because no term has more than three factors.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.inference import least_squares
from counterspin.inference.blocks import Block, reduce_block
from counterspin.inference.identifiability import assess
from counterspin.inference.joint.prepared import prepare_columns
from counterspin.inference.joint.series import Series
from counterspin.inference.joint.unknowns import Unknowns
from counterspin.inference.least_squares import Solution
from counterspin.inference.noise.model import Noise
from counterspin.studies.analyses import JointRequest
from counterspin.studies.draws import RADIUS, Draws, StudyTruth, nominal, of_run
from counterspin.studies.noise import estimate_noise
from counterspin.studies.trials import Trials

#: Nodes in the radius: no product of the table has more than three factors.
_RADIUS_POWERS: Final = 4


@frozen
class JointEngine:
    """Trials of one joint analysis."""

    rows: tuple[int, ...]  #: Places in the model of the unknowns that are reported.
    #: Estimate, nominal value added, where all that is true is nominal, shape (c,).
    constant: Array
    #: (owner, symbol, run, power of the radius) -> d(estimate)/d(value), shape (c,); run is None
    #: where the runs share one value.
    response: Mapping[tuple[str, str, int | None, int], Array]
    radius_response: Array  #: d(estimate)/d(radius) through the reference displacement, shape (c,).
    spread: Array  #: What independent normals are multiplied with, shape (c, c).
    u: Array  #: Combined standard uncertainty, shape (c,).
    #: The radius assumed, and what its deviation is divided by before powers are taken.
    radius: float
    scale: float
    white: float  #: The white noise assumed, m.

    @classmethod
    def prepare(
        cls, series: Sequence[Series], request: JointRequest, truth: StudyTruth
    ) -> tuple[JointEngine, tuple[str, ...]]:
        """Reduce all series and solve once."""
        noise = request.noise
        radius = series[0].trajectory.radius
        # The range of the study conditions the powers of the radius well.
        low, high = truth.bounds(RADIUS, 0)
        scale = max(abs(low - radius), abs(high - radius), 1e-6 * radius)
        model = request.model
        names = list(dict.fromkeys(record.run for record in series))
        keys = _truth_keys(series, truth, names, varies=truth.varies(RADIUS) or low != radius)
        blocks = []
        for record in series:
            given = noise[record.accelerometer]
            blocks.append(_block(record, model, given, keys, names, scale, truth))
        solution = _solve(blocks, model, len(keys) + 1)
        assessment = assess(solution, [u.name for u in model.unknowns])
        rows = [i for i in request.reported if assessment.determined[model.unknowns[i].name]]
        lost = tuple(model.unknowns[i].name for i in request.reported if i not in rows)
        c = len(model.considered)
        moved = -solution.sensitivity_considered[:, c:][rows]
        values, vectors = np.linalg.eigh(solution.covariance_noise[np.ix_(rows, rows)])
        covariance = (
            solution.covariance_noise + solution.covariance_prior + solution.covariance_considered
        )
        first = noise[series[0].accelerometer]
        engine = cls(
            rows=tuple(rows),
            constant=solution.estimate[rows] + np.array([model.unknowns[i].nominal for i in rows]),
            response={key: moved[:, index] for index, key in enumerate(keys)},
            radius_response=moved[:, -1],
            spread=vectors * np.sqrt(np.maximum(values, 0.0)),
            u=np.sqrt(np.diag(covariance)[rows]),
            radius=radius,
            scale=scale,
            white=math.sqrt(first.sample_variance),
        )
        return engine, lost

    def trials(self, draws: Draws, generator: np.random.Generator) -> Trials:
        """Return what the analysis says of n trials; see `Engine`."""
        n = draws.trials
        scale = draws.white / self.white if self.white > 0.0 else 1.0
        estimate = estimate_noise(generator, self.spread, scale, n)
        estimate += self.constant[:, None]
        away = draws.radius - self.radius
        estimate += np.outer(self.radius_response, away)
        for (owner, symbol, run, power), response in self.response.items():
            size = of_run(draws.values[owner, symbol], run or 0) - nominal(owner, symbol)
            if power:
                size = size * (away / self.scale) ** power
            estimate += np.outer(response, size)
        u = np.broadcast_to(self.u[:, None], estimate.shape)
        return Trials(estimate, u, np.full((1, 1), math.inf) * np.ones((len(self.u), 1)))


def scale_factors(series: Sequence[Series], model: Unknowns, truth: StudyTruth) -> dict[str, float]:
    """Return the K_I with which each accelerometer sees the platform's errors.

    `calibrate` takes it from the estimate; here what is true on average stands for that.
    """
    factors = {}
    for name in dict.fromkeys(record.accelerometer for record in series):
        known = [c.prior[0] for c in model.considered if c.owner == name and c.symbol == "K_I"]
        factors[name] = known[0] if known else truth.mean(name, "K_I")
    return factors


def _truth_keys(
    series: Sequence[Series], truth: StudyTruth, runs: Sequence[str], *, varies: bool
) -> list[tuple[str, str, int | None, int]]:
    """Return a key for each column of what is true."""
    accelerometers = {record.accelerometer for record in series}
    keys: list[tuple[str, str, int | None, int]] = []
    for owner, symbols in truth.symbols.items():
        if owner and owner not in accelerometers:
            continue
        for symbol in symbols:
            fixed = truth.fixed.get((owner, symbol))
            several = fixed is not None and fixed.size > 1
            several |= any(
                (varying.owner, varying.symbol) == (owner, symbol) and varying.per_run
                for varying in truth.varying
            )
            places: list[int | None] = list(range(len(runs))) if several else [None]
            powers = range(_RADIUS_POWERS if varies else 1)
            keys += [(owner, symbol, place, power) for place in places for power in powers]
    return keys


def _block(
    series: Series,
    model: Unknowns,
    noise: Noise,
    keys: Sequence[tuple[str, str, int | None, int]],
    runs: Sequence[str],
    scale: float,
    truth: StudyTruth,
) -> Block:
    """Whiten and reduce one series: unknowns, considered terms, columns of what is true."""
    factors = scale_factors([series], model, truth)
    expected = np.array([truth.mean(u.owner, u.symbol) - u.nominal for u in model.unknowns])
    (prepared,) = prepare_columns([series], model, factors, expected)
    mine = {
        key: index
        for index, key in enumerate(keys)
        if key[0] in ("", series.accelerometer) and key[2] in (None, runs.index(series.run))
    }
    true = np.zeros((series.time.size, len(keys) + 1))
    symbols = list(dict.fromkeys(symbol for _, symbol, _, _ in mine))
    powers = max((power for *_, power in mine), default=0) + 1
    k_i = truth.mean(series.accelerometer, "K_I")
    columns = _in_radius(series, symbols, k_i, powers, scale)
    for (_, symbol, _, power), index in mine.items():
        true[:, index] = columns[power][:, symbols.index(symbol)]
    motion = series.trajectory
    alone = replace(motion, site=replace(motion.site, removed_gravity=None))
    true[:, -1] = series.reference(alone) / motion.radius  # the circle goes with its radius
    whiten = series.whitener(noise)
    own = series.polynomials(whiten.polynomials)
    rows = whiten.apply(np.column_stack([own, prepared.design, prepared.fixed, true]))
    m, p = whiten.polynomials, prepared.design.shape[1]
    block = reduce_block(rows[:, m : m + p], np.zeros(rows.shape[0]), rows[:, :m], rows[:, m + p :])
    factor = np.zeros((block.factor.shape[0], len(model.unknowns)))
    factor[:, list(prepared.unknowns)] = block.factor
    c = len(model.considered)
    fixed = np.zeros((block.factor.shape[0], c + true.shape[1]))
    places = [*prepared.considered, *range(c, c + true.shape[1])]
    fixed[:, places] = block.considered
    return replace(block, factor=factor, considered=fixed)


def _in_radius(
    series: Series, symbols: Sequence[str], scale_factor: float, powers: int, scale: float
) -> list[Array]:
    """Return the columns as coefficients of powers of the radius' scaled deviation."""
    if powers == 1:
        return [series.columns(symbols, scale_factor)]
    nodes = np.polynomial.chebyshev.chebpts2(powers)
    motion = series.trajectory
    values = np.array(
        [
            series.columns(
                symbols, scale_factor, replace(motion, radius=motion.radius + scale * float(x))
            )
            for x in nodes
        ]
    )
    inverse = np.linalg.inv(np.vander(nodes, increasing=True))
    return list(np.tensordot(inverse, values, axes=1))


def _solve(blocks: Sequence[Block], model: Unknowns, true: int) -> Solution:
    """Solve with the columns of what is true as considered terms without uncertainty."""
    return least_squares.solve(
        blocks,
        prior_mean=[u.prior_mean for u in model.unknowns],
        prior_sd=[u.prior[1] for u in model.unknowns],
        considered_mean=[*model.considered_means, *(0.0 for _ in range(true))],
        considered_sd=[*model.considered_sizes, *(0.0 for _ in range(true))],
        limits=[u.limit for u in model.unknowns],
    )

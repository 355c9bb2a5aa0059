"""The columns of each record, computed once, weighted with any noise, and condensed.

Beside a few coefficients that are asked for a fit has dozens of unknowns that only have a prior:
inputs, and terms at their typical sizes. In units of its prior's standard uncertainty each is a
normal deviate, and so is every orthogonal combination of them. In the directions of the columns'
singular vectors most of them do nothing that the noise would not hide a thousand times: what is
left is a dozen columns, which serve wherever a fit is repeated for other rows or another noise.
What is asked for has the same estimate and covariance, but for that.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Final

import numpy as np
import numpy.typing as npt

from counterspin.arrays import SIGMA_OF_MAD, Array, median, triangle_of
from counterspin.errors import NotIdentifiableError
from counterspin.frozen import frozen
from counterspin.inference.joint import encoder
from counterspin.inference.joint.series import (
    Series,
    expected_output,
    input_column,
    rotation_column,
)
from counterspin.inference.joint.unknowns import ROTATION, Observation, Unknown, Unknowns
from counterspin.inference.least_squares import Block, reduce_rows
from counterspin.inference.noise.model import Noise
from counterspin.physics.terms import INPUTS, SHARED_TERMS, TERMS


@frozen
class Prepared(Observation):
    """A series and its columns, ready to be weighted with any noise."""

    series: Series  #: The series.
    scale_factor: float  #: K_I with which it sees the platform's errors.

    @property
    def accelerometer(self) -> str:
        """Whose record it is, and so its noise."""
        return self.series.accelerometer

    source = accelerometer

    @property
    def run(self) -> str:
        """The run in which it was taken."""
        return self.series.run

    @property
    def motion(self) -> str:
        """Records are of a double turntable."""
        return "counter-rotating"

    def block(self, noises: Mapping[str, Noise]) -> Block:
        """Return the record's information on its columns, its start errors projected out."""
        noise = noises[self.accelerometer]
        uneven = noise.random_walk > 0.0 or noise.wanders or self.series.jitter > 0.0
        if uneven or noise.sample_variance == 0.0:
            return self._weighted(noise)
        return self.white.scaled(1.0 / math.sqrt(noise.sample_variance))

    @cached_property
    def white(self) -> Block:
        """The same for white noise of 1 per sample: of any other size it is in proportion."""
        return self._weighted(Noise(1.0))

    def _weighted(self, noise: Noise) -> Block:
        series = self.series
        if series.time.size <= series.order:
            raise NotIdentifiableError(
                f"{series.accelerometer} in {series.run}: {series.time.size} samples do not "
                "determine the record's own start offset and start velocity; the record is too "
                "short"
            )
        whiten = series.whitener(noise)
        own = series.polynomials(whiten.polynomials)
        rows = whiten.apply(np.column_stack([own, self.design, self.fixed, series.error]))
        return reduce_rows(rows, whiten.polynomials, self.design.shape[1])

    def without(self, drop: npt.NDArray[np.bool_]) -> Prepared:
        """Return the series and its columns without the rows where `drop` is true."""
        keep = np.logical_not(drop)
        return replace(
            self,
            series=self.series.without(drop),
            design=self.design[keep],
            fixed=self.fixed[keep],
        )

    def again(
        self, before: Unknowns, after: Unknowns, scale_factor: float, estimate: Array
    ) -> Prepared:
        """Return the columns for another model or another scale factor; only new ones are computed.

        A record shows of a term what it did, but for the scale factor with which it shows the
        platform's.
        """
        columns = [*self.design.T, *self.fixed.T]
        terms = [before.unknowns[i].symbol for i in self.unknowns]
        terms += [before.considered[i].symbol for i in self.considered]
        ratio = scale_factor / self.scale_factor
        shown = {
            symbol: ratio * column if symbol in SHARED_TERMS else column
            for symbol, column in zip(terms, columns, strict=True)
            # What the encoder leaves open, and what an input does, depend on the estimate.
            if symbol not in encoder.SYMBOLS and symbol not in INPUTS
        }
        return _prepare(self.series, after, scale_factor, estimate, shown)


def prepare_columns(
    series: Sequence[Series],
    model: Unknowns,
    scale_factors: Mapping[str, float],
    estimate: Array | None = None,
) -> tuple[Prepared, ...]:
    """Compute every column of a problem.

    scale_factors: K_I of each accelerometer, with which it sees the platform's errors.
    estimate: Values of the unknowns, less nominal, shape (p,), at which the uncertain inputs'
        derivatives are taken; None: those of a perfect system.
    """
    values = np.zeros(len(model.unknowns)) if estimate is None else estimate
    return tuple(
        _prepare(record, model, scale_factors[record.accelerometer], values, {})
        for record in series
    )


def prepared_for(
    prepared: Sequence[Prepared],
    before: Unknowns,
    after: Unknowns,
    scale_factors: Mapping[str, float],
    known: Mapping[Unknown, float],
) -> tuple[Prepared, ...]:
    """Return the columns for another model or for other scale factors; only new are computed."""
    values = np.array([known.get(unknown, 0.0) for unknown in after.unknowns])
    return tuple(
        part.again(before, after, scale_factors[part.accelerometer], values) for part in prepared
    )


def _prepare(
    series: Series,
    model: Unknowns,
    scale_factor: float,
    estimate: Array,
    shown: Mapping[str, Array],
) -> Prepared:
    """Compute the columns of one series, except those that are known already."""
    unknowns = tuple(i for i, unknown in enumerate(model.unknowns) if unknown.concerns(series))
    considered = tuple(i for i, other in enumerate(model.considered) if other.concerns(series))
    symbols = [model.unknowns[i].symbol for i in unknowns]
    ignored = [model.considered[i].symbol for i in considered]
    turned = [symbol for symbol in (*symbols, *ignored) if symbol in ROTATION]
    encoded = [symbol for symbol in (*symbols, *ignored) if symbol in encoder.SYMBOLS]
    inputs = [symbol for symbol in (*symbols, *ignored) if symbol in INPUTS]
    apart = {*turned, *encoded, *inputs}
    terms = [symbol for symbol in (*symbols, *ignored) if symbol not in apart]
    new = [symbol for symbol in terms if symbol not in shown]
    table = dict(shown)
    table |= dict(zip(new, series.columns(new, scale_factor).T, strict=True))
    table |= {s: rotation_column(series, s) for s in turned if s not in shown}
    # What nobody asks for is small, and its part in what an input does is of second order.
    asked = {model.unknowns[i].symbol for i in unknowns if model.unknowns[i].asked}
    values = zip(symbols, estimate[list(unknowns)].tolist(), strict=True)
    known = {s: v for s, v in values if s in terms and s in asked}
    own = {"K_I": scale_factor - 1.0} | {s: v for s, v in known.items() if s in TERMS}
    if series.share > 0.0:
        # The rotation is less certain then, and its product with what is held counts too.
        held = [model.considered[i] for i in considered]
        own |= {
            one.symbol: math.hypot(one.prior_mean, one.prior[1])
            for one in held
            if one.symbol in TERMS and one.symbol != "K_I"
        }
    table |= dict(zip(encoded, encoder.columns(series, encoded, own).T, strict=True))
    if inputs:
        now = expected_output(series, known, table)
        table |= {s: input_column(series, s, scale_factor, known, now) for s in inputs}
    return Prepared(
        unknowns,
        _stacked(series, [table[symbol] for symbol in symbols]),
        considered,
        _stacked(series, [table[symbol] for symbol in ignored]),
        series,
        scale_factor,
    )


def _stacked(series: Series, columns: Sequence[Array]) -> Array:
    # Column by column in memory: to put them row by row takes a second time as long.
    return np.array(columns).T if len(columns) else np.empty((series.time.size, 0))


#: Columns are left out whose effect, all rows together, is below this part of the noise of one row.
_LEAST_EFFECT: Final = 0.02

#: Largest credible size of a condensed unknown, in standard deviations.
_LIMIT: Final = 1e3


def condense(
    prepared: Sequence[Prepared], model: Unknowns, noise: Mapping[str, float | None]
) -> tuple[tuple[Prepared, ...], Unknowns]:
    """Return columns and model with what nobody asks for condensed, after what is asked for.

    noise: Accelerometer -> white noise of a sample, in its record's unit; None where it is not
        known.
    """
    unasked = [unknown for unknown in model.unknowns if not unknown.asked]
    spread = np.array([other.prior[1] for other in unasked])
    if not unasked or not np.isfinite(spread).all():
        return tuple(prepared), model
    mean = np.array([other.prior_mean for other in unasked])
    floors = {part.accelerometer: noise.get(part.accelerometer) or math.inf for part in prepared}
    for part in prepared:
        if not noise.get(part.accelerometer):
            floors[part.accelerometer] = min(floors[part.accelerometer], white_level(part))
    if min(floors.values(), default=0.0) == 0.0:
        # Nothing hides anything.
        return tuple(prepared), model
    others = [k for k, unknown in enumerate(model.unknowns) if not unknown.asked]
    weighted = []
    for part in prepared:
        rows = np.zeros((part.white.factor.shape[0], len(model.unknowns)))
        rows[:, list(part.unknowns)] = part.white.factor
        weighted.append(rows[:, others] * (spread / floors[part.accelerometer]))
    _, sizes, directions = np.linalg.svd(triangle_of(np.vstack(weighted)))
    kept = directions[: int(np.sum(sizes > _LEAST_EFFECT))]
    few = [Unknown("", f"condensed.{k}", (0.0, 1.0), _LIMIT, asked=False) for k in range(len(kept))]
    shapes = np.zeros((len(model.unknowns), len(kept)))
    shapes[others] = kept.T * spread[:, None]
    means = np.zeros(len(model.unknowns))
    means[others] = mean
    condensed = replace(model, unknowns=(*model.asked, *few))
    return tuple(_condensed(part, model, means, shapes) for part in prepared), condensed


def _condensed(part: Prepared, model: Unknowns, means: Array, shapes: Array) -> Prepared:
    """Return a record with what nobody asks for in other columns.

    means: (p,) of the unknowns that are condensed, 0 of others.
    shapes: (p, few): what one unit of each new unknown is.
    """
    own = [k for k, place in enumerate(part.unknowns) if model.unknowns[place].asked]
    asked = [place for place, unknown in enumerate(model.unknowns) if unknown.asked]
    places = [asked.index(part.unknowns[k]) for k in own]
    here = list(part.unknowns)
    turned = np.hstack([np.eye(len(here))[:, own], shapes[here]])
    series, white = part.series, part.white
    condensed = replace(
        part,
        series=replace(series, error=series.error - part.design @ means[here]),
        unknowns=(*places, *range(len(asked), len(asked) + shapes.shape[1])),
        design=part.design @ turned,
    )
    # Of white noise it says in the new columns what it said in the old ones.
    triangle = replace(
        white, factor=white.factor @ turned, target=white.target - white.factor @ means[here]
    )
    vars(condensed)["white"] = triangle
    return condensed


def white_level(part: Prepared) -> float:
    """Return the white noise of a record's samples, from what changes from row to row.

    Third differences of what no column explains: slow noise does not show in them.
    """
    series, white = part.series, part.white
    scale = np.linalg.norm(white.factor, axis=0)
    scale = np.where(scale > 0.0, scale, 1.0)
    found = np.linalg.lstsq(white.factor / scale, white.target, rcond=None)[0] / scale
    left = series.error - part.design @ found
    own = series.polynomials(max(series.order, 1))
    left = left - own @ np.linalg.lstsq(own, left, rcond=None)[0]
    rough = np.diff(left * np.sqrt(series.count / series.relative), 3)
    if rough.size == 0:
        return 0.0
    return SIGMA_OF_MAD * median(np.abs(rough)) / math.sqrt(20.0)

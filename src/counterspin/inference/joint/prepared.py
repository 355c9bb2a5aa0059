"""The columns of each record, computed once and then weighted with any noise."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from counterspin.arrays import Array
from counterspin.errors import NotIdentifiableError
from counterspin.frozen import frozen
from counterspin.inference.blocks import Block, reduce_block
from counterspin.inference.joint import encoder
from counterspin.inference.joint.inputs import input_column, rotation_column
from counterspin.inference.joint.observation import Observation
from counterspin.inference.joint.series import Series
from counterspin.inference.joint.unknowns import ROTATION, Unknown, Unknowns
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
        """Return what the record says of its columns, its own start errors projected out."""
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
        m, p = whiten.polynomials, self.design.shape[1]
        return reduce_block(rows[:, m : m + p], rows[:, -1], rows[:, :m], rows[:, m + p : -1])

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
    table |= dict(zip(encoded, encoder.columns(series, encoded, own).T, strict=True))
    shown_terms = {s: table[s] for s in known}
    base = series.reference() if inputs else None
    table |= {s: input_column(series, s, scale_factor, known, shown_terms, base) for s in inputs}
    return Prepared(
        unknowns,
        _stacked(series, [table[symbol] for symbol in symbols]),
        considered,
        _stacked(series, [table[symbol] for symbol in ignored]),
        series,
        scale_factor,
    )


def _stacked(series: Series, columns: Sequence[Array]) -> Array:
    return np.column_stack(columns or [np.empty((series.time.size, 0))])

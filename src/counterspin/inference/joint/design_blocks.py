"""Design blocks: the columns of each record, computed once, weighted with any noise, compressed.

In addition to a few parameters of interest, a fit has dozens of nuisance parameters that only have
a prior: inputs, and terms with default priors. In units of its prior's standard uncertainty each is
a standard normal variable, and so is every orthogonal combination of them. Most singular directions
have an effect far below the noise and are dropped. A dozen columns remain, which serve wherever a
fit is repeated for other rows or another noise. The estimates and covariances of the parameters of
interest do not change noticeably.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Final

import numpy as np
import numpy.typing as npt

from counterspin.arrays import MAD_TO_SIGMA, Array, median, triangular_factor
from counterspin.errors import NotIdentifiableError
from counterspin.frozen import frozen
from counterspin.inference.joint import encoder
from counterspin.inference.joint.series import (
    ResidualSeries,
    expected_output,
    input_column,
    rotation_column,
)
from counterspin.inference.joint.unknowns import ROTATION, Observation, Unknown, Unknowns
from counterspin.inference.least_squares import Block, reduce_rows
from counterspin.inference.noise.model import Noise
from counterspin.inference.priors import prior_root
from counterspin.physics.terms import INPUTS, SHARED_TERMS, TERMS


@frozen
class DesignBlock(Observation):
    """A series and its columns, ready to be weighted with any noise."""

    series: ResidualSeries  #: The series.
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
        needs_whitening = (
            noise.random_walk > 0.0 or noise.has_bias_instability or self.series.timing_noise > 0.0
        )
        if needs_whitening or noise.sample_variance == 0.0:
            return self._whiten(noise)
        return self.unit_noise_block.scaled(1.0 / math.sqrt(noise.sample_variance))

    @cached_property
    def unit_noise_block(self) -> Block:
        """The same for white noise of 1 per sample: of any other size it is in proportion."""
        return self._whiten(Noise(1.0))

    def _whiten(self, noise: Noise) -> Block:
        series = self.series
        if series.time.size <= series.order:
            raise NotIdentifiableError(
                f"{series.accelerometer} in {series.run}: {series.time.size} samples do not "
                "determine the initial offset and initial velocity; the record is too short"
            )
        whiten = series.whitener(noise)
        polynomials = series.polynomials(whiten.polynomials)
        rows = whiten.apply(np.column_stack([polynomials, self.design, self.fixed, series.error]))
        return reduce_rows(rows, whiten.polynomials, self.design.shape[1])

    def drop_rows(self, mask: npt.NDArray[np.bool_]) -> DesignBlock:
        """Return the series and its columns without the rows where `mask` is true."""
        keep = np.logical_not(mask)
        return replace(
            self,
            series=self.series.drop_rows(mask),
            design=self.design[keep],
            fixed=self.fixed[keep],
        )

    def update(
        self, previous: Unknowns, model: Unknowns, scale_factor: float, estimate: Array
    ) -> DesignBlock:
        """Return the columns for another model or another scale factor; only new ones are computed.

        A record shows of a term what it did, but for the scale factor with which it shows the
        platform's.
        """
        columns = [*self.design.T, *self.fixed.T]
        terms = [previous.unknowns[i].symbol for i in self.unknowns]
        terms += [previous.considered[i].symbol for i in self.considered]
        ratio = scale_factor / self.scale_factor
        cached_columns = {
            symbol: ratio * column if symbol in SHARED_TERMS else column
            for symbol, column in zip(terms, columns, strict=True)
            # What the encoder leaves open, and what an input does, depend on the estimate.
            if symbol not in encoder.SYMBOLS and symbol not in INPUTS
        }
        return _build_design_block(self.series, model, scale_factor, estimate, cached_columns)


def build_design_blocks(
    series: Sequence[ResidualSeries],
    model: Unknowns,
    scale_factors: Mapping[str, float],
    estimate: Array | None = None,
) -> tuple[DesignBlock, ...]:
    """Compute every column of a problem.

    scale_factors: K_I of each accelerometer, with which it sees the platform's errors.
    estimate: Values of the unknowns, less nominal, shape (p,), at which the uncertain inputs'
        derivatives are taken; None: those of a perfect system.
    """
    values = np.zeros(len(model.unknowns)) if estimate is None else estimate
    return tuple(
        _build_design_block(record, model, scale_factors[record.accelerometer], values, {})
        for record in series
    )


def update_design_blocks(
    design_blocks: Sequence[DesignBlock],
    previous: Unknowns,
    model: Unknowns,
    scale_factors: Mapping[str, float],
    known: Mapping[Unknown, float],
) -> tuple[DesignBlock, ...]:
    """Return the columns for another model or for other scale factors; only new are computed."""
    values = np.array([known.get(unknown, 0.0) for unknown in model.unknowns])
    return tuple(
        block.update(previous, model, scale_factors[block.accelerometer], values)
        for block in design_blocks
    )


def _build_design_block(
    series: ResidualSeries,
    model: Unknowns,
    scale_factor: float,
    estimate: Array,
    cached_columns: Mapping[str, Array],
) -> DesignBlock:
    """Compute the columns of one series, except those that are known already."""
    unknowns = tuple(i for i, unknown in enumerate(model.unknowns) if unknown.affects(series))
    considered_indices = tuple(i for i, term in enumerate(model.considered) if term.affects(series))
    symbols = [model.unknowns[i].symbol for i in unknowns]
    ignored = [model.considered[i].symbol for i in considered_indices]
    rotation_symbols = [symbol for symbol in (*symbols, *ignored) if symbol in ROTATION]
    encoder_symbols = [symbol for symbol in (*symbols, *ignored) if symbol in encoder.SYMBOLS]
    inputs = [symbol for symbol in (*symbols, *ignored) if symbol in INPUTS]
    special_symbols = {*rotation_symbols, *encoder_symbols, *inputs}
    terms = [symbol for symbol in (*symbols, *ignored) if symbol not in special_symbols]
    new = [symbol for symbol in terms if symbol not in cached_columns]
    table = dict(cached_columns)
    table |= dict(zip(new, series.columns(new, scale_factor).T, strict=True))
    table |= {s: rotation_column(series, s) for s in rotation_symbols if s not in cached_columns}
    # Nuisance parameters are small; their effect on the columns of inputs is of second order.
    symbols_of_interest = {
        model.unknowns[i].symbol for i in unknowns if model.unknowns[i].is_of_interest
    }
    values = zip(symbols, estimate[list(unknowns)].tolist(), strict=True)
    known = {s: v for s, v in values if s in terms and s in symbols_of_interest}
    accelerometer_values = {"K_I": scale_factor - 1.0} | {
        s: v for s, v in known.items() if s in TERMS
    }
    if series.corrected_fraction > 0.0:
        # The rotation is less certain then, and its product with what is held counts too.
        considered_terms = [model.considered[i] for i in considered_indices]
        accelerometer_values |= {
            considered_term.symbol: math.hypot(considered_term.prior_mean, considered_term.prior[1])
            for considered_term in considered_terms
            if considered_term.symbol in TERMS and considered_term.symbol != "K_I"
        }
    table |= dict(
        zip(
            encoder_symbols,
            encoder.columns(series, encoder_symbols, accelerometer_values).T,
            strict=True,
        )
    )
    if inputs:
        now = expected_output(series, known, table)
        table |= {s: input_column(series, s, scale_factor, known, now) for s in inputs}
    return DesignBlock(
        unknowns,
        _stack_columns(series, [table[symbol] for symbol in symbols]),
        considered_indices,
        _stack_columns(series, [table[symbol] for symbol in ignored]),
        series,
        scale_factor,
    )


def _stack_columns(series: ResidualSeries, columns: Sequence[Array]) -> Array:
    # Column by column in memory: to put them row by row takes a second time as long.
    return np.array(columns).T if len(columns) else np.empty((series.time.size, 0))


#: Columns are left out whose effect, all rows together, is below this part of the noise of one row.
_MIN_EFFECT: Final = 0.02

#: Largest credible size of a condensed unknown, in standard deviations.
_LIMIT_SDS: Final = 1e3


def compress_nuisance(
    design_blocks: Sequence[DesignBlock], model: Unknowns, noise: Mapping[str, float | None]
) -> tuple[tuple[DesignBlock, ...], Unknowns]:
    """Compress nuisance parameters; put the columns and model after the parameters of interest.

    noise: Accelerometer -> white noise of a sample, in its record's unit; None where it is not
        known.
    """
    nuisance = [unknown for unknown in model.unknowns if not unknown.is_of_interest]
    prior_sds = np.array([unknown.prior[1] for unknown in nuisance])
    if not nuisance or not np.isfinite(prior_sds).all():
        return tuple(design_blocks), model
    mean = np.array([unknown.prior_mean for unknown in nuisance])
    floors = {
        block.accelerometer: noise.get(block.accelerometer) or math.inf for block in design_blocks
    }
    for block in design_blocks:
        if not noise.get(block.accelerometer):
            floors[block.accelerometer] = min(
                floors[block.accelerometer], estimate_white_noise(block)
            )
    if min(floors.values(), default=0.0) == 0.0:
        # Without noise no direction is negligible.
        return tuple(design_blocks), model
    root = prior_root(nuisance)
    nuisance_places = [k for k, unknown in enumerate(model.unknowns) if not unknown.is_of_interest]
    weighted_rows = []
    for block in design_blocks:
        rows = np.zeros((block.unit_noise_block.factor.shape[0], len(model.unknowns)))
        rows[:, list(block.unknowns)] = block.unit_noise_block.factor
        scaled_rows = rows[:, nuisance_places] * (prior_sds / floors[block.accelerometer])
        weighted_rows.append(scaled_rows if root is None else scaled_rows @ root)
    _, singular_values, directions = np.linalg.svd(triangular_factor(np.vstack(weighted_rows)))
    directions_kept = directions[: int(np.sum(singular_values > _MIN_EFFECT))]
    compressed_unknowns = [
        Unknown("", f"condensed.{k}", (0.0, 1.0), _LIMIT_SDS, is_of_interest=False)
        for k in range(len(directions_kept))
    ]
    shapes = np.zeros((len(model.unknowns), len(directions_kept)))
    independent = directions_kept.T if root is None else root @ directions_kept.T
    shapes[nuisance_places] = independent * prior_sds[:, None]
    means = np.zeros(len(model.unknowns))
    means[nuisance_places] = mean
    condensed = replace(model, unknowns=(*model.of_interest, *compressed_unknowns))
    return tuple(_compress_block(block, model, means, shapes) for block in design_blocks), condensed


def _compress_block(
    block: DesignBlock, model: Unknowns, means: Array, shapes: Array
) -> DesignBlock:
    """Return a record with its nuisance parameters in compressed columns.

    means: (p,) of the compressed unknowns, 0 of others.
    shapes: (p, few): what one unit of each new unknown is.
    """
    columns_of_interest = [
        k for k, place in enumerate(block.unknowns) if model.unknowns[place].is_of_interest
    ]
    places_of_interest = [
        place for place, unknown in enumerate(model.unknowns) if unknown.is_of_interest
    ]
    places = [places_of_interest.index(block.unknowns[k]) for k in columns_of_interest]
    columns = list(block.unknowns)
    transform = np.hstack([np.eye(len(columns))[:, columns_of_interest], shapes[columns]])
    series, white = block.series, block.unit_noise_block
    compressed_block = replace(
        block,
        series=replace(series, error=series.error - block.design @ means[columns]),
        unknowns=(
            *places,
            *range(len(places_of_interest), len(places_of_interest) + shapes.shape[1]),
        ),
        design=block.design @ transform,
    )
    # Of white noise it says in the new columns what it said in the old ones.
    triangle = replace(
        white, factor=white.factor @ transform, target=white.target - white.factor @ means[columns]
    )
    vars(compressed_block)["unit_noise_block"] = triangle
    return compressed_block


def estimate_white_noise(block: DesignBlock) -> float:
    """Estimate the white noise of a record's samples from third differences of the residuals.

    Slow noise does not appear in third differences.
    """
    series, white = block.series, block.unit_noise_block
    scale = np.linalg.norm(white.factor, axis=0)
    scale = np.where(scale > 0.0, scale, 1.0)
    coefficients = np.linalg.lstsq(white.factor / scale, white.target, rcond=None)[0] / scale
    residuals = series.error - block.design @ coefficients
    polynomials = series.polynomials(max(series.order, 1))
    residuals = residuals - polynomials @ np.linalg.lstsq(polynomials, residuals, rcond=None)[0]
    third_differences = np.diff(residuals * np.sqrt(series.count / series.variance_ratio), 3)
    if third_differences.size == 0:
        return 0.0
    return MAD_TO_SIGMA * median(np.abs(third_differences)) / math.sqrt(20.0)

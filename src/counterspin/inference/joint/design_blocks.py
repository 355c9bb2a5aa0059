"""Design blocks: the columns of a record, computed once and used with any noise.

In addition to a few parameters of interest, a fit has dozens of nuisance parameters with a prior:
inputs, and terms with default priors. Divided by their prior standard uncertainties, they and all
their orthogonal combinations are standard normal variables. Most singular directions have an effect
far below the noise and are dropped. The remaining dozen columns replace all nuisance parameters in
repeated fits. The results for the parameters of interest do not change noticeably.
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
    """Columns of a series, for any noise."""

    series: ResidualSeries  #: The series.
    scale_factor: float  #: K_I in the columns of platform errors.

    @property
    def accelerometer(self) -> str:
        """Name of the accelerometer, and of its noise."""
        return self.series.accelerometer

    source = accelerometer

    @property
    def run(self) -> str:
        """Name of the run."""
        return self.series.run

    @property
    def motion(self) -> str:
        """Test type: records are made on a double turntable."""
        return "counter-rotating"

    def block(self, noises: Mapping[str, Noise]) -> Block:
        """Return the information on the columns, with the start errors projected out."""
        noise = noises[self.accelerometer]
        needs_whitening = (
            noise.random_walk > 0.0 or noise.has_bias_instability or self.series.timing_noise > 0.0
        )
        if needs_whitening or noise.sample_variance == 0.0:
            return self._whiten(noise)
        return self.unit_noise_block.scaled(1.0 / math.sqrt(noise.sample_variance))

    @cached_property
    def unit_noise_block(self) -> Block:
        """Block for white noise of 1 per sample; other white noise only scales this block."""
        return self._whiten(Noise(1.0))

    def _whiten(self, noise: Noise) -> Block:
        series = self.series
        if series.time.size <= series.order:
            raise NotIdentifiableError(
                f"{series.accelerometer} in {series.run}: {series.time.size} samples do not "
                "determine the initial offset and initial velocity; the record is too short"
            )
        whitener = series.whitener(noise)
        polynomials = series.polynomials(whitener.polynomials)
        columns = [polynomials, self.design, self.considered_design, series.error]
        rows = whitener.apply(np.column_stack(columns))
        return reduce_rows(rows, whitener.polynomials, self.design.shape[1])

    def drop_rows(self, mask: npt.NDArray[np.bool_]) -> DesignBlock:
        """Return the series and its columns without the rows where `mask` is true."""
        is_kept = np.logical_not(mask)
        return replace(
            self,
            series=self.series.drop_rows(mask),
            design=self.design[is_kept],
            considered_design=self.considered_design[is_kept],
        )

    def update(
        self, previous: Unknowns, model: Unknowns, scale_factor: float, estimate: Array
    ) -> DesignBlock:
        """Return the columns for another model or scale factor; only new columns are computed.

        Columns of platform errors are proportional to the scale factor.
        """
        all_columns = [*self.design.T, *self.considered_design.T]
        symbols = [previous.unknowns[i].symbol for i in self.unknowns]
        symbols += [previous.considered[i].symbol for i in self.considered]
        ratio = scale_factor / self.scale_factor
        cached_columns = {
            symbol: ratio * column if symbol in SHARED_TERMS else column
            for symbol, column in zip(symbols, all_columns, strict=True)
            # Columns of encoder terms and inputs depend on the estimate.
            if symbol not in encoder.SYMBOLS and symbol not in INPUTS
        }
        return _build_design_block(self.series, model, scale_factor, estimate, cached_columns)


def build_design_blocks(
    series: Sequence[ResidualSeries],
    model: Unknowns,
    scale_factors: Mapping[str, float],
    estimate: Array | None = None,
) -> tuple[DesignBlock, ...]:
    """Compute all columns of a problem.

    scale_factors: Accelerometer -> K_I in the columns of platform errors.
    estimate: Unknowns minus nominal values, shape (p,), at which the derivatives with respect to
        inputs are computed; None: a perfect system.
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
    estimates: Mapping[Unknown, float],
) -> tuple[DesignBlock, ...]:
    """Return the columns for another model or scale factors; only new columns are computed."""
    values = np.array([estimates.get(unknown, 0.0) for unknown in model.unknowns])
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
    """Compute the columns of a series, except the cached columns."""
    unknowns = tuple(i for i, unknown in enumerate(model.unknowns) if unknown.affects(series))
    considered_indices = tuple(i for i, term in enumerate(model.considered) if term.affects(series))
    symbols = [model.unknowns[i].symbol for i in unknowns]
    considered_symbols = [model.considered[i].symbol for i in considered_indices]
    all_symbols = (*symbols, *considered_symbols)
    rotation_symbols = [symbol for symbol in all_symbols if symbol in ROTATION]
    encoder_symbols = [symbol for symbol in all_symbols if symbol in encoder.SYMBOLS]
    input_symbols = [symbol for symbol in all_symbols if symbol in INPUTS]
    special_symbols = {*rotation_symbols, *encoder_symbols, *input_symbols}
    term_symbols = [symbol for symbol in all_symbols if symbol not in special_symbols]
    new_symbols = [symbol for symbol in term_symbols if symbol not in cached_columns]
    columns = dict(cached_columns)
    columns |= dict(zip(new_symbols, series.columns(new_symbols, scale_factor).T, strict=True))
    columns |= {s: rotation_column(series, s) for s in rotation_symbols if s not in cached_columns}
    # Nuisance parameters are small; their effect on the columns of inputs is of second order.
    symbols_of_interest = {
        model.unknowns[i].symbol for i in unknowns if model.unknowns[i].is_of_interest
    }
    values = zip(symbols, estimate[list(unknowns)].tolist(), strict=True)
    coefficients = {s: v for s, v in values if s in term_symbols and s in symbols_of_interest}
    encoder_coefficients = {"K_I": scale_factor - 1.0}
    encoder_coefficients |= {s: v for s, v in coefficients.items() if s in TERMS}
    if series.corrected_fraction > 0.0:
        # The rotation is then less certain, and its product with considered terms matters too.
        considered_terms = [model.considered[i] for i in considered_indices]
        encoder_coefficients |= {
            considered_term.symbol: math.hypot(considered_term.prior_mean, considered_term.prior[1])
            for considered_term in considered_terms
            if considered_term.symbol in TERMS and considered_term.symbol != "K_I"
        }
    encoder_columns = encoder.columns(series, encoder_symbols, encoder_coefficients).T
    columns |= dict(zip(encoder_symbols, encoder_columns, strict=True))
    if input_symbols:
        output = expected_output(series, coefficients, columns)
        for symbol in input_symbols:
            columns[symbol] = input_column(series, symbol, scale_factor, coefficients, output)
    return DesignBlock(
        unknowns,
        _stack_columns(series, [columns[symbol] for symbol in symbols]),
        considered_indices,
        _stack_columns(series, [columns[symbol] for symbol in considered_symbols]),
        series,
        scale_factor,
    )


def _stack_columns(series: ResidualSeries, columns: Sequence[Array]) -> Array:
    # Column-major order: row-major order would double the time.
    return np.array(columns).T if len(columns) else np.empty((series.time.size, 0))


#: Directions whose effect on all rows is below this fraction of the noise of a row are dropped.
_MIN_SINGULAR_VALUE: Final = 0.02

#: Largest credible size of a compressed unknown, in standard deviations.
_LIMIT_SDS: Final = 1e3


def compress_nuisance(
    design_blocks: Sequence[DesignBlock], model: Unknowns, noise: Mapping[str, float | None]
) -> tuple[tuple[DesignBlock, ...], Unknowns]:
    """Return blocks and model with compressed nuisance parameters after those of interest.

    noise: Accelerometer -> white noise of a sample, in the unit of the record; None: unknown.
    """
    nuisance = [unknown for unknown in model.unknowns if not unknown.is_of_interest]
    prior_sds = np.array([unknown.prior[1] for unknown in nuisance])
    if not nuisance or not np.isfinite(prior_sds).all():
        return tuple(design_blocks), model
    prior_means = np.array([unknown.prior_mean for unknown in nuisance])
    noise_floors = {
        block.accelerometer: noise.get(block.accelerometer) or math.inf for block in design_blocks
    }
    for block in design_blocks:
        if not noise.get(block.accelerometer):
            noise_floors[block.accelerometer] = min(
                noise_floors[block.accelerometer], estimate_white_noise(block)
            )
    if min(noise_floors.values(), default=0.0) == 0.0:
        # Without noise, no direction is negligible.
        return tuple(design_blocks), model
    prior_factor = prior_root(nuisance)
    nuisance_indices = [k for k, unknown in enumerate(model.unknowns) if not unknown.is_of_interest]
    weighted_rows = []
    for block in design_blocks:
        rows = np.zeros((block.unit_noise_block.factor.shape[0], len(model.unknowns)))
        rows[:, list(block.unknowns)] = block.unit_noise_block.factor
        scaled_rows = rows[:, nuisance_indices] * (prior_sds / noise_floors[block.accelerometer])
        weighted_rows.append(scaled_rows if prior_factor is None else scaled_rows @ prior_factor)
    _, singular_values, directions = np.linalg.svd(triangular_factor(np.vstack(weighted_rows)))
    kept_directions = directions[: int(np.sum(singular_values > _MIN_SINGULAR_VALUE))]
    compressed_unknowns = [
        Unknown("", f"condensed.{k}", (0.0, 1.0), _LIMIT_SDS, is_of_interest=False)
        for k in range(len(kept_directions))
    ]
    transform = np.zeros((len(model.unknowns), len(kept_directions)))
    basis = kept_directions.T if prior_factor is None else prior_factor @ kept_directions.T
    transform[nuisance_indices] = basis * prior_sds[:, None]
    means = np.zeros(len(model.unknowns))
    means[nuisance_indices] = prior_means
    compressed_model = replace(model, unknowns=(*model.of_interest, *compressed_unknowns))
    blocks = tuple(_compress_block(block, model, means, transform) for block in design_blocks)
    return blocks, compressed_model


def _compress_block(
    block: DesignBlock, model: Unknowns, means: Array, transform: Array
) -> DesignBlock:
    """Return a block with compressed nuisance columns.

    means: Prior means of the nuisance parameters, 0 for other unknowns, shape (p,).
    transform: Unknowns per unit of each of the m compressed unknowns, shape (p, m).
    """
    columns_of_interest = [
        k for k, index in enumerate(block.unknowns) if model.unknowns[index].is_of_interest
    ]
    indices_of_interest = [
        index for index, unknown in enumerate(model.unknowns) if unknown.is_of_interest
    ]
    new_indices = [indices_of_interest.index(block.unknowns[k]) for k in columns_of_interest]
    indices = list(block.unknowns)
    column_transform = np.hstack([np.eye(len(indices))[:, columns_of_interest], transform[indices]])
    series, unit_block = block.series, block.unit_noise_block
    compressed_block = replace(
        block,
        series=replace(series, error=series.error - block.design @ means[indices]),
        unknowns=(
            *new_indices,
            *range(len(indices_of_interest), len(indices_of_interest) + transform.shape[1]),
        ),
        design=block.design @ column_transform,
    )
    # The information for unit noise is transformed too, instead of being computed again.
    compressed_unit_block = replace(
        unit_block,
        factor=unit_block.factor @ column_transform,
        target=unit_block.target - unit_block.factor @ means[indices],
    )
    vars(compressed_block)["unit_noise_block"] = compressed_unit_block
    return compressed_block


def estimate_white_noise(block: DesignBlock) -> float:
    """Estimate the white noise of a record's samples from third differences of the residuals.

    Slow noise does not appear in third differences.
    """
    series, unit_block = block.series, block.unit_noise_block
    scale = np.linalg.norm(unit_block.factor, axis=0)
    scale = np.where(scale > 0.0, scale, 1.0)
    coefficients = np.linalg.lstsq(unit_block.factor / scale, unit_block.target, rcond=None)[0]
    residuals = series.error - block.design @ (coefficients / scale)
    polynomials = series.polynomials(max(series.order, 1))
    residuals = residuals - polynomials @ np.linalg.lstsq(polynomials, residuals, rcond=None)[0]
    third_differences = np.diff(residuals * np.sqrt(series.count / series.variance_ratio), 3)
    if third_differences.size == 0:
        return 0.0
    return MAD_TO_SIGMA * median(np.abs(third_differences)) / math.sqrt(20.0)

"""Noise of a record, and whitening of its rows.

Noise has three components per sample, and the noise of the bias
(`counterspin.inference.noise.bias_instability`):

- white noise with standard deviation `white` in the observable;
- quantisation with step q, which adds the variance q^2/12 and is treated as white noise;
- white accelerometer noise with random-walk coefficient N: the variance of the velocity grows by
  N^2 per second (two-sided density; IEEE Std 952). In specific force it is white, in velocity a
  random walk, in displacement a doubly integrated one.

`order` is the number of integrations from acceleration to the observable: 2 displacement,
1 velocity, 0 specific force. A row may be the mean of a block of samples, and rows may be missing.

With a random walk, differences of the rows (second differences for displacement, first for
velocity, divided by irregular steps) remove start offset and start velocity, and have a covariance
with `order` off-diagonals. Its banded Cholesky factor whitens in O(n). This is exact for blocks,
gaps and irregular steps, because block means of the walk's covariance are polynomials. For second
differences, the walk contributes N^2 h^3 (2/3, 1/6) for regular samples and
N^2 h^3 (11/20, 13/60, 1/120) for adjoining long blocks.
Without a random walk, rows are divided by their standard deviations, without differences.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from counterspin.arrays import Array, median
from counterspin.frozen import frozen
from counterspin.inference.noise.bias_instability import (
    LowRankWhitener,
    Variances,
    basis_length,
    basis_size,
    coefficient_root,
    integrated_cosines,
)
from counterspin.inference.noise.components import BIAS_COMPONENTS, COMPONENTS, component_keys
from counterspin.inference.noise.riccati import BlockSpans, filter_walk

DISPLACEMENT, VELOCITY, SPECIFIC_FORCE = 2, 1, 0


class _EstimateSentinel(float):
    """Sentinel for a component to be estimated; the same object in all processes."""

    def __repr__(self) -> str:
        return "ESTIMATE"

    def __reduce__(self) -> str:
        return "ESTIMATE"


#: Value of a component of `Noise` that is to be estimated from the records.
ESTIMATE: Final = _EstimateSentinel("nan")


@frozen
class Noise:
    """Noise of the records of an accelerometer; each of `COMPONENTS` is a number or `ESTIMATE`."""

    white: float  #: Standard deviation per sample, in the observable's unit (m, m/s or m/s^2).
    random_walk: float = 0.0  #: N, (m/s^2)/Hz^0.5: velocity variance N^2 t.
    quantisation: float = 0.0  #: Step of the recorded observable, same unit as `white`; a number.
    #: Bias instability B, m/s^2, and random walk K of the bias, m/s^2/s^0.5; see
    #: `counterspin.inference.noise.bias_instability`.
    flicker: float = 0.0
    bias_walk: float = 0.0
    #: Covariance of the variances, 4 by 4, if they come from another record; empty: exact.
    covariance: tuple[tuple[float, ...], ...] = ()

    def __post_init__(self) -> None:
        for name in (*COMPONENTS, "quantisation"):
            value = getattr(self, name)
            if value is ESTIMATE and name in COMPONENTS:
                continue
            if not (np.isfinite(value) and value >= 0):
                raise ValueError(f"noise: {name} is {value}; it must not be negative")

    @classmethod
    def from_sizes(cls, sizes: Mapping[str, Any], observable: str) -> Noise:
        """Return the noise of records of an observable.

        sizes: Key of a description (`size_keys` or ``quantisation``) -> size.
        """
        quantisation = sizes["quantisation"] if observable == "displacement" else 0.0
        components = {name: sizes[key] for name, key in component_keys(observable).items()}
        return cls(quantisation=quantisation, **components)

    @property
    def to_estimate(self) -> tuple[str, ...]:
        """Components to be estimated."""
        return tuple(name for name in COMPONENTS if getattr(self, name) is ESTIMATE)

    @property
    def known(self) -> Noise:
        """The noise without the components to be estimated."""
        return self.with_sizes(dict.fromkeys(self.to_estimate, 0.0))

    @property
    def without_bias_instability(self) -> Noise:
        """The noise without the components of the bias."""
        return self.with_sizes(dict.fromkeys(BIAS_COMPONENTS, 0.0))

    @property
    def sample_variance(self) -> float:
        """Variance of the white noise per sample: white^2 + quantisation^2/12."""
        return self.white**2 + self.quantisation**2 / 12

    @property
    def has_bias_instability(self) -> bool:
        """True if a component of the bias is not zero or is to be estimated."""
        return any(getattr(self, name) != 0.0 for name in BIAS_COMPONENTS)

    @property
    def variances(self) -> Variances:
        """Variances of `COMPONENTS`, with quantisation in the white noise."""
        return (self.sample_variance, *(getattr(self, name) ** 2 for name in COMPONENTS[1:]))

    def with_variances(self, variances: Variances) -> Noise:
        """Return the noise with the components to be estimated from variances."""
        white = max(variances[0] - self.quantisation**2 / 12, 0.0)
        sizes = dict(zip(COMPONENTS, map(math.sqrt, (white, *variances[1:])), strict=True))
        return self.with_sizes({name: sizes[name] for name in self.to_estimate})

    def with_sizes(self, sizes: Mapping[str, float]) -> Noise:
        """Return the noise with other sizes of some of `COMPONENTS`."""
        changes: Mapping[str, Any] = sizes
        return replace(self, **changes)


@frozen
class Differences:
    """Differences of the rows of a record, and the factor of their covariance."""

    order: int  #: Order of the differences, and number of off-diagonals: 2, 1 or 0.
    blocks: BlockSpans  #: Samples of each row.
    spacing: Array  #: Time between the samples of a block, s, shape (n,).
    #: White-noise variance of this record over that of the accelerometer.
    variance_ratio: float = 1.0

    @classmethod
    def from_times(
        cls,
        times: ArrayLike,
        order: int,
        count: ArrayLike | None = None,
        sample_spacing: ArrayLike | None = None,
        variance_ratio: float = 1.0,
    ) -> Differences:
        """Return the differences of rows at `times`; arguments and errors as in `make_whitener`."""
        if order not in (DISPLACEMENT, VELOCITY, SPECIFIC_FORCE):
            raise ValueError(
                f"order is {order}: 2 for displacement, 1 for velocity, 0 for specific force"
            )
        time = np.asarray(times, dtype=float)
        if time.ndim != 1 or len(time) <= order:
            raise ValueError(
                f"{time.size} rows are too few for whitening: {order + 1} are required"
            )
        counts = np.broadcast_to(np.asarray(1 if count is None else count, float), time.shape)
        if not (counts >= 1).all():
            raise ValueError("counts must be at least 1: a row represents at least one sample")
        steps = np.diff(time)
        if not (steps > 0).all():
            raise ValueError("times must increase from row to row")
        if sample_spacing is None:
            # The means of adjoining blocks of c and c' samples are (c + c')/2 spacings apart.
            adjoining_spacings = steps / (counts[1:] + counts[:-1]) * 2
            sample_spacing = median(adjoining_spacings) if len(adjoining_spacings) else 1.0
        spacing = np.broadcast_to(np.asarray(sample_spacing, float), time.shape)
        if not (spacing > 0).all():
            raise ValueError("the sample spacing must be positive")
        blocks = BlockSpans.from_blocks(time, counts, spacing)
        if (blocks.half_length[1:] + blocks.half_length[:-1] >= steps).any():
            row = int(np.argmax(blocks.half_length[1:] + blocks.half_length[:-1] >= steps))
            raise ValueError(
                f"blocks {row} and {row + 1} overlap: {counts[row]:g} and {counts[row + 1]:g} "
                f"samples {spacing[row]:g} s apart do not fit into {steps[row]:g} s"
            )
        return cls(order, blocks, spacing, variance_ratio)

    @property
    def n_rows(self) -> int:
        """Number of rows of the differences."""
        return len(self.blocks.time) - self.order

    def apply(self, rows: ArrayLike) -> Array:
        """Return differences (n - order, ...) of rows (n,) or (n, k), in column-major order."""
        if self.order == 0:
            return np.asarray(rows, dtype=float)
        values = np.asfortranarray(rows, dtype=float)
        steps = np.asfortranarray(np.diff(values, axis=0))
        if self.order == 1:
            return steps
        first, second = self._weights()
        if values.ndim == 2:
            first, second = first[:, None], second[:, None]
        # Steps come first, so that the weights multiply small numbers and lose fewer digits.
        return np.asfortranarray(second * steps[1:] - first * steps[:-1])

    def apply_transposed(self, rows: Array) -> Array:
        """Return the transposed operator of `apply` on rows (n - order, k), shape (n, k)."""
        if self.order == 0:
            return rows
        transposed = np.zeros((len(self.blocks.time), rows.shape[1]))
        first, second = (1.0, 1.0) if self.order == 1 else (w[:, None] for w in self._weights())
        transposed[self.order :] += second * rows
        transposed[: -self.order] += first * rows * (-1.0) ** self.order
        if self.order == DISPLACEMENT:
            transposed[1:-1] -= 2.0 * rows
        return transposed

    def bias_columns(self, order: int, variances: Variances, walk_duration: float) -> list[Array]:
        """Return differences of the effect of the bias noise, for a root of its covariance.

        The first array is for all components together, the others for each unit component.

        walk_duration: Duration of the walk of the bias before the record, s.
        """
        length = basis_length(float(self.blocks.time[-1]))
        n_cosines = basis_size(variances, median(self.spacing), length, order)
        cosines = self.apply(
            integrated_cosines(
                self.blocks.time, self.blocks.count, self.spacing, order, n_cosines, length
            )
        )
        variance_sets = (variances, *map(tuple, np.eye(len(COMPONENTS))[2:].tolist()))
        return [
            cosines @ coefficient_root(variance_set, n_cosines, length, walk_duration)
            for variance_set in variance_sets
        ]

    def _weights(self) -> tuple[Array, Array]:
        """Return the weights of the first and last of three rows, (n-2,); the middle one has -2."""
        steps = np.diff(self.blocks.time)
        span = steps[:-1] + steps[1:]
        return 2 * steps[1:] / span, 2 * steps[:-1] / span

    def factor(self, white: float | Array, walk: float) -> tuple[Array, float]:
        """Return the banded Cholesky factor of the covariance, and the log-determinant.

        white: White-noise variance of a sample of the accelerometer, without `variance_ratio`.
        walk: N^2; not both zero.
        """
        white = white * self.variance_ratio
        if self.order == SPECIFIC_FORCE:
            # A sample is the mean over its spacing h: variance N^2/h.
            bands = np.sqrt((white + walk / self.spacing) / self.blocks.count)[None, :]
        elif self.order == VELOCITY:
            bands = self._velocity_factor(white, walk)
        else:
            bands = self._displacement_factor(white, walk)
        return bands, 2 * float(np.log(bands[0]).sum())

    def _velocity_factor(self, white: float | Array, walk: float) -> Array:
        from scipy.linalg.lapack import dpbtrf

        variance = white / self.blocks.count - walk * self.blocks.mean_distance / 2
        covariance = np.zeros((2, self.n_rows))
        covariance[0] = walk * np.diff(self.blocks.time) + variance[1:] + variance[:-1]
        covariance[1, :-1] = -variance[1:-1]
        bands, info = dpbtrf(covariance, lower=1)
        if info:  # cannot be for positive variances; never let a broken factor through
            raise ArithmeticError("the covariance of the first differences has no Cholesky factor")
        return np.asarray(bands)

    def _displacement_factor(self, white: float | Array, walk: float) -> Array:
        innovations = filter_walk(self.blocks, white, walk)
        first, second = self._weights()
        innovation_sd = np.sqrt(innovations.variance)
        position_gain, velocity_gain = innovations.gain
        bands = np.zeros((3, self.n_rows))
        bands[0] = second * innovation_sd
        # Effect of the innovation of a row on the next two differences.
        first_effect = position_gain[:-1] + innovations.ahead[3:] * velocity_gain[:-1]
        second_effect = (
            position_gain[:-2]
            + (innovations.step[3:-1] + innovations.ahead[4:]) * velocity_gain[:-2]
        )
        bands[1, :-1] = (second[1:] * first_effect - 2) * innovation_sd[:-1]
        bands[2, :-2] = (
            second[2:] * second_effect - 2 * first_effect[:-1] + first[2:]
        ) * innovation_sd[:-2]
        return bands


@frozen
class Whitener:
    """Linear operator that whitens the rows of a record."""

    differences: Differences  #: Differences of the record; order 0: none.
    bands: Array  #: Banded lower Cholesky factor of their covariance.
    log_det: float  #: Log-determinant of this covariance.
    #: Number of start-error columns 1, t that must be estimated: `order` without a random walk, 0
    #: with a random walk, because the differences remove them.
    polynomials: int
    #: Whitener of the bias noise after this factor; None without bias noise.
    bias_whitener: LowRankWhitener | None = None

    @property
    def n_rows(self) -> int:
        """Number of output rows."""
        return self.differences.n_rows

    def apply(self, rows: ArrayLike) -> Array:
        """Return whitened rows, (m,) or (m, k), of (n,) or (n, k) rows; m is `n_rows`."""
        white = solve_banded_factor(self.bands, self.differences.apply(rows))
        return white if self.bias_whitener is None else self.bias_whitener.apply(white)


def solve_banded_factor(bands: Array, rows: Array, transposed: bool = False) -> Array:
    """Return L^-1 rows, or L'^-1 rows, for a lower banded L of `Differences.factor`."""
    if bands.shape[0] == 1:
        return np.asarray(rows / (bands[0] if rows.ndim == 1 else bands[0][:, None]))
    from scipy.linalg.lapack import dtbtrs

    columns = rows if rows.ndim == 2 else rows[:, None]
    solution, info = dtbtrs(bands, columns, uplo="L", trans="T" if transposed else "N")
    if info:
        raise ArithmeticError("the noise of a row has zero variance: the covariance is singular")
    return np.asarray(solution if rows.ndim == 2 else solution[:, 0])


def make_whitener(
    times: ArrayLike,
    order: int,
    noise: Noise,
    count: ArrayLike | None = None,
    sample_spacing: ArrayLike | None = None,
    walk_duration: float = 0.0,
    added_variance: float | Array = 0.0,
) -> Whitener:
    """Return the whitener of a record of an observable.

    times: Times of samples, or mean times of blocks, s, increasing, shape (n,), without missing
        rows.
    order: 2 displacement, 1 velocity, 0 specific force.
    count: Number of samples in each row, shape (n,) or a number; None: 1.
    sample_spacing: Time between the samples of a block, s, shape (n,) or a number; None: most
        blocks adjoin.
    walk_duration, added_variance: See `build_whitener`.
    """
    return build_whitener(
        Differences.from_times(times, order, count, sample_spacing),
        noise,
        walk_duration,
        added_variance,
    )


def build_whitener(
    differences: Differences,
    noise: Noise,
    walk_duration: float = 0.0,
    added_variance: float | Array = 0.0,
) -> Whitener:
    """Return the whitener of a record.

    walk_duration: Duration of the walk of the bias before the record, s.
    added_variance: White variance of the samples in addition to the noise, of all or each row,
        (n,).
    """
    white, walk = noise.sample_variance + added_variance, noise.random_walk**2
    if np.any(white + walk == 0):
        raise ValueError("noise: all components are zero, so the rows cannot be weighted")
    order, polynomials = differences.order, 0
    if walk == 0:
        polynomials = order
        differences = replace(differences, order=SPECIFIC_FORCE)
    bands, log_det = differences.factor(white, walk)
    if not noise.has_bias_instability:
        return Whitener(differences, bands, log_det, polynomials)
    variances = (float(np.mean(white)) * differences.variance_ratio, *noise.variances[1:])
    columns = differences.bias_columns(order, variances, walk_duration)[0]
    bias_whitener = LowRankWhitener.from_root(solve_banded_factor(bands, columns))
    return Whitener(differences, bands, log_det + bias_whitener.log_det, polynomials, bias_whitener)


def information_loss(
    differences: Differences,
    columns: Array,
    noise: Noise,
    walk_duration: float = 0.0,
    added_variance: float | Array = 0.0,
) -> Array:
    """Return the loss of information per unit variance of each of `COMPONENTS`, (4, m, m).

    With the noise covariance V, the information on unknowns with columns X is X' V^-1 X. A unit
    increase of a variance adds a matrix B to V, and reduces the information by X' V^-1 B V^-1 X.
    Multiplied by the inverse of the total information on both sides, this is the increase of the
    covariance of estimates with constant weights. By the envelope theorem, a change of optimal
    weights has no first-order effect. Losses of absent bias components are zero.

    columns: Shape (n, m).
    walk_duration, added_variance: See `build_whitener`.
    """
    white, walk = noise.sample_variance + added_variance, noise.random_walk**2
    bands, _ = differences.factor(white, walk)
    rows = solve_banded_factor(bands, differences.apply(columns))
    bias_columns: list[Array] = []
    if noise.has_bias_instability:
        variances = (float(np.mean(white)) * differences.variance_ratio, *noise.variances[1:])
        bias_root, *bias_columns = differences.bias_columns(
            differences.order, variances, walk_duration
        )
        bias_whitener = LowRankWhitener.from_root(solve_banded_factor(bands, bias_root))
        rows = bias_whitener.apply(bias_whitener.apply(rows))
    weighted = solve_banded_factor(bands, rows, transposed=True)
    row_scale = np.sqrt(differences.variance_ratio / differences.blocks.count)
    sample_component = differences.apply_transposed(weighted) * row_scale[:, None]
    components = [sample_component, _multiply_transposed(differences.factor(0.0, 1.0)[0], weighted)]
    components += [columns_of_component.T @ weighted for columns_of_component in bias_columns]
    losses = np.zeros((len(COMPONENTS), columns.shape[1], columns.shape[1]))
    for index, component in enumerate(components):
        losses[index] = component.T @ component
    return losses


def _multiply_transposed(bands: Array, rows: Array) -> Array:
    """Return L' rows for a lower banded L."""
    product = bands[0][:, None] * rows
    for offset in range(1, len(bands)):
        product[:-offset] += bands[offset, :-offset, None] * rows[offset:]
    return np.asarray(product)

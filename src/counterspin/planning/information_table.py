"""Information of a run about functions of the angle: closed forms for even samples, else tables.

1, th, th^2, th^3 and, for each harmonic m, cos m th, sin m th, th cos m th, th sin m th: the
products of specific forces have the first harmonics, the platform's drift and g-sensitivity
multiply them with time, and integration over the angle stays among them.

With white noise the information of a record is the matrix of sums, over its samples, of products of
these functions. About the middle of the record each function is a power of x in [-1, 1] times a
cosine or sine of a multiple of the angle, the sums are derivatives of the Dirichlet kernel sin(n
a/2)/(n sin(a/2)), and even and odd functions do not mix. In this basis the sums can be factored
without loss of digits, which the raw t^2 and cos wt cannot (functions of a whole revolution or more
are never near to collinear).

The number of samples need not be an integer: between integers, the sums follow a smooth curve.

No closed form exists for noise with a random walk, or noise that differs from row to row, such as
noise of the time stamps. The triangular factor of the whitened functions is then tabulated over the
rate and the number of revolutions, with rows about as dense as in the records.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache, cached_property
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from counterspin.arrays import Array, triangular_factor
from counterspin.campaign.runs import MAX_COMPUTED_ROWS
from counterspin.errors import CounterspinError
from counterspin.frozen import frozen
from counterspin.inference.noise.model import Noise, make_whitener
from counterspin.records.reduction import BLOCKS_PER_REVOLUTION


def basis_functions(angle: Array, n_harmonics: int) -> Array:
    """Return 1, th, th^2, th^3 and, by harmonic, cos, sin, th cos, th sin; shape (n, b)."""
    columns = [angle**power for power in range(4)]
    for m in range(1, n_harmonics + 1):
        cos, sin = np.cos(m * angle), np.sin(m * angle)
        columns += [cos, sin, angle * cos, angle * sin]
    return np.column_stack(columns)


def integration_matrix(n_harmonics: int, order: int) -> Array:
    """Return the matrix that integrates a combination of the functions `order` times over th."""
    n_functions = 4 + 4 * n_harmonics
    single_integration = np.zeros((n_functions, n_functions))
    for power in range(3):
        single_integration[power + 1, power] = 1.0 / (power + 1)
    for m in range(1, n_harmonics + 1):
        harmonic_columns = slice(4 * m, 4 * m + 4)
        # Columns: the derivatives of cos, sin, th cos, th sin in terms of the same four.
        derivative = np.array(
            [[0.0, m, 1.0, 0.0], [-m, 0.0, 0.0, 1.0], [0.0, 0.0, 0.0, m], [0.0, 0.0, -m, 0.0]]
        )
        single_integration[harmonic_columns, harmonic_columns] = np.linalg.inv(derivative)
    return np.asarray(np.linalg.matrix_power(single_integration, order))


def shift_angle_origin(weights: Array, shift: Array) -> Array:
    """Convert combinations of the functions of th to combinations of the functions of th - shift.

    weights: Shape (n, b, k).
    shift: rad, shape (n,).
    """
    n, n_functions, k = weights.shape
    s = shift[:, None]
    w = [weights[:, i] for i in range(4)]
    result = np.empty_like(weights)
    result[:, 0] = w[0] + s * (w[1] + s * (w[2] + s * w[3]))
    result[:, 1] = w[1] + s * (2.0 * w[2] + 3.0 * s * w[3])
    result[:, 2] = w[2] + 3.0 * s * w[3]
    result[:, 3] = w[3]
    m = np.arange(1, n_functions // 4)
    cos, sin = (function(m * s)[:, :, None] for function in (np.cos, np.sin))
    harmonic_weights = weights[:, 4:].reshape(n, m.size, 4, k)
    shifted_weights = result[:, 4:].reshape(n, m.size, 4, k)
    cos_weights, sin_weights = (
        harmonic_weights[:, :, i] + s[:, :, None] * harmonic_weights[:, :, i + 2] for i in (0, 1)
    )
    shifted_weights[:, :, 0] = cos * cos_weights + sin * sin_weights
    shifted_weights[:, :, 1] = cos * sin_weights - sin * cos_weights
    shifted_weights[:, :, 2] = cos * harmonic_weights[:, :, 2] + sin * harmonic_weights[:, :, 3]
    shifted_weights[:, :, 3] = cos * harmonic_weights[:, :, 3] - sin * harmonic_weights[:, :, 2]
    return result


def prefix_factors(rows: Array, ends: npt.NDArray[np.int64], n_dropped: int) -> Array:
    """Return the triangular factors of the rows up to each end, without the first columns.

    Returns: shape (ends, b - n_dropped, b - n_dropped).
    """
    factors = []
    triangle = np.empty((0, rows.shape[1]))
    start = 0
    for end in ends:
        triangle = triangular_factor(np.vstack([triangle, rows[start:end]]))
        signs = np.where(np.diagonal(triangle) < 0.0, -1.0, 1.0)
        positive_triangle = signs[:, None] * triangle
        factors.append(positive_triangle[n_dropped:, n_dropped:])
        start = end
    return np.array(factors)


#: Maximum phase of the highest harmonic of the products per row, rad. The kernel is singular at
#: 2 pi.
_MAX_ANGLE_STEP: Final = 5.5

#: Relative ridge on the diagonal of the sums of products: the matrix is singular if the samples are
#: too few to separate the functions.
_RIDGE: Final = 1e-14

#: Derivatives of q = 1/(n sin(b/n)) by b over q: coefficients of powers of c = cot(b/n)/n and
#: of e = 1/n^2, as (coefficient, power of c, power of e).
_KERNEL: Final = (
    ((1.0, 0, 0),),
    ((-1.0, 1, 0),),
    ((2.0, 2, 0), (1.0, 0, 1)),
    ((-6.0, 3, 0), (-5.0, 1, 1)),
    ((24.0, 4, 0), (28.0, 2, 1), (5.0, 0, 2)),
)
_BINOMIALS: Final = ((1,), (1, 1), (1, 2, 1), (1, 3, 3, 1), (1, 4, 6, 4, 1))


@frozen(eq=False)
class EvenSamples:
    """Samples, or means of adjoining blocks of samples, evenly spaced in angle, for n runs."""

    first_angle: Array  #: Angle of the first row, rad, shape (n,).
    angle_step: Array  #: Angle from row to row, rad, shape (n,).
    count: Array  #: Number of rows, not necessarily whole, shape (n,).
    #: Standard deviation of the angles inside a block, rad, shape (n,); 0 for point samples.
    angle_sd: Array

    @property
    def mean_angle(self) -> Array:
        """Mean angle, rad, shape (n,)."""
        return np.asarray(self.first_angle + 0.5 * self.angle_step * (self.count - 1.0))

    @property
    def half_width(self) -> Array:
        """Half the angle that the rows cover, rad, shape (n,); x is an angle divided by it."""
        return np.asarray(0.5 * self.angle_step * self.count)


def sqrt_information(samples: EvenSamples, weights: Array, n_start_errors: int) -> Array:
    """Return square-root information, each row with unit variance.

    weights: Combinations of the functions, shape (n, b, k).
    n_start_errors: Number of start errors, 0, 1 or 2: of the columns 1 and th, estimated per run.
    Returns: shape (n, b - n_start_errors, k).
    """
    n_harmonics = weights.shape[1] // 4 - 1
    even, odd = center_weights(average_over_blocks(weights, samples.angle_sd), samples)
    result = np.empty((len(weights), weights.shape[1] - n_start_errors, weights.shape[2]))
    is_coarse = 2.0 * n_harmonics * samples.angle_step > _MAX_ANGLE_STEP
    fine_runs = np.flatnonzero(~is_coarse)
    if fine_runs.size:
        moments = _moments(samples.angle_step[fine_runs], samples.count[fine_runs], 2 * n_harmonics)
        sqrt_count = np.sqrt(samples.count[fine_runs])[:, None, None]
        n_even = even.shape[1] - (n_start_errors > 0)
        for parity, columns, n_dropped, rows in (
            (0, even, int(n_start_errors > 0), slice(0, n_even)),
            (1, odd, int(n_start_errors > 1), slice(n_even, None)),
        ):
            lower = _cholesky_factors(_product_means(moments, n_harmonics, parity))
            upper = np.swapaxes(lower, 1, 2)[:, n_dropped:]
            result[fine_runs, rows] = sqrt_count * (upper @ columns[fine_runs])
    for run in np.flatnonzero(is_coarse):
        factor = _factor_samples(samples, run, even[run], odd[run], n_harmonics)
        result[run] = factor[n_start_errors:]
    return result


def average_over_blocks(weights: Array, angle_sd: Array) -> Array:
    """Return the combinations averaged over the angles th - sd and th + sd."""
    is_averaged = angle_sd > 0.0
    if not is_averaged.any():
        return weights
    result = weights.copy()
    forward_weights, backward_weights = (
        shift_angle_origin(weights[is_averaged], sign * angle_sd[is_averaged])
        for sign in (1.0, -1.0)
    )
    result[is_averaged] = 0.5 * (forward_weights + backward_weights)
    return result


def center_weights(weights: Array, samples: EvenSamples) -> tuple[Array, Array]:
    """Return the combinations in terms of x about the middle: even functions, odd functions.

    Even: 1, x^2, cos m t and, for all m, x sin m t; odd: x, x^3, sin m t, x cos m t.
    """
    centered = shift_angle_origin(weights, samples.mean_angle)
    half_width = samples.half_width[:, None, None]
    poly, trig = centered[:, :4], centered[:, 4:]
    even = [poly[:, :1], half_width**2 * poly[:, 2:3], trig[:, 0::4], half_width * trig[:, 3::4]]
    odd = [
        half_width * poly[:, 1:2],
        half_width**3 * poly[:, 3:4],
        trig[:, 1::4],
        half_width * trig[:, 2::4],
    ]
    return np.concatenate(even, axis=1), np.concatenate(odd, axis=1)


def _moments(step: Array, count: Array, max_harmonic: int) -> Array:
    """Return means over the rows of x^p cos(m t), p even, and x^p sin(m t), p odd.

    Shape (n, 7, max_harmonic + 1); powers above 4 are valid only for m = 0.
    """
    e = (1.0 / count**2)[:, None]
    m = np.arange(1, max_harmonic + 1)
    b = 0.5 * count[:, None] * m * step[:, None]
    angle = b / count[:, None]
    q = 1.0 / (count[:, None] * np.sin(angle))
    c = np.cos(angle) / np.sin(angle) / count[:, None]
    kernel = [q * sum(factor * c**i * e**j for factor, i, j in row) for row in _KERNEL]
    cos, sin = np.cos(b), np.sin(b)
    derivatives = (sin, cos, -sin, -cos, sin)
    result = np.zeros((len(step), 7, max_harmonic + 1))
    sign = (1.0, -1.0, -1.0, 1.0, 1.0)
    for p in range(5):
        terms = (_BINOMIALS[p][j] * derivatives[p - j] * kernel[j] for j in range(p + 1))
        result[:, p, 1:] = sign[p] * sum(terms)
    e = e[:, 0]
    result[:, 0, 0] = 1.0
    result[:, 2, 0] = (1.0 - e) / 3.0
    result[:, 4, 0] = (1.0 - e) * (3.0 - 7.0 * e) / 15.0
    result[:, 6, 0] = (1.0 - e) * (3.0 - 18.0 * e + 31.0 * e**2) / 21.0
    return result


@cache
def _product_terms(
    n_harmonics: int, parity: int
) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp], npt.NDArray[np.intp], Array, Array]:
    """Return the product of each pair of functions of one parity.

    A product has a power of x, a difference and a sum of harmonics, and factors of their moments.
    """
    polynomials = [(parity, 0, 0), (parity + 2, 0, 0)]
    m = range(1, n_harmonics + 1)
    functions = [*polynomials, *((0, parity, i) for i in m), *((1, 1 - parity, i) for i in m)]
    shape = len(functions), len(functions)
    power, difference_index, sum_index = (np.zeros(shape, dtype=np.intp) for _ in range(3))
    difference_weight, sum_weight = np.zeros(shape), np.zeros(shape)
    for i, (power_a, is_sine_a, m_a) in enumerate(functions):
        for j, (power_b, is_sine_b, m_b) in enumerate(functions):
            power[i, j] = power_a + power_b
            difference_index[i, j], sum_index[i, j] = abs(m_a - m_b), m_a + m_b
            if is_sine_a == is_sine_b:
                difference_weight[i, j], sum_weight[i, j] = 0.5, (-0.5 if is_sine_a else 0.5)
            else:  # sin m cos l = (sin (m + l) + sin (m - l))/2, m the sine's
                signed_difference = m_a - m_b if is_sine_a else m_b - m_a
                difference_weight[i, j], sum_weight[i, j] = 0.5 * np.sign(signed_difference), 0.5
    return power, difference_index, sum_index, difference_weight, sum_weight


def _product_means(moments: Array, n_harmonics: int, parity: int) -> Array:
    """Return the mean products of the even (parity 0) or odd (1) functions, shape (n, c, c)."""
    power, difference_index, sum_index, difference_weight, sum_weight = _product_terms(
        n_harmonics, parity
    )
    result = difference_weight * moments[:, power, difference_index]
    result += sum_weight * moments[:, power, sum_index]
    return np.asarray(result)


def _cholesky_factors(products: Array) -> Array:
    """Return lower triangular factors, shape (n, c, c)."""
    diagonal = np.arange(products.shape[1])
    products[:, diagonal, diagonal] *= 1.0 + _RIDGE
    return np.asarray(np.linalg.cholesky(products))


def _factor_samples(
    samples: EvenSamples, run: np.intp, even: Array, odd: Array, n_harmonics: int
) -> Array:
    """Return the rows of a run, computed from its samples; rows of start errors first."""
    count = float(samples.count[run])
    n_rows = int(np.ceil(count - 1e-9))
    t = samples.angle_step[run] * (np.arange(n_rows) - 0.5 * (count - 1.0))
    x = t / samples.half_width[run]
    m = np.arange(1, n_harmonics + 1)
    cos, sin = np.cos(t[:, None] * m), np.sin(t[:, None] * m)
    # Start errors first: lower rows of the triangle do not depend on them.
    start_error_columns = np.column_stack([np.ones(n_rows), x])
    other_columns = np.column_stack([x**2, cos, x[:, None] * sin, x**3, sin, x[:, None] * cos])
    rows = np.hstack([start_error_columns, other_columns])
    rows[-1] *= np.sqrt(count - (n_rows - 1))  # the last row may be a fraction of a row
    rows = np.vstack([rows, np.zeros((max(0, rows.shape[1] - n_rows), rows.shape[1]))])
    return np.asarray(triangular_factor(rows) @ np.vstack([even[0], odd[0], even[1:], odd[1:]]))


#: Phases at which factors are tabulated; the number of rows per revolution is a multiple.
_N_PHASES: Final = 16

#: Ratio of neighbouring nodes in the number of revolutions, and in the rate.
_REVOLUTION_RATIO: Final = 1.13
_RATE_RATIO: Final = 1.22


#: Function of rate (rad/s) and angles (rad, shape (n,)) that returns a variance, shape (n,).
VarianceFunction = Callable[[float, Array], Array]


class InformationTable:
    """Interpolation table of the triangular factors of the whitened functions of the angle.

    order: Number of integrations of the specific force in the observable.
    noise: Noise of one sample.
    added_variance: Additional variance of a sample; None: no additional variance.
    sampling_rate: Hz.
    """

    def __init__(
        self,
        order: int,
        noise: Noise,
        added_variance: VarianceFunction | None,
        sampling_rate: float,
        rate_range: tuple[float, float],
        revolution_range: tuple[float, float],
        n_harmonics: int,
    ) -> None:
        self._order = order
        self._noise = noise
        self._added_variance = added_variance
        #: Number of the functions 1 and th that differences of rows eliminate (random walk).
        self._n_dropped = order if noise.random_walk > 0.0 else 0
        self._sampling_rate = sampling_rate
        self._n_harmonics = n_harmonics
        if revolution_range[1] > (max_revolutions := MAX_COMPUTED_ROWS / BLOCKS_PER_REVOLUTION):
            raise CounterspinError(
                f"limits: these limits allow runs of {revolution_range[1]:.3g} revolutions. With a "
                "random walk or time-stamp jitter, the search covers only runs of at most "
                f"{max_revolutions:.3g} revolutions. Reduce longest_run, total_time or "
                "highest_rate",
                code="value-out-of-range",
            )
        self._counts = _integer_grid(revolution_range)
        self._nodes = _log_nodes(*rate_range)

    @cached_property
    def _integer_spline(self) -> Any:
        """The spline through integer numbers of revolutions."""
        return self._make_spline(1)

    @cached_property
    def _phase_splines(self) -> Any:
        """The splines for each phase at the end of a run."""
        return self._make_spline(_N_PHASES)

    def _make_spline(self, n_phases: int) -> Any:
        """Return a spline over log rate and log revolutions of factors, (phases, b, b)."""
        from scipy.interpolate import NdBSpline, make_interp_spline

        counts, order, n_dropped = self._counts, self._order, self._n_dropped
        conversion_matrices = _conversion_matrices(counts, n_phases)
        max_density = 1 if n_phases == 1 and self._added_variance is None else 4
        tables = []
        for rate in np.exp(self._nodes):
            samples_per_revolution = 2.0 * math.pi * self._sampling_rate / rate
            points_per_revolution = _N_PHASES * int(
                np.clip(round(samples_per_revolution / _N_PHASES), 1, max_density)
            )
            angle = (np.arange(points_per_revolution * (counts[-1] + 1)) + 0.5) * (
                2.0 * math.pi / points_per_revolution
            )
            # Variance of a row over the variance of a sample.
            variance_weight = points_per_revolution / samples_per_revolution
            white_sd = math.sqrt(self._noise.sample_variance * variance_weight)
            added_variance = (
                0.0
                if self._added_variance is None
                else variance_weight * self._added_variance(float(rate), angle)
            )
            noise = Noise(white_sd, self._noise.random_walk)
            whitener = make_whitener(angle / rate, order, noise, added_variance=added_variance)
            rows = whitener.apply(basis_functions(angle, self._n_harmonics)[:, n_dropped:])
            phase_offsets = np.arange(n_phases) * (points_per_revolution // n_phases)
            ends = (counts[:, None] * points_per_revolution + phase_offsets).ravel() - n_dropped
            factors = prefix_factors(rows, ends, order - n_dropped).reshape(
                len(counts), n_phases, -1
            )
            tables.append(conversion_matrices @ factors.swapaxes(0, 1))
        # Interpolation is linear in the values: the splines' coefficients are matrix products.
        rate_spline = make_interp_spline(self._nodes, np.eye(len(self._nodes)))
        count_spline = make_interp_spline(np.log(counts), np.eye(len(counts)))
        # Shape (rates, phases, counts, b b).
        values = np.tensordot(rate_spline.c, np.array(tables), axes=1)
        n_functions = 4 + 4 * self._n_harmonics - order
        shape = (len(self._nodes), len(counts), n_phases, n_functions, n_functions)
        coefficients = (count_spline.c @ values).swapaxes(1, 2).reshape(shape)
        return NdBSpline((rate_spline.t, count_spline.t), coefficients, 3)

    def sqrt_information(
        self, weights: Array, rate: Array, n_samples: Array, *, depends_on_phase: bool
    ) -> Array:
        """Return square-root information of runs, each row with unit variance.

        weights: Combinations of the functions, shape (n, b, k).
        rate, n_samples: rad/s, and number of samples, shape (n,).
        depends_on_phase: True: the information depends on the phase at the end (slower); False: it
            is interpolated between integer numbers of revolutions.
        Returns: shape (n, b - order, k).
        """
        angle_step = rate / self._sampling_rate
        revolutions = n_samples * angle_step / (2.0 * math.pi)
        # The samples cover an angle that begins half a step before the first one.
        shifted_weights = shift_angle_origin(weights, -0.5 * angle_step)[:, self._order :]
        log_points = np.column_stack([np.log(rate), np.log(revolutions)])
        # With noisy time stamps, samples near an extremum of the output are most informative, and
        # their positions matter more than the phase at the end.
        if not depends_on_phase or self._added_variance is not None:
            return np.asarray(self._integer_spline(log_points)[:, 0] @ shifted_weights)
        phase_weights = _trigonometric_weights(revolutions)[:, :, None, None]
        return np.asarray(
            np.sum(phase_weights * self._phase_splines(log_points), axis=1) @ shifted_weights
        )


def _conversion_matrices(counts: npt.NDArray[np.int64], n_phases: int) -> Array:
    """Return matrices that convert factors tabulated at a phase to whole revolutions.

    At a fixed phase, a factor is a smooth function of the number of revolutions.

    Returns: shape (n_phases, c, c) for c tabulated numbers of revolutions.
    """
    from scipy.interpolate import make_interp_spline

    identity = np.eye(len(counts))
    splines = (make_interp_spline(np.log(counts + j / n_phases), identity) for j in range(n_phases))
    return np.array([spline(np.log(counts)) for spline in splines])


def _trigonometric_weights(revolutions: Array) -> Array:
    """Return the weights of equally spaced phases in trigonometric interpolation, (n, phases)."""
    phase_distance = revolutions[:, None] % 1.0 - np.arange(_N_PHASES) / _N_PHASES
    half_angle = math.pi * np.where(np.abs(phase_distance) < 1e-12, 1.0, phase_distance)
    weights = np.sin(_N_PHASES * half_angle) / (_N_PHASES * np.tan(half_angle))
    return np.asarray(np.where(np.abs(phase_distance) < 1e-12, 1.0, weights))


def _integer_grid(bounds: tuple[float, float]) -> npt.NDArray[np.int64]:
    """Return integer numbers of revolutions that span a range, nearly a geometric series."""
    low, high = max(1, math.floor(bounds[0])), math.ceil(bounds[1])
    high = max(high, low + 4)
    counts = [low]
    while counts[-1] < high:
        counts.append(max(counts[-1] + 1, round(counts[-1] * _REVOLUTION_RATIO)))
    return np.array(counts, dtype=np.int64)


def _log_nodes(low: float, high: float) -> Array:
    count = max(6, math.ceil(math.log(high / low) / math.log(_RATE_RATIO)) + 1)
    return np.linspace(math.log(low), math.log(high), count)

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

The number of samples need not be whole: between whole numbers the sums follow the smooth curve
through them.

No closed form exists where the noise has a random walk, or differs from row to row, as that of
time stamps does: the triangular factor of the whitened functions is tabulated over the rate and the
number of revolutions, with rows about as dense as the records' own.
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


def basis_functions(angle: Array, harmonics: int) -> Array:
    """Return 1, th, th^2, th^3 and, by harmonic, cos, sin, th cos, th sin; shape (n, b)."""
    columns = [angle**power for power in range(4)]
    for m in range(1, harmonics + 1):
        cos, sin = np.cos(m * angle), np.sin(m * angle)
        columns += [cos, sin, angle * cos, angle * sin]
    return np.column_stack(columns)


def integration_matrix(harmonics: int, order: int) -> Array:
    """Return the matrix that integrates a combination of the functions `order` times over th."""
    size = 4 + 4 * harmonics
    once = np.zeros((size, size))
    for power in range(3):
        once[power + 1, power] = 1.0 / (power + 1)
    for m in range(1, harmonics + 1):
        block = slice(4 * m, 4 * m + 4)
        # Columns: the derivatives of cos, sin, th cos, th sin in terms of the same four.
        derivative = np.array(
            [[0.0, m, 1.0, 0.0], [-m, 0.0, 0.0, 1.0], [0.0, 0.0, 0.0, m], [0.0, 0.0, -m, 0.0]]
        )
        once[block, block] = np.linalg.inv(derivative)
    return np.asarray(np.linalg.matrix_power(once, order))


def shift_angle_origin(weights: Array, shift: Array) -> Array:
    """Return combinations of the functions of th as combinations of the functions of th - shift.

    weights: Shape (n, b, k).
    shift: rad, shape (n,).
    """
    n, size, k = weights.shape
    s = shift[:, None]
    w = [weights[:, i] for i in range(4)]
    result = np.empty_like(weights)
    result[:, 0] = w[0] + s * (w[1] + s * (w[2] + s * w[3]))
    result[:, 1] = w[1] + s * (2.0 * w[2] + 3.0 * s * w[3])
    result[:, 2] = w[2] + 3.0 * s * w[3]
    result[:, 3] = w[3]
    m = np.arange(1, size // 4)
    cos, sin = (f(m * s)[:, :, None] for f in (np.cos, np.sin))
    before = weights[:, 4:].reshape(n, m.size, 4, k)
    after = result[:, 4:].reshape(n, m.size, 4, k)
    of_cos, of_sin = (before[:, :, i] + s[:, :, None] * before[:, :, i + 2] for i in (0, 1))
    after[:, :, 0] = cos * of_cos + sin * of_sin
    after[:, :, 1] = cos * of_sin - sin * of_cos
    after[:, :, 2] = cos * before[:, :, 2] + sin * before[:, :, 3]
    after[:, :, 3] = cos * before[:, :, 3] - sin * before[:, :, 2]
    return result


def prefix_factors(rows: Array, ends: npt.NDArray[np.int64], drop: int) -> Array:
    """Return the triangular factor of the first rows, up to each end; the first columns dropped.

    Returns: shape (ends, b - drop, b - drop).
    """
    factors = []
    triangle = np.empty((0, rows.shape[1]))
    start = 0
    for end in ends:
        triangle = triangular_factor(np.vstack([triangle, rows[start:end]]))
        signs = np.where(np.diagonal(triangle) < 0.0, -1.0, 1.0)
        selected = signs[:, None] * triangle
        factors.append(selected[drop:, drop:])
        start = end
    return np.array(factors)


#: Largest angle by which the highest harmonic of the products may turn from sample to sample, rad.
#: Towards 2 pi the kernel becomes singular.
_LARGEST_STEP: Final = 5.5

#: Added to the diagonal of a matrix of sums, relative: where samples are too few to tell functions
#: apart, the matrix is singular.
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
_BINOMIAL: Final = ((1,), (1, 1), (1, 2, 1), (1, 3, 3, 1), (1, 4, 6, 4, 1))


@frozen(eq=False)
class EvenSamples:
    """Samples, or means of adjoining blocks of samples, evenly spaced in angle; one row a run."""

    first: Array  #: Angle of the first row, rad, shape (n,).
    step: Array  #: Angle from row to row, rad, shape (n,).
    count: Array  #: Number of rows, not necessarily whole, shape (n,).
    #: Standard deviation of the angles inside a block, rad, shape (n,); 0 for point samples.
    spread: Array

    @property
    def middle(self) -> Array:
        """Mean angle, rad, shape (n,)."""
        return np.asarray(self.first + 0.5 * self.step * (self.count - 1.0))

    @property
    def half_width(self) -> Array:
        """Half the angle that the rows stand for, rad, shape (n,); x is an angle over this."""
        return np.asarray(0.5 * self.step * self.count)


def sqrt_information(samples: EvenSamples, weights: Array, held: int) -> Array:
    """Return square-root information, each row with unit variance.

    weights: Combinations of the functions, shape (n, b, k).
    held: Number of the columns 1 and th that are start errors, estimated in each run: 0, 1 or 2.
    Returns: shape (n, b - held, k).
    """
    harmonics = weights.shape[1] // 4 - 1
    even, odd = center_weights(average_over_blocks(weights, samples.spread), samples)
    result = np.empty((len(weights), weights.shape[1] - held, weights.shape[2]))
    wide = 2.0 * harmonics * samples.step > _LARGEST_STEP
    close = np.flatnonzero(~wide)
    if close.size:
        moments = _moments(samples.step[close], samples.count[close], 2 * harmonics)
        size = np.sqrt(samples.count[close])[:, None, None]
        half = even.shape[1] - (held > 0)
        for parity, columns, drop, rows in (
            (0, even, int(held > 0), slice(0, half)),
            (1, odd, int(held > 1), slice(half, None)),
        ):
            lower = _cholesky_factors(_sums(moments, harmonics, parity))
            upper = np.swapaxes(lower, 1, 2)[:, drop:]
            result[close, rows] = size * (upper @ columns[close])
    for run in np.flatnonzero(wide):
        result[run] = _sum_rows(samples, run, even[run], odd[run], harmonics)[held:]
    return result


def average_over_blocks(weights: Array, spread: Array) -> Array:
    """Return the combinations averaged over the angles th - spread and th + spread."""
    blocks = spread > 0.0
    if not blocks.any():
        return weights
    result = weights.copy()
    later, earlier = (
        shift_angle_origin(weights[blocks], shift * spread[blocks]) for shift in (1.0, -1.0)
    )
    result[blocks] = 0.5 * (later + earlier)
    return result


def center_weights(weights: Array, samples: EvenSamples) -> tuple[Array, Array]:
    """Return the combinations in terms of x about the middle: even functions, odd functions.

    Even: 1, x^2, cos m t and, for all m, x sin m t; odd: x, x^3, sin m t, x cos m t.
    """
    about = shift_angle_origin(weights, samples.middle)
    half = samples.half_width[:, None, None]
    trig = about[:, 4:]
    even = [about[:, :1], half**2 * about[:, 2:3], trig[:, 0::4], half * trig[:, 3::4]]
    odd = [half * about[:, 1:2], half**3 * about[:, 3:4], trig[:, 1::4], half * trig[:, 2::4]]
    return np.concatenate(even, axis=1), np.concatenate(odd, axis=1)


def _moments(step: Array, count: Array, highest: int) -> Array:
    """Return means over the rows of x^p cos(m t), p even, and x^p sin(m t), p odd.

    Shape (n, 7, highest + 1); powers above 4 are there for m = 0 only.
    """
    e = (1.0 / count**2)[:, None]
    m = np.arange(1, highest + 1)
    b = 0.5 * count[:, None] * m * step[:, None]
    angle = b / count[:, None]
    q = 1.0 / (count[:, None] * np.sin(angle))
    c = np.cos(angle) / np.sin(angle) / count[:, None]
    kernel = [q * sum(f * c**i * e**j for f, i, j in row) for row in _KERNEL]
    cos, sin = np.cos(b), np.sin(b)
    derivatives = (sin, cos, -sin, -cos, sin)
    result = np.zeros((len(step), 7, highest + 1))
    sign = (1.0, -1.0, -1.0, 1.0, 1.0)
    for p in range(5):
        terms = (_BINOMIAL[p][j] * derivatives[p - j] * kernel[j] for j in range(p + 1))
        result[:, p, 1:] = sign[p] * sum(terms)
    e = e[:, 0]
    result[:, 0, 0] = 1.0
    result[:, 2, 0] = (1.0 - e) / 3.0
    result[:, 4, 0] = (1.0 - e) * (3.0 - 7.0 * e) / 15.0
    result[:, 6, 0] = (1.0 - e) * (3.0 - 18.0 * e + 31.0 * e**2) / 21.0
    return result


@cache
def _pairs(
    harmonics: int, parity: int
) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp], npt.NDArray[np.intp], Array, Array]:
    """Return the product of each pair of functions of one parity.

    A product has a power of x, a difference and a sum of harmonics, and factors of their moments.
    """
    zero = [(parity, 0, 0), (parity + 2, 0, 0)]
    m = range(1, harmonics + 1)
    functions = [*zero, *((0, parity, i) for i in m), *((1, 1 - parity, i) for i in m)]
    size = len(functions)
    power, difference, together = (np.zeros((size, size), dtype=np.intp) for _ in range(3))
    by_difference, by_sum = np.zeros((size, size)), np.zeros((size, size))
    for i, (a, sine, m_a) in enumerate(functions):
        for j, (b, other_sine, m_b) in enumerate(functions):
            power[i, j], difference[i, j], together[i, j] = a + b, abs(m_a - m_b), m_a + m_b
            if sine == other_sine:
                by_difference[i, j], by_sum[i, j] = 0.5, (-0.5 if sine else 0.5)
            else:  # sin m cos l = (sin (m + l) + sin (m - l))/2, m the sine's
                towards = m_a - m_b if sine else m_b - m_a
                by_difference[i, j], by_sum[i, j] = 0.5 * np.sign(towards), 0.5
    return power, difference, together, by_difference, by_sum


def _sums(moments: Array, harmonics: int, parity: int) -> Array:
    """Return the mean products of the even (parity 0) or odd (1) functions, shape (n, c, c)."""
    power, difference, together, by_difference, by_sum = _pairs(harmonics, parity)
    result = by_difference * moments[:, power, difference]
    result += by_sum * moments[:, power, together]
    return np.asarray(result)


def _cholesky_factors(sums: Array) -> Array:
    """Return lower triangular factors, shape (n, c, c)."""
    diagonal = np.arange(sums.shape[1])
    sums[:, diagonal, diagonal] *= 1.0 + _RIDGE
    return np.asarray(np.linalg.cholesky(sums))


def _sum_rows(samples: EvenSamples, run: np.intp, even: Array, odd: Array, harmonics: int) -> Array:
    """Return one run's rows from its samples themselves, the start errors' first."""
    count = float(samples.count[run])
    rows_needed = int(np.ceil(count - 1e-9))
    t = samples.step[run] * (np.arange(rows_needed) - 0.5 * (count - 1.0))
    x = t / samples.half_width[run]
    m = np.arange(1, harmonics + 1)
    cos, sin = np.cos(t[:, None] * m), np.sin(t[:, None] * m)
    # Start errors first: the rows of the triangle below theirs are free of them.
    first = np.column_stack([np.ones(rows_needed), x])
    rest = np.column_stack([x**2, cos, x[:, None] * sin, x**3, sin, x[:, None] * cos])
    rows = np.hstack([first, rest])
    rows[-1] *= np.sqrt(count - (rows_needed - 1))  # of the last row only its part counts
    rows = np.vstack([rows, np.zeros((max(0, rows.shape[1] - rows_needed), rows.shape[1]))])
    return np.asarray(triangular_factor(rows) @ np.vstack([even[0], odd[0], even[1:], odd[1:]]))


#: Parts of a revolution at which factors are tabulated; rows to a revolution are a multiple.
_PHASES: Final = 16

#: Ratio of neighbouring nodes in the number of revolutions, and in the rate.
_REVOLUTION_RATIO: Final = 1.13
_RATE_RATIO: Final = 1.22


#: Additional variance of a sample, at a rate (rad/s) and angles (rad, shape (n,)): shape (n,).
Added = Callable[[float, Array], Array]


class InformationTable:
    """Factors of the whitened functions of the angle.

    order: Number of integrations of the specific force in the observable.
    noise: Of one sample.
    added: None: nothing.
    sampling_rate: Hz.
    """

    def __init__(
        self,
        order: int,
        noise: Noise,
        added: Added | None,
        sampling_rate: float,
        rates: tuple[float, float],
        revolutions: tuple[float, float],
        harmonics: int,
    ) -> None:
        self._order = order
        self._noise = noise
        self._added = added
        #: The differences of rows whose noise walks have lost the first functions, 1 and th.
        self._lost = order if noise.random_walk > 0.0 else 0
        self._sampling_rate = sampling_rate
        self._harmonics = harmonics
        if revolutions[1] > (most := MAX_COMPUTED_ROWS / BLOCKS_PER_REVOLUTION):
            raise CounterspinError(
                f"limits: these limits allow runs of {revolutions[1]:.3g} revolutions. With a "
                "random walk or time-stamp jitter, the search covers only runs of at most "
                f"{most:.3g} revolutions. Reduce longest_run, total_time or highest_rate",
                code="value-out-of-range",
            )
        self._counts = _integer_grid(revolutions)
        self._nodes = _log_nodes(*rates)

    @cached_property
    def _integer_spline(self) -> Any:
        """The spline through whole numbers of revolutions."""
        return self._spline(1)

    @cached_property
    def _phase_splines(self) -> Any:
        """A spline for each part of a revolution at the end."""
        return self._spline(_PHASES)

    def _spline(self, phases: int) -> Any:
        """Return a spline over log rate and log revolutions of factors, (phases, b, b)."""
        from scipy.interpolate import NdBSpline, make_interp_spline

        counts, order, lost = self._counts, self._order, self._lost
        conversions = _conversion_matrices(counts, phases)
        densest = 1 if phases == 1 and self._added is None else 4
        tables = []
        for rate in np.exp(self._nodes):
            samples = 2.0 * math.pi * self._sampling_rate / rate  # to a revolution
            points = _PHASES * int(np.clip(round(samples / _PHASES), 1, densest))
            angle = (np.arange(points * (counts[-1] + 1)) + 0.5) * (2.0 * math.pi / points)
            weight = points / samples  # of a row, of the variance of a sample
            white = math.sqrt(self._noise.sample_variance * weight)
            added = 0.0 if self._added is None else weight * self._added(float(rate), angle)
            noise = Noise(white, self._noise.random_walk)
            whiten = make_whitener(angle / rate, order, noise, added_variance=added)
            rows = whiten.apply(basis_functions(angle, self._harmonics)[:, lost:])
            parts = np.arange(phases) * (points // phases)
            ends = (counts[:, None] * points + parts).ravel() - lost
            factors = prefix_factors(rows, ends, order - lost).reshape(len(counts), phases, -1)
            tables.append(conversions @ factors.swapaxes(0, 1))
        # Interpolation is linear in the values: the splines' coefficients are matrix products.
        by_rate = make_interp_spline(self._nodes, np.eye(len(self._nodes)))
        by_count = make_interp_spline(np.log(counts), np.eye(len(counts)))
        values = np.tensordot(by_rate.c, np.array(tables), axes=1)  # (rates, phases, counts, b b)
        size = 4 + 4 * self._harmonics - order
        shape = (len(self._nodes), len(counts), phases, size, size)
        coefficients = (by_count.c @ values).swapaxes(1, 2).reshape(shape)
        return NdBSpline((by_rate.t, by_count.t), coefficients, 3)

    def sqrt_information(
        self, weights: Array, rate: Array, samples: Array, *, with_ripple: bool
    ) -> Array:
        """Return square-root information of runs, each row with unit variance.

        weights: Combinations of the functions, shape (n, b, k).
        rate, samples: rad/s, and number of samples, shape (n,).
        with_ripple: True: the information follows the part of a revolution at the end, which
            takes longer; False: smoothly from whole number to whole number of revolutions.
        Returns: shape (n, b - order, k).
        """
        phase = rate / self._sampling_rate
        revolutions = samples * phase / (2.0 * math.pi)
        # The samples stand for an angle that begins half a step before the first.
        shifted = shift_angle_origin(weights, -0.5 * phase)[:, self._order :]
        index = np.column_stack([np.log(rate), np.log(revolutions)])
        # What samples near an extremum of the output tell, where time stamps do no harm, depends on
        # where they happen to be: more than the ripple does.
        if not with_ripple or self._added is not None:
            return np.asarray(self._integer_spline(index)[:, 0] @ shifted)
        kernel = _trigonometric_weights(revolutions)[:, :, None, None]
        return np.asarray(np.sum(kernel * self._phase_splines(index), axis=1) @ shifted)


def _conversion_matrices(counts: npt.NDArray[np.int64], phases: int) -> Array:
    """Return matrices that convert factors tabulated at a phase to whole revolutions.

    At one phase of the end a factor is a smooth function of the number of revolutions.

    Returns: for each part a matrix over the numbers, shape (phases, c, c).
    """
    from scipy.interpolate import make_interp_spline

    alone = np.eye(len(counts))
    parts = (make_interp_spline(np.log(counts + j / phases), alone) for j in range(phases))
    return np.array([part(np.log(counts)) for part in parts])


def _trigonometric_weights(revolutions: Array) -> Array:
    """Return the weights of equally spaced phases in trigonometric interpolation, (n, phases)."""
    distance = revolutions[:, None] % 1.0 - np.arange(_PHASES) / _PHASES
    half = math.pi * np.where(np.abs(distance) < 1e-12, 1.0, distance)
    weights = np.sin(_PHASES * half) / (_PHASES * np.tan(half))
    return np.asarray(np.where(np.abs(distance) < 1e-12, 1.0, weights))


def _integer_grid(bounds: tuple[float, float]) -> npt.NDArray[np.int64]:
    """Return whole numbers of revolutions that span a range, nearly in a geometric series."""
    low, high = max(1, math.floor(bounds[0])), math.ceil(bounds[1])
    high = max(high, low + 4)
    counts = [low]
    while counts[-1] < high:
        counts.append(max(counts[-1] + 1, round(counts[-1] * _REVOLUTION_RATIO)))
    return np.array(counts, dtype=np.int64)


def _log_nodes(low: float, high: float) -> Array:
    count = max(6, math.ceil(math.log(high / low) / math.log(_RATE_RATIO)) + 1)
    return np.linspace(math.log(low), math.log(high), count)

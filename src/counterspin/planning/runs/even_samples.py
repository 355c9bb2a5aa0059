"""What evenly spaced samples tell about functions of the angle, in closed form.

With white noise the information of a record is the matrix of sums, over its samples, of products
of the functions in `counterspin.planning.runs.angle_functions`. About the middle of the record each
function is a power of x in [-1, 1] times a cosine or sine of a multiple of the angle, the sums are
derivatives of the Dirichlet kernel sin(n a/2)/(n sin(a/2)), and even and odd functions do not mix.
In this basis the sums can be factored without loss of digits, which the raw t^2 and cos wt cannot
(functions of a whole revolution or more are never near to collinear).

The number of samples need not be whole: between whole numbers the sums follow the smooth curve
through them.
"""

from __future__ import annotations

from functools import cache
from typing import Final

import numpy as np
import numpy.typing as npt

from counterspin.arrays import Array, triangle_of
from counterspin.frozen import frozen
from counterspin.planning.runs.angle_functions import shifted

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
    def half(self) -> Array:
        """Half the angle that the rows stand for, rad, shape (n,); x is an angle over this."""
        return np.asarray(0.5 * self.step * self.count)


def root(samples: EvenSamples, weights: Array, held: int) -> Array:
    """Return square-root information, each row with unit variance.

    weights: Combinations of the functions, shape (n, b, k).
    held: How many of the columns 1 and th are start errors, estimated in each run: 0, 1 or 2.
    Returns: shape (n, b - held, k).
    """
    harmonics = weights.shape[1] // 4 - 1
    even, odd = _centred(averaged(weights, samples.spread), samples)
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
            lower = _factor(_sums(moments, harmonics, parity))
            upper = np.swapaxes(lower, 1, 2)[:, drop:]
            result[close, rows] = size * (upper @ columns[close])
    for run in np.flatnonzero(wide):
        result[run] = _summed(samples, run, even[run], odd[run], harmonics)[held:]
    return result


def averaged(weights: Array, spread: Array) -> Array:
    """Return the combinations averaged over the angles th - spread and th + spread."""
    blocks = spread > 0.0
    if not blocks.any():
        return weights
    result = weights.copy()
    later, earlier = (shifted(weights[blocks], by * spread[blocks]) for by in (1.0, -1.0))
    result[blocks] = 0.5 * (later + earlier)
    return result


def _centred(weights: Array, samples: EvenSamples) -> tuple[Array, Array]:
    """Return the combinations in terms of x about the middle: even functions, odd functions.

    Even: 1, x^2, cos m t and, for all m, x sin m t; odd: x, x^3, sin m t, x cos m t.
    """
    about = shifted(weights, samples.middle)
    half = samples.half[:, None, None]
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
    """Return, for each pair of functions of one parity, what their product is.

    The power of x, the difference and the sum of the harmonics, and the factors of their moments.
    """
    zero = [(parity, 0, 0), (parity + 2, 0, 0)]
    m = range(1, harmonics + 1)
    functions = [*zero, *((0, parity, i) for i in m), *((1, 1 - parity, i) for i in m)]
    size = len(functions)
    power, apart, together = (np.zeros((size, size), dtype=np.intp) for _ in range(3))
    by_difference, by_sum = np.zeros((size, size)), np.zeros((size, size))
    for i, (a, sine, m_a) in enumerate(functions):
        for j, (b, other_sine, m_b) in enumerate(functions):
            power[i, j], apart[i, j], together[i, j] = a + b, abs(m_a - m_b), m_a + m_b
            if sine == other_sine:
                by_difference[i, j], by_sum[i, j] = 0.5, (-0.5 if sine else 0.5)
            else:  # sin m cos l = (sin (m + l) + sin (m - l))/2, m the sine's
                towards = m_a - m_b if sine else m_b - m_a
                by_difference[i, j], by_sum[i, j] = 0.5 * np.sign(towards), 0.5
    return power, apart, together, by_difference, by_sum


def _sums(moments: Array, harmonics: int, parity: int) -> Array:
    """Return the mean products of the even (parity 0) or odd (1) functions, shape (n, c, c)."""
    power, apart, together, by_difference, by_sum = _pairs(harmonics, parity)
    result = by_difference * moments[:, power, apart]
    result += by_sum * moments[:, power, together]
    return np.asarray(result)


def _factor(sums: Array) -> Array:
    """Return lower triangular factors, shape (n, c, c)."""
    places = np.arange(sums.shape[1])
    sums[:, places, places] *= 1.0 + _RIDGE
    return np.asarray(np.linalg.cholesky(sums))


def _summed(samples: EvenSamples, run: np.intp, even: Array, odd: Array, harmonics: int) -> Array:
    """Return one run's rows from its samples themselves, the start errors' first."""
    count = float(samples.count[run])
    whole = int(np.ceil(count - 1e-9))
    t = samples.step[run] * (np.arange(whole) - 0.5 * (count - 1.0))
    x = t / samples.half[run]
    m = np.arange(1, harmonics + 1)
    cos, sin = np.cos(t[:, None] * m), np.sin(t[:, None] * m)
    # Start errors first: what the triangle has below their rows is free of them.
    first = np.column_stack([np.ones(whole), x])
    rest = np.column_stack([x**2, cos, x[:, None] * sin, x**3, sin, x[:, None] * cos])
    rows = np.hstack([first, rest])
    rows[-1] *= np.sqrt(count - (whole - 1))  # of the last row only its part counts
    rows = np.vstack([rows, np.zeros((max(0, rows.shape[1] - whole), rows.shape[1]))])
    return np.asarray(triangle_of(rows) @ np.vstack([even[0], odd[0], even[1:], odd[1:]]))

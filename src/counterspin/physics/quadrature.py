"""Single and double time integrals along a trajectory, to rounding, at any times.

Between two panel edges the integrand is the Legendre series through its Gauss nodes, and the
series is integrated once or twice term by term. The result is therefore as accurate between the
edges as at them, and costs nothing more for a million sample times than for three.

- `panel_edges`: where panels begin and end
- `sign_changes`: kinks that must be edges too
- `integrate`: the integrals
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

import numpy as np
import numpy.typing as npt
from numpy.polynomial import legendre

from counterspin.physics.accelerometer import Array
from counterspin.physics.spindle import Spindle

NODES: Final = 16  #: Gauss-Legendre nodes in a panel
_CHUNK: Final = 65536  #: sample times evaluated at once, which bounds the memory

# The highest harmonic of the smooth products is the third (a_I^3); ripple adds its own.
# Sixteen nodes reach 1e-12 while a panel spans at most 3/4 of a period of the highest harmonic.
_PRODUCT_HARMONIC: Final = 3
_PANELS_PER_PERIOD: Final = 4.0 / 3.0


def _series_of_integral(times_integrated: int) -> Array:
    """Matrix from node values to the Legendre series of the integral, (NODES + times, NODES)."""
    nodes, weights = legendre.leggauss(NODES)
    order = np.arange(NODES)
    series = (order[:, None] + 0.5) * legendre.legvander(nodes, NODES - 1).T * weights
    integral = legendre.legint(series, m=times_integrated, lbnd=-1.0, axis=0)
    return np.asarray(integral, dtype=np.float64)


_X: Final[Array] = legendre.leggauss(NODES)[0]
_ONCE: Final[Array] = _series_of_integral(1)
_TWICE: Final[Array] = _series_of_integral(2)


def panel_edges(spindle: Spindle, duration: float, breaks: Array | None = None) -> Array:
    """Return panel edges from 0 to `duration` (s), increasing, shape (m + 1,).

    Parameters
    ----------
    spindle
        Gives the revolutions, and the highest ripple harmonic, which asks for more panels.
    duration
        End of the integration, s; positive.
    breaks
        Further edges, s, such as the times of kinks.
    """
    revolutions = duration * abs(spindle.rate) * (1 + max(0.0, spindle.drift * duration))
    revolutions /= 2.0 * math.pi
    per_revolution = _PANELS_PER_PERIOD * (_PRODUCT_HARMONIC + spindle.highest_harmonic)
    edges = np.linspace(0.0, duration, max(2, math.ceil(revolutions * per_revolution) + 1))
    if breaks is None or breaks.size == 0:
        return edges
    edges = np.union1d(edges, breaks[(breaks > 0.0) & (breaks < duration)])
    # A panel of rounding width adds nothing and would divide by zero.
    keep = np.append(np.diff(edges) > 1e-13 * duration, True)
    kept: Array = edges[keep]
    return kept


def sign_changes(function: Callable[[Array], Array], edges: Array) -> Array:
    """Return the times at which a function changes sign, by false position to rounding.

    Parameters
    ----------
    function
        Maps times (n,) to values (n,).
    edges
        Panel edges; each panel is searched in 8 steps, so that two changes closer than an
        eighth of a panel are missed together.

    References
    ----------
    Dowell and Jarratt, A modified regula falsi method for computing the root of an equation, BIT
    11 (1971) 168: the Illinois rule.
    """
    steps = np.linspace(0.0, 1.0, 8, endpoint=False)
    grid = np.append((edges[:-1, None] + np.diff(edges)[:, None] * steps).ravel(), edges[-1])
    values = function(grid)
    at = np.flatnonzero((values[1:] > 0.0) != (values[:-1] > 0.0))
    left, right, f_left, f_right = grid[at], grid[at + 1], values[at], values[at + 1]
    # A step this short is rounding; the limit of rounds is what halving would take.
    short = 2.0 * np.finfo(float).eps * edges[-1]
    for _ in range(52):
        slope = f_right - f_left
        step = np.divide(
            f_right * (right - left), slope, out=np.zeros_like(right), where=slope != 0
        )
        new = right - step
        f_new = function(new)
        kept = (f_new > 0.0) == (f_right > 0.0)
        # Where the left end stays, half its value moves the next step beyond the root.
        left, f_left = np.where(kept, left, right), np.where(kept, 0.5 * f_left, f_right)
        right, f_right = new, f_new
        if np.all(np.abs(step) <= short):
            break
    return right


def integrate(integrand: Callable[[Array], Array], edges: Array, times: Array, order: int) -> Array:
    """Integrate several functions once or twice from the first edge.

    Parameters
    ----------
    integrand
        Maps times (n,) in s to values (k, n).
    edges
        Panel edges, s, increasing; the integrand is smooth inside each panel.
    times
        Where the integrals are wanted, s, shape (n,), between the first and the last edge.
    order
        1 for the integral, 2 for the double integral (zero value and slope at the first edge).

    Returns
    -------
    Array
        Shape (n, k), the integrand's unit times s or s^2.

    Raises
    ------
    ValueError
        If a time lies outside the edges.
    """
    tolerance = 1e-12 * (edges[-1] - edges[0])
    if times.size and (times.min() < edges[0] - tolerance or times.max() > edges[-1] + tolerance):
        raise ValueError("times lie outside the panels")
    half = 0.5 * np.diff(edges)
    nodes = edges[:-1, None] + half[:, None] * (1.0 + _X)
    values = integrand(nodes.ravel()).reshape(-1, half.size, NODES)
    once = _series(values, _ONCE) * half[:, None, None]
    # A Legendre series at x = 1 is the sum of its coefficients.
    first = _running_sum(once.sum(axis=1))
    if order == 1:
        series = once
        series[:, 0] += first[:-1]
    else:
        series = _series(values, _TWICE) * half[:, None, None] ** 2
        # The slope at the panel's start goes on through it, as slope x half x (1 + x).
        gained = half[:, None] * first[:-1]
        start = _running_sum(series.sum(axis=1) + 2.0 * gained)
        series[:, 0] += start[:-1] + gained
        series[:, 1] += gained
    result = np.empty((times.size, values.shape[0]))
    for begin in range(0, times.size, _CHUNK):
        t = times[begin : begin + _CHUNK]
        panel = np.clip(np.searchsorted(edges, t, side="right") - 1, 0, half.size - 1)
        x = (t - edges[panel]) / half[panel] - 1.0
        result[begin : begin + _CHUNK] = _at(x, panel, series)
    return result


def _series(values: Array, matrix: Array) -> Array:
    """Return the Legendre series of integrals from node values (k, m, NODES), shape (m, c, k)."""
    return np.ascontiguousarray((values @ matrix.T).transpose(1, 2, 0))


def _at(x: Array, panel: npt.NDArray[np.intp], series: Array) -> Array:
    """Return the series (m, c, k) of the panels (n,) at the places x (n,) in them, shape (n, k).

    Places in the same panel stand in a row, so that a matrix product serves them all. Rows are a
    little longer than the usual number of places in a panel; where there are more, there are
    more rows. However the places are spread, all rows together are at most 6 n long.
    """
    order = np.argsort(panel, kind="stable")
    occupied, counts = np.unique(panel[order], return_counts=True)
    width = x.size // occupied.size + 2
    rows = -(-counts // width)
    places = np.arange(x.size) - np.repeat(np.cumsum(counts) - counts, counts)
    slots = np.empty(x.size, dtype=np.intp)
    slots[order] = places + np.repeat(width * (np.cumsum(rows) - rows), counts)
    filled = np.zeros(width * rows.sum())
    filled[slots] = x
    powers = legendre.legvander(filled.reshape(-1, width), series.shape[1] - 1)
    found: Array = (powers @ series[np.repeat(occupied, rows)]).reshape(-1, series.shape[2])
    return found[slots]


def _running_sum(increments: Array) -> Array:
    """Return the sums before each panel and after the last, shape (m + 1, k)."""
    return np.concatenate([np.zeros((1, increments.shape[1])), np.cumsum(increments, axis=0)])

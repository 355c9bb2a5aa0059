"""Single and double time integrals along a trajectory, to rounding, at any times.

Within a panel, the integrand is replaced by the polynomial through its values at the Gauss nodes,
which is integrated once or twice. The result is as accurate between the edges as at the edges, and
the number of evaluations of the integrand does not depend on the number of times.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.polynomial import chebyshev, legendre

from counterspin.arrays import Array
from counterspin.physics.spindle import Spindle

NODES: Final = 16  #: Gauss-Legendre nodes in a panel
_CHUNK_TIMES: Final = 65536  #: sample times evaluated at once, which bounds the memory
#: Times may precede the first panel by this fraction of it, as corrected time stamps do. Its
#: polynomials are accurate there to 1e-9 of a third harmonic.
_MAX_EXTRAPOLATION: Final = 0.1
_CACHE_SIZE: Final = 16384  #: largest number of times, or panel edges, whose positions are cached

# The highest harmonic of the smooth products is the third (a_I^3); ripple adds its own.
# Sixteen nodes reach 1e-12 while a panel spans at most 3/4 of a period of the highest harmonic.
# With panels twice as long, integrals over a whole panel are still exact to rounding, but between
# the edges only to 1e-6, and to 1e-4 of a fourth harmonic.
_MAX_PRODUCT_HARMONIC: Final = 3
_PANELS_PER_PERIOD: Final = 4.0 / 3.0
_COARSE_PANELS_PER_PERIOD: Final = 2.0 / 3.0


def _integral_series(times_integrated: int) -> Array:
    """Matrix from node values to the Chebyshev series of the integral, (NODES + 2, NODES)."""
    series = np.linalg.inv(chebyshev.chebvander(_GAUSS_NODES, NODES - 1))
    integral = chebyshev.chebint(series, m=times_integrated, lbnd=-1.0, axis=0)
    padded_integral = np.zeros((NODES + 2, NODES))
    padded_integral[: len(integral)] = integral
    return padded_integral


_GAUSS_NODES, _WEIGHTS = legendre.leggauss(NODES)
_SINGLE_INTEGRAL: Final[Array] = _integral_series(1)
_DOUBLE_INTEGRAL: Final[Array] = _integral_series(2)
#: Weights of the double integral over a whole panel, the integral of (1 - x) f.
_DOUBLE_WEIGHTS: Final[Array] = _WEIGHTS * (1.0 - _GAUSS_NODES)


def panel_edges(
    spindle: Spindle, duration: float, breaks: Array | None = None, *, coarse: bool = False
) -> Array:
    """Return panel edges from 0 to `duration` (s), increasing, shape (m + 1,).

    duration: End of the integration, s; positive.
    breaks: Further edges, s, such as the times of kinks.
    coarse: Half as many panels; between the edges, integrals are then accurate to 1e-4.
    """
    revolutions = duration * abs(spindle.rate) * (1 + max(0.0, spindle.drift * duration))
    revolutions /= 2.0 * math.pi
    density = _COARSE_PANELS_PER_PERIOD if coarse else _PANELS_PER_PERIOD
    panels_per_revolution = density * (_MAX_PRODUCT_HARMONIC + spindle.highest_harmonic)
    edges = np.linspace(0.0, duration, max(2, math.ceil(revolutions * panels_per_revolution) + 1))
    if breaks is None or breaks.size == 0:
        return edges
    edges = np.sort(np.append(edges, breaks[(breaks > 0.0) & (breaks < duration)]))
    # A panel of rounding width adds nothing and would divide by zero.
    is_separate = np.append(np.diff(edges) > 1e-13 * duration, True)
    separate_edges: Array = edges[is_separate]
    return separate_edges


def sign_changes(function: Callable[[Array], Array], edges: Array) -> Array:
    """Return the times at which a function changes sign, by false position to rounding.

    edges: Panel edges; each panel is searched in 8 steps, so two changes within one step are
        missed.
    References: Dowell and Jarratt, A modified regula falsi method for computing the root of an
        equation, BIT 11 (1971) 168: the Illinois rule.
    """
    steps = np.linspace(0.0, 1.0, 8, endpoint=False)
    grid = np.append((edges[:-1, None] + np.diff(edges)[:, None] * steps).ravel(), edges[-1])
    values = function(grid)
    indices = np.flatnonzero((values[1:] > 0.0) != (values[:-1] > 0.0))
    left, right = grid[indices], grid[indices + 1]
    f_left, f_right = values[indices], values[indices + 1]
    # Shorter steps are rounding; 52 iterations would suffice for bisection.
    rounding = 2.0 * np.finfo(float).eps * edges[-1]
    for _ in range(52):
        rise, zeros = f_right - f_left, np.zeros_like(right)
        step = np.divide(f_right * (right - left), rise, out=zeros, where=rise != 0)
        next_time = right - step
        next_value = function(next_time)
        has_sign_of_right = (next_value > 0.0) == (f_right > 0.0)
        # If the left end stays, halving its value moves the next step beyond the root.
        left, f_left = (
            np.where(has_sign_of_right, left, right),
            np.where(has_sign_of_right, 0.5 * f_left, f_right),
        )
        right, f_right = next_time, next_value
        if np.all(np.abs(step) <= rounding):
            break
    return right


def integrate(integrand: Callable[[Array], Array], edges: Array, times: Array, order: int) -> Array:
    """Integrate several functions once or twice from the first edge.

    integrand: Maps times (n,) in s to values (k, n).
    edges: Panel edges, s, increasing; the integrand is smooth inside each panel.
    times: Times of the integrals, s, shape (n,), between the first and the last edge.
    order: 1 for the integral, 2 for the double integral (zero value and slope at the first edge).
    Returns: shape (n, k), the integrand's unit times s or s^2.
    """
    panels = Panels(edges)
    return panels.at(times, panels.series(integrand(panels.nodes), order)).T


class Panels:
    """Panels of time with their Gauss nodes, for integrands known at the nodes.

    edges: s, increasing; the integrands are smooth inside each panel.
    """

    def __init__(self, edges: Array) -> None:
        self._edges = edges
        self._half = 0.5 * np.diff(edges)
        self.nodes: Array = (edges[:-1, None] + self._half[:, None] * (1.0 + _GAUSS_NODES)).ravel()

    def series(self, values: Array, order: int) -> Array:
        """Return Chebyshev series of the integrals of functions, (k, panels, NODES + 2).

        values: At the nodes, shape (k, m).
        order: 1 for the integral from the first edge, 2 for the double integral.
        """
        half_widths, f = self._half, values.reshape(len(values), self._half.size, NODES)
        series = np.empty((len(f), half_widths.size, NODES + 2))
        if order == 1:
            np.matmul(f * half_widths[:, None], _SINGLE_INTEGRAL.T, out=series)
            series[..., 0] += _cumulative_sum((f @ _WEIGHTS) * half_widths)
            return series
        # The slope at the start of the panel contributes slope x half x (1 + x).
        increments = _cumulative_sum((f @ _WEIGHTS) * half_widths) * half_widths
        np.matmul(f * half_widths[:, None] ** 2, _DOUBLE_INTEGRAL.T, out=series)
        start = _cumulative_sum((f @ _DOUBLE_WEIGHTS) * half_widths**2 + 2.0 * increments)
        series[..., 0] += start + increments
        series[..., 1] += increments
        return series

    def at(self, times: Array, series: Array) -> Array:
        """Return the values of series of these panels at times between the edges, (k, n).

        Times may lie before the first edge by a tenth of the widest panel. A kink can make the
        first panel much shorter, so that its polynomials hold for less than that. The integral
        over the rest is neglected: a few milliseconds of a product whose sign just changes.
        """
        edges = self._edges
        min_time = edges[0] - _MAX_EXTRAPOLATION * 2.0 * self._half.max()
        max_time = edges[-1] + 1e-12 * (edges[-1] - edges[0])
        if times.size and (times.min() < min_time or times.max() > max_time):
            raise ValueError("times lie outside the panels")
        times = np.maximum(times, edges[0] - _MAX_EXTRAPOLATION * (edges[1] - edges[0]))
        chunks = []
        for chunk_start in range(0, times.size if len(series) else 0, _CHUNK_TIMES):
            t = times[chunk_start : chunk_start + _CHUNK_TIMES]
            # Accelerometers of a run and trajectories of one spindle share their times.
            is_cacheable = max(t.size, edges.size) <= _CACHE_SIZE
            positions = (
                _cached_positions(edges.tobytes(), t.tobytes())
                if is_cacheable
                else _PanelPositions(edges, t)
            )
            chunks.append(positions.evaluate(series))
        if not chunks:
            return np.empty((len(series), times.size))
        return chunks[0] if len(chunks) == 1 else np.concatenate(chunks, axis=1)


class _PanelPositions:
    """Positions of times in panels, with the polynomials at these times.

    Times in the same panel share a row, so that one matrix product evaluates them all. Rows are a
    little longer than the mean number of times per panel, and a panel with more times has several
    rows. All rows together have at most 6 n slots for any distribution of the times.
    """

    def __init__(self, edges: Array, times: Array) -> None:
        half_width = 0.5 * np.diff(edges)
        panels = np.clip(np.searchsorted(edges, times, side="right") - 1, 0, half_width.size - 1)
        order = np.argsort(panels, kind="stable")
        counts = np.bincount(panels)
        occupied_panels = np.flatnonzero(counts)
        counts = counts[occupied_panels]
        width = times.size // occupied_panels.size + 2
        n_rows = -(-counts // width)
        slots = np.arange(times.size) - np.repeat(np.cumsum(counts) - counts, counts)
        self._slots = np.empty(times.size, dtype=np.intp)
        self._slots[order] = slots + np.repeat(width * (np.cumsum(n_rows) - n_rows), counts)
        slot_positions = np.zeros(width * n_rows.sum())
        slot_positions[self._slots] = (times - edges[panels]) / half_width[panels] - 1.0
        values = chebyshev.chebvander(slot_positions.reshape(-1, width), NODES + 1)
        self._powers = np.moveaxis(values, 2, 1)
        # The panel of each row; None if each panel has exactly one row.
        has_one_row_per_panel = occupied_panels.size == half_width.size and n_rows.max() == 1
        self._panels = None if has_one_row_per_panel else np.repeat(occupied_panels, n_rows)

    def evaluate(self, series: Array) -> Array:
        """Return the values of series (k, panels, NODES + 2) at the times, shape (k, n)."""
        row_series = series.transpose(1, 0, 2)
        if self._panels is not None:
            row_series = row_series[self._panels]
        n_rows, _, width = self._powers.shape
        # Write into the final layout: allocating another array takes longer than filling it.
        slot_values = np.empty((len(series), n_rows, width))
        np.matmul(row_series, self._powers, out=slot_values.transpose(1, 0, 2))
        return slot_values.reshape(len(series), -1).take(self._slots, axis=1)


@lru_cache(maxsize=6)
def _cached_positions(edges: bytes, times: bytes) -> _PanelPositions:
    return _PanelPositions(np.frombuffer(edges), np.frombuffer(times))


def _cumulative_sum(increments: Array) -> Array:
    """Return the sums before each panel, (k, m), of the increments over the panels, (k, m)."""
    sums = np.zeros_like(increments)
    np.cumsum(increments[:, :-1], axis=1, out=sums[:, 1:])
    return sums

"""Single and double time integrals along a trajectory, to rounding, at any times.

Between two panel edges the integrand is the polynomial through its values at Gauss nodes, and the
polynomial is integrated once or twice. The result is therefore as accurate between the edges as at
them, and the integrand is evaluated no more often for a million sample times than for three.
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
#: Part of a panel by which times may lie before it: corrected time stamps do. Its polynomials are
#: as good there, to 1e-9 of a third harmonic.
_MAX_EXTRAPOLATION: Final = 0.1
_CACHE_SIZE: Final = 16384  #: sample times, or panel edges, up to which places in panels are kept

# The highest harmonic of the smooth products is the third (a_I^3); ripple adds its own.
# Sixteen nodes reach 1e-12 while a panel spans at most 3/4 of a period of the highest harmonic.
# Over twice that they still integrate a whole panel to rounding, but what lies between the edges
# to 1e-6 only, and to 1e-4 of a fourth harmonic.
_MAX_PRODUCT_HARMONIC: Final = 3
_PANELS_PER_PERIOD: Final = 4.0 / 3.0
_COARSE_PANELS_PER_PERIOD: Final = 2.0 / 3.0


def _integral_series(times_integrated: int) -> Array:
    """Matrix from node values to the Chebyshev series of the integral, (NODES + 2, NODES)."""
    series = np.linalg.inv(chebyshev.chebvander(_NODE_POSITIONS, NODES - 1))
    integral = chebyshev.chebint(series, m=times_integrated, lbnd=-1.0, axis=0)
    padded_integral = np.zeros((NODES + 2, NODES))
    padded_integral[: len(integral)] = integral
    return padded_integral


_NODE_POSITIONS, _WEIGHTS = legendre.leggauss(NODES)
_SINGLE_INTEGRAL: Final[Array] = _integral_series(1)
_DOUBLE_INTEGRAL: Final[Array] = _integral_series(2)
#: From node values to the double integral over a whole panel, which is that of (1 - x) f.
_DOUBLE_WEIGHTS: Final[Array] = _WEIGHTS * (1.0 - _NODE_POSITIONS)


def panel_edges(
    spindle: Spindle, duration: float, breaks: Array | None = None, *, coarse: bool = False
) -> Array:
    """Return panel edges from 0 to `duration` (s), increasing, shape (m + 1,).

    duration: End of the integration, s; positive.
    breaks: Further edges, s, such as the times of kinks.
    coarse: Half as many, for shapes: what lies between the edges is then accurate to 1e-4.
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

    edges: Panel edges; each panel is searched in 8 steps, so that two changes closer than an
        eighth of a panel are missed together.
    References: Dowell and Jarratt, A modified regula falsi method for computing the root of an
        equation, BIT 11 (1971) 168: the Illinois rule.
    """
    steps = np.linspace(0.0, 1.0, 8, endpoint=False)
    grid = np.append((edges[:-1, None] + np.diff(edges)[:, None] * steps).ravel(), edges[-1])
    values = function(grid)
    indices = np.flatnonzero((values[1:] > 0.0) != (values[:-1] > 0.0))
    left, right, f_left, f_right = (
        grid[indices],
        grid[indices + 1],
        values[indices],
        values[indices + 1],
    )
    # A step this short is rounding; the limit of rounds is what halving would take.
    rounding = 2.0 * np.finfo(float).eps * edges[-1]
    for _ in range(52):
        slope = f_right - f_left
        step = np.divide(
            f_right * (right - left), slope, out=np.zeros_like(right), where=slope != 0
        )
        next_time = right - step
        next_value = function(next_time)
        has_sign_of_right = (next_value > 0.0) == (f_right > 0.0)
        # Where the left end stays, half its value moves the next step beyond the root.
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
    times: Where the integrals are wanted, s, shape (n,), between the first and the last edge.
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
        self.nodes: Array = (
            edges[:-1, None] + self._half[:, None] * (1.0 + _NODE_POSITIONS)
        ).ravel()

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
        # The slope at the panel's start goes on through it, as slope x half x (1 + x).
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
            # Accelerometers of a run, and paths of one spindle, are asked at the same times.
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

    Places in the same panel stand in a row, so that a matrix product serves them all. Rows are a
    little longer than the usual number of places in a panel; where there are more, there are
    more rows. However the places are spread, all rows together are at most 6 n long.
    """

    def __init__(self, edges: Array, times: Array) -> None:
        half_width = 0.5 * np.diff(edges)
        panel_indices = np.clip(
            np.searchsorted(edges, times, side="right") - 1, 0, half_width.size - 1
        )
        order = np.argsort(panel_indices, kind="stable")
        counts = np.bincount(panel_indices)
        occupied_panels = np.flatnonzero(counts)
        counts = counts[occupied_panels]
        width = times.size // occupied_panels.size + 2
        n_rows = -(-counts // width)
        slots = np.arange(times.size) - np.repeat(np.cumsum(counts) - counts, counts)
        self._slots = np.empty(times.size, dtype=np.intp)
        self._slots[order] = slots + np.repeat(width * (np.cumsum(n_rows) - n_rows), counts)
        slot_positions = np.zeros(width * n_rows.sum())
        slot_positions[self._slots] = (times - edges[panel_indices]) / half_width[
            panel_indices
        ] - 1.0
        values = chebyshev.chebvander(slot_positions.reshape(-1, width), NODES + 1)
        self._powers = np.moveaxis(values, 2, 1)
        # The panel of each row, where that is not simply the next one.
        has_one_row_per_panel = occupied_panels.size == half_width.size and n_rows.max() == 1
        self._panels = None if has_one_row_per_panel else np.repeat(occupied_panels, n_rows)

    def evaluate(self, series: Array) -> Array:
        """Return the values of series (k, panels, NODES + 2) at the times, shape (k, n)."""
        row_series = series.transpose(1, 0, 2)
        if self._panels is not None:
            row_series = row_series[self._panels]
        n_rows, _, width = self._powers.shape
        # Written where they are taken from: memory that a process has not had yet takes longer to
        # get than it takes to fill.
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

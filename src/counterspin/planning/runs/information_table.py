"""What a run tells about functions of the angle where there is no closed form: interpolated.

There is none where the noise has a random walk, or is another from row to row, as that of time
stamps is. The triangular factor of the whitened functions is tabulated over the rate and the number
of revolutions, with rows about as dense as the records' own.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cached_property
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from counterspin.arrays import Array
from counterspin.campaign.runs import MOST_ROWS
from counterspin.errors import CounterspinError
from counterspin.inference.noise.model import Noise, make_whitener
from counterspin.planning.runs.angle_functions import functions, prefix_factors, shifted
from counterspin.records.reduction import BLOCKS_PER_REVOLUTION

#: Parts of a revolution at which factors are tabulated; rows to a revolution are a multiple.
_PHASES: Final = 16

#: Ratio of neighbouring nodes in the number of revolutions, and in the rate.
_REVOLUTION_RATIO: Final = 1.13
_RATE_RATIO: Final = 1.22


#: Variance that a sample has besides, at a rate (rad/s) and angles (rad, shape (n,)): shape (n,).
Added = Callable[[float, Array], Array]


class InformationTable:
    """Factors of the whitened functions of the angle.

    order: How often the observable integrates the specific force.
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
        if revolutions[1] > (most := MOST_ROWS / BLOCKS_PER_REVOLUTION):
            raise CounterspinError(
                f"limits: a run may have {revolutions[1]:.3g} revolutions; with a random walk "
                f"or noise of the time stamps, the search is limited to runs of at most "
                f"{most:.3g}: "
                "state a shorter longest_run or total_time, or a lower highest_rate"
            )
        self._counts = _whole_numbers(revolutions)
        self._nodes = _log_nodes(*rates)

    @cached_property
    def _smooth(self) -> Any:
        """The spline through whole numbers of revolutions."""
        return self._spline(1)

    @cached_property
    def _by_phase(self) -> Any:
        """A spline for each part of a revolution at the end."""
        return self._spline(_PHASES)

    def _spline(self, phases: int) -> Any:
        """Return a spline over log rate and log revolutions of factors, (phases, b, b)."""
        from scipy.interpolate import NdBSpline, make_interp_spline

        counts, order, lost = self._counts, self._order, self._lost
        to_whole = _to_whole_numbers(counts, phases)
        densest = 1 if phases == 1 and self._added is None else 4
        tables = []
        for rate in np.exp(self._nodes):
            samples = 2.0 * math.pi * self._sampling_rate / rate  # to a revolution
            points = _PHASES * int(np.clip(round(samples / _PHASES), 1, densest))
            angle = (np.arange(points * (counts[-1] + 1)) + 0.5) * (2.0 * math.pi / points)
            each = points / samples  # of a row, of the variance of a sample
            white = math.sqrt(self._noise.sample_variance * each)
            added = 0.0 if self._added is None else each * self._added(float(rate), angle)
            noise = Noise(white, self._noise.random_walk)
            whiten = make_whitener(angle / rate, order, noise, added=added)
            rows = whiten.apply(functions(angle, self._harmonics)[:, lost:])
            parts = np.arange(phases) * (points // phases)
            ends = (counts[:, None] * points + parts).ravel() - lost
            factors = prefix_factors(rows, ends, order - lost).reshape(len(counts), phases, -1)
            tables.append(to_whole @ factors.swapaxes(0, 1))
        # Interpolation is linear in the values: the splines' coefficients are matrix products.
        by_rate = make_interp_spline(self._nodes, np.eye(len(self._nodes)))
        by_count = make_interp_spline(np.log(counts), np.eye(len(counts)))
        values = np.tensordot(by_rate.c, np.array(tables), axes=1)  # (rates, phases, counts, b b)
        size = 4 + 4 * self._harmonics - order
        shape = (len(self._nodes), len(counts), phases, size, size)
        coefficients = (by_count.c @ values).swapaxes(1, 2).reshape(shape)
        return NdBSpline((by_rate.t, by_count.t), coefficients, 3)

    def root(self, weights: Array, rate: Array, samples: Array, *, with_ripple: bool) -> Array:
        """Return square-root information of runs, each row with unit variance.

        weights: Combinations of the functions, shape (n, b, k).
        rate, samples: rad/s, and number of samples, shape (n,).
        with_ripple: Whether the information follows the part of a revolution at the end, which
            takes longer; False: smoothly from whole number to whole number of revolutions.
        Returns: shape (n, b - order, k).
        """
        turn = rate / self._sampling_rate
        revolutions = samples * turn / (2.0 * math.pi)
        # The samples stand for an angle that begins half a step before the first.
        moved = shifted(weights, -0.5 * turn)[:, self._order :]
        place = np.column_stack([np.log(rate), np.log(revolutions)])
        # What samples near an extremum of the output tell, where time stamps do no harm, depends on
        # where they happen to be: more than the ripple does.
        if not with_ripple or self._added is not None:
            return np.asarray(self._smooth(place)[:, 0] @ moved)
        kernel = _trigonometric(revolutions)[:, :, None, None]
        return np.asarray(np.sum(kernel * self._by_phase(place), axis=1) @ moved)


def _to_whole_numbers(counts: npt.NDArray[np.int64], phases: int) -> Array:
    """Return matrices that carry factors tabulated at a phase to whole revolutions.

    At one phase of the end a factor is a smooth function of the number of revolutions.

    Returns: for each part a matrix over the numbers, shape (phases, c, c).
    """
    from scipy.interpolate import make_interp_spline

    alone = np.eye(len(counts))
    parts = (make_interp_spline(np.log(counts + j / phases), alone) for j in range(phases))
    return np.array([part(np.log(counts)) for part in parts])


def _trigonometric(revolutions: Array) -> Array:
    """Return the weights of equally spaced phases in trigonometric interpolation, (n, phases)."""
    apart = revolutions[:, None] % 1.0 - np.arange(_PHASES) / _PHASES
    half = math.pi * np.where(np.abs(apart) < 1e-12, 1.0, apart)
    weights = np.sin(_PHASES * half) / (_PHASES * np.tan(half))
    return np.asarray(np.where(np.abs(apart) < 1e-12, 1.0, weights))


def _whole_numbers(between: tuple[float, float]) -> npt.NDArray[np.int64]:
    """Return whole numbers of revolutions that span a range, nearly in a geometric series."""
    low, high = max(1, math.floor(between[0])), math.ceil(between[1])
    high = max(high, low + 4)
    counts = [low]
    while counts[-1] < high:
        counts.append(max(counts[-1] + 1, round(counts[-1] * _REVOLUTION_RATIO)))
    return np.array(counts, dtype=np.int64)


def _log_nodes(low: float, high: float) -> Array:
    count = max(6, math.ceil(math.log(high / low) / math.log(_RATE_RATIO)) + 1)
    return np.linspace(math.log(low), math.log(high), count)

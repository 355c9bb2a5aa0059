"""Frequency response of an accelerometer and its recorder.

A linear system multiplies each harmonic of the output of the error model by its complex gain H(f);
the mean does not change, H(0) = 1. The same holds for velocity and displacement, except for the
start offset and start velocity, which each fit estimates.

The recorder filters the whole record; the accelerometer filters the specific force that it senses,
but not the Coriolis acceleration that the navigation computer subtracts.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import lru_cache
from typing import Final

import numpy as np
import numpy.typing as npt

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.physics.spindle import Spindle

ComplexArray = npt.NDArray[np.complex128]

#: Harmonics of the rotation for which the response is approximated.
_N_HARMONICS: Final = 8

#: Frequencies per harmonic at which it is approximated.
_POINTS_PER_HARMONIC: Final = 4

#: Largest error of the approximated gain at these frequencies.
_TOLERANCE: Final = 3e-10

#: Error above which the gain is only matched at the harmonics, as for the table of a resonance.
_MAX_ERROR: Final = 1e-7

#: Largest number of time shifts on either side of the delay, and their spacing as a fraction of
#: the period of the highest harmonic.
_MAX_SHIFTS: Final = 6
_SHIFT_SPACING: Final = 0.125


#: Relative step of derivatives with respect to inputs.
_RELATIVE_STEP: Final = 1e-4


@frozen
class ResponseTable:
    """Measured gain and phase, relative to the static gain."""

    frequency: tuple[float, ...]  #: Hz, increasing, positive.
    gain: tuple[float, ...]  #: Gain over the static gain.
    phase: tuple[float, ...]  #: rad, negative for a delay.
    #: Standard uncertainties, fully correlated between frequencies; empty: exact.
    u_gain: tuple[float, ...] = ()
    u_phase: tuple[float, ...] = ()

    def evaluate(self, frequency: Array, gain_error: float, phase_error: float) -> ComplexArray:
        """Return the complex gain at frequencies in Hz, shape (n,).

        Between the rows, gain and phase are cubic; above the last row, the gain is constant and
        the phase is that of a delay.

        gain_error, phase_error: Deviations of gain and phase from the table, in standard
            uncertainties.
        """
        from scipy.interpolate import PchipInterpolator

        table_frequency = np.array(self.frequency)
        gain, phase = np.array(self.gain), np.array(self.phase)
        if self.u_gain:
            gain = gain + gain_error * np.array(self.u_gain)
        if self.u_phase:
            phase = phase + phase_error * np.array(self.u_phase)
        clipped_frequency = np.minimum(frequency, table_frequency[-1])
        points = np.append(0.0, table_frequency)
        gains = PchipInterpolator(points, np.append(1.0, gain))(clipped_frequency)
        phases = PchipInterpolator(points, np.append(0.0, phase))(clipped_frequency) * (
            np.maximum(frequency, table_frequency[-1]) / table_frequency[-1]
        )
        return np.asarray(gains * np.exp(1j * phases), dtype=np.complex128)


@frozen
class TimeShifts:
    """A response as a sum of shifts in time, valid for a rotation at one rate."""

    shifts: tuple[float, ...]  #: s, positive for a later time.
    weights: tuple[float, ...]  #: Sum 1.

    def apply(self, spindle: Spindle, function: Callable[[Spindle], Array]) -> Array:
        """Return a function of the rotation, filtered by the response.

        The spindle is shifted, not the time, because all integrals begin at the start of the run.

        function: Maps a rotation to values of any shape.
        """
        return np.asarray(
            sum(
                weight * function(spindle.later(shift))
                for shift, weight in zip(self.shifts, self.weights, strict=True)
            )
        )


@frozen
class FrequencyResponse:
    """Frequency response of the channel of one accelerometer.

    The accelerometer has a second-order response,
    H(f) = 1/(1 - (f/f0)^2 + 2 i zeta f/f0), or a measured one; the recorder has a first-order low
    pass, 1/(1 + i f/fc).
    """

    natural_frequency: float = math.inf  #: f0, Hz; infinite: an accelerometer without dynamics.
    damping: float = 0.0  #: Damping ratio zeta.
    table: ResponseTable | None = None  #: Measured response, in place of f0 and zeta.
    gain_error: float = 0.0  #: Deviation from the table, in its standard uncertainties.
    phase_error: float = 0.0
    cutoff_frequency: float = math.inf  #: fc of the recorder's low pass (-3 dB), Hz.

    def accelerometer_gain(self, frequency: Array) -> ComplexArray:
        """Return the complex gain of the accelerometer at frequencies in Hz, shape (n,)."""
        if self.table is not None:
            return self.table.evaluate(frequency, self.gain_error, self.phase_error)
        ratio = frequency / self.natural_frequency
        return np.asarray(1.0 / (1.0 - ratio**2 + 2.0j * self.damping * ratio), np.complex128)

    def recorder_gain(self, frequency: Array) -> ComplexArray:
        """Return the complex gain of the recorder at frequencies in Hz, shape (n,)."""
        return np.asarray(1.0 / (1.0 + 1.0j * frequency / self.cutoff_frequency), np.complex128)

    def gain(self, frequency: Array) -> ComplexArray:
        """Return the complex gain of accelerometer and recorder at frequencies in Hz, (n,)."""
        return self.accelerometer_gain(frequency) * self.recorder_gain(frequency)

    def deviate(self, symbol: str, change: float) -> FrequencyResponse:
        """Return the response with one of its inputs changed.

        symbol: A key of `RESPONSE_INPUTS`.
        change: In the unit of the input.
        """
        name = RESPONSE_INPUTS[symbol]
        return replace(self, **{name: getattr(self, name) + change})

    def step(self, symbol: str) -> float:
        """Return the step of a derivative with respect to an input."""
        value: float = getattr(self, RESPONSE_INPUTS[symbol])
        return _RELATIVE_STEP * max(abs(value), 1.0)

    def filter_record(
        self,
        spindle: Spindle,
        record_at: Callable[[Spindle], Array],
        sensed_at: Callable[[Spindle], Array],
    ) -> Array:
        """Return the record of a perfect accelerometer with this response.

        The recorder filters the record. The accelerometer filters the specific force only, and not
        the Coriolis acceleration that the computer subtracts.

        record_at: Maps a rotation to the record without dynamics.
        sensed_at: Maps a rotation to the contribution of the specific force to this record.
        """
        recorder, total = self.recorder_shifts(spindle.rate), self.total_shifts(spindle.rate)
        unsensed_record = recorder.apply(spindle, lambda s: record_at(s) - sensed_at(s))
        return unsensed_record + total.apply(spindle, sensed_at)

    def total_shifts(self, rate: float) -> TimeShifts:
        """Return the response of accelerometer and recorder for a rate in rad/s."""
        return _time_shifts(self, abs(rate), is_recorder=False)

    def recorder_shifts(self, rate: float) -> TimeShifts:
        """Return the response of the recorder for a rate in rad/s."""
        return _time_shifts(self, abs(rate), is_recorder=True)


CUTOFF: Final = "records.cutoff_frequency"  #: Hz, of the recorder's low pass

#: Uncertain inputs of a response -> the attribute that each changes.
RESPONSE_INPUTS: Final[Mapping[str, str]] = {
    "sensor.natural_frequency": "natural_frequency",
    "sensor.damping": "damping",
    "sensor.gain": "gain_error",
    "sensor.phase": "phase_error",
    CUTOFF: "cutoff_frequency",
}


@lru_cache(maxsize=256)
def _time_shifts(response: FrequencyResponse, rate: float, *, is_recorder: bool) -> TimeShifts:
    """Approximate a response by time shifts around its delay at the rotation frequency."""
    gain = response.recorder_gain if is_recorder else response.gain
    if is_recorder and math.isinf(response.cutoff_frequency):
        return TimeShifts((0.0,), (1.0,))
    two_pi = 2.0 * math.pi
    delay = -float(np.angle(gain(np.array([rate / two_pi])))[0]) / rate
    spacing = two_pi * _SHIFT_SPACING / (_N_HARMONICS * rate)
    orders = np.arange(1, _N_HARMONICS * _POINTS_PER_HARMONIC + 1) / _POINTS_PER_HARMONIC
    frequencies = rate * orders  # rad/s
    undelayed_response = gain(frequencies / two_pi) * np.exp(1j * frequencies * delay) - 1.0
    targets = np.concatenate([undelayed_response.real, undelayed_response.imag])
    for n_shifts in range(1, _MAX_SHIFTS + 1):
        steps = np.array([*range(-n_shifts, 0), *range(1, n_shifts + 1)])
        shift_responses = np.exp(1j * np.outer(frequencies, steps) * spacing) - 1.0
        design = np.vstack([shift_responses.real, shift_responses.imag])
        weights = np.linalg.lstsq(design, targets, rcond=1e-13)[0]
        error = np.abs(design @ weights - targets).max()
        if error < _TOLERANCE:
            break
    if error > _MAX_ERROR:
        return _interpolate(gain, rate, delay)
    return TimeShifts(
        (-delay, *(spacing * steps - delay).tolist()),
        (1.0 - float(weights.sum()), *weights.tolist()),
    )


def _interpolate(gain: Callable[[Array], ComplexArray], rate: float, delay: float) -> TimeShifts:
    """Return shifts over a revolution with the exact gain at the harmonics of the rotation.

    gain: Maps frequencies in Hz, shape (n,), to the complex gain.
    rate: rad/s.
    delay: Centre of the shifts, s.
    """
    orders = np.arange(-_N_HARMONICS, _N_HARMONICS + 1)
    positive_gains = gain(np.arange(1.0, _N_HARMONICS + 1.0) * (rate / (2.0 * math.pi)))
    gains = np.concatenate([positive_gains[::-1].conj(), [1.0], positive_gains])
    angles = 2.0 * math.pi * orders / orders.size
    phasors = np.exp(1j * np.outer(orders, rate * delay - angles))
    weights = (gains @ phasors).real / orders.size
    return TimeShifts(tuple((angles / rate - delay).tolist()), tuple(weights.tolist()))

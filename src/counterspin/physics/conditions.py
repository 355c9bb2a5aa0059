"""Conditions on which coefficients of an accelerometer depend, as stated and during a run.

Each condition in a description is a field of `StatedConditions` and a row of `STATED_CONDITIONS`.
Its deviation from the reference is an entry of `RunConditions.at` and `RunConditions.at_start`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field
from typing import Any, Final

import numpy as np

from counterspin.arrays import Array
from counterspin.frozen import frozen

#: Condition in a description -> unit in a table of readings.
STATED_CONDITIONS: Final[Mapping[str, str]] = {"temperature": "degC", "time": "s"}


@frozen
class StatedConditions:
    """Stated conditions of a reading or a record; None: not stated."""

    #: K; several values are evenly spaced over a record.
    temperature: tuple[float, ...] | None = field(kw_only=True)
    time: float | None = field(kw_only=True)  #: Start time on any clock, s.


def stated_conditions(source: object) -> dict[str, Any]:
    """Return the stated conditions of a run, a reading or a record of poses, by name."""
    return {name: getattr(source, name) for name in STATED_CONDITIONS}


@frozen
class RunConditions:
    """Conditions of a run: start time, temperature and its direction of change."""

    start: float = 0.0  #: Start time, s from the beginning of the campaign.
    temperature_offset: float = 0.0  #: Mean temperature minus the reference temperature, K.
    #: 1/2 if the temperature rose at the start of the run, -1/2 if it fell, 0 if unknown.
    direction: float = 0.0
    #: Temperatures minus the reference temperature, K, at evenly spaced times, linear in between;
    #: empty if the temperature was constant.
    temperature_profile: tuple[float, ...] = ()
    length: float = 0.0  #: Duration of the profile, s.
    reversal_times: tuple[float, ...] = ()  #: Times of reversal, s from the start of the run.

    @property
    def knots(self) -> Array:
        """Times of the temperature profile, s from the start of the run, shape (k,)."""
        return np.linspace(0.0, self.length, len(self.temperature_profile))

    @property
    def breaks(self) -> Array:
        """Times of kinks and jumps, s from the start of the run, shape (m,)."""
        return np.append(self.knots, self.reversal_times)

    @property
    def changing_conditions(self) -> frozenset[str]:
        """Conditions other than time that change within the run."""
        changes = {"temperature": self.temperature_profile, "direction": self.reversal_times}
        return frozenset(name for name, change in changes.items() if change)

    def at_start(self, force: float) -> dict[str, Array]:
        """Return the value of each condition at the start of the run, at its mean temperature.

        force: Centripetal force at the run's rate, g. Coefficients depend on its square.
        """
        return {
            "time": np.asarray(self.start),
            "temperature": np.asarray(self.temperature_offset),
            "direction": np.asarray(self.direction),
            "force": np.asarray(force) ** 2,
        }

    def at(self, times: Array, force: float) -> dict[str, Array]:
        """Return the values of each condition at times (n,) from the start of the run, s.

        The time condition is taken at the start of the run.

        force: As in `at_start`.
        """
        temperature = self._temperature_offset_at(times)
        return {
            "time": np.full_like(temperature, self.start),
            "temperature": temperature,
            "direction": self._direction_at(times),
            "force": np.full_like(temperature, force) ** 2,
        }

    def _temperature_offset_at(self, times: Array) -> Array:
        if not self.temperature_profile:
            return np.full(times.shape, self.temperature_offset)
        return np.interp(times, self.knots, self.temperature_profile)

    def _direction_at(self, times: Array) -> Array:
        reversals = np.searchsorted(np.sort(self.reversal_times), times)
        return np.asarray(self.direction * (1.0 - 2.0 * (reversals % 2)))


#: Conditions at the start of a campaign, at the reference temperature.
AT_REFERENCE: Final = RunConditions()

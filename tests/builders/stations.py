"""A single station of readings, from which tests make arrays of stations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from counterspin.physics.accelerometer import Mounting
from counterspin.physics.station import Stations, mean_products
from counterspin.physics.terms import TERMS


@dataclass(frozen=True)
class Station:
    """Position, attitude and motion of the instrument during a single reading."""

    motion: str
    mounting: Mounting
    rate: float = 0.0
    radius: float = 0.0
    stretch: float = 0.0
    droop: float = 0.0
    axis_tilt: tuple = (0.0, 0.0)
    turn: tuple = (0.0, 0.0, 0.0)
    table: tuple = ()  #: (n, c, s) of each wave.
    amplitude: float = 0.0
    bias_acceleration: float = 0.0

    def force(self, site, angle, rate=None, acceleration=0.0):
        """Return the specific force in the station's frame, m/s^2, shape (n, 3)."""
        return combine_stations([self]).forces(site, angle, rate, acceleration)[0]

    def products(self, site, force):
        """Return the signed products of specific forces, shape (number of `TERMS`, n)."""
        return combine_stations([self]).products(site, force[None])[:, 0]

    def axes_under_load(self):
        """Return the axes I, P, O as rows, with droop and rotation, shape (3, 3)."""
        return combine_stations([self]).axes_under_load()[0]

    def indicated(self, site, coefficients):
        """Return the mean indication in g; coefficients without a given value are nominal."""
        values = [coefficients.get(symbol, row.nominal) for symbol, row in TERMS.items()]
        return float(mean_products(combine_stations([self]), site)[0] @ values)


def combine_stations(stations):
    """Return stations of the same motion as arrays."""
    (motion,) = {station.motion for station in stations}
    names = ("rate", "radius", "stretch", "droop", "axis_tilt", "turn", "amplitude")
    settings = {
        name: np.array([getattr(station, name) for station in stations])
        for name in (*names, "bias_acceleration")
    }
    combined = Stations.at(
        motion, np.array([station.mounting.axes for station in stations]), **settings
    )
    for harmonic in {n for station in stations for n, _, _ in station.table}:
        waves = [
            np.sum(
                [(c, station) for n, c, station in station.table if n == harmonic] or [(0.0, 0.0)],
                axis=0,
            )
            for station in stations
        ]
        combined.table[harmonic] = np.array(waves)
    return combined

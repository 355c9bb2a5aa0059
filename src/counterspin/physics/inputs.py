"""The inputs of a calibration beside its records: radius, gravity, latitude, timing.

An input that is stated without an uncertainty is known all the same only so well. What is then to
be assumed stands here, as the typical sizes of terms stand in the table of terms.

- `UNCERTAIN_INPUTS`, `UncertainInput`: the table
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from counterspin.frozen import frozen


@frozen
class UncertainInput:
    """One input.

    Attributes
    ----------
    symbol
        Such as ``centrifuge.radius``.
    unit
        SI.
    typical
        Standard uncertainty to assume where it is stated as exact.
    words
        What it is called.
    """

    symbol: str
    unit: str
    typical: float
    words: str


UNCERTAIN_INPUTS: Final[Mapping[str, UncertainInput]] = {
    row.symbol: row
    for row in (
        # Measured with a length standard: 1e-7 to 4e-6 of the radius.
        UncertainInput("centrifuge.radius", "m", 1e-5, "radius of the centrifuge"),
        # A gravity map, corrected for the height; an absolute gravimeter does better by 1000.
        UncertainInput("site.gravity", "m/s^2", 1e-4, "gravity of the site"),
        # 30 m on the ground.
        UncertainInput("site.latitude", "rad", 5e-6, "latitude of the site"),
        # One row of a record at 100 kHz.
        UncertainInput("records.timing_offset", "s", 1e-5, "delay of the recorded angle"),
    )
}

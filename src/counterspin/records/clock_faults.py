"""Faults of a record's clock and angle in words, with the likely cause."""

from __future__ import annotations

import math

#: Ratios of measured to nominal rate that come of a mistaken unit, and what to say.
_UNIT_SLIPS = (
    (180 / math.pi, "Is the angle column in degrees?"),
    (math.pi / 180, "Is the angle column in radians?"),
    (2 * math.pi, "Is the angle column in radians rather than revolutions?"),
    (1 / (2 * math.pi), "Is the angle column in revolutions?"),
    (360.0, "Is the angle column in degrees rather than revolutions?"),
    (1 / 360, "Is the angle column in revolutions rather than degrees?"),
    (1e-3, "Is the time column in milliseconds?"),
    (1e3, "Is the time column in seconds rather than milliseconds?"),
    (1e-6, "Is the time column in microseconds?"),
    (1e6, "Is the time column in seconds rather than microseconds?"),
    (1e-9, "Is the time column in nanoseconds?"),
    (1 / 60, "Is the time column in seconds rather than minutes, or the rate per minute?"),
    (60.0, "Is the time column in minutes, or the rate per minute?"),
)


def rate_words(measured: float, nominal: float) -> str:
    """Say that the angle does not advance at the run's rate (rad/s), and what may be the cause."""
    ratio = measured / nominal
    words = (
        f"the angle advances at {measured:.6g} rad/s, but the run's rate is {nominal:.6g} rad/s."
    )
    if abs(ratio + 1) < 0.05:
        return words + (
            " The angle runs in the opposite sense to the run's rate: give the rate the other "
            "sign, or the angle column."
        )
    slip, hint = min(_UNIT_SLIPS, key=lambda known: abs(abs(ratio) / known[0] - 1))
    if abs(abs(ratio) / slip - 1) < 0.05:
        return f"{words} {hint}"
    return words + " The two must agree within 5 %: check the rate, and the record's units."


def jump_words(gone: float, step: float, stray: float, rate: float) -> str:
    """Say that time and angle part company between two rows.

    gone, step: The time between the rows, and the usual one, s.
    stray: The angle's excess over what that time leads to, rad.
    rate: rad/s.
    """
    if abs(gone / step - 1) < 0.2:
        return (
            f"the angle jumps: it is {stray:.4g} rad off what the rows before it lead to, "
            "and stays off. Cut the record here."
        )
    return (
        f"the clock jumps: time advances by {gone:.6g} s over one row, the angle as in "
        f"{gone + stray / rate:.6g} s. Cut the record here."
    )

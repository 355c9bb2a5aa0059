"""When an instrument is due again: how long it stays in specification with a stated reliability."""

from __future__ import annotations

from datetime import datetime, timedelta
from typing import Final

from counterspin.histories.consistency import Drift
from counterspin.inference.distributions import normal_cdf

#: No interval is longer, whatever the line says; years.
LONGEST_YEARS: Final = 10.0

YEAR: Final = timedelta(days=365.25)


def probability_inside(line: Drift, time: float, low: float | None, high: float | None) -> float:
    """Return the probability that the quantity lies within limits at a time.

    The line's uncertainty is enlarged by its Birge ratio where that is above 1.

    low, high: The limits; None where there is none.
    """
    value, u = (float(part) for part in line.at(time))
    u *= max(1.0, line.agreement.birge or 1.0)
    below = 1.0 if high is None else normal_cdf((high - value) / u)
    return below - (0.0 if low is None else normal_cdf((low - value) / u))


def next_due(
    line: Drift,
    start: datetime,
    last: datetime,
    limits: tuple[float | None, float | None],
    reliability: float,
) -> datetime | None:
    """Return the last day on which the quantity is in specification with the reliability wanted.

    After method 2 of ILAC-G24:2022 (OIML D 10:2022), 6.3, "Control chart (calendar-time)": drift
    and its uncertainty are found from the results of the past and carried on.

    Returns: `last` itself where the probability is too small already; None if it is large enough
        for `LONGEST_YEARS` years.
    """
    begin = (last - start) / YEAR
    if probability_inside(line, begin, *limits) < reliability:
        return last
    # The probability may first grow, when the line leads back: the first time that it fails counts.
    steps = int(LONGEST_YEARS * 52)
    inside = begin
    for step in range(1, steps + 1):
        outside = begin + LONGEST_YEARS * step / steps
        if probability_inside(line, outside, *limits) < reliability:
            break
        inside = outside
    else:
        return None
    while outside - inside > 1e-4:
        middle = 0.5 * (inside + outside)
        if probability_inside(line, middle, *limits) < reliability:
            outside = middle
        else:
            inside = middle
    return start + inside * YEAR

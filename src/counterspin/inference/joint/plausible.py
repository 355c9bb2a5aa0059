"""Which of several explanations that records cannot tell apart is the likelier one.

The evidence for a parameter that fits as v with the standard uncertainty u goes as u p(v), where
p is what was known of it before (Jeffreys, Theory of Probability, 3rd ed., sections 5.0 and 5.2).
Of a term p has the width of its typical size, which is an order of magnitude, and Cauchy's wide
tails. A mistake, such as a digit, a unit or a place, is of any size: 1/|v| over the decades.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

from counterspin.inference.joint import mistakes
from counterspin.inference.joint.alternatives import Alternative

#: ln of the decades, about six, that a mistake may be of.
_DECADES: Final = 6.0 * math.log(10.0)

#: Part of the stated values that are off which are mistaken, rather than off by what is typical.
_MISTAKEN: Final = 0.5

#: How likely a mistake of some kind is beside one of the whole campaign.
_RARER: Final[Mapping[str, float]] = {
    "priors": 0.3,  # several statements, all off by as much
    mistakes.RUN_SCALE: 0.1,
    mistakes.BIAS: 0.1,
    mistakes.BIAS_DRIFT: 0.3,
    mistakes.JUMP: 0.03,
    mistakes.SLOPE: 0.03,
    mistakes.BIAS_STEP: 0.03,
}


def log_evidence(other: Alternative, value: float, u: float) -> float:
    """Return ln of the evidence for an alternative, but for what all have and for how it fits."""
    if not (math.isfinite(u) and u > 0.0 and value != 0.0):
        return -math.inf
    rarer = _RARER.get(other.kind, 1.0)
    of_mistake = rarer / (abs(value) * _DECADES)
    if other.typical is None or not other.typical > 0.0:
        return math.log(u * of_mistake)
    known = rarer / (math.pi * other.typical * (1.0 + (value / other.typical) ** 2))
    if other.stated:
        known = _MISTAKEN * of_mistake + (1.0 - _MISTAKEN) * known
    return math.log(u * known)

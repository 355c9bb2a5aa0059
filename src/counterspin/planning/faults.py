"""Faults that a campaign's model takes no account of, and what each would do unseen.

A fault is a term of the table that is assumed to be perfect, at its typical size. Each
moves the estimates, and leaves something in the residuals; where that is too little, the plan
cannot notice it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from counterspin.arrays import Array
from counterspin.calibration.model import assumed_of, model_of
from counterspin.campaign.description import Campaign
from counterspin.frozen import frozen
from counterspin.inference.joint.series import Series
from counterspin.inference.joint.unknowns import Considered
from counterspin.physics.terms import MOTION_TERMS, term


@frozen(eq=False)
class Fault:
    """Something that may be wrong, and that the model does not know."""

    #: As the term table has it, or as it would; what it is called.
    symbol: str
    words: str
    #: What to reckon with where nothing is known, SI and g-units.
    size: float
    unit: str
    parts: tuple[Considered, ...]  #: Each has the size.
    #: Whether the parts are independent (each run has its own); else they are cosine and sine of
    #: one amplitude, the worst phase of which is taken.
    random: bool = False
    #: What a record shows of one unit in place of the one part, shape (n,), or None: nothing.
    shown: Callable[[Series], Array | None] | None = None


def _of_family(symbol: str, parts: Sequence[Considered], size: float) -> Fault:
    row = term(parts[0].symbol)
    return Fault(symbol, row.words_of_family, size, row.unit, tuple(parts), random=row.per_run)


def faults_of(campaign: Campaign, name: str) -> list[Fault]:
    """Return what may be wrong for an accelerometer unseen: what is assumed to be perfect."""
    by_symbol: dict[str, list[Considered]] = {}
    for other in assumed_of(campaign, model_of(campaign), name):
        by_symbol.setdefault(term(other.symbol).family, []).append(other)
    return [
        _of_family(symbol, parts, campaign.typical_of(parts[0].symbol, name))
        for symbol, parts in by_symbol.items()
    ]


def of_path(symbol: str) -> Fault:
    """Return an error of the path, both quadratures: such as ``encoder.harmonic.1``."""
    rows = [row for row in MOTION_TERMS.values() if row.family == symbol]
    return _of_family(symbol, [perfect("", row.symbol) for row in rows], rows[0].typical)


def perfect(owner: str, symbol: str) -> Considered:
    """Return a term that is taken as perfect."""
    return Considered(owner, symbol, (0.0, 0.0), 1.0)


def square(name: str) -> Fault:
    """Return K_II of an accelerometer itself, as the estimate is to see it whole."""
    return Fault("K_II", "", 1.0, "g/g^2", (perfect(name, "K_II"),))


def mean_square(name: str) -> Fault:
    """Return what K_II of an accelerometer does to the mean force, without its harmonics."""

    def shown(series: Series) -> Array | None:
        if series.accelerometer != name:
            return None
        motion = series.trajectory
        times = np.arange(16.0) / 16.0 * (2.0 * math.pi / abs(motion.spindle.rate))
        along = motion.specific_force(times) @ series.mounting.turned(series.attitude).input_axis
        mean = float(np.mean((along / motion.site.gravity) ** 2))
        return np.asarray(mean * series.columns(["K_F"], 1.0)[:, 0])

    # Readings are of a mean force: nobody's term shows them nothing.
    return Fault("K_II", "", 1.0, "g/g^2", (perfect("nobody", ""),), shown=shown)

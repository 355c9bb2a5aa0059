"""Faults that a campaign's model takes no account of, and what each would do unseen.

A fault is a term of the table that is assumed to be perfect, at its typical size. Each
moves the estimates, and leaves something in the residuals; where that is too little, the plan
cannot notice it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.calibration.model import assumed_of
from counterspin.campaign.description import Campaign
from counterspin.frozen import frozen
from counterspin.inference.joint.series import Series
from counterspin.inference.joint.unknowns import Considered
from counterspin.physics.terms import MOTION_TERMS, term

#: What a record shows of one unit of a fault: shape (n, k); None where nothing.
Columns = Callable[[Series], Array | None]


#: Stands where a fault is no term of the table: readings show nothing of it.
_NO_TERM: Final = Considered("nobody", "", (0.0, 0.0), 1.0)


@frozen(eq=False)
class Part:
    """What a fault, or a part of it, shows of one unit: in records and, of a term, in readings."""

    columns: Columns
    term: Considered = _NO_TERM


@frozen(eq=False)
class Fault:
    """Something that may be wrong, and that the model does not know."""

    #: As the term table has it, or as it would; what it is called.
    symbol: str
    words: str
    #: What to reckon with where nothing is known, SI and g-units.
    size: float
    unit: str
    parts: tuple[Part, ...]  #: Each has the size.
    #: Whether the parts are independent (each run has its own); else they are cosine and sine of
    #: one amplitude, the worst phase of which is taken.
    random: bool = False


def faults_of(campaign: Campaign, name: str) -> list[Fault]:
    """Return what may be wrong for an accelerometer unseen: what is assumed to be perfect."""
    by_symbol: dict[str, list[Considered]] = {}
    for other in assumed_of(campaign, name):
        by_symbol.setdefault(term(other.symbol).family, []).append(other)
    return [
        Fault(
            symbol,
            term(parts[0].symbol).words_of_family,
            campaign.typical_of(parts[0].symbol, name),
            term(parts[0].symbol).unit,
            tuple(_of_term(part, campaign) for part in parts),
            random=term(parts[0].symbol).per_run,
        )
        for symbol, parts in by_symbol.items()
    ]


def of_path(symbol: str) -> Fault:
    """Return an error of the path, both quadratures: such as ``encoder.harmonic.1``."""
    rows = [row for row in MOTION_TERMS.values() if row.family == symbol]
    return Fault(
        symbol,
        rows[0].words_of_family,
        rows[0].typical,
        rows[0].unit,
        tuple(Part(_seen(row.symbol)) for row in rows),
    )


def _seen(symbol: str) -> Columns:
    return lambda series: series.columns([symbol], 1.0)[:, 0]


def square(name: str) -> Fault:
    """Return K_II of an accelerometer itself, as the estimate is to see it whole."""
    return Fault("K_II", "", 1.0, "g/g^2", (_only(name, _k_ii),))


def mean_square(name: str) -> Fault:
    """Return what K_II of an accelerometer does to the mean force, without its harmonics."""
    return Fault("K_II", "", 1.0, "g/g^2", (_only(name, _mean_of_square),))


def _only(name: str, columns: Columns) -> Part:
    return Part(lambda series: columns(series) if series.accelerometer == name else None)


def _k_ii(series: Series) -> Array:
    return series.columns(["K_II"], 1.0)[:, 0]


def _mean_of_square(series: Series) -> Array:
    motion = series.trajectory
    times = np.arange(16.0) / 16.0 * (2.0 * math.pi / abs(motion.spindle.rate))
    along = motion.specific_force(times) @ series.mounting.turned(series.attitude).input_axis
    mean = float(np.mean((along / motion.site.gravity) ** 2))
    return np.asarray(mean * series.columns(["K_F"], 1.0)[:, 0])


def _of_term(part: Considered, campaign: Campaign) -> Part:
    def columns(series: Series) -> Array | None:
        prior = campaign.accelerometers[series.accelerometer].priors.get("K_I")
        factor = prior.value if prior else 1.0
        return series.columns([part.symbol], factor)[:, 0] if part.concerns(series) else None

    return Part(columns, part)

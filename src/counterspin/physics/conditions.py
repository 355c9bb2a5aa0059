"""What a coefficient does under the conditions of a run: its temperature, its time, its force.

A coefficient that changes is the table's plus a slope times a lever: K from the reference
temperature, s from the beginning of the campaign, or the square of the centripetal force at the
run's rate in g^2. Each accelerometer has slopes of its own.

- `ConditionTerm`, `CONDITION_TERMS`: the slopes
- `RunConditions`: what there is to know of a run beside its motion
- `changed`: coefficients as they are under a run's conditions, at its start
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from counterspin.frozen import frozen
from counterspin.physics.accelerometer import TERMS


@frozen
class ConditionTerm:
    """One slope of a coefficient.

    Attributes
    ----------
    symbol
        Such as ``K_F.trend``.
    coefficient
        The term of `TERMS` that changes.
    condition
        ``temperature``, ``time`` or ``force``.
    unit, limit, typical
        As of `counterspin.physics.shared_terms.PlatformTerm`.
    words
        What it is called.
    """

    symbol: str
    coefficient: str
    condition: str
    unit: str
    limit: float
    typical: float
    words: str

    nominal = 0.0
    per_run = False

    def lever(self, conditions: RunConditions, force: float) -> float:
        """Return what the slope is multiplied with at the start of a run.

        Parameters
        ----------
        conditions
            Of the run.
        force
            Centripetal force at the run's rate, g.
        """
        levers = {"temperature": conditions.warmth, "time": conditions.start, "force": force**2}
        return levers[self.condition]


@frozen
class RunConditions:
    """What is known of a run beside its motion.

    Attributes
    ----------
    start
        When it began, s from the beginning of the campaign.
    warmth
        Its temperature less the reference temperature, K.
    """

    start: float = 0.0
    warmth: float = 0.0


#: At the beginning of a campaign, at the reference temperature.
AT_REFERENCE: Final = RunConditions()

CONDITION_TERMS: Final[Mapping[str, ConditionTerm]] = {
    row.symbol: row
    for row in (
        *(
            ConditionTerm(
                f"{symbol}.temperature",
                symbol,
                "temperature",
                f"{TERMS[symbol].unit}/K",
                limit,
                typical,
                f"change of {symbol} with temperature",
            )
            for symbol, limit, typical in (
                ("K_F", 1e-2, 5e-6),
                ("K_I", 1e-2, 1e-4),
                ("K_II", 1e-5, 1e-8),
            )
        ),
        ConditionTerm("K_F.trend", "K_F", "time", "g/s", 1e-3, 1.7e-9, "change of K_F with time"),
        ConditionTerm(
            "K_F.heating",
            "K_F",
            "force",
            "g/g^2",
            1e-4,
            1e-7,
            "rise of K_F with the square of the centripetal force",
        ),
    )
}


def changed(
    coefficients: Mapping[str, float], conditions: RunConditions, force: float
) -> dict[str, float]:
    """Return an accelerometer's coefficients as they are at the start of a run.

    Parameters
    ----------
    coefficients
        Terms of `TERMS` and of `CONDITION_TERMS` by symbol; those not named are nominal.
    conditions, force
        As of `ConditionTerm.lever`.
    """
    at_start = {symbol: value for symbol, value in coefficients.items() if symbol in TERMS}
    for symbol, slope in coefficients.items():
        row = CONDITION_TERMS.get(symbol)
        if row is None or slope == 0.0:
            continue
        before = at_start.get(row.coefficient, TERMS[row.coefficient].nominal)
        at_start[row.coefficient] = before + slope * row.lever(conditions, force)
    return at_start

"""What results vary by from one turn-on, mounting or day to another: IEEE 1293's repeatability."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.histories.due import YEAR
from counterspin.histories.files import DatedResult
from counterspin.histories.result import Repeatability, RepeatComponent
from counterspin.inference.variance_components import variance_components

#: Fewest results, beyond what is estimated beside, that tell a variance.
_FEWEST: Final = 2


def repeatability(
    records: Sequence[DatedResult], covariance: Array | None, *, drifts: bool
) -> Repeatability | None:
    """Return what results vary by beyond their u; None for too few.

    covariance: Of the results, shape (n, n); None: they are independent.
    drifts: Whether they are taken about a line over time, not about their mean.
    """
    start = records[0].date
    years = np.array([(record.date - start) / YEAR for record in records])
    columns = [np.ones(len(records)), *([years - years.mean()] if drifts else [])]
    if len(records) < len(columns) + _FEWEST:
        return None
    groups, not_told = _groups(records)
    if not groups:
        return None
    known = np.diag([record.u**2 for record in records]) if covariance is None else covariance
    values = np.array([record.value for record in records])
    found = variance_components(values, known, groups, np.stack(columns, axis=1))
    components = {
        name: RepeatComponent(
            value=own.value,
            low=own.low,
            high=own.high if math.isfinite(own.high) else None,
            groups=own.groups,
            freedom=own.freedom,
            same_as=[other for other, place in found.same_as.items() if place == name],
        )
        for name, own in found.components.items()
    }
    return Repeatability(
        components=components,
        total=math.sqrt(sum(own.value**2 for own in components.values())),
        about="line" if drifts else "mean",
        value=found.value,
        u=found.u,
        not_told=not_told,
    )


def _groups(records: Sequence[DatedResult]) -> tuple[dict[str, list[str]], dict[str, str]]:
    """Return the groups of each result by what was repeated, and why others cannot be told."""
    labels: dict[str, list[str | None]] = {
        "day": [record.date.date().isoformat() for record in records],
        "mounting": [record.mounting for record in records],
        "turn_on": [record.turn_on for record in records],
    }
    groups: dict[str, list[str]] = {}
    not_told: dict[str, str] = {}
    for name, own in labels.items():
        named = [label for label in own if label is not None]
        if len(named) < len(own):
            lacking = len(own) - len(named)
            not_told[name] = f"{lacking} of {len(own)} results do not state it"
        elif len(set(named)) < 2:
            not_told[name] = "all results are of the same"
        else:
            groups[name] = named
    return groups, not_told

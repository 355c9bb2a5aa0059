"""How errors of different accelerometers are related, as a result says it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations

import numpy as np

from counterspin.arrays import Array
from counterspin.calibration.result import Result
from counterspin.physics.correction import CalibratedAccelerometer


def covariances_between(
    result: Result, instruments: Sequence[CalibratedAccelerometer]
) -> dict[tuple[int, int], Array]:
    """Return the covariances of the coefficients of accelerometers that were fitted together.

    By their places, as `counterspin.physics.correction.correct` takes them. Two estimates are
    related as the result's covariance says; an estimate and what is known of another's term as the
    sensitivity of its budget says. A result of an earlier version says neither.
    """
    if result.covariance is None:
        return {}
    places = {name: place for place, name in enumerate(result.covariance.terms)}
    found = {}
    for (k, one), (m, other) in combinations(enumerate(instruments), 2):
        covariance = np.zeros((len(one.coefficients), len(other.coefficients)))
        for i, j, at in _pairs(one, other, places):
            covariance[i, j] = result.covariance.values[at]
        _add_known(result, one, other, places, covariance)
        _add_known(result, other, one, places, covariance.T)
        found[k, m] = covariance
    return found


def _pairs(
    one: CalibratedAccelerometer, other: CalibratedAccelerometer, places: Mapping[str, int]
) -> Iterator[tuple[int, int, tuple[int, int]]]:
    """Yield the places of two estimates among their instruments' coefficients, and among all."""
    for i, symbol in enumerate(one.coefficients):
        for j, another in enumerate(other.coefficients):
            names = f"{one.name}.{symbol}", f"{other.name}.{another}"
            if names[0] in places and names[1] in places:
                yield i, j, (places[names[0]], places[names[1]])


def _add_known(
    result: Result,
    one: CalibratedAccelerometer,
    other: CalibratedAccelerometer,
    places: Mapping[str, int],
    covariance: Array,
) -> None:
    """Fill in, in place, how estimates of the first follow what is known of the second."""
    for i, symbol in enumerate(one.coefficients):
        for line in result.accelerometers[one.name].budget.get(symbol, []):
            owner, _, source = line.source.partition(".")
            known = owner == other.name and line.source not in places
            if known and source in other.coefficients and line.sensitivity is not None:
                j = list(other.coefficients).index(source)
                covariance[i, j] = line.sensitivity * other.covariance[j, j]

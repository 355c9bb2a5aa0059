"""Correlations between stated priors of accelerometer terms, ``correlation`` in [model.priors]."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from typing import Final

import numpy as np

from counterspin.campaign.documents import KeyPath
from counterspin.campaign.quantity import Quantity
from counterspin.campaign.validation import Problems, suggest_name
from counterspin.errors import InputError, OutOfRangeError, error_code
from counterspin.inference.priors import correlation_matrix
from counterspin.physics.terms import ACCELEROMETER_TERMS

#: The key in [model.priors].
CORRELATION_KEY: Final = "correlation"

_KEY_PATH: Final[KeyPath] = ("model", "priors", CORRELATION_KEY)

#: Smallest eigenvalue of a correlation matrix that counts as positive.
_MIN_EIGENVALUE: Final = 1e-9

#: Full names of two terms, such as ``Qx.K_OO`` and ``Qx.K_PP``.
Pair = tuple[str, str]


def read_correlations(
    entries: object,
    priors: Mapping[str, Mapping[str, Quantity]],
    considered: Collection[str],
    problems: Problems,
) -> dict[str, dict[str, float]]:
    """Return full name of a term -> full name of another term -> correlation of their priors.

    entries: List of [term, term, r]. A term without an accelerometer applies to each of them.
    priors: Accelerometer -> term symbol -> prior.
    considered: Symbols of the considered terms, [model] hold.
    """
    if not isinstance(entries, list):
        problems.add(_KEY_PATH, 'must be a list such as [["K_OO", "K_PP", 0.4]]', "wrong-type")
        return {}
    correlations: dict[str, dict[str, float]] = {}
    for index, entry in enumerate(entries):
        path = (*_KEY_PATH, index)
        try:
            pairs, r = _read_entry(entry, priors)
            for pair in pairs:
                for name in pair:
                    _check_correlatable(name, priors, considered)
                first, second = pair
                if second in correlations.get(first, {}):
                    raise InputError(
                        f"the correlation of {first} and {second} is stated twice",
                        "duplicate-entry",
                    )
                correlations.setdefault(first, {})[second] = r
                correlations.setdefault(second, {})[first] = r
        except ValueError as error:
            problems.add(path, str(error), error_code(error))
    for members in _find_indefinite_sets(correlations):
        names = ", ".join(
            f"{first} and {second} {r:g}"
            for position, first in enumerate(members)
            for second, r in correlations[first].items()
            if second not in members[:position]
        )
        problems.add(
            _KEY_PATH,
            f"no joint distribution can have these correlations: {names}. Their matrix is not "
            "positive definite; reduce a correlation, or check the signs",
            "invalid-correlation",
        )
        return {}
    return correlations


def _read_entry(
    entry: object, priors: Mapping[str, Mapping[str, Quantity]]
) -> tuple[list[Pair], float]:
    """Return the pairs of an entry and their correlation."""
    match entry:
        case [str(first), str(second), (int() | float()) as r] if not isinstance(r, bool):
            pass
        case _:
            raise ValueError('must be two terms and their correlation, as in ["K_OO", "K_PP", 0.4]')
    if not -1.0 < r < 1.0:
        raise OutOfRangeError(
            f"a correlation must be greater than -1 and less than 1, but it is {r:g}"
        )
    full_names = [_expand_name(name, priors) for name in (first, second)]
    pairs = [
        (a, b)
        for a in full_names[0]
        for b in full_names[1]
        # A term without an accelerometer refers to the same accelerometer.
        if not {first, second} & {*ACCELEROMETER_TERMS} or a.split(".")[0] == b.split(".")[0]
    ]
    if not pairs or any(a == b for a, b in pairs):
        raise ValueError(f"{first} and {second} are not two different terms")
    return pairs, float(r)


def _expand_name(name: str, priors: Mapping[str, Mapping[str, Quantity]]) -> list[str]:
    """Return the full names of a term; without an accelerometer, one for each of them."""
    owner, _, symbol = name.partition(".")
    if owner in priors and symbol in ACCELEROMETER_TERMS:
        return [name]
    if name in ACCELEROMETER_TERMS:
        return [f"{owner}.{name}" for owner in priors]
    raise InputError(
        f'"{name}" is not a term of an accelerometer' + suggest_name(name, ACCELEROMETER_TERMS),
        "unknown-term",
    )


def _check_correlatable(
    name: str, priors: Mapping[str, Mapping[str, Quantity]], considered: Collection[str]
) -> None:
    """Raise ValueError if the prior of a term cannot be correlated."""
    owner, _, symbol = name.partition(".")
    prior = priors[owner].get(symbol)
    if prior is None or prior.u == 0.0:
        reason = "has no stated prior" if prior is None else "is stated without an uncertainty"
        raise InputError(
            f"{name} {reason}; a correlation requires two priors with a stated ±", "missing-prior"
        )
    if symbol in considered:
        raise InputError(
            f"{symbol} is in model.hold; remove it from this list, so that the fit adjusts the "
            "term",
            "conflicting-keys",
        )
    if (shape := prior.distribution.shape) != "normal":
        raise InputError(
            f"the prior of {name} has a {shape} distribution; correlated priors are jointly normal "
            "(JCGM 101, 6.4.8). State this prior by its value and u, or remove the correlation",
            "invalid-correlation",
        )


def _find_indefinite_sets(correlations: Mapping[str, Mapping[str, float]]) -> Iterator[list[str]]:
    """Yield each set of connected terms whose correlation matrix is not positive definite."""
    remaining = dict.fromkeys(correlations)
    while remaining:
        members = [next(iter(remaining))]
        for name in members:  # grows as further terms are found
            members += [partner for partner in correlations[name] if partner not in members]
        remaining = dict.fromkeys(name for name in remaining if name not in members)
        matrix = correlation_matrix(members, correlations)
        if np.linalg.eigvalsh(matrix)[0] < _MIN_EIGENVALUE:
            yield members

"""The covariance of the difference of two results, what they have in common being counted.

Two estimates of the same records have most of their error in common. Where one of them is the best
linear unbiased estimate of what both rest on (the smaller of two nested models, or all of the
records beside some of them), the covariance of the two is its own variance, so that variances
subtract (J. A. Hausman, Econometrica 46 (1978) 1251, lemma 2.1). What is held moves each estimate
by its own sensitivity. Results of other records have in common what is stated alike: the
radius, gravity, what is known beforehand. What nobody states is the same for an instrument and its
machine in all their results, and so is shared by those that take it at the same typical size.
"""

from __future__ import annotations

import math
from typing import Final, Literal

import numpy as np

from counterspin.arrays import Array
from counterspin.comparisons.estimates import Estimates, SharedSource, squares
from counterspin.frozen import frozen
from counterspin.inference.distributions import chi_square_tail

#: Part of a variance below which a difference of variances is rounding.
NEGLIGIBLE: Final = 1e-9

#: Part of a variance from which a source that both results share is named.
_SAID: Final = 1e-3


@frozen
class Relation:
    """What two results have in common."""

    #: Whether their records are the ``same``, some are (``part``), or they are ``independent``.
    records: Literal["same", "part", "independent"]
    #: Place of the result whose estimate is the best of what both rest on, 0 or 1, or None: nothing
    #: says which; the one with the smaller variance is then taken for it.
    better: Literal[0, 1] | None = None
    #: Whether both weigh the same records in the same way, so that noise moves them alike.
    alike: bool = False
    #: Noise of the first result over that of the second, where it was estimated in both.
    noise_ratio: float = 1.0


def covariance_of_difference(
    first: Estimates, second: Estimates, relation: Relation
) -> tuple[Array, list[str]]:
    """Return the covariance of second less first, and the names of the sources that both share."""
    apart = relation.records == "part" and relation.better is None
    if relation.records == "independent" or apart:
        return _of_independent(first, second)
    return _of_common_records(first, second, relation)


def _of_independent(first: Estimates, second: Estimates) -> tuple[Array, list[str]]:
    covariance = first.covariance + second.covariance
    shared = []
    for name, source in first.sources.items():
        other = second.sources.get(name)
        if other is not None and not source.of_run and source.is_as(other):
            cross = np.outer(source.moves, other.moves)
            covariance = covariance - cross - cross.T
            if np.any(np.abs(np.diag(cross)) > _SAID * np.diag(first.covariance)):
                shared.append(name)
    return covariance, shared


def _of_common_records(
    first: Estimates, second: Estimates, relation: Relation
) -> tuple[Array, list[str]]:
    better, other = (first, second) if relation.better != 1 else (second, first)
    size = len(first.symbols)
    if not (first.complete and second.complete):
        # Nothing says what moves which: all that is held is taken to move both alike.
        rest = [np.diag(e.covariance) - e.held**2 for e in (first, second)]
        if relation.alike:
            rest = [np.zeros(size), np.zeros(size)]
        difference = np.abs(rest[0] - rest[1]) + (first.held - second.held) ** 2
        return np.diag(difference), []
    in_both, apart = list[tuple[SharedSource, SharedSource]](), list[Array]()
    anew = list[tuple[Array, Array]]()
    shared = []
    for name, source in better.sources.items():
        its = other.sources.get(name)
        if source.estimated:
            # Measured anew, it is no part of what both rest on.
            if its is not None and its.estimated and source.is_another(its):
                anew.append((source.moves, its.moves))
        elif its is not None and source.is_as(its):
            in_both.append((source, its))
            shared.append(name)
        else:
            apart.append(source.moves)
    # Stated otherwise, or left out by the better one: by itself in the other.
    alone = [
        source.moves
        for name, source in other.sources.items()
        if not (source.estimated or name in shared or _estimated(better, name))
    ]
    own_anew, their_anew = (squares([moves[i] for moves in anew], size) for i in (0, 1))
    theirs = other.covariance - their_anew
    theirs = theirs - squares([*(its.moves for _, its in in_both), *alone], size)
    own = better.covariance - own_anew - better.part(estimated=False)
    if relation.noise_ratio != 1.0:
        ratio = relation.noise_ratio if better is second else 1.0 / relation.noise_ratio
        priors = better.part(estimated=True) - own_anew
        own = priors + ratio**2 * (own - priors)
    scale = np.sqrt(np.diag(first.covariance) + np.diag(second.covariance))
    excess = np.zeros((size, size))
    if not relation.alike:
        excess = _size_of((theirs - own) / np.outer(scale, scale)) * np.outer(scale, scale)
    moved = squares([its.moves - source.moves for source, its in in_both], size)
    return excess + moved + squares([*apart, *alone], size) + own_anew + their_anew, shared


def _estimated(estimates: Estimates, name: str) -> bool:
    return name in estimates.sources and estimates.sources[name].estimated


def _size_of(matrix: Array) -> Array:
    """Return a symmetric matrix with its negative eigenvalues positive.

    There are none where the better estimate is the better one.
    """
    values, vectors = np.linalg.eigh(0.5 * (matrix + matrix.T))
    values = np.where(np.abs(values) > NEGLIGIBLE, np.abs(values), 0.0)
    size: Array = (vectors * values) @ vectors.T
    return size


def chi_square(
    difference: Array, covariance: Array, scale: Array
) -> tuple[float, int, float | None]:
    """Return chi-square of a difference, its degrees of freedom and the probability of more.

    difference: Shape (p,).
    covariance: Of it, shape (p, p); as many degrees of freedom as directions in which it is not
        nothing.
    scale: Standard uncertainties that say what is nothing, shape (p,).
    """
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    there = values > 2.0 * NEGLIGIBLE
    along = vectors.T @ (difference / scale)
    chi2 = float(np.sum(along[there] ** 2 / values[there]))
    dof = int(np.count_nonzero(there))
    return chi2, dof, chi_square_tail(dof, chi2) if dof and math.isfinite(chi2) else None

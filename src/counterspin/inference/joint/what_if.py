"""The change of u of a coefficient if something were known better or worse: an update, no refit.

Let A be the covariance that the weights minimise, and D the changes of 1/u^2 of what is known
beforehand of the sources J. The estimates then become M times what they were, with
M = 1 - A_J D (1 + A_JJ D)^-1 e_J^T, and A becomes M A (the information form of a sequential update,
Bierman 1977, chapter V). Contributions that do not enter the weights (considered terms, undetected
noise) propagate through the same gain: E becomes M E M^T. If a considered term, which has no
weight, were known better, only its contribution to E would decrease, by the square. The noise stays
as it was estimated.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.inference.joint.fit import JointFit
from counterspin.inference.joint.summary import BudgetLine, WhatIf
from counterspin.inference.joint.unknowns import Considered

#: Sources below this share of any u^2 are not asked about, nor more of them than a page has room
#: for.
_MIN_SHARE: Final = 1e-3
_MAX_SOURCES: Final = 12

#: What is beside the weights, below this part of a variance, is rounding.
_ROUNDING: Final = 1e-9


def what_if(
    fit: JointFit, places: Mapping[str, int], budget: Mapping[str, Sequence[BudgetLine]], owner: str
) -> WhatIf | None:
    """Return the inputs of a coefficient update; None where no relevant value could change.

    places: Coefficient -> its place among the unknowns.
    budget: Coefficient -> its budget.
    owner: Accelerometer, whose own terms are named without it.
    """
    shares: dict[str, float] = {}
    for line in (line for lines in budget.values() for line in lines):
        shares[line.source] = max(shares.get(line.source, 0.0), line.share)
    unknowns, considered_terms = fit.model.unknowns, fit.model.considered
    terms = {
        term.name.removeprefix(f"{owner}."): (term, index)
        for terms_of_kind in (considered_terms, unknowns)
        for index, term in enumerate(terms_of_kind)
    }
    sources = [
        source
        for source, share in sorted(shares.items(), key=lambda item: -item[1])
        if share >= _MIN_SHARE
        and source in terms
        # What is exactly known would have to become uncertain first.
        and 0.0 < terms[source][0].prior[1] < math.inf
        # A correlated prior cannot change alone.
        and not terms[source][0].correlations
    ][:_MAX_SOURCES]
    if not sources:
        return None
    names = list(dict.fromkeys([*(symbol for symbol in places if symbol in budget), *sources]))
    # A held term has a row of zeros: no weights know of it.
    rows = np.zeros((len(names), len(unknowns)))
    considered_places = {}
    for row, name in zip(rows, names, strict=True):
        term, index = terms[name]
        if isinstance(term, Considered):
            considered_places[name] = index
        else:
            row[index] = 1.0
    # From the factors: what the weights take the covariance for, whatever the noise turned out.
    root = fit.solution.covariance_root(rows)
    weighted = root @ root.T
    unweighted = rows @ fit.solution.covariance @ rows.T - weighted
    considered_sensitivities = rows @ fit.solution.sensitivity_considered
    return WhatIf(
        names=names,
        units=[terms[name][0].unit for name in names],
        known={source: terms[source][0].prior[1] for source in sources},
        weighed=weighted.tolist(),
        beside=unweighted.tolist() if _is_significant(unweighted, weighted) else [],
        held={
            name: (considered_terms[k].prior[1] * considered_sensitivities[:, k]).tolist()
            for name, k in considered_places.items()
        },
    )


def _is_significant(covariance: Array, reference: Array) -> bool:
    sds = np.sqrt(np.diag(reference))
    return bool(np.any(np.abs(covariance) > _ROUNDING * np.outer(sds, sds)))

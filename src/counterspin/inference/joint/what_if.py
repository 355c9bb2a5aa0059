"""Change of u of a coefficient with other prior uncertainties, without a refit.

Let A be the covariance that the weights minimise, and D the changes of 1/u^2 of the priors of the
sources J. The estimates are then multiplied by M = 1 - A_J D (1 + A_JJ D)^-1 e_J^T, and A becomes
M A (information form of a sequential update, Bierman 1977, chapter V). Contributions that do not
enter the weights (considered terms, undetected noise) propagate through the same gain: E becomes
M E M^T. A change of u of a considered term only changes its contribution to E, by the square. The
estimated noise does not change.
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

#: Smallest share of a source in any u^2, and largest number of sources on a page.
_MIN_SHARE: Final = 1e-3
_MAX_SOURCES: Final = 12

#: Fraction of a variance below which the unweighted covariance is rounding error.
_ROUNDING: Final = 1e-9


def what_if(
    fit: JointFit,
    unknown_indices: Mapping[str, int],
    budgets: Mapping[str, Sequence[BudgetLine]],
    owner: str,
) -> WhatIf | None:
    """Return the matrices for an update of priors; None if no relevant prior can change.

    unknown_indices: Coefficient -> its index among the unknowns.
    budgets: Coefficient -> its budget.
    owner: Accelerometer whose name is omitted from the names of its terms.
    """
    shares: dict[str, float] = {}
    for line in (line for lines in budgets.values() for line in lines):
        shares[line.source] = max(shares.get(line.source, 0.0), line.share)
    unknowns, considered_terms = fit.model.unknowns, fit.model.considered
    terms = {
        term.name.removeprefix(f"{owner}."): (term, index)
        for terms_of_kind in (considered_terms, unknowns)
        for index, term in enumerate(terms_of_kind)
    }
    sources = [
        source
        for source, share in sorted(shares.items(), key=lambda name_and_share: -name_and_share[1])
        if share >= _MIN_SHARE
        and source in terms
        # Only finite nonzero uncertainties can change.
        and 0.0 < terms[source][0].prior[1] < math.inf
        # A correlated prior cannot change alone.
        and not terms[source][0].correlations
    ][:_MAX_SOURCES]
    if not sources:
        return None
    names = list(
        dict.fromkeys([*(symbol for symbol in unknown_indices if symbol in budgets), *sources])
    )
    # The row of a considered term is zero, because it has no weight.
    selection = np.zeros((len(names), len(unknowns)))
    considered_indices = {}
    for row, name in zip(selection, names, strict=True):
        term, index = terms[name]
        if isinstance(term, Considered):
            considered_indices[name] = index
        else:
            row[index] = 1.0
    # From the factors: the covariance that the weights minimise.
    root = fit.solution.covariance_root(selection)
    weighted_covariance = root @ root.T
    unweighted_covariance = selection @ fit.solution.covariance @ selection.T - weighted_covariance
    considered_sensitivities = selection @ fit.solution.sensitivity_considered
    return WhatIf(
        names=names,
        units=[terms[name][0].unit for name in names],
        known={source: terms[source][0].prior[1] for source in sources},
        weighed=weighted_covariance.tolist(),
        beside=unweighted_covariance.tolist()
        if _is_significant(unweighted_covariance, weighted_covariance)
        else [],
        held={
            name: (considered_terms[k].prior[1] * considered_sensitivities[:, k]).tolist()
            for name, k in considered_indices.items()
        },
    )


def _is_significant(covariance: Array, reference: Array) -> bool:
    sds = np.sqrt(np.diag(reference))
    return bool(np.any(np.abs(covariance) > _ROUNDING * np.outer(sds, sds)))

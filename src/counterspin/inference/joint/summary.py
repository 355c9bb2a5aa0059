"""Numbers of a joint fit that a result states: budget lines, what-if values and the jackknife."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import field
from typing import Final, Literal

import numpy as np

from counterspin.frozen import frozen

#: Categories: noise, stated priors, default priors, and considered terms.
Kind = Literal["noise", "stated", "unstated", "held"]
NOISE: Final = "noise"
STATED: Final = "stated"
DEFAULT_PRIOR: Final = "unstated"
CONSIDERED: Final = "held"


@frozen
class BudgetLine:
    """One source of uncertainty (GUM table 1)."""

    #: Name of the source: a term, an input, ``noise of Qx``, ``undetected noise of Qx``, or an
    #: uncertain quantity of the rotation of a run, such as ``run1.rate`` or ``run1.ripple1``.
    source: str
    #: Kind of uncertainty source: ``noise`` (including encoder noise), ``stated``, ``unstated`` or
    #: ``held``.
    kind: Kind
    #: Standard uncertainty of the source, in `unit`; null for noise. For undetected noise, this is
    #: the noise level; for a ripple, u of the sine and of the cosine; for random errors of rates,
    #: the root mean square of their u.
    u: float | None
    unit: str  #: Unit of `u`.
    #: Change of the coefficient per unit of the source; null for noise, because its sensitivity
    #: differs between samples. For a ripple (sine and cosine in one line) and for errors of rates,
    #: this is the magnitude of the sensitivity.
    sensitivity: float | None
    contribution: float  #: Magnitude of sensitivity × u, in the coefficient's unit.
    share: float  #: Share of the coefficient's u^2, from 0 to 1.


@frozen
class WhatIf:
    """Covariances for an update of prior uncertainties."""

    names: list[str]  #: Names of the coefficients and sources, as in a budget.
    units: list[str]  #: Unit of each name, an SI unit or a g-unit.
    #: Prior standard uncertainty of each source; a source without an entry cannot be changed.
    known: dict[str, float]
    #: Covariance matrix of the estimates, as assumed by the weights of the fit; rows and
    #: columns are in the order of `names`.
    weighed: list[list[float]]
    #: Additional covariance from held terms and undetected noise; empty if there are none.
    beside: list[list[float]] = field(default_factory=list)
    #: Shift of each coefficient and source when a held source changes by its u.
    held: dict[str, list[float]] = field(default_factory=dict)

    @property
    def is_whole(self) -> bool:
        """True if names, units and matrices are consistent; those of a file may not be."""
        names = set(self.names)
        matrices = (self.weighed, self.beside or self.weighed)
        return (
            len(names) == len(self.names) == len(self.units)
            and self.known.keys() <= names
            and self.held.keys() <= self.known.keys()
            and all(0.0 < u < math.inf for u in self.known.values())
            and all(len(m) == len(names) == len(r) for m in matrices for r in m)
            and all(len(changes) == len(names) for changes in self.held.values())
            and all(math.isfinite(v) for m in (*matrices, self.held.values()) for r in m for v in r)
        )

    def u(self, name: str, known: Mapping[str, float]) -> float:
        """Return the standard uncertainty of a coefficient with other prior uncertainties.

        known: Source -> prior standard uncertainty, above 0; other sources are unchanged.
        """
        return math.sqrt(sum(self.parts(name, known).values()))

    def parts(self, name: str, known: Mapping[str, float]) -> dict[str, float]:
        """Return the u^2 of a coefficient by source, and the remainder as ``""``; see `u`."""
        if unknown := [source for source in known if source not in self.known]:
            raise ValueError(f"no prior for {', '.join(unknown)}")
        if not all(u > 0.0 and math.isfinite(u) for u in known.values()):
            raise ValueError("a standard uncertainty must be greater than zero")
        covariance = np.array(self.weighed)
        constant_covariance = np.array(self.beside) if self.beside else np.zeros_like(covariance)
        changed_priors = {source: u for source, u in known.items() if source not in self.held}
        indices = [self.names.index(source) for source in changed_priors]
        weight_changes = np.diag(
            [u**-2 - self.known[source] ** -2 for source, u in changed_priors.items()]
        )
        gain_matrix = np.eye(len(indices)) + covariance[np.ix_(indices, indices)] @ weight_changes
        transform = np.eye(len(covariance))
        transform[:, indices] -= (
            covariance[:, indices] @ weight_changes @ np.linalg.inv(gain_matrix)
        )
        row = transform[self.names.index(name)]
        covariances = row @ covariance  # with every name
        variance = float(covariances[self.names.index(name)] + row @ constant_covariance @ row)
        parts = {}
        for source, u in (self.known | dict(known)).items():
            if source in self.held:
                shift = float(row @ self.held[source])
                parts[source] = (shift * u / self.known[source]) ** 2
                variance += parts[source] - shift**2
            else:
                # The contribution of a prior is its u times the sensitivity A / u^2.
                parts[source] = float(covariances[self.names.index(source)] / u) ** 2
        return parts | {"": max(variance - sum(parts.values()), 0.0)}


@frozen
class Jackknife:
    """Change of one unknown without a run."""

    run: str  #: Omitted run.
    #: Estimate without this run; null if the other runs do not determine the coefficient.
    value: float | None = None
    shift: float | None = None  #: Estimate without this run minus the estimate from all runs.
    #: Shift divided by its standard uncertainty; null if this run contains so little information
    #: that rounding errors dominate.
    z: float | None = None
    #: Effective degrees of freedom of the standard uncertainty of the shift; null means infinite.
    dof: float | None = None

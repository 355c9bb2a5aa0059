"""What several results have in common, and so err in together: radius, gravity, priors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.calibration.result import Result
from counterspin.frozen import frozen
from counterspin.inference.joint.budget import BudgetLine
from counterspin.physics.terms import is_term, mounting_of, term

#: How a budget names what is common: an input of the campaign -> where the result has its value.
_INPUTS: Final = {
    "site.gravity": "gravity",
    "site.latitude": "latitude",
    "centrifuge.radius": "radius",
}

#: Correlations below this change nothing that is printed.
_NEGLIGIBLE_CORRELATION: Final = 0.01

#: The parts of a budget are no more than u^2, but for rounding.
_MAX_BUDGET_SUM: Final = 1.01

#: What a result does not share is at least this part of its u.
_LEAST_OWN_PART: Final = 1e-3


@frozen
class SharedInputs:
    """What results share."""

    names: tuple[str, ...]  #: What it is, such as ``centrifuge.radius``.
    largest: float  #: The largest correlation of two results.
    covariance: Array  #: Of the results, shape (n, n).


def shared_sources(
    result: Result, u: float, lines: Sequence[BudgetLine]
) -> dict[tuple[str, str], float]:
    """Return what each source does that another result may have in common.

    Two results share an input if both have the same value and uncertainty of it, and a term of the
    accelerometer, the platform or the machine if both have the same uncertainty, stated or not: it
    is then taken to be the same measurement, or the same lack of one. That of another accelerometer
    must be of the same one. What belongs to a run or to a mounting is not shared.

    u, lines: Of the coefficient, and its budget.
    """
    found: dict[tuple[str, str], float] = {}
    if sum(line.contribution**2 for line in lines) > _MAX_BUDGET_SUM * u**2:
        return found  # a budget of another uncertainty
    for line in lines:
        source = line.source
        if line.kind == "noise" or line.u is None or line.sensitivity is None:
            continue
        owner, _, symbol = source.partition(".")
        if source in _INPUTS:
            identity = f"{getattr(result.inputs, _INPUTS[source])!r} ± {line.u!r}"
        elif is_term(source) and not (term(source).per_run or mounting_of(source)):
            identity = repr(line.u)
        elif owner in result.accelerometers and is_term(symbol):
            whose = result.accelerometers[owner].serial_number
            identity = f"{line.u!r} of {whose or result.details.get('serial_number')}"
        else:
            continue
        found[source, identity] = line.sensitivity * line.u
    return found


def in_common(
    u: Sequence[float], shared: Sequence[Mapping[tuple[str, str], float]]
) -> SharedInputs | None:
    """Return what results have in common; None where it is negligible."""
    count: dict[tuple[str, str], int] = {}
    for sources in shared:
        for key in sources:
            count[key] = count.get(key, 0) + 1
    keys = [key for key, n in count.items() if n > 1]
    moved = np.array([[sources.get(key, 0.0) for key in keys] for sources in shared])
    total = np.asarray(u, dtype=np.float64)
    own = total**2 - (moved**2).sum(axis=1)
    covariance = moved @ moved.T
    covariance[np.diag_indices(total.size)] += np.maximum(own, (_LEAST_OWN_PART * total) ** 2)
    size = np.sqrt(np.diag(covariance))
    correlation = np.abs(covariance / np.outer(size, size) - np.eye(total.size))
    if not keys or (largest := float(correlation.max())) < _NEGLIGIBLE_CORRELATION:
        return None
    weight = np.abs(moved / total[:, None]).max(axis=0)
    names = dict.fromkeys(
        key[0] for key, w in zip(keys, weight, strict=True) if w**2 >= 0.1 * _NEGLIGIBLE_CORRELATION
    )
    return SharedInputs(tuple(names), largest, covariance)

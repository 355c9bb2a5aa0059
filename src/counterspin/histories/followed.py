"""What a history follows: a term of each accelerometer, or a parameter of each triad."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Final

from counterspin.calibration.result import Result
from counterspin.calibration.result_parts import Coefficient
from counterspin.frozen import frozen
from counterspin.inference.conformity import Conformity
from counterspin.inference.joint.budget import BudgetLine
from counterspin.physics.effects import Product
from counterspin.physics.terms import TERMS, Term

#: Kind of a triad's parameter -> a term of its unit, and of as many specific forces.
KINDS: Final = {"offset": "K_F", "sensitivity": "K_I", "angle": "delta_O"}


@frozen
class FollowedValue:
    """What one result says of what is followed."""

    accelerometers: tuple[str, ...]  #: Whose it is: an angle is that of two.
    coefficient: Coefficient | None  #: None where the result has none.
    budget: Sequence[BudgetLine]  #: Of it.
    conformity: Conformity | None  #: With its specification; None without one.


def term_like(followed: str) -> Term[Product]:
    """Return the term that is followed, or one in the unit of a parameter that is."""
    return TERMS[KINDS.get(followed, followed)]


def followed_in(result: Result, followed: str) -> Iterator[FollowedValue]:
    """Yield what a result says of a term of each accelerometer, or of a parameter of its triad.

    Of angles it is what they are more than 90 deg.
    """
    if followed not in KINDS:
        for name, own in result.accelerometers.items():
            coefficient = own.coefficients.get(followed)
            lines, judged = own.budget.get(followed, ()), own.conformity.get(followed)
            yield FollowedValue((name,), coefficient, lines, judged)
        return
    triad = result.triad
    if triad is None:
        for name in result.accelerometers:
            yield FollowedValue((name,), None, (), None)
        return
    for parameter, c in triad.parameters.items():
        kind, *names = parameter.split(".")
        if kind != followed or not set(names) <= set(triad.accelerometers):
            continue
        if kind == "angle" and c.value is not None:
            c = c.model_copy(update={"value": c.value - 0.5 * math.pi})  # noqa: PLW2901
        of_bias = result.accelerometers[names[0]].conformity.get("K_F")
        judged = of_bias if kind == "offset" else None
        yield FollowedValue(tuple(names), c, triad.budget.get(parameter, ()), judged)

"""What every engine gives: an analysis' estimates in many trials."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.studies.draws import Draws


@frozen
class Trials:
    """What an analysis says in n trials."""

    #: Of each coefficient, shape (c, n); u is the combined standard uncertainty.
    estimate: Array
    u: Array
    dof: Array  #: Its effective degrees of freedom, shape (c, n); infinite where noise is given.


class Engine(Protocol):
    """Makes the trials of one analysis."""

    def trials(self, draws: Draws, generator: np.random.Generator) -> Trials:
        """Return what the analysis says of each draw of what is true, with noise of its own."""
        ...


def one_by_one(
    trial: Callable[[Draws, np.random.Generator], tuple[Array, Array, Array]],
    draws: Draws,
    generator: np.random.Generator,
) -> Trials:
    """Return trials that are made without any shortcut.

    trial: Makes one of them: estimate, u and degrees of freedom, shape (c,) each.
    """
    made = [trial(draws.take(place), generator) for place in range(draws.trials)]
    return Trials(*(np.array(part).T for part in zip(*made, strict=True)))

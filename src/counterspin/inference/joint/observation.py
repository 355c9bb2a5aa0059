"""What a fit is made of: rows that are linear in its unknowns, with noise of their own kind.

A record (`counterspin.inference.joint.prepared`), or readings and poses
(`counterspin.inference.linear_readings`). Whatever is asked of a fit, such as another noise, a run
left out or one more column, is asked of its observations alike.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Self

import numpy as np

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.inference.blocks import Block
from counterspin.inference.joint.unknowns import Unknowns
from counterspin.inference.noise.model import Noise


@frozen
class Observation(ABC):
    """What was measured together, n rows of it, and its columns."""

    #: Which of the model's unknowns and considered columns the columns below belong to.
    unknowns: tuple[int, ...]
    #: Their columns, shapes (n, m) and (n, c).
    design: Array
    considered: tuple[int, ...]
    fixed: Array

    @property
    @abstractmethod
    def source(self) -> str:
        """What its noise is called, in a budget and among the noises of a fit."""

    @property
    @abstractmethod
    def run(self) -> str:
        """The run in which it was measured, or what else it is called where that is left out."""

    @property
    @abstractmethod
    def motion(self) -> str:
        """The kind of test: counter-rotating for records."""

    @abstractmethod
    def block(self, noise: Mapping[str, Noise]) -> Block:
        """Return what it says of its columns, by the noise of its source."""

    def relaxed(self, count: int) -> Self:
        """Return it with what is considered among the unknowns, behind `count` others."""
        places = tuple(count + place for place in self.considered)
        whole = self.with_columns(places, self.fixed.T)
        return replace(whole, considered=(), fixed=self.fixed[:, :0])

    def with_columns(self, places: Sequence[int], columns: Sequence[Array] | Array) -> Self:
        """Return it with further unknowns: their places and what each shows, shape (n,)."""
        if not len(places):
            return self
        return replace(
            self,
            unknowns=(*self.unknowns, *places),
            design=np.column_stack([self.design, *columns]),
        )

    def block_in(self, model: Unknowns, noise: Mapping[str, Noise]) -> Block:
        """Return what it says, its columns where a model has them."""
        block = self.block(noise)
        factor = np.zeros((block.factor.shape[0], len(model.unknowns)))
        factor[:, list(self.unknowns)] = block.factor
        fixed = np.zeros((block.factor.shape[0], len(model.considered)))
        fixed[:, list(self.considered)] = block.considered
        return replace(block, factor=factor, considered=fixed)

"""The engine of a study: the trials of one batch, by whatever shortcut each analysis allows."""

from __future__ import annotations

from typing import Final, Literal, Protocol

import numpy as np

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.studies.draws import DRIFT, Draws, StudyTruth
from counterspin.studies.noise import NOISE_STREAM, TRUTH_STREAM, stream
from counterspin.studies.tally import Driver, Tally

#: What a trial costs: ``constant``; ``sampled`` where sigma is from the residuals, and with it the
#: second stage's weights; ``surrogate``; ``exact``; ``readings``; ``full``.
Cost = Literal["constant", "sampled", "surrogate", "exact", "readings", "full"]

#: Trials of a batch: what fits a cache, and for slow engines what takes a fraction of a second.
_BATCH: Final[dict[Cost, int]] = {
    "constant": 16384,
    "sampled": 8192,
    "surrogate": 4096,
    "exact": 128,
    "readings": 64,
    "full": 8,
}


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


@frozen
class ReportedCoefficient:
    """One coefficient of one analysis."""

    #: Names; the owner of a platform term is empty.
    analysis: str
    owner: str
    symbol: str
    #: The Cramer-Rao bound of its standard uncertainty; None where it cannot be had.
    bound: float | None

    @property
    def name(self) -> str:
        """Owner and symbol in one word."""
        return f"{self.owner}.{self.symbol}" if self.owner else self.symbol


@frozen
class EnginePart:
    """An engine and what it reports, in the order of its rows."""

    engine: Engine  #: The engine.
    cost: Cost  #: What a trial of it costs.
    #: Which stream of noise it draws from. Analyses that share one see the same readings.
    noise: int
    words: str  #: What it is called.
    rows: tuple[int, ...]  #: Its own rows that are reported.
    reported: tuple[ReportedCoefficient, ...]  #: What they are.
    lost: tuple[str, ...] = ()  #: Coefficients that the records do not determine.


@frozen
class Batch:
    """What one batch of trials gives."""

    sums: Array  #: For each reported coefficient, shape (c, width).
    values: Array | None  #: Truth, estimate and u of each, shape (c, 3, n), or None.


@frozen
class StudyEngine:
    """Everything that a worker needs."""

    truth: StudyTruth  #: What is true.
    seed: int  #: Of the study.
    parts: tuple[EnginePart, ...]  #: An engine for each analysis.
    tally: Tally  #: What is counted.

    @property
    def batch_size(self) -> int:
        """Trials in a batch."""
        return min(_BATCH[part.cost] for part in self.parts)

    @property
    def reported(self) -> tuple[ReportedCoefficient, ...]:
        """All that is reported, in the order of a batch's rows."""
        return tuple(coefficient for part in self.parts for coefficient in part.reported)

    def batch(self, number: int, trials: int, *, keep: bool = False) -> Batch:
        """Do the trials of one batch.

        number: Of the batch, from 0.
        keep: Whether each trial is returned too.
        """
        draws = self.truth.draw(stream(self.seed, number, TRUTH_STREAM), self.batch_size)
        driven = [_driven(draws, driver)[:trials] for driver in self.tally.drivers]
        sums, values = [], []
        for part in self.parts:
            noise = stream(self.seed, number, NOISE_STREAM + part.noise)
            # What is simulated without shortcut is slow: no more trials of it than count.
            few = draws.part(0, trials) if part.cost in ("full", "readings") else draws
            said = part.engine.trials(few, noise)
            for row, coefficient in zip(part.rows, part.reported, strict=True):
                truth = draws.mean(coefficient.owner, coefficient.symbol)[:trials]
                estimate = said.estimate[row, :trials]
                u, dof = said.u[row, :trials], said.dof[row, :trials]
                sums.append(self.tally.count(estimate, truth, u, dof, driven))
                if keep:
                    values.append(np.stack([truth, estimate, np.broadcast_to(u, truth.shape)]))
        return Batch(np.array(sums), np.array(values) if keep else None)


def _driven(draws: Draws, driver: Driver) -> Array:
    if driver.symbol == DRIFT:
        return np.broadcast_to(draws.drift.mean(axis=0), draws.trials)
    ripple = np.hypot(draws.ripple_cos, draws.ripple_sin).mean(axis=0)
    return np.broadcast_to(ripple, draws.trials)

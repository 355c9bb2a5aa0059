"""The uncertainty budget: where the uncertainty of a coefficient comes from, line by line."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Final, Literal

import numpy as np

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.inference.joint import encoder
from counterspin.inference.joint.fit import JointFit
from counterspin.inference.joint.unknowns import Considered, Unknown
from counterspin.inference.least_squares import Combination
from counterspin.inference.noise.model import WALK_UNIT

#: Lines below this share of u^2 say nothing.
_NEGLIGIBLE: Final = 1e-12

#: Kinds: what was measured, what the description states, what it does not state and is taken at its
#: typical size, and what is known but not adjusted.
Kind = Literal["noise", "stated", "unstated", "held"]
NOISE: Final = "noise"
STATED: Final = "stated"
UNSTATED: Final = "unstated"
HELD: Final = "held"


#: Units of the parts of a rotation; that of a ripple is rad/s.
_ENCODER_UNITS: Final = {"angle": "rad", "rate": "rad/s", "drift": "1/s"}


@frozen
class BudgetLine:
    """One source of uncertainty (GUM table 1)."""

    #: Name of a term or input; ``noise of Qx``, ``noise of Qx that does not show``; a part of a
    #: run's rotation as its encoder leaves it open, such as ``run1.rate`` or ``run1.ripple1``.
    source: str
    kind: Kind  #: ``noise`` (an encoder's too), ``stated``, ``unstated`` or ``held``.
    #: Standard uncertainty of the source, in `unit`; None for noise. Of noise that does not show in
    #: the records, its level; of a ripple that of its sine and of its cosine.
    u: float | None
    unit: str  #: Of u.
    #: Change of the coefficient per unit of the source; None for noise, which has one for every
    #: sample. Of a ripple, whose sine and cosine are one line, its size.
    sensitivity: float | None
    contribution: float  #: Size of sensitivity × u, in the coefficient's unit.
    share: float  #: Part of the coefficient's u^2, from 0 to 1.


def budget(fit: JointFit, index: int, name: str = "") -> list[BudgetLine]:
    """Return the budget of one unknown; as `budget_of`."""
    return budget_of(fit, np.eye(len(fit.model.unknowns))[index], name)


def budget_of(fit: JointFit, weights: Array, name: str = "") -> list[BudgetLine]:
    """Return the budget of a combination of the unknowns, largest contribution first.

    name: An accelerometer, whose own terms are named without it.
    """
    solution, model = fit.solution, fit.model
    parts = solution.combine(weights)
    lines = [
        BudgetLine(f"noise of {source}", NOISE, None, "", None, share, 0.0)
        for source, share in _noise_by_source(fit, parts.noise_rows).items()
    ]
    for source, (level, covariance) in fit.unseen.items():
        words = f"noise of {source} that does not show"
        size = math.sqrt(float(weights @ covariance @ weights))
        slope = size / level if level else 0.0
        lines.append(BudgetLine(words, NOISE, level, WALK_UNIT, slope, size, 0.0))
    terms = (*model.unknowns, *model.considered)
    sensitivity = (solution.sensitivity_prior, solution.sensitivity_considered)
    slopes = np.concatenate([weights @ each for each in sensitivity])
    sizes = (*parts.prior, *parts.considered)
    rotation: dict[tuple[str, str], list[float]] = {}
    for term, slope, size in zip(terms, map(float, slopes), map(float, sizes), strict=True):
        if term.symbol in encoder.SYMBOLS:
            place = term.owner, encoder.part_of(term.symbol)
            rotation.setdefault(place, []).append(size)
        elif math.isfinite(u := term.prior[1]):
            source = term.name.removeprefix(f"{name}.")
            lines.append(BudgetLine(source, kind_of(term), u, term.unit, slope, abs(size), 0.0))
    lines += _encoder_lines(fit, rotation)
    total = sum(line.contribution**2 for line in lines)
    if total == 0.0:
        return []
    lines = [replace(line, share=line.contribution**2 / total) for line in lines]
    kept = [line for line in lines if line.share > _NEGLIGIBLE]
    return sorted(kept, key=lambda line: -line.contribution)


def kind_of(term: Unknown) -> Kind:
    """Return how something is known of a term of a fit."""
    if isinstance(term, Considered):
        return HELD
    return UNSTATED if term.unstated else STATED


def _encoder_lines(
    fit: JointFit, rotation: Mapping[tuple[str, str], Sequence[float]]
) -> Iterator[BudgetLine]:
    """Yield each part of each run's rotation, whose terms, estimated or held, are one line."""
    errors = {prepared.run: prepared.series.angle_error for prepared in fit.prepared}
    for (run, part), contributions in rotation.items():
        error = errors[run]
        u = error.u[part] if error else 0.0
        size = math.hypot(*contributions) if len(contributions) > 1 else contributions[0]
        slope, unit = size / u if u else 0.0, _ENCODER_UNITS.get(part, "rad/s")
        yield BudgetLine(f"{run}.{part}", NOISE, u, unit, slope, abs(size), 0.0)


def _noise_by_source(fit: JointFit, rows: Array) -> dict[str, float]:
    """Sum the rows' contributions over the observations of each source."""
    squares: dict[str, float] = {}
    start = 0
    for block, one in zip(fit.blocks, fit.observations, strict=True):
        end = start + block.factor.shape[0]
        own = float(np.sum(rows[start:end] ** 2))
        squares[one.source] = squares.get(one.source, 0.0) + own
        start = end
    return {name: math.sqrt(square) for name, square in squares.items()}


def by_kind_of(fit: JointFit, parts: Combination) -> tuple[float, float, float]:
    """Return u of a combination of the unknowns, as of `by_kind`."""
    squares = {NOISE: parts.noise**2 + parts.unseen**2, STATED: 0.0, UNSTATED: 0.0}
    terms = (*fit.model.unknowns, *fit.model.considered)
    for unknown, part in zip(terms, (*parts.prior, *parts.considered), strict=True):
        encoded = unknown.symbol in encoder.SYMBOLS
        squares[NOISE if encoded else UNSTATED if unknown.unstated else STATED] += float(part) ** 2
    of_noise, of_stated, of_unstated = (math.sqrt(square) for square in squares.values())
    return of_noise, of_stated, of_unstated


def by_kind(fit: JointFit, index: int) -> tuple[float, float, float]:
    """Return u of an unknown from noise, from what is stated and from what is not."""
    solution, model = fit.solution, fit.model
    squares: dict[str, float] = {
        NOISE: float(solution.covariance_noise[index, index]),
        STATED: 0.0,
        UNSTATED: 0.0,
    }
    if solution.covariance_unseen is not None:
        squares[NOISE] += float(solution.covariance_unseen[index, index])
    sensitivity = (solution.sensitivity_prior[index], solution.sensitivity_considered[index])
    for unknowns, slopes in zip((model.unknowns, model.considered), sensitivity, strict=True):
        for unknown, slope in zip(unknowns, slopes.tolist(), strict=True):
            if slope != 0.0 and math.isfinite(unknown.prior[1]):
                encoded = unknown.symbol in encoder.SYMBOLS
                kind = NOISE if encoded else UNSTATED if unknown.unstated else STATED
                squares[kind] += (slope * unknown.prior[1]) ** 2
    of_noise, of_stated, of_unstated = (math.sqrt(max(s, 0.0)) for s in squares.values())
    return of_noise, of_stated, of_unstated

"""The uncertainty budget: where u of a coefficient comes from, and what would move it.

What u would be if something were known better or worse is an update, not a refit. Let A be the
covariance that the weights minimise, and D the changes of 1/u^2 of what is known beforehand of the
sources J. The estimates then become M times what they were, with
M = 1 - A_J D (1 + A_JJ D)^-1 e_J^T, and A becomes M A (the information form of a sequential update,
Bierman 1977, chapter V). What is beside the weights, of held terms and of noise that does not show,
goes through the same gain: E becomes M E M^T. A held term weighs nothing: if it were known better,
only what it adds to E would become less, by the square. The noise stays as it was found.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.inference.joint import encoder
from counterspin.inference.joint.fit import JointFit
from counterspin.inference.joint.series import RATE
from counterspin.inference.joint.summary import (
    HELD,
    NOISE,
    STATED,
    UNSTATED,
    BudgetLine,
    Kind,
    WhatIf,
)
from counterspin.inference.joint.unknowns import (
    Considered,
    Unknown,
    unit_of,
)
from counterspin.inference.noise.model import WALK_UNIT

#: Lines below this share of u^2 say nothing.
_NEGLIGIBLE: Final = 1e-12

#: Units of the parts of a rotation; that of a ripple is rad/s.
_ENCODER_UNITS: Final = {"angle": "rad", "rate": "rad/s", "drift": "1/s"}


def budget(fit: JointFit, index: int, name: str = "") -> list[BudgetLine]:
    """Return the budget of one unknown; as `budget_of`."""
    return budget_of(fit, np.eye(len(fit.model.unknowns))[index], name)


def budget_of(fit: JointFit, weights: Array, name: str = "") -> list[BudgetLine]:
    """Return the budget of a combination of the unknowns, largest contribution first.

    name: An accelerometer, whose own terms are named without it.
    """
    solution, model = fit.solution, fit.model
    parts = solution.combine(weights)
    of_rates = [one.rate_variances(fit.solution, weights) for one in fit.observations]
    lines = [
        BudgetLine(f"noise of {source}", NOISE, None, "", None, share, 0.0)
        for source, share in _noise_by_source(fit, parts.noise_rows, of_rates).items()
    ]
    lines += _lines_of_rates(fit, of_rates)
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


def _lines_of_rates(fit: JointFit, of_rates: Sequence[tuple[float, float]]) -> Iterator[BudgetLine]:
    """Yield the random errors of rates that are stated, and those of the default size."""
    kinds: tuple[Kind, ...] = (STATED, UNSTATED)
    for place, (kind, squares) in enumerate(zip(kinds, zip(*of_rates, strict=True), strict=True)):
        size = math.sqrt(sum(squares))
        if size > 0.0:
            u = np.concatenate([one.rate_uncertainties[place] for one in fit.observations])
            typical = math.sqrt(float(np.mean(u[u > 0.0] ** 2)))
            yield BudgetLine(RATE, kind, typical, unit_of(RATE), size / typical, size, 0.0)


def _noise_by_source(
    fit: JointFit, rows: Array, of_rates: Sequence[tuple[float, float]]
) -> dict[str, float]:
    """Sum the rows' contributions over the observations of each source, except those of rates."""
    squares: dict[str, float] = {}
    start = 0
    for block, one, rates in zip(fit.blocks, fit.observations, of_rates, strict=True):
        end = start + block.factor.shape[0]
        own = max(float(np.sum(rows[start:end] ** 2)) - sum(rates), 0.0)
        squares[one.source] = squares.get(one.source, 0.0) + own
        start = end
    return {name: math.sqrt(square) for name, square in squares.items()}


def by_kind_of(fit: JointFit, weights: Array) -> tuple[float, float, float]:
    """Return u of a combination of the unknowns, as of `by_kind`."""
    parts = fit.solution.combine(weights)
    squares = _squares_by_kind(fit, weights, parts.noise**2 + parts.unseen**2)
    terms = (*fit.model.unknowns, *fit.model.considered)
    for unknown, part in zip(terms, (*parts.prior, *parts.considered), strict=True):
        encoded = unknown.symbol in encoder.SYMBOLS
        squares[NOISE if encoded else UNSTATED if unknown.unstated else STATED] += float(part) ** 2
    of_noise, of_stated, of_unstated = (math.sqrt(square) for square in squares.values())
    return of_noise, of_stated, of_unstated


def _squares_by_kind(fit: JointFit, weights: Array, noise: float) -> dict[str, float]:
    """Return a variance of observations by kind: the errors of rates are not noise."""
    of_rates = [one.rate_variances(fit.solution, weights) for one in fit.observations]
    stated, default = (sum(squares) for squares in zip(*of_rates, strict=True))
    return {NOISE: max(noise - stated - default, 0.0), STATED: stated, UNSTATED: default}


def by_kind(fit: JointFit, index: int) -> tuple[float, float, float]:
    """Return u of an unknown from noise, from what is stated and from what is not."""
    solution, model = fit.solution, fit.model
    weights = np.eye(len(model.unknowns))[index]
    noise = float(solution.covariance_noise[index, index])
    squares = _squares_by_kind(fit, weights, noise)
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


# What if ---------------------------------------------------------------------------------------

#: Sources below this share of any u^2 are not asked about, nor more of them than a page has room
#: for.
_LEAST_SHARE: Final = 1e-3
_MOST: Final = 12

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
    unknowns, considered = fit.model.unknowns, fit.model.considered
    terms = {
        term.name.removeprefix(f"{owner}."): (term, place)
        for some in (considered, unknowns)
        for place, term in enumerate(some)
    }
    sources = [
        source
        for source, share in sorted(shares.items(), key=lambda item: -item[1])
        if share >= _LEAST_SHARE
        and source in terms
        # What is exactly known would have to become uncertain first.
        and 0.0 < terms[source][0].prior[1] < math.inf
    ][:_MOST]
    if not sources:
        return None
    names = list(dict.fromkeys([*(symbol for symbol in places if symbol in budget), *sources]))
    # A held term has a row of zeros: no weights know of it.
    rows = np.zeros((len(names), len(unknowns)))
    held = {}
    for row, name in zip(rows, names, strict=True):
        term, place = terms[name]
        if isinstance(term, Considered):
            held[name] = place
        else:
            row[place] = 1.0
    # From the factors: what the weights take the covariance for, whatever the noise turned out.
    root = fit.solution.root_of(rows)
    weighed = root @ root.T
    beside = rows @ fit.solution.covariance @ rows.T - weighed
    moved = rows @ fit.solution.sensitivity_considered
    return WhatIf(
        names=names,
        units=[terms[name][0].unit for name in names],
        known={source: terms[source][0].prior[1] for source in sources},
        weighed=weighed.tolist(),
        beside=beside.tolist() if _counts(beside, weighed) else [],
        held={name: (considered[k].prior[1] * moved[:, k]).tolist() for name, k in held.items()},
    )


def _counts(beside: Array, weighed: Array) -> bool:
    size = np.sqrt(np.diag(weighed))
    return bool(np.any(np.abs(beside) > _ROUNDING * np.outer(size, size)))

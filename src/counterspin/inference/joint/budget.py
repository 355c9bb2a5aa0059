"""The uncertainty budget: where the uncertainty of a coefficient comes from, line by line.

- `budget`: one line for the records' noise of each accelerometer, one for noise that they do not
  show, one for each prior, each considered term, each uncertain input and each part of a run's
  recorded rotation; the squares of the contributions add up to u^2
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.inference.joint import encoder
from counterspin.inference.joint.fit import JointFit
from counterspin.inference.joint.unknowns import Unknown
from counterspin.inference.least_squares import Combination

#: Lines below this share of u^2 say nothing.
_NEGLIGIBLE: Final = 1e-12

NOISE: Final = "noise"  #: kind of a line that stands for the records
UNSEEN: Final = "unseen"  #: kind of a line that stands for noise that the records do not show
ENCODER: Final = "encoder"  #: kind of a line that stands for a run's recorded angle


@frozen
class Line:
    """One source of uncertainty (GUM table 1).

    Attributes
    ----------
    source
        Name of the unknown, considered term or input; for noise the accelerometer's; for the
        encoder the run's and ``angle``, ``rate``, ``drift`` or ``ripple1`` ...
    kind
        ``noise``, ``unseen``, ``prior``, ``considered``, ``input`` or ``encoder``.
    u
        Standard uncertainty of the source, in its own unit; None for noise.
    sensitivity
        d(coefficient)/d(source); None for noise, which has one for every sample. Of a ripple, whose
        sine and cosine are one line, its size.
    contribution
        |sensitivity| x u, in the coefficient's unit.
    share
        Part of u^2.
    """

    source: str
    kind: str
    u: float | None
    sensitivity: float | None
    contribution: float
    share: float


def budget(fit: JointFit, index: int) -> tuple[Line, ...]:
    """Return the budget of one unknown, largest contribution first.

    Parameters
    ----------
    fit
        The solved problem.
    index
        Which unknown.
    """
    solution, model = fit.solution, fit.model
    weights = np.zeros(len(model.unknowns))
    weights[index] = 1.0
    parts = solution.combine(weights)
    lines = [
        Line(name, NOISE, None, None, share, 0.0)
        for name, share in _noise_by_accelerometer(fit, parts.noise_rows).items()
    ]
    for name, (level, covariance) in fit.unseen.items():
        size = math.sqrt(float(covariance[index, index]))
        lines.append(Line(name, UNSEEN, level, size / level if level else 0.0, size, 0.0))
    for j, unknown in enumerate(model.unknowns):
        if math.isfinite(unknown.prior[1]) and unknown.symbol not in encoder.SYMBOLS:
            sensitivity = float(solution.sensitivity_prior[index, j])
            lines.append(
                Line(unknown.name, "prior", unknown.prior[1], sensitivity, abs(parts.prior[j]), 0.0)
            )
    inputs = model.inputs or {}
    encoded = {other.name for other in model.considered if other.symbol in encoder.SYMBOLS}
    for k, (name, u) in enumerate(zip(model.considered_names, model.considered_sizes, strict=True)):
        if name in encoded:
            continue
        kind = "input" if name in inputs else "considered"
        sensitivity = float(solution.sensitivity_considered[index, k])
        lines.append(Line(name, kind, u, sensitivity, abs(float(parts.considered[k])), 0.0))
    lines += _encoder_lines(fit, parts)
    total = sum(line.contribution**2 for line in lines)
    if total == 0.0:
        return ()
    lines = [replace(line, share=line.contribution**2 / total) for line in lines]
    kept = [line for line in lines if line.share > _NEGLIGIBLE]
    return tuple(sorted(kept, key=lambda line: -line.contribution))


def _encoder_lines(fit: JointFit, parts: Combination) -> list[Line]:
    """Join the terms of each part of each run's rotation, estimated or considered."""
    signed: dict[tuple[str, str], list[float]] = {}
    terms: list[tuple[Unknown, float]] = [
        *zip(fit.model.unknowns, parts.prior, strict=True),
        *zip(fit.model.considered, parts.considered, strict=False),
    ]
    for other, contribution in terms:
        if other.symbol in encoder.SYMBOLS:
            place = other.owner, encoder.part_of(other.symbol)
            signed.setdefault(place, []).append(float(contribution))
    errors = {prepared.run: prepared.series.angle_error for prepared in fit.prepared}
    lines = []
    for (run, part), contributions in signed.items():
        error = errors[run]
        u = error.u[part] if error else 0.0
        size = math.hypot(*contributions) if len(contributions) > 1 else contributions[0]
        sensitivity = size / u if u else 0.0
        lines.append(Line(f"{run}.{part}", ENCODER, u, sensitivity, abs(size), 0.0))
    return lines


def _noise_by_accelerometer(fit: JointFit, rows: Array) -> dict[str, float]:
    """Sum the rows' contributions over the blocks of each accelerometer, and of each other."""
    squares: dict[str, float] = {}
    start = 0
    names = [*(prepared.accelerometer for prepared in fit.prepared), *fit.beside]
    for block, name in zip([*fit.blocks, *fit.beside.values()], names, strict=True):
        end = start + block.factor.shape[0]
        squares[name] = squares.get(name, 0.0) + float(np.sum(rows[start:end] ** 2))
        start = end
    return {name: math.sqrt(square) for name, square in squares.items()}

"""The uncertainty budget: where the uncertainty of a coefficient comes from, line by line."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final, Literal

import numpy as np

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.inference.joint import encoder
from counterspin.inference.joint.fit import JointFit
from counterspin.inference.joint.unknowns import Unknown
from counterspin.inference.least_squares import Combination

#: Lines below this share of u^2 say nothing.
_NEGLIGIBLE: Final = 1e-12

#: Kinds: what was measured, what the description states, what it does not state and is taken at its
#: typical size, and what is known but not adjusted.
Kind = Literal["noise", "stated", "unstated", "held"]
NOISE: Final = "noise"
STATED: Final = "stated"
UNSTATED: Final = "unstated"
HELD: Final = "held"


@frozen
class Line:
    """One source of uncertainty (GUM table 1)."""

    #: Name of the unknown or held term; for noise the accelerometer's; for the encoder the run's
    #: and ``angle``, ``rate``, ``drift`` or ``ripple1`` ...
    source: str
    kind: Kind  #: `NOISE` (an encoder's too), `STATED`, `UNSTATED` or `HELD`.
    u: float | None  #: Standard uncertainty of the source, in its own unit; None for noise.
    #: d(coefficient)/d(source); None for noise, which has one for every sample. Of a ripple, whose
    #: sine and cosine are one line, its size.
    sensitivity: float | None
    contribution: float  #: |sensitivity| x u, in the coefficient's unit.
    share: float  #: Part of u^2.
    #: Of noise: whether it does not show in the records. `u` is its level, (m/s^2)/Hz^0.5.
    hidden: bool = False
    #: Whether u is a typical size that the description does not state; of a held term, too.
    unstated: bool = False


def budget(fit: JointFit, index: int) -> tuple[Line, ...]:
    """Return the budget of one unknown, largest contribution first."""
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
        slope = size / level if level else 0.0
        lines.append(Line(name, NOISE, level, slope, size, 0.0, hidden=True))
    for j, unknown in enumerate(model.unknowns):
        if math.isfinite(unknown.prior[1]) and unknown.symbol not in encoder.SYMBOLS:
            kind: Kind = UNSTATED if unknown.unstated else STATED
            sensitivity = float(solution.sensitivity_prior[index, j])
            size = abs(float(parts.prior[j]))
            lines.append(_of(unknown, kind, sensitivity, size))
    for k, held in enumerate(model.considered):
        if held.symbol not in encoder.SYMBOLS:
            sensitivity = float(solution.sensitivity_considered[index, k])
            lines.append(_of(held, HELD, sensitivity, abs(float(parts.considered[k]))))
    lines += _encoder_lines(fit, parts)
    total = sum(line.contribution**2 for line in lines)
    if total == 0.0:
        return ()
    lines = [replace(line, share=line.contribution**2 / total) for line in lines]
    kept = [line for line in lines if line.share > _NEGLIGIBLE]
    return tuple(sorted(kept, key=lambda line: -line.contribution))


def _of(unknown: Unknown, kind: Kind, sensitivity: float, size: float) -> Line:
    return Line(
        unknown.name, kind, unknown.prior[1], sensitivity, size, 0.0, unstated=unknown.unstated
    )


def _encoder_lines(fit: JointFit, parts: Combination) -> list[Line]:
    """Join the terms of each part of each run's rotation, estimated or considered."""
    signed: dict[tuple[str, str], list[float]] = {}
    terms: list[tuple[Unknown, float]] = [
        *zip(fit.model.unknowns, parts.prior, strict=True),
        *zip(fit.model.considered, parts.considered, strict=True),
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
        lines.append(Line(f"{run}.{part}", NOISE, u, sensitivity, abs(size), 0.0))
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

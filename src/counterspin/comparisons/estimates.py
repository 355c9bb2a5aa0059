"""What a result says of one accelerometer, with its uncertainty taken apart by source."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from counterspin.arrays import Array
from counterspin.calibration.result import Result
from counterspin.calibration.result_parts import Coefficient
from counterspin.frozen import frozen
from counterspin.physics.terms import TERMS, mounting_of


@frozen(eq=False)
class SharedSource:
    """One thing that is known with an uncertainty and moves estimates."""

    estimated: bool  #: Whether it was weighed with the data; else it was held.
    #: Its value, where the result says it, and its standard uncertainty.
    stated: tuple[float | None, float]
    moves: Array  #: Signed: what its standard uncertainty moves each estimate by, shape (p,).
    of_run: bool  #: Whether it belongs to one run or mounting, as a tilt or a misalignment does.

    def is_as(self, other: SharedSource) -> bool:
        """Return whether another is stated alike, as far as the results say it."""
        return self.is_as_sure_as(other) and not self.is_another(other)

    def is_as_sure_as(self, other: SharedSource) -> bool:
        """Return whether another has the same standard uncertainty."""
        return bool(np.isclose(self.stated[1], other.stated[1], rtol=1e-9, atol=0.0))

    def is_another(self, other: SharedSource) -> bool:
        """Return whether another is stated with another value, and so was measured anew."""
        return None not in (self.stated[0], other.stated[0]) and self.stated[0] != other.stated[0]


@frozen(eq=False)
class Estimates:
    """Estimates of one accelerometer, p of them."""

    symbols: tuple[str, ...]  #: Of the terms.
    value: Array  #: Shape (p,).
    covariance: Array  #: All of it, shape (p, p).
    #: By name: what is stated, what is not, what is held, and recorded rotations.
    sources: dict[str, SharedSource]
    #: Whether the sources and correlations are known; else what is held is only known as a sum, in
    #: `held`, and the covariance may be without its correlations.
    complete: bool
    held: Array  #: Root of the sum of squares of all that is held, shape (p,).

    def part(self, *, estimated: bool) -> Array:
        """Return what was weighed with the data, or all that is held, contributes."""
        if not self.complete and not estimated:
            return np.diag(self.held**2)
        moves = [s.moves for s in self.sources.values() if s.estimated is estimated]
        return squares(moves, len(self.symbols))


def squares(moves: Sequence[Array], size: int) -> Array:
    """Return the covariance of independent sources from what each moves, shape (size, size)."""
    if not moves:
        return np.zeros((size, size))
    stacked = np.stack(moves)
    covariance: Array = stacked.T @ stacked
    return covariance


def g_units_ratio(symbol: str, own: float, other: float) -> float:
    """Return the number of a term in g-units of another gravity over that in its own.

    A coefficient of n factors is in g/g^n, and so goes with g^(1 - n).
    """
    return (own / other) ** (1 - len(TERMS[symbol].effect.factors)) if symbol in TERMS else 1.0


def estimates_of(
    result: Result, name: str, symbols: Sequence[str], gravity: float | None = None
) -> Estimates:
    """Return what a result says of some of an accelerometer's terms.

    gravity: Whose g-units to have the numbers in, m/s^2; None: the result's own.
    """
    accelerometer = result.accelerometers[name]
    own = [accelerometer.coefficients[symbol] for symbol in symbols]
    own_gravity = result.inputs.gravity
    given = own_gravity if gravity is None else gravity
    factor = np.array([g_units_ratio(s, own_gravity, given) for s in symbols])
    u = np.array([c.u or 0.0 for c in own])
    correlation = np.eye(len(own))
    stated = accelerometer.correlation
    known = stated is not None and set(symbols) <= set(stated.terms)
    if stated is not None and known:
        correlation = stated[list(symbols)]
    sources = {
        source: _scaled(shared, factor)
        for source, shared in _sources(result, name, symbols).items()
    }
    return Estimates(
        symbols=tuple(symbols),
        value=factor * np.array([c.value or 0.0 for c in own]),
        covariance=np.outer(factor * u, factor * u) * correlation,
        sources=sources,
        complete=known and all(accelerometer.budget.get(symbol) for symbol in symbols),
        held=factor * np.array([_held(result, c) for c in own]),
    )


def _held(result: Result, coefficient: Coefficient) -> float:
    """Return what may have been held: in two stages all that is known, else nothing."""
    if result.method != "two-stage":
        return 0.0
    return math.hypot(coefficient.u_stated or 0.0, coefficient.u_unstated or 0.0)


def _scaled(source: SharedSource, factor: Array) -> SharedSource:
    return SharedSource(source.estimated, source.stated, source.moves * factor, source.of_run)


def _sources(result: Result, name: str, symbols: Sequence[str]) -> dict[str, SharedSource]:
    accelerometer = result.accelerometers[name]
    sources: dict[str, SharedSource] = {}
    for place, symbol in enumerate(symbols):
        for line in accelerometer.budget.get(symbol, ()):
            if line.u is None or line.sensitivity is None:
                continue
            source = sources.get(line.source)
            if source is None:
                source = sources[line.source] = SharedSource(
                    # What the encoder leaves open of a rotation is the same in every fit.
                    estimated=line.kind in ("stated", "unstated"),
                    stated=(_value(result, name, line.source), line.u),
                    moves=np.zeros(len(symbols)),
                    of_run=bool(mounting_of(line.source))
                    or any(line.source.startswith(f"{run}.") for run in result.runs),
                )
            source.moves[place] = line.sensitivity * line.u
    return sources


def _value(result: Result, name: str, source: str) -> float | None:
    """Return the value of an input or of what is known beforehand, where the result says it."""
    inputs, accelerometer = result.inputs, result.accelerometers[name]
    stated = {
        "centrifuge.radius": inputs.radius,
        "site.gravity": inputs.gravity,
        "site.latitude": inputs.latitude,
    }
    if source in stated:
        return stated[source]
    if source in accelerometer.known:
        return accelerometer.known[source].value
    for known in result.rests_on:
        if known.name in (source, f"{name}.{source}"):
            return known.value
    coefficient = accelerometer.coefficients.get(source)
    return None if coefficient is None or coefficient.estimated else coefficient.value

"""Estimates of an accelerometer in two results, shared sources, and covariance of the difference.

Two estimates of the same records have most of their error in common. Where one of them is the best
linear unbiased estimate from the common data (the smaller of two nested models, or the result from
all records if the other uses some of them), the covariance of the two is its own variance, so that
variances subtract (J. A. Hausman, Econometrica 46 (1978) 1251, lemma 2.1). Considered terms
move each estimate by its own sensitivity. Results of other records share the sources with equal
statements: the radius, gravity, priors. A term that is not stated is the same for an instrument and
its machine in all their results, so results with the same default standard uncertainty share it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final, Literal

import numpy as np

from counterspin.arrays import Array
from counterspin.calibration.result import Result
from counterspin.calibration.result_parts import Coefficient
from counterspin.comparisons.rerun import terms_of
from counterspin.frozen import frozen
from counterspin.inference.distributions import chi_square_tail
from counterspin.physics.terms import TERMS, mounting_of

#: Part of a variance below which a difference of variances is rounding.
NEGLIGIBLE: Final = 1e-9

#: Part of u below which two values differ by rounding.
_ROUNDING: Final = 1e-6

#: Part of a variance from which a source that both results share is named.
_SAID: Final = 1e-3


@frozen
class Relation:
    """The relation of two results: common records, better estimate, noise ratio."""

    #: Whether their records are the ``same``, some are (``part``), or they are ``independent``.
    records: Literal["same", "part", "independent"]
    #: Place of the result whose estimate is the best of what both rest on, 0 or 1, or None: nothing
    #: says which; the one with the smaller variance is then taken for it.
    better: Literal[0, 1] | None = None
    #: Whether both weigh the same records in the same way, so that noise moves them alike.
    alike: bool = False
    #: Noise of the first result over that of the second, where it was estimated in both.
    noise_ratio: float = 1.0


def covariance_of_difference(
    first: Estimates, second: Estimates, relation: Relation
) -> tuple[Array, list[str]]:
    """Return the covariance of second minus first, and the names of the shared sources."""
    partial_overlap = relation.records == "part" and relation.better is None
    if relation.records == "independent" or partial_overlap:
        return _independent_covariance(first, second)
    return _common_record_covariance(first, second, relation)


def _independent_covariance(first: Estimates, second: Estimates) -> tuple[Array, list[str]]:
    covariance = first.covariance + second.covariance
    shared = []
    for name, source in first.sources.items():
        counterpart = second.sources.get(name)
        if counterpart is not None and not source.of_run and source.is_as(counterpart):
            cross = np.outer(source.moves, counterpart.moves)
            covariance = covariance - cross - cross.T
            if np.any(np.abs(np.diag(cross)) > _SAID * np.diag(first.covariance)):
                shared.append(name)
    return covariance, shared


def _common_record_covariance(
    first: Estimates, second: Estimates, relation: Relation
) -> tuple[Array, list[str]]:
    better, worse = (first, second) if relation.better != 1 else (second, first)
    size = len(first.symbols)
    if not (first.complete and second.complete):
        # The sensitivities are unknown: all considered terms are assumed to move both alike.
        rest = [np.diag(e.covariance) - e.held**2 for e in (first, second)]
        if relation.alike:
            rest = [np.zeros(size), np.zeros(size)]
        difference = np.abs(rest[0] - rest[1]) + (first.held - second.held) ** 2
        return np.diag(difference), []
    in_both, unshared = list[tuple[SharedSource, SharedSource]](), list[Array]()
    anew = list[tuple[Array, Array]]()
    shared = []
    for name, source in better.sources.items():
        its = worse.sources.get(name)
        if source.estimated:
            # A new measurement does not belong to the common data.
            if its is not None and its.estimated and source.is_another(its):
                anew.append((source.moves, its.moves))
        elif its is not None and source.is_as(its):
            in_both.append((source, its))
            shared.append(name)
        else:
            unshared.append(source.moves)
    # Stated otherwise, or left out by the better one: by itself in the other.
    alone = [
        source.moves
        for name, source in worse.sources.items()
        if not (source.estimated or name in shared or _estimated(better, name))
    ]
    own_anew, their_anew = (squares([moves[i] for moves in anew], size) for i in (0, 1))
    worse_covariance = worse.covariance - their_anew
    worse_covariance = worse_covariance - squares(
        [*(its.moves for _, its in in_both), *alone], size
    )
    better_covariance = better.covariance - own_anew - better.part(estimated=False)
    if relation.noise_ratio != 1.0:
        ratio = relation.noise_ratio if better is second else 1.0 / relation.noise_ratio
        priors = better.part(estimated=True) - own_anew
        better_covariance = priors + ratio**2 * (better_covariance - priors)
    scale = np.sqrt(np.diag(first.covariance) + np.diag(second.covariance))
    excess = np.zeros((size, size))
    if not relation.alike:
        excess = _size_of(
            (worse_covariance - better_covariance) / np.outer(scale, scale)
        ) * np.outer(scale, scale)
    moved = squares([its.moves - source.moves for source, its in in_both], size)
    return excess + moved + squares([*unshared, *alone], size) + own_anew + their_anew, shared


def _estimated(estimates: Estimates, name: str) -> bool:
    return name in estimates.sources and estimates.sources[name].estimated


def _size_of(matrix: Array) -> Array:
    """Return a symmetric matrix with its negative eigenvalues positive.

    There are none where the better estimate is the better one.
    """
    values, vectors = np.linalg.eigh(0.5 * (matrix + matrix.T))
    values = np.where(np.abs(values) > NEGLIGIBLE, np.abs(values), 0.0)
    size: Array = (vectors * values) @ vectors.T
    return size


def chi_square(
    difference: Array, covariance: Array, scale: Array
) -> tuple[float, int, float | None]:
    """Return chi-square of a difference, its degrees of freedom and the probability of more.

    difference: Shape (p,).
    covariance: Of it, shape (p, p); as many degrees of freedom as directions in which it is not
        negligible.
    scale: Standard uncertainties, relative to which a variance is negligible, shape (p,).
    """
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    significant = values > 2.0 * NEGLIGIBLE
    along = vectors.T @ (difference / scale)
    chi2 = float(np.sum(along[significant] ** 2 / values[significant]))
    dof = int(np.count_nonzero(significant))
    return chi2, dof, chi_square_tail(dof, chi2) if dof and math.isfinite(chi2) else None


@frozen(eq=False)
class SharedSource:
    """A source of uncertainty that moves estimates."""

    estimated: bool  #: Whether it was weighed with the data; else it was held.
    #: Its value, where the result says it, and its standard uncertainty.
    stated: tuple[float | None, float]
    moves: Array  #: Signed shift of each estimate by its standard uncertainty, shape (p,).
    of_run: bool  #: Whether it belongs to one run or mounting, as a tilt or a misalignment does.

    def is_as(self, other: SharedSource) -> bool:
        """Check that another source has an equal statement, as far as the results state it."""
        return self.is_as_sure_as(other) and not self.is_another(other)

    def is_as_sure_as(self, other: SharedSource) -> bool:
        """Check that another source has the same standard uncertainty."""
        return bool(np.isclose(self.stated[1], other.stated[1], rtol=1e-9, atol=0.0))

    def is_another(self, other: SharedSource) -> bool:
        """Check that another source has a different value, which means a new measurement."""
        return None not in (self.stated[0], other.stated[0]) and self.stated[0] != other.stated[0]


@frozen(eq=False)
class Estimates:
    """Estimates of one accelerometer, p of them."""

    symbols: tuple[str, ...]  #: Of the terms.
    value: Array  #: Shape (p,).
    covariance: Array  #: All of it, shape (p, p).
    #: By name: stated and default priors, considered terms, and recorded rotations.
    sources: dict[str, SharedSource]
    #: Whether the sources and correlations are known; else what is held is only known as a sum, in
    #: `held`, and the covariance may be without its correlations.
    complete: bool
    held: Array  #: Root of the sum of squares of all that is held, shape (p,).

    def part(self, *, estimated: bool) -> Array:
        """Return the covariance due to the estimated sources, or due to the considered ones."""
        if not self.complete and not estimated:
            return np.diag(self.held**2)
        moves = [s.moves for s in self.sources.values() if s.estimated is estimated]
        return squares(moves, len(self.symbols))


def squares(moves: Sequence[Array], size: int) -> Array:
    """Return the covariance of independent sources from the shifts by each, shape (size, size)."""
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
    """Return the estimates of some of an accelerometer's terms from a result.

    gravity: Gravity of the g-units of the numbers, m/s^2; None: the result's own.
    """
    accelerometer = result.accelerometers[name]
    coefficients = [accelerometer.coefficients[symbol] for symbol in symbols]
    own_gravity = result.inputs.gravity
    given = own_gravity if gravity is None else gravity
    factor = np.array([g_units_ratio(s, own_gravity, given) for s in symbols])
    u = np.array([c.u or 0.0 for c in coefficients])
    correlation = np.eye(len(coefficients))
    stated = accelerometer.correlation
    known = stated is not None and set(symbols) <= set(stated.terms)
    if stated is not None and known:
        places = [stated.terms.index(symbol) for symbol in symbols]
        correlation = np.array(stated.matrix)[np.ix_(places, places)]
    sources = {
        source: _scale_source(shared, factor)
        for source, shared in _sources(result, name, symbols).items()
    }
    return Estimates(
        symbols=tuple(symbols),
        value=factor * np.array([c.value or 0.0 for c in coefficients]),
        covariance=np.outer(factor * u, factor * u) * correlation,
        sources=sources,
        complete=known and all(accelerometer.budget.get(symbol) for symbol in symbols),
        held=factor * np.array([_considered_u(result, c) for c in coefficients]),
    )


def _considered_u(result: Result, coefficient: Coefficient) -> float:
    """Return u of the possibly considered terms: in two stages of all priors, else zero."""
    if result.method != "two-stage":
        return 0.0
    return math.hypot(coefficient.u_stated or 0.0, coefficient.u_unstated or 0.0)


def _scale_source(source: SharedSource, factor: Array) -> SharedSource:
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
    """Return the value of an input or of a prior, if the result states it."""
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


def records_of(result: Result) -> frozenset[str]:
    """Return the checksums of the input files of a result, except its description."""
    return frozenset(
        checksum
        for file, checksum in result.provenance.inputs.items()
        if not file.endswith(".toml") and checksum.startswith("sha256:")
    )


def relation_of(
    name: str, results: tuple[Result, Result], estimates: tuple[Estimates, Estimates]
) -> tuple[Relation, list[str]]:
    """Return the relation of two results of an accelerometer, and the assumptions in words."""
    first, second = results
    records = records_of(first), records_of(second)
    assumed = []
    if not all(e.complete for e in estimates):
        assumed.append(
            "One of the results has no uncertainty budget or no correlations, "
            "so the terms are compared as if they were uncorrelated."
        )
    if not all(records):
        assumed.append("A result names no records: the two are assumed independent.")
    if not records[0] & records[1]:
        assumed.append(
            "Radius, gravity and priors that both results state alike count "
            "as one measurement; everything else is assumed independent."
        )
        return Relation("independent"), assumed
    kind: Literal["same", "part"] = "same" if records[0] == records[1] else "part"
    better = _better(results, records, estimates)
    alike = kind == "same" and better is not None and _alike(name, results, estimates)
    if better is None and kind == "part":
        assumed.append(
            "The results share some records, but neither uses all records of the other: they are "
            "assumed independent, which overestimates the uncertainty of a difference."
        )
    elif first.model != second.model:
        assumed.append(
            "One of the results comes from the equations as printed, which estimate something "
            "else: the uncertainty of a difference has little meaning."
        )
    elif better is None:
        assumed.append(
            "Neither model is part of the other, or the priors differ: the result with the "
            "smaller variance is assumed to be the best estimate from these records, "
            "so that the variances subtract."
        )
    elif first.method != second.method:
        assumed.append(
            "The joint method is assumed to be the best estimate from these records, "
            "so that the variances subtract."
        )
    elif not alike and _noise(name, first) != _noise(name, second):
        assumed.append(
            "The stated noise differs: the variances are subtracted although "
            "the weights differ too."
        )
    return Relation(kind, better, alike, _noise_ratio(name, first, second)), assumed


def _better(
    results: tuple[Result, Result],
    records: tuple[frozenset[str], frozenset[str]],
    estimates: tuple[Estimates, Estimates],
) -> Literal[0, 1] | None:
    """Return the index of the best linear unbiased estimate from the common data, or None.

    It has all records of the other, no term that the other lacks, and the same priors.
    """
    first, second = results
    if first.model != second.model:
        return None
    if first.method != second.method:
        return (0 if first.method == "joint" else 1) if records[0] == records[1] else None
    first_sources, second_sources = (e.sources for e in estimates)
    if any(
        s.estimated and n in second_sources and not _same_prior(n, first_sources, second_sources)
        for n, s in first_sources.items()
    ):
        return None
    of_runs = set(first.runs) ^ set(second.runs)
    terms = [{term for term in terms_of(r) if term.split(".")[0] not in of_runs} for r in results]
    if records[0] >= records[1] and terms[0] <= terms[1]:
        return 0
    if records[1] >= records[0] and terms[1] <= terms[0]:
        return 1
    return None


def _same_prior(
    name: str, first: Mapping[str, SharedSource], second: Mapping[str, SharedSource]
) -> bool:
    its = second[name]
    return not its.estimated or first[name].is_as(its) or first[name].is_another(its)


def _alike(
    name: str, results: tuple[Result, Result], estimates: tuple[Estimates, Estimates]
) -> bool:
    first, second = results
    first_sources, second_sources = (e.sources for e in estimates)
    estimated = [
        {n for n, s in sources.items() if s.estimated}
        for sources in (first_sources, second_sources)
    ]
    return (
        first.method == second.method
        and first.model == second.model
        and first.provenance.options == second.provenance.options
        and terms_of(first) == terms_of(second)
        and estimated[0] == estimated[1]
        and all(first_sources[n].is_as_sure_as(second_sources[n]) for n in estimated[0])
        and _noise(name, first) == _noise(name, second)
    )


def _noise(name: str, result: Result) -> dict[str, float | None]:
    """Return the noise sizes that affect the weights: none for white noise alone."""
    lines = result.accelerometers[name].noise
    if len(lines) == 1:
        return dict.fromkeys(lines)
    return {part: None if line.estimated else line.value for part, line in lines.items()}


def _noise_ratio(name: str, first: Result, second: Result) -> float:
    first_noise, second_noise = (result.accelerometers[name].noise for result in (first, second))
    if len(first_noise) != 1 or set(first_noise) != set(second_noise):
        return 1.0
    ((part, line),) = first_noise.items()
    return line.value / second_noise[part].value if line.value and second_noise[part].value else 1.0


def by_the_joint_check(
    name: str,
    results: tuple[Result, Result],
    estimates: tuple[Estimates, Estimates],
    covariance: Array,
) -> Array:
    """Return a covariance with the u that a joint result itself states of the two methods."""
    for joint, two_stage in (results, results[::-1]):
        check = joint.accelerometers[name].two_stage
        coefficient = two_stage.accelerometers[name].coefficients.get("K_II")
        if (
            joint.method != "joint"
            or two_stage.method != "two-stage"
            or not check
            or not coefficient
        ):
            continue
        # The same estimate, except for the rounding of sums in each result.
        same = (
            coefficient.value is not None
            and abs(coefficient.value - check.value) <= _ROUNDING * check.u
        )
        if same and "K_II" in estimates[0].symbols:
            place = estimates[0].symbols.index("K_II")
            covariance = covariance.copy()
            covariance[place, place] = check.u_difference**2
    return covariance

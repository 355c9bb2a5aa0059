"""What faults that a model does not know would shift, and how large each of them may become.

A fault is a term of the table that is assumed to be perfect, at its typical size. Each
moves the estimates, and leaves something in the residuals; where that is too little, the plan
cannot notice it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from counterspin.arrays import Array, triangle_of
from counterspin.calibration.model import assumed_of, model_of
from counterspin.campaign.description import Campaign
from counterspin.campaign.runs import sample_count
from counterspin.campaign.triads.grouped import all_groups
from counterspin.frozen import frozen
from counterspin.inference.blocks import Block
from counterspin.inference.joint.fit import solve_blocks
from counterspin.inference.joint.prepared import Prepared, prepare_columns, prepared_for
from counterspin.inference.joint.series import INPUTS, TIMING, Series
from counterspin.inference.joint.unknowns import ROTATION, Considered, Unknowns, unit_of
from counterspin.inference.linear_readings import blocks_at
from counterspin.physics.terms import MOTION_TERMS, term
from counterspin.planning.forecast import Forecast, expected_values, scale_factors
from counterspin.planning.possibilities import Places
from counterspin.planning.result import Requirement

#: A fault that adds this part of u in quadrature makes u grow by a twentieth.
_TOLERABLE_PART_OF_U: Final = math.sqrt(1.05**2 - 1.0)

#: The inputs of which something is required.
_INPUTS: Final = ("centrifuge.radius", TIMING)

#: No centrifuge has larger faults; a length is a part of the radius.
_LARGEST_SIZES: Final = {"rad": 0.1, "s": 1.0, "1/s": 1e-2, "1": 0.1}


def requirements_of(
    prediction: Forecast, name: str, sampling_rate: float
) -> tuple[str, list[Requirement]]:
    """Return how good the centrifuge must be for the uncertainty that is predicted.

    Each fault by itself, at the size given, makes u of the coefficient grow by a twentieth.

    sampling_rate: Hz.
    """
    campaign = prediction.campaign
    paths = [of_path(symbol) for symbol in ("encoder.harmonic.1", "centrifuge.imbalance.1")]
    # A fit that has a fault among its unknowns gives way to it: it says nothing of its own need.
    symbols = {part.symbol for fault in paths for part in fault.parts}
    before = prediction.fit
    model = before.model.without({*symbols, *INPUTS, TIMING})
    prepared = prepared_for(before.prepared, before.model, model, scale_factors(campaign), {})
    fit = replace(before, model=model, observations=prepared)
    place = [unknown.name for unknown in model.unknowns].index(name)
    unknown = model.unknowns[place]
    expected = expected_values(campaign, model.unknowns)
    words = f"at the expected value of {name}"
    if expected[place] == 0.0:
        expected[place] = unknown.limit
        unit = unit_of(unknown.symbol)
        words = f"if {name} had its largest credible value, {unknown.limit:.3g} {unit}"
    # A fault of the rotation has its own size in each run.
    owners = {symbol: [run.name for run in campaign.runs] for symbol in ROTATION}
    owners |= {symbol: [""] for symbol in _INPUTS}
    faults = [
        Fault(symbol, "", 1.0, "", tuple(perfect(owner, symbol) for owner in of))
        for symbol, of in owners.items()
    ]
    found = sensitivities(replace(prediction, fit=fit), [*faults, *paths], expected)
    zero, rate, drift, radius, delay, *machine = (one.moved[place] for one in found)
    rates = np.array([run.rate for run in campaign.runs])
    lines = [
        ("radius", radius, "m"),
        ("drift of the rate that the recorded angle does not show", drift, "1/s"),
        ("rate, relative, the same error in all runs", rate @ rates, "1"),
        ("zero of the angle, new in each run", zero, "rad"),
        (
            "noise of the angle, per sample",
            _angle_noise(campaign, np.column_stack([zero, rate, drift]), sampling_rate),
            "rad",
        ),
        (f"{paths[0].words}, the same in all runs", machine[0], "rad"),
        (paths[1].words, machine[1], "m"),
        ("delay between the clocks of angle and output", delay, "s"),
    ]
    allowed = _TOLERABLE_PART_OF_U * prediction.u[name]
    largest = {**_LARGEST_SIZES, "m": _LARGEST_SIZES["1"] * campaign.radius.value}
    return words, [
        Requirement(
            words=text,
            size=size if (size := _over(allowed, moved)) <= largest[unit] else None,
            unit=unit,
        )
        for text, moved, unit in lines
    ]


def _over(allowed: float, moved: Array | float) -> float:
    """Return the size of a fault whose parts, one unit each, move the coefficient so."""
    sensitivity = float(np.linalg.norm(moved))
    return allowed / sensitivity if sensitivity > 0.0 else math.inf


def _angle_noise(campaign: Campaign, of_run: Array, sampling_rate: float) -> float:
    """Return the sensitivity to white noise of the recorded angle.

    The rotation is fitted to the angle, th0 + w t + C w t^2/2, so that noise of a sample comes in
    through the uncertainty of these three.
    """
    variance = 0.0
    for run, sensitivity in zip(campaign.runs, of_run, strict=True):
        duration = run.duration or 0.0
        n = sample_count(duration, sampling_rate)
        scale = np.array([1.0, 1.0 / duration, 2.0 / (abs(run.rate) * duration**2)])
        a, b, c = (sensitivity * scale).tolist()  # to 1, t and t^2, t from 0 to 1
        # The same of 1, t - 1/2 and (t - 1/2)^2 less its mean, whose products add up to nothing
        # over even samples, and whose squares have these means.
        linear = (n + 1.0) / (12.0 * (n - 1.0))
        square = (n + 1.0) * (n**2 - 4.0) / (180.0 * (n - 1.0) ** 3)
        rest = c - b + a * (0.25 - linear)
        variance += (a**2 + (b - 0.5 * a) ** 2 / linear + rest**2 / square) / n
    return math.sqrt(variance)


@frozen(eq=False)
class Fault:
    """Something that may be wrong, and that the model does not know."""

    #: As the term table has it, or as it would; what it is called.
    symbol: str
    words: str
    #: What to reckon with where nothing is known, SI and g-units.
    size: float
    unit: str
    parts: tuple[Considered, ...]  #: Each has the size.
    #: Whether the parts are independent (each run has its own); else they are cosine and sine of
    #: one amplitude, the worst phase of which is taken.
    random: bool = False
    #: What a record shows of one unit in place of the one part, shape (n,), or None: nothing.
    shown: Callable[[Series], Array | None] | None = None


def _of_family(symbol: str, parts: Sequence[Considered], size: float) -> Fault:
    row = term(parts[0].symbol)
    return Fault(symbol, row.words_of_family, size, row.unit, tuple(parts), random=row.per_run)


def faults_of(campaign: Campaign, name: str) -> list[Fault]:
    """Return what may be wrong for an accelerometer unseen: what is assumed to be perfect."""
    by_symbol: dict[str, list[Considered]] = {}
    for other in assumed_of(campaign, model_of(campaign), name):
        by_symbol.setdefault(term(other.symbol).family, []).append(other)
    return [
        _of_family(symbol, parts, campaign.typical_of(parts[0].symbol, name))
        for symbol, parts in by_symbol.items()
    ]


def of_path(symbol: str) -> Fault:
    """Return an error of the path, both quadratures: such as ``encoder.harmonic.1``."""
    rows = [row for row in MOTION_TERMS.values() if row.family == symbol]
    return _of_family(symbol, [perfect("", row.symbol) for row in rows], rows[0].typical)


def perfect(owner: str, symbol: str) -> Considered:
    """Return a term that is taken as perfect."""
    return Considered(owner, symbol, (0.0, 0.0), 1.0)


def square(name: str) -> Fault:
    """Return K_II of an accelerometer itself, as the estimate is to see it whole."""
    return Fault("K_II", "", 1.0, "g/g^2", (perfect(name, "K_II"),))


def mean_square(name: str) -> Fault:
    """Return what K_II of an accelerometer does to the mean force, without its harmonics."""

    def shown(series: Series) -> Array | None:
        if series.accelerometer != name:
            return None
        motion = series.trajectory
        times = np.arange(16.0) / 16.0 * (2.0 * math.pi / abs(motion.spindle.rate))
        along = motion.specific_force(times) @ series.mounting.turned(series.attitude).input_axis
        mean = float(np.mean((along / motion.site.gravity) ** 2))
        return np.asarray(mean * series.columns(["K_F"], 1.0)[:, 0])

    # Readings are of a mean force: nobody's term shows them nothing.
    return Fault("K_II", "", 1.0, "g/g^2", (perfect("nobody", ""),), shown=shown)


#: Columns of faults that are there at once; of one that each run has anew there is one a run.
_PARTS_AT_ONCE: Final = 16


@frozen(eq=False)
class Sensitivity:
    """What a fault would shift, and what it would leave in the residuals."""

    fault: Fault  #: The fault.
    #: What one unit of each of its parts moves the unknowns by, (p, k).
    moved: Array
    #: The products of what one unit of its parts leaves in the whitened rows and priors once the
    #: fit has followed it as far as it can, (k, k).
    left: Array
    #: By accelerometer, the same in its own whitened residuals, and their degrees of freedom.
    left_in: dict[str, Array]
    freedom: dict[str, float]

    def of_unit(self, place: int) -> float:
        """Return what one unit of the fault moves an unknown by, without sign."""
        return float(np.linalg.norm(self.moved[place]))

    def shift(self, place: int) -> float:
        """Return by how much the fault of its size moves an unknown, without sign."""
        return self.fault.size * self.of_unit(place)

    def deviation(self, place: int) -> float:
        """Return how many standard deviations the best test for this very fault would see."""
        return math.sqrt(self.square(self.left, place))

    def detection(self, place: int, accelerometer: str, significance: float) -> float:
        """Return the probability that the residuals of an accelerometer fail their test."""
        from scipy.special import chdtri, chndtr

        dof = max(1.0, self.freedom[accelerometer])
        square = self.square(self.left_in[accelerometer], place)
        return 1.0 - float(chndtr(chdtri(dof, significance), dof, square))

    def square(self, left: Array, place: int) -> float:
        """Return the sum of squares that the fault of its size leaves, as of `left`.

        Of parts that are one amplitude, in the phase that moves an unknown most.
        """
        size = self.fault.size
        if self.fault.random:
            return size**2 * float(np.trace(left))
        moved = self.moved[place]
        length = float(np.linalg.norm(moved))
        phase = moved / length if length > 0.0 else np.eye(moved.size)[0]
        return max(0.0, size**2 * float(phase @ left @ phase))


def sensitivities(
    prediction: Forecast, faults: Sequence[Fault], expected: Array | None = None
) -> list[Sensitivity]:
    """Return what faults would do to a campaign's fit, each by itself.

    expected: Values of the model's unknowns, less nominal, on which inputs act; None: what
        `expected_values` says.
    """
    if expected is None:
        expected = expected_values(prediction.campaign, prediction.fit.model.unknowns)
    groups: list[list[Fault]] = [[]]
    for fault in faults:
        if groups[-1] and sum(len(f.parts) for f in (*groups[-1], fault)) > _PARTS_AT_ONCE:
            groups.append([])
        groups[-1].append(fault)
    return [one for group in groups for one in _together(prediction, group, expected)]


def _together(prediction: Forecast, faults: Sequence[Fault], expected: Array) -> list[Sensitivity]:
    model, campaign = prediction.fit.model, prediction.campaign
    parts = [(fault, part) for fault in faults for part in fault.parts]
    here = len(model.considered) + np.arange(len(parts))
    extended = Unknowns(model.unknowns, (*model.considered, *(part for _, part in parts)))
    # An input acts on what is expected: nothing else is needed for its column.
    acting = np.flatnonzero(expected)
    on = Unknowns(tuple(model.unknowns[i] for i in acting), model.considered)
    factors = scale_factors(campaign)
    blocks = []
    for record in prediction.fit.prepared:
        # One after the other: the columns of all of them together would take much memory.
        whole = _with_faults(record, parts, on, expected[acting], factors)
        blocks.append(whole.block_in(extended, prediction.fit.noise))
    groups = all_groups(campaign)
    blocks += blocks_at(groups, extended, expected)
    solution = solve_blocks(blocks, extended)
    owners = [record.accelerometer for record in prediction.fit.prepared]
    owners += [group.accelerometer for group in groups]
    moved = -solution.sensitivity_considered[:, here]
    total, left_in = _left(blocks, owners, extended, here)
    ends = np.cumsum([block.factor.shape[0] for block in blocks])
    freedom: dict[str, float] = {}
    followed = np.split(solution.leverages, ends[:-1])
    for owner, block, leverages in zip(owners, blocks, followed, strict=True):
        own = block.rows - block.nuisance - float(leverages.sum())
        freedom[owner] = freedom.get(owner, 0.0) + own
    found = []
    for fault in faults:
        places = np.flatnonzero([owner is fault for owner, _ in parts])
        square = np.ix_(places, places)
        by_accelerometer = {name: own[square] for name, own in left_in.items()}
        found.append(Sensitivity(fault, moved[:, places], total[square], by_accelerometer, freedom))
    return found


def _with_faults(
    record: Prepared,
    faults: Sequence[tuple[Fault, Considered]],
    on: Unknowns,
    expected: Array,
    factors: Mapping[str, float],
) -> Prepared:
    """Return a record with the columns of faults' parts after those of what is considered.

    on, expected: What inputs act on, and how large it is, shape (p,).
    """
    shown = [(i, fault.shown(record.series)) for i, (fault, _) in enumerate(faults) if fault.shown]
    seen = [(i, column) for i, column in shown if column is not None]
    model = Unknowns(on.unknowns, tuple(part for _, part in faults))
    (made,) = prepare_columns([record.series], model, factors, expected)
    places = (*made.considered, *(i for i, _ in seen))
    return replace(
        record,
        fixed=np.column_stack([record.fixed, made.fixed, *(column for _, column in seen)]),
        considered=(*record.considered, *(len(on.considered) + i for i in places)),
    )


def _left(
    blocks: Sequence[Block], owners: Sequence[str], model: Unknowns, faulty: Places
) -> tuple[Array, dict[str, Array]]:
    """Return the products of what the faults' columns leave in rows and priors.

    What is considered is followed here as what is estimated: the test of the residuals allows
    for it.
    """
    others = np.setdiff1d(np.arange(len(model.considered_names)), faulty)
    sizes = np.array(model.considered_sizes)[others]
    spread = np.array([*(u.spread for u in model.unknowns), *sizes])
    p = spread.size
    held = np.diag(1.0 / np.where(spread > 0.0, spread, 1e-30))
    rows = [
        np.hstack([block.factor, block.considered[:, others], block.considered[:, faulty]])
        for block in blocks
    ]
    prior = np.hstack([held, np.zeros((p, faulty.size))])
    triangle = triangle_of(np.vstack([*rows, prior]))
    rest = triangle[p:, p:]
    followed = np.linalg.solve(triangle[:p, :p], triangle[:p, p:])
    by_accelerometer: dict[str, Array] = {}
    for block, owner in zip(rows, owners, strict=True):
        residual = block[:, p:] - block[:, :p] @ followed
        before = by_accelerometer.get(owner, 0.0)
        by_accelerometer[owner] = before + residual.T @ residual
    return rest.T @ rest, by_accelerometer

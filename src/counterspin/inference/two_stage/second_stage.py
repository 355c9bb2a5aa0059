"""The paper's two-stage identification (Eq. 19-27, 33-34) as a joint fit of curvatures.

The joint fit reduces a record to square-root information by whitening it. The first stage reduces
it to one number, the curvature b2 of a parabola through its strobes, which is linear in the
coefficients as every sample is: what a coefficient does to b2 is the same functional of the
coefficient's column. So the second stage is the joint fit's own solver on one row a run, and
values, budgets, sensitivities and tests of priors are those of any fit.

- ``exact``: the columns are the joint fit's, along the identified rotation, so that drift and
  ripple are accounted for; at constant rate K_II enters with R^2 w^4/(4 g). K_F is estimated beside
  it, with its prior. Only where the nominal angle is the reference does the drift C show, as
  -(1/2) K_I R w C.
- ``as-printed``: Eq. 26, with 1/2 for K_II and a ripple column that exact physics does not have.

- `strobed`: a record at its strobes
- `two_stage_model`: what is estimated and what is held
- `resolve`: the fit, a `SecondStage`
- `second_stage`, `StrobedRun`: the same from runs whose first stage is at hand
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import field, replace
from functools import cached_property
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.errors import NotIdentifiableError
from counterspin.frozen import frozen
from counterspin.inference.blocks import Block
from counterspin.inference.identifiability import NEAR_COLLINEAR, TWIN_AGREEMENT
from counterspin.inference.joint.fit import JointFit, solve_blocks
from counterspin.inference.joint.inputs import rotation_column
from counterspin.inference.joint.prepared import Prepared, prepare_columns
from counterspin.inference.joint.series import Series
from counterspin.inference.joint.unknowns import ROTATION, Considered, Unknown, Unknowns
from counterspin.inference.noise.model import NoiseModel
from counterspin.inference.two_stage import strobes as strobing
from counterspin.inference.two_stage.first_stage import Parabola
from counterspin.inference.two_stage.request import DRIFT, RIPPLE, TwoStageRequest, credible_limit
from counterspin.physics import as_printed, observation
from counterspin.physics.accelerometer import Mounting
from counterspin.physics.motion import Trajectory
from counterspin.physics.terms import TERMS, term

#: Rates closer than this (relative) do not help to tell unknowns apart.
_SAME_RATE_WITHIN: Final = 1e-3

#: An effect below this many sigma(b2), at the term's largest credible size, is nothing to name.
_SMALLEST_VISIBLE: Final = 0.5

#: Where residuals vanish (a noise-free demonstration) any common weight serves: this sigma(b2).
_LEAST_SIGMA: Final = np.finfo(float).tiny ** 0.25


@frozen
class StrobedRun:
    """What the second stage needs of one run.

    Attributes
    ----------
    name
        The run's name.
    trajectory
        The rotation along which the exact columns are taken.
    parabola
        The run's first stage.
    attitude
        The platform's attitude, as for `counterspin.columns`.
    """

    name: str
    trajectory: Trajectory
    parabola: Parabola
    attitude: Array = field(default_factory=lambda: observation.LEVEL)


@frozen
class SecondStage:
    """The second stage (Eq. 20-27, 33-34) of one accelerometer.

    Attributes
    ----------
    fit
        The joint fit of the curvatures: one row a run, of unit variance. Its unknowns are K_II
        first, then K_F (exact) and the spindle's second unknown, if any. Of runs that are not
        weighted the solution is that of equal weights, with the uncertainty of the actual b2
        (Eq. 34).
    parabolas
        The first stages, in the order of the runs.
    dof
        Effective degrees of freedom of each unknown's u (Welch-Satterthwaite over the runs),
        shape (p,); infinite where sigma is given.
    weighted
        Whether the runs were weighted by 1/sigma(b2)^2.
    """

    fit: JointFit
    parabolas: tuple[Parabola, ...]
    dof: Array
    weighted: bool

    @property
    def symbols(self) -> tuple[str, ...]:
        """The unknowns."""
        return tuple(unknown.symbol for unknown in self.fit.model.unknowns)

    @property
    def runs(self) -> tuple[StrobedRun, ...]:
        """The runs, along the rotation that was found."""
        return tuple(
            StrobedRun(part.run, part.series.trajectory, parabola, part.series.attitude)
            for part, parabola in zip(self.fit.prepared, self.parabolas, strict=True)
        )

    def estimate(self, symbol: str) -> tuple[float, float]:
        """Return value and combined standard uncertainty of an unknown."""
        index = self.symbols.index(symbol)
        return float(self.fit.solution.estimate[index]), float(self.fit.solution.u[index])

    @cached_property
    def contributions(self) -> Array:
        """What each run's noise moves each unknown by, one standard deviation, shape (p, runs)."""
        return _contributions(self.fit)

    @property
    def gain(self) -> Array:
        """d(estimate)/d(b2), shape (p, runs)."""
        return self.contributions / _sigma(self.parabolas)

    @property
    def misfit(self) -> Array:
        """Each run's b2 less the model's, in units of its standard uncertainty, shape (runs,)."""
        return np.concatenate(
            [
                block.target
                - block.factor @ self.fit.solution.estimate
                - block.considered @ self.fit.model.considered_means
                for block in self.fit.blocks
            ]
        )

    @property
    def near_collinear(self) -> tuple[tuple[str, str, float], ...]:
        """Pairs of columns whose correlation in the data exceeds `NEAR_COLLINEAR`, with it."""
        information, symbols = self.fit.solution.information, self.symbols
        unit = information / np.linalg.norm(information, axis=0)
        cosine = unit.T @ unit
        return tuple(
            (symbols[i], symbols[j], float(cosine[i, j]))
            for i in range(len(symbols))
            for j in range(i + 1, len(symbols))
            if abs(cosine[i, j]) > NEAR_COLLINEAR
        )

    def alike(self, symbol: str, others: Iterable[str]) -> dict[str, float]:
        """Return the held terms that act exactly as an unknown does.

        The estimate of the unknown is then one of the sum of all of them.

        Parameters
        ----------
        symbol
            The unknown.
        others
            The terms that are asked about.

        Returns
        -------
        dict
            Term -> how much of the unknown one unit of it is like. Terms that cannot be seen at
            their largest credible size are left out.
        """
        rows = np.vstack([block.factor for block in self.fit.blocks])
        held = np.vstack([block.considered for block in self.fit.blocks])
        column = rows[:, self.symbols.index(symbol)]
        alike = {}
        for other in others:
            effect = held[:, self._places(other)].sum(axis=1)
            size, along = float(np.linalg.norm(effect)), float(column @ effect)
            seen = size * term(other).limit > _SMALLEST_VISIBLE
            if seen and abs(along) > TWIN_AGREEMENT * size * float(np.linalg.norm(column)):
                alike[other] = along / float(column @ column)
        return alike

    def shift(self, symbol: str) -> Array:
        """Return what one unit of a held term that is not taken away moves the unknowns by, (p,).

        Of a term that every run has anew, the runs' effects are combined as independent ones.
        """
        moved = -self.fit.solution.sensitivity_considered[:, self._places(symbol)]
        return np.asarray(moved[:, 0] if moved.shape[1] == 1 else np.linalg.norm(moved, axis=1))

    def _places(self, symbol: str) -> list[int]:
        considered = self.fit.model.considered
        return [place for place, other in enumerate(considered) if other.symbol == symbol]


def strobed(series: Series) -> tuple[Series, strobing.Strobes]:
    """Return a record at its strobes, each for as many samples as its noise allows, and these."""
    phase = strobing.strobe_angle(series.mounting.turned(series.attitude).input_axis)
    angle = series.trajectory.spindle.angle(series.time)

    def at_strobes(values: Array) -> strobing.Strobes:
        return strobing.by_angle(series.time, angle, values, phase, series.count)

    found, changing = at_strobes(series.error), series.by_latitude
    by_latitude = None if changing is None else at_strobes(changing).error
    return replace(_at(series, found), by_latitude=by_latitude), found


def _at(series: Series, strobes: strobing.Strobes) -> Series:
    return replace(
        series,
        time=strobes.time,
        spread=np.zeros_like(strobes.time),
        count=strobes.noise_factor**-2.0,
        error=strobes.error,
    )


def held(
    model: Unknowns, estimated: Collection[str], series: Sequence[Series]
) -> tuple[Considered, ...]:
    """Return all terms of a model but those estimated as held: as known, or exactly ideal.

    Without what cannot show in the series, and without the rotation of runs whose angle is not
    recorded: at the strobes its drift alone shows.
    """
    return tuple(
        Considered(
            other.owner,
            other.symbol,
            other.prior if math.isfinite(other.prior[1]) else (other.nominal, 0.0),
            other.limit,
        )
        for other in (*model.unknowns, *model.considered)
        if other.symbol not in (*estimated, *ROTATION)
        and any(other.concerns(record) for record in series)
    )


def two_stage_model(
    model: Unknowns, request: TwoStageRequest, series: Sequence[Series]
) -> Unknowns:
    """Return a joint model as the two-stage method has it: what it does not estimate is held.

    Parameters
    ----------
    model
        Of the joint fit.
    request
        What is estimated, with its priors.
    series
        Of one accelerometer in each run.
    """
    limits = {other.symbol: other.limit for other in model.unknowns}
    owner = series[0].accelerometer
    estimated = tuple(
        Unknown(
            owner if symbol in TERMS else "",
            symbol,
            prior,
            limits[symbol] if symbol in limits else credible_limit(symbol),
        )
        for symbol, prior in request.unknowns.items()
    )
    return Unknowns(estimated, held(model, request.unknowns, series), model.inputs)


def resolve(
    series: Sequence[Series],
    parabolas: Sequence[Parabola],
    model: Unknowns,
    request: TwoStageRequest,
) -> SecondStage:
    """Resolve the curvatures of several runs of one accelerometer.

    Parameters
    ----------
    series
        Of `strobed`.
    parabolas
        Their first stages.
    model
        Of `two_stage_model`.
    request
        Equations and weights.

    Returns
    -------
    SecondStage

    Raises
    ------
    NotIdentifiableError
        If there are fewer different rates than unknowns; both senses of one rate count once
        where no unknown changes its sign with the sense.
    """
    _check_rates(series, model, {DRIFT, RIPPLE} if request.ripple == "amplitude" else {DRIFT})
    noise = {series[0].accelerometer: NoiseModel(parabolas[0].sigma, request.random_walk or 0.0)}

    def solved(prepared: Sequence[Prepared]) -> JointFit:
        blocks = tuple(
            _curvature_row(part, parabola, model)
            for part, parabola in zip(prepared, parabolas, strict=True)
        )
        solution = solve_blocks(blocks, model)
        if not request.weighted:
            # Rows of one common variance, and then the uncertainty of the actual b2.
            sigma = _sigma(parabolas)
            ratios = sigma / math.sqrt(np.mean(sigma**2))
            even = [
                replace(b, factor=r * b.factor, target=r * b.target, considered=r * b.considered)
                for b, r in zip(blocks, ratios, strict=True)
            ]
            unweighted = solve_blocks(even, model).with_row_noise(ratios)
            solution = replace(unweighted, information=solution.information)
        return JointFit(model, solution, tuple(prepared), blocks, noise)

    def columns(fit: JointFit | None) -> Sequence[Prepared]:
        if request.model == "as-printed":
            return [_printed(record, model, request.ripple, fit) for record in series]
        return _exact(series, model, fit)

    # Some columns depend on the estimate: twice.
    fit = solved(columns(solved(columns(None))))
    return SecondStage(fit, tuple(parabolas), _effective_dof(fit, parabolas), request.weighted)


def second_stage(
    runs: Sequence[StrobedRun],
    mounting: Mounting,
    request: TwoStageRequest | None = None,
    *,
    ignored: Sequence[str] = ("K_III",),
) -> SecondStage:
    """Resolve the b2 of several runs into K_II and the unknowns beside it.

    Parameters
    ----------
    runs
        At least as many different rates as unknowns without a prior.
    mounting
        The accelerometer's axes in the level attitude.
    request
        Model, priors and weights; None: the exact model, and nothing known beforehand. Its noise
        is the first stage's.
    ignored
        Terms of which only the effect is wanted that they would have; those of which something is
        known are passed over.

    Returns
    -------
    SecondStage

    Raises
    ------
    NotIdentifiableError
        As `resolve`.
    """
    request = request or TwoStageRequest()
    names = [run.name for run in runs]
    names = [n if names.count(n) == 1 else f"{n} ({i + 1})" for i, n in enumerate(names)]
    nothing = np.empty(0)
    series = [
        _at(
            Series(
                accelerometer="",
                run=name,
                trajectory=run.trajectory,
                mounting=mounting,
                observable="displacement",
                attitude=run.attitude,
                time=nothing,
                spread=nothing,
                count=nothing,
                spacing=2.0 * math.pi / abs(run.trajectory.spindle.rate),
                error=nothing,
            ),
            run.parabola.strobes,
        )
        for name, run in zip(names, runs, strict=True)
    ]
    ideal = {symbol: (term(symbol).nominal, 0.0) for symbol in ignored}
    considered = tuple(
        Considered(owner, symbol, prior, term(symbol).limit)
        for symbol, prior in {**ideal, **request.considered}.items()
        for owner in (names if term(symbol).per_run else [""])
    )
    everything = Unknowns((), considered, request.inputs(runs[0].trajectory))
    model = two_stage_model(everything, request, series)
    return resolve(series, [run.parabola for run in runs], model, request)


def _curvature_row(prepared: Prepared, parabola: Parabola, model: Unknowns) -> Block:
    """Return what the strobes of a run say as one row of unit variance, and what they leave."""
    sigma = max(parabola.u_b2, _LEAST_SIGMA)
    curvature = parabola.gain[2] / sigma
    factor = np.zeros((1, len(model.unknowns)))
    factor[0, list(prepared.unknowns)] = curvature @ prepared.design
    fixed = np.zeros((1, len(model.considered_names)))
    fixed[0, list(prepared.considered)] = curvature @ prepared.fixed
    chi2 = parabola.chi2 if math.isfinite(parabola.chi2) else 0.0
    return Block(factor, np.array([parabola.b2 / sigma]), fixed, chi2, parabola.dof + 3, 2)


def _exact(series: Sequence[Series], model: Unknowns, fit: JointFit | None) -> Sequence[Prepared]:
    """Return the columns; those that depend on the estimate where a fit has it.

    K_II grows with the rate's fourth power, and so along a drift that is known by then. The drift
    itself is counted from none: its own column is that of the nominal rate, seen through K_I.
    """
    scale_factor = _scale_factor(model)
    scale_factors = {series[0].accelerometer: scale_factor}
    places = [i for i, unknown in enumerate(model.unknowns) if unknown.symbol == DRIFT]
    if not places:
        if fit is None:
            return prepare_columns(series, model, scale_factors)
        return fit.prepared_for(model, scale_factors)
    estimate = None if fit is None else fit.solution.estimate
    drift = 0.0 if estimate is None else float(estimate[places[0]])
    moved = [_drifting(record, drift) for record in series]
    prepared = prepare_columns(moved, model, scale_factors, estimate)
    for part, record in zip(prepared, series, strict=True):
        part.design[:, part.unknowns.index(places[0])] = scale_factor * rotation_column(
            record, DRIFT
        )
    return prepared


def _drifting(series: Series, drift: float) -> Series:
    spindle = replace(series.trajectory.spindle, drift=drift)
    return replace(series, trajectory=replace(series.trajectory, spindle=spindle))


def _printed(
    series: Series, model: Unknowns, ripple: as_printed.RippleModel, fit: JointFit | None = None
) -> Prepared:
    """Return the columns of Eq. 26 and the K_F of Eq. 19; all else has no t^2 there.

    Of uncertain inputs the derivatives, where a fit has the estimate.
    """
    motion, scale_factor = series.trajectory, _scale_factor(model)
    rate, radius, g = np.array([motion.spindle.rate]), motion.radius, motion.site.gravity
    columns = as_printed.second_stage_columns(rate, radius, g, scale_factor, ripple)[0]
    sizes = {"K_II": float(columns[0]), RIPPLE: float(columns[1]), "K_F": 0.5 * g}
    symbols = [unknown.symbol for unknown in model.unknowns]
    if fit is not None:
        found = {s: v * sizes[s] for s, v in zip(symbols, fit.solution.estimate, strict=True)}
        sizes["centrifuge.radius"] = (2.0 * found["K_II"] + found[RIPPLE]) / radius
        sizes["site.gravity"] = -found["K_II"] / g
    others = [*(other.symbol for other in model.considered), *(model.inputs or ())]
    square = series.time**2
    return Prepared(
        series,
        scale_factor,
        tuple(range(len(symbols))),
        np.outer(square, [sizes[symbol] for symbol in symbols]),
        tuple(range(len(others))),
        np.outer(square, [sizes.get(symbol, 0.0) for symbol in others]),
    )


def _scale_factor(model: Unknowns) -> float:
    """Return K_I with which the displacement errors are seen, g/g."""
    return next((c.prior[0] for c in model.considered if c.symbol == "K_I"), 1.0)


def _check_rates(series: Sequence[Series], model: Unknowns, odd: Collection[str]) -> None:
    """Refuse what cannot be solved; `odd` are the unknowns that change sign with the sense."""
    free = [u.symbol for u in model.unknowns if math.isinf(u.prior[1])]
    even = [symbol for symbol in free if symbol not in odd]
    rates = [record.trajectory.spindle.rate for record in series]
    for needed, different, words in (
        (even, _different([abs(rate) for rate in rates]), "rates, whatever their sense"),
        (free, _different(rates), "rates"),
    ):
        if different < len(needed):
            raise NotIdentifiableError(
                f"{len(needed)} unknowns without a prior ({', '.join(needed)}) need at least "
                f"{len(needed)} different {words}; the campaign has {different}: add runs at other "
                "rates, or give priors"
            )


def _different(rates: Sequence[float]) -> int:
    kept: list[float] = []
    for rate in rates:
        if all(abs(rate - other) > _SAME_RATE_WITHIN * abs(other) for other in kept):
            kept.append(rate)
    return len(kept)


def _sigma(parabolas: Sequence[Parabola]) -> Array:
    """Return sigma(b2) of each run, m/s^2, shape (runs,)."""
    return np.array([max(parabola.u_b2, _LEAST_SIGMA) for parabola in parabolas])


def _contributions(fit: JointFit) -> Array:
    unit = np.eye(len(fit.model.unknowns))
    return np.array([fit.solution.combine(row).noise_rows for row in unit])


def _effective_dof(fit: JointFit, parabolas: Sequence[Parabola]) -> Array:
    """Return Welch-Satterthwaite degrees of freedom (GUM G.4.1), shape (p,)."""
    if not parabolas[0].sigma_from_residuals:
        return np.full(len(fit.model.unknowns), math.inf)
    parts = _contributions(fit) ** 2
    dof = np.array([parabola.dof for parabola in parabolas])
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(fit.solution.u**4 / np.sum(parts**2 / dof, axis=1))

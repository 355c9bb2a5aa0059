"""A record of a run reduced to one row of a joint fit: the curvature of its strobes.

The joint fit reduces a record to square-root information by whitening it. The first stage reduces
it to one number, the curvature b2 of a parabola through its strobes, which is linear in the
coefficients as every sample is: what a coefficient does to b2 is the same functional of the
coefficient's column.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import fields, replace
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.inference.blocks import Block
from counterspin.inference.joint.fit import JointFit
from counterspin.inference.joint.prepared import Prepared, prepare_columns, prepared_for
from counterspin.inference.joint.series import Series, rotation_column
from counterspin.inference.joint.unknowns import RIPPLE, ROTATION, Considered, Unknown, Unknowns
from counterspin.inference.noise.model import Noise
from counterspin.inference.two_stage import strobes as strobing
from counterspin.inference.two_stage.first_stage import Parabola
from counterspin.inference.two_stage.request import DRIFT, TwoStageRequest
from counterspin.physics import as_printed
from counterspin.physics.terms import TERMS

#: Where residuals vanish (a noise-free demonstration) any common weight serves: this sigma(b2).
LEAST_SIGMA: Final = np.finfo(float).tiny ** 0.25


def strobed(series: Series) -> tuple[Series, strobing.Strobes]:
    """Return a record at its strobes, each for as many samples as its noise allows, and these."""
    phase = strobing.strobe_angle(series.mounting.turned(series.attitude).input_axis)
    angle = series.trajectory.spindle.angle(series.time)

    def at_strobes(values: Array) -> strobing.Strobes:
        return strobing.by_angle(series.time, angle, values, phase, series.count)

    found, changing = at_strobes(series.error), series.by_latitude
    by_latitude = None if changing is None else at_strobes(changing).error
    record = replace(
        series,
        time=found.time,
        spread=np.zeros_like(found.time),
        count=found.noise_factor**-2.0,
        error=found.error,
        by_latitude=by_latitude,
        until=float(np.max(series.time + series.spread)),  # as all of it was
    )
    return record, found


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
            asked=False,
            unstated=other.unstated,
        )
        for other in (*model.unknowns, *model.considered)
        if other.symbol not in (*estimated, *ROTATION)
        and any(other.concerns(record) for record in series)
    )


def two_stage_model(
    model: Unknowns, request: TwoStageRequest, series: Sequence[Series]
) -> Unknowns:
    """Return a joint model as one accelerometer's two stages have it: the rest is held."""
    owner = series[0].accelerometer
    known = {other.symbol: other for other in model.unknowns if other.owner in ("", owner)}
    estimated = tuple(
        Unknown(
            owner if symbol in TERMS else "",
            symbol,
            prior,
            known[symbol].limit if symbol in known else request.limit_of(symbol),
            unstated=symbol in known and known[symbol].unstated,
        )
        for symbol, prior in request.unknowns.items()
    )
    return Unknowns(estimated, held(model, request.unknowns, series))


@frozen
class Curvature(Prepared):
    """A record at its strobes, of which only the curvature counts."""

    parabola: Parabola  #: Through the strobes.

    @classmethod
    def of(cls, prepared: Prepared, parabola: Parabola) -> Curvature:
        """Return the curvature of prepared strobes."""
        own = {each.name: getattr(prepared, each.name) for each in fields(prepared)}
        return cls(**own, parabola=parabola)

    def block(self, noises: Mapping[str, Noise]) -> Block:  # noqa: ARG002 -- it has its own
        """Return what the strobes say as one row of unit variance, and what they leave."""
        parabola = self.parabola
        sigma = max(parabola.u_b2, LEAST_SIGMA)
        curvature = parabola.gain[2][None, :] / sigma
        chi2 = parabola.chi2 if math.isfinite(parabola.chi2) else 0.0
        target = np.array([parabola.b2 / sigma])
        factor, fixed = curvature @ self.design, curvature @ self.fixed
        return Block(factor, target, fixed, chi2, parabola.dof + 3, 2)


def exact_columns(
    series: Sequence[Series], model: Unknowns, fit: JointFit | None
) -> Sequence[Prepared]:
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
        found = dict(zip(fit.model.unknowns, fit.solution.estimate.tolist(), strict=True))
        return prepared_for(fit.prepared, fit.model, model, scale_factors, found)
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


def printed_columns(
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
    others = [other.symbol for other in model.considered]
    square = series.time**2
    return Prepared(
        tuple(range(len(symbols))),
        np.outer(square, [sizes[symbol] for symbol in symbols]),
        tuple(range(len(others))),
        np.outer(square, [sizes.get(symbol, 0.0) for symbol in others]),
        series,
        scale_factor,
    )


def _scale_factor(model: Unknowns) -> float:
    """Return K_I with which the displacement errors are seen, g/g."""
    return next((c.prior[0] for c in model.considered if c.symbol == "K_I"), 1.0)

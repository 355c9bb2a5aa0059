"""Inputs of the two-stage method, and its records as rows of a joint fit.

The joint fit reduces a record to square-root information by whitening it. The first stage reduces
it to one number, the curvature b2 of a parabola through its strobes, which is linear in the
coefficients as every sample is: what a coefficient does to b2 is the same functional of the
coefficient's column.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import field, fields, replace
from functools import cached_property
from typing import Final, Literal

import numpy as np

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.inference.joint.design_blocks import (
    DesignBlock,
    build_design_blocks,
    update_design_blocks,
)
from counterspin.inference.joint.fit import JointFit
from counterspin.inference.joint.series import ResidualSeries, rotation_column
from counterspin.inference.joint.unknowns import RIPPLE, ROTATION, Considered, Unknown, Unknowns
from counterspin.inference.least_squares import NO_PRIOR, Block
from counterspin.inference.noise.model import Noise
from counterspin.inference.two_stage.first_stage import (
    Parabola,
    Strobes,
    by_angle,
    first_stage,
    strobe_angle,
)
from counterspin.physics import as_printed
from counterspin.physics.as_printed import RippleModel
from counterspin.physics.motion import Trajectory
from counterspin.physics.terms import TERMS, term

DRIFT: Final = "spindle.drift"  #: second unknown where the nominal angle is the reference, 1/s

#: Largest credible sizes of the second unknowns: 1 % a second, 1 % of a usual rate.
_SPINDLE_LIMIT: Final = 1e-2


@frozen
class TwoStageRequest:
    """Estimated unknowns, known values and assumed noise of the two-stage method.

    Attributes
    ----------
    model
        ``exact`` or ``as-printed``.
    priors
        Term -> (value, standard uncertainty) in g-units, known beforehand. K_II and K_F are
        estimated with theirs; every other term is considered: taken at its value, with its
        uncertainty carried into the result. Without a prior K_I is exactly nominal.
    fit_bias
        Whether K_F is estimated, with its prior (exact model only: the paper takes it as known).
    nominal_angle
        Whether the reference displacement is that of the nominal rate; then the drift C, common
        to all runs, is an unknown of the exact model.
    ripple
        As printed: the ripple has the same ``amplitude`` w_p at all rates, or the same ``ratio``
        w_p/w0.
    weighted
        Weight the runs by sigma(b2), or not, as the paper does. Priors then count like runs of
        the mean sigma(b2).
    sigma
        Standard deviation of a sample's displacement, m; None: from the residuals of each run, or
        from where the random walk is found.
    from_residuals
        Whether sigma is taken from the residuals of each run whatever else is known of it.
    random_walk
        Coefficient N of the accelerometer's white noise, m/s^2/Hz^0.5; None: not known, to be
        found in whole records before anything can be resolved.
    timing
        Standard deviation of a time stamp, s.
    u_radius, u_gravity
        Relative standard uncertainties of radius and gravity.
    limits
        Term -> largest credible size, where it is not the table's.
    """

    model: Literal["exact", "as-printed"] = "exact"
    priors: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    fit_bias: bool = True
    nominal_angle: bool = False
    ripple: RippleModel = "amplitude"
    weighted: bool = True
    sigma: float | None = None
    from_residuals: bool = False
    random_walk: float | None = 0.0
    timing: float = 0.0
    u_radius: float = 0.0
    u_gravity: float = 0.0
    limits: Mapping[str, float] = field(default_factory=dict)

    @property
    def scale_factor(self) -> float:
        """K_I with which the displacement errors are seen, g/g."""
        return self.considered["K_I"][0]

    @cached_property
    def unknowns(self) -> dict[str, tuple[float, float]]:
        """Estimated unknowns, K_II first, with their priors; infinite: no prior information."""
        unknowns = {"K_II": self.priors.get("K_II", NO_PRIOR)}
        bias = self.priors.get("K_F", NO_PRIOR)
        if self.model == "exact" and self.fit_bias and bias[1] > 0.0:
            unknowns["K_F"] = bias
        if self.model == "as-printed":
            unknowns[RIPPLE] = NO_PRIOR
        elif self.nominal_angle:
            unknowns[DRIFT] = NO_PRIOR
        return unknowns

    @cached_property
    def considered(self) -> dict[str, tuple[float, float]]:
        """Known values: (value, standard uncertainty), K_I included."""
        known_values = {"K_F": (0.0, 0.0), "K_I": (TERMS["K_I"].nominal, 0.0), **self.priors}
        return {
            symbol: prior for symbol, prior in known_values.items() if symbol not in self.unknowns
        }

    def with_noise(self, noise: Noise) -> TwoStageRequest:
        """Return the request with noise that was found, where it states none."""
        if self.random_walk is not None:
            return self
        sigma = None if self.from_residuals else self.sigma or math.sqrt(noise.sample_variance)
        return replace(self, sigma=sigma, random_walk=noise.random_walk)

    def first_stage(
        self, strobes: Strobes, trajectory: Trajectory, timing: float = 0.0
    ) -> Parabola:
        """Return the first stage of a run with this noise.

        At a strobe the displacement passes at R w: a time stamp's error shows with that.

        timing: Standard deviation of the times of the rows, s.
        """
        passing = trajectory.radius * trajectory.spindle.rate
        sigma = None if self.sigma is None else math.hypot(self.sigma, passing * timing)
        return first_stage(strobes, sigma, self.random_walk or 0.0)

    def inputs(self, motion: Trajectory) -> dict[str, float]:
        """Return the uncertain inputs, with the standard uncertainty of each in SI units."""
        uncertainties = {
            "centrifuge.radius": self.u_radius * motion.radius,
            "site.gravity": self.u_gravity * motion.site.gravity,
        }
        return {name: u for name, u in uncertainties.items() if u > 0.0}

    def limit_of(self, symbol: str) -> float:
        """Return the largest credible size of an unknown of the two-stage method."""
        if symbol.startswith("spindle."):
            return _SPINDLE_LIMIT
        return self.limits.get(symbol) or term(symbol).limit


# As rows of a joint fit ------------------------------------------------------------------------

#: Where residuals vanish (a noise-free demonstration) any common weight serves: this sigma(b2).
LEAST_SIGMA: Final = np.finfo(float).tiny ** 0.25


def select_strobes(series: ResidualSeries) -> tuple[ResidualSeries, Strobes]:
    """Return a record at its strobes, each for as many samples as its noise allows, and these."""
    phase = strobe_angle(series.mounting.turned(series.attitude).input_axis)
    angle = series.trajectory.spindle.angle(series.time)

    def at_strobes(values: Array) -> Strobes:
        return by_angle(series.time, angle, values, phase, series.count)

    strobes, sensitivity = at_strobes(series.error), series.latitude_sensitivity
    by_latitude = None if sensitivity is None else at_strobes(sensitivity).error
    record = replace(
        series,
        time=strobes.time,
        time_sd=np.zeros_like(strobes.time),
        count=strobes.noise_factor**-2.0,
        error=strobes.error,
        latitude_sensitivity=by_latitude,
        integration_end=float(np.max(series.time + series.time_sd)),  # as all of it was
    )
    return record, strobes


def considered_terms(
    model: Unknowns, estimated_symbols: Collection[str], series: Sequence[ResidualSeries]
) -> tuple[Considered, ...]:
    """Return all terms of a model but those estimated as held: as known, or exactly ideal.

    Without what cannot show in the series, and without the rotation of runs whose angle is not
    recorded: at the strobes its drift alone shows.
    """
    return tuple(
        Considered(
            term.owner,
            term.symbol,
            term.prior if math.isfinite(term.prior[1]) else (term.nominal, 0.0),
            term.limit,
            is_of_interest=False,
            has_default_prior=term.has_default_prior,
        )
        for term in (*model.unknowns, *model.considered)
        if term.symbol not in (*estimated_symbols, *ROTATION)
        and any(term.affects(record) for record in series)
    )


def two_stage_model(
    model: Unknowns, request: TwoStageRequest, series: Sequence[ResidualSeries]
) -> Unknowns:
    """Return a joint model as one accelerometer's two stages have it: the rest is held."""
    owner = series[0].accelerometer
    unknowns_by_symbol = {
        unknown.symbol: unknown for unknown in model.unknowns if unknown.owner in ("", owner)
    }
    estimated_unknowns = tuple(
        Unknown(
            owner if symbol in TERMS else "",
            symbol,
            prior,
            unknowns_by_symbol[symbol].limit
            if symbol in unknowns_by_symbol
            else request.limit_of(symbol),
            has_default_prior=symbol in unknowns_by_symbol
            and unknowns_by_symbol[symbol].has_default_prior,
        )
        for symbol, prior in request.unknowns.items()
    )
    return Unknowns(estimated_unknowns, considered_terms(model, request.unknowns, series))


@frozen
class Curvature(DesignBlock):
    """A record at its strobes, of which only the curvature counts."""

    parabola: Parabola  #: Through the strobes.

    @classmethod
    def of(cls, block: DesignBlock, parabola: Parabola) -> Curvature:
        """Return the curvature of prepared strobes."""
        values = {attribute.name: getattr(block, attribute.name) for attribute in fields(block)}
        return cls(**values, parabola=parabola)

    def block(self, noises: Mapping[str, Noise]) -> Block:  # noqa: ARG002 -- it has its own
        """Return the strobes' information as one row of unit variance, and their residuals."""
        parabola = self.parabola
        sigma = max(parabola.u_b2, LEAST_SIGMA)
        curvature = parabola.gain[2][None, :] / sigma
        chi2 = parabola.chi2 if math.isfinite(parabola.chi2) else 0.0
        target = np.array([parabola.b2 / sigma])
        factor, fixed = curvature @ self.design, curvature @ self.fixed
        return Block(factor, target, fixed, chi2, parabola.dof + 3, 2)


def exact_columns(
    series: Sequence[ResidualSeries], model: Unknowns, fit: JointFit | None
) -> Sequence[DesignBlock]:
    """Return the columns; those that depend on the estimate where a fit has it.

    K_II grows with the rate's fourth power, and so along a drift that is known by then. The drift
    itself is counted from none: its own column is that of the nominal rate, seen through K_I.
    """
    scale_factor = _scale_factor(model)
    scale_factors = {series[0].accelerometer: scale_factor}
    indices = [i for i, unknown in enumerate(model.unknowns) if unknown.symbol == DRIFT]
    if not indices:
        if fit is None:
            return build_design_blocks(series, model, scale_factors)
        estimates = dict(zip(fit.model.unknowns, fit.solution.estimate.tolist(), strict=True))
        return update_design_blocks(fit.design_blocks, fit.model, model, scale_factors, estimates)
    estimate = None if fit is None else fit.solution.estimate
    drift = 0.0 if estimate is None else float(estimate[indices[0]])
    drifting = [_with_drift(record, drift) for record in series]
    blocks = build_design_blocks(drifting, model, scale_factors, estimate)
    for block, record in zip(blocks, series, strict=True):
        block.design[:, block.unknowns.index(indices[0])] = scale_factor * rotation_column(
            record, DRIFT
        )
    return blocks


def _with_drift(series: ResidualSeries, drift: float) -> ResidualSeries:
    spindle = replace(series.trajectory.spindle, drift=drift)
    return replace(series, trajectory=replace(series.trajectory, spindle=spindle))


def printed_columns(
    series: ResidualSeries,
    model: Unknowns,
    ripple: as_printed.RippleModel,
    fit: JointFit | None = None,
) -> DesignBlock:
    """Return the columns of Eq. 26 and the K_F of Eq. 19; all else has no t^2 there.

    Of uncertain inputs the derivatives, where a fit has the estimate.
    """
    motion, scale_factor = series.trajectory, _scale_factor(model)
    rate, radius, g = np.array([motion.spindle.rate]), motion.radius, motion.site.gravity
    columns = as_printed.second_stage_columns(rate, radius, g, scale_factor, ripple)[0]
    factors = {"K_II": float(columns[0]), RIPPLE: float(columns[1]), "K_F": 0.5 * g}
    symbols = [unknown.symbol for unknown in model.unknowns]
    if fit is not None:
        contributions = {
            s: v * factors[s] for s, v in zip(symbols, fit.solution.estimate, strict=True)
        }
        factors["centrifuge.radius"] = (
            2.0 * contributions["K_II"] + contributions[RIPPLE]
        ) / radius
        factors["site.gravity"] = -contributions["K_II"] / g
    considered_symbols = [term.symbol for term in model.considered]
    square = series.time**2
    return DesignBlock(
        tuple(range(len(symbols))),
        np.outer(square, [factors[symbol] for symbol in symbols]),
        tuple(range(len(considered_symbols))),
        np.outer(square, [factors.get(symbol, 0.0) for symbol in considered_symbols]),
        series,
        scale_factor,
    )


def _scale_factor(model: Unknowns) -> float:
    """Return K_I with which the displacement errors are seen, g/g."""
    return next((c.prior[0] for c in model.considered if c.symbol == "K_I"), 1.0)

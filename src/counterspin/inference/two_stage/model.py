"""Inputs of the two-stage method, and its records as rows of a joint fit.

The joint fit reduces a record to square-root information by whitening. The first stage reduces it
to a single number, the curvature b2 of a parabola through its strobes. Like the samples, b2 is
linear in the coefficients, so the effect of a coefficient on b2 is the curvature of its column.
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
    """Unknowns, known values and assumed noise of the two-stage method.

    Attributes
    ----------
    model
        ``exact`` or ``as-printed``.
    priors
        Term -> prior (value, standard uncertainty) in g-units. K_II and K_F are estimated with
        their priors; every other term is considered: fixed at its value, with its uncertainty
        propagated. Without a prior, K_I is exactly nominal.
    fit_bias
        Whether K_F is estimated, with its prior (exact model only; the paper assumes it known).
    nominal_angle
        Whether the reference displacement is that of the nominal rate; then the drift C, common
        to all runs, is an unknown of the exact model.
    ripple
        As printed: the ripple has the same ``amplitude`` w_p at all rates, or the same ``ratio``
        w_p/w0.
    weighted
        Whether the runs are weighted by 1/sigma(b2)^2; the paper does not weight them. Without
        weights, priors count like runs with the mean sigma(b2).
    sigma
        Standard deviation of a sample's displacement, m; None: from the residuals of each run, or
        estimated together with the random walk.
    from_residuals
        Whether sigma is always estimated from the residuals of each run.
    random_walk
        Coefficient N of the accelerometer's white noise, m/s^2/Hz^0.5; None: unknown, to be
        estimated from whole records before the second stage.
    timing
        Standard deviation of a time stamp, s.
    u_radius, u_gravity
        Relative standard uncertainties of radius and gravity.
    limits
        Term -> largest credible size, if it differs from the table.
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
        """K_I in the columns of platform errors, g/g."""
        return self.considered["K_I"][0]

    @cached_property
    def unknowns(self) -> dict[str, tuple[float, float]]:
        """Estimated unknowns, K_II first, with their priors; infinite: no prior information."""
        unknowns = {"K_II": self.priors.get("K_II", NO_PRIOR)}
        bias_prior = self.priors.get("K_F", NO_PRIOR)
        if self.model == "exact" and self.fit_bias and bias_prior[1] > 0.0:
            unknowns["K_F"] = bias_prior
        if self.model == "as-printed":
            unknowns[RIPPLE] = NO_PRIOR
        elif self.nominal_angle:
            unknowns[DRIFT] = NO_PRIOR
        return unknowns

    @cached_property
    def considered(self) -> dict[str, tuple[float, float]]:
        """Considered terms, including K_I: (value, standard uncertainty)."""
        known_values = {"K_F": (0.0, 0.0), "K_I": (TERMS["K_I"].nominal, 0.0), **self.priors}
        return {
            symbol: prior for symbol, prior in known_values.items() if symbol not in self.unknowns
        }

    def with_noise(self, noise: Noise) -> TwoStageRequest:
        """Return the request with estimated noise, unless it states the noise."""
        if self.random_walk is not None:
            return self
        sigma = None if self.from_residuals else self.sigma or math.sqrt(noise.sample_variance)
        return replace(self, sigma=sigma, random_walk=noise.random_walk)

    def first_stage(
        self, strobes: Strobes, trajectory: Trajectory, timing: float = 0.0
    ) -> Parabola:
        """Return the first stage of a run with this noise.

        At a strobe, the velocity is R w, which determines the effect of time-stamp errors.

        timing: Standard deviation of the times of the rows, s.
        """
        velocity = trajectory.radius * trajectory.spindle.rate
        sigma = None if self.sigma is None else math.hypot(self.sigma, velocity * timing)
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


# Rows of a joint fit ---------------------------------------------------------------------------

#: sigma(b2) if all residuals are zero, as in a demonstration without noise.
MIN_SIGMA: Final = np.finfo(float).tiny ** 0.25


def select_strobes(series: ResidualSeries) -> tuple[ResidualSeries, Strobes]:
    """Return a record reduced to its strobes, with equivalent sample counts, and the strobes."""
    phase = strobe_angle(series.mounting.turned(series.attitude).input_axis)
    angle = series.trajectory.spindle.angle(series.time)

    def interpolate_strobes(values: Array) -> Strobes:
        return by_angle(series.time, angle, values, phase, series.count)

    strobes, sensitivity = interpolate_strobes(series.error), series.latitude_sensitivity
    latitude_sensitivity = None if sensitivity is None else interpolate_strobes(sensitivity).error
    record = replace(
        series,
        time=strobes.time,
        time_sd=np.zeros_like(strobes.time),
        count=strobes.noise_factor**-2.0,
        error=strobes.error,
        latitude_sensitivity=latitude_sensitivity,
        integration_end=float(np.max(series.time + series.time_sd)),  # end of the full record
    )
    return record, strobes


def considered_terms(
    model: Unknowns, estimated_symbols: Collection[str], series: Sequence[ResidualSeries]
) -> tuple[Considered, ...]:
    """Return all terms of a model except the estimated ones, as considered terms.

    Terms without a prior are exactly nominal. Terms that do not affect the series, and the rotation
    of runs without a recorded angle, are omitted.
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
    """Return the model of the two-stage method for an accelerometer, from a joint model."""
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
    """Curvature of a record at its strobes, as an observation."""

    parabola: Parabola  #: Parabola through the strobes.

    @classmethod
    def from_block(cls, block: DesignBlock, parabola: Parabola) -> Curvature:
        """Return the curvature of a design block at its strobes."""
        values = {attribute.name: getattr(block, attribute.name) for attribute in fields(block)}
        return cls(**values, parabola=parabola)

    def block(self, noises: Mapping[str, Noise]) -> Block:  # noqa: ARG002 -- it has its own
        """Return the information of the strobes as a row of unit variance."""
        parabola = self.parabola
        sigma = max(parabola.u_b2, MIN_SIGMA)
        curvature = parabola.gain[2][None, :] / sigma
        chi2 = parabola.chi2 if math.isfinite(parabola.chi2) else 0.0
        target = np.array([parabola.b2 / sigma])
        factor, considered = curvature @ self.design, curvature @ self.considered_design
        return Block(factor, target, considered, chi2, parabola.dof + 3, 2)


def exact_columns(
    series: Sequence[ResidualSeries], model: Unknowns, fit: JointFit | None
) -> Sequence[DesignBlock]:
    """Return the columns of the exact model, at the estimate of a fit if there is one.

    The column of K_II grows with the fourth power of the rate, and includes the estimated drift.
    The column of the drift is that at the nominal rate, times K_I.
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
    drifting_series = [_with_drift(record, drift) for record in series]
    blocks = build_design_blocks(drifting_series, model, scale_factors, estimate)
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
    """Return the columns of Eq. 26 and of K_F in Eq. 19; other terms have no t^2 there.

    Columns of uncertain inputs are derivatives at the estimate of a fit.
    """
    motion, scale_factor = series.trajectory, _scale_factor(model)
    rate, radius, g = np.array([motion.spindle.rate]), motion.radius, motion.site.gravity
    columns = as_printed.second_stage_columns(rate, radius, g, scale_factor, ripple)[0]
    quadratic_coefficients = {"K_II": float(columns[0]), RIPPLE: float(columns[1]), "K_F": 0.5 * g}
    symbols = [unknown.symbol for unknown in model.unknowns]
    if fit is not None:
        contributions = {
            s: v * quadratic_coefficients[s]
            for s, v in zip(symbols, fit.solution.estimate, strict=True)
        }
        quadratic_coefficients["centrifuge.radius"] = (
            2.0 * contributions["K_II"] + contributions[RIPPLE]
        ) / radius
        quadratic_coefficients["site.gravity"] = -contributions["K_II"] / g
    considered_symbols = [term.symbol for term in model.considered]
    squared_time = series.time**2
    return DesignBlock(
        tuple(range(len(symbols))),
        np.outer(squared_time, [quadratic_coefficients[symbol] for symbol in symbols]),
        tuple(range(len(considered_symbols))),
        np.outer(
            squared_time, [quadratic_coefficients.get(symbol, 0.0) for symbol in considered_symbols]
        ),
        series,
        scale_factor,
    )


def _scale_factor(model: Unknowns) -> float:
    """Return K_I in the columns of platform errors, g/g."""
    return next((c.prior[0] for c in model.considered if c.symbol == "K_I"), 1.0)

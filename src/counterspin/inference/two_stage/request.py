"""What is asked of the two-stage method for one accelerometer: model, priors, noise."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import field, replace
from functools import cached_property
from typing import Final, Literal

from counterspin.frozen import frozen
from counterspin.inference.joint.unknowns import RIPPLE
from counterspin.inference.least_squares import NO_PRIOR
from counterspin.inference.noise.model import Noise
from counterspin.inference.two_stage.first_stage import Parabola, first_stage
from counterspin.inference.two_stage.strobes import Strobes
from counterspin.physics.as_printed import RippleModel
from counterspin.physics.motion import Trajectory
from counterspin.physics.terms import TERMS, term

DRIFT: Final = "spindle.drift"  #: second unknown where the nominal angle is the reference, 1/s

#: Largest credible sizes of the second unknowns: 1 % a second, 1 % of a usual rate.
_SPINDLE_LIMIT: Final = 1e-2


@frozen
class TwoStageRequest:
    """What the two-stage method estimates, takes as known and assumes of the noise.

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
        """What is estimated, K_II first, with its prior; infinite: nothing is known of it."""
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
        """What is taken as known: (value, standard uncertainty), K_I included."""
        known = {"K_F": (0.0, 0.0), "K_I": (TERMS["K_I"].nominal, 0.0), **self.priors}
        return {symbol: prior for symbol, prior in known.items() if symbol not in self.unknowns}

    def with_noise(self, noise: Noise) -> TwoStageRequest:
        """Return the request with noise that was found, where it states none."""
        if self.random_walk is not None:
            return self
        sigma = None if self.from_residuals else self.sigma or math.sqrt(noise.sample_variance)
        return replace(self, sigma=sigma, random_walk=noise.random_walk)

    def first_stage(self, strobes: Strobes, trajectory: Trajectory) -> Parabola:
        """Return the first stage of a run with this noise.

        At a strobe the displacement passes at R w: a time stamp's error shows with that.
        """
        passing = trajectory.radius * trajectory.spindle.rate
        sigma = None if self.sigma is None else math.hypot(self.sigma, passing * self.timing)
        return first_stage(strobes, sigma, self.random_walk or 0.0)

    def inputs(self, motion: Trajectory) -> dict[str, float]:
        """Return the uncertain inputs, with the standard uncertainty of each in SI units."""
        sizes = {
            "centrifuge.radius": self.u_radius * motion.radius,
            "site.gravity": self.u_gravity * motion.site.gravity,
        }
        return {name: u for name, u in sizes.items() if u > 0.0}

    def limit_of(self, symbol: str) -> float:
        """Return the largest credible size of an unknown of the two-stage method."""
        if symbol.startswith("spindle."):
            return _SPINDLE_LIMIT
        return self.limits.get(symbol) or term(symbol).limit

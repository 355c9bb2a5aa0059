"""Errors of a navigation computer that uses its own velocity for the Coriolis acceleration.

With the true motion of the platform, the computer removes 2 Omega x v. With the velocity of its own
solution, v + e', it removes 2 Omega x e' too much. The error then obeys e'' = a - 2 Omega x e',
where a is the error of the sensed acceleration. Integrated once, e' = e_p' - 2 Omega x (e - e(0)),
where e_p is the error with the true motion of the platform.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

import numpy as np
from numpy.polynomial.chebyshev import chebint, chebvander

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.physics.motion import Site

#: Observables that depend on the velocity of the navigation computer.
NAVIGATION_OBSERVABLES: Final = ("displacement", "velocity")

#: Singular value of the input axes, relative to the largest, below which a direction counts as not
#: recorded.
_MIN_RECORDED_FRACTION: Final = 0.05

#: Terms of the series in 2 Omega t; after two hours, the next term is below 1e-15.
_N_TERMS: Final = 20

#: Degree of the polynomial that is integrated exactly; the remainder is waves and noise.
_DEGREE: Final = 7


@frozen
class AxisError:
    """Error of the record of one accelerometer."""

    input_axis: Array  #: In the run's attitude, east-north-up, shape (3,).
    #: ``displacement``, ``velocity`` or ``specific_force``, which has no Coriolis correction.
    observable: str
    time: Array  #: s, increasing, shape (n,).
    #: Record minus the motion along the input axis, m, m/s or m/s^2, shape (n,); NaN if missing.
    error: Array


def computer_correction(site: Site, errors: Sequence[AxisError]) -> list[Array]:
    """Return the Coriolis correction that a computer with its own velocity subtracted.

    site: Provides the Earth's rotation.
    """
    return _coriolis_projections(site, errors, unobserved_projection(errors) @ coriolis(site))


def own_velocity_errors(site: Site, errors: Sequence[AxisError]) -> list[Array]:
    """Return the errors of a computer with its own velocity.

    site, errors: As for `computer_correction`, but with the errors of a computer that knows the
        motion of the platform.
    """
    corrections = _coriolis_projections(site, errors, coriolis(site))
    return [axis.error - correction for axis, correction in zip(errors, corrections, strict=True)]


def coriolis(site: Site) -> Array:
    """Return the matrix of the cross product 2 Omega x, 1/s, shape (3, 3)."""
    matrix: Array = 2.0 * np.cross(site.earth_rotation, np.eye(3)).T
    return matrix


def unobserved_projection(errors: Sequence[AxisError]) -> Array:
    """Return the projection onto the directions without recorded displacement or velocity."""
    axes = _navigation_axes(errors)
    projection: Array = np.eye(3) - np.linalg.pinv(axes, rcond=_MIN_RECORDED_FRACTION) @ axes
    return projection


def _navigation_axes(errors: Sequence[AxisError]) -> Array:
    axes = [record.input_axis for record in errors if record.observable in NAVIGATION_OBSERVABLES]
    return np.reshape(axes, (len(axes), 3))


def _coriolis_projections(site: Site, errors: Sequence[AxisError], matrix: Array) -> list[Array]:
    """Return the Coriolis part of each error, from d = d(recorded) - integral of matrix @ d."""
    navigated_errors = [record for record in errors if record.observable in NAVIGATION_OBSERVABLES]
    if not navigated_errors:
        return [np.zeros(record.time.size) for record in errors]
    grid = np.unique(np.concatenate([record.time for record in navigated_errors]))
    integrate = _make_integrator(grid)
    inverse = np.linalg.pinv(_navigation_axes(errors), rcond=_MIN_RECORDED_FRACTION)
    positions = term = inverse @ [_position_error(record, grid) for record in navigated_errors]
    for _ in range(_N_TERMS):
        term = -matrix @ integrate(term)
        positions = positions + term
    velocity = coriolis(site) @ positions
    coriolis_errors = {"velocity": velocity, "displacement": integrate(velocity)}
    return [
        np.interp(record.time, grid, record.input_axis @ coriolis_errors[record.observable])
        if record.observable in NAVIGATION_OBSERVABLES
        else np.zeros(record.time.size)
        for record in errors
    ]


def _position_error(record: AxisError, grid: Array) -> Array:
    """Return the position error of an accelerometer since the start of the record, m."""
    is_finite = np.isfinite(record.error)
    time, error = record.time[is_finite], record.error[is_finite]
    if record.observable == "velocity":
        error = _make_integrator(time)(error[None])[0]
    displacement: Array = np.interp(grid, time, error - error[0])
    return displacement


def _make_integrator(time: Array) -> Callable[[Array], Array]:
    """Return a function that integrates values (k, n) at these times from the first time.

    A polynomial is integrated exactly and the remainder by the trapezoidal rule, which would be
    inaccurate across gaps of the record.
    """
    half_duration = 0.5 * float(time[-1] - time[0])
    scaled_time = (time - time[0]) / half_duration - 1.0 if half_duration else np.zeros_like(time)
    powers = chebvander(scaled_time, min(_DEGREE, time.size - 1))
    inverse = np.linalg.pinv(powers)
    integrated_basis = half_duration * chebint(np.eye(powers.shape[1]), lbnd=-1.0, axis=1)
    integrals = chebvander(scaled_time, powers.shape[1]) @ integrated_basis.T
    steps = 0.5 * np.diff(time)

    def integrate(values: Array) -> Array:
        polynomial_coefficients = values @ inverse.T
        remainder = values - polynomial_coefficients @ powers.T
        remainder_integral = np.cumsum(steps * (remainder[:, 1:] + remainder[:, :-1]), axis=1)
        result: Array = polynomial_coefficients @ integrals.T
        result[:, 1:] += remainder_integral
        return result

    return integrate

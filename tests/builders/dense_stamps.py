"""A dense fit of angles and specific forces whose rows are sampled off their time stamps.

Each row has its time error as an unknown beside the coefficients and each run's rotation (Eq. 1),
and three observations: the angle, the output, and the time error, which is zero within its noise.
Derivatives are by central differences; nothing of the package is used.
"""

import math
from typing import NamedTuple

import numpy as np

EARTH_RATE = 7.292115e-5
HARMONICS = 4
ITERATIONS = 6


class Records(NamedTuple):
    """One run: time stamps (s), angles (rad) and specific forces towards east (m/s^2)."""

    time: np.ndarray
    angle: np.ndarray
    output: np.ndarray


class Machine(NamedTuple):
    """Radius (m), gravity (m/s^2), latitude (rad)."""

    radius: float
    gravity: float
    latitude: float


def compute_rotation(spin, t):
    """Return angle, rate and angular acceleration; spin: start, rate, half bend, a_n, b_n."""
    start, rate, bend = spin[:3]
    angle, first, second = start + rate * t + bend * t**2, rate + 2 * bend * t, 2 * bend + 0 * t
    for n, (a, b) in enumerate(spin[3:].reshape(-1, 2), start=1):
        cos, sin = np.cos(n * rate * t), np.sin(n * rate * t)
        angle = angle + a * cos + b * sin
        first = first + n * rate * (b * cos - a * sin)
        second = second - (n * rate) ** 2 * (a * cos + b * sin)
    return angle, first, second


def compute_output(coefficients, spin, t, machine):
    """Return K_F + K_I x + K_II x^2 + K_III x^3 of the specific force towards east, m/s^2."""
    angle, first, second = compute_rotation(spin, t)
    force = -machine.radius * (first**2 * np.cos(angle) + second * np.sin(angle))
    up = EARTH_RATE * math.sin(machine.latitude)
    x = (force - 2 * up * machine.radius * first * np.cos(angle)) / machine.gravity
    return machine.gravity * np.polynomial.polynomial.polyval(x, coefficients)


def fit_rows(runs, machine, timing, encoder, white):
    """Return K_F, K_I, K_II, K_III and their standard uncertainties."""
    k = np.array([0.0, 1.0, 0.0, 0.0])
    spins = [
        np.append(np.polyfit(r.time, r.angle, 1)[::-1], np.zeros(1 + 2 * HARMONICS)) for r in runs
    ]
    time_errors = [np.zeros_like(r.time) for r in runs]
    n_unknowns = 4 + sum(map(len, spins))
    for _ in range(ITERATIONS):
        rows, targets, offset = [], [], 4
        for i, (run, spin) in enumerate(zip(runs, spins, strict=True)):
            t = run.time + time_errors[i]
            predicted = np.stack(
                [
                    compute_rotation(spin, t)[0] / encoder,
                    compute_output(k, spin, t, machine) / white,
                ]
            )
            jacobian = np.zeros((2, t.size, n_unknowns))
            for n in range(4):
                step = np.zeros(4)
                step[n] = 1e-6
                jacobian[1, :, n] = (
                    compute_output(k + step, spin, t, machine)
                    - compute_output(k - step, spin, t, machine)
                ) / (2e-6 * white)
            for n in range(spin.size):
                step = np.zeros(spin.size)
                step[n] = 1e-6 / run.time[-1] ** min(n, 2) if n < 3 else 1e-6
                upper_spin, lower_spin = spin + step, spin - step
                jacobian[0, :, offset + n] = (
                    compute_rotation(upper_spin, t)[0] - compute_rotation(lower_spin, t)[0]
                ) / (2 * step[n] * encoder)
                jacobian[1, :, offset + n] = (
                    compute_output(k, upper_spin, t, machine)
                    - compute_output(k, lower_spin, t, machine)
                ) / (2 * step[n] * white)
            slopes = compute_slopes(k, spin, t, machine, (encoder, white))
            residual = np.stack([run.angle / encoder, run.output / white]) - predicted
            # The time error of a row is eliminated: a projection in the space of its three rows.
            time_error_column = np.stack([*slopes, np.full(t.size, 1 / timing)])
            time_error_column /= np.linalg.norm(time_error_column, axis=0)
            jacobian = np.concatenate([jacobian, np.zeros((1, t.size, n_unknowns))])
            residual = np.concatenate([residual, -time_errors[i][None] / timing])
            jacobian -= time_error_column[:, :, None] * np.einsum(
                "cn,cnp->np", time_error_column, jacobian
            )
            residual = residual - time_error_column * np.sum(time_error_column * residual, axis=0)
            rows.append(jacobian.reshape(-1, n_unknowns))
            targets.append(residual.ravel())
            offset += spin.size
        design, target = np.vstack(rows), np.concatenate(targets)
        scale = np.linalg.norm(design, axis=0)
        q, r = np.linalg.qr(design / scale)
        step = np.linalg.solve(r, q.T @ target) / scale
        k, offset = k + step[:4], 4
        for i, run in enumerate(runs):
            spins[i] = spins[i] + step[offset : offset + spins[i].size]
            offset += spins[i].size
            time_errors[i] = _estimate_time_errors(
                run, k, spins[i], time_errors[i], machine, (timing, encoder, white)
            )
    inverse = np.linalg.inv(r) / scale[:, None]
    return k, np.linalg.norm(inverse, axis=1)[:4]


def compute_slopes(k, spin, t, machine, noise, h=1e-5):
    """Return slopes of angle and output, divided by their noise, 1/s, shape (2, n)."""
    change = compute_output(k, spin, t + h, machine) - compute_output(k, spin, t - h, machine)
    return np.stack([compute_rotation(spin, t)[1] / noise[0], change / (2 * h * noise[1])])


def _estimate_time_errors(run, k, spin, time_errors, machine, sizes):
    """Return the most likely time errors of the rows, s, by a single Newton step."""
    timing, encoder, white = sizes
    t = run.time + time_errors
    slopes = compute_slopes(k, spin, t, machine, (encoder, white))
    residual = np.stack([
        (run.angle - compute_rotation(spin, t)[0]) / encoder,
        (run.output - compute_output(k, spin, t, machine)) / white,
    ])  # fmt: skip
    weight = np.sum(slopes**2, axis=0) + timing**-2
    return time_errors + (np.sum(slopes * residual, axis=0) - time_errors / timing**2) / weight

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


def rotation(spin, t):
    """Return angle, rate and angular acceleration; spin: start, rate, half bend, a_n, b_n."""
    start, rate, bend = spin[:3]
    angle, first, second = start + rate * t + bend * t**2, rate + 2 * bend * t, 2 * bend + 0 * t
    for n, (a, b) in enumerate(spin[3:].reshape(-1, 2), start=1):
        cos, sin = np.cos(n * rate * t), np.sin(n * rate * t)
        angle = angle + a * cos + b * sin
        first = first + n * rate * (b * cos - a * sin)
        second = second - (n * rate) ** 2 * (a * cos + b * sin)
    return angle, first, second


def output(coefficients, spin, t, machine):
    """Return K_F + K_I x + K_II x^2 + K_III x^3 of the specific force towards east, m/s^2."""
    angle, first, second = rotation(spin, t)
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
    late = [np.zeros_like(r.time) for r in runs]
    size = 4 + sum(map(len, spins))
    for _ in range(ITERATIONS):
        rows, left, place = [], [], 4
        for i, (run, spin) in enumerate(zip(runs, spins, strict=True)):
            t = run.time + late[i]
            seen = np.stack([rotation(spin, t)[0] / encoder, output(k, spin, t, machine) / white])
            jacobian = np.zeros((2, t.size, size))
            for n in range(4):
                step = np.zeros(4)
                step[n] = 1e-6
                jacobian[1, :, n] = (
                    output(k + step, spin, t, machine) - output(k - step, spin, t, machine)
                ) / (2e-6 * white)
            for n in range(spin.size):
                step = np.zeros(spin.size)
                step[n] = 1e-6 / run.time[-1] ** min(n, 2) if n < 3 else 1e-6
                ahead, behind = spin + step, spin - step
                jacobian[0, :, place + n] = (rotation(ahead, t)[0] - rotation(behind, t)[0]) / (
                    2 * step[n] * encoder
                )
                jacobian[1, :, place + n] = (
                    output(k, ahead, t, machine) - output(k, behind, t, machine)
                ) / (2 * step[n] * white)
            slopes = slopes_of(k, spin, t, machine, (encoder, white))
            residual = np.stack([run.angle / encoder, run.output / white]) - seen
            # The time error of a row is eliminated: a projection in the space of its three rows.
            own = np.stack([*slopes, np.full(t.size, 1 / timing)])
            own /= np.linalg.norm(own, axis=0)
            jacobian = np.concatenate([jacobian, np.zeros((1, t.size, size))])
            residual = np.concatenate([residual, -late[i][None] / timing])
            jacobian -= own[:, :, None] * np.einsum("cn,cnp->np", own, jacobian)
            residual = residual - own * np.sum(own * residual, axis=0)
            rows.append(jacobian.reshape(-1, size))
            left.append(residual.ravel())
            place += spin.size
        design, target = np.vstack(rows), np.concatenate(left)
        scale = np.linalg.norm(design, axis=0)
        q, r = np.linalg.qr(design / scale)
        step = np.linalg.solve(r, q.T @ target) / scale
        k, place = k + step[:4], 4
        for i, run in enumerate(runs):
            spins[i] = spins[i] + step[place : place + spins[i].size]
            place += spins[i].size
            late[i] = _sample_late(run, k, spins[i], late[i], machine, (timing, encoder, white))
    inverse = np.linalg.inv(r) / scale[:, None]
    return k, np.linalg.norm(inverse, axis=1)[:4]


def slopes_of(k, spin, t, machine, noise, h=1e-5):
    """Return slopes of angle and output, divided by their noise, 1/s, shape (2, n)."""
    change = output(k, spin, t + h, machine) - output(k, spin, t - h, machine)
    return np.stack([rotation(spin, t)[1] / noise[0], change / (2 * h * noise[1])])


def _sample_late(run, k, spin, late, machine, sizes):
    """Return the most likely time errors of the rows, s, by a single Newton step."""
    timing, encoder, white = sizes
    t = run.time + late
    slopes = slopes_of(k, spin, t, machine, (encoder, white))
    residual = np.stack([
        (run.angle - rotation(spin, t)[0]) / encoder,
        (run.output - output(k, spin, t, machine)) / white,
    ])  # fmt: skip
    weight = np.sum(slopes**2, axis=0) + timing**-2
    return late + (np.sum(slopes * residual, axis=0) - late / timing**2) / weight

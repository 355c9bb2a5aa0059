"""Simulation of the noise of records."""

from __future__ import annotations

import numpy as np

from counterspin.arrays import Array
from counterspin.inference.noise.components import BIAS_COMPONENTS
from counterspin.inference.noise.model import Noise


def add_noise(
    generator: np.random.Generator,
    times: Array,
    signal: Array,
    noise: Noise,
    order: int,
    walk_duration: float = 0.0,
) -> Array:
    """Return a signal with all components of the noise, then quantised.

    times, signal: Regular times, s, and signal, SI, shape (n,).
    order: 2 for displacement, 1 for velocity, 0 for specific force.
    walk_duration: Duration of the walk of the bias before the first time, s.
    """
    if noise.has_bias_instability and times.size > 1:
        signal = signal + draw_bias_noise(generator, times, noise, order, walk_duration)
    signal = signal + draw_accelerometer_noise(generator, times, noise.random_walk, order)
    signal = add_white_noise(generator, signal, noise.white)
    quantisation = noise.quantisation
    return np.round(signal / quantisation) * quantisation if quantisation > 0.0 else signal


def add_white_noise(generator: np.random.Generator, values: Array, sd: float) -> Array:
    """Return values with white noise."""
    noisy: Array = values + sd * generator.standard_normal(values.size)
    return noisy


def draw_accelerometer_noise(
    generator: np.random.Generator, times: Array, random_walk: float, order: int
) -> Array:
    """Draw the effect of the accelerometer's white noise on the observable.

    times: s, increasing, shape (n,).
    random_walk: Coefficient N, m/s^2/Hz^0.5 (velocity variance N^2 t).
    order: 2 for displacement, 1 for velocity, 0 for specific force (the mean over each sample's
        interval).
    Returns: shape (n,), zero at the first time for orders 1 and 2.
    """
    step = np.diff(times)
    if order == 0:
        intervals = np.concatenate([step[:1], step])
        white: Array = random_walk * generator.standard_normal(times.size) / np.sqrt(intervals)
        return white
    # Over a step the walk's velocity gains sqrt(h) z1, its position h^1.5 (z1/2 + z2/sqrt(12)).
    z1, z2 = generator.standard_normal((2, step.size))
    velocity: Array = np.concatenate([[0.0], np.cumsum(random_walk * np.sqrt(step) * z1)])
    if order == 1:
        return velocity
    interval_noise = random_walk * step**1.5 * (0.5 * z1 + z2 / np.sqrt(12.0))
    position: Array = np.concatenate([[0.0], np.cumsum(velocity[:-1] * step + interval_noise)])
    return position


def draw_bias_noise(
    generator: np.random.Generator,
    times: Array,
    noise: Noise,
    order: int,
    walk_duration: float = 0.0,
) -> Array:
    """Draw the effect of the noise of the bias on the observable.

    times: s, evenly spaced, shape (n,), at least 2.
    order: As for `draw_accelerometer_noise`; 0 is the bias itself.
    walk_duration: Duration of the walk of the bias before the first time, s.
    Returns: shape (n,), zero at the first time for orders 1 and 2.
    """
    bias, step = np.zeros(times.size), float(times[1] - times[0])
    for name, component in BIAS_COMPONENTS.items():
        size = getattr(noise, name)
        if size > 0.0:
            bias += component.draw(generator, times, size, walk_duration)
    if order == 0:
        return bias
    # The bias is linear between samples.
    velocity_change = 0.5 * step * (bias[1:] + bias[:-1])
    velocity = np.concatenate([[0.0], np.cumsum(velocity_change)])
    if order == 1:
        return velocity
    displacement_change = velocity[:-1] * step + (2.0 * bias[:-1] + bias[1:]) * step**2 / 6.0
    position: Array = np.concatenate([[0.0], np.cumsum(displacement_change)])
    return position

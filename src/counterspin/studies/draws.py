"""True values of each trial of a study, fixed or drawn, and draws of the noise.

Trials are drawn in batches of a fixed size. Each batch has its own random streams
(`random_stream`), which depend only on the seed of the study and the number of the batch. So a
trial does not depend on the worker, the order or the number of other trials.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import field, replace
from typing import Final, Literal

import numpy as np

from counterspin.arrays import Array
from counterspin.calibration.model import inputs_by_owner
from counterspin.campaign.description import Campaign
from counterspin.campaign.settings import NOISE_UNITS
from counterspin.campaign.static_noise import simulated_noise
from counterspin.frozen import frozen
from counterspin.inference.priors import correlation_matrix
from counterspin.physics.spindle import Ripple, Spindle
from counterspin.physics.terms import ACCELEROMETER_TERMS, INPUTS

WHITE_NOISE: Final = "noise.displacement"  #: per sample, m

#: Units of the noise levels that may vary.
NOISE_LEVEL_UNITS: Final = {
    f"noise.{key}": unit
    for key, unit in NOISE_UNITS.items()
    if key not in ("velocity", "specific_force")
}

#: Noise of noise-free records, by key of [noise].
ZERO_NOISE: Final[Mapping[str, float]] = dict.fromkeys(NOISE_UNITS, 0.0)

#: (owner, symbol, run) of a true value; run is None for a value that all runs share.
TruthKey = tuple[str, str, int | None]

#: Separate random streams of a batch for the truth and for the noise.
TRUTH_STREAM: Final = 0
NOISE_STREAM: Final = 1


def random_stream(seed: int, batch: int, stream: int) -> np.random.Generator:
    """Return a random generator for the truth or for the noise of one batch.

    batch: Index of the batch, from 0.
    stream: `TRUTH_STREAM`, or `NOISE_STREAM` plus the noise stream of an analysis.
    """
    sequence = np.random.SeedSequence(seed, spawn_key=(batch, stream))
    return np.random.Generator(np.random.SFC64(sequence))


def curvature_noise(
    generator: np.random.Generator, white_noise: Array, curvature_scale: Array, n_trials: int
) -> Array:
    """Return the error of b2 due to white noise, m/s^2, shape (runs, trials).

    white_noise: Standard deviation of a strobe in each trial, m, shape (trials,) or (1,).
    curvature_scale: sigma/u(b2) of each run, s^2, shape (runs, trials) or (runs, 1).
    """
    noise = generator.standard_normal((curvature_scale.shape[0], n_trials))
    noise *= white_noise / curvature_scale
    return noise


def residual_variances(
    generator: np.random.Generator, white_noise: Array, dof: Array, n_trials: int
) -> Array:
    """Return the residual variance of each run, m^2, shape (runs, trials).

    dof: Degrees of freedom of each run's residuals, shape (runs,).
    """
    variances = np.stack([generator.standard_gamma(0.5 * run_dof, n_trials) for run_dof in dof])
    variances *= 2.0 * white_noise**2 / dof[:, None]
    return variances


def estimate_noise(
    generator: np.random.Generator,
    sqrt_covariance: Array,
    noise_ratio: Array | float,
    n_trials: int,
) -> Array:
    """Return the errors of the estimates of a joint fit due to noise, shape (c, trials).

    sqrt_covariance: A square root of the estimates' covariance, shape (c, c).
    noise_ratio: True noise divided by assumed noise, shape (trials,) or one number.
    """
    noise: Array = sqrt_covariance @ generator.standard_normal((sqrt_covariance.shape[1], n_trials))
    noise *= noise_ratio
    return noise


DRIFT: Final = "spindle.drift"  #: C, 1/s
RIPPLE_RATIO: Final = "spindle.ripple.ratio"  #: w_1/w0 of the first harmonic
RIPPLE_AMPLITUDE: Final = "spindle.ripple.amplitude"  #: w_1 of the first harmonic, rad/s
RIPPLE_PHASE: Final = "spindle.ripple.phase"  #: phase of the first harmonic, rad

#: Quantities that may vary in addition to the terms of the model, with their units.
OTHER_QUANTITY_UNITS: Final[Mapping[str, str]] = {
    DRIFT: "1/s",
    RIPPLE_RATIO: "1",
    RIPPLE_AMPLITUDE: "rad/s",
    RIPPLE_PHASE: "rad",
    **{symbol: row.unit for symbol, row in INPUTS.items()},
    **NOISE_LEVEL_UNITS,
}

#: Half width of the valid range of a normal distribution, in standard deviations.
_RANGE_HALF_WIDTH: Final = 4.5


@frozen
class VariedQuantity:
    """A quantity that varies from trial to trial."""

    owner: str  #: Accelerometer of a term, or recorder of a clock; empty for shared quantities.
    symbol: str  #: A term of the tables or a key of `OTHER_QUANTITY_UNITS`.
    distribution: Literal["normal", "uniform", "fixed"]
    #: Mean and standard deviation; lowest and highest value; value and 0.
    first_parameter: float
    second_parameter: float
    is_per_run: bool = False  #: True if each run has a separate random value.
    #: Correlations with other quantities by full name; only for normal distributions.
    correlations: Mapping[str, float] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Owner and symbol in one word."""
        return f"{self.owner}.{self.symbol}" if self.owner else self.symbol

    def draw(self, generator: np.random.Generator, n_runs: int, n_trials: int) -> Array:
        """Return samples, shape (runs, trials); an axis with equal values has length 1."""
        n_rows = n_runs if self.is_per_run else 1
        if self.distribution == "normal":
            samples: Array = generator.standard_normal((n_rows, n_trials))
            samples *= self.second_parameter
            samples += self.first_parameter
            return samples
        if self.distribution == "uniform":
            samples = generator.random((n_rows, n_trials))
            samples *= self.second_parameter - self.first_parameter
            samples += self.first_parameter
            return samples
        return np.full((1, 1), self.first_parameter)

    @property
    def value_range(self) -> tuple[float, float]:
        """Lowest and highest value for which the study must be valid."""
        if self.distribution == "normal":
            return (
                self.first_parameter - _RANGE_HALF_WIDTH * self.second_parameter,
                self.first_parameter + _RANGE_HALF_WIDTH * self.second_parameter,
            )
        return (
            self.first_parameter,
            self.second_parameter if self.distribution == "uniform" else self.first_parameter,
        )


@frozen
class Draws:
    """True values of a batch of n trials in r runs.

    An axis of runs or trials with equal values has length 1.
    """

    n_trials: int  #: Number of trials.
    #: (owner, symbol) -> values, shape (r or 1, n or 1): accelerometer terms in g-units, platform
    #: terms in SI.
    values: Mapping[tuple[str, str], Array]
    #: C of each run, 1/s, and (w_1/w0) cos phi and (w_1/w0) sin phi of the first harmonic of the
    #: ripple, shape (r or 1, n or 1).
    drift: Array
    ripple_cos: Array
    ripple_sin: Array
    #: (recorder of a clock, or empty; symbol) -> true minus stated value of an input, SI, shape
    #: (n,) or (1,).
    input_errors: Mapping[tuple[str, str], Array]
    white_noise: Array  #: White noise of a sample, m, shape (n,) or (1,).
    noise_levels: Mapping[str, Array]  #: Other varied noise levels, shape (n,) or (1,).

    def select_trial(self, trial: int) -> Draws:
        """Return the draws of one trial."""
        return self.slice_trials(trial, trial + 1)

    def slice_trials(self, start: int, stop: int) -> Draws:
        """Return the draws of the trials from `start` to `stop`."""

        def select(values: Array) -> Array:
            return values if values.shape[-1] == 1 else values[..., start:stop]

        return Draws(
            stop - start,
            {key: select(value) for key, value in self.values.items()},
            select(self.drift),
            select(self.ripple_cos),
            select(self.ripple_sin),
            {key: select(value) for key, value in self.input_errors.items()},
            select(self.white_noise),
            {key: select(value) for key, value in self.noise_levels.items()},
        )

    def rotation_parameters(self, run: int) -> list[Array]:
        """Return the drift of a run, and the cosine and sine of its ripple, (n,) or (1,) each."""
        return [run_values(rows, run) for rows in (self.drift, self.ripple_cos, self.ripple_sin)]

    def noise_sizes(self, sizes: Mapping[str, float]) -> dict[str, float]:
        """Return `sizes`, by key of [noise], with the mean values of varied noise levels."""
        mean_levels = {symbol: float(level.mean()) for symbol, level in self.noise_levels.items()}
        levels = {symbol.removeprefix("noise."): level for symbol, level in mean_levels.items()}
        return {**sizes, "displacement": float(self.white_noise.mean()), **levels}

    def deviation(self, key: TruthKey) -> Array:
        """Return a true value minus its nominal or stated value, shape (n,) or (1,)."""
        owner, symbol, run = key
        if symbol in INPUTS:
            return self.input_error(symbol, owner)
        return run_values(self.values[owner, symbol], run or 0) - nominal_value(owner, symbol)

    def shift_rotation(self, index: int, shift: Array) -> Draws:
        """Return the draws with one rotation parameter of each run shifted.

        index: 0 for the drift, 1 for the cosine of the ripple, 2 for its sine.
        shift: Shape (runs,).
        """
        rotation = [self.drift, self.ripple_cos, self.ripple_sin]
        rotation[index] = rotation[index] + shift[:, None]
        return replace(self, drift=rotation[0], ripple_cos=rotation[1], ripple_sin=rotation[2])

    def input_error(self, symbol: str, recorder: str = "") -> Array:
        """Return the deviation of an input from its stated value, shape (n,) or (1,)."""
        return self.input_errors.get((recorder, symbol), np.zeros(1))

    def mean(self, owner: str, symbol: str) -> Array:
        """Return the mean of a coefficient over the runs in each trial, shape (n,)."""
        if (owner, symbol) not in self.values:
            return np.full(self.n_trials, nominal_value(owner, symbol))
        value = self.values[owner, symbol]
        return np.broadcast_to(value.mean(axis=0), self.n_trials)

    def true_spindle(self, spindle: Spindle, run: int) -> Spindle:
        """Return the true rotation of one run in the first trial."""
        cos, sin = (float(run_values(rows, run)[0]) for rows in (self.ripple_cos, self.ripple_sin))
        other_ripples = tuple(ripple for ripple in spindle.ripples if ripple.harmonic != 1)
        first_harmonic = Ripple(
            1, spindle.rate * float(np.hypot(cos, sin)), float(np.arctan2(sin, cos))
        )
        drift = float(run_values(self.drift, run)[0])
        return Spindle(spindle.rate, drift, (first_harmonic, *other_ripples), spindle.start_angle)


@frozen
class StudyTruth:
    """True values of a study."""

    #: (owner, symbol) -> value of each run, shape (r,) or (1,).
    fixed_values: Mapping[tuple[str, str], Array]
    spindles: tuple[Spindle, ...]  #: Spindle of each run, with the fixed values.
    #: (recorder of a clock, or empty; symbol) -> stated value of an active input, SI.
    stated_inputs: Mapping[tuple[str, str], float]
    fixed_inputs: Mapping[tuple[str, str], float]  #: True values of the inputs that do not vary.
    #: White noise of a sample of the first accelerometer, SI, if it does not vary.
    white_noise: float
    varied_quantities: tuple[VariedQuantity, ...]  #: The quantities that vary.

    @classmethod
    def from_campaign(
        cls, campaign: Campaign, varied_quantities: tuple[VariedQuantity, ...]
    ) -> StudyTruth:
        """Combine [truth] of a campaign with the varied quantities."""
        assert campaign.simulation is not None
        fixed_values: dict[tuple[str, str], Array] = {
            ("", symbol): np.array([value])
            for symbol, value in campaign.simulation.truth.machine.items()
        } | {
            (name, symbol): np.array([value])
            for name, coefficients in campaign.simulation.truth.coefficients.items()
            for symbol, value in coefficients.items()
        }
        platform_truths = [run.shared for run in campaign.simulation.truth.runs.values()]
        for symbol in dict.fromkeys(
            symbol for platform_values in platform_truths for symbol in platform_values
        ):
            fixed_values["", symbol] = np.array(
                [platform_values.get(symbol, 0.0) for platform_values in platform_truths]
            )
        first_accelerometer = next(iter(campaign.accelerometers.values()))
        stated_inputs = {key: quantity.value for key, quantity in inputs_by_owner(campaign).items()}
        true_inputs = campaign.simulation.truth.inputs
        fixed_inputs = {key: true_inputs.get(key, value) for key, value in stated_inputs.items()}
        for quantity in varied_quantities:
            fixed_values.pop((quantity.owner, quantity.symbol), None)
            fixed_inputs.pop((quantity.owner, quantity.symbol), None)
        return cls(
            fixed_values=fixed_values,
            spindles=tuple(run.spindle for run in campaign.simulation.truth.runs.values()),
            stated_inputs=stated_inputs,
            fixed_inputs=fixed_inputs,
            white_noise=simulated_noise(campaign)[first_accelerometer.observable],
            varied_quantities=varied_quantities,
        )

    def draw(self, generator: np.random.Generator, n_trials: int) -> Draws:
        """Draw the true values of trials, in the order of the varied quantities."""
        n_runs = len(self.spindles)
        values = {key: value[:, None] for key, value in self.fixed_values.items()}
        drift = np.array([[spindle.drift] for spindle in self.spindles])
        ratio, phase = (np.array(column)[:, None] for column in self._first_harmonics())
        white_noise = np.array([self.white_noise])
        input_errors = {
            key: np.array([value - self.stated_inputs[key]])
            for key, value in self.fixed_inputs.items()
        }
        noise_levels: dict[str, Array] = {}
        all_samples = [
            quantity.draw(generator, n_runs, n_trials) for quantity in self.varied_quantities
        ]
        _correlate_samples(self.varied_quantities, all_samples)
        for quantity, samples in zip(self.varied_quantities, all_samples, strict=True):
            if quantity.symbol == DRIFT:
                drift = samples
            elif quantity.symbol == RIPPLE_RATIO:
                ratio = samples
            elif quantity.symbol == RIPPLE_AMPLITUDE:
                ratio = samples / np.array([[spindle.rate] for spindle in self.spindles])
            elif quantity.symbol == RIPPLE_PHASE:
                phase = samples
            elif (key := (quantity.owner, quantity.symbol)) in self.stated_inputs:
                input_errors[key] = samples[0] - self.stated_inputs[key]
            elif quantity.symbol == WHITE_NOISE:
                white_noise = np.abs(samples[0])
            elif quantity.symbol in NOISE_LEVEL_UNITS:
                noise_levels[quantity.symbol] = np.abs(samples[0])
            else:
                values[quantity.owner, quantity.symbol] = samples
        cos, sin = ratio * np.cos(phase), ratio * np.sin(phase)
        return Draws(n_trials, values, drift, cos, sin, input_errors, white_noise, noise_levels)

    def mean_draw(self) -> Draws:
        """Return a trial with the mean values of all varied quantities."""
        fixed_quantities = tuple(
            replace(
                quantity,
                distribution="fixed",
                first_parameter=0.5 * sum(quantity.value_range),
                is_per_run=False,
            )
            for quantity in self.varied_quantities
        )
        draw = replace(self, varied_quantities=fixed_quantities).draw(np.random.default_rng(0), 1)
        runs = range(len(self.spindles))
        drift, cos, sin = np.array([self.rotation_bounds(run).mean(axis=1) for run in runs]).T
        return replace(draw, drift=drift[:, None], ripple_cos=cos[:, None], ripple_sin=sin[:, None])

    def rotation_bounds(self, run: int) -> Array:
        """Return the lowest and highest drift, ripple cosine and ripple sine, shape (3, 2)."""
        ratio_bounds, phase = self.bounds(RIPPLE_RATIO, run), self.bounds(RIPPLE_PHASE, run)[0]
        if self.varies(RIPPLE_RATIO, RIPPLE_AMPLITUDE, RIPPLE_PHASE):
            max_ratio = max(map(abs, ratio_bounds))
            cos, sin = (-max_ratio, max_ratio), (-max_ratio, max_ratio)
        else:
            cos, sin = (
                (ratio_bounds[0] * trig_function(phase),) * 2 for trig_function in (np.cos, np.sin)
            )
        return np.array([self.bounds(DRIFT, run), cos, sin])

    def mean(self, owner: str, symbol: str) -> float:
        """Return the mean true value of a coefficient; minus the stated value for an input.

        A platform term of a run has the true value of the platform.
        """
        owner = owner if symbol in ACCELEROMETER_TERMS or symbol in INPUTS else ""
        stated_value = self.stated_inputs.get((owner, symbol), 0.0)
        for quantity in self.varied_quantities:
            if (quantity.owner, quantity.symbol) == (owner, symbol):
                return 0.5 * sum(quantity.value_range) - stated_value
        if (owner, symbol) in self.fixed_inputs:
            return self.fixed_inputs[owner, symbol] - stated_value
        value = self.fixed_values.get((owner, symbol))
        return nominal_value(owner, symbol) if value is None else float(value.mean())

    def _first_harmonics(self) -> tuple[list[float], list[float]]:
        """Return the ratio and the phase of the first ripple harmonic of each run."""
        ratios, phases = [], []
        for spindle in self.spindles:
            first_harmonics = [ripple for ripple in spindle.ripples if ripple.harmonic == 1]
            ratios.append(first_harmonics[0].amplitude / spindle.rate if first_harmonics else 0.0)
            phases.append(first_harmonics[0].phase if first_harmonics else 0.0)
        return ratios, phases

    def varies(self, *symbols: str) -> bool:
        """Check that any of the quantities varies."""
        return any(
            quantity.symbol in symbols and quantity.distribution != "fixed"
            for quantity in self.varied_quantities
        )

    @property
    def symbols(self) -> dict[str, tuple[str, ...]]:
        """Symbols of the non-nominal terms by owner; the owner of platform terms is ''."""
        keys = [
            *self.fixed_values,
            *((quantity.owner, quantity.symbol) for quantity in self.varied_quantities),
        ]
        keys = [key for key in keys if key[1] not in OTHER_QUANTITY_UNITS]
        owners = dict.fromkeys(owner for owner, _ in keys)
        return {
            owner: tuple(dict.fromkeys(symbol for key_owner, symbol in keys if key_owner == owner))
            for owner in owners
        }

    def bounds(self, symbol: str, run: int) -> tuple[float, float]:
        """Return the lowest and highest value of a spindle quantity in a run."""
        spindle = self.spindles[run]
        for quantity in self.varied_quantities:
            if symbol == RIPPLE_RATIO and quantity.symbol == RIPPLE_AMPLITUDE:
                low, high = sorted(bound / spindle.rate for bound in quantity.value_range)
                return low, high
            if quantity.symbol == symbol:
                return quantity.value_range
        ratios, phases = self._first_harmonics()
        value = {DRIFT: spindle.drift, RIPPLE_RATIO: ratios[run], RIPPLE_PHASE: phases[run]}[symbol]
        return value, value


def _correlate_samples(quantities: Sequence[VariedQuantity], samples: Sequence[Array]) -> None:
    """Correlate independent samples of normal quantities in place."""
    indices = [
        index
        for index, quantity in enumerate(quantities)
        if quantity.correlations and quantity.distribution == "normal"
    ]
    if not indices:
        return
    names = [quantities[index].name for index in indices]
    correlations = {quantities[index].name: quantities[index].correlations for index in indices}
    mean, sd = (
        np.array([getattr(quantities[index], parameter) for index in indices])[:, None]
        for parameter in ("first_parameter", "second_parameter")
    )
    standard_samples = (np.vstack([samples[index] for index in indices]) - mean) / sd
    cholesky_factor = np.linalg.cholesky(correlation_matrix(names, correlations))
    for index, values in zip(
        indices, mean + sd * (cholesky_factor @ standard_samples), strict=True
    ):
        samples[index][:] = values


def run_values(values: Array, run: int) -> Array:
    """Return the values of a run, shape (n,) or (1,); a single row applies to all runs."""
    row: Array = values[min(run, values.shape[0] - 1)]
    return row


def nominal_value(owner: str, symbol: str) -> float:
    """Return the value of a coefficient in a perfect system."""
    return ACCELEROMETER_TERMS[symbol].nominal if owner else 0.0

"""True values of each trial of a study, fixed or drawn, and draws of the noise.

Trials are drawn in batches of a fixed size. Each batch has its own random streams
(`random_stream`), derived from the study's seed and the batch's number alone. So a trial does not
depend on the worker, the order or the number of other trials.
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

WHITE: Final = "noise.displacement"  #: of a sample, m

#: Level that may vary -> its unit.
NOISE_LEVELS: Final = {
    f"noise.{key}": unit
    for key, unit in NOISE_UNITS.items()
    if key not in ("velocity", "specific_force")
}

#: Sizes of the noise of records without noise, by key of [noise].
NOISE_FREE: Final[Mapping[str, float]] = dict.fromkeys(NOISE_UNITS, 0.0)

#: (owner, symbol, run) of a term or an input that is true; run is None where the runs share one.
Key = tuple[str, str, int | None]

#: Streams of a batch: the truth and the noise are drawn apart.
TRUTH_STREAM: Final = 0
NOISE_STREAM: Final = 1


def random_stream(seed: int, batch: int, number: int) -> np.random.Generator:
    """Return a random generator for the truth or for the noise of one batch.

    batch: Index of the batch, from 0.
    number: `TRUTH_STREAM`, or `NOISE_STREAM` plus the noise stream of an analysis.
    """
    sequence = np.random.SeedSequence(seed, spawn_key=(batch, number))
    return np.random.Generator(np.random.SFC64(sequence))


def curvature_noise(
    generator: np.random.Generator, white: Array, curvature_scale: Array, trials: int
) -> Array:
    """Return the error of b2 due to white noise, m/s^2, shape (runs, trials).

    white: Standard deviation of a strobe in each trial, m, shape (trials,) or (1,).
    curvature_scale: sigma/u(b2) of each run, s^2, shape (runs, trials) or (runs, 1).
    """
    noise = generator.standard_normal((curvature_scale.shape[0], trials))
    noise *= white / curvature_scale
    return noise


def residual_variances(
    generator: np.random.Generator, white: Array, dof: Array, trials: int
) -> Array:
    """Return the variance that the residuals of each run show, m^2, shape (runs, trials).

    dof: Degrees of freedom of each run's residuals, shape (runs,).
    """
    variances = np.stack([generator.standard_gamma(0.5 * run_dof, trials) for run_dof in dof])
    variances *= 2.0 * white**2 / dof[:, None]
    return variances


def estimate_noise(
    generator: np.random.Generator, sqrt_covariance: Array, noise_ratio: Array | float, trials: int
) -> Array:
    """Return the errors of the estimates of a joint fit due to noise, shape (c, trials).

    sqrt_covariance: A square root of the estimates' covariance, shape (c, c).
    noise_ratio: True noise divided by assumed noise, shape (trials,) or one number.
    """
    noise: Array = sqrt_covariance @ generator.standard_normal((sqrt_covariance.shape[1], trials))
    noise *= noise_ratio
    return noise


DRIFT: Final = "spindle.drift"  #: C, 1/s
RIPPLE_RATIO: Final = "spindle.ripple.ratio"  #: w_1/w0 of the first harmonic
RIPPLE_AMPLITUDE: Final = "spindle.ripple.amplitude"  #: or its w_1, rad/s
RIPPLE_PHASE: Final = "spindle.ripple.phase"  #: its phase, rad

#: Quantities that may vary in addition to the terms of the model, with their units.
OTHER_QUANTITIES: Final[Mapping[str, str]] = {
    DRIFT: "1/s",
    RIPPLE_RATIO: "1",
    RIPPLE_AMPLITUDE: "rad/s",
    RIPPLE_PHASE: "rad",
    **{symbol: row.unit for symbol, row in INPUTS.items()},
    **NOISE_LEVELS,
}

#: Half width of the range of a normal distribution for which a study must be valid, in sd.
_RANGE_IN_SDS: Final = 4.5


@frozen
class VariedQuantity:
    """A quantity that varies from trial to trial."""

    owner: str  #: The accelerometer of a term of its own, the recorder of a clock; else empty.
    symbol: str  #: A term of the tables or a key of `OTHER_QUANTITIES`.
    distribution: Literal["normal", "uniform", "fixed"]
    #: Mean and standard deviation; least and greatest value; value and 0.
    first: float
    second: float
    per_run: bool = False  #: Whether every run of a trial has a value of its own.
    #: Full names of other quantities -> correlation with them; of normal ones only.
    correlations: Mapping[str, float] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Owner and symbol in one word."""
        return f"{self.owner}.{self.symbol}" if self.owner else self.symbol

    def draw(self, generator: np.random.Generator, runs: int, trials: int) -> Array:
        """Return values, shape (runs, trials); an axis whose values are equal has length 1."""
        rows = runs if self.per_run else 1
        if self.distribution == "normal":
            drawn: Array = generator.standard_normal((rows, trials))
            drawn *= self.second
            drawn += self.first
            return drawn
        if self.distribution == "uniform":
            drawn = generator.random((rows, trials))
            drawn *= self.second - self.first
            drawn += self.first
            return drawn
        return np.full((1, 1), self.first)

    @property
    def value_range(self) -> tuple[float, float]:
        """The lowest and highest value for which the study must be valid."""
        if self.distribution == "normal":
            return (
                self.first - _RANGE_IN_SDS * self.second,
                self.first + _RANGE_IN_SDS * self.second,
            )
        return (self.first, self.second if self.distribution == "uniform" else self.first)


@frozen
class Draws:
    """The truth of a batch of n trials in r runs.

    Where the runs or the trials have a value in common, their axis has length 1, so that constant
    values cost nothing.
    """

    trials: int  #: How many there are.
    #: (owner, symbol) -> values, shape (r or 1, n or 1): accelerometer terms in g-units, platform
    #: terms in SI.
    values: Mapping[tuple[str, str], Array]
    #: Of each run: C in 1/s, and the first harmonic's (w_1/w0) cos phi and (w_1/w0) sin phi, shape
    #: (r or 1, n or 1).
    drift: Array
    ripple_cos: Array
    ripple_sin: Array
    #: (recorder of a clock, else empty; symbol) -> input, SI, minus its stated value, shape (n,)
    #: or (1,).
    inputs: Mapping[tuple[str, str], Array]
    white: Array  #: m, shape (n,) or (1,).
    noise: Mapping[str, Array]  #: Other noise levels that vary, shape (n,) or (1,).

    def take(self, trial: int) -> Draws:
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
            {key: select(value) for key, value in self.inputs.items()},
            select(self.white),
            {key: select(value) for key, value in self.noise.items()},
        )

    def rotation_parameters(self, run: int) -> list[Array]:
        """Return a run's drift, and cosine and sine amplitudes of its ripple, (n,) or (1,) each."""
        return [
            run_values(values, run) for values in (self.drift, self.ripple_cos, self.ripple_sin)
        ]

    def noise_sizes(self, sizes: Mapping[str, float]) -> dict[str, float]:
        """Return sizes of the noise, by key of [noise], with the means of those that vary."""
        levels = {symbol: float(level.mean()) for symbol, level in self.noise.items()}
        varied = {symbol.removeprefix("noise."): level for symbol, level in levels.items()}
        return {**sizes, "displacement": float(self.white.mean()), **varied}

    def deviation(self, key: Key) -> Array:
        """Return a true value minus its nominal or stated one, shape (n,) or (1,)."""
        owner, symbol, run = key
        if symbol in INPUTS:
            return self.input_error(symbol, owner)
        return run_values(self.values[owner, symbol], run or 0) - nominal_value(owner, symbol)

    def shift_rotation(self, index: int, shift: Array) -> Draws:
        """Return the draws with one rotation parameter of each run shifted.

        index: 0 for the drift, 1 for the ripple's cosine, 2 for its sine.
        shift: Shape (runs,).
        """
        parameters = [self.drift, self.ripple_cos, self.ripple_sin]
        parameters[index] = parameters[index] + shift[:, None]
        return replace(
            self, drift=parameters[0], ripple_cos=parameters[1], ripple_sin=parameters[2]
        )

    def input_error(self, symbol: str, recorder: str = "") -> Array:
        """Return the deviation of an input from its stated value, shape (n,) or (1,)."""
        return self.inputs.get((recorder, symbol), np.zeros(1))

    def mean(self, owner: str, symbol: str) -> Array:
        """Return a coefficient's mean over the runs in each trial, shape (n,)."""
        if (owner, symbol) not in self.values:
            return np.full(self.trials, nominal_value(owner, symbol))
        value = self.values[owner, symbol]
        return np.broadcast_to(value.mean(axis=0), self.trials)

    def true_spindle(self, base: Spindle, run: int) -> Spindle:
        """Return the true rotation of one run in the first trial."""
        cos, sin = (float(run_values(part, run)[0]) for part in (self.ripple_cos, self.ripple_sin))
        harmonics = tuple(ripple for ripple in base.ripples if ripple.harmonic != 1)
        first_harmonic = Ripple(
            1, base.rate * float(np.hypot(cos, sin)), float(np.arctan2(sin, cos))
        )
        drift = float(run_values(self.drift, run)[0])
        return Spindle(base.rate, drift, (first_harmonic, *harmonics), base.start_angle)


@frozen
class StudyTruth:
    """The true values of a study."""

    #: (owner, symbol) -> value of each run, shape (r,) or (1,).
    fixed: Mapping[tuple[str, str], Array]
    spindles: tuple[Spindle, ...]  #: Of each run, with the constant values.
    #: (recorder of a clock, else empty; symbol) -> the stated value of an active input, SI.
    stated: Mapping[tuple[str, str], float]
    inputs: Mapping[tuple[str, str], float]  #: True values of the inputs that do not vary.
    #: Standard deviation of a sample of the first accelerometer, SI, where it does not vary.
    white: float
    varying: tuple[VariedQuantity, ...]  #: The quantities that vary.

    @classmethod
    def from_campaign(cls, campaign: Campaign, varying: tuple[VariedQuantity, ...]) -> StudyTruth:
        """Combine a campaign's [truth] with the quantities that vary."""
        assert campaign.simulation is not None
        fixed: dict[tuple[str, str], Array] = {
            ("", symbol): np.array([value])
            for symbol, value in campaign.simulation.truth.machine.items()
        } | {
            (name, symbol): np.array([value])
            for name, coefficients in campaign.simulation.truth.coefficients.items()
            for symbol, value in coefficients.items()
        }
        platforms = [run.shared for run in campaign.simulation.truth.runs.values()]
        for symbol in dict.fromkeys(symbol for platform in platforms for symbol in platform):
            fixed["", symbol] = np.array([platform.get(symbol, 0.0) for platform in platforms])
        first_accelerometer = next(iter(campaign.accelerometers.values()))
        stated = {key: input_value.value for key, input_value in inputs_by_owner(campaign).items()}
        true_inputs = campaign.simulation.truth.inputs
        inputs = {key: true_inputs.get(key, value) for key, value in stated.items()}
        for quantity in varying:
            fixed.pop((quantity.owner, quantity.symbol), None)
            inputs.pop((quantity.owner, quantity.symbol), None)
        return cls(
            fixed=fixed,
            spindles=tuple(run.spindle for run in campaign.simulation.truth.runs.values()),
            stated=stated,
            inputs=inputs,
            white=simulated_noise(campaign)[first_accelerometer.observable],
            varying=varying,
        )

    def draw(self, generator: np.random.Generator, trials: int) -> Draws:
        """Draw the truth of some trials, quantity after quantity in the study's order."""
        runs = len(self.spindles)
        values = {key: value[:, None] for key, value in self.fixed.items()}
        drift = np.array([[s.drift] for s in self.spindles])
        ratio, phase = (
            np.array(values_by_run)[:, None] for values_by_run in self._first_harmonics()
        )
        white = np.array([self.white])
        inputs = {key: np.array([value - self.stated[key]]) for key, value in self.inputs.items()}
        noise: dict[str, Array] = {}
        drawn = [quantity.draw(generator, runs, trials) for quantity in self.varying]
        _correlate(self.varying, drawn)
        for quantity, drawn_values in zip(self.varying, drawn, strict=True):
            if quantity.symbol == DRIFT:
                drift = drawn_values
            elif quantity.symbol == RIPPLE_RATIO:
                ratio = drawn_values
            elif quantity.symbol == RIPPLE_AMPLITUDE:
                ratio = drawn_values / np.array([[spindle.rate] for spindle in self.spindles])
            elif quantity.symbol == RIPPLE_PHASE:
                phase = drawn_values
            elif (key := (quantity.owner, quantity.symbol)) in self.stated:
                inputs[key] = drawn_values[0] - self.stated[key]
            elif quantity.symbol == WHITE:
                white = np.abs(drawn_values[0])
            elif quantity.symbol in NOISE_LEVELS:
                noise[quantity.symbol] = np.abs(drawn_values[0])
            else:
                values[quantity.owner, quantity.symbol] = drawn_values
        cos, sin = ratio * np.cos(phase), ratio * np.sin(phase)
        return Draws(trials, values, drift, cos, sin, inputs, white, noise)

    def mean_draw(self) -> Draws:
        """Return a trial in which every quantity that varies has its mean value."""
        fixed = tuple(
            replace(
                quantity, distribution="fixed", first=0.5 * sum(quantity.value_range), per_run=False
            )
            for quantity in self.varying
        )
        draws = replace(self, varying=fixed).draw(np.random.default_rng(0), 1)
        runs = range(len(self.spindles))
        drift, cos, sin = np.array([self.rotation_bounds(run).mean(axis=1) for run in runs]).T
        return replace(
            draws, drift=drift[:, None], ripple_cos=cos[:, None], ripple_sin=sin[:, None]
        )

    def rotation_bounds(self, run: int) -> Array:
        """Return the lowest and highest drift, ripple cosine and ripple sine, shape (3, 2)."""
        ratio, phase = self.bounds(RIPPLE_RATIO, run), self.bounds(RIPPLE_PHASE, run)[0]
        if self.varies(RIPPLE_RATIO, RIPPLE_AMPLITUDE, RIPPLE_PHASE):
            largest = max(map(abs, ratio))
            cos, sin = (-largest, largest), (-largest, largest)
        else:
            cos, sin = ((ratio[0] * function(phase),) * 2 for function in (np.cos, np.sin))
        return np.array([self.bounds(DRIFT, run), cos, sin])

    def mean(self, owner: str, symbol: str) -> float:
        """Return the mean true value of a coefficient; one of a run has the platform's truth.

        For an input, return the mean true value minus the stated value.
        """
        owner = owner if symbol in ACCELEROMETER_TERMS or symbol in INPUTS else ""
        stated = self.stated.get((owner, symbol), 0.0)
        for quantity in self.varying:
            if (quantity.owner, quantity.symbol) == (owner, symbol):
                return 0.5 * sum(quantity.value_range) - stated
        if (owner, symbol) in self.inputs:
            return self.inputs[owner, symbol] - stated
        value = self.fixed.get((owner, symbol))
        return nominal_value(owner, symbol) if value is None else float(value.mean())

    def _first_harmonics(self) -> tuple[list[float], list[float]]:
        """Return ratio and phase of every run's first harmonic."""
        ratios, phases = [], []
        for spindle in self.spindles:
            first_harmonics = [ripple for ripple in spindle.ripples if ripple.harmonic == 1]
            ratios.append(first_harmonics[0].amplitude / spindle.rate if first_harmonics else 0.0)
            phases.append(first_harmonics[0].phase if first_harmonics else 0.0)
        return ratios, phases

    def varies(self, *symbols: str) -> bool:
        """Check for variation in any of the given quantities."""
        return any(
            quantity.symbol in symbols and quantity.distribution != "fixed"
            for quantity in self.varying
        )

    @property
    def symbols(self) -> dict[str, tuple[str, ...]]:
        """Owner -> the terms that are not nominal in every trial; the platform's owner is ''."""
        keys = [*self.fixed, *((quantity.owner, quantity.symbol) for quantity in self.varying)]
        keys = [key for key in keys if key[1] not in OTHER_QUANTITIES]
        owners = dict.fromkeys(owner for owner, _ in keys)
        return {
            owner: tuple(dict.fromkeys(symbol for key_owner, symbol in keys if key_owner == owner))
            for owner in owners
        }

    def bounds(self, symbol: str, run: int) -> tuple[float, float]:
        """Return the least and greatest value of a spindle quantity in a run."""
        for quantity in self.varying:
            if symbol == RIPPLE_RATIO and quantity.symbol == RIPPLE_AMPLITUDE:
                low, high = sorted(
                    bound / self.spindles[run].rate for bound in quantity.value_range
                )
                return low, high
            if quantity.symbol == symbol:
                return quantity.value_range
        spindle = self.spindles[run]
        ratios, phases = self._first_harmonics()
        value = {
            DRIFT: spindle.drift,
            RIPPLE_RATIO: ratios[run],
            RIPPLE_PHASE: phases[run],
        }[symbol]
        return value, value


def _correlate(quantities: Sequence[VariedQuantity], drawn: Sequence[Array]) -> None:
    """Correlate values of normal quantities that were drawn independently, in place."""
    places = [
        place
        for place, quantity in enumerate(quantities)
        if quantity.correlations and quantity.distribution == "normal"
    ]
    if not places:
        return
    names = [quantities[place].name for place in places]
    correlations = {quantities[place].name: quantities[place].correlations for place in places}
    mean, sd = (
        np.array([getattr(quantities[place], part) for place in places])[:, None]
        for part in ("first", "second")
    )
    standard = (np.vstack([drawn[place] for place in places]) - mean) / sd
    root = np.linalg.cholesky(correlation_matrix(names, correlations))
    for place, values in zip(places, mean + sd * (root @ standard), strict=True):
        drawn[place][:] = values


def run_values(values: Array, run: int) -> Array:
    """Return the values of one run, shape (n,) or (1,); a single row applies to all runs."""
    row: Array = values[min(run, values.shape[0] - 1)]
    return row


def nominal_value(owner: str, symbol: str) -> float:
    """Return the value of a coefficient in a perfect system."""
    return ACCELEROMETER_TERMS[symbol].nominal if owner else 0.0

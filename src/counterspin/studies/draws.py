"""True values of each trial of a study, fixed or drawn, and draws of the noise.

Trials are drawn in batches of a fixed size. Each batch has random streams of its own
(`counterspin.studies.draws.stream`), derived from the study's seed and the batch's number alone,
so that a trial does not depend on the worker, the order or the number of other trials.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Final, Literal

import numpy as np

from counterspin.arrays import Array
from counterspin.calibration.model import inputs_by_owner
from counterspin.campaign.description import Campaign
from counterspin.campaign.static_noise import simulated_noise
from counterspin.frozen import frozen
from counterspin.physics import simulation
from counterspin.physics.observation import ORDERS
from counterspin.physics.spindle import Ripple, Spindle
from counterspin.physics.terms import ACCELEROMETER_TERMS, INPUTS

WHITE: Final = "noise.displacement"  #: of a sample, m

#: Level that may vary -> its unit and its field of `RecordNoise`.
NOISE_LEVELS: Final[Mapping[str, tuple[str, str]]] = {
    WHITE: ("m", "white"),
    "noise.acceleration": ("m/s^2/Hz^0.5", "random_walk"),
    "noise.flicker": ("m/s^2", "flicker"),
    "noise.bias_walk": ("m/s^2/s^0.5", "bias_walk"),
    "noise.quantisation": ("m", "quantisation"),
    "noise.angle": ("rad", "angle"),
    "noise.timing": ("s", "timing"),
}

#: (owner, symbol, run) of a term or an input that is true; run is None where the runs share one.
Key = tuple[str, str, int | None]

#: Streams of a batch: the truth and the noise are drawn apart.
TRUTH_STREAM: Final = 0
NOISE_STREAM: Final = 1


def stream(seed: int, batch: int, which: int) -> np.random.Generator:
    """Return the random numbers of one batch, for its truth or for its noise.

    batch: Number of the batch, from 0.
    """
    sequence = np.random.SeedSequence(seed, spawn_key=(batch, which))
    return np.random.Generator(np.random.SFC64(sequence))


@frozen
class RecordNoise:
    """Noise of whole records."""

    #: Standard deviations of a sample's displacement, velocity and specific force, SI.
    white: float = 0.0
    velocity: float = 0.0
    specific_force: float = 0.0
    random_walk: float = 0.0  #: Coefficient N of the accelerometer's white noise, m/s^2/Hz^0.5.
    quantisation: float = 0.0  #: Step of the recorded displacement, m.
    #: Standard deviations of a recorded angle and of a time stamp, rad and s.
    angle: float = 0.0
    timing: float = 0.0
    #: Wander of the accelerometer's bias: m/s^2, m/s^2/s^0.5.
    flicker: float = 0.0
    bias_walk: float = 0.0

    @property
    def wanders(self) -> bool:
        """True if the bias has coloured noise."""
        return self.flicker > 0.0 or self.bias_walk > 0.0

    def stamps(self, generator: np.random.Generator, times: Array) -> Array:
        """Return the time stamps of samples taken at these times, s."""
        return np.asarray(times + self.timing * generator.standard_normal(times.size))

    def angles(self, generator: np.random.Generator, angles: Array) -> Array:
        """Return these angles as they are recorded, rad."""
        return np.asarray(angles + self.angle * generator.standard_normal(angles.size))

    def white_of(self, observable: str) -> float:
        """Return the standard deviation of a sample, SI."""
        sizes = {"velocity": self.velocity, "specific_force": self.specific_force}
        return sizes.get(observable, self.white)

    def signals(
        self,
        generator: np.random.Generator,
        times: Array,
        signal: Array,
        observable: str = "displacement",
        before: float = 0.0,
    ) -> Array:
        """Return a signal as it is recorded, `before` s after a bias began to walk, SI."""
        order = ORDERS[observable]
        if self.wanders:
            signal = signal + simulation.bias_wander(
                generator, times, self.flicker, self.bias_walk, order, before
            )
        walk = simulation.accelerometer_walk(generator, times, self.random_walk, order)
        white = self.white_of(observable)
        recorded = signal + walk + white * generator.standard_normal(times.size)
        step = self.quantisation if observable == "displacement" else 0.0
        return np.asarray(np.round(recorded / step) * step if step > 0.0 else recorded)


def curvature_noise(
    generator: np.random.Generator, white: Array, sizes: Array, trials: int
) -> Array:
    """Return the error of b2 due to white noise, m/s^2, shape (runs, trials).

    white: Standard deviation of a strobe in each trial, m, shape (trials,) or (1,).
    sizes: sigma/u(b2) of each run, s^2, shape (runs, trials) or (runs, 1).
    """
    noise = generator.standard_normal((sizes.shape[0], trials))
    noise *= white / sizes
    return noise


def residual_variances(
    generator: np.random.Generator, white: Array, dof: Array, trials: int
) -> Array:
    """Return the variance that the residuals of each run show, m^2, shape (runs, trials).

    dof: Degrees of freedom of each run's residuals, shape (runs,).
    """
    variances = np.stack([generator.standard_gamma(0.5 * freedom, trials) for freedom in dof])
    variances *= 2.0 * white**2 / dof[:, None]
    return variances


def estimate_noise(
    generator: np.random.Generator, spread: Array, scale: Array | float, trials: int
) -> Array:
    """Return the errors of the estimates of a joint fit due to noise, shape (c, trials).

    spread: A square root of the estimates' covariance, shape (c, c).
    scale: True over assumed noise, shape (trials,) or one number.
    """
    noise: Array = spread @ generator.standard_normal((spread.shape[1], trials))
    noise *= scale
    return noise


DRIFT: Final = "spindle.drift"  #: C, 1/s
RIPPLE_RATIO: Final = "spindle.ripple.ratio"  #: w_1/w0 of the first harmonic
RIPPLE_AMPLITUDE: Final = "spindle.ripple.amplitude"  #: or its w_1, rad/s
RIPPLE_PHASE: Final = "spindle.ripple.phase"  #: its phase, rad

#: Quantities that may vary in addition to the terms of the model, with their units.
OTHERS: Final[Mapping[str, str]] = {
    DRIFT: "1/s",
    RIPPLE_RATIO: "1",
    RIPPLE_AMPLITUDE: "rad/s",
    RIPPLE_PHASE: "rad",
    **{symbol: row.unit for symbol, row in INPUTS.items()},
    **{symbol: unit for symbol, (unit, _) in NOISE_LEVELS.items()},
}

#: How many standard deviations of a normal distribution a study must be valid for.
_VALID_SDS: Final = 4.5


@frozen
class VariedQuantity:
    """A quantity that varies from trial to trial."""

    owner: str  #: The accelerometer of a term of its own, the recorder of a clock; else empty.
    symbol: str  #: A term of the tables or a key of `OTHERS`.
    distribution: Literal["normal", "uniform", "fixed"]
    #: Mean and standard deviation; least and greatest value; value and 0.
    first: float
    second: float
    per_run: bool = False  #: Whether every run of a trial has a value of its own.

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
    def reach(self) -> tuple[float, float]:
        """The least and greatest value that matter."""
        if self.distribution == "normal":
            return self.first - _VALID_SDS * self.second, self.first + _VALID_SDS * self.second
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
        """Return one of the trials by itself."""
        return self.part(trial, trial + 1)

    def part(self, start: int, stop: int) -> Draws:
        """Return some of the trials by themselves."""

        def some(values: Array) -> Array:
            return values if values.shape[-1] == 1 else values[..., start:stop]

        return Draws(
            stop - start,
            {key: some(value) for key, value in self.values.items()},
            some(self.drift),
            some(self.ripple_cos),
            some(self.ripple_sin),
            {key: some(value) for key, value in self.inputs.items()},
            some(self.white),
            {key: some(value) for key, value in self.noise.items()},
        )

    def small(self, run: int) -> list[Array]:
        """Return drift and ripple's cosine and sine parts of a run, (n,) or (1,) each."""
        return [of_run(part, run) for part in (self.drift, self.ripple_cos, self.ripple_sin)]

    def deviation(self, key: Key) -> Array:
        """Return a true value minus its nominal or stated one, shape (n,) or (1,)."""
        owner, symbol, run = key
        if symbol in INPUTS:
            return self.off(symbol, owner)
        return of_run(self.values[owner, symbol], run or 0) - nominal(owner, symbol)

    def displaced(self, place: int, by: Array) -> Draws:
        """Return the draws with drift (0), cosine (1) or sine (2) of the ripple of each run moved.

        by: Shape (runs,).
        """
        parts = [self.drift, self.ripple_cos, self.ripple_sin]
        parts[place] = parts[place] + by[:, None]
        return replace(self, drift=parts[0], ripple_cos=parts[1], ripple_sin=parts[2])

    def off(self, symbol: str, recorder: str = "") -> Array:
        """Return the deviation of an input from its stated value, shape (n,) or (1,)."""
        return self.inputs.get((recorder, symbol), np.zeros(1))

    def mean(self, owner: str, symbol: str) -> Array:
        """Return a coefficient's mean over the runs in each trial, shape (n,)."""
        if (owner, symbol) not in self.values:
            return np.full(self.trials, nominal(owner, symbol))
        value = self.values[owner, symbol]
        return np.broadcast_to(value.mean(axis=0), self.trials)

    def spindle(self, base: Spindle, run: int) -> Spindle:
        """Return the true motion of one run in the first of the trials."""
        cos, sin = (float(of_run(part, run)[0]) for part in (self.ripple_cos, self.ripple_sin))
        others = tuple(ripple for ripple in base.ripples if ripple.harmonic != 1)
        first = Ripple(1, base.rate * float(np.hypot(cos, sin)), float(np.arctan2(sin, cos)))
        drift = float(of_run(self.drift, run)[0])
        return Spindle(base.rate, drift, (first, *others), base.start_angle)


@frozen
class StudyTruth:
    """The true values of a study."""

    #: (owner, symbol) -> value of each run, shape (r,) or (1,).
    fixed: Mapping[tuple[str, str], Array]
    spindles: tuple[Spindle, ...]  #: Of each run, with the constant values.
    #: (recorder of a clock, else empty; symbol) -> the stated value of an active input, SI.
    stated: Mapping[tuple[str, str], float]
    inputs: Mapping[tuple[str, str], float]  #: What is true of those that do not vary.
    #: Standard deviation of a sample of the first accelerometer, SI, where it does not vary.
    white: float
    varying: tuple[VariedQuantity, ...]  #: What does.

    @classmethod
    def of(cls, campaign: Campaign, varying: tuple[VariedQuantity, ...]) -> StudyTruth:
        """Return the true values: a campaign's [truth], and the quantities that vary instead."""
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
        first = next(iter(campaign.accelerometers.values()))
        stated = {key: known.value for key, known in inputs_by_owner(campaign).items()}
        true = campaign.simulation.truth.inputs
        inputs = {key: true.get(key, value) for key, value in stated.items()}
        for quantity in varying:
            fixed.pop((quantity.owner, quantity.symbol), None)
            inputs.pop((quantity.owner, quantity.symbol), None)
        return cls(
            fixed=fixed,
            spindles=tuple(run.spindle for run in campaign.simulation.truth.runs.values()),
            stated=stated,
            inputs=inputs,
            white=float(getattr(simulated_noise(campaign), first.observable)),
            varying=varying,
        )

    def draw(self, generator: np.random.Generator, trials: int) -> Draws:
        """Draw the truth of some trials, quantity after quantity in the study's order."""
        runs = len(self.spindles)
        values = {key: value[:, None] for key, value in self.fixed.items()}
        drift = np.array([[s.drift] for s in self.spindles])
        ratio, phase = (np.array(part)[:, None] for part in self._first())
        white = np.array([self.white])
        inputs = {key: np.array([value - self.stated[key]]) for key, value in self.inputs.items()}
        noise: dict[str, Array] = {}
        for quantity in self.varying:
            drawn = quantity.draw(generator, runs, trials)
            if quantity.symbol == DRIFT:
                drift = drawn
            elif quantity.symbol == RIPPLE_RATIO:
                ratio = drawn
            elif quantity.symbol == RIPPLE_AMPLITUDE:
                ratio = drawn / np.array([[spindle.rate] for spindle in self.spindles])
            elif quantity.symbol == RIPPLE_PHASE:
                phase = drawn
            elif (key := (quantity.owner, quantity.symbol)) in self.stated:
                inputs[key] = drawn[0] - self.stated[key]
            elif quantity.symbol == WHITE:
                white = np.abs(drawn[0])
            elif quantity.symbol in NOISE_LEVELS:
                noise[quantity.symbol] = np.abs(drawn[0])
            else:
                values[quantity.owner, quantity.symbol] = drawn
        cos, sin = ratio * np.cos(phase), ratio * np.sin(phase)
        return Draws(trials, values, drift, cos, sin, inputs, white, noise)

    def middle(self) -> Draws:
        """Return a trial in which every quantity that varies has its mean value."""
        fixed = tuple(
            replace(quantity, distribution="fixed", first=0.5 * sum(quantity.reach), per_run=False)
            for quantity in self.varying
        )
        draws = replace(self, varying=fixed).draw(np.random.default_rng(0), 1)
        runs = range(len(self.spindles))
        drift, cos, sin = np.array([self.small_bounds(run).mean(axis=1) for run in runs]).T
        return replace(
            draws, drift=drift[:, None], ripple_cos=cos[:, None], ripple_sin=sin[:, None]
        )

    def small_bounds(self, run: int) -> Array:
        """Return least and greatest drift and ripple's cosine and sine parts, (3, 2)."""
        ratio, phase = self.bounds(RIPPLE_RATIO, run), self.bounds(RIPPLE_PHASE, run)[0]
        if self.varies(RIPPLE_RATIO, RIPPLE_AMPLITUDE, RIPPLE_PHASE):
            largest = max(map(abs, ratio))
            cos, sin = (-largest, largest), (-largest, largest)
        else:
            cos, sin = ((ratio[0] * part(phase),) * 2 for part in (np.cos, np.sin))
        return np.array([self.bounds(DRIFT, run), cos, sin])

    def mean(self, owner: str, symbol: str) -> float:
        """Return the mean true value of a coefficient; one of a run has the platform's truth.

        For an input, return the mean true value minus the stated value.
        """
        owner = owner if symbol in ACCELEROMETER_TERMS or symbol in INPUTS else ""
        stated = self.stated.get((owner, symbol), 0.0)
        for quantity in self.varying:
            if (quantity.owner, quantity.symbol) == (owner, symbol):
                return 0.5 * sum(quantity.reach) - stated
        if (owner, symbol) in self.inputs:
            return self.inputs[owner, symbol] - stated
        value = self.fixed.get((owner, symbol))
        return nominal(owner, symbol) if value is None else float(value.mean())

    def _first(self) -> tuple[list[float], list[float]]:
        """Return ratio and phase of every run's first harmonic."""
        ratios, phases = [], []
        for spindle in self.spindles:
            first = [ripple for ripple in spindle.ripples if ripple.harmonic == 1]
            ratios.append(first[0].amplitude / spindle.rate if first else 0.0)
            phases.append(first[0].phase if first else 0.0)
        return ratios, phases

    def varies(self, *symbols: str) -> bool:
        """Check for variation in any of the given quantities."""
        return any(
            varying.symbol in symbols and varying.distribution != "fixed"
            for varying in self.varying
        )

    @property
    def symbols(self) -> dict[str, tuple[str, ...]]:
        """Owner -> the terms that are not nominal in every trial; the platform's owner is ''."""
        keys = [*self.fixed, *((quantity.owner, quantity.symbol) for quantity in self.varying)]
        keys = [key for key in keys if key[1] not in OTHERS]
        owners = dict.fromkeys(owner for owner, _ in keys)
        return {
            owner: tuple(dict.fromkeys(symbol for key_owner, symbol in keys if key_owner == owner))
            for owner in owners
        }

    def bounds(self, symbol: str, run: int) -> tuple[float, float]:
        """Return the least and greatest value of a spindle quantity in a run."""
        for quantity in self.varying:
            if symbol == RIPPLE_RATIO and quantity.symbol == RIPPLE_AMPLITUDE:
                low, high = sorted(bound / self.spindles[run].rate for bound in quantity.reach)
                return low, high
            if quantity.symbol == symbol:
                return quantity.reach
        spindle = self.spindles[run]
        ratios, phases = self._first()
        value = {
            DRIFT: spindle.drift,
            RIPPLE_RATIO: ratios[run],
            RIPPLE_PHASE: phases[run],
        }[symbol]
        return value, value


def of_run(values: Array, run: int) -> Array:
    """Return one run's row of values that the runs may have in common, shape (n,) or (1,)."""
    row: Array = values[min(run, values.shape[0] - 1)]
    return row


def nominal(owner: str, symbol: str) -> float:
    """Return the value of a coefficient in a perfect system."""
    return ACCELEROMETER_TERMS[symbol].nominal if owner else 0.0

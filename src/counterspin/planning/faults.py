"""Shifts of the estimates by faults that a model omits, and the tolerable size of each fault.

A fault is a term of the table that is assumed to be perfect, at its typical size. Each
moves the estimates, and leaves something in the residuals; where that is too little, the plan
cannot notice it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.calibration.model import fixed_terms, make_unknowns
from counterspin.campaign.description import Campaign
from counterspin.campaign.runs import sample_count
from counterspin.frozen import frozen
from counterspin.inference.diagnostics import SIGNIFICANCE
from counterspin.inference.joint.design_blocks import DesignBlock, update_design_blocks
from counterspin.inference.joint.fit import JointFit
from counterspin.inference.joint.series import INPUT_PERTURBATIONS, TIMING
from counterspin.inference.joint.unknowns import (
    ROTATION,
    Considered,
    Observation,
    Unknowns,
    unit_of,
)
from counterspin.physics.terms import MOTION_TERMS, term
from counterspin.planning.forecast import Forecast, expected_values, scale_factors
from counterspin.planning.sensitivities import Sensitivities, columns_of, sensitivities
from counterspin.readings.linear import LinearReadings
from counterspin.results import ResultPart

#: A fault that adds this part of u in quadrature makes u grow by a twentieth.
_TOLERABLE_FRACTION_OF_U: Final = math.sqrt(1.05**2 - 1.0)

#: Probability of failing the test of the residuals above which a fault counts as noticed.
_DETECTION_PROBABILITY: Final = 0.95

#: The inputs with a requirement.
_INPUTS: Final = ("centrifuge.radius", TIMING)

#: No centrifuge has larger faults; a length is a part of the radius.
_MAX_SIZES: Final = {"rad": 0.1, "s": 1.0, "1/s": 1e-2, "1": 0.1}


class Requirement(ResultPart):
    """The size of a fault of the centrifuge that increases u of the goal by a twentieth.

    `size` is None where any size that can occur would do.
    """

    words: str
    size: float | None
    unit: str


class FaultEffect(ResultPart):
    """A term assumed to be perfect that would move K_II by more than its u."""

    #: As in the table of terms, or as it would stand there; what it is called.
    symbol: str
    words: str
    #: At which it is taken: a typical one.
    size: float
    unit: str
    #: Of K_II, g/g^2, without sign; of parts with unknown phase the largest, of those that each run
    #: has anew the root of the sum of squares.
    shift: float
    ratio: float  #: The shift over u(K_II).
    #: Standard deviations that the best test for it would see: a fit that estimates it.
    deviation: float
    detection: float  #: Probability that the residuals of the fit without it fail their test.
    noticed: bool  #: Whether they nearly always do.


def fault_requirements(
    prediction: Forecast, name: str, sampling_rate: float
) -> tuple[str, list[Requirement]]:
    """Return the requirements on the centrifuge for the predicted uncertainty.

    Each fault by itself, at the size given, makes u of the coefficient grow by a twentieth.

    sampling_rate: Hz.
    """
    campaign = prediction.campaign
    paths = [path_fault(symbol) for symbol in ("encoder.harmonic.1", "centrifuge.imbalance.1")]
    # A fit that has a fault among its unknowns gives way to it: it says nothing of its own need.
    symbols = {part.symbol for fault in paths for part in fault.parts}
    fit_before = prediction.fit
    model = fit_before.model.without({*symbols, *INPUT_PERTURBATIONS, TIMING})
    index = [unknown.name for unknown in model.unknowns].index(name)
    unknown = model.unknowns[index]
    expected = expected_values(campaign, model.unknowns)
    fit = replace(fit_before, model=model, observations=_omit_terms(prediction, model, expected))
    basis = f"for the expected value of {name}"
    if expected[index] == 0.0:
        expected[index] = unknown.limit
        unit = unit_of(unknown.symbol)
        basis = f"if {name} had the largest credible value, {unknown.limit:.3g} {unit}"
    # A fault of the rotation has its own size in each run.
    owners = {symbol: [run.name for run in campaign.runs] for symbol in ROTATION}
    owners |= {symbol: [""] for symbol in _INPUTS}
    faults = [
        Fault(symbol, "", 1.0, "", tuple(as_considered_term(owner, symbol) for owner in of))
        for symbol, of in owners.items()
    ]
    effects = fault_sensitivities(replace(prediction, fit=fit), [*faults, *paths], expected)
    origin, rate, drift, radius, delay, *machine = (effect.moved[index] for effect in effects)
    rates = np.array([run.rate for run in campaign.runs])
    lines = [
        ("radius", radius, "m"),
        ("rate drift that does not appear in the recorded angle", drift, "1/s"),
        ("relative rate error common to all runs", rate @ rates, "1"),
        ("zero of the angle, varying between runs", origin, "rad"),
        (
            "angle noise per sample",
            _angle_noise(campaign, np.column_stack([origin, rate, drift]), sampling_rate),
            "rad",
        ),
        (f"{paths[0].words}, common to all runs", machine[0], "rad"),
        (paths[1].words, machine[1], "m"),
        ("delay between the clocks of angle and output", delay, "s"),
    ]
    allowed_shift = _TOLERABLE_FRACTION_OF_U * prediction.u[name]
    max_sizes = {**_MAX_SIZES, "m": _MAX_SIZES["1"] * campaign.radius.value}
    return basis, [
        Requirement(
            words=text,
            size=size
            if (size := _allowed_size(allowed_shift, shifts)) <= max_sizes[unit]
            else None,
            unit=unit,
        )
        for text, shifts, unit in lines
    ]


def _omit_terms(prediction: Forecast, model: Unknowns, expected: Array) -> tuple[Observation, ...]:
    """Return the observations with the columns of a model that has fewer terms."""
    fit, factors = prediction.fit, scale_factors(prediction.campaign)
    readings = [
        observation.group
        for observation in fit.observations
        if isinstance(observation, LinearReadings)
    ]
    return (
        *update_design_blocks(fit.design_blocks, fit.model, model, factors, {}),
        *(group.linearize(model, expected) for group in readings),
    )


def _allowed_size(relative_increase: float, shifts: Array | float) -> float:
    """Return the allowed size of a fault from the coefficient's shifts per unit of its parts."""
    sensitivity = float(np.linalg.norm(shifts))
    return relative_increase / sensitivity if sensitivity > 0.0 else math.inf


def _angle_noise(campaign: Campaign, run_shifts: Array, sampling_rate: float) -> float:
    """Return the sensitivity to white noise of the recorded angle.

    The rotation is fitted to the angle, th0 + w t + C w t^2/2, so that noise of a sample comes in
    through the uncertainty of these three.
    """
    variance = 0.0
    for run, sensitivity in zip(campaign.runs, run_shifts, strict=True):
        duration = run.duration or 0.0
        n = sample_count(duration, sampling_rate)
        scale = np.array([1.0, 1.0 / duration, 2.0 / (abs(run.rate) * duration**2)])
        a, b, c = (sensitivity * scale).tolist()  # to 1, t and t^2, t from 0 to 1
        # The same of 1, t - 1/2 and (t - 1/2)^2 minus its mean, whose products add up to nothing
        # over even samples, and whose squares have these means.
        linear = (n + 1.0) / (12.0 * (n - 1.0))
        square = (n + 1.0) * (n**2 - 4.0) / (180.0 * (n - 1.0) ** 3)
        quadratic = c - b + a * (0.25 - linear)
        variance += (a**2 + (b - 0.5 * a) ** 2 / linear + quadratic**2 / square) / n
    return math.sqrt(variance)


@frozen(eq=False)
class Fault:
    """A possible fault that the model omits."""

    #: As the term table has it, or as it would; what it is called.
    symbol: str
    words: str
    #: What to reckon with where nothing is known, SI and g-units.
    size: float
    unit: str
    parts: tuple[Considered, ...]  #: Each has the size.
    #: Whether the parts are independent (each run has its own); else they are cosine and sine of
    #: one amplitude, the worst phase of which is taken.
    random: bool = False
    #: Column of an observation per unit, shape (n,), for a fault that is not a term.
    response: Callable[[Observation], Array] | None = None


def _family_fault(symbol: str, parts: Sequence[Considered], size: float) -> Fault:
    row = term(parts[0].symbol)
    return Fault(symbol, row.words_of_family, size, row.unit, tuple(parts), random=row.per_run)


def possible_faults(campaign: Campaign, name: str) -> list[Fault]:
    """Return the possible undetected faults for an accelerometer: terms assumed to be perfect."""
    by_symbol: dict[str, list[Considered]] = {}
    for considered_term in fixed_terms(campaign, make_unknowns(campaign), name):
        by_symbol.setdefault(term(considered_term.symbol).family, []).append(considered_term)
    return [
        _family_fault(symbol, parts, campaign.typical_of(parts[0].symbol, name))
        for symbol, parts in by_symbol.items()
    ]


def path_fault(symbol: str) -> Fault:
    """Return an error of the path, both quadratures: such as ``encoder.harmonic.1``."""
    rows = [row for row in MOTION_TERMS.values() if row.family == symbol]
    return _family_fault(
        symbol, [as_considered_term("", row.symbol) for row in rows], rows[0].typical
    )


def as_considered_term(owner: str, symbol: str) -> Considered:
    """Return a term that is taken as perfect."""
    return Considered(owner, symbol, (0.0, 0.0), 1.0)


def square_term_fault(name: str) -> Fault:
    """Return K_II of an accelerometer, which the estimate must recover completely."""
    return Fault("K_II", "", 1.0, "g/g^2", (as_considered_term(name, "K_II"),))


def mean_square_fault(name: str) -> Fault:
    """Return the effect of K_II of an accelerometer on the mean force, without its harmonics."""

    def columns(observation: Observation) -> Array:
        if not isinstance(observation, DesignBlock) or observation.accelerometer != name:
            return np.zeros(len(observation.design))
        series, motion = observation.series, observation.series.trajectory
        times = np.arange(16.0) / 16.0 * (2.0 * math.pi / abs(motion.spindle.rate))
        projection = (
            motion.specific_force(times) @ series.mounting.turned(series.attitude).input_axis
        )
        mean = float(np.mean((projection / motion.site.gravity) ** 2))
        return np.asarray(mean * series.columns(["K_F"], 1.0)[:, 0])

    return Fault("K_II", "", 1.0, "g/g^2", (), response=columns)


#: Number of fault columns in memory at once; a fault of each run has a column for each run.
_MAX_COLUMNS: Final = 16


@frozen(eq=False)
class FaultSensitivity(Sensitivities):
    """The shift by a fault, and its remainder in the residuals, part by part."""

    fault: Fault  #: The fault.

    def unit_shift(self, index: int) -> float:
        """Return the size of the shift of an unknown per unit of the fault."""
        return float(np.linalg.norm(self.moved[index]))

    def shift(self, index: int) -> float:
        """Return the size of the shift of an unknown by the fault at its typical size."""
        return self.fault.size * self.unit_shift(index)

    def deviation(self, index: int) -> float:
        """Return the deviation seen by the best test for this fault, in standard deviations."""
        return math.sqrt(self.residual_ss(self.left, index))

    def detection(self, index: int, accelerometer: str, significance: float) -> float:
        """Return the probability that the residuals of an accelerometer fail their test."""
        from scipy.special import chdtri, chndtr

        dof = max(1.0, self.freedom[accelerometer])
        noncentrality = self.residual_ss(self.left_in[accelerometer], index)
        return 1.0 - float(chndtr(chdtri(dof, significance), dof, noncentrality))

    def residual_ss(self, products: Array, index: int) -> float:
        """Return the sum of squares that the fault at its typical size leaves, from `products`.

        Of parts that are one amplitude, in the phase that moves an unknown most.
        """
        size = self.fault.size
        if self.fault.random:
            return size**2 * float(np.trace(products))
        shifts = self.moved[index]
        length = float(np.linalg.norm(shifts))
        phase = shifts / length if length > 0.0 else np.eye(shifts.size)[0]
        return max(0.0, size**2 * float(phase @ products @ phase))


def fault_sensitivities(
    prediction: Forecast, faults: Sequence[Fault], expected: Array | None = None
) -> list[FaultSensitivity]:
    """Return the effects of faults on a campaign's fit, each fault separately.

    expected: Values of the fit's unknowns, minus nominal, on which inputs act; None: those of
        `expected_values`.
    """
    fit = prediction.fit
    if expected is None:
        expected = expected_values(prediction.campaign, fit.model.unknowns)
    groups: list[list[Fault]] = [[]]
    for fault in faults:
        if groups[-1] and sum(len(f.parts) for f in (*groups[-1], fault)) > _MAX_COLUMNS:
            groups.append([])
        groups[-1].append(fault)
    return [effect for group in groups for effect in _group_sensitivities(fit, group, expected)]


def _group_sensitivities(
    fit: JointFit, faults: Sequence[Fault], expected: Array
) -> Iterator[FaultSensitivity]:
    term_columns = columns_of(fit, [part for fault in faults for part in fault.parts], expected)
    ends = np.cumsum([len(fault.parts) for fault in faults])[:-1]

    def columns(observation: Observation) -> Array:
        parts = np.split(term_columns(observation), ends, axis=1)
        return np.column_stack(
            [
                block if fault.response is None else fault.response(observation)
                for fault, block in zip(faults, parts, strict=True)
            ]
        )

    sensitivity = sensitivities(fit, columns)
    start = 0
    for fault in faults:
        columns_slice = slice(start, start := start + max(1, len(fault.parts)))
        accelerometer_products = {
            name: remainder[columns_slice, columns_slice]
            for name, remainder in sensitivity.left_in.items()
        }
        shifts, remainder = (
            sensitivity.moved[:, columns_slice],
            sensitivity.left[columns_slice, columns_slice],
        )
        yield FaultSensitivity(
            shifts, remainder, accelerometer_products, sensitivity.freedom, fault
        )


def undetected_faults(
    prediction: Forecast, name: str, k_ii: int
) -> tuple[float | None, list[FaultEffect]]:
    """Return the share of K_II from the second harmonic, and the faults that would shift K_II.

    The first is None where there are readings, which are means.

    k_ii: The place of the accelerometer's K_II among the unknowns.
    """
    campaign, fit = prediction.campaign, prediction.fit
    faults = [*possible_faults(campaign, name), mean_square_fault(name), square_term_fault(name)]
    *sensitivities, mean_effect, square_effect = fault_sensitivities(prediction, faults)
    u = float(fit.solution.u[k_ii])
    effects = []
    for effect in sensitivities:
        shift, fault = effect.shift(k_ii), effect.fault
        if shift > u:
            detection = effect.detection(k_ii, name, SIGNIFICANCE)
            effects.append(
                FaultEffect(
                    symbol=fault.symbol,
                    words=fault.words,
                    size=fault.size,
                    unit=fault.unit,
                    shift=shift,
                    ratio=shift / u,
                    deviation=effect.deviation(k_ii),
                    detection=detection,
                    noticed=detection >= _DETECTION_PROBABILITY,
                )
            )
    ratio = float(mean_effect.moved[k_ii, 0] / square_effect.moved[k_ii, 0])
    share = None if campaign.readings else 1.0 - ratio
    return share, sorted(effects, key=lambda effect: -effect.shift)

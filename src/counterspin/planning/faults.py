"""Shifts of the estimates by faults that a model omits, and the tolerable size of each fault.

A fault is a term of the table that the model fixes at its nominal value. At its typical size, it
shifts the estimates and changes the residuals. The plan detects it only if the residuals change
enough.
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
from counterspin.planning.sensitivities import Sensitivities, make_column_function, sensitivities
from counterspin.readings.linear import LinearReadings
from counterspin.results import ResultPart

#: Adding this fraction of u in quadrature increases u by a twentieth.
_TOLERABLE_FRACTION_OF_U: Final = math.sqrt(1.05**2 - 1.0)

#: Probability of failing the test of the residuals above which a fault counts as noticed.
_DETECTION_PROBABILITY: Final = 0.95

#: The inputs with a requirement.
_INPUTS: Final = ("centrifuge.radius", TIMING)

#: Largest plausible faults by unit; the entry "1" also applies to a length over the radius.
_MAX_SIZES: Final = {"rad": 0.1, "s": 1.0, "1/s": 1e-2, "1": 0.1}


class Requirement(ResultPart):
    """The size of a fault of the centrifuge that increases u of the goal by a twentieth.

    `size` is None if any plausible size is tolerable.
    """

    words: str
    size: float | None
    unit: str


class FaultEffect(ResultPart):
    """A term fixed at its nominal value that would shift K_II by more than u(K_II)."""

    #: Symbol and name as in the table of terms.
    symbol: str
    words: str
    #: Typical size of the fault.
    size: float
    unit: str
    #: Magnitude of the shift of K_II, g/g^2: the maximum over the phase of an amplitude, or the
    #: root of the sum of squares over runs.
    shift: float
    ratio: float  #: Shift over u(K_II).
    #: Expected value over standard deviation of the fault in a fit that estimates it.
    deviation: float
    detection: float  #: Probability that the residuals fail their test if the term is omitted.
    noticed: bool  #: True if they nearly always fail.


def fault_requirements(
    prediction: Forecast, name: str, sampling_rate: float
) -> tuple[str, list[Requirement]]:
    """Return the requirements on the centrifuge for the predicted uncertainty.

    Each fault alone, at the returned size, increases u of the coefficient by a twentieth.

    sampling_rate: Hz.
    """
    campaign = prediction.campaign
    path_faults = list(map(path_fault, ("encoder.harmonic.1", "centrifuge.imbalance.1")))
    # A fit that estimates a fault would absorb it, so these terms are removed.
    symbols = {fault_term.symbol for fault in path_faults for fault_term in fault.terms}
    full_fit = prediction.fit
    model = full_fit.model.without({*symbols, *INPUT_PERTURBATIONS, TIMING})
    index = [unknown.name for unknown in model.unknowns].index(name)
    unknown = model.unknowns[index]
    expected = expected_values(campaign, model.unknowns)
    observations = _rebuild_observations(prediction, model, expected)
    fit = replace(full_fit, model=model, observations=observations)
    basis_text = f"for the expected value of {name}"
    if expected[index] == 0.0:
        expected[index] = unknown.limit
        unit = unit_of(unknown.symbol)
        basis_text = f"if {name} had the largest credible value, {unknown.limit:.3g} {unit}"
    # The rotation has an independent fault in each run.
    owners = {symbol: [run.name for run in campaign.runs] for symbol in ROTATION}
    owners |= {symbol: [""] for symbol in _INPUTS}
    faults = [
        Fault(
            symbol, "", 1.0, "", tuple(make_considered_term(owner, symbol) for owner in term_owners)
        )
        for symbol, term_owners in owners.items()
    ]
    responses = fault_sensitivities(replace(prediction, fit=fit), [*faults, *path_faults], expected)
    origin, rate, drift, radius, delay, *path = (response.shifts[index] for response in responses)
    rates = np.array([run.rate for run in campaign.runs])
    properties = [
        ("radius", radius, "m"),
        ("rate drift that does not appear in the recorded angle", drift, "1/s"),
        ("relative rate error common to all runs", rate @ rates, "1"),
        ("zero of the angle, varying between runs", origin, "rad"),
        (
            "angle noise per sample",
            _angle_noise_shift(campaign, np.column_stack([origin, rate, drift]), sampling_rate),
            "rad",
        ),
        (f"{path_faults[0].words}, common to all runs", path[0], "rad"),
        (path_faults[1].words, path[1], "m"),
        ("delay between the clocks of angle and output", delay, "s"),
    ]
    allowed_shift = _TOLERABLE_FRACTION_OF_U * prediction.u[name]
    max_sizes = {**_MAX_SIZES, "m": _MAX_SIZES["1"] * campaign.radius.value}
    return basis_text, [
        Requirement(
            words=text,
            size=allowed_size
            if (allowed_size := _allowed_size(allowed_shift, shifts)) <= max_sizes[unit]
            else None,
            unit=unit,
        )
        for text, shifts, unit in properties
    ]


def _rebuild_observations(
    prediction: Forecast, model: Unknowns, expected: Array
) -> tuple[Observation, ...]:
    """Return the observations with the columns of a reduced model."""
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


def _allowed_size(allowed_shift: float, shifts: Array | float) -> float:
    """Return the allowed size of a fault from the shifts of the coefficient per unit."""
    sensitivity = float(np.linalg.norm(shifts))
    return allowed_shift / sensitivity if sensitivity > 0.0 else math.inf


def _angle_noise_shift(campaign: Campaign, shifts_by_run: Array, sampling_rate: float) -> float:
    """Return the shift of the coefficient per unit of white noise of the recorded angle.

    The angle is fitted by th0 + w t + C w t^2/2, so the noise acts through the uncertainties of
    these three parameters.
    """
    variance = 0.0
    for run, sensitivity in zip(campaign.runs, shifts_by_run, strict=True):
        duration = run.duration or 0.0
        n = sample_count(duration, sampling_rate)
        scale = np.array([1.0, 1.0 / duration, 2.0 / (abs(run.rate) * duration**2)])
        a, b, c = (sensitivity * scale).tolist()  # to 1, t and t^2, t from 0 to 1
        # 1, t - 1/2 and (t - 1/2)^2 minus its mean are orthogonal over even samples; these are
        # the mean squares.
        linear_mean_square = (n + 1.0) / (12.0 * (n - 1.0))
        quadratic_mean_square = (n + 1.0) * (n**2 - 4.0) / (180.0 * (n - 1.0) ** 3)
        quadratic = c - b + a * (0.25 - linear_mean_square)
        variance += (
            a**2 + (b - 0.5 * a) ** 2 / linear_mean_square + quadratic**2 / quadratic_mean_square
        ) / n
    return math.sqrt(variance)


@frozen(eq=False)
class Fault:
    """A possible fault that the model omits."""

    #: Symbol and name as in the table of terms.
    symbol: str
    words: str
    #: Default standard uncertainty of each term, in SI and g-units.
    typical_size: float
    unit: str
    terms: tuple[Considered, ...]  #: Terms of the fault.
    #: True: the terms are independent, one for each run; False: they are the cosine and sine parts
    #: of one amplitude, whose worst phase is used.
    is_per_run: bool = False
    #: Function that returns the column of an observation per unit, shape (n,); None: from `terms`.
    response: Callable[[Observation], Array] | None = None


def _make_family_fault(symbol: str, terms: Sequence[Considered], size: float) -> Fault:
    row = term(terms[0].symbol)
    return Fault(symbol, row.words_of_family, size, row.unit, tuple(terms), is_per_run=row.per_run)


def possible_faults(campaign: Campaign, name: str) -> list[Fault]:
    """Return the possible faults of an accelerometer: the terms fixed at nominal values."""
    terms_by_family: dict[str, list[Considered]] = {}
    for considered_term in fixed_terms(campaign, make_unknowns(campaign), name):
        terms_by_family.setdefault(term(considered_term.symbol).family, []).append(considered_term)
    return [
        _make_family_fault(family, family_terms, campaign.typical_of(family_terms[0].symbol, name))
        for family, family_terms in terms_by_family.items()
    ]


def path_fault(symbol: str) -> Fault:
    """Return an error of the path with both quadratures, such as ``encoder.harmonic.1``."""
    rows = [row for row in MOTION_TERMS.values() if row.family == symbol]
    return _make_family_fault(
        symbol, [make_considered_term("", row.symbol) for row in rows], rows[0].typical
    )


def make_considered_term(owner: str, symbol: str) -> Considered:
    """Return a term with the nominal value 0 and the size 1 as a considered term."""
    return Considered(owner, symbol, (0.0, 0.0), 1.0)


def square_term_fault(name: str) -> Fault:
    """Return K_II of an accelerometer, which the estimate recovers completely."""
    return Fault("K_II", "", 1.0, "g/g^2", (make_considered_term(name, "K_II"),))


def mean_square_fault(name: str) -> Fault:
    """Return the effect of K_II of an accelerometer on the mean force, without its harmonics."""

    def mean_square_column(observation: Observation) -> Array:
        if not isinstance(observation, DesignBlock) or observation.accelerometer != name:
            return np.zeros(len(observation.design))
        series, trajectory = observation.series, observation.series.trajectory
        times = np.arange(16.0) / 16.0 * (2.0 * math.pi / abs(trajectory.spindle.rate))
        input_force = (
            trajectory.specific_force(times) @ series.mounting.turned(series.attitude).input_axis
        )
        mean_square = float(np.mean((input_force / trajectory.site.gravity) ** 2))
        return np.asarray(mean_square * series.columns(["K_F"], 1.0)[:, 0])

    return Fault("K_II", "", 1.0, "g/g^2", (), response=mean_square_column)


#: Maximum number of fault columns in memory.
_MAX_COLUMNS: Final = 16


@frozen(eq=False)
class FaultSensitivity(Sensitivities):
    """The shifts and residuals of a fault, one column for each of its terms."""

    fault: Fault  #: The fault.

    def unit_shift(self, index: int) -> float:
        """Return the size of the shift of an unknown per unit of the fault."""
        return float(np.linalg.norm(self.shifts[index]))

    def shift(self, index: int) -> float:
        """Return the size of the shift of an unknown by the fault at its typical size."""
        return self.fault.typical_size * self.unit_shift(index)

    def z_score(self, index: int) -> float:
        """Return the expected value over standard deviation of the fault if it is estimated."""
        return math.sqrt(self.residual_ss(self.residual_products, index))

    def detection_probability(self, index: int, accelerometer: str, significance: float) -> float:
        """Return the probability that the residuals of an accelerometer fail their test."""
        from scipy.special import chdtri, chndtr

        dof = max(1.0, self.dof[accelerometer])
        noncentrality = self.residual_ss(self.accelerometer_products[accelerometer], index)
        return 1.0 - float(chndtr(chdtri(dof, significance), dof, noncentrality))

    def residual_ss(self, residual_products: Array, index: int) -> float:
        """Return the residual sum of squares of the fault at its typical size.

        The phase of an amplitude is the one that shifts the unknown `index` most.

        residual_products: Of the whitened residuals per unit, shape (m, m).
        """
        size = self.fault.typical_size
        if self.fault.is_per_run:
            return size**2 * float(np.trace(residual_products))
        shifts = self.shifts[index]
        shift_norm = float(np.linalg.norm(shifts))
        worst_phase = shifts / shift_norm if shift_norm > 0.0 else np.eye(shifts.size)[0]
        return max(0.0, size**2 * float(worst_phase @ residual_products @ worst_phase))


def fault_sensitivities(
    prediction: Forecast, faults: Sequence[Fault], expected: Array | None = None
) -> list[FaultSensitivity]:
    """Return the effects of faults on a campaign's fit, each fault separately.

    expected: Values of the fit's unknowns minus nominal, for the effect of inputs; None: those of
        `expected_values`.
    """
    fit = prediction.fit
    if expected is None:
        expected = expected_values(prediction.campaign, fit.model.unknowns)
    batches: list[list[Fault]] = [[]]
    for fault in faults:
        if (
            batches[-1]
            and sum(len(batch_fault.terms) for batch_fault in (*batches[-1], fault)) > _MAX_COLUMNS
        ):
            batches.append([])
        batches[-1].append(fault)
    return [effect for batch in batches for effect in _batch_sensitivities(fit, batch, expected)]


def _batch_sensitivities(
    fit: JointFit, faults: Sequence[Fault], expected: Array
) -> Iterator[FaultSensitivity]:
    term_columns = make_column_function(
        fit, [fault_term for fault in faults for fault_term in fault.terms], expected
    )
    split_indices = np.cumsum([len(fault.terms) for fault in faults])[:-1]

    def stack_columns(observation: Observation) -> Array:
        columns_by_fault = np.split(term_columns(observation), split_indices, axis=1)
        return np.column_stack(
            [
                block if fault.response is None else fault.response(observation)
                for fault, block in zip(faults, columns_by_fault, strict=True)
            ]
        )

    batch_result = sensitivities(fit, stack_columns)
    start = 0
    for fault in faults:
        column_slice = slice(start, start := start + max(1, len(fault.terms)))
        accelerometer_products = {
            name: products[column_slice, column_slice]
            for name, products in batch_result.accelerometer_products.items()
        }
        shifts = batch_result.shifts[:, column_slice]
        products = batch_result.residual_products[column_slice, column_slice]
        yield FaultSensitivity(shifts, products, accelerometer_products, batch_result.dof, fault)


def undetected_faults(
    prediction: Forecast, name: str, k_ii_index: int
) -> tuple[float | None, list[FaultEffect]]:
    """Return the share of K_II from the second harmonic, and the faults that would shift K_II.

    The share is None for a campaign with readings, which are means.

    k_ii_index: Index of the accelerometer's K_II among the unknowns.
    """
    campaign, fit = prediction.campaign, prediction.fit
    faults = [*possible_faults(campaign, name), mean_square_fault(name), square_term_fault(name)]
    *responses, mean_response, square_response = fault_sensitivities(prediction, faults)
    u = float(fit.solution.u[k_ii_index])
    effects = []
    for response in responses:
        shift, fault = response.shift(k_ii_index), response.fault
        if shift > u:
            detection_probability = response.detection_probability(k_ii_index, name, SIGNIFICANCE)
            effects.append(
                FaultEffect(
                    symbol=fault.symbol,
                    words=fault.words,
                    size=fault.typical_size,
                    unit=fault.unit,
                    shift=shift,
                    ratio=shift / u,
                    deviation=response.z_score(k_ii_index),
                    detection=detection_probability,
                    noticed=detection_probability >= _DETECTION_PROBABILITY,
                )
            )
    mean_share = float(mean_response.shifts[k_ii_index, 0] / square_response.shifts[k_ii_index, 0])
    harmonic_share = None if campaign.readings else 1.0 - mean_share
    return harmonic_share, sorted(effects, key=lambda effect: -effect.shift)

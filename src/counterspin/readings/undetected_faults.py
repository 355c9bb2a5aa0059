"""Single faults of typical size that readings and poses would not reveal, and their effects.

With few degrees of freedom, the fit absorbs a bias step or a change of meter range almost
completely, and the residuals show little of it. Each fault is a column that is tested in addition
to the model. A fault is undetected if its remainder in the residuals is below the detection limit
of the tests in `readings.checks` and `triads.checks`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np

from counterspin.calibration.accelerometer_view import AccelerometerView
from counterspin.calibration.checks.shifts import format_magnitude, largest_shift
from counterspin.campaign.conditions import DEFAULT_WARMING
from counterspin.campaign.description import Campaign
from counterspin.inference.diagnostics import SIGNIFICANCE
from counterspin.inference.distributions import student_quantile
from counterspin.inference.joint.alternatives import (
    Alternative,
    run_score_tests,
    undetected_effects,
)
from counterspin.inference.joint.fit import JointFit, estimate_considered
from counterspin.physics.terms import ARCSEC
from counterspin.readings.checks import pattern_columns, residual_group
from counterspin.readings.fitted import FittedReadings
from counterspin.readings.patterns import DRIFT, RANGE, REVERSED, STEP, TURN
from counterspin.readings.reading_groups import groups_of_view

#: Smallest shift of a coefficient, in its u, of a reported fault.
_MIN_SHIFT_RATIO: Final = 2.0

_METER_GAIN: Final = "a meter gain change"

#: Typical difference between the gains of two ranges of a meter: order of magnitude, for a
#: voltmeter with 6.5 digits and ranges within 40 ppm after a year.
_TYPICAL_RANGE_DIFFERENCE: Final = 5e-5

#: Typical scale error of a dividing head, rad per revolution: order of magnitude, no source.
_TYPICAL_HEAD_ERROR: Final = 36.0 * ARCSEC

#: Smallest number of readings of a group.
_MIN_READINGS: Final = 4


class _UndetectedFault(NamedTuple):
    """Faults of one kind that the residuals would not reveal."""

    expected_ratio: float  #: Largest expected shift of a coefficient over its u.
    ratio: float  #: Largest shift over u at the size that the tests do not detect.
    clause: str  #: Description of the fault with the largest shift.

    def merge(self, other: _UndetectedFault) -> _UndetectedFault:
        """Return this fault merged with another fault of the same kind."""
        expected = max(self.expected_ratio, other.expected_ratio)
        return max(self, other, key=lambda fault: fault.ratio)._replace(expected_ratio=expected)


def find_undetected_faults(views: Sequence[AccelerometerView]) -> dict[str, list[str]]:
    """Return accelerometer -> undetected faults, in descending order of the expected shift.

    For each kind of fault, only the one with the largest shift is returned. The expected shift of
    a kind is the largest root mean square of a shift given the residuals, in u.
    """
    fit = estimate_considered(views[0].fit)
    groups = {id(group.readings): group for view in views for group in groups_of_view(view)}
    faults_by_name: dict[str, dict[str, _UndetectedFault]] = {view.name: {} for view in views}
    for group in groups.values():
        index = group.index_in(fit)
        if index is None or group.readings.size < _MIN_READINGS:
            continue
        columns = pattern_columns(fit, residual_group(group, index))
        faults = {
            column: size
            for column in columns
            if (size := _typical_size(views[0].campaign, group, column)) is not None
        }
        if not faults:
            continue
        detectable_effect = _detectable_effect(group, len(columns))
        residual_norms, shifts = undetected_effects(fit, tuple(faults))
        tests = run_score_tests(fit, tuple(faults), noise_given=group.has_external_noise)
        for column_index, (column, typical_size) in enumerate(faults.items()):
            norm = float(residual_norms[column_index])
            size = min(typical_size, detectable_effect / max(norm, 1e-300))
            if column.kind == REVERSED and size < typical_size:
                continue  # The fault is all or nothing, and the tests would detect it.
            for view in views:
                symbol, shift, ratio = largest_shift(view, (), size * shifts[:, column_index])
                if not symbol:
                    continue  # The readings determine no coefficient.
                ratio *= _noise_shrinkage(view, fit, symbol, group, size * norm)
                expected_size = _expected_size(
                    column,
                    typical_size,
                    float(tests.value[column_index]),
                    float(tests.u[column_index]),
                )
                clause = f"{_describe_fault(column, size)} shifts {symbol} by "
                clause += f"{format_magnitude(symbol, abs(shift), 3)} ({ratio:.2g} u({symbol}))"
                fault = _UndetectedFault(ratio * expected_size / size, ratio, clause)
                faults_by_kind = faults_by_name[view.name]
                faults_by_kind[column.kind] = fault.merge(faults_by_kind.get(column.kind, fault))
    return {
        name: [
            fault.clause
            for fault in sorted(faults_by_kind.values(), reverse=True)
            if fault.ratio > _MIN_SHIFT_RATIO
        ]
        for name, faults_by_kind in faults_by_name.items()
    }


def fault_remarks(faults: Mapping[str, Sequence[str]]) -> Iterator[str]:
    """Yield a remark for each accelerometer with undetected faults."""
    for name, clauses in faults.items():
        if clauses:
            is_single = len(clauses) == 1
            subject, pronoun = ("this fault", "it") if is_single else ("these faults", "them")
            single_range = any(_METER_GAIN in clause for clause in clauses)
            yield (
                f"{name}: the residuals would not reveal {subject}: {'; '.join(clauses)}. Rule "
                f"{pronoun} out by other means: repeat the series in another order"
                f"{', or use a single range of the meter' * single_range}."
            )


def _detectable_effect(group: FittedReadings, n_tests: int) -> float:
    """Return the smallest effect that the tests detect, in standard deviations.

    Estimated noise is that of the other residuals.
    """
    level = 0.5 * SIGNIFICANCE / max(n_tests, 1)
    dof = group.noise_dof - 1.0
    return -student_quantile(dof, 0.5 * level) if dof >= 1.0 else math.inf


def _expected_size(fault: Alternative, typical_size: float, value: float, u: float) -> float:
    """Return the root mean square of the size of a fault given the residuals.

    The prior has the mean 0 and the standard deviation `typical_size`. A sense of rotation is right
    or wrong, with equal prior probabilities.

    value, u: Estimate of the size from the residuals; u is infinite without information.
    """
    if fault.kind == REVERSED:
        return typical_size * math.sqrt(0.5 * (1.0 + math.tanh((value - 0.5) / (2.0 * u**2))))
    weight = 1.0 / (1.0 + (u / typical_size) ** 2)
    return math.sqrt((weight * value) ** 2 + (1.0 - weight) * typical_size**2)


def _noise_shrinkage(
    view: AccelerometerView, fit: JointFit, symbol: str, group: FittedReadings, effect: float
) -> float:
    """Return u over its value if the estimated noise contains the remainder of a fault.

    effect: Remainder of the fault in the residuals, in standard deviations.
    """
    if group.has_external_noise or not effect:
        return 1.0
    index = view.indices[symbol]
    variance = float(view.fit.solution.covariance[index, index])
    noise_fraction = float(fit.solution.covariance_noise[index, index]) / variance
    return 1.0 / math.sqrt(1.0 + min(noise_fraction, 1.0) * effect**2 / max(group.noise_dof, 1.0))


def _typical_size(campaign: Campaign, group: FittedReadings, fault: Alternative) -> float | None:
    """Return the typical size of a fault in the unit of its column; None if it is no fault."""
    name = fault.owner
    if fault.kind == STEP:
        return campaign.typical_of("K_F.hysteresis", name)
    if fault.kind == RANGE:
        return _TYPICAL_RANGE_DIFFERENCE
    if fault.kind == REVERSED:
        return 1.0
    if fault.kind == TURN and fault.symbol == "angle":
        return _TYPICAL_HEAD_ERROR / (2.0 * math.pi)
    if fault.kind == DRIFT:
        duration = float(np.ptp(group.readings.time))
        trend_size = duration * campaign.typical_of("K_F.trend", name)
        return max(trend_size, DEFAULT_WARMING * campaign.typical_of("K_F.temperature", name))
    return None


def _describe_fault(fault: Alternative, size: float) -> str:
    if fault.kind == REVERSED:
        return fault.symbol
    if fault.kind == STEP:
        return f'a bias step of {format_magnitude("K_F", size, 3)} starting at "{fault.symbol}"'
    if fault.kind == RANGE:
        return f"{_METER_GAIN} of {1e6 * size:.2g} ppm above {fault.symbol}"
    if fault.kind == TURN:
        arcsec = 2.0 * math.pi * size / ARCSEC
        return f"a head error that grows by {arcsec:.2g} arcsec per revolution"
    return f"a bias drift of {format_magnitude('K_F', size, 3)} during the series"

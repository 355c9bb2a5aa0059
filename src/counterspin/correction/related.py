"""Further inputs of a correction: temperature differences, and correlations of errors."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations
from typing import Final

import numpy as np
import numpy.typing as npt

from counterspin.arrays import Array
from counterspin.calibration.result import Result
from counterspin.campaign.field_types import parse_uncertain_temperature
from counterspin.errors import CampaignError, error_code
from counterspin.physics.correction import CalibratedAccelerometer, TemperatureOffset
from counterspin.units import ZERO_CELSIUS

#: Temperatures in degC as in `ApplyOptions`, or text.
Temperature = npt.ArrayLike | str | None

#: Margin about the calibration temperatures without a warning, K.
_TEMPERATURE_MARGIN: Final = 1.0


def temperature_offset(
    result: Result, instruments: Sequence[CalibratedAccelerometer], temperature: Temperature
) -> TemperatureOffset:
    """Return the temperature of a record minus the reference temperature of the result.

    Raises
    ------
    CampaignError
        If slopes require the temperature of the record or of the calibration, and it is missing.
    """
    value, u = _parse_temperature(temperature)
    reference = result.inputs.reference_temperature
    if reference is not None and value is not None:
        return TemperatureOffset(value - reference, u)
    if dependence_texts := list(_temperature_dependences(instruments)):
        remedy = (
            'give `temperature`: a column, or a constant such as `temperature="23 ± 1 degC"`'
            if reference is not None
            else "the result does not state the calibration temperature; calibrate again"
        )
        raise CampaignError(
            "apply",
            [f"{', '.join(dependence_texts)} with the temperature of the record; {remedy}"],
            code="missing-input",
        )
    return TemperatureOffset()


def _temperature_dependences(instruments: Sequence[CalibratedAccelerometer]) -> Iterator[str]:
    for instrument in instruments:
        u = np.sqrt(np.diag(instrument.covariance))
        symbols = [
            symbol
            for symbol, sd in zip(instrument.coefficients, u, strict=True)
            if symbol in instrument.slopes and (instrument.coefficients[symbol] or sd)
        ]
        if symbols:
            verb = "changes" if len(symbols) == 1 else "change"
            yield f"{', '.join(symbols)} of {instrument.name} {verb}"


def _parse_temperature(temperature: Temperature) -> tuple[Array | float | None, float]:
    """Return a temperature and its u, K."""
    if isinstance(temperature, str):
        try:
            quantity = parse_uncertain_temperature(temperature)
        except ValueError as error:
            raise CampaignError(
                "apply", [f"`temperature`: {error}"], code=error_code(error)
            ) from error
        return quantity.value, quantity.u
    if temperature is None:
        return None, 0.0
    return np.asarray(temperature, dtype=np.float64) + ZERO_CELSIUS, 0.0


def temperature_notes(
    result: Result, instruments: Sequence[CalibratedAccelerometer], temperature: Temperature
) -> Iterator[str]:
    """Yield sentences on the use of the temperature."""
    if temperature is None:
        return
    reference = result.inputs.reference_temperature
    if reference is None or not any(instrument.slopes for instrument in instruments):
        yield "The result contains no temperature slope, so the temperature has no effect."
        return
    yield (
        f"Temperature slopes are relative to {reference - ZERO_CELSIUS:.6g} degC, the "
        "reference temperature of the coefficients."
    )


def temperature_warnings(
    result: Result, offset: TemperatureOffset, temperature: Temperature
) -> Iterator[str]:
    """Yield warnings on temperatures outside those of the calibration."""
    reference, calibrated_range = result.inputs.reference_temperature, result.inputs.temperatures
    if temperature is None or reference is None or not calibrated_range:
        return
    temperatures = np.asarray(offset.value) + reference
    temperatures = temperatures[np.isfinite(temperatures)]
    if not temperatures.size:
        return
    low, high = float(temperatures.min()), float(temperatures.max())
    if (
        low < calibrated_range[0] - _TEMPERATURE_MARGIN
        or high > calibrated_range[1] + _TEMPERATURE_MARGIN
    ):
        yield (
            f"The temperature is {_format_range(low, high)}, but the calibration temperature was "
            f"{_format_range(*calibrated_range)}. Outside the calibrated range, the "
            "temperature slopes of the result are the only temperature effect included in u."
        )


def _format_range(low: float, high: float) -> str:
    low_text, high_text = (f"{value - ZERO_CELSIUS:.4g}" for value in (low, high))
    return f"{low_text} degC" if low_text == high_text else f"{low_text} to {high_text} degC"


def cross_covariances(
    result: Result, instruments: Sequence[CalibratedAccelerometer]
) -> dict[tuple[int, int], Array]:
    """Return the covariances between the coefficients of different accelerometers of one fit.

    The keys are pairs of indices, as for `counterspin.physics.correction.correct`. The result
    contains the covariance of two estimates; the covariance of an estimate and a prior follows from
    the sensitivity in the budget. Results of earlier versions contain neither.
    """
    if result.covariance is None:
        return {}
    indices = {name: index for index, name in enumerate(result.covariance.terms)}
    covariances = {}
    for (k, first), (m, second) in combinations(enumerate(instruments), 2):
        covariance = np.zeros((len(first.coefficients), len(second.coefficients)))
        for i, j, index_pair in _estimate_pairs(first, second, indices):
            covariance[i, j] = result.covariance.matrix[index_pair]
        _add_prior_covariances(result, first, second, indices, covariance)
        _add_prior_covariances(result, second, first, indices, covariance.T)
        covariances[k, m] = covariance
    return covariances


def _estimate_pairs(
    first: CalibratedAccelerometer, second: CalibratedAccelerometer, indices: Mapping[str, int]
) -> Iterator[tuple[int, int, tuple[int, int]]]:
    """Yield the indices of two estimates in their instruments, and in the joint covariance."""
    for i, symbol in enumerate(first.coefficients):
        for j, other_symbol in enumerate(second.coefficients):
            names = f"{first.name}.{symbol}", f"{second.name}.{other_symbol}"
            if names[0] in indices and names[1] in indices:
                yield i, j, (indices[names[0]], indices[names[1]])


def _add_prior_covariances(
    result: Result,
    first: CalibratedAccelerometer,
    second: CalibratedAccelerometer,
    indices: Mapping[str, int],
    covariance: Array,
) -> None:
    """Add the covariances of estimates of the first instrument with priors of the second."""
    for i, symbol in enumerate(first.coefficients):
        for line in result.accelerometers[first.name].budget.get(symbol, []):
            owner, _, source = line.source.partition(".")
            is_prior = owner == second.name and line.source not in indices
            if is_prior and source in second.coefficients and line.sensitivity is not None:
                j = list(second.coefficients).index(source)
                covariance[i, j] = line.sensitivity * second.covariance[j, j]

"""Correct arrays of indicated specific force by a calibrated error model."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import field, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from counterspin.arrays import Array
from counterspin.calibration.findings import judge_result, refusal_reason
from counterspin.calibration.result import Result
from counterspin.calibration.result_parts import AccelerometerResult
from counterspin.campaign.quantity import parse_quantity
from counterspin.correction.instrument import (
    HYSTERESIS_SYMBOL,
    add_unstated_terms,
    applicable_terms,
    determined_terms,
    is_applicable,
    is_valid_covariance,
    make_instrument,
    term_covariance,
)
from counterspin.correction.related import (
    cross_covariances,
    temperature_notes,
    temperature_offset,
    temperature_warnings,
)
from counterspin.errors import CampaignError, RecordError, UsageError, error_code
from counterspin.frozen import frozen
from counterspin.physics.correction import (
    CalibratedAccelerometer,
    KnownForce,
    correct,
    missing_axes,
)
from counterspin.physics.terms import TERMS, condition_of
from counterspin.records.dialect import AUTODETECT, Dialect
from counterspin.results import unsealed_sentences
from counterspin.units import unit_factor

_SOURCE: Final = "apply"  #: source named in error messages

#: Axis -> name, and the argument for the specific force along it.
_AXES: Final = {"P": ("pendulous", "pendulous"), "O": ("output", "output_axis")}

#: Largest indication without a warning, relative to the largest specific force of the calibration;
#: allows for bias and scale factor.
_RANGE_FACTOR: Final = 1.05

#: Specific force along an axis: numbers in the unit of the indication, or text with a unit.
Force = npt.ArrayLike | str


@frozen(eq=False)
class Correction:
    """Corrected specific force along an accelerometer's input axis."""

    corrected: Array  #: Specific force, shape (n,); NaN if an input is missing.
    #: Standard uncertainty (k = 1) from coefficients and constants, without the noise of the
    #: indication, shape (n,).
    u: Array
    indicated: Array  #: Indicated specific force by the nominal sensitivity and zero, shape (n,).
    #: Unit of the three arrays: unit of the indication, or g if that is not a unit of specific
    #: force.
    unit: str
    #: Smallest effective degrees of freedom of an applied coefficient; infinite for stated noise.
    dof: float
    notes: tuple[str, ...]  #: Sentences on the applied terms.
    warnings: tuple[str, ...]  #: Sentences on terms not applied, and on extrapolation.
    #: Corrections of the accelerometers of `ApplyOptions.others`, by name.
    others: Mapping[str, Correction] = field(default_factory=dict)

    def __repr__(self) -> str:
        """Return a text with the number of samples and the largest u."""
        max_u = float(np.nanmax(self.u)) if np.isfinite(self.u).any() else math.nan
        warning_text = f", {len(self.warnings)} warnings" if self.warnings else ""
        unit = self.unit
        n_samples = self.corrected.size
        return f"<{n_samples} corrected in {unit}, u at most {max_u:.2g} {unit}{warning_text}>"


@frozen(eq=False)
class ApplyOptions:
    """Options for applying a result.

    Attributes
    ----------
    unit
        Unit of the indication, of all other arrays and of the correction: g (of the calibration
        site), m/s^2, mg, ... Or a unit of the outputs that the result states, such as ``count`` or
        ``mA``; all other arrays are then in g.
    pendulous, output_axis
        Specific force along the pendulous and the output axis: shape (n,), one number, or text
        such as ``"-1 g"`` or ``"-1 ± 1e-4 g"``; for a file, the name of a column or such a text.
    temperature
        Temperature in degC, shape (n,) or one number, or text such as ``"23 ± 1 degC"``; for a
        file, the name of a column or such a text. Temperature slopes require it.
    others
        Indications of other accelerometers of the result on the same platform by name, shape (n,),
        or names of columns. They determine a_P and a_O, and are corrected too.
    force
        Whether a result of the printed equations, with half the K_II, may be applied.
    dialect
        Format of a file if it cannot be detected, as in [records] of a campaign.
    """

    unit: str = "g"
    pendulous: Force | None = None
    output_axis: Force | None = None
    temperature: npt.ArrayLike | str | None = None
    others: Mapping[str, npt.ArrayLike] = field(default_factory=dict)
    force: bool = False
    dialect: Dialect = AUTODETECT


def apply(
    result: Result,
    accelerometer: str,
    indicated: npt.ArrayLike,
    options: ApplyOptions | None = None,
) -> Correction:
    """Correct indicated specific force for the calibrated model: the inverse of Eq. 7.

    Parameters
    ----------
    result
        Result of a calibration.
    accelerometer
        Name of the accelerometer in the result.
    indicated
        Indicated specific force, shape (n,).
    options
        Unit, temperature, and force along the other axes.

    Returns
    -------
    Correction

    Raises
    ------
    CampaignError
        If the accelerometer is unknown, if a required force or temperature is missing or given
        twice, or if the result uses the printed equations.
    ConvergenceError
        If a sample is outside the range of the model.
    RecordError
        If the records contradict the result and the misfit was not accepted, or if they do not
        determine a required coefficient.
    """
    options = options or ApplyOptions()
    if result.model == "as-printed" and not options.force:
        raise CampaignError(
            _SOURCE,
            [
                "the result was computed with the equations as printed, which yield half the "
                "true K_II; calibrate again with the exact model, or set `force=True`"
            ],
            code="as-printed",
        )
    indications = {accelerometer: indicated, **options.others}
    if accelerometer in options.others:
        raise UsageError(
            _SOURCE,
            [f"`others`: {accelerometer} is the accelerometer to be corrected; omit it here"],
        )
    unit, scales = _find_scales(result, indications, options.unit)
    factor = unit_factor(unit, "g", gravity=result.inputs.gravity)
    available_factors = {"I", "|I|", "sign_I"}
    available_factors |= {"P"} if options.pendulous is not None else set()
    available_factors |= {"O"} if options.output_axis is not None else set()
    # Three accelerometers measure all components of the force.
    available_factors |= {"P", "O"} if len(options.others) > 1 else set()
    reference = result.inputs.reference_temperature
    if reference is not None and options.temperature is not None:
        available_factors |= {"temperature"}
    full_result, omitted_symbols = add_unstated_terms(result, available_factors)
    instruments = [
        make_instrument(full_result, name, needs_mounting=bool(options.others))
        for name in indications
    ]
    judged_result = judge_result(result)
    if (refusal_text := refusal_reason(judged_result, indications)) is not None:
        raise RecordError(refusal_text, code="contradicted")
    _require_determined(judged_result, indications)
    mounting = instruments[0].mounting
    known_forces = [
        _make_known_force(force, mounting.matrix[row], factor, result.inputs.gravity, option)
        for row, (force, (_, option)) in enumerate(
            zip((options.pendulous, options.output_axis), _AXES.values(), strict=True), start=1
        )
        if force is not None
    ]
    try:
        missing_forces = missing_axes(instruments, known_forces)
    except ValueError as error:
        raise CampaignError(_SOURCE, [str(error)], code=error_code(error)) from error
    if missing_forces:
        raise CampaignError(
            _SOURCE, _missing_force_errors(accelerometer, missing_forces), code="missing-input"
        )
    offset = temperature_offset(result, instruments, options.temperature)
    columns = [
        np.asarray(values, dtype=np.float64) * scales[name].factor - scales[name].zero
        for name, values in indications.items()
    ]
    covariances = cross_covariances(full_result, instruments)
    forces = correct(instruments, np.stack(columns, axis=1), known_forces, covariances, offset)
    calibrations = [result.accelerometers[name] for name in indications]
    correction = Correction(
        corrected=forces.force[:, 0] / factor,
        u=forces.u[:, 0] / factor,
        indicated=columns[0] / factor,
        unit=unit,
        dof=min(
            (
                coefficient.dof
                for calibration in calibrations
                for coefficient in applicable_terms(calibration).values()
                if coefficient.dof is not None
            ),
            default=math.inf,
        ),
        notes=(
            *(
                _applied_note(name, calibration)
                for name, calibration in zip(indications, calibrations, strict=True)
            ),
            *temperature_notes(result, instruments, options.temperature),
        ),
        warnings=(
            *unsealed_sentences([] if judged_result.sealed else ["the result"]),
            *_misfit_warnings(judged_result),
            *temperature_warnings(result, offset, options.temperature),
            *(
                warning
                for name, calibration, column in zip(
                    indications, calibrations, columns, strict=True
                )
                for warning in (
                    *_omitted_term_warnings(name, calibration),
                    *_missing_input_warnings(name, omitted_symbols.get(name, ())),
                    *_unapplied_warnings(name, calibration),
                    *_covariance_warnings(name, calibration),
                    *_range_warnings(result, name, column),
                )
            ),
        ),
    )
    corrections = {
        name: replace(
            correction,
            corrected=forces.force[:, k] / factor,
            u=forces.u[:, k] / factor,
            indicated=columns[k] / factor,
        )
        for k, name in enumerate(options.others, 1)
    }
    return replace(correction, others=corrections)


def _require_determined(result: Result, names: Iterable[str]) -> None:
    """Raise RecordError if the data do not determine a term to be applied."""
    for name in names:
        findings = {
            finding.subject.removeprefix(f"{name}."): finding.text
            for finding in result.accelerometers[name].findings
            if finding.undetermined
        }
        if needed_symbols := [symbol for symbol in findings if is_applicable(symbol)]:
            raise RecordError(
                f"{name}: the correction requires {', '.join(needed_symbols)}, but the result does "
                f"not determine these coefficients. {findings[needed_symbols[0]]}",
                code="not-determined",
            )


@frozen
class _Scale:
    """Conversion of a column to specific force, g: a factor, and an offset to subtract."""

    factor: float
    zero: float = 0.0


def _find_scales(result: Result, names: Iterable[str], unit: str) -> tuple[str, dict[str, _Scale]]:
    """Return the unit of the corrected values, and the conversion of each column."""
    try:
        factor = unit_factor(unit, "g", gravity=result.inputs.gravity)
    except ValueError as error:
        unit_error = error
    else:
        return unit, dict.fromkeys(names, _Scale(factor))
    scales = {}
    for name in names:
        accelerometer = result.accelerometers.get(name)
        nominal = accelerometer.nominal if accelerometer else None
        try:
            if nominal is None:
                raise unit_error
            factor = unit_factor(unit, nominal.unit)
        except ValueError as error:
            text = f"`unit`: {error}"
            if nominal is None:
                text += f"; the result does not state a different output for {name}"
            raise CampaignError(_SOURCE, [text], code=error_code(error)) from error
        scales[name] = _Scale(factor / nominal.sensitivity, nominal.zero / nominal.sensitivity)
    return "g", scales


def _missing_input_warnings(name: str, symbols: Sequence[str]) -> Iterator[str]:
    slope_symbols = [symbol for symbol in symbols if symbol not in TERMS]
    product_symbols = [symbol for symbol in symbols if symbol in TERMS]
    for symbol_group, reason in (
        (
            product_symbols,
            "the specific force along the pendulous and output axes is not given",
        ),
        (
            slope_symbols,
            ("the temperature is not given, or it differs from the calibration temperature"),
        ),
    ):
        if symbol_group:
            yield (
                f"{name}: no value is stated for {', '.join(symbol_group)}, and {reason}, so u "
                f"does not include this contribution."
            )


def _unapplied_warnings(name: str, accelerometer: AccelerometerResult) -> list[str]:
    """Return a warning on terms that depend on a quantity that records do not contain."""
    coefficients = {**accelerometer.known, **accelerometer.coefficients}
    unapplied_symbols = [
        symbol
        for symbol, coefficient in coefficients.items()
        if condition_of(symbol)
        and symbol != HYSTERESIS_SYMBOL
        and not is_applicable(symbol)
        and (coefficient.value or coefficient.u)
    ]
    if not unapplied_symbols:
        return []
    return [
        f"{name}: the correction does not apply {', '.join(unapplied_symbols)}. The corrected "
        "values are valid for the state at the start of the calibration, before the specific force "
        "heated the accelerometer."
    ]


def _misfit_warnings(result: Result) -> list[str]:
    if result.accepted_misfit is None:
        return []
    return [
        f"The records contradict this result: {result.findings[0].text} The misfit was "
        f"accepted for this reason: {result.accepted_misfit}"
    ]


def _covariance_warnings(name: str, accelerometer: AccelerometerResult) -> list[str]:
    """Return a warning if the covariance in the result is not positive semidefinite."""
    if is_valid_covariance(term_covariance(accelerometer, determined_terms(accelerometer))):
        return []
    return [
        f"{name}: the correlations in the result are inconsistent because of a fault in "
        "versions before 0.1.0, so u is an upper bound. Calibrate again."
    ]


def _make_known_force(
    force: Any, direction: Array, factor: float, gravity: float, option: str
) -> KnownForce:
    if isinstance(force, str):
        try:
            quantity = parse_quantity(force, "g", gravity=gravity)
        except ValueError as error:
            raise CampaignError(
                _SOURCE, [f"`{option}`: {error}"], code=error_code(error)
            ) from error
        return KnownForce(direction, quantity.value, quantity.u)
    return KnownForce(direction, np.asarray(force, dtype=np.float64) * factor)


def _missing_force_errors(
    accelerometer: str,
    missing_forces: Sequence[tuple[CalibratedAccelerometer, str, tuple[str, ...]]],
) -> list[str]:
    problems = []
    for instrument, axis, symbols in missing_forces:
        axis_name, option = _AXES[axis]
        verb = "needs" if len(symbols) == 1 else "need"
        if instrument.name == accelerometer:
            remedy = f'give `{option}`: a column, or a constant such as `{option}="-1 g"`'
        else:
            remedy = "give `pendulous` or `output_axis` for the accelerometer to be corrected"
        problems.append(
            f"{', '.join(symbols)} of {instrument.name} {verb} the specific force along its "
            f"{axis_name} axis; {remedy}, or use `others` to name an accelerometer that senses "
            "it"
        )
    return problems


def _applied_note(name: str, accelerometer: AccelerometerResult) -> str:
    terms = determined_terms(accelerometer)
    estimates = ", ".join(symbol for symbol, coefficient in terms.items() if coefficient.estimated)
    priors = ", ".join(symbol for symbol, coefficient in terms.items() if not coefficient.estimated)
    clauses = [f"as estimated: {estimates}"] if estimates else []
    clauses += [f"from priors: {priors}"] if priors else []
    return f"{name}: coefficients applied {'; '.join(clauses) or 'none'}."


def _omitted_term_warnings(name: str, accelerometer: AccelerometerResult) -> list[str]:
    terms = applicable_terms(accelerometer)
    warnings = []
    missing_symbols = [symbol for symbol, coefficient in terms.items() if coefficient.value is None]
    if missing_symbols:
        warnings.append(
            f"{name}: the result does not determine {', '.join(missing_symbols)}, so the "
            "correction does not apply these terms, and u does not include their uncertainty."
        )
    for symbol, row in TERMS.items():
        if row.nominal and (symbol not in terms or symbol in missing_symbols):
            warnings.append(
                f"{name}: the result has no value for {symbol} ({row.words}). The correction "
                f"uses {row.nominal:g} {row.unit} as an exact value."
            )
    return warnings


def _range_warnings(result: Result, name: str, indicated: Array) -> list[str]:
    """Return a warning if the indication exceeds the range of the calibration."""
    max_rate = max((abs(run.rate) for run in result.runs.values()), default=0.0)
    readings = result.accelerometers[name].readings
    # An accelerometer at rest measures up to 1 g, whatever the rates of the centrifuge.
    calibrated_range = max(
        1.0,
        result.inputs.radius * max_rate**2 / result.inputs.gravity,
        *(abs(reading.value) for reading in readings),
    )
    magnitudes = np.abs(indicated[np.isfinite(indicated)])
    max_indication = float(magnitudes.max()) if magnitudes.size else 0.0
    if max_indication <= _RANGE_FACTOR * calibrated_range:
        return []
    return [
        f"{name}: the indication reaches {max_indication:.3g} g, but the calibration reached only "
        f"{calibrated_range:.3g} g. Above this value, u includes only the terms of the model."
    ]

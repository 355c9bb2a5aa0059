"""Correct indicated specific force for a calibrated error model, in memory."""

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
    HYSTERESIS,
    acts,
    covariance_of,
    determined_terms,
    instrument_of,
    is_possible,
    terms_of,
    with_unstated,
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

#: Largest indication without a warning, over the calibration's largest specific force: allows for
#: bias and scale factor.
_RANGE_FACTOR: Final = 1.05

#: Specific force along an axis: numbers in the unit of the indication, or text with a unit.
Force = npt.ArrayLike | str


@frozen(eq=False)
class Correction:
    """Corrected specific force along an accelerometer's input axis."""

    corrected: Array  #: Specific force, shape (n,); NaN where something was missing.
    #: Its standard uncertainty (k = 1) from coefficients and constants, shape (n,). The noise
    #: of the indication itself is no part of it.
    u: Array
    indicated: Array  #: Indicated specific force by the nominal sensitivity and zero, shape (n,).
    #: Of all three: that of the indication, or g where that is no unit of a specific force.
    unit: str
    #: The fewest effective degrees of freedom of a coefficient that was applied; infinite
    #: where the noise was given.
    dof: float
    notes: tuple[str, ...]  #: What was applied, in sentences.
    warnings: tuple[str, ...]  #: What was not, and where the model is stretched.
    #: The same of each accelerometer of `ApplyOptions.others`, by name.
    others: Mapping[str, Correction] = field(default_factory=dict)

    def __repr__(self) -> str:
        """Return a text with the number of samples and the largest u."""
        largest = float(np.nanmax(self.u)) if np.isfinite(self.u).any() else math.nan
        warned = f", {len(self.warnings)} warnings" if self.warnings else ""
        unit = self.unit
        return (
            f"<{self.corrected.size} corrected in {unit}, u at most {largest:.2g} {unit}{warned}>"
        )


@frozen(eq=False)
class ApplyOptions:
    """How a result is applied.

    Attributes
    ----------
    unit
        Unit of the indication: g (that of the calibration's site), m/s^2, mg, ... Also that of
        every other array, and of what is returned. Or that of the accelerometers' outputs, such as
        ``count`` or ``mA``, as the result states them: then all else is in g.
    pendulous, output_axis
        Specific force along the pendulous and the output axis: shape (n,), one number, or text
        such as ``"-1 g"`` or ``"-1 ± 1e-4 g"``; in a file, a column or such a text.
    temperature
        Of each row in degC, shape (n,) or one number, or text such as ``"23 ± 1 degC"``; in a file,
        a column or such a text. Slopes with temperature need it.
    others
        Indications of other accelerometers of the result on the same platform, shape (n,), or
        their columns, by name; a_P and a_O then follow from all of them, corrected as well.
    force
        Whether a result of the equations as printed, with half the K_II, may be applied.
    dialect
        How a file is written, as far as it does not show: as [records] of a campaign says it.
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
        A calibration's result.
    accelerometer
        Its name there.
    indicated
        Indicated specific force, shape (n,).
    options
        Its unit, and what is known of the force along the other axes.

    Returns
    -------
    Correction

    Raises
    ------
    CampaignError
        If the result or what is given does not fit: an unknown accelerometer, a force or a
        temperature that the model needs and that is not known, a force that is given twice,
        equations as printed.
    ConvergenceError
        If a sample lies outside of what the model can indicate.
    RecordError
        If the records contradict the result, and no reason is stated for accepting that. If they
        do not determine a requested term that the correction needs.
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
    unit, scales = _column_scales(result, indications, options.unit)
    factor = unit_factor(unit, "g", gravity=result.inputs.gravity)
    given = {"I", "|I|", "sign_I"}
    given |= {"P"} if options.pendulous is not None else set()
    given |= {"O"} if options.output_axis is not None else set()
    # Three accelerometers measure all components of the force.
    given |= {"P", "O"} if len(options.others) > 1 else set()
    reference = result.inputs.reference_temperature
    if reference is not None and options.temperature is not None:
        given |= {"temperature"}
    completed, omitted = with_unstated(result, given)
    instruments = [
        instrument_of(completed, name, placed=bool(options.others)) for name in indications
    ]
    judged_result = judge_result(result)
    if (refused := refusal_reason(judged_result, indications)) is not None:
        raise RecordError(refused, code="contradicted")
    _require_determined(judged_result, indications)
    mounting = instruments[0].mounting
    known = [
        _make_known_force(given, mounting.matrix[row], factor, result.inputs.gravity, option)
        for row, (given, (_, option)) in enumerate(
            zip((options.pendulous, options.output_axis), _AXES.values(), strict=True), start=1
        )
        if given is not None
    ]
    try:
        missing = missing_axes(instruments, known)
    except ValueError as error:
        raise CampaignError(_SOURCE, [str(error)], code=error_code(error)) from error
    if missing:
        raise CampaignError(
            _SOURCE, _missing_force_errors(accelerometer, missing), code="missing-input"
        )
    warmth = temperature_offset(result, instruments, options.temperature)
    columns = [
        np.asarray(values, dtype=np.float64) * scales[name].factor - scales[name].zero
        for name, values in indications.items()
    ]
    covariances = cross_covariances(completed, instruments)
    forces = correct(instruments, np.stack(columns, axis=1), known, covariances, warmth)
    calibrations = [result.accelerometers[name] for name in indications]
    correction = Correction(
        corrected=forces.force[:, 0] / factor,
        u=forces.u[:, 0] / factor,
        indicated=columns[0] / factor,
        unit=unit,
        dof=min(
            (
                c.dof
                for calibrated in calibrations
                for c in terms_of(calibrated).values()
                if c.dof is not None
            ),
            default=math.inf,
        ),
        notes=(
            *(
                _applied_note(name, calibrated)
                for name, calibrated in zip(indications, calibrations, strict=True)
            ),
            *temperature_notes(result, instruments, options.temperature),
        ),
        warnings=(
            *unsealed_sentences([] if judged_result.sealed else ["the result"]),
            *_misfit_warnings(judged_result),
            *temperature_warnings(result, warmth, options.temperature),
            *(
                warning
                for name, calibrated, column in zip(indications, calibrations, columns, strict=True)
                for warning in (
                    *_omitted_term_warnings(name, calibrated),
                    *_missing_input_warnings(name, omitted.get(name, ())),
                    *_unapplied_warnings(name, calibrated),
                    *_covariance_warnings(name, calibrated),
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
        if needed := [symbol for symbol in findings if acts(symbol)]:
            raise RecordError(
                f"{name}: the correction requires {', '.join(needed)}, but the result does not "
                f"determine these coefficients. {findings[needed[0]]}",
                code="not-determined",
            )


@frozen
class _ColumnScale:
    """Conversion of a column to specific force, g: a factor, and an offset to subtract."""

    factor: float
    zero: float = 0.0


def _column_scales(
    result: Result, names: Iterable[str], unit: str
) -> tuple[str, dict[str, _ColumnScale]]:
    """Return the unit of the corrected values, and the conversion of each column."""
    try:
        factor = unit_factor(unit, "g", gravity=result.inputs.gravity)
    except ValueError as error:
        unit_error = error
    else:
        return unit, dict.fromkeys(names, _ColumnScale(factor))
    scales = {}
    for name in names:
        calibrated = result.accelerometers.get(name)
        nominal = calibrated.nominal if calibrated else None
        try:
            if nominal is None:
                raise unit_error
            factor = unit_factor(unit, nominal.unit)
        except ValueError as error:
            text = f"`unit`: {error}"
            if nominal is None:
                text += f"; the result does not state a different output for {name}"
            raise CampaignError(_SOURCE, [text], code=error_code(error)) from error
        scales[name] = _ColumnScale(
            factor / nominal.sensitivity, nominal.zero / nominal.sensitivity
        )
    return "g", scales


def _missing_input_warnings(name: str, symbols: Sequence[str]) -> Iterator[str]:
    slopes = [symbol for symbol in symbols if symbol not in TERMS]
    products = [symbol for symbol in symbols if symbol in TERMS]
    for omitted, missing_input in (
        (
            products,
            "the specific force along the other axes is not given (`pendulous`, `output_axis`)",
        ),
        (
            slopes,
            (
                "the temperature is not given (`temperature`), or it differs from the "
                "calibration temperature"
            ),
        ),
    ):
        if omitted:
            yield (
                f"{name}: {', '.join(omitted)} are not stated, and {missing_input}, so u does "
                "not include the uncertainty of these terms."
            )


def _unapplied_warnings(name: str, accelerometer: AccelerometerResult) -> list[str]:
    """Return a warning about terms that depend on a quantity that a record does not have."""
    known = {**accelerometer.known, **accelerometer.coefficients}
    unapplied = [
        symbol
        for symbol, c in known.items()
        if condition_of(symbol) and symbol != HYSTERESIS and not acts(symbol) and (c.value or c.u)
    ]
    if not unapplied:
        return []
    return [
        f"{name}: the correction does not apply {', '.join(unapplied)}. It is valid for the "
        "start of the calibration, before the specific force heated the accelerometer."
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
    if is_possible(covariance_of(accelerometer, determined_terms(accelerometer))):
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
    accelerometer: str, missing: Sequence[tuple[CalibratedAccelerometer, str, tuple[str, ...]]]
) -> list[str]:
    problems = []
    for instrument, axis, symbols in missing:
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
    estimated = ", ".join(s for s, c in terms.items() if c.estimated)
    from_priors = ", ".join(s for s, c in terms.items() if not c.estimated)
    parts = [f"as estimated: {estimated}"] if estimated else []
    parts += [f"from priors: {from_priors}"] if from_priors else []
    return f"{name}: coefficients applied {'; '.join(parts) or 'none'}."


def _omitted_term_warnings(name: str, accelerometer: AccelerometerResult) -> list[str]:
    terms = terms_of(accelerometer)
    warnings = []
    unknown = [symbol for symbol, c in terms.items() if c.value is None]
    if unknown:
        warnings.append(
            f"{name}: the result does not determine {', '.join(unknown)}, so the correction "
            "does not apply these terms, and u does not include their uncertainty."
        )
    for symbol, row in TERMS.items():
        if row.nominal and (symbol not in terms or symbol in unknown):
            warnings.append(
                f"{name}: the result has no value for {symbol} ({row.words}). The correction "
                f"uses {row.nominal:g} {row.unit} as an exact value."
            )
    return warnings


def _range_warnings(result: Result, name: str, indicated: Array) -> list[str]:
    """Return a warning if the indication exceeds the range of the calibration."""
    max_rate = max((abs(run.rate) for run in result.runs.values()), default=0.0)
    readings = result.accelerometers[name].readings
    # At rest on its side, an accelerometer measures 1 g, whatever the rates of the centrifuge.
    calibrated_range = max(
        1.0,
        result.inputs.radius * max_rate**2 / result.inputs.gravity,
        *(abs(reading.value) for reading in readings),
    )
    valid = np.abs(indicated[np.isfinite(indicated)])
    largest = float(valid.max()) if valid.size else 0.0
    if largest <= _RANGE_FACTOR * calibrated_range:
        return []
    return [
        f"{name}: the indication reaches {largest:.3g} g, but the calibration reached only "
        f"{calibrated_range:.3g} g. Above this value, u includes only the terms of the model."
    ]

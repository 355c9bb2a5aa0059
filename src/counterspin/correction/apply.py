"""Corrects indicated specific force for a calibrated error model, in memory."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import field, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from counterspin.arrays import Array
from counterspin.calibration.findings import judge_result, refusal
from counterspin.calibration.result import Result
from counterspin.calibration.result_parts import AccelerometerResult
from counterspin.campaign.quantity import parse
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
    covariances_between,
    notes_of_warmth,
    warmth_of,
    warnings_of_warmth,
)
from counterspin.errors import CampaignError, RecordError
from counterspin.frozen import frozen
from counterspin.physics.correction import (
    CalibratedAccelerometer,
    KnownForce,
    correct,
    missing_axes,
)
from counterspin.physics.terms import CONDITION_TERMS, TERMS
from counterspin.records.dialect import TO_BE_FOUND, Dialect
from counterspin.results import unsealed_sentences
from counterspin.units import unit_factor

_SOURCE: Final = "apply"  #: what the command's own refusals begin with

#: Axis -> its name, and the argument that gives the specific force along it.
_AXES: Final = {"P": ("pendulous", "pendulous"), "O": ("output", "output_axis")}

#: How far beyond the calibration's largest specific force an indication may go unremarked; bias
#: and scale factor alone bring it there.
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
    dialect: Dialect = TO_BE_FOUND


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
                "the result is from the paper's equations as printed, which give "
                "half the true K_II; calibrate again with the exact model, or give `force=True`"
            ],
        )
    indications = {accelerometer: indicated, **options.others}
    if accelerometer in options.others:
        raise CampaignError(
            _SOURCE, [f"`others`: {accelerometer} is the accelerometer to be corrected"]
        )
    unit, scales = _scales(result, indications, options.unit)
    factor = unit_factor(unit, "g", gravity=result.inputs.gravity)
    given = {"I", "|I|"}
    given |= {"P"} if options.pendulous is not None else set()
    given |= {"O"} if options.output_axis is not None else set()
    # Three accelerometers feel the whole force.
    given |= {"P", "O"} if len(options.others) > 1 else set()
    reference = result.inputs.reference_temperature
    if reference is not None and options.temperature is not None:
        given |= {"temperature"}
    completed, lost = with_unstated(result, given)
    instruments = [
        instrument_of(completed, name, placed=bool(options.others)) for name in indications
    ]
    judged = judge_result(result)
    if (refused := refusal(judged, indications)) is not None:
        raise RecordError(refused)
    _require_determined(judged, indications)
    mounting = instruments[0].mounting
    known = [
        _known(given, mounting.matrix[row], factor, result.inputs.gravity, option)
        for row, (given, (_, option)) in enumerate(
            zip((options.pendulous, options.output_axis), _AXES.values(), strict=True), start=1
        )
        if given is not None
    ]
    try:
        missing = missing_axes(instruments, known)
    except ValueError as error:
        raise CampaignError(_SOURCE, [str(error)]) from error
    if missing:
        raise CampaignError(_SOURCE, _needed(accelerometer, missing))
    warmth = warmth_of(result, instruments, options.temperature)
    columns = [
        np.asarray(values, dtype=np.float64) * scales[name].factor - scales[name].zero
        for name, values in indications.items()
    ]
    between = covariances_between(completed, instruments)
    forces = correct(instruments, np.stack(columns, axis=1), known, between, warmth)
    applied = [result.accelerometers[name] for name in indications]
    done = Correction(
        corrected=forces.force[:, 0] / factor,
        u=forces.u[:, 0] / factor,
        indicated=columns[0] / factor,
        unit=unit,
        dof=min(
            (
                c.dof
                for calibrated in applied
                for c in terms_of(calibrated).values()
                if c.dof is not None
            ),
            default=math.inf,
        ),
        notes=(
            *(
                _note(name, calibrated)
                for name, calibrated in zip(indications, applied, strict=True)
            ),
            *notes_of_warmth(result, instruments, options.temperature),
        ),
        warnings=(
            *unsealed_sentences([] if judged.sealed else ["the result"]),
            *_accepted(judged),
            *warnings_of_warmth(result, warmth, options.temperature),
            *(
                warning
                for name, calibrated, column in zip(indications, applied, columns, strict=True)
                for warning in (
                    *_left_out(name, calibrated),
                    *_not_carried(name, lost.get(name, ())),
                    *_not_applied(name, calibrated),
                    *_contradictory(name, calibrated),
                    *_stretched(result, name, column),
                )
            ),
        ),
    )
    corrections = {
        name: replace(
            done,
            corrected=forces.force[:, k] / factor,
            u=forces.u[:, k] / factor,
            indicated=columns[k] / factor,
        )
        for k, name in enumerate(options.others, 1)
    }
    return replace(done, others=corrections)


def _require_determined(result: Result, names: Iterable[str]) -> None:
    """Refuse accelerometers of which the data do not determine a term that is to be applied."""
    for name in names:
        findings = {
            finding.subject.removeprefix(f"{name}."): finding.text
            for finding in result.accelerometers[name].findings
            if finding.undetermined
        }
        if needed := [symbol for symbol in findings if acts(symbol)]:
            raise RecordError(
                f"{name}: the correction needs {', '.join(needed)}, which the result does not "
                f"determine. {findings[needed[0]]}"
            )


@frozen
class _Scale:
    """The conversion of a column to a specific force, g: a factor, and an offset to subtract."""

    factor: float
    zero: float = 0.0


def _scales(result: Result, names: Iterable[str], unit: str) -> tuple[str, dict[str, _Scale]]:
    """Return the unit of what is returned, and how the column of each accelerometer becomes g."""
    try:
        factor = unit_factor(unit, "g", gravity=result.inputs.gravity)
    except ValueError as error:
        no_force = error
    else:
        return unit, dict.fromkeys(names, _Scale(factor))
    scales = {}
    for name in names:
        own = result.accelerometers.get(name)
        nominal = own.nominal if own else None
        try:
            if nominal is None:
                raise no_force
            factor = unit_factor(unit, nominal.unit)
        except ValueError as error:
            text = f"`unit`: {error}"
            if nominal is None:
                text += f"; the result states no other output of {name}"
            raise CampaignError(_SOURCE, [text]) from error
        scales[name] = _Scale(factor / nominal.sensitivity, nominal.zero / nominal.sensitivity)
    return "g", scales


def _not_carried(name: str, symbols: Sequence[str]) -> Iterator[str]:
    slopes = [symbol for symbol in symbols if symbol not in TERMS]
    products = [symbol for symbol in symbols if symbol in TERMS]
    for lost, what in (
        (products, "force along the other axes is not given (`pendulous`, `output_axis`)"),
        (
            slopes,
            "temperature is not given (`temperature`), or differs from that of the calibration",
        ),
    ):
        if lost:
            yield (
                f"{name}: {', '.join(lost)} are not stated, and the {what}; "
                "their uncertainty is not included in u."
            )


def _not_applied(name: str, accelerometer: AccelerometerResult) -> list[str]:
    """Return a warning about terms that vary with a quantity that a record does not state."""
    known = {**accelerometer.known, **accelerometer.coefficients}
    others = [
        symbol
        for symbol, c in known.items()
        if symbol in {*CONDITION_TERMS} - {HYSTERESIS} and not acts(symbol) and (c.value or c.u)
    ]
    if not others:
        return []
    return [
        f"{name}: not applied: {', '.join(others)}. The correction applies to the beginning of "
        "the calibration, without heating by its specific forces."
    ]


def _accepted(result: Result) -> list[str]:
    if result.accepted_misfit is None:
        return []
    return [
        f"The records contradict this result: {result.findings[0].text} The misfit was accepted: "
        f"{result.accepted_misfit}"
    ]


def _contradictory(name: str, accelerometer: AccelerometerResult) -> list[str]:
    """Return a warning if the result states a covariance that no coefficients could have."""
    if is_possible(covariance_of(accelerometer, determined_terms(accelerometer))):
        return []
    return [
        f"{name}: the correlations in the result are inconsistent, a fault "
        "of versions before 0.1.0; u is an upper estimate. Calibrate again."
    ]


def _known(given: Any, direction: Array, factor: float, gravity: float, option: str) -> KnownForce:
    if isinstance(given, str):
        try:
            quantity = parse(given, "g", gravity=gravity)
        except ValueError as error:
            raise CampaignError(_SOURCE, [f"`{option}`: {error}"]) from error
        return KnownForce(direction, quantity.value, quantity.u)
    return KnownForce(direction, np.asarray(given, dtype=np.float64) * factor)


def _needed(
    accelerometer: str, missing: Sequence[tuple[CalibratedAccelerometer, str, tuple[str, ...]]]
) -> list[str]:
    problems = []
    for instrument, axis, symbols in missing:
        words, option = _AXES[axis]
        verb = "needs" if len(symbols) == 1 else "need"
        if instrument.name == accelerometer:
            ways = f'give `{option}`: a column, or a constant such as `{option}="-1 g"`'
        else:
            ways = "give `pendulous` or `output_axis` of the accelerometer to be corrected"
        problems.append(
            f"{', '.join(symbols)} of {instrument.name} {verb} the specific force along its "
            f"{words} axis; {ways}, or name an accelerometer that senses it with `others`"
        )
    return problems


def _note(name: str, accelerometer: AccelerometerResult) -> str:
    terms = determined_terms(accelerometer)
    estimated = ", ".join(s for s, c in terms.items() if c.estimated)
    beforehand = ", ".join(s for s, c in terms.items() if not c.estimated)
    parts = [f"as estimated: {estimated}"] if estimated else []
    parts += [f"from priors: {beforehand}"] if beforehand else []
    return f"{name}: applied {'; '.join(parts) or 'nothing'}."


def _left_out(name: str, accelerometer: AccelerometerResult) -> list[str]:
    terms = terms_of(accelerometer)
    warnings = []
    unknown = [symbol for symbol, c in terms.items() if c.value is None]
    if unknown:
        warnings.append(
            f"{name}: not applied, because the result does not determine them: "
            f"{', '.join(unknown)}. "
            "Their uncertainty is not included in u."
        )
    for symbol, row in TERMS.items():
        if row.nominal and (symbol not in terms or symbol in unknown):
            warnings.append(
                f"{name}: the result has no value of {symbol} ({row.words}); {row.nominal:g} "
                f"{row.unit} is used as if it were exact."
            )
    return warnings


def _stretched(result: Result, name: str, indicated: Array) -> list[str]:
    """Return a warning if the indication exceeds the range of the calibration."""
    fastest = max((abs(run.rate) for run in result.runs.values()), default=0.0)
    # At rest on a side an accelerometer sees 1 g, however slowly the centrifuge turns.
    seen = max(1.0, result.inputs.radius * fastest**2 / result.inputs.gravity)
    present = np.abs(indicated[np.isfinite(indicated)])
    largest = float(present.max()) if present.size else 0.0
    if largest <= _RANGE_FACTOR * seen:
        return []
    return [
        f"{name}: the indication reaches {largest:.3g} g, but the calibration only {seen:.3g} "
        "g: beyond that, u covers only the terms of the model."
    ]

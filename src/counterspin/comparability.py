"""Units and uncertainty sources that results have in common."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

from counterspin.calibration.result import Result
from counterspin.calibration.result_parts import NominalOutput
from counterspin.frozen import frozen
from counterspin.physics.terms import TERMS, find_symbol, is_term, term
from counterspin.units import is_convertible, unit_factor

#: Start of the sentence on the conversion of an output.
OUTPUT_SENTENCE_START: Final = "The nominal output of"


def g_units_ratio(symbol: str, gravity: float, other_gravity: float) -> float:
    """Return the factor that converts a term to g-units of another gravity.

    A coefficient with n factors has the unit g/g^n and is proportional to g^(1 - n).
    """
    return (
        (gravity / other_gravity) ** (1 - len(TERMS[symbol].effect.factors))
        if symbol in TERMS
        else 1.0
    )


@frozen
class OutputConversion:
    """Conversion of coefficients from one nominal output to another."""

    #: Factor of each coefficient, in addition to `g_units_ratio`.
    ratio: float = 1.0
    #: Difference to add to K_F after the conversion, in g.
    zero_shift: float = 0.0

    def shift(self, symbol: str) -> float:
        """Return the difference to add to a coefficient after the conversion."""
        return self.zero_shift if symbol == "K_F" else 0.0


def output_conversion(
    nominal: NominalOutput | None,
    gravity: float,
    reference: NominalOutput | None,
    reference_gravity: float,
) -> OutputConversion:
    """Return the conversion of coefficients to a reference's nominal output.

    A coefficient is a true output divided by a nominal sensitivity, which is per local g.

    Returns: The identity if a nominal output is missing or their units are not convertible.
    """
    if nominal is None or reference is None or not is_convertible(nominal.unit, reference.unit):
        return OutputConversion()
    factor = unit_factor(nominal.unit, reference.unit)
    return OutputConversion(
        ratio=factor
        * (nominal.sensitivity / gravity)
        / (reference.sensitivity / reference_gravity),
        zero_shift=(factor * nominal.zero - reference.zero) / reference.sensitivity,
    )


def describe_output_conversion(
    name: str, pair: tuple[Result, Result], labels: tuple[str, str]
) -> Iterator[str]:
    """Yield a sentence on the conversion of an accelerometer's output, if the outputs differ.

    pair, labels: Reference and other result, and their names.
    """
    reference, nominal = (result.accelerometers[name].nominal for result in pair)
    gravities = [result.inputs.gravity for result in pair]
    if reference == nominal and (nominal is None or gravities[0] == gravities[1]):
        return
    gravity_texts = [
        "" if gravities[0] == gravities[1] else f" (g = {gravity:.9g} m/s^2)"
        for gravity in gravities
    ]
    texts = [
        ("g" if output is None else output.words) + gravity_text
        for output, gravity_text in zip((reference, nominal), gravity_texts, strict=True)
    ]
    is_converted = (
        reference is not None
        and nominal is not None
        and is_convertible(nominal.unit, reference.unit)
    )
    yield f"{OUTPUT_SENTENCE_START} {name} is {texts[0]} in {labels[0]} and {texts[1]} in " + (
        f"{labels[1]}. The comparison converts the values of {labels[1]} to the nominal output of "
        f"{labels[0]}."
        if is_converted
        else f"{labels[1]}. These units cannot be converted, so an error of a nominal sensitivity "
        "appears as a difference."
    )


def is_instrument_source(name: str) -> bool:
    """Return whether an uncertainty source is a term of an accelerometer."""
    symbol = find_symbol(name)
    return is_term(symbol) and term(symbol).scope == "accelerometer"


def are_different(names: Sequence[str | None]) -> bool:
    """Return whether stated names, such as serial numbers or laboratories, differ."""
    return len(set(names) - {None}) > 1


def source_value(result: Result, name: str, source: str) -> float | None:
    """Return the value of an input or prior; None if the result does not state it."""
    inputs, accelerometer = result.inputs, result.accelerometers[name]
    input_values = {
        "centrifuge.radius": inputs.radius,
        "site.gravity": inputs.gravity,
        "site.latitude": inputs.latitude,
    }
    if source in input_values:
        return input_values[source]
    if source in accelerometer.known:
        return accelerometer.known[source].value
    for prior in result.rests_on:
        if prior.name in (source, f"{name}.{source}"):
            return prior.value
    coefficient = accelerometer.coefficients.get(source)
    return None if coefficient is None or coefficient.estimated else coefficient.value

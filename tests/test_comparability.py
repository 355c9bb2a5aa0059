"""Conversion of results to the nominal output and the g-units of another result."""

import math

import pytest
import results as by_hand

from counterspin.calibration.result_parts import NominalOutput
from counterspin.comparability import (
    describe_output_conversion,
    g_units_ratio,
    output_conversion,
)

#: True output in mA: zero + sum of C_n f^n, f in m/s^2.
ZERO = 4.02
C = (0.127, 3e-8, 2e-10)


def coefficients_at(nominal, gravity, ampere=1e-3):
    """Return K_F, K_I, K_II and K_III of the true output with a nominal output, by hand."""
    scale = 1e-3 / ampere
    higher = [c * scale * gravity**n / nominal.sensitivity for n, c in enumerate(C, 1)]
    symbols = ("K_F", "K_I", "K_II", "K_III")
    offset = (ZERO * scale - nominal.zero) / nominal.sensitivity
    return dict(zip(symbols, [offset, *higher], strict=True))


@pytest.mark.parametrize(
    ("nominal", "ampere"),
    [
        (NominalOutput(unit="mA", sensitivity=1.25, zero=4.0), 1e-3),
        (NominalOutput(unit="mA", sensitivity=1.30), 1e-3),
        (NominalOutput(unit="uA", sensitivity=1240.0, zero=4010.0), 1e-6),
    ],
)
@pytest.mark.parametrize("gravity", [9.78, 9.8066])
def test_conversion_follows_from_true_output(nominal, ampere, gravity):
    reference, reference_gravity = NominalOutput(unit="mA", sensitivity=1.25, zero=4.0), 9.8066
    conversion = output_conversion(nominal, gravity, reference, reference_gravity)
    expected = coefficients_at(reference, reference_gravity)
    for symbol, value in coefficients_at(nominal, gravity, ampere).items():
        ratio = conversion.ratio * g_units_ratio(symbol, gravity, reference_gravity)
        assert math.isclose(value * ratio + conversion.shift(symbol), expected[symbol])


def test_outputs_in_other_quantities_are_not_converted():
    current = NominalOutput(unit="mA", sensitivity=1.25)
    for nominal in (None, NominalOutput(unit="V", sensitivity=1.25)):
        conversion = output_conversion(nominal, 9.8, current, 9.8)
        assert (conversion.ratio, conversion.zero_shift) == (1.0, 0.0)


def make_result(nominal, gravity=9.8):
    inputs = {"gravity": gravity, "latitude": 0.0, "radius": 2.5}
    accelerometer = by_hand.make_accelerometer_result(nominal=nominal)
    return by_hand.make_bare_result(accelerometers={"A": accelerometer}, inputs=inputs)


@pytest.mark.parametrize(
    ("first", "second", "words"),
    [
        ((None,), (None, 9.81), ""),
        (({"unit": "mA", "sensitivity": 1.25},), ({"unit": "mA", "sensitivity": 1.25},), ""),
        (
            ({"unit": "mA", "sensitivity": 1.25},),
            ({"unit": "mA", "sensitivity": 1.3},),
            "is 1.25 mA/g in old and 1.3 mA/g in new. The comparison converts",
        ),
        (
            ({"unit": "mA", "sensitivity": 1.25},),
            ({"unit": "mA", "sensitivity": 1.25}, 9.81),
            "is 1.25 mA/g (g = 9.8 m/s^2) in old and 1.25 mA/g (g = 9.81 m/s^2) in new. The",
        ),
        (({"unit": "mA", "sensitivity": 1.25},), (None,), "and g in new. These units cannot"),
    ],
)
def test_sentence_states_both_outputs(first, second, words):
    pair = make_result(*first), make_result(*second)
    text = " ".join(describe_output_conversion("A", pair, ("old", "new")))
    assert words in text
    assert bool(text) is bool(words)

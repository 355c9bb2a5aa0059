"""The one table of terms: products, units, sizes, symbols with a mounting's name."""

import itertools
import math

import numpy as np
import pytest
from equation_7 import EQUATION_7

from counterspin.physics.effects import AttitudeError, SpecificForceProduct
from counterspin.physics.terms import (
    DEGREE_PER_HOUR,
    PLATFORM_TERMS,
    READING_TERMS,
    TABLE,
    TERMS,
    accelerometer_name,
    affects_readings,
    find_symbol,
    is_term,
    mounting_name,
    shared_symbol,
    term,
)


def test_symbols_products_and_words_are_unique():
    symbols = [*TERMS, *PLATFORM_TERMS]
    assert len(symbols) == len(set(symbols)) == 18 + 33
    assert all(row.symbol == symbol for symbol, row in (TERMS | PLATFORM_TERMS).items())
    # No product under two names, in whatever order its factors are written.
    products = [tuple(sorted(row.effect.factors)) for row in TERMS.values()]
    assert len(set(products)) == len(products)
    assert len({row.effect.ieee_symbol.lower() for row in TERMS.values()}) == len(TERMS)
    assert len({row.words for row in (TERMS | PLATFORM_TERMS).values()}) == len(symbols)
    effects = [row.effect for row in PLATFORM_TERMS.values()]
    assert len(set(effects)) == len(effects)


IEEE = dict(
    zip(
        EQUATION_7,
        [
            "K0",
            "K1",
            "K2",
            "K3",
            "K4",
            "K5",
            "Kip",
            "Kio",
            "Kpo",
            "Kpp",
            "Koo",
            "Koq",
            "K0'",
            "K1'",
            "Kspin",
            "Kang",
            "delta_o",
            "delta_p",
        ],
        strict=True,
    )
)


@pytest.mark.parametrize("symbol", EQUATION_7)
def test_products_match_equation_7(symbol):
    for ipo in itertools.product([-1.5, 0.7, 2.0], [-0.9, 1.1], [0.3, -2.2]):
        expected = EQUATION_7[symbol](*ipo)
        assert TERMS[symbol].effect.evaluate(np.array(ipo)) == pytest.approx(expected, rel=1e-15)
    assert TERMS[symbol].effect.ieee_symbol == IEEE[symbol]


def test_products_preserve_shape():
    force = np.random.default_rng(1).normal(size=(3, 4, 5))
    for symbol, row in TERMS.items():
        expected = np.broadcast_to(EQUATION_7[symbol](*force), (4, 5))
        np.testing.assert_allclose(row.effect.evaluate(force), expected, rtol=1e-15)


@pytest.mark.parametrize("symbol", EQUATION_7)
def test_units_follow_degree_of_product(symbol):
    """In units of g, a coefficient of degree n has the unit g/g^n."""
    row = TERMS[symbol]
    if row.effect.requires_rotation:
        assert row.unit == {"K_spin": "g s^2/rad^2", "K_ang": "g s^2/rad"}[symbol]
        return
    force = np.array([1.3, -0.7, 0.4])
    degree = round(math.log2(row.effect.evaluate(2 * force) / row.effect.evaluate(force)))
    if symbol.startswith("delta"):
        assert degree == 1
        assert row.unit == "rad"
    else:
        assert (
            row.unit == {0: "g", 1: "g/g", 2: "g/g^2", 3: "g/g^3", 4: "g/g^4", 5: "g/g^5"}[degree]
        )


def test_product_texts_and_nominal_values():
    assert {s: row.effect.text for s, row in TERMS.items() if s in ("K_F", "K_III", "K_OQ")} == {
        "K_F": "1",
        "K_III": "a_I^3",
        "K_OQ": "a_I*|a_I|",
    }
    texts = {"K_0_asym": "sign(a_I)/2", "K_I_asym": "|a_I|/2", "K_spin": "w_I*w_P"}
    assert {symbol: TERMS[symbol].effect.text for symbol in texts} == texts
    assert TERMS["K_IP"].effect.text == "a_I*a_P"
    nominal = {symbol: row.nominal for symbol, row in TERMS.items() if row.nominal}
    assert nominal == {"K_I": 1.0}
    assert all(row.nominal == 0.0 for row in PLATFORM_TERMS.values())
    assert all(row.limit > 0.0 for row in (TERMS | PLATFORM_TERMS).values())


def test_platform_terms_cover_three_axes_and_nine_pairs():
    expected = {}
    for i, name in enumerate(["east", "north", "up"]):
        expected[f"platform.tilt.{name}"] = ("tilt", i, None, "rad", True)
        expected[f"platform.drift.{name}"] = ("drift", i, None, "rad/s", False)
        key = f"platform.g2_sensitivity.{name}"
        expected[key] = ("g2_sensitivity", i, None, "rad/s/g^2", False)
    for (i, a), (j, b) in itertools.product(enumerate("xyz"), repeat=2):
        key = f"platform.g_sensitivity.{a}{b}"
        expected[key] = ("g_sensitivity", i, j, "rad/s/g", False)
        expected[f"platform.compliance.{a}{b}"] = ("compliance", i, j, "rad/g", False)
    for n, wave in itertools.product((1, 2), ("cos", "sin")):
        expected[f"table.harmonic.{n}.{wave}"] = ("table", 2, None, "rad", False)
    for i, name in enumerate(["outward", "forward"]):
        expected[f"table.axis_tilt.{name}"] = ("table_axis", i, None, "rad", False)
    properties = {
        s: (turn.kind, turn.axis, turn.force_axis, row.unit, row.per_run)
        for s, row in PLATFORM_TERMS.items()
        if (turn := row.effect)
    }
    assert properties == expected
    assert not any(row.per_run for row in TERMS.values())


def test_term_returns_rows_of_both_tables():
    assert isinstance(term("K_II").effect, SpecificForceProduct)
    assert isinstance(term("platform.drift.up").effect, AttitudeError)
    assert term("K_OQ") is TERMS["K_OQ"]


@pytest.mark.parametrize("symbol", ["K2", "k_ii", "", "platform.tilt.west"])
def test_unknown_term_raises_with_known_symbols(symbol):
    with pytest.raises(ValueError, match=r"known: K_F, .*, table\.axis_tilt") as error:
        term(symbol)
    assert repr(symbol) in str(error.value)


def test_degree_per_hour():
    assert pytest.approx(math.pi / 180 / 3600, rel=1e-15) == DEGREE_PER_HOUR


@pytest.mark.parametrize("mounting", ["in", "m", "east", "MOUNTING"])
def test_symbol_with_mounting(mounting):
    radius, turn = f"centrifuge.radius.{mounting}", f"fixture.misalignment.{mounting}.east"
    assert term(radius) is TABLE["centrifuge.radius.MOUNTING"]
    assert term(turn) is TABLE["fixture.misalignment.MOUNTING.east"]
    if mounting != "MOUNTING":
        assert (mounting_name(radius), mounting_name(turn)) == (mounting, mounting)
    assert affects_readings(turn)
    assert find_symbol(turn) == turn
    assert find_symbol(f"A.{turn}") == turn


def test_symbol_with_accelerometer_and_mounting():
    radius = "centrifuge.radius.A.in"
    assert term(radius) is TABLE["centrifuge.radius.ACCELEROMETER.MOUNTING"]
    assert (accelerometer_name(radius), mounting_name(radius)) == ("A", "in")
    assert shared_symbol(radius) == "centrifuge.radius.in"
    assert accelerometer_name("centrifuge.radius.in") == ""
    assert shared_symbol("centrifuge.radius.in") == "centrifuge.radius.in"


@pytest.mark.parametrize(
    "name",
    [
        "centrifuge.radius.",
        "centrifuge.radius..b",
        "centrifuge.radius.a.",
        "fixture.misalignment.east",
        "fixture.misalignment.in.west",
        "fixture.misalignment.a.b.east",
    ],
)
def test_unknown_mounting_symbol_is_not_term(name):
    assert not is_term(name)
    assert mounting_name(name) == ""
    assert not affects_readings(name)


def test_readings_exclude_platform_and_encoder_terms():
    kinds = {type(row.effect).__name__ for row in READING_TERMS.values()}
    assert kinds == {"AttitudeError", "SetupError", "Slope", "TrajectoryError"}
    assert not affects_readings("platform.tilt.east")
    assert not affects_readings("encoder.harmonic.1.cos")


def test_row_scopes_match_symbols():
    assert {row.scope for row in TABLE.values()} == {
        "accelerometer",
        "run",
        "platform",
        "machine",
        "mounting",
        "position",
        "reading",
        "input",
    }
    assert all(row.per_mounting == ("MOUNTING" in symbol) for symbol, row in TABLE.items())
    assert all((row.scope == "position") == ("POSITION" in s) for s, row in TABLE.items())
    assert all(0.0 < row.typical < row.limit for row in TABLE.values())

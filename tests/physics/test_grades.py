"""Sizes of an accelerometer's terms by its grade."""

import math
from itertools import pairwise

import pytest

from counterspin.physics.grades import DEFAULT_GRADE, GRADES, SIZES
from counterspin.physics.terms import ACCELEROMETER_TERMS, TABLE, term


def test_only_accelerometer_terms_have_sizes_for_every_grade():
    assert set(SIZES) == set(ACCELEROMETER_TERMS)
    assert all(tuple(sizes) == GRADES for sizes in SIZES.values())


@pytest.mark.parametrize("symbol", ACCELEROMETER_TERMS)
def test_sizes_do_not_decrease_for_worse_grades(symbol):
    sizes = [term(symbol).sizes(grade) for grade in GRADES]
    for better, worse in pairwise(sizes):
        assert better.limit <= worse.limit
        assert better.typical <= worse.typical
    for size in sizes:
        assert 0.0 < size.typical < size.limit
        assert size.source


def test_default_grade_is_navigation():
    assert DEFAULT_GRADE == "navigation"
    for row in ACCELEROMETER_TERMS.values():
        assert row.sizes() == row.sizes("navigation")
        assert (row.limit, row.typical, row.source) == tuple(vars(row.sizes()).values())


def test_machine_term_has_same_size_for_all_grades():
    row = TABLE["platform.tilt.north"]
    assert row.sizes("consumer") == row.sizes()
    assert row.sizes().typical == row.typical
    assert row.source == row.sizes().source


def test_sizes_follow_from_cited_figures():
    consumer = {symbol: sizes["consumer"].typical for symbol, sizes in SIZES.items()}
    # A rectangular distribution over +-7.5 %.
    assert consumer["K_I"] == pytest.approx(0.075 / math.sqrt(3.0), rel=0.1)
    # 0.5 % of 4 g and of 8 g, over the square, and of 8 g over the cube.
    assert 0.005 * 8.0 / 8.0**2 < consumer["K_II"] < 0.005 * 4.0 / 4.0**2
    assert consumer["K_III"] == pytest.approx(0.005 * 8.0 / 8.0**3, rel=0.3)
    tactical = {symbol: sizes["tactical"].typical for symbol, sizes in SIZES.items()}
    assert tactical["K_II"] == pytest.approx(0.003 * 10.0 / 10.0**2)
    assert tactical["K_III"] == pytest.approx(0.003 * 10.0 / 10.0**3)


def test_source_quotes_slopes_of_huygens_servo_accelerometer():
    # Scale factor and offset of HASI's calibration file, by temperature in K.
    def slope_of_scale(kelvin):
        scale = 1.30675e-3 - 1.35046e-7 * kelvin + 4.02821e-10 * kelvin**2
        return (-1.35046e-7 + 2.0 * 4.02821e-10 * kelvin) / scale

    def slope_of_offset(kelvin):
        return 3.83652e-6 - 2.0 * 0.00761e-6 * kelvin

    source = SIZES["K_I.temperature"]["navigation"].source
    assert f"{1e6 * slope_of_scale(293.0):.0f} ppm/K" in source
    source = SIZES["K_F.temperature"]["navigation"].source
    for kelvin in (293.0, 100.0):
        assert f"{1e6 * abs(slope_of_offset(kelvin)):.1f} µg/K at {kelvin:.0f} K" in source

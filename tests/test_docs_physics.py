"""The page on the physics lists exactly the terms of the code, and its figures are computed."""

import math
import re
from fnmatch import fnmatchcase
from pathlib import Path

import numpy as np
import pytest

from counterspin.physics.accelerometer import QX, TERMS
from counterspin.physics.conditions import CONDITION_TERMS
from counterspin.physics.inputs import UNCERTAIN_INPUTS
from counterspin.physics.machine import MACHINE_TERMS
from counterspin.physics.observation import parabola
from counterspin.physics.shared_terms import DEGREE_PER_HOUR, OWN_TERMS, SHARED_TERMS

PAGE = (Path(__file__).parents[1] / "docs" / "physics.md").read_text(encoding="utf-8")


def rows_between(marker):
    """Return the body rows of the table between two comments, cell by cell."""
    _, begun, rest = PAGE.partition(f"<!-- {marker} -->\n")
    table, ended, _ = rest.partition(f"<!-- /{marker} -->")
    assert begun
    assert ended
    return [
        [cell.strip() for cell in line.strip("|").split(" | ")]
        for line in table.strip().splitlines()[2:]
    ]


def test_accelerometer_table_lists_exactly_the_terms():
    expected = [
        [
            row.symbol,
            # a bare bar would end the cell
            f"`{'-' if row.sign < 0 else ''}{row.product}`".replace("|", r"\|"),
            row.unit,
            row.ieee,
            row.words,
            f"{row.limit:g}",
            f"{row.typical:g}",
        ]
        for row in TERMS.values()
    ]
    assert rows_between("terms") == expected


def test_shared_table_lists_exactly_the_terms():
    expected = [
        [f"`{row.symbol}`", row.unit, row.words, f"{row.limit:.4g}", f"{row.typical:.4g}"]
        for row in SHARED_TERMS.values()
    ]
    assert rows_between("shared terms") == expected


def test_table_of_conditions_lists_exactly_the_terms():
    expected = [
        [f"`{row.symbol}`", row.unit, row.words, f"{row.limit:.4g}", f"{row.typical:.4g}"]
        for row in CONDITION_TERMS.values()
    ]
    assert rows_between("condition terms") == expected


def test_inputs_are_those_of_the_code():
    expected = [
        [f"`{row.symbol}`", row.unit, row.words, f"{row.typical:g}"]
        for row in UNCERTAIN_INPUTS.values()
    ]
    assert rows_between("inputs") == expected


def test_every_typical_size_says_where_it_comes_from():
    known = {**MACHINE_TERMS, **OWN_TERMS, **SHARED_TERMS, **UNCERTAIN_INPUTS}
    covered = []
    for names, size, source in rows_between("sources"):
        patterns = re.findall(r"`([\w.*]+)`", names)
        meant = [s for s in known if any(fnmatchcase(s, p) for p in patterns)]
        assert meant
        for symbol in meant:
            assert size == f"{known[symbol].typical:.4g} {known[symbol].unit}", symbol
        assert source
        covered += meant
    assert sorted(covered) == sorted(known)


def test_what_navigation_grade_means_for_bias_and_drift():
    # A nautical mile is a minute of arc of the Earth.
    miles = math.degrees(1.0) * 60.0
    assert OWN_TERMS["K_F"].typical * miles == pytest.approx(0.34, abs=0.005)
    drift = SHARED_TERMS["platform.drift.north"].typical
    assert drift * 3600.0 * miles == pytest.approx(0.6, rel=1e-3)


def test_ten_degrees_an_hour_in_si():
    assert f"{10 * DEGREE_PER_HOUR:.4g} rad/s" in PAGE


@pytest.mark.parametrize(
    ("words", "symbol", "size"),
    [
        ("1 µg of K_F", "K_F", 1e-6),
        ("1 arcsec of tilt", "platform.tilt.north", np.radians(1 / 3600)),
        ("1 deg/h/g of g-sensitivity", "platform.g_sensitivity.zx", DEGREE_PER_HOUR),
    ],
)
def test_equivalent_errors_of_k_ii(words, symbol, size):
    cells = []
    for rate in np.pi * np.array([0.5, 1.0, 2.0]):
        at_rate = (QX, rate, 2.5, 9.8)
        cells.append(f"{abs(parabola(symbol, *at_rate) / parabola('K_II', *at_rate)) * size:.1e}")
    assert [words, *cells] in rows_between("equivalents")

"""The page on the physics lists exactly the terms of the code, and its figures are computed."""

import math
import re
from fnmatch import fnmatchcase
from pathlib import Path

import numpy as np
import pytest

from counterspin.physics.accelerometer import QX, QY, QZ
from counterspin.physics.closed_forms import parabola
from counterspin.physics.grades import SIZES
from counterspin.physics.motion import Site, Trajectory
from counterspin.physics.observation import columns
from counterspin.physics.spindle import Spindle
from counterspin.physics.terms import (
    ACCELEROMETER_TERMS,
    CONDITION_TERMS,
    DEGREE_PER_HOUR,
    INPUTS,
    SHARED_TERMS,
    TABLE,
    TERMS,
)
from counterspin.reproduction.plan import TABLE_1

PAGE = (Path(__file__).parents[1] / "docs" / "physics.md").read_text(encoding="utf-8")


def rows_between(marker):
    """Return the body rows of the table between two comments, cell by cell."""
    _, begun, following_text = PAGE.partition(f"<!-- {marker} -->\n")
    table, ended, _ = following_text.partition(f"<!-- /{marker} -->")
    assert begun
    assert ended
    return [
        [cell.strip() for cell in line.strip("|").split(" | ")]
        for line in table.strip().splitlines()[2:]
    ]


def test_accelerometer_table_lists_all_terms():
    expected = [
        [
            row.symbol,
            # a bare bar would end the cell
            f"`{'-' if row.effect.weight < 0 else ''}{row.effect.text}`".replace("|", r"\|"),
            row.unit,
            row.effect.ieee_symbol,
            row.words,
            f"{row.limit:g}",
            f"{row.typical:g}",
        ]
        for row in TERMS.values()
    ]
    assert rows_between("terms") == expected


def test_shared_table_lists_all_terms():
    expected = [
        [f"`{row.symbol}`", row.unit, row.words, f"{row.limit:.4g}", f"{row.typical:.4g}"]
        for row in SHARED_TERMS.values()
    ]
    assert rows_between("shared terms") == expected


def test_condition_table_lists_all_terms():
    expected = [
        [f"`{row.symbol}`", row.unit, row.words, f"{row.limit:.4g}", f"{row.typical:.4g}"]
        for row in CONDITION_TERMS.values()
    ]
    assert rows_between("condition terms") == expected


def test_inputs_match_code():
    expected = [
        [f"`{row.symbol}`", row.unit, row.words, f"{row.typical:g}"] for row in INPUTS.values()
    ]
    assert rows_between("inputs") == expected


def test_sizes_by_grade_match_code():
    stated = {}
    for names, grade, limit, typical, source in rows_between("grades"):
        for symbol in re.findall(r"`([\w.]+)`", names):
            stated[symbol, grade] = (limit, typical, source)
    assert stated == {
        (symbol, grade): (f"{size.limit:g}", f"{size.typical:g}", size.source)
        for symbol, sizes in SIZES.items()
        for grade, size in sizes.items()
    }


def test_typical_sizes_have_source():
    known = {s: row for s, row in TABLE.items() if s not in ACCELEROMETER_TERMS}
    covered = []
    for names, size, source in rows_between("sources"):
        patterns = re.findall(r"`([\w.*]+)`", names)
        meant = [s for s in known if any(fnmatchcase(s, p) for p in patterns)]
        assert meant
        for symbol in meant:
            assert size == f"{known[symbol].typical:.4g} {known[symbol].unit}", symbol
            assert source == known[symbol].source
        covered += meant
    assert sorted(covered) == sorted(known)


def test_sizes_from_paper_are_fractions_of_table_1():
    parts = {"half": 2, "a third": 3, "a quarter": 4}
    fractions = {}
    for names, _, _, size, source in rows_between("grades"):
        if match := re.match(r"([a-z ]+) of .*Table 1 \(([\d.e-]+) g\S+\)", source):
            symbol = re.search(r"K_(?:III|II|IP)\b", names)[0]
            assert float(match[2]) == TABLE_1[symbol]
            assert float(size) == pytest.approx(TABLE_1[symbol] / parts[match[1]])
            fractions[symbol] = match[1]
    assert set(fractions) == {"K_II", "K_III", "K_IP"}


def test_navigation_grade_bias_and_drift_match_position_error():
    # A nautical mile is a minute of arc of the Earth.
    miles = math.degrees(1.0) * 60.0
    assert ACCELEROMETER_TERMS["K_F"].typical * miles == pytest.approx(0.34, abs=0.005)
    drift = SHARED_TERMS["platform.drift.north"].typical
    assert drift * 3600.0 * miles == pytest.approx(0.6, rel=1e-3)


def test_ten_degrees_per_hour_in_si():
    assert f"{10 * DEGREE_PER_HOUR:.4g} rad/s" in PAGE


@pytest.mark.parametrize(
    ("words", "symbol", "size"),
    [
        ("1 µg of K_F", "K_F", 1e-6),
        ("1 arcsec of tilt", "platform.tilt.north", np.radians(1 / 3600)),
        ("1 deg/h/g of g-sensitivity", "platform.g_sensitivity.zx", DEGREE_PER_HOUR),
    ],
)
def test_equivalent_errors_of_k_ii_match_table(words, symbol, size):
    cells = []
    for rate in np.pi * np.array([0.5, 1.0, 2.0]):
        at_rate = (QX, rate, 2.5, 9.8)
        ratio = parabola(symbol, *at_rate) / parabola("K_II", *at_rate)
        cells.append(f"{abs(ratio) * size:.1e}")
    assert [words, *cells] in rows_between("equivalents")


def evaluate_latex(formula, **values):
    """Return the value of a formula in LaTeX: powers, fractions, sines, cosines of R, w, g, t."""
    text = formula.strip().strip("$").replace(r"\Bigl[", "(").replace(r"\Bigr]", ")")
    text = re.sub(r"\\[dt]frac(\d)(\d+|\{\d+\})", r"(\1/\2)", text).replace("/{", "/(")
    text = re.sub(r"\(/?(\d)/\((\d+)\}\)", r"(\1/\2)", text)
    text = re.sub(r"\\dfrac\{([^{}]*)\}\{([^{}]*)\}", r"((\1)/(\2))", text)
    text = re.sub(r"\\(sin|cos) (\d?)wt", r"\1(\2wt)", text)
    tokens = re.findall(r"sin|cos|\d+|[Rwgt()+\-/]|\^\d+", text)
    assert "".join(tokens) == text.replace(" ", ""), text
    line = ""
    for before, token in zip(["(", *tokens], tokens, strict=False):
        operand = re.match(r"[\w(]", token) and not token.startswith("^")
        factor = operand and before not in "(+-/" and before not in ("sin", "cos")
        line += ("*" if factor else "") + token.replace("^", "**")
    return eval(line, {"sin": np.sin, "cos": np.cos, **values})


def test_closed_forms_match_columns():
    table = PAGE.partition("## Closed forms at constant rate")[2].partition(
        "## Separability of terms"
    )[0]
    rows = [
        [cell.strip() for cell in line.strip("|").split(" | ")]
        for line in table.splitlines()
        if line.startswith("| K_")
    ]
    numbers = {"R": 2.5, "w": 3.0, "g": 9.8}
    trajectory = Trajectory(Spindle(3.0), 2.5, Site(9.8, 0.8, earth_rate=0.0))
    times = np.linspace(0.0, 40.0, 81)
    checked = []
    for terms, column, parabolas in rows:
        for symbol in (
            s for s in terms.replace(" − 1", "").split(", ") if s in ACCELEROMETER_TERMS
        ):
            if column.startswith("$") and "t_0" not in column:
                got = columns(trajectory, QX, [symbol], times)[:, 0]
                expected = evaluate_latex(column, t=times, **numbers)
                np.testing.assert_allclose(got, expected, atol=1e-11 * max(abs(expected)))
                checked.append(symbol)
            if "t_0" not in parabolas:
                expected = evaluate_latex(parabolas.partition(";")[0], **numbers)
                assert parabola(symbol, QX, 3.0, 2.5, 9.8) == pytest.approx(expected, rel=1e-13)
                checked.append(symbol)
    assert {"K_F", "K_I", "K_II", "K_III", "K_IP", "K_IO", "K_OO", "K_PO", "K_4"} <= set(checked)
    assert len(checked) > 18


def test_accelerometer_directions_match_mountings():
    rows = re.findall(r"^\| (Q[xyz])(?: \(Eq\. 8\))? \| (\w+) \| (\w+) \| (\w+) \|$", PAGE, re.M)
    assert [name for name, *_ in rows] == ["Qx", "Qy", "Qz"]
    vectors = {"east": [1, 0, 0], "north": [0, 1, 0], "up": [0, 0, 1]}
    vectors |= {"down": [0, 0, -1], "west": [-1, 0, 0]}
    for (_, *names), mounting in zip(rows, (QX, QY, QZ), strict=True):
        np.testing.assert_array_equal(mounting.matrix, [vectors[name] for name in names])

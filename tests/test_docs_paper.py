"""Every number that the page on the paper quotes is the one that `reproduce` computes."""

import math
import re
from pathlib import Path

import pytest
from prose import agrees_to_last_digit, find_numbers, parse_number

from counterspin.physics.accelerometer import QX
from counterspin.physics.closed_forms import parabola
from counterspin.reproduction import plan
from counterspin.reproduction.comparison import reproduce

PAGE = (Path(__file__).parents[1] / "docs" / "paper.md").read_text(encoding="utf-8")

# A number followed by the key of its row: 1.0<!-- key --> or, the paper's, 1.0<!-- key:printed -->
NUMBER = r"-?\d+\.\d+(?:e[+-]\d\d)?"
QUOTED = re.findall(rf"({NUMBER})<!-- ([\w.]+?)(:printed)? -->", PAGE)


@pytest.fixture(scope="module")
def reproduction():
    return reproduce()


@pytest.mark.parametrize(("number", "key", "printed"), QUOTED)
def test_quoted_number_matches_reproduction(reproduction, number, key, printed):
    row = reproduction[key]
    assert number == (row.printed_text if printed else row.ours_text)


def test_every_figure_is_quoted(reproduction):
    assert {key for _, key, _ in QUOTED} == {row.key for row in reproduction.rows}


def test_every_quoted_number_has_key():
    assert PAGE.count("<!--") == len(QUOTED)
    unmarked = re.findall(NUMBER, re.sub(rf"{NUMBER}<!--.*?-->", "", PAGE))
    # What the paper states, what is put in, numbers of sections, and what the next test reads.
    assert set(unmarked) <= {"0.01", "0.004", "9.8", "9.80665", "2.2", "2.3", "1.5"}


def test_plan_is_about_fifty_times_better(reproduction):
    row = reproduction["sigma_k_ii.exact"]
    assert 45 < row.printed / row.ours < 60


def test_missing_drift_and_small_product_match_text(reproduction):
    (missing,) = find_numbers("paper", "(The estimate is {} % smaller than")
    drift = reproduction["separation.drift_as_ripple"].ours
    assert agrees_to_last_digit(missing, 100.0 * (1.0 - drift / (2.0 / 3.0 * plan.DRIFT_RATE)))
    (most,) = find_numbers("paper", "this parabola is at most {} millionths of the $K_{II}$ term")
    rate, table = max(plan.RATES), plan.TABLE_1
    product = 0.75 * table["K_III"] * plan.RADIUS**3 * rate**6 / plan.GRAVITY**2
    product *= plan.RIPPLE_RATIO * math.sin(plan.RIPPLE_PHASE)
    term = table["K_II"] * parabola("K_II", QX, rate, plan.RADIUS, plan.GRAVITY)
    assert 0.5e-6 * parse_number(most) < product / term < 1e-6 * parse_number(most)

"""Every number that the page on the paper quotes is the one that `reproduce` computes."""

import re
from pathlib import Path

import pytest

from counterspin.reproduction.comparison import reproduce

PAGE = (Path(__file__).parents[1] / "docs" / "paper.md").read_text(encoding="utf-8")

# A number followed by the key of its row: 1.0<!-- key --> or, the paper's, 1.0<!-- key:printed -->
NUMBER = r"-?\d+\.\d+(?:e[+-]\d\d)?"
QUOTED = re.findall(rf"({NUMBER})<!-- ([\w.]+?)(:printed)? -->", PAGE)


@pytest.fixture(scope="module")
def reproduction():
    return reproduce()


@pytest.mark.parametrize(("number", "key", "printed"), QUOTED)
def test_quoted_number(reproduction, number, key, printed):
    row = reproduction[key]
    assert number == (row.printed_text if printed else row.ours_text)


def test_every_figure_is_quoted(reproduction):
    assert {key for _, key, _ in QUOTED} == {row.key for row in reproduction.rows}


def test_no_figure_is_quoted_without_its_key():
    assert PAGE.count("<!--") == len(QUOTED)
    unmarked = re.findall(NUMBER, re.sub(rf"{NUMBER}<!--.*?-->", "", PAGE))
    # What the paper states, what is put in, and numbers of sections.
    assert set(unmarked) <= {"0.01", "0.004", "9.8", "9.80665", "2.2", "2.3"}


def test_the_plan_is_some_fifty_times_better(reproduction):
    row = reproduction["sigma_k_ii.exact"]
    assert 45 < row.printed / row.ours < 60

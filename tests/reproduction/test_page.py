"""The comparison with the paper as text, complete at all usual widths."""

import io

import pytest
from rich.console import Console

from counterspin.reproduction.comparison import reproduce
from counterspin.reproduction.plan import PaperSection, Reproduction, Row


def render(reproduction, width):
    out = io.StringIO()
    Console(file=out, width=width).print(reproduction)
    return out.getvalue()


@pytest.mark.parametrize("width", [80, 100, 160])
def test_numbers_are_not_broken_at_width(width):
    reproduction = reproduce()
    text = render(reproduction, width)
    assert max(len(line) for line in text.splitlines()) <= width
    words = text.split()
    for row in reproduction.rows:
        assert row.printed_text in words
        assert row.ours_text in words
    for section in reproduction.sections:
        assert section.title in text


def test_value_missing_in_paper_is_shown_as_dash():
    row = Row("a.b", "something", None, 2.5, "m", "not in the paper", ".1f")
    text = render(Reproduction(inputs={}, sections=(PaperSection("Part", (row,)),)), 80)
    assert next(line.split()[:4] for line in text.splitlines() if line.startswith("something")) == [
        "something",
        "-",
        "2.5",
        "m",
    ]

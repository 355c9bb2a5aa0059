"""Typesetting of numbers and units."""

import pytest

from counterspin.characters import MultilineText
from counterspin.reports.blocks import (
    Bars,
    Column,
    Heading,
    HeatMap,
    Paragraph,
    Plot,
    PlotSeries,
    Table,
)
from counterspin.reports.numbers import format_compact, format_estimate
from counterspin.reports.typography import set_indices, typeset, typeset_block


@pytest.mark.parametrize(
    ("plain", "printed"),
    [
        (format_estimate(2.70445e-5, 3.7e-9, "g/g^2"), "(2.70445 ± 0.00037) × 10⁻⁵ g/g²"),
        (format_compact(2.70445e-5, 3.7e-9), "2.70445(37) × 10⁻⁵"),
        ("3.1(1.2)e12", "3.1(1.2) × 10¹²"),
        (f"{1e-9:.2g} g and {4e-8:.2g} g", "10⁻⁹ g and 4 × 10⁻⁸ g"),
        (f"{1e12:.2g} g, {2.5e20:.2g} g", "10¹² g, 2.5 × 10²⁰ g"),
        ("± 0.0012 ug", "± 0.0012 µg"),
        ("1e-5 g/g^2", "10⁻⁵ g/g²"),
        ("6e-7 (< 0.1 %)", "6 × 10⁻⁷ (< 0.1 %)"),
        ("3e-6 m/s^2 and s^-1", "3 × 10⁻⁶ m/s² and s⁻¹"),
        ("K_II, ug/g^2 per unit", "K_II, µg/g² per unit"),
        ("by 29 ug/g^2.", "by 29 µg/g²."),
        ("0.0080 ug. 3 ug", "0.0080 µg. 3 µg"),
        ("ug.csv", "ug.csv"),
        ("-32.78 (-5 to -.5), K_I - 0.159 z = -1e-5", "−32.78 (−5 to −.5), K_I − 0.159 z = −10⁻⁵"),
        ("2026-03-01, run-1, a-2, Student-t, 1-2", "2026-03-01, run-1, a-2, Student-t, 1-2"),
        # Text that is not a number or has another form.
        ("run1e5.csv", "run1e5.csv"),
        ("file.1e5", "file.1e5"),
        ("a^2.5 and x^b", "a^2.5 and x^b"),
        ("debug, ugly, mug, A.ug", "debug, ugly, mug, A.ug"),
        ("g/Hz^0.5", "g/Hz^0.5"),
        ("8c969ed83a48ee1b", "8c969ed83a48ee1b"),
        ("2 x 3", "2 x 3"),
    ],
)
def test_numbers_and_units_are_typeset(plain, printed):
    assert typeset(plain) == printed
    assert typeset(printed) == printed


def test_blocks_except_commands_are_typeset():
    assert typeset_block(Heading("ug", 3)) == Heading("µg", 3)
    assert typeset_block(Paragraph("g^2", "quiet")) == Paragraph("g²", "quiet")
    assert typeset_block(Paragraph("run g^2", "command")) == Paragraph("run g^2", "command")
    table = Table((Column("ug", "right"),), (("1e-5 g",),), frozenset({0}))
    assert typeset_block(table) == Table((Column("µg", "right"),), (("10⁻⁵ g",),), frozenset({0}))
    lines = typeset_block(Table((Column(""),), ((MultilineText("1 ug", "2\n ug"),),)))
    assert lines.rows == (("1 µg\n2\\n µg",),)
    plot = Plot("ug", "s^2", "m^2", (PlotSeries("1e3 ug", (0.0,), (1.0,)),), zoom=True)
    assert typeset_block(plot) == Plot(
        "µg", "s²", "m²", (PlotSeries("10³ µg", (0.0,), (1.0,)),), zoom=True
    )
    bars = Bars("ug", ("ug.csv",), (1.0,), ("6e-7",))
    assert typeset_block(bars) == Bars("µg", ("ug.csv",), (1.0,), ("6 × 10⁻⁷",))
    assert typeset_block(HeatMap("ug", ("K",), ((1.0,),))) == HeatMap("µg", ("K",), ((1.0,),))


@pytest.mark.parametrize(
    ("plain", "printed"),
    [
        ("K_II of Qx", "K[II] of Qx"),
        ("misalignment, delta_O: 3 mrad", "misalignment, δ[O]: 3 mrad"),
        ("the mean of a_I².", "the mean of a[I]²."),
        ("K_F.heating, Qx.K_II, a_1.csv and delta_Omega", None),
    ],
)
def test_symbols_have_subscripts(plain, printed):
    assert set_indices(plain, lambda letter, index: f"{letter}[{index}]") == (printed or plain)

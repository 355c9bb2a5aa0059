"""Characters: escaped control characters and replacements for limited encodings."""

import unicodedata

import pytest

from counterspin.campaign.quantity import parse_quantity
from counterspin.characters import MultilineText, escape_controls, substitute_unencodable
from counterspin.reports.numbers import format_estimate


@pytest.mark.parametrize(
    ("encoding", "message"),
    [
        ("utf-8", "2 × 10⁻⁵ µg/g²"),
        ("latin-1", "2 × 10^-5 µg/g²"),
        ("ascii", "2 x 10^-5 ug/g^2"),
    ],
)
def test_superscripts_are_replaced_if_not_encodable(encoding, message):
    assert substitute_unencodable("2 × 10⁻⁵ µg/g²", encoding) == message


@pytest.mark.parametrize(
    ("encoding", "expected"),
    [
        ("utf-8", "1 ± 2 × 3 − Ω"),
        ("latin-1", "1 ± 2 × 3 - ?"),
        ("ascii", "1 +/- 2 x 3 - ?"),
    ],
)
def test_text_is_encodable_in_any_encoding(encoding, expected):
    assert substitute_unencodable("1 ± 2 × 3 − Ω", encoding) == expected


def test_replaced_text_is_valid_in_campaign_file():
    text = substitute_unencodable(format_estimate(27.0445, 0.0007, "ug/g^2"), "ascii")
    assert parse_quantity(text, "g/g^2").u == pytest.approx(7e-10)


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("\x1b[31mred\x07", r"\x1b[31mred\x07"),
        ("one\rtwo\ttab", r"one\rtwo\ttab"),
        ("\x9b31m\x7f\x85", r"\x9b31m\x7f\x85"),
        ("K\u202eII\u2066", r"K\u202eII\u2066"),
        ("\u061c\u200e\u200f\u2028\u2029\ufeff", r"\u061c\u200e\u200f\u2028\u2029\ufeff"),
        ("file\udcff.csv", r"file\udcff.csv"),
        ("µg/g² ± 加速度計 é\u0301 👩\u200d🔬", "µg/g² ± 加速度計 é\u0301 👩\u200d🔬"),
        ("two\nlines", r"two\nlines"),
        ("no character: \ufffe\uffff", r"no character: \ufffe\uffff"),
    ],
)
def test_control_characters_are_escaped(text, shown):
    assert escape_controls(text) == escape_controls(escape_controls(text)) == shown


def test_multiline_text_keeps_lines_and_escapes_newlines_in_values():
    assert escape_controls(MultilineText("one", "t\x1bwo\nK_II = 1")) == "one\nt\\x1bwo\\nK_II = 1"


def test_all_unicode_controls_are_escaped():
    kinds = {"Cc", "Cs", "Zl", "Zp"}
    directions = {"LRE", "RLE", "LRO", "RLO", "PDF", "LRI", "RLI", "FSI", "PDI"}
    for code in range(0x110000):
        character = chr(code)
        acts = (
            unicodedata.category(character) in kinds
            or unicodedata.bidirectional(character) in directions
        )
        if acts:
            assert escape_controls(character) == character.encode("unicode_escape").decode(), hex(
                code
            )

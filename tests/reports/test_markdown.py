"""Markdown, read back by a parser: what was said stands there, word for word."""

from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from markdown_it import MarkdownIt

from counterspin.characters import MultilineText, escape_controls
from counterspin.reports.blocks import Bars, Column, Heading, Paragraph, Table
from counterspin.reports.markdown import escape_markdown, markdown

HOSTILE = [
    "K_II and K_IP_ and __init__",
    "a | b || c",
    "*not* **strong** ~~gone~~ ~x~",
    "<b>bold</b> <script>alert(1)</script> & &amp; &lt;",
    "<div no block",
    "[link](http://example.org) ![picture](x) [!NOTE] [x]: y",
    "`code` ``more``",
    "\\ \\| \\n ends in \\",
    "$x^2$ $$y$$",
    "# no heading #",
    "- no list",
    "+ no list",
    "-",
    "1. no list",
    "12) no list",
    "=====",
    "---",
    "-0.5 ± 0.2",
    "> no quotation",
    "http://a.b/c_d_e?f=1&copy=2",
]

every_hostile_text = pytest.mark.parametrize("text", HOSTILE)


def parsed(text):
    return MarkdownIt("commonmark").enable(["table", "strikethrough"]).parse(text)


def shown(inline):
    """Return what a reader sees of an inline token; markup that is not expected is an error."""
    seen = ""
    for token in inline.children:
        if token.type == "text":
            seen += token.content
        elif token.type == "hardbreak" or (token.type, token.content) == ("html_inline", "<br>"):
            seen += "\n"
        elif token.type == "softbreak":
            seen += " "
        else:
            assert token.type in {"strong_open", "strong_close"}
    return seen


def inlines(text, kind):
    tokens = parsed(text)
    return [shown(b) for a, b in pairwise(tokens) if a.type == f"{kind}_open"]


def cells(text):
    tokens = parsed(text)
    rows = []
    for before, token in pairwise(tokens):
        if before.type == "tr_open":
            rows.append([])
        if before.type in {"th_open", "td_open"}:
            rows[-1].append(shown(token))
    return rows


@every_hostile_text
def test_words_come_out_as_they_are(text):
    tokens = parsed(markdown([Paragraph(text)]))
    assert [token.type for token in tokens] == ["paragraph_open", "inline", "paragraph_close"]
    assert shown(tokens[1]) == text
    assert inlines(markdown([Heading(text, 3)]), "heading") == [text]
    for style in ("answer", "undetermined", "warning"):
        quotation = markdown([Paragraph(text, style)])
        assert parsed(quotation)[0].type == "blockquote_open"
        (said,) = inlines(quotation.removeprefix("> [!WARNING]\n"), "paragraph")
        assert said == text


printable = st.text(st.characters(exclude_categories=("Cs", "Cc", "Zs", "Zl", "Zp"))).map(str.strip)
spaced = st.lists(printable, max_size=4).map(lambda words: " ".join(" ".join(words).split()))


@given(st.lists(st.tuples(spaced, spaced, spaced), max_size=3))
@settings(deadline=None, max_examples=150)
def test_any_cell_comes_out_as_it_is(rows):
    table = Table((Column("a|b"), Column("K_II", "right"), Column("")), tuple(rows))
    assert cells(markdown([table])) == [
        ["a|b", "K_II", ""],
        *(list(map(escape_controls, r)) for r in rows),
    ]


@given(spaced)
@settings(deadline=None, max_examples=150)
def test_any_paragraph_comes_out_as_it_is(text):
    assert inlines(markdown([Heading("x"), Paragraph(text)]), "paragraph") == (
        [escape_controls(text)] if text else []
    )


def test_lines_stay_lines():
    lines = MultilineText("one", "===", "- two", "", "    three")
    assert inlines(markdown([Paragraph(lines)]), "paragraph") == ["one\n===\n- two\nthree"]
    table = Table((Column("Ripple"),), ((MultilineText("1: 0.5", "2: 0.1"),),))
    assert cells(markdown([table])) == [["Ripple"], ["1: 0.5\n2: 0.1"]]


def test_ends_of_lines_in_a_name_begin_no_line():
    name = "Qx\n\n# Good\n"
    shown = r"Qx\n\n# Good\n"
    table = Table((Column(name),), ((name,),))
    text = markdown([Heading(name), Paragraph(name), Paragraph(name, "command"), table])
    assert inlines(text, "heading") == inlines(text, "paragraph") == [shown]
    assert cells(text) == [[shown], [shown]]
    assert f"sh\n{shown}\n`" in text


def test_table_is_aligned_for_parser_and_eye():
    table = Table(
        (Column("Run"), Column("K_II, ug/g^2", "right")),
        (("run1", "27.0416"), ("a | longer name", "-3")),
        quiet=frozenset({1}),
    )
    text = markdown([table])
    styles = [t.attrs.get("style") for t in parsed(text) if t.type == "td_open"]
    assert styles == [None, "text-align:right"] * 2
    lines = text.splitlines()
    assert len({len(line) for line in lines}) == 1
    assert lines[2].endswith("      27.0416 |")


def test_kinds_of_paragraphs():
    text = markdown(
        [
            Heading("Report", 1),
            Paragraph("K_II of Qx = 1 ± 2", "answer"),
            Paragraph("K_II of Qy = 3 ± 4", "answer"),
            Paragraph("Warning: short records", "warning"),
            Paragraph("a_ind = K_F `x`", "equation"),
            Paragraph("counterspin calibrate .", "command"),
            Paragraph("k = 1", "quiet"),
        ]
    )
    tokens = parsed(text)
    assert [t.info for t in tokens if t.type == "fence"] == ["text", "sh"]
    assert [t.content for t in tokens if t.type == "fence"] == [
        "a_ind = K_F `x`\n",
        "counterspin calibrate .\n",
    ]
    # Both answers in one quotation, the warning in another.
    assert [t.type for t in tokens].count("blockquote_open") == 2
    assert "\n> [!WARNING]\n> Warning: short records\n" in text
    assert inlines(text, "paragraph")[:3] == [
        "K_II of Qx = 1 ± 2",
        "K_II of Qy = 3 ± 4",
        "[!WARNING] Warning: short records",
    ]
    assert text.endswith("\n\nk = 1\n")


def test_code_with_fences_stays_code():
    (fence,) = parsed(markdown([Paragraph(MultilineText("```", "rm x", "````"), "command")]))
    assert fence.content == "```\nrm x\n````\n"


def test_pictures_are_left_out():
    bars = Bars("Budget", ("noise",), (1.0,), ("100 %",))
    assert markdown([Paragraph("before"), bars, Paragraph("after")]) == "before\n\nafter\n"
    assert escape_markdown("") == ""


def test_what_acts_on_a_terminal_is_shown():
    column = Column("a\x9b\u202e")
    blocks = [
        Heading("red\x1b[31m"),
        Paragraph("title\x07\u2028b"),
        Paragraph("x\x1b\\y", "command"),
        Table((column,), (("c\x00",),)),
    ]
    text = markdown(blocks)
    for shown in (r"\\x1b\[31m", r"\\x07\\u2028b", "x\\x1b\\y\n", r"\\x9b\\u202e", r"\\x00"):
        assert shown in text
    assert all(character.isprintable() or character == "\n" for character in text)

"""Markdown is parsed back to the original text."""

from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from markdown_it import MarkdownIt

from counterspin.characters import MultilineText, escape_controls
from counterspin.reports.blocks import Bars, Column, Heading, Paragraph, Table
from counterspin.reports.markdown import escape_markdown, render_markdown

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


def parse_markdown(text):
    return MarkdownIt("commonmark").enable(["table", "strikethrough"]).parse(text)


def inline_text(inline):
    """Return the visible text of an inline token; unexpected markup is an error."""
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


def inline_texts(text, kind):
    tokens = parse_markdown(text)
    return [inline_text(b) for a, b in pairwise(tokens) if a.type == f"{kind}_open"]


def table_cells(text):
    tokens = parse_markdown(text)
    rows = []
    for before, token in pairwise(tokens):
        if before.type == "tr_open":
            rows.append([])
        if before.type in {"th_open", "td_open"}:
            rows[-1].append(inline_text(token))
    return rows


@every_hostile_text
def test_text_round_trips_through_parser(text):
    tokens = parse_markdown(render_markdown([Paragraph(text)]))
    assert [token.type for token in tokens] == ["paragraph_open", "inline", "paragraph_close"]
    assert inline_text(tokens[1]) == text
    assert inline_texts(render_markdown([Heading(text, 3)]), "heading") == [text]
    for style in ("answer", "undetermined", "warning"):
        quotation = render_markdown([Paragraph(text, style)])
        assert parse_markdown(quotation)[0].type == "blockquote_open"
        (actual_inline_text,) = inline_texts(quotation.removeprefix("> [!WARNING]\n"), "paragraph")
        assert actual_inline_text == text


printable = st.text(st.characters(exclude_categories=("Cs", "Cc", "Zs", "Zl", "Zp"))).map(str.strip)
spaced = st.lists(printable, max_size=4).map(lambda words: " ".join(" ".join(words).split()))


@given(st.lists(st.tuples(spaced, spaced, spaced), max_size=3))
@settings(deadline=None, max_examples=150)
def test_table_cells_round_trip_through_parser(rows):
    table = Table((Column("a|b"), Column("K_II", "right"), Column("")), tuple(rows))
    assert table_cells(render_markdown([table])) == [
        ["a|b", "K_II", ""],
        *(list(map(escape_controls, r)) for r in rows),
    ]


@given(spaced)
@settings(deadline=None, max_examples=150)
def test_paragraph_round_trips_through_parser(text):
    assert inline_texts(render_markdown([Heading("x"), Paragraph(text)]), "paragraph") == (
        [escape_controls(text)] if text else []
    )


def test_line_breaks_are_preserved():
    lines = MultilineText("one", "===", "- two", "", "    three")
    assert inline_texts(render_markdown([Paragraph(lines)]), "paragraph") == [
        "one\n===\n- two\nthree"
    ]
    table = Table((Column("Ripple"),), ((MultilineText("1: 0.5", "2: 0.1"),),))
    assert table_cells(render_markdown([table])) == [["Ripple"], ["1: 0.5\n2: 0.1"]]


def test_line_breaks_in_names_are_escaped():
    name = "Qx\n\n# Good\n"
    shown = r"Qx\n\n# Good\n"
    table = Table((Column(name),), ((name,),))
    text = render_markdown([Heading(name), Paragraph(name), Paragraph(name, "command"), table])
    assert inline_texts(text, "heading") == inline_texts(text, "paragraph") == [shown]
    assert table_cells(text) == [[shown], [shown]]
    assert f"sh\n{shown}\n`" in text


def test_table_is_aligned_for_parser_and_eye():
    table = Table(
        (Column("Run"), Column("K_II, ug/g^2", "right")),
        (("run1", "27.0416"), ("a | longer name", "-3")),
        quiet_rows=frozenset({1}),
    )
    text = render_markdown([table])
    styles = [t.attrs.get("style") for t in parse_markdown(text) if t.type == "td_open"]
    assert styles == [None, "text-align:right"] * 2
    lines = text.splitlines()
    assert len({len(line) for line in lines}) == 1
    assert lines[2].endswith("      27.0416 |")


def test_paragraph_styles():
    text = render_markdown(
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
    tokens = parse_markdown(text)
    assert [t.info for t in tokens if t.type == "fence"] == ["text", "sh"]
    assert [t.content for t in tokens if t.type == "fence"] == [
        "a_ind = K_F `x`\n",
        "counterspin calibrate .\n",
    ]
    # Both answers in one quotation, the warning in another.
    assert [t.type for t in tokens].count("blockquote_open") == 2
    assert "\n> [!WARNING]\n> Warning: short records\n" in text
    assert inline_texts(text, "paragraph")[:3] == [
        "K_II of Qx = 1 ± 2",
        "K_II of Qy = 3 ± 4",
        "[!WARNING] Warning: short records",
    ]
    assert text.endswith("\n\nk = 1\n")


def test_code_with_fences_stays_code():
    (fence,) = parse_markdown(
        render_markdown([Paragraph(MultilineText("```", "rm x", "````"), "command")])
    )
    assert fence.content == "```\nrm x\n````\n"


def test_plots_are_omitted():
    bars = Bars("Budget", ("noise",), (1.0,), ("100 %",))
    assert render_markdown([Paragraph("before"), bars, Paragraph("after")]) == "before\n\nafter\n"
    assert escape_markdown("") == ""


def test_control_characters_are_escaped():
    column = Column("a\x9b\u202e")
    blocks = [
        Heading("red\x1b[31m"),
        Paragraph("title\x07\u2028b"),
        Paragraph("x\x1b\\y", "command"),
        Table((column,), (("c\x00",),)),
    ]
    text = render_markdown(blocks)
    for shown in (r"\\x1b\[31m", r"\\x07\\u2028b", "x\\x1b\\y\n", r"\\x9b\\u202e", r"\\x00"):
        assert shown in text
    assert all(character.isprintable() or character == "\n" for character in text)

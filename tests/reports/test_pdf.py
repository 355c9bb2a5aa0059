"""The PDF: what a reader finds on its pages, and what an archive and a machine find in it."""

import io
import os
import shutil
import subprocess
import sys
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path

import pypdf
import pytest
import typst
from matplotlib.image import imread

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
from counterspin.reports.pdf import Attachment, pdf

DATE = datetime(2026, 3, 1, 14, 30, tzinfo=timezone(timedelta(hours=1)))

#: A committed certificate, XML attached.
EXAMPLE = Path(__file__).parents[2] / "docs" / "examples" / "three-rate" / "certificate.pdf"

HOSTILE = r'#panic() #let x = [ $a^b$ ] \ *b* _c_ `d` <e> @f // g /* h */ "i" {j} ~ -- ... = \u{41}'

PICTURES = [
    Plot("Drift", "time / s", "drift", (PlotSeries("seen", (0.0, 1.0), (1.0, 2.0)),)),
    Bars("Budget", ("noise",), (1.0,), ("100 %",)),
    HeatMap("Correlation", ("a", "b"), ((1.0, 0.5), (0.5, 1.0))),
]


def made(*blocks, title="Campaign", identifier="CS-0123456789ab", date=DATE, attachments=()):
    return pdf(list(blocks), title=title, identifier=identifier, date=date, attachments=attachments)


def reader(*blocks, **settings):
    return pypdf.PdfReader(io.BytesIO(made(*blocks, **settings)), strict=True)


def words(page):
    """Return the text of a page in one line, without what was put in to break it."""
    return " ".join(page.extract_text().replace("\u200b", "").split())


def pixels(monkeypatch, *blocks):
    """Return every page as it looks, shape (height, width), 1 where the paper is white."""
    pages = []

    def look(files, **settings):
        drawn = compile_(files, ignore_system_fonts=True, format="png", ppi=72.0)
        for page in drawn if isinstance(drawn, list) else [drawn]:
            pages.append(imread(io.BytesIO(page))[..., :3].min(axis=-1))
        return compile_(files, **settings)

    compile_ = typst.compile
    with monkeypatch.context() as patch:
        patch.setattr(typst, "compile", look)
        made(*blocks)
    return pages


# Pages


def test_every_page_says_what_it_belongs_to():
    found = reader(*(Paragraph(f"Paragraph {i}. " + "Words " * 60) for i in range(40)))
    count = len(found.pages)
    assert count > 2
    for number, page in enumerate(found.pages, 1):
        text = words(page)
        assert "Campaign" in text
        assert "CS-0123456789ab" in text
        assert f"Page {number} of {count}" in text
        assert "2026-03-01 13:30 UTC" in text
        assert ("End of CS-0123456789ab" in text) == (number == count)


def test_the_end_never_takes_a_page_of_its_own():
    # Whatever is said last, something of it stands on the last page.
    for length in range(40, 60):
        found = reader(*(Paragraph(f"line {i}") for i in range(length)))
        last = words(found.pages[-1])
        assert "line" in last
        assert "End of CS-0123456789ab" in last


def test_title_is_the_heading_where_there_is_none():
    (page,) = reader(Paragraph("words")).pages
    assert words(page).count("Campaign") == 2
    (page,) = reader(Heading("Its own", 1), title="Campaign").pages
    assert words(page).count("Campaign") == 1


def test_words_are_never_read_as_markup():
    found = reader(
        Heading(HOSTILE, 1),
        Heading(f"2 {HOSTILE}", 2),
        Paragraph(f"answer {HOSTILE}", "answer"),
        Paragraph(f"warning {HOSTILE}", "warning"),
        Paragraph(f"plain {HOSTILE}"),
        Paragraph(f"quiet {HOSTILE}", "quiet"),
        Paragraph(f"$ {HOSTILE}", "command"),
        Table((Column(f"title {HOSTILE}"),), ((f"cell {HOSTILE}",),)),
        Bars(f"bars {HOSTILE}", ("#a $b$",), (1.0,), ("100 %",)),
        title=HOSTILE,
    )
    text = " ".join(words(page) for page in found.pages)
    heads = ("2", "answer", "warning", "plain", "quiet", "$", "title", "cell", "bars")
    for head in heads:
        assert f"{head} {HOSTILE}" in text
    assert "#a $b$" in text
    assert found.metadata.title == HOSTILE


def test_indices_of_equations_are_set_as_indices():
    (page,) = reader(Paragraph("Q: a_ind = K_F + K_II a² − ω ∬ f", "equation")).pages
    text = words(page)
    assert "_" not in text.split("Q: ")[1]
    for symbol in ("ω", "∬", "²", "−"):
        assert symbol in text


def test_pictures_keep_their_words_and_are_read_aloud():
    data = made(*PICTURES)
    found = pypdf.PdfReader(io.BytesIO(data))
    text = " ".join(words(page) for page in found.pages)
    for said in ("Drift", "time / s", "seen", "Budget", "100 %", "Correlation", "0.50"):
        assert said in text
    alternatives = {
        thing.get_object()["/Alt"]
        for thing in (found.get_object(i) for i in range(1, len(found.xref[0]) + 1))
        if isinstance(thing, pypdf.generic.DictionaryObject) and "/Alt" in thing
    }
    assert alternatives == {"Drift", "Budget", "Correlation"}


def test_nothing_leaves_the_margins(monkeypatch):
    long = "x" * 300
    for style in ("plain", "answer", "warning", "quiet", "command"):
        for page in pixels(monkeypatch, Paragraph(f"{long} {HOSTILE * 3}", style), *PICTURES):
            assert page[:, -61:].min() == 1.0
    for page in pixels(monkeypatch, Heading(HOSTILE * 4, 1), Heading(long, 2)):
        assert page[:, -61:].min() == 1.0


def test_letters_that_no_font_has_become_squares():
    odd = "\ue123\U000e0041"
    found = reader(
        Paragraph(f"α Ж é {odd[0]} end"), Bars(f"b{odd[0]}", (f"label{odd[0]}",), (1.0,), ("1",))
    )
    text = words(found.pages[0])
    assert "α Ж é □ end" in text
    assert "label□" in text or "label\ufffd" in text


def test_names_act_on_nothing_and_begin_no_line():
    name = "Qx\x1b\u202e\nK_II = 1"
    shown = r"Qx\x1b\u202e\nK_II = 1"
    blocks = [Paragraph(name), Table((Column(name),), ((name,),))]
    found = reader(*blocks, title=name, identifier=name)
    assert found.metadata.title == shown
    text = found.pages[0].extract_text()
    assert text.count("\\nK") >= 5
    assert not [line for line in text.splitlines() if line.startswith("K")]


# Tables


def long_table(rows, columns=4):
    return Table(
        (
            Column("Name of the run", wraps=True),
            *(Column(f"c{i}", "right") for i in range(columns)),
        ),
        tuple((f"run{r}", *(f"{r}.{c}00417" for c in range(columns))) for r in range(rows)),
        quiet=frozenset({1}),
    )


def test_long_table_goes_on_under_the_same_header():
    found = reader(long_table(150))
    assert len(found.pages) > 2
    text = [words(page) for page in found.pages]
    assert all("Name of the run c0 c1 c2 c3" in page for page in text)
    for row in range(150):
        assert sum(f"run{row} {row}.000417 {row}.100417" in page for page in text) == 1


def test_long_table_begins_where_some_of_its_rows_have_room():
    counts = []
    for lines in range(34, 48):
        found = reader(*(Paragraph("x") for _ in range(lines)), long_table(20))
        first = next(text for page in found.pages if "run0 " in (text := words(page)))
        counts.append(sum(f"run{row} {row}." in first for row in range(20)))
    # Wherever on the page the table happens to stand, which differs between these.
    assert min(counts) >= 3
    assert len(set(counts)) > 3


def test_symbols_have_an_index():
    text = words(reader(Paragraph("K_II of a_run"), Table((Column("K_F"),), (("K_I",),))).pages[0])
    assert "KII of a_run" in text
    assert "KF KI" in text


def test_short_table_stays_in_one_piece():
    for lines in range(30, 48, 3):
        found = reader(*(Paragraph("x") for _ in range(lines)), long_table(10))
        on = [words(page) for page in found.pages if "run0 " in words(page)]
        assert len(on) == 1
        assert "run9 " in on[0]


@pytest.mark.parametrize(
    "table",
    [
        long_table(20, columns=11),
        long_table(3, columns=30),
        Table((Column("File"), Column("SHA-256")), (("records/" * 60 + "run1.csv", "0a" * 32),)),
        Table((Column("a", wraps=True), Column("b", wraps=True)), (("x" * 400, "words " * 300),)),
    ],
    ids=["11 columns", "31 columns", "long name", "long words"],
)
def test_wide_table_stays_on_the_page_whole(table, monkeypatch):
    margin = 61  # 22 mm are 62.4 points; a letter may reach out by a fraction of one
    for page in pixels(monkeypatch, table):
        assert page[:, :-margin].min() < 0.5
        assert page[:, -margin:].min() == 1.0
        assert page[:, : margin - 1].min() == 1.0
    found = reader(table)
    text = "".join("".join(page.extract_text().split()) for page in found.pages)
    text = text.replace("\u200b", "")
    if len(table.rows) == 20:
        text = "".join("".join(words(page).split()) for page in found.pages)
        for row in table.rows:
            assert "".join(row) in text
    letters = sum(len("".join(cell.split())) for row in table.rows for cell in row)
    assert len(text) > letters


def test_numbers_of_a_column_end_at_the_same_place():
    table = Table((Column("value", "right"),), (("1.5",), ("-1234.5",), ("0.5",)))
    (page,) = reader(table).pages
    ends = {}

    def visit(text, current, matrix, font, size):
        if text.strip() in {"1.5", "-1234.5", "0.5"}:
            ends[text.strip()] = current[4] + matrix[4]

    page.extract_text(visitor_text=visit)
    # All digits are equally wide; "1.5" and "0.5" begin at the same place, the longest before.
    assert ends["1.5"] == pytest.approx(ends["0.5"], abs=0.01)
    assert ends["-1234.5"] < ends["1.5"] - 9.0


# The file


def attachments():
    return [
        Attachment("certificate.xml", b"<dcc/>\r\n\x00\xff", "application/xml", "The DCC", "data"),
        Attachment("result.json", b"{}", "application/json", "The result ü", "source"),
    ]


def test_attachments_come_back_byte_for_byte():
    found = reader(Paragraph("words"), attachments=attachments())
    assert {name: data[0] for name, data in found.attachments.items()} == {
        one.name: one.data for one in attachments()
    }
    embedded = found.trailer["/Root"]["/AF"]
    files = {file.get_object()["/UF"]: file.get_object() for file in embedded}
    assert files["certificate.xml"]["/AFRelationship"] == "/Data"
    assert files["result.json"]["/AFRelationship"] == "/Source"
    assert files["result.json"]["/Desc"] == "The result ü"
    stream = files["certificate.xml"]["/EF"]["/F"].get_object()
    assert stream["/Subtype"] == "/application/xml"


def test_two_attachments_of_one_name_are_refused():
    with pytest.raises(ValueError, match=r"certificate\.xml, certificate\.xml"):
        made(attachments=attachments()[:1] * 2)


@pytest.mark.parametrize("attached", [(), attachments()], ids=["alone", "with attachments"])
def test_file_says_what_it_is(attached):
    found = reader(Paragraph("words"), attachments=attached)
    xmp = found.xmp_metadata
    assert xmp.pdfaid_part == "3"
    assert xmp.pdfaid_conformance == "A"  # and so B too
    assert xmp.dc_title == {"x-default": "Campaign"}
    assert found.metadata.title == "Campaign"
    assert found.metadata.keywords == "CS-0123456789ab"
    assert found.metadata.creation_date == DATE.astimezone(UTC)
    # PDF/A wants every font in the file and the meaning of its colours.
    assert "/OutputIntents" in found.trailer["/Root"]


@pytest.mark.skipif(shutil.which("verapdf") is None, reason="veraPDF is not installed")
@pytest.mark.parametrize("flavour", ["3a", "ua1"])
def test_verapdf_finds_no_fault(tmp_path, flavour):
    """In a report with everything, and in a certificate."""
    table = Table((Column("term"), Column("u", "right")), (("K_II", "1"),))
    attached = [Attachment("a.xml", b"<a/>", "application/xml", "an attachment", "data")]
    own = tmp_path / "own.pdf"
    own.write_bytes(made(Heading("Part", 2), table, *PICTURES, attachments=attached))
    for path in (own, EXAMPLE):
        words = ["verapdf", "--flavour", flavour, "--format", "text", str(path)]
        told = subprocess.run(words, capture_output=True, text=True, check=False)
        assert told.returncode == 0, told.stdout
        assert told.stdout.startswith("PASS"), told.stdout


def test_chapters_are_in_the_outline():
    found = reader(Heading("Report", 1), Heading("Runs"), Paragraph("words"), Heading("Fit", 3))
    titles = []

    def walk(items):
        for item in items:
            walk(item) if isinstance(item, list) else titles.append(item.title)

    walk(found.outline)
    assert titles == ["Report", "Runs", "Fit"]


@pytest.mark.slow
def test_same_report_gives_the_same_bytes_in_any_process():
    blocks = (Heading("Report", 1), Paragraph("µg/g² × 10⁻⁵", "answer"), long_table(30), *PICTURES)
    first = made(*blocks, attachments=attachments())
    assert made(*blocks, attachments=attachments()) == first
    assert made(*blocks, attachments=attachments(), date=DATE.astimezone(UTC)) == first
    code = f"""
import sys
from datetime import datetime, timezone
from counterspin.reports.blocks import *
from counterspin.reports.pdf import *
data = pdf({list(blocks)!r}, title="Campaign", identifier="CS-0123456789ab",
    date=datetime(2026, 3, 1, 13, 30, tzinfo=timezone.utc), attachments={attachments()!r})
sys.stdout.buffer.write(data)
"""
    for seed in ("1", "2"):
        run = subprocess.run(
            [sys.executable, "-c", code],
            stdout=subprocess.PIPE,
            env={**os.environ, "PYTHONHASHSEED": seed, "TZ": "Asia/Tokyo"},
            check=True,
        )
        assert run.stdout == first
    assert made(*blocks, attachments=attachments(), date=DATE + timedelta(days=1)) != first

"""The PDF: its pages, and its conformance to PDF/A and PDF/UA."""

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
from counterspin.reports.pdf import Attachment, find_missing_glyphs, render_pdf

DATE = datetime(2026, 3, 1, 14, 30, tzinfo=timezone(timedelta(hours=1)))

#: A committed certificate, XML attached.
EXAMPLE = Path(__file__).parents[2] / "docs" / "examples" / "three-rate" / "certificate.pdf"

HOSTILE = r'#panic() #let x = [ $a^b$ ] \ *b* _c_ `d` <e> @f // g /* h */ "i" {j} ~ -- ... = \u{41}'

PICTURES = [
    Plot("Drift", "time / s", "drift", (PlotSeries("seen", (0.0, 1.0), (1.0, 2.0)),)),
    Bars("Budget", ("noise",), (1.0,), ("100 %",)),
    HeatMap("Correlation", ("a", "b"), ((1.0, 0.5), (0.5, 1.0))),
]


def make_pdf(*blocks, title="Campaign", identifier="CS-0123456789ab", date=DATE, attachments=()):
    return render_pdf(
        list(blocks), title=title, identifier=identifier, date=date, attachments=attachments
    )


def read_pdf(*blocks, **settings):
    return pypdf.PdfReader(io.BytesIO(make_pdf(*blocks, **settings)), strict=True)


def page_text(page):
    """Return the text of a page in one line without soft hyphens."""
    return " ".join(page.extract_text().replace("\u200b", "").split())


def page_pixels(monkeypatch, *blocks):
    """Return each rendered page, shape (height, width); 1 is white."""
    pages = []

    def compile_with_settings(files, **settings):
        drawn = compile_(files, ignore_system_fonts=True, format="png", ppi=72.0)
        for page in drawn if isinstance(drawn, list) else [drawn]:
            pages.append(imread(io.BytesIO(page))[..., :3].min(axis=-1))
        return compile_(files, **settings)

    compile_ = typst.compile
    with monkeypatch.context() as patch:
        patch.setattr(typst, "compile", compile_with_settings)
        make_pdf(*blocks)
    return pages


# Pages


def test_pages_have_title_identifier_and_number():
    pdf = read_pdf(*(Paragraph(f"Paragraph {i}. " + "Words " * 60) for i in range(40)))
    count = len(pdf.pages)
    assert count > 2
    for number, page in enumerate(pdf.pages, 1):
        text = page_text(page)
        assert "Campaign" in text
        assert "CS-0123456789ab" in text
        assert f"Page {number} of {count}" in text
        assert "2026-03-01 13:30 UTC" in text
        assert ("End of CS-0123456789ab" in text) == (number == count)


def test_end_mark_is_not_alone_on_page():
    # The last page contains a part of the last block.
    for length in range(40, 60):
        pdf = read_pdf(*(Paragraph(f"line {i}") for i in range(length)))
        last = page_text(pdf.pages[-1])
        assert "line" in last
        assert "End of CS-0123456789ab" in last


def test_title_replaces_missing_heading():
    (page,) = read_pdf(Paragraph("words")).pages
    assert page_text(page).count("Campaign") == 2
    (page,) = read_pdf(Heading("Its own", 1), title="Campaign").pages
    assert page_text(page).count("Campaign") == 1


def test_text_is_not_interpreted_as_markup():
    pdf = read_pdf(
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
    text = " ".join(page_text(page) for page in pdf.pages)
    heads = ("2", "answer", "warning", "plain", "quiet", "$", "title", "cell", "bars")
    for head in heads:
        assert f"{head} {HOSTILE}" in text
    assert "#a $b$" in text
    assert pdf.metadata.title == HOSTILE


def test_equations_have_subscripts():
    (page,) = read_pdf(Paragraph("Q: a_ind = K_F + K_II a² − ω ∬ f", "equation")).pages
    text = page_text(page)
    assert "_" not in text.split("Q: ")[1]
    for symbol in ("ω", "∬", "²", "−"):
        assert symbol in text


def test_plots_contain_text_and_alternative_text():
    data = make_pdf(*PICTURES)
    PdfReader = pypdf.PdfReader(io.BytesIO(data))
    text = " ".join(page_text(page) for page in PdfReader.pages)
    for actual_text in ("Drift", "time / s", "seen", "Budget", "100 %", "Correlation", "0.50"):
        assert actual_text in text
    alternatives = {
        thing.get_object()["/Alt"]
        for thing in (PdfReader.get_object(i) for i in range(1, len(PdfReader.xref[0]) + 1))
        if isinstance(thing, pypdf.generic.DictionaryObject) and "/Alt" in thing
    }
    assert alternatives == {"Drift", "Budget", "Correlation"}


def test_content_stays_within_margins(monkeypatch):
    long = "x" * 300
    for style in ("plain", "answer", "warning", "quiet", "command"):
        for page in page_pixels(monkeypatch, Paragraph(f"{long} {HOSTILE * 3}", style), *PICTURES):
            assert page[:, -61:].min() == 1.0
    for page in page_pixels(monkeypatch, Heading(HOSTILE * 4, 1), Heading(long, 2)):
        assert page[:, -61:].min() == 1.0


def test_missing_glyphs_become_squares():
    odd = "\ue123\U000e0041"
    pdf = read_pdf(
        Paragraph(f"α Ж é {odd[0]} end"), Bars(f"b{odd[0]}", (f"label{odd[0]}",), (1.0,), ("1",))
    )
    text = page_text(pdf.pages[0])
    assert "α Ж é □ end" in text
    assert "label□" in text or "label\ufffd" in text


def test_control_characters_in_names_are_escaped():
    name = "Qx\x1b\u202e\nK_II = 1"
    shown = r"Qx\x1b\u202e\nK_II = 1"
    blocks = [Paragraph(name), Table((Column(name),), ((name,),))]
    pdf = read_pdf(*blocks, title=name, identifier=name)
    assert pdf.metadata.title == shown
    text = pdf.pages[0].extract_text()
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
        quiet_rows=frozenset({1}),
    )


def test_long_table_repeats_header():
    pdf = read_pdf(long_table(150))
    assert len(pdf.pages) > 2
    text = [page_text(page) for page in pdf.pages]
    assert all("Name of the run c0 c1 c2 c3" in page for page in text)
    for row in range(150):
        assert sum(f"run{row} {row}.000417 {row}.100417" in page for page in text) == 1


def test_long_table_starts_with_at_least_three_rows():
    counts = []
    for lines in range(34, 48):
        pdf = read_pdf(*(Paragraph("x") for _ in range(lines)), long_table(20))
        first = next(text for page in pdf.pages if "run0 " in (text := page_text(page)))
        counts.append(sum(f"run{row} {row}." in first for row in range(20)))
    # For all positions of the table on the page, which differ in these cases.
    assert min(counts) >= 3
    assert len(set(counts)) > 3


def test_symbols_have_subscripts():
    text = page_text(
        read_pdf(Paragraph("K_II of a_run"), Table((Column("K_F"),), (("K_I",),))).pages[0]
    )
    assert "KII of a_run" in text
    assert "KF KI" in text


def test_short_table_is_not_split():
    for lines in range(30, 48, 3):
        pdf = read_pdf(*(Paragraph("x") for _ in range(lines)), long_table(10))
        on = [page_text(page) for page in pdf.pages if "run0 " in page_text(page)]
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
def test_wide_table_fits_page(table, monkeypatch):
    margin = 61  # 22 mm are 62.4 points; a glyph may extend by a fraction of a point
    for page in page_pixels(monkeypatch, table):
        assert page[:, :-margin].min() < 0.5
        assert page[:, -margin:].min() == 1.0
        assert page[:, : margin - 1].min() == 1.0
    pdf = read_pdf(table)
    text = "".join("".join(page.extract_text().split()) for page in pdf.pages)
    text = text.replace("\u200b", "")
    if len(table.rows) == 20:
        text = "".join("".join(page_text(page).split()) for page in pdf.pages)
        for row in table.rows:
            assert "".join(row) in text
    letters = sum(len("".join(cell.split())) for row in table.rows for cell in row)
    assert len(text) > letters


def test_numbers_are_right_aligned():
    table = Table((Column("value", "right"),), (("1.5",), ("-1234.5",), ("0.5",)))
    (page,) = read_pdf(table).pages
    ends = {}

    def visit(text, current, matrix, font, size):
        if text.strip() in {"1.5", "-1234.5", "0.5"}:
            ends[text.strip()] = current[4] + matrix[4]

    page.extract_text(visitor_text=visit)
    # All digits have equal width; "1.5" and "0.5" start at the same x, the longest before.
    assert ends["1.5"] == pytest.approx(ends["0.5"], abs=0.01)
    assert ends["-1234.5"] < ends["1.5"] - 9.0


# The file


def make_attachments():
    return [
        Attachment("certificate.xml", b"<dcc/>\r\n\x00\xff", "application/xml", "The DCC", "data"),
        Attachment("result.json", b"{}", "application/json", "The result ü", "source"),
    ]


def test_attachments_are_identical():
    pdf = read_pdf(Paragraph("words"), attachments=make_attachments())
    assert {name: data[0] for name, data in pdf.attachments.items()} == {
        attachment.name: attachment.data for attachment in make_attachments()
    }
    embedded = pdf.trailer["/Root"]["/AF"]
    files = {file.get_object()["/UF"]: file.get_object() for file in embedded}
    assert files["certificate.xml"]["/AFRelationship"] == "/Data"
    assert files["result.json"]["/AFRelationship"] == "/Source"
    assert files["result.json"]["/Desc"] == "The result ü"
    stream = files["certificate.xml"]["/EF"]["/F"].get_object()
    assert stream["/Subtype"] == "/application/xml"


def test_rejects_duplicate_attachment_name():
    with pytest.raises(ValueError, match=r"certificate\.xml, certificate\.xml"):
        make_pdf(attachments=make_attachments()[:1] * 2)


@pytest.mark.parametrize("attached", [(), make_attachments()], ids=["alone", "with attachments"])
def test_file_declares_pdf_a_metadata(attached):
    pdf = read_pdf(Paragraph("words"), attachments=attached)
    xmp = pdf.xmp_metadata
    assert xmp.pdfaid_part == "3"
    assert xmp.pdfaid_conformance == "A"  # and so B too
    assert xmp.dc_title == {"x-default": "Campaign"}
    assert pdf.metadata.title == "Campaign"
    assert pdf.metadata.keywords == "CS-0123456789ab"
    assert pdf.metadata.creation_date == DATE.astimezone(UTC)
    # PDF/A requires embedded fonts and an output intent.
    assert "/OutputIntents" in pdf.trailer["/Root"]


@pytest.mark.skipif(shutil.which("verapdf") is None, reason="veraPDF is not installed")
@pytest.mark.parametrize("flavour", ["3a", "ua1"])
def test_verapdf_reports_no_error(tmp_path, flavour):
    """A report with all kinds of blocks, and a certificate."""
    table = Table((Column("term"), Column("u", "right")), (("K_II", "1"),))
    attached = [Attachment("a.xml", b"<a/>", "application/xml", "an attachment", "data")]
    own = tmp_path / "own.pdf"
    own.write_bytes(make_pdf(Heading("Part", 2), table, *PICTURES, attachments=attached))
    for path in (own, EXAMPLE):
        words = ["verapdf", "--flavour", flavour, "--format", "text", str(path)]
        process = subprocess.run(words, capture_output=True, text=True, check=False)
        assert process.returncode == 0, process.stdout
        assert process.stdout.startswith("PASS"), process.stdout


def test_outline_contains_chapters():
    pdf = read_pdf(Heading("Report", 1), Heading("Runs"), Paragraph("words"), Heading("Fit", 3))
    titles = []

    def collect_titles(items):
        for item in items:
            collect_titles(item) if isinstance(item, list) else titles.append(item.title)

    collect_titles(pdf.outline)
    assert titles == ["Report", "Runs", "Fit"]


@pytest.mark.slow
def test_pdf_is_reproducible_across_processes():
    blocks = (Heading("Report", 1), Paragraph("µg/g² × 10⁻⁵", "answer"), long_table(30), *PICTURES)
    first = make_pdf(*blocks, attachments=make_attachments())
    assert make_pdf(*blocks, attachments=make_attachments()) == first
    assert make_pdf(*blocks, attachments=make_attachments(), date=DATE.astimezone(UTC)) == first
    code = f"""
import sys
from datetime import datetime, timezone
from counterspin.reports.blocks import *
from counterspin.reports.pdf import *
data = render_pdf({list(blocks)!r}, title="Campaign", identifier="CS-0123456789ab",
    date=datetime(2026, 3, 1, 13, 30, tzinfo=timezone.utc), attachments={make_attachments()!r})
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
    assert make_pdf(*blocks, attachments=make_attachments(), date=DATE + timedelta(days=1)) != first


def test_missing_glyphs_are_listed_once(monkeypatch):
    assert find_missing_glyphs("Iván Иван Ελ") == ""
    monkeypatch.setattr("counterspin.reports.pdf._has_glyph", lambda text, **_: "王" not in text)
    assert find_missing_glyphs("a王b小王") == "王"
    assert find_missing_glyphs("a小") == ""

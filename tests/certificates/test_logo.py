"""The laboratory's logo: accepted and rejected files."""

import struct
import zlib

import pytest
from raising import raises
from results import make_qx_result

from certificates import LAB, write_lab
from counterspin.certificates.issuing import certificate, draft_pages
from counterspin.certificates.logo import MAX_LOGO_BYTES, read_logo
from counterspin.toml_text import parse_toml

HEAD = '<svg xmlns="http://www.w3.org/2000/svg" xmlns:x="http://www.w3.org/1999/xlink" width="9" '
SVG = f'{HEAD}height="3"><path d="M0 0h9v3z" fill="#1a7048"/></svg>'


def make_png(width=9, height=3):
    """Return a grey PNG image."""

    def make_chunk(kind, data):
        checksum = struct.pack(">I", zlib.crc32(kind + data))
        return struct.pack(">I", len(data)) + kind + data + checksum

    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    rows = zlib.compress((b"\0" + b"\x80" * width) * height)
    return (
        b"\x89PNG\r\n\x1a\n"
        + make_chunk(b"IHDR", head)
        + make_chunk(b"IDAT", rows)
        + make_chunk(b"IEND", b"")
    )


def svg_with(content):
    return f'{HEAD}height="3">{content}</svg>'.encode()


@pytest.mark.parametrize(
    "data", [SVG.encode(), make_png(), svg_with("<style>a{fill:url(#g)}</style>")]
)
def test_png_and_svg_are_read_unchanged(tmp_path, data):
    (tmp_path / "logo").write_bytes(data)
    assert read_logo(tmp_path, "logo") == data


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (svg_with("<script>alert(1)</script>"), "an element <script>"),
        (svg_with('<image href="data:,x"/>'), "an element <image>"),
        (svg_with('<use href="#a"/>'), "an element <use>"),
        (
            svg_with('<a x:href="https://example.org"><path d="M0 0"/></a>'),
            "a link to another file",
        ),
        (svg_with('<path d="M0 0" onload="x()"/>'), "an attribute onload"),
        (svg_with('<path style="fill: url(https://example.org/x)"/>'), "a reference to another"),
        (svg_with("<style>@import 'x.css';</style>"), "a reference to another"),
        (b'<!DOCTYPE svg [<!ENTITY a "aa">]>' + SVG.encode(), "a document type"),
        (b"<html/>", "neither a PNG nor an SVG"),
        (b"GIF89a", "neither a PNG nor an SVG"),
        (make_png()[:40], "is damaged"),
        (b"<" + b" " * MAX_LOGO_BYTES, f"more than {MAX_LOGO_BYTES} bytes|File too large"),
    ],
)
def test_rejects_other_file_types(tmp_path, data, words):
    (tmp_path / "logo").write_bytes(data)
    with pytest.raises(ValueError, match=words):
        read_logo(tmp_path, "logo")


@pytest.mark.parametrize("data", [SVG.encode(), make_png()])
def test_logo_is_on_first_page_only(tmp_path, data):
    (tmp_path / "logo").write_bytes(data)
    text = LAB.replace('code = "D-K-1"', 'logo = "logo"')
    pages_without_logo = draft_pages(make_qx_result(), parse_toml(LAB), tmp_path)
    pages = draft_pages(make_qx_result(), parse_toml(text), tmp_path)
    counts = [[page.count("<image") for page in images] for images in (pages_without_logo, pages)]
    assert [b - a for a, b in zip(*counts, strict=True)] == [1, *[0] * (len(pages) - 1)]
    issued = certificate(make_qx_result(), write_lab(tmp_path, text))
    assert issued.pdf().startswith(b"%PDF")


def test_missing_logo_names_key(tmp_path):
    path = write_lab(tmp_path, LAB.replace('code = "D-K-1"', 'logo = "nowhere.png"'))
    with raises("file-not-found", "laboratory.logo:", "nowhere.png:"):
        certificate(make_qx_result(), path)

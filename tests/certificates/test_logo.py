"""The laboratory's logo: which files are embedded, and which are refused."""

import struct
import zlib

import pytest
from raising import raises
from results import result

from certificates import LAB, write_lab
from counterspin.certificates.issuing import certificate, draft_pages
from counterspin.certificates.logo import MAX_BYTES, read_logo
from counterspin.toml_text import parse_toml

HEAD = '<svg xmlns="http://www.w3.org/2000/svg" xmlns:x="http://www.w3.org/1999/xlink" width="9" '
SVG = f'{HEAD}height="3"><path d="M0 0h9v3z" fill="#1a7048"/></svg>'


def png(width=9, height=3):
    """Return a grey PNG image."""

    def chunk(kind, data):
        checksum = struct.pack(">I", zlib.crc32(kind + data))
        return struct.pack(">I", len(data)) + kind + data + checksum

    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    rows = zlib.compress((b"\0" + b"\x80" * width) * height)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


def inside(content):
    return f'{HEAD}height="3">{content}</svg>'.encode()


@pytest.mark.parametrize("data", [SVG.encode(), png(), inside("<style>a{fill:url(#g)}</style>")])
def test_png_and_svg_are_read_as_they_are(tmp_path, data):
    (tmp_path / "logo").write_bytes(data)
    assert read_logo(tmp_path, "logo") == data


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (inside("<script>alert(1)</script>"), "an element <script>"),
        (inside('<image href="data:,x"/>'), "an element <image>"),
        (inside('<use href="#a"/>'), "an element <use>"),
        (inside('<a x:href="https://example.org"><path d="M0 0"/></a>'), "a link to another file"),
        (inside('<path d="M0 0" onload="x()"/>'), "an attribute onload"),
        (inside('<path style="fill: url(https://example.org/x)"/>'), "a reference to another"),
        (inside("<style>@import 'x.css';</style>"), "a reference to another"),
        (b'<!DOCTYPE svg [<!ENTITY a "aa">]>' + SVG.encode(), "a document type"),
        (b"<html/>", "neither a PNG nor an SVG"),
        (b"GIF89a", "neither a PNG nor an SVG"),
        (png()[:40], "is damaged"),
        (b"<" + b" " * MAX_BYTES, f"more than {MAX_BYTES} bytes|File too large"),
    ],
)
def test_other_files_are_refused_with_the_reason(tmp_path, data, words):
    (tmp_path / "logo").write_bytes(data)
    with pytest.raises(ValueError, match=words):
        read_logo(tmp_path, "logo")


@pytest.mark.parametrize("data", [SVG.encode(), png()])
def test_the_logo_is_on_the_first_page_only(tmp_path, data):
    (tmp_path / "logo").write_bytes(data)
    text = LAB.replace('code = "D-K-1"', 'logo = "logo"')
    plain = draft_pages(result(), parse_toml(LAB), tmp_path)
    pages = draft_pages(result(), parse_toml(text), tmp_path)
    counts = [[page.count("<image") for page in drawn] for drawn in (plain, pages)]
    assert [b - a for a, b in zip(*counts, strict=True)] == [1, *[0] * (len(pages) - 1)]
    made = certificate(result(), write_lab(tmp_path, text))
    assert made.pdf().startswith(b"%PDF")


def test_a_logo_that_is_missing_is_named_by_its_key(tmp_path):
    path = write_lab(tmp_path, LAB.replace('code = "D-K-1"', 'logo = "nowhere.png"'))
    with raises("file-not-found", "laboratory.logo:", "nowhere.png:"):
        certificate(result(), path)

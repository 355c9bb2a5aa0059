"""Reports as PDF/A-3a and PDF/UA-1, set by typst, with attached files.

Only the fonts included in typst are used, and no network, so the same blocks give the same file,
byte for byte. ``assets/report.typ`` is the layout; all text is passed as data and is never
interpreted as markup.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from importlib import resources
from itertools import groupby
from typing import Any, Final, Literal

from counterspin.characters import escape_controls
from counterspin.frozen import frozen
from counterspin.output import file_mark
from counterspin.reports.blocks import (
    VALUE_STYLES,
    Block,
    Heading,
    Paragraph,
    Picture,
    Table,
    expand_cards,
)
from counterspin.reports.charts import render_svg

#: PDF/A with attachments, with fixed appearance (level b, included in a), and with tags for screen
#: readers (PDF/UA).
_PDF_STANDARDS: Final = ["a-3a", "ua-1"]

#: Replacement of a character without a glyph in any font.
_REPLACEMENT_CHARACTER: Final = "\N{WHITE SQUARE}"

#: Last character of Latin Extended-B.
_LAST_LATIN_CHARACTER: Final = "\u024f"

#: Parts of typst's messages on a character without a glyph, and on a private-use character.
_MISSING_GLYPH_MESSAGES: Final = ("could not be displayed", "contains the codepoint")


@frozen
class Attachment:
    """A file attached to a PDF."""

    name: str  #: File name.
    data: bytes  #: Content of the file.
    media_type: str  #: MIME type, such as ``application/xml``.
    description: str  #: Description in the list of attachments.
    #: Relationship to the document (AFRelationship, ISO 32000-2, 7.11.3): its source, its data, an
    #: alternative form, or a supplement.
    relationship: Literal["source", "data", "alternative", "supplement"]


@frozen
class PageMarks:
    """Marks on the pages of a document, besides its blocks."""

    watermark: str = ""  #: Printed across every page; empty: none.
    logo: bytes | None = None  #: At the top of the first page: PNG, or SVG that loads nothing.


#: Pages without marks.
_NO_MARKS: Final = PageMarks()


def render_pdf(
    blocks: Sequence[Block],
    *,
    title: str,
    identifier: str,
    date: datetime,
    document_type: str = "a page",
    attachments: Sequence[Attachment] = (),
    marks: PageMarks = _NO_MARKS,
) -> bytes:
    """Set blocks as a PDF/A-3a (ISO 19005-3) and PDF/UA-1 (ISO 14289-1).

    Every page shows the title, the identifier, its number and the number of pages; the last page
    marks the end (ISO/IEC 17025:2017, 7.8.2.1). A character missing in typst's fonts (Latin, Greek,
    Cyrillic and Hebrew) is taken from the machine's fonts; a square replaces it if these lack it.

    title: Title on every page; also the heading, if the blocks have none of level 1.
    """
    names = [attachment.name for attachment in attachments]
    if len(set(names)) < len(names):
        raise ValueError(f"each attachment must have a unique name; got {', '.join(names)}")
    utc_date = date.astimezone(UTC).replace(microsecond=0)
    layout_data = _make_layout_data(blocks, title, identifier, utc_date, marks)
    layout_data |= {
        "mark": file_mark(document_type),
        "attachments": [
            {
                "name": attachment.name,
                "media_type": attachment.media_type,
                "description": attachment.description,
                "relationship": attachment.relationship,
            }
            for attachment in attachments
        ],
    }
    # The compiler accepts text only, so bytes are passed as a list of numbers.
    files = {
        f"attachment-{index}.json": _encode_bytes(attachment.data)
        for index, attachment in enumerate(attachments)
    }
    return _compile_pdf(layout_data, files | _logo_files(marks.logo), utc_date)


def render_page_images(
    blocks: Sequence[Block],
    *,
    title: str,
    identifier: str,
    date: datetime,
    marks: PageMarks = _NO_MARKS,
) -> list[str]:
    """Return the pages of `render_pdf` as SVG images; parameters as there."""
    utc_date = date.astimezone(UTC).replace(microsecond=0)
    layout_data = _make_layout_data(blocks, title, identifier, utc_date, marks)
    files = _layout_files(layout_data) | _logo_files(marks.logo)
    pages = _run_typst(files, utc_date, only_typst_fonts=True, output_format="svg")
    return [page.decode() for page in (pages if isinstance(pages, list) else [pages])]


def is_image(content: bytes) -> bool:
    """Return whether data are a PNG or SVG image that can be set on a page."""
    from typst import TypstError

    page = '#set document(title: "x")\n#image(bytes(json("logo.json")), alt: "x")'
    files = {"main.typ": page.encode()} | _logo_files(content)
    try:
        _run_typst(files, datetime(2000, 1, 1, tzinfo=UTC), only_typst_fonts=True)
    except TypstError:
        return False
    return True


def _logo_files(logo: bytes | None) -> dict[str, bytes]:
    return {} if logo is None else {"logo.json": _encode_bytes(logo)}


def _encode_bytes(content: bytes) -> bytes:
    return json.dumps(list(content), separators=(",", ":")).encode()


def _make_layout_data(
    blocks: Sequence[Block], title: str, identifier: str, utc_date: datetime, marks: PageMarks
) -> dict[str, Any]:
    """Return the data of the layout, without attachments."""
    title, identifier = escape_controls(title), escape_controls(identifier)
    blocks = list(expand_cards(blocks))
    if not any(isinstance(block, Heading) and block.level == 1 for block in blocks):
        blocks = [Heading(title, 1), *blocks]
    return {
        "title": title,
        "identifier": identifier,
        "watermark": marks.watermark,
        "has_logo": marks.logo is not None,
        "mark": "",
        "moment": utc_date.timetuple()[:6],
        "day": f"{utc_date:%Y-%m-%d %H:%M} UTC",
        "blocks": list(_layout_items(blocks)),
        "pictures": [render_svg(block) for block in blocks if isinstance(block, Picture)],
        "attachments": [],
    }


def _layout_items(blocks: Sequence[Block]) -> Iterator[dict[str, Any]]:
    """Yield the items of the layout: a block, or consecutive answers."""
    picture_index = 0
    for style, group in groupby(blocks, _answer_style):
        if style is not None:
            texts = [block.text for block in group if isinstance(block, Paragraph)]
            yield {"kind": "answers", "texts": texts, "reserved": style == "reserved"}
            continue
        for block in group:
            match block:
                case Heading(text, level):
                    yield {"kind": "heading", "text": text, "level": level}
                case Paragraph(text, style):
                    yield {"kind": style, "text": text}
                case Table():
                    yield _table_item(block)
                case _:
                    yield {"kind": "picture", "title": block.title, "number": picture_index}
                    picture_index += 1


def _answer_style(block: Block) -> str | None:
    """Return the style of an answer."""
    return block.style if isinstance(block, Paragraph) and block.style in VALUE_STYLES else None


def _table_item(block: Table) -> dict[str, Any]:
    return {
        "kind": "table",
        "columns": [
            {"title": column.title, "align": column.align, "wraps": column.wraps}
            for column in block.columns
        ],
        "rows": block.rows,
        "quiet": sorted(block.quiet_rows),
    }


# typst


def _compile_pdf(layout_data: dict[str, Any], files: dict[str, bytes], utc_date: datetime) -> bytes:
    from typst import TypstError

    def compile_layout(data: Any, *, only_typst_fonts: bool = True) -> bytes:
        pages = _run_typst(_layout_files(data) | files, utc_date, only_typst_fonts=only_typst_fonts)
        assert isinstance(pages, bytes)
        return pages

    try:
        return compile_layout(layout_data)
    except TypstError as error:
        # PDF/A requires a glyph for each character (ISO 19005-3, 6.2.11.8).
        if not any(message in error.message for message in _MISSING_GLYPH_MESSAGES):
            raise
    characters = sorted({character for text in _iterate_texts(layout_data) for character in text})
    missing_typst_glyphs = [
        character for character in characters if not _has_glyph(character, only_typst_fonts=True)
    ]
    missing_glyphs = [
        character
        for character in missing_typst_glyphs
        if not _has_glyph(character, only_typst_fonts=False)
    ]
    replacements = str.maketrans(dict.fromkeys(missing_glyphs, _REPLACEMENT_CHARACTER))
    return compile_layout(
        _translate_texts(layout_data, replacements),
        only_typst_fonts=missing_glyphs == missing_typst_glyphs,
    )


def _layout_files(layout_data: dict[str, Any]) -> dict[str, bytes]:
    layout = (resources.files("counterspin.reports") / "assets" / "report.typ").read_bytes()
    return {"main.typ": layout, "data.json": json.dumps(layout_data, ensure_ascii=False).encode()}


def _run_typst(
    files: dict[str, bytes],
    utc_date: datetime,
    *,
    only_typst_fonts: bool,
    output_format: Literal["pdf", "svg"] = "pdf",
) -> bytes | list[bytes]:
    """Return a PDF, or the pages as SVG: a list if there are several."""
    import typst

    document: bytes | list[bytes] = typst.compile(  # type: ignore[call-overload]
        files,
        ignore_system_fonts=only_typst_fonts,
        format=output_format,
        pdf_standards=_PDF_STANDARDS if output_format == "pdf" else None,
        timestamp=utc_date,
    )
    return document


def find_missing_glyphs(text: str) -> str:
    """Return the characters that `render_pdf` replaces with a square, each once."""
    # The fonts of typst contain Latin characters.
    characters = sorted({character for character in text if character > _LAST_LATIN_CHARACTER})
    if not characters or _has_glyph("".join(characters), only_typst_fonts=False):
        return ""
    return "".join(
        character for character in characters if not _has_glyph(character, only_typst_fonts=False)
    )


def _has_glyph(text: str, *, only_typst_fonts: bool) -> bool:
    """Return whether the fonts have a glyph for each character of a text."""
    from typst import TypstError

    # PDF/UA requires a title.
    page = '#set document(title: "x")\n#set text(font: "Libertinus Serif")\n' + "".join(
        f'#"\\u{{{ord(character):x}}}"\n' for character in text
    )
    try:
        _run_typst(
            {"main.typ": page.encode()},
            datetime(2000, 1, 1, tzinfo=UTC),
            only_typst_fonts=only_typst_fonts,
        )
    except TypstError:
        return False
    return True


def _iterate_texts(document: Any) -> Iterator[str]:
    match document:
        case str():
            yield document
        case dict():
            yield from _iterate_texts(list(document.values()))
        case list() | tuple():
            for item in document:
                yield from _iterate_texts(item)


def _translate_texts(document: Any, translations: dict[int, str]) -> Any:
    match document:
        case str():
            return document.translate(translations)
        case dict():
            return {key: _translate_texts(value, translations) for key, value in document.items()}
        case list() | tuple():
            return [_translate_texts(item, translations) for item in document]
    return document

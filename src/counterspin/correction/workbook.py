"""Workbooks (.xlsx, ISO/IEC 29500) with text and numbers."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Mapping, Sequence
from typing import Final
from xml.sax.saxutils import escape, quoteattr

Cell = str | float | None

_MAIN_NS: Final = "http://schemas.openxmlformats.org/spreadsheetml/2006/main"
_RELATIONS_NS: Final = "http://schemas.openxmlformats.org/officeDocument/2006/relationships"
_PACKAGE_NS: Final = "http://schemas.openxmlformats.org/package/2006"
_MIME_TYPE: Final = "application/vnd.openxmlformats-officedocument.spreadsheetml"

#: Date of the files in the archive, so that equal tables give equal files.
_ARCHIVE_DATE: Final = (1980, 1, 1, 0, 0, 0)


def make_workbook(sheets: Mapping[str, Sequence[Sequence[Cell]]], remark: str) -> bytes:
    """Return a workbook.

    sheets: Rows of cells by name of the sheet.
    remark: Comment of the archive.
    """
    sheet_numbers = range(1, len(sheets) + 1)
    overrides_xml = "".join(
        f'<Override PartName="/xl/worksheets/sheet{n}.xml" '
        f'ContentType="{_MIME_TYPE}.worksheet+xml"/>'
        for n in sheet_numbers
    )
    sheets_xml = "".join(
        f'<sheet name={quoteattr(name)} sheetId="{n}" r:id="r{n}"/>'
        for n, name in zip(sheet_numbers, sheets, strict=True)
    )
    xml_by_path = {
        "[Content_Types].xml": f'<Types xmlns="{_PACKAGE_NS}/content-types">'
        '<Default Extension="rels" '
        'ContentType="application/vnd.openxmlformats-package.relationships+xml"/>'
        f'<Override PartName="/xl/workbook.xml" ContentType="{_MIME_TYPE}.sheet.main+xml"/>'
        f"{overrides_xml}</Types>",
        "_rels/.rels": _relationships_xml({"r1": ("officeDocument", "xl/workbook.xml")}),
        "xl/workbook.xml": f'<workbook xmlns="{_MAIN_NS}" xmlns:r="{_RELATIONS_NS}">'
        f"<sheets>{sheets_xml}</sheets></workbook>",
        "xl/_rels/workbook.xml.rels": _relationships_xml(
            {f"r{n}": ("worksheet", f"worksheets/sheet{n}.xml") for n in sheet_numbers}
        ),
    }
    for n, rows in zip(sheet_numbers, sheets.values(), strict=True):
        rows_xml = "".join(f"<row>{''.join(map(_cell_xml, row))}</row>" for row in rows)
        xml_by_path[f"xl/worksheets/sheet{n}.xml"] = (
            f'<worksheet xmlns="{_MAIN_NS}"><sheetData>{rows_xml}</sheetData></worksheet>'
        )
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in xml_by_path.items():
            document = f'<?xml version="1.0" encoding="UTF-8" standalone="yes"?>\n{text}'
            archive.writestr(zipfile.ZipInfo(name, _ARCHIVE_DATE), document)
        archive.comment = remark.encode()
    return stream.getvalue()


def _relationships_xml(targets: Mapping[str, tuple[str, str]]) -> str:
    elements_xml = "".join(
        f'<Relationship Id="{key}" Type="{_RELATIONS_NS}/{relation_type}" Target="{target}"/>'
        for key, (relation_type, target) in targets.items()
    )
    return f'<Relationships xmlns="{_PACKAGE_NS}/relationships">{elements_xml}</Relationships>'


def _cell_xml(value: Cell) -> str:
    if value is None:
        return "<c/>"
    if isinstance(value, str):
        return f'<c t="inlineStr"><is><t xml:space="preserve">{escape(value)}</t></is></c>'
    return f"<c><v>{float(value)!r}</v></c>"

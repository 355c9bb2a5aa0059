"""Workbooks in the format of Excel, reduced to the parts that the reader uses."""

import zipfile
from xml.sax.saxutils import escape

_MAIN = "http://schemas.openxmlformats.org/spreadsheetml/2006/main"
_OFFICE = "http://schemas.openxmlformats.org/officeDocument/2006/relationships"
_PACKAGE = "http://schemas.openxmlformats.org/package/2006"
_TYPES = (
    f'<Types xmlns="{_PACKAGE}/content-types"><Default Extension="rels" '
    'ContentType="application/vnd.openxmlformats-package.relationships+xml"/>'
    '<Default Extension="xml" ContentType="application/xml"/></Types>'
)


def write_workbook(path, sheets, renamed_cells=()):
    """Write sheets, name -> rows of text, numbers or None.

    renamed_cells: New cell names by old cell names.
    """
    numbered_sheets = list(enumerate(sheets.items(), 1))
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("[Content_Types].xml", _TYPES)
        file.writestr("_rels/.rels", _relations([("officeDocument", "xl/workbook.xml")]))
        sheet_elements = "".join(
            f'<sheet name="{escape(name)}" sheetId="{i}" r:id="r{i}"/>'
            for i, (name, _) in numbered_sheets
        )
        file.writestr(
            "xl/workbook.xml",
            f'<workbook xmlns="{_MAIN}" xmlns:r="{_OFFICE}"><sheets>{sheet_elements}</sheets>'
            "</workbook>",
        )
        relations = [("worksheet", f"worksheets/sheet{i}.xml") for i, _ in numbered_sheets]
        file.writestr("xl/_rels/workbook.xml.rels", _relations(relations))
        for i, (_, rows) in numbered_sheets:
            body = "".join(_row(k, row) for k, row in enumerate(rows, 1))
            for cell in renamed_cells:
                body = body.replace(f'"{cell}"', f'"{renamed_cells[cell]}"')
            text = f'<worksheet xmlns="{_MAIN}"><sheetData>{body}</sheetData></worksheet>'
            file.writestr(f"xl/worksheets/sheet{i}.xml", text)
    return path


def _relations(parts):
    lines = "".join(
        f'<Relationship Id="r{i}" Type="{_OFFICE}/{kind}" Target="{target}"/>'
        for i, (kind, target) in enumerate(parts, 1)
    )
    return f'<Relationships xmlns="{_PACKAGE}/relationships">{lines}</Relationships>'


def _row(number, row):
    cells = ""
    for column, cell in enumerate(row):
        name = f"{chr(65 + column)}{number}"
        if isinstance(cell, str):
            cells += f'<c r="{name}" t="inlineStr"><is><t>{escape(cell)}</t></is></c>'
        elif cell is not None:
            cells += f'<c r="{name}"><v>{cell!r}</v></c>'
    return f'<row r="{number}">{cells}</row>'

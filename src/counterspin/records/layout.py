"""Detection of the layout of a text table from its first lines.

LabVIEW and other recorders write lines about the measurement above the names, a row of units below
them, semicolons or tabs between cells, and decimal commas. Of all ways to split the rows, the one
with the most numbers is used.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import pairwise, zip_longest
from typing import Final

from counterspin.frozen import frozen
from counterspin.records.dialect import Dialect
from counterspin.records.unit_notation import bracketed_unit, parse_file_unit

#: Delimiters of one character, the most common first.
SINGLE_DELIMITERS: Final = (",", ";", "\t", "|")
#: Any number of blanks as one delimiter.
BLANKS: Final = " "
#: Possible delimiters, the most common first.
DELIMITERS: Final = (*SINGLE_DELIMITERS, BLANKS)
#: Number of first lines in which the rows must begin.
HEAD_LINES: Final = 400
#: Rows that show whether a file is plain, and smallest number of rows of a table.
_PLAIN_ROWS, _MIN_ROWS = 20, 3
#: Empty cells, in lower case without surrounding blanks, including failed measurements.
EMPTY_CELL_TEXTS: Final = (
    *("", "nan", "n/a", "#n/a", "na", "null", "none", "-", "--", "---"),
    *("ovld", "ovl", "overload", "overflow", "over", "#value!", "#div/0!", "#num!"),
    *("*" * width for width in range(3, 25)),  # a number too long for a field of Fortran
    *(sign + text for sign in ("", "-") for text in ("1.#qnan", "1.#ind", "1.#inf", "nan(ind)")),
)
#: Time of day with an optional date and zone, in ISO 8601 or in notations of spreadsheets and
#: recorders; minutes and seconds; or a duration of MATLAB.
TIMESTAMP: Final = re.compile(
    r"(?:\d{4}[-/]\d\d?[-/]\d\d?[T ]|\d\d?[./]\d\d?[./]\d{4} "
    r"|(?:[A-Z][a-z]{2},? )?\d\d?[- ][A-Z][a-z]{2}[a-z]*[- ]\d{4} |[A-Z][a-z]{2,} \d\d?,? \d{4} )?"
    r"\d\d?:\d\d:\d\d(?:[.,:]\d+)?(?: ?[AaPp][Mm]|Z| ?UTC| ?GMT|[+-]\d\d:?\d\d)?"
    r"|\d{1,3}:\d\d[.,]\d+|\d+(?:[.,]\d+)?(?:[eE][-+]?\d+)? ?(?:[mu]?s|[mu]?secs?|min|hr)"
    r"|(?:[A-Z][a-z]{2} )?[A-Z][a-z]{2}  ?\d\d? \d\d:\d\d:\d\d(?:\.\d+)? \d{4}"
    r"|\d{8}[T ]\d{6}(?:[.,]\d+)?Z?"
)
#: First cells of header lines with column names and with units.
_NAME_KEYS: Final = ("tracename", "trace name", "channel name", "tag")
_UNIT_KEYS: Final = ("vunit", "unit")
#: Cells of a units row for columns without a unit.
_NO_UNITS: Final = (
    *("", "-", "(-)", "[-]", "(na)", "[na]", "na", "n/a", "(n/a)", "()", "[]"),
    *("no.", "no", "nr", "nr.", "number", "time", "date", "date&time"),
    *("ts", "rn"),  # of time stamp and record number in TOA5 files
)
#: Largest number of lines between units and rows.
_MAX_LINES_BELOW_UNITS: Final = 4
_NUMBER_PATTERNS: Final = {
    mark: re.compile(
        rf"[+-]?(?:\d+(?:{re.escape(mark)}\d*)?|{re.escape(mark)}\d+)(?:[eE][+-]?\d+)?"
    )
    for mark in (".", ",")
}
#: A cell between blanks, perhaps quoted; a unit in brackets may follow its name after one blank.
_BETWEEN_BLANKS: Final = re.compile(
    r'"[^"]*"|[\[(][^\[\]()\s]+[\])](?=\s|$)|\S+(?: ?[\[(][^\[\]()\s]+[\])])?'
)
#: Separator of names that contain single blanks.
_WIDE_BLANKS: Final = re.compile(r"\s{2,}|\t")
#: Comment mark at the beginning of a line, with blanks or a label.
_COMMENT_MARK: Final = re.compile(
    r"^\s*(?:#+|%+|//+|!+|\*(?=[\sA-Za-z]))\s*(?:(?:col(?:umn)?s?|fields|names|header)\s*[:=]\s*)?",
    re.IGNORECASE,
)
#: Rule between names and rows.
_RULED_LINE: Final = re.compile(r"[\s|+]*(?:[-=_]{2,}[\s|+,;]*)+")
#: Number of comment lines above the rows that may contain the names.
_MAX_COMMENT_LINES: Final = 4
#: Largest number of lines of a quoted cell.
_MAX_QUOTED_LINES: Final = 30
#: Delimiter -> description.
_DELIMITER_TEXTS: Final = {
    ";": "semicolon-separated",
    "\t": "tab-separated",
    "|": "separated by vertical bars",
    BLANKS: "separated by spaces",
}
#: Separator between the name of several columns and their number.
DUPLICATE_MARK: Final = " #"


@frozen
class TableFormat:
    """Layout of a text table; lines count from 1."""

    header: int  #: Line of the names; 0 for numbered columns without names.
    before_rows: int  #: Lines before the first row of numbers.
    names: tuple[str, ...]  #: Names of the columns, without surrounding blanks.
    units: tuple[str, ...]  #: Normalised units of the columns; empty if not stated.
    units_row: bool  #: Whether the units are in a separate row.
    delimiter: str  #: Delimiter of cells.
    decimal: str  #: Decimal separator.
    mismatch: str = ""  #: Reason why a line of names is not used.

    def describe(self, encoding: str) -> str:
        """Describe the layout; empty for a plain file."""
        statements = []
        if not self.header:
            statements.append("unnamed columns")
        if self.mismatch:
            statements.append(self.mismatch)
        if self.header > 1:
            statements.append(f"names in line {self.header}")
        if self.units_row:
            statements.append("a units row")
        if self.delimiter in _DELIMITER_TEXTS:
            statements.append(_DELIMITER_TEXTS[self.delimiter])
        if self.decimal == ",":
            statements.append("decimal commas")
        if encoding != "utf-8":
            statements.append(encoding)
        return ", ".join(statements)


#: A line's number, from 1, and its text without the end of line.
Line = tuple[int, str]


def detect_format(lines: Sequence[Line], dialect: Dialect) -> TableFormat | None:
    """Return the detected layout of a file; None if no rows are found."""
    best_score: tuple[int, TableFormat] | None = None
    lines = [(number, line) for number, line in lines if not _RULED_LINE.fullmatch(line)]
    for delimiter in [dialect.delimiter] if dialect.delimiter else DELIMITERS:
        split_lines = [(number, _split_comment(line, delimiter)) for number, line in lines]
        if delimiter == BLANKS:
            split_lines = _join_spaced_names(split_lines, lines)
        for decimal in [dialect.decimal] if dialect.decimal else (".", ","):
            candidate = find_rows(split_lines, dialect, decimal, delimiter)
            if candidate is not None and (best_score is None or candidate[0] > best_score[0]):
                best_score = candidate
    return best_score and best_score[1]


def join_quoted_lines(lines: Sequence[Line]) -> list[Line]:
    """Join quoted cells that span several lines; a joined line has the number of its last line.

    Lines with a quotation mark that is not closed are returned as they are.
    """
    joined_lines: list[Line] = []
    text, count = "", 0
    for number, line in lines:
        text, count = (f"{text} {line}", count + 1) if count else (line, 1)
        if text.count('"') % 2 == 0:
            joined_lines.append((number, text))
            count = 0
        elif count > _MAX_QUOTED_LINES:
            return list(lines)
    return list(lines) if count else joined_lines


def _split_comment(line: str, delimiter: str) -> list[str]:
    """Return the cells of a line, the first with '#' before it if the line is a comment."""
    comment_mark = _COMMENT_MARK.match(line)
    if comment_mark is None:
        return split_cells(line, delimiter)
    first, *cells = split_cells(line[comment_mark.end() :], delimiter) or [""]
    return [f"#{first}", *cells]


def _normalise_comment(line: str) -> str:
    """Replace a comment mark, if there is one, by '#'."""
    return _COMMENT_MARK.sub("#", line, count=1) if _COMMENT_MARK.match(line) else line


def _join_spaced_names(
    split_lines: Sequence[tuple[int, list[str]]], lines: Sequence[Line]
) -> list[tuple[int, list[str]]]:
    """Split lines above the rows at wide blanks, if that gives one name per column.

    Names such as `Acc X` contain single blanks, and are separated by two or more.
    """
    widths = [len(cells) for _, cells in split_lines[-_PLAIN_ROWS:] if _has_numbers(cells, ".")]
    row_width = max(set(widths), key=widths.count, default=0)
    joined_rows = []
    for (number, cells), (_, line) in zip(split_lines, lines, strict=True):
        fields = [cell for cell in _WIDE_BLANKS.split(_normalise_comment(line).strip()) if cell]
        is_text = cells and not _has_numbers(cells, ".")
        joined_rows.append(
            (number, fields if is_text and len(fields) == row_width != len(cells) else cells)
        )
    return joined_rows


def is_plain_format(lines: Sequence[Line]) -> bool:
    """Return whether the first line contains names, and the others numbers with decimal points."""
    lines_with_text = [line for _, line in lines if line.strip() and not line.startswith("#")]
    if len(lines_with_text) < 2:
        return False
    delimiter = max(SINGLE_DELIMITERS, key=lines_with_text[0].count)
    names = split_cells(lines_with_text[0], delimiter)
    width = len(names)
    n_named = sum(bool(name) and name.lower() != "comment" for name in names)
    rows = [split_cells(line, delimiter) for line in lines_with_text[1 : 1 + _PLAIN_ROWS]]
    if _is_row(names, ".") or max(map(len, rows)) < n_named:
        return False
    return all(len(row) <= width and _is_row(row, ".") for row in rows)


def plain_format(lines: Sequence[Line], dialect: Dialect) -> TableFormat | None:
    """Return the layout with names in the first line; None without lines."""
    lines_with_text = [
        (number, line)
        for number, line in lines
        if line.strip() and not line.startswith("#") and number > (dialect.skip_lines or 0)
    ]
    if not lines_with_text:
        return None
    number, line = lines_with_text[0]
    # The delimiter is the most frequent one in the header.
    delimiter = dialect.delimiter or max(SINGLE_DELIMITERS, key=line.count)
    names = split_cells(_COMMENT_MARK.sub("", line, count=1), delimiter)
    # A blank line before the rows would stop the parser.
    body = (n for n, text in lines if n > number and text.strip())
    unit_cells: list[str] = []
    if dialect.units_row:
        units_line = next(body, number + 1)
        unit_cells = next(
            (split_cells(text, delimiter) for n, text in lines if n == units_line), []
        )
        if _is_row(unit_cells, dialect.decimal or "."):
            return plain_format(lines, replace(dialect, units_row=False))
    units = [
        parse_file_unit(cell) or "" for cell in [*unit_cells, *[""] * len(names)][: len(names)]
    ]
    units = [unit or bracketed_unit(name) for unit, name in zip(units, names, strict=True)]
    before_rows = next(body, lines[-1][0] + 1) - 1
    decimal = dialect.decimal or "."
    return TableFormat(
        number,
        before_rows,
        _number_duplicates(names),
        tuple(units),
        bool(dialect.units_row),
        delimiter,
        decimal,
    )


def _number_duplicates(names: Sequence[str]) -> tuple[str, ...]:
    """Append numbers to column names that occur more than once."""
    counts: dict[str, int] = {}
    numbered_names = []
    for name in names:
        counts[name] = counts.get(name, 0) + 1
        is_duplicate = name and names.count(name) > 1
        numbered_names.append(f"{name}{DUPLICATE_MARK}{counts[name]}" if is_duplicate else name)
    return tuple(numbered_names)


def find_rows(
    split_lines: Sequence[tuple[int, list[str]]],
    dialect: Dialect,
    decimal: str,
    delimiter: str = "",
) -> tuple[int, TableFormat] | None:
    """Return score (numbers minus texts) and layout of the longest run of rows; or None."""
    skipped_lines = dialect.skip_lines
    table = [(number, cells) for number, cells in split_lines if any(cells)]
    start, end = _find_longest_run(table, decimal, start_line=skipped_lines or 0)
    if end - start < min(_MIN_ROWS, max(1, len(table) - 2)):
        return None
    while start < end - 1 and table[start][1][0].startswith("#"):
        start += 1
    width = len(table[start][1])
    lines_above = [
        (number, cells)
        for number, cells in table[:start]
        if not cells[0].startswith("#") and number > (skipped_lines or 0)
    ]
    if skipped_lines is not None:
        lines_above = lines_above[:2]
    if any(len(cells) == width and _is_row(cells, decimal) for _, cells in lines_above):
        return None  # rows above the header show that it is not one
    rows = [cells for _, cells in table[start:end]]
    header_cells, mismatch = _header_in_comment(table[:start], width, decimal), ""
    header_cells = header_cells or _find_header(lines_above, dialect, width, decimal)
    if header_cells is not None:
        (header, names), unit_cells = header_cells
        if len(names) == width - 1 and _contains_row_names(rows, decimal, delimiter):
            names = ["column 1", *names]  # R writes no name above the row names
            unit_cells = ["", *unit_cells] if unit_cells else unit_cells
    is_unnamed = header_cells is not None and _has_unnamed_columns(names, rows, decimal)
    last_lines = lines_above or [(number, cells) for number, cells in table[:start][-1:]]
    if is_unnamed or (header_cells is None and _has_miscounted_names(last_lines, width, decimal)):
        number, cells = (header, names) if is_unnamed else last_lines[-1]
        if not _are_unnamed_rows(rows, decimal, delimiter):
            return None
        mismatch = (
            f"line {number} has {_count_noun(cells, 'name')} for {width} columns, so the columns "
        )
        mismatch += "are numbered"
        header, names, unit_cells = 0, [], []
    elif header_cells is not None:
        pass
    elif all(2 * len(cells) <= width for _, cells in lines_above[-1:]) and _are_unnamed_rows(
        rows, decimal, delimiter
    ):
        header, names, unit_cells = 0, [], []
    else:
        return None
    if delimiter == "," and any(
        is_number(cell, decimal) for row in rows for cell in row[len(names) :] if names
    ):
        return None  # commas are decimal: 1,25 is not two cells
    # A delimiter at the end of every row adds an unnamed empty cell.
    names += [
        f"column {index + 1}"
        if any(is_number(row[index], decimal) or TIMESTAMP.fullmatch(row[index]) for row in rows)
        else ""
        for index in range(len(names), width)
    ]
    padding = [""] * (len(names) - len(unit_cells))
    units = [parse_file_unit(cell) or "" for cell in [*unit_cells, *padding]]
    units = [unit or bracketed_unit(name) for unit, name in zip(units, names, strict=True)]
    filled_cells = [cell for row in rows for cell in row if cell]
    n_numbers = sum(is_number(cell, decimal) for cell in filled_cells)
    n_texts = sum(not TIMESTAMP.fullmatch(cell) for cell in filled_cells) - n_numbers
    before_rows = table[start][0] - 1
    layout = TableFormat(
        header,
        before_rows,
        _number_duplicates(names),
        tuple(units),
        bool(unit_cells),
        delimiter,
        decimal,
        mismatch,
    )
    return n_numbers - n_texts, layout


def _contains_row_names(rows: Sequence[Sequence[str]], decimal: str, delimiter: str) -> bool:
    """Return whether the first cells are row names: text, or consecutive integers."""
    first_cells = [row[0] for row in rows]
    if not all(is_number(row[-1], decimal) for row in rows):
        return False
    if all(cell.isdigit() for cell in first_cells):
        return all(int(next_cell) - int(cell) == 1 for cell, next_cell in pairwise(first_cells))
    if delimiter not in (BLANKS, "\t") or len(rows) < _MIN_ROWS:
        return False
    return not any(is_number(cell, decimal) or TIMESTAMP.fullmatch(cell) for cell in first_cells)


def _has_unnamed_columns(names: Sequence[str], rows: Sequence[Sequence[str]], decimal: str) -> bool:
    """Return whether rows contain numbers after the last named column."""
    return bool(names) and any(
        is_number(cell, decimal) for row in rows for cell in row[len(names) :]
    )


def _has_miscounted_names(
    lines_above: Sequence[tuple[int, list[str]]], width: int, decimal: str
) -> bool:
    """Return whether the line above the rows seems to contain too few or too many names."""
    cells = lines_above[-1][1] if lines_above else []
    if len(cells) < 2 or any(is_number(cell, decimal) for cell in cells):
        return False
    # A comment may contain any text.
    if cells[0].startswith("#") and cells[0].endswith(":"):
        return False
    max_cells = 1 if cells[0].startswith("#") else width
    return 0 < abs(len(cells) - width) <= max_cells


def _count_noun(cells: Sequence[str], noun: str) -> str:
    count = sum(map(bool, cells))
    return f"{count} {noun}" + "s" * (count != 1)


def _are_unnamed_rows(rows: Sequence[Sequence[str]], decimal: str, delimiter: str) -> bool:
    """Return whether rows without names are unambiguous.

    With commas as delimiters, decimal points are required: 0,5,1,25 may be two or four numbers.
    """
    if not all(_is_row(row, decimal) for row in rows):
        return False
    return delimiter != "," or any("." in cell for row in rows for cell in row)


def _find_header(
    lines_above: Sequence[tuple[int, list[str]]], dialect: Dialect, width: int, decimal: str
) -> tuple[tuple[int, list[str]], list[str]] | None:
    """Return the line of names above the rows, and the cells of units; or None."""
    units_row = dialect.units_row
    if dialect.skip_lines is None:
        rows_by_key = {cells[0].lower(): (number, cells) for number, cells in reversed(lines_above)}
        for key in _NAME_KEYS:
            if key in rows_by_key and len(rows_by_key[key][1]) >= width - 1:
                number, names = rows_by_key[key]
                units = next((rows_by_key[key][1] for key in _UNIT_KEYS if key in rows_by_key), [])
                # Columns before the channels are named in the last line.
                cells_above = lines_above[-1][1] if not names[1] else []
                channel_names = [
                    name or name_above
                    for name, name_above in zip_longest(["", *names[1:width]], cells_above)
                ]
                return (number, [name or "" for name in channel_names[:width]]), [
                    "",
                    *units[1:width],
                ]
        # Names are directly above the rows, or above the units, which other lines may follow.
        header_pair = None if units_row is not None else _header_and_unit_rows(lines_above, width)
        lines_above = header_pair or lines_above[-2:]
    if not lines_above:
        return None
    if units_row is None:
        units_row = len(lines_above) > 1 and _are_units(lines_above[1][1], lines_above[0][1], width)
    if len(lines_above) < 1 + units_row:
        return None
    stated_units = dialect.skip_lines is not None or units_row
    number, names = lines_above[0] if stated_units else lines_above[-1]
    values = [cell for cell in names if is_number(cell, decimal)]
    is_damaged = 2 * len(values) >= len(names) or any(decimal in cell for cell in values)
    # There are more names than columns; LabVIEW's rows may lack an empty comment.
    has_too_many = any(name.lower() not in ("", "comment") for name in names[width:])
    if is_damaged or has_too_many or 2 * sum(map(bool, names)) < max(2, width):
        return None
    return (number, names[:width]), lines_above[1][1] if units_row else []


def _header_in_comment(
    lines_above: Sequence[tuple[int, list[str]]], width: int, decimal: str
) -> tuple[tuple[int, list[str]], list[str]] | None:
    """Return the names in comments above the rows, and the units below them; or None.

    The names are in the nearest line with a name for each column.
    """
    units: list[str] = []
    for number, cells in reversed(lines_above[-_MAX_COMMENT_LINES:]):
        if not cells[0].startswith("#"):
            break
        names = [cells[0].removeprefix("#").strip(), *cells[1:]]
        nonempty_names = [name for name in names if name]
        if len(names) != width or len(nonempty_names) != width or width < 2:
            continue
        if names[0].endswith(":") or any(is_number(name, decimal) for name in nonempty_names):
            continue  # a comment, such as "note: at rest"
        if not units and all(
            parse_file_unit(name) or name.lower() in _NO_UNITS for name in nonempty_names
        ):
            units = names
            continue
        return (number, names), [parse_file_unit(unit) or "" for unit in units]
    return None


def _header_and_unit_rows(
    lines_above: Sequence[tuple[int, list[str]]], width: int
) -> Sequence[tuple[int, list[str]]] | None:
    """Return the lines of names and of units below them; None if there are none near the rows."""
    for index in range(
        len(lines_above) - 1, max(0, len(lines_above) - 2 - _MAX_LINES_BELOW_UNITS), -1
    ):
        if _are_units(lines_above[index][1], lines_above[index - 1][1], width):
            return lines_above[index - 1 : index + 1]
        if len(lines_above[index][1]) != width:
            return None  # a line about the measurement
    return None


def _find_longest_run(
    table: Sequence[tuple[int, list[str]]], decimal: str, start_line: int
) -> tuple[int, int]:
    """Return start and stop of the longest run of rows with equal numbers of cells."""
    longest_run, start = (0, 0), 0
    for index in range(len(table) + 1):
        number, cells = table[index] if index < len(table) else (0, [])
        is_comment = bool(cells) and cells[0].startswith("#")
        is_row = number > start_line and (is_comment or _has_numbers(cells, decimal))
        is_same_width = index > start and len(cells) == len(table[start][1])
        if is_row and (is_comment or index == start or is_same_width):
            continue
        if index - start > longest_run[1] - longest_run[0]:
            longest_run = (start, index)
        start = index if is_row and not is_comment else index + 1
    return longest_run


def split_cells(line: str, delimiter: str) -> list[str]:
    """Return the cells of a line, without surrounding blanks."""
    if delimiter == BLANKS:
        return [cell.strip('"') for cell in _BETWEEN_BLANKS.findall(line)]
    cells = line.split(delimiter)
    if '"' in line:
        with suppress(csv.Error):  # a line that is not text
            cells = next(csv.reader([line], delimiter=delimiter))
    return [cell.strip() for cell in cells]


def describe_lines(lines: Sequence[Line], max_lines: int = 6) -> str:
    """Describe the first lines, if no table was found in them."""
    descriptions = []
    for number, line in [line for line in lines if line[1].strip()][:max_lines]:
        delimiter = max(SINGLE_DELIMITERS, key=line.count)
        cells = split_cells(line, delimiter if delimiter in line else BLANKS)
        n_numbers = sum(any(is_number(cell, mark) for mark in _NUMBER_PATTERNS) for cell in cells)
        cell_text = f"{len(cells)} cell" + "s" * (len(cells) > 1)
        descriptions.append(
            f"  line {number}: {cell_text}, {n_numbers or 'none'} a number: {line.strip()[:60]}"
        )
    return "\n".join(descriptions)


def _are_units(cells: Sequence[str], names: Sequence[str], width: int) -> bool:
    """Return whether cells are units, and the cells above them names."""
    units = [parse_file_unit(cell) is not None for cell in cells if cell.lower() not in _NO_UNITS]
    nonempty_names = [name for name in names if name]
    return (
        len(cells) <= width
        and any(units)
        and all(units)
        and len(nonempty_names) >= max(1, width - 1)
        and len(names) <= width
        and not all(parse_file_unit(name) for name in nonempty_names)
    )


def _is_row(cells: Iterable[str], decimal: str) -> bool:
    """Return whether cells are numbers, times or empty, and at least one is a number."""
    has_value = False
    for cell in cells:
        if is_number(cell, decimal):
            has_value = True
        elif cell.lower() not in EMPTY_CELL_TEXTS and not TIMESTAMP.fullmatch(cell):
            return False
    return has_value


def _has_numbers(cells: Sequence[str], decimal: str) -> bool:
    """Return whether at least half of the non-empty cells are numbers or times."""
    entries = [cell for cell in cells if cell]
    n_numbers = sum(is_number(cell, decimal) or bool(TIMESTAMP.fullmatch(cell)) for cell in entries)
    return 2 * n_numbers >= len(entries) and any(is_number(cell, decimal) for cell in entries)


def is_number(cell: str, decimal: str) -> bool:
    """Return whether a cell is a number with a decimal separator."""
    return _NUMBER_PATTERNS[decimal].fullmatch(cell) is not None

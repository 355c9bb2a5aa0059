"""Layout of a table of text: what its first lines show of how it is written.

LabVIEW and other recorders write lines about the measurement before the names, a row of units
below them, semicolons or tabs between cells, and a decimal comma where that is the custom. The
rows show what they are: of all ways to part them, the right one makes the most numbers.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Sequence
from contextlib import suppress
from itertools import pairwise, zip_longest
from typing import Final

from counterspin.frozen import frozen
from counterspin.records.dialect import Dialect
from counterspin.records.unit_notation import bracketed_unit, parse_file_unit

#: Marks that may part the cells, the usual first.
SINGLE_DELIMITERS: Final = (",", ";", "\t", "|")
#: Blanks, any number of them, as one delimiter.
BLANKS: Final = " "
#: What may part the cells, the usual first.
DELIMITERS: Final = (*SINGLE_DELIMITERS, BLANKS)
#: Lines in which the rows must begin.
HEAD_LINES: Final = 400
#: Rows that show whether a file is plain, and how many are wanted to tell a layout.
_PLAIN_ROWS, _MIN_ROWS = 20, 3
#: What counts as an empty cell, in lower case and without surrounding blanks: no number, or one
#: that the instrument could not measure.
EMPTY_CELL_TEXTS: Final = (
    *("", "nan", "n/a", "#n/a", "na", "null", "-", "--", "---"),
    *("ovld", "ovl", "overload", "overflow", "over", "#value!", "#div/0!", "#num!"),
    *(sign + text for sign in ("", "-") for text in ("1.#qnan", "1.#ind", "1.#inf", "nan(ind)")),
)
#: Time of day, perhaps with a date before it and a zone behind: in ISO 8601, or as spreadsheets
#: and recorders write it, with names of months too; minutes and seconds; or a duration of MATLAB.
STAMP: Final = re.compile(
    r"(?:\d{4}[-/]\d\d?[-/]\d\d?[T ]|\d\d?[./]\d\d?[./]\d{4} "
    r"|(?:[A-Z][a-z]{2},? )?\d\d?[- ][A-Z][a-z]{2}[a-z]*[- ]\d{4} |[A-Z][a-z]{2,} \d\d?,? \d{4} )?"
    r"\d\d?:\d\d:\d\d(?:[.,:]\d+)?(?: ?[AaPp][Mm]|Z| ?UTC| ?GMT|[+-]\d\d:?\d\d)?"
    r"|\d{1,3}:\d\d[.,]\d+|\d+(?:[.,]\d+)?(?:[eE][-+]?\d+)? ?(?:[mu]?s|[mu]?secs?|min|hr)"
    r"|(?:[A-Z][a-z]{2} )?[A-Z][a-z]{2}  ?\d\d? \d\d:\d\d:\d\d(?:\.\d+)? \d{4}"
    r"|\d{8}[T ]\d{6}(?:[.,]\d+)?Z?"
)
#: Lines of a head, by their first cell: the names of columns, and their units.
_NAME_KEYS: Final = ("tracename", "trace name", "channel name", "tag")
_UNIT_KEYS: Final = ("vunit", "unit")
#: What a row of units has above columns that have none.
_NO_UNITS: Final = (
    *("", "-", "(-)", "[-]", "(na)", "[na]", "na", "n/a", "(n/a)", "()", "[]"),
    *("no.", "no", "nr", "nr.", "number", "time", "date", "date&time"),
)
#: Most lines between the units and the rows.
_LINES_BELOW_UNITS: Final = 4
_NUMBERS: Final = {
    mark: re.compile(
        rf"[+-]?(?:\d+(?:{re.escape(mark)}\d*)?|{re.escape(mark)}\d+)(?:[eE][+-]?\d+)?"
    )
    for mark in (".", ",")
}
#: A cell between blanks, perhaps in quotation marks; a unit in brackets may stand one blank behind
#: its name.
_BETWEEN_BLANKS: Final = re.compile(
    r'"[^"]*"|[\[(][^\[\]()\s]+[\])](?=\s|$)|\S+(?: ?[\[(][^\[\]()\s]+[\])])?'
)
#: Blanks that part names which have blanks within them.
_WIDE_BLANKS: Final = re.compile(r"\s{2,}|\t")
#: A mark of a comment at the beginning of a line, and the blanks or the label behind it.
_COMMENT: Final = re.compile(
    r"^\s*(?:#+|%+|//+|!+|\*(?=[\sA-Za-z]))\s*(?:(?:col(?:umn)?s?|fields|names|header)\s*[:=]\s*)?",
    re.IGNORECASE,
)
#: A line that is drawn between the names and the rows.
_RULE: Final = re.compile(r"[\s|+]*(?:[-=_]{2,}[\s|+,;]*)+")
#: Lines of comments above the rows in which names may stand.
_COMMENT_LINES: Final = 4
#: Lines of a quoted cell, at most.
_QUOTED_LINES: Final = 30
#: Words that label a row of results below a table.
_RESULT_LABEL: Final = re.compile(
    r"(?i)(mean|average|avg|mittel(wert)?|std|sd|stdev|sigma|sum|summe|min(imum)?|max(imum)?|median|"
    r"variance|range|rms|total|result|checked|approved|signed|operator|end|eof|geprüft)\b.*"
)
#: Part of the cells of a column of numbers that are numbers; lines below the rows have others.
_NUMERIC_PART: Final = 0.6
#: Most lines below the rows that are no rows.
MAX_FOOTER_LINES: Final = 40
#: Delimiter -> how it is called.
_DELIMITER_WORDS: Final = {
    ";": "semicolon-separated",
    "\t": "tab-separated",
    "|": "separated by vertical bars",
    BLANKS: "separated by spaces",
}
#: Between a name that several columns have, and which of them one is.
NUMBERED: Final = " #"


@frozen
class TableFormat:
    """Where things stand in a table of text; lines count from 1."""

    header: int  #: Line of the names; 0 where there is none, and columns are numbered.
    before_rows: int  #: Lines before the first row of numbers.
    names: tuple[str, ...]  #: Of the columns, without blanks around them.
    units: tuple[str, ...]  #: Of the columns, in plain signs; empty text where there is none.
    units_row: bool  #: Whether they stand in a row of their own.
    #: Between cells, and in numbers.
    delimiter: str
    decimal: str
    mismatch: str = ""  #: Why a line of names is not used, in words.

    def describe(self, encoding: str) -> str:
        """Say what is not plain; empty text of a plain file."""
        statements = []
        if not self.header:
            statements.append("unnamed columns")
        if self.mismatch:
            statements.append(self.mismatch)
        if self.header > 1:
            statements.append(f"names in line {self.header}")
        if self.units_row:
            statements.append("a units row")
        if self.delimiter in _DELIMITER_WORDS:
            statements.append(_DELIMITER_WORDS[self.delimiter])
        if self.decimal == ",":
            statements.append("decimal commas")
        if encoding != "utf-8":
            statements.append(encoding)
        return ", ".join(statements)


#: A line's number, from 1, and its text without the end of line.
Line = tuple[int, str]


def detect_format(lines: Sequence[Line], dialect: Dialect) -> TableFormat | None:
    """Return the layout of a file whose rows stand out; None if nothing looks like rows."""
    best: tuple[int, TableFormat] | None = None
    lines = [(number, line) for number, line in lines if not _RULE.fullmatch(line)]
    for delimiter in [dialect.delimiter] if dialect.delimiter else DELIMITERS:
        split_lines = [(number, _split_comment(line, delimiter)) for number, line in lines]
        if delimiter == BLANKS:
            split_lines = _join_spaced_names(split_lines, lines)
        for decimal in [dialect.decimal] if dialect.decimal else (".", ","):
            candidate = find_rows(split_lines, dialect, decimal, delimiter)
            if candidate is not None and (best is None or candidate[0] > best[0]):
                best = candidate
    return best and best[1]


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
        elif count > _QUOTED_LINES:
            return list(lines)
    return list(lines) if count else joined_lines


def _split_comment(line: str, delimiter: str) -> list[str]:
    """Return the cells of a line, the first with '#' before it if the line is a comment."""
    mark = _COMMENT.match(line)
    if mark is None:
        return split_cells(line, delimiter)
    first, *cells = split_cells(line[mark.end() :], delimiter) or [""]
    return [f"#{first}", *cells]


def _normalise_comment(line: str) -> str:
    """Return a line with its mark of a comment, if it has one, as '#' without a blank behind it."""
    return _COMMENT.sub("#", line, count=1) if _COMMENT.match(line) else line


def _join_spaced_names(
    split_lines: Sequence[tuple[int, list[str]]], lines: Sequence[Line]
) -> list[tuple[int, list[str]]]:
    """Return lines parted by blanks, of which those above the rows may be parted by wide ones.

    Names such as `Acc X` have a blank within them, and two or more between them.
    """
    widths = [len(cells) for _, cells in split_lines[-_PLAIN_ROWS:] if _has_numbers(cells, ".")]
    width = max(set(widths), key=widths.count, default=0)
    result = []
    for (number, cells), (_, line) in zip(split_lines, lines, strict=True):
        fields = [cell for cell in _WIDE_BLANKS.split(_normalise_comment(line).strip()) if cell]
        text = cells and not _has_numbers(cells, ".")
        result.append((number, fields if text and len(fields) == width != len(cells) else cells))
    return result


def is_plain_format(lines: Sequence[Line]) -> bool:
    """Return whether names stand in the first line and numbers with points below it."""
    lines_with_text = [line for _, line in lines if line.strip() and not line.startswith("#")]
    if len(lines_with_text) < 2:
        return False
    delimiter = max(SINGLE_DELIMITERS, key=lines_with_text[0].count)
    names = split_cells(lines_with_text[0], delimiter)
    width = len(names)
    named_count = sum(bool(name) and name.lower() != "comment" for name in names)
    rows = [split_cells(line, delimiter) for line in lines_with_text[1 : 1 + _PLAIN_ROWS]]
    if _is_row(names, ".") or max(map(len, rows)) < named_count:
        return False
    return all(len(row) <= width and _is_row(row, ".") for row in rows)


def plain_format(lines: Sequence[Line], dialect: Dialect) -> TableFormat | None:
    """Return the layout if names stand in the first line that is there; None if there is none."""
    lines_with_text = [
        (number, line)
        for number, line in lines
        if line.strip() and not line.startswith("#") and number > (dialect.skip_lines or 0)
    ]
    if not lines_with_text:
        return None
    number, line = lines_with_text[0]
    # The delimiter is the one that the header uses most; a lone column has none.
    delimiter = dialect.delimiter or max(SINGLE_DELIMITERS, key=line.count)
    names = split_cells(_COMMENT.sub("", line, count=1), delimiter)
    # Among the rows a blank line is a row of empty cells; here it stops the parser.
    body = iter([n for n, line_text in lines if n > number and line_text.strip()])
    cells: list[str] = []
    if dialect.units_row:
        units_line = next(body, number + 1)
        cells = next(
            (split_cells(line_text, delimiter) for n, line_text in lines if n == units_line), []
        )
    units = [parse_file_unit(cell) or "" for cell in [*cells, *[""] * len(names)][: len(names)]]
    units = [unit or bracketed_unit(name) for unit, name in zip(units, names, strict=True)]
    comments = next(body, lines[-1][0] + 1) - 1
    mark = dialect.decimal or "."
    return TableFormat(
        number,
        comments,
        _number_duplicates(names),
        tuple(units),
        bool(dialect.units_row),
        delimiter,
        mark,
    )


def _number_duplicates(names: Sequence[str]) -> tuple[str, ...]:
    """Return names of columns, those that occur more than once with their number behind."""
    counts: dict[str, int] = {}
    numbered_names = []
    for name in names:
        counts[name] = counts.get(name, 0) + 1
        duplicates = name and names.count(name) > 1
        numbered_names.append(f"{name}{NUMBERED}{counts[name]}" if duplicates else name)
    return tuple(numbered_names)


def find_rows(
    split_lines: Sequence[tuple[int, list[str]]],
    dialect: Dialect,
    decimal: str,
    delimiter: str = "",
) -> tuple[int, TableFormat] | None:
    """Return how many numbers more than texts the longest stretch of rows has, and its layout."""
    skipped_lines = dialect.skip_lines
    table = [(number, cells) for number, cells in split_lines if any(cells)]
    start, end = _longest_run(table, decimal, start_line=skipped_lines or 0)
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
        return None  # a row like any other stands above: what parts the two is no row of names
    rows = [cells for _, cells in table[start:end]]
    head, mismatch = _header_in_comment(table[:start], width, decimal), ""
    head = head or _find_header(lines_above, dialect, width, decimal)
    if head is not None:
        (header, names), unit_cells = head
        if len(names) == width - 1 and _contains_row_names(rows, decimal, delimiter):
            names = ["column 1", *names]  # as R writes it: nothing above the names of the rows
            unit_cells = ["", *unit_cells] if unit_cells else unit_cells
    is_unnamed = head is not None and _has_unnamed_columns(names, rows, decimal)
    nearest_line = lines_above or [(number, cells) for number, cells in table[:start][-1:]]
    if is_unnamed or (head is None and _has_miscounted_names(nearest_line, width, decimal)):
        number, cells = (header, names) if is_unnamed else nearest_line[-1]
        if not _are_unnamed_rows(rows, decimal, delimiter):
            return None
        mismatch = (
            f"line {number} has {_count_noun(cells, 'name')} for {width} columns, so the columns "
        )
        mismatch += "are numbered"
        header, names, unit_cells = 0, [], []
    elif head is not None:
        pass
    elif all(2 * len(cells) <= width for _, cells in lines_above[-1:]) and _are_unnamed_rows(
        rows, decimal, delimiter
    ):
        header, names, unit_cells = 0, [], []
    else:
        return None
    if delimiter == "," and any(
        _is_number(cell, decimal) for row in rows for cell in row[len(names) :] if names
    ):
        return None  # a number that no name stands above is the rest of one: 1,25 has no two cells
    # A delimiter at the end of every row makes an empty cell that has no name.
    names += [
        f"column {index + 1}"
        if any(_is_number(row[index], decimal) or STAMP.fullmatch(row[index]) for row in rows)
        else ""
        for index in range(len(names), width)
    ]
    padding = [""] * (len(names) - len(unit_cells))
    units = [parse_file_unit(cell) or "" for cell in [*unit_cells, *padding]]
    units = [unit or bracketed_unit(name) for unit, name in zip(units, names, strict=True)]
    text_count = [cell for row in rows for cell in row if cell]
    number_count = sum(_is_number(cell, decimal) for cell in text_count)
    texts = sum(not STAMP.fullmatch(cell) for cell in text_count) - number_count
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
    return number_count - texts, layout


def _contains_row_names(rows: Sequence[Sequence[str]], decimal: str, delimiter: str) -> bool:
    """Return whether the first cells are names of rows: words, or whole numbers that rise."""
    first_cells = [row[0] for row in rows]
    if not all(_is_number(row[-1], decimal) for row in rows):
        return False
    if all(cell.isdigit() for cell in first_cells):
        return all(int(next_cell) - int(cell) == 1 for cell, next_cell in pairwise(first_cells))
    if delimiter not in (BLANKS, "\t") or len(rows) < _MIN_ROWS:
        return False
    return not any(_is_number(cell, decimal) or STAMP.fullmatch(cell) for cell in first_cells)


def _has_unnamed_columns(names: Sequence[str], rows: Sequence[Sequence[str]], decimal: str) -> bool:
    """Return whether rows have numbers in columns behind the last name."""
    return bool(names) and any(
        _is_number(cell, decimal) for row in rows for cell in row[len(names) :]
    )


def _has_miscounted_names(
    lines_above: Sequence[tuple[int, list[str]]], width: int, decimal: str
) -> bool:
    """Return whether the line above the rows seems to have names, but not one for each column."""
    cells = lines_above[-1][1] if lines_above else []
    if len(cells) < 2 or any(_is_number(cell, decimal) for cell in cells):
        return False
    # A comment may say anything.
    if cells[0].startswith("#") and cells[0].endswith(":"):
        return False
    max_cells = 1 if cells[0].startswith("#") else width
    return 0 < abs(len(cells) - width) <= max_cells


def _count_noun(cells: Sequence[str], noun: str) -> str:
    count = sum(map(bool, cells))
    return f"{count} {noun}" + "s" * (count != 1)


def _are_unnamed_rows(rows: Sequence[Sequence[str]], decimal: str, delimiter: str) -> bool:
    """Return whether rows of numbers alone are plain without names above them.

    Where commas part cells, points must part decimals: 0,5,1,25 may be four numbers or two.
    """
    if not all(_is_row(row, decimal) for row in rows):
        return False
    return delimiter != "," or any("." in cell for row in rows for cell in row)


def _find_header(
    lines_above: Sequence[tuple[int, list[str]]], dialect: Dialect, width: int, decimal: str
) -> tuple[tuple[int, list[str]], list[str]] | None:
    """Return the line of names above the rows, and the cells of units; None if it is none."""
    units_row = dialect.units_row
    if dialect.skip_lines is None:
        labelled_rows = {
            cells[0].lower(): (number, cells) for number, cells in reversed(lines_above)
        }
        for key in _NAME_KEYS:
            if key in labelled_rows and len(labelled_rows[key][1]) >= width - 1:
                number, names = labelled_rows[key]
                units = next(
                    (labelled_rows[key][1] for key in _UNIT_KEYS if key in labelled_rows), []
                )
                # Columns before the channels have their names in the last line.
                cells_above = lines_above[-1][1] if not names[1] else []
                named = [
                    name or old for name, old in zip_longest(["", *names[1:width]], cells_above)
                ]
                return (number, [name or "" for name in named[:width]]), ["", *units[1:width]]
        # Names stand right above the rows, or above the units, below which more may be told.
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
    values = [cell for cell in names if _is_number(cell, decimal)]
    is_damaged = 2 * len(values) >= len(names) or any(decimal in cell for cell in values)
    # Names of columns that the rows do not have; LabVIEW's rows may end before an empty remark.
    has_too_many = any(name.lower() not in ("", "comment") for name in names[width:])
    if is_damaged or has_too_many or 2 * sum(map(bool, names)) < max(2, width):
        return None
    return (number, names[:width]), lines_above[1][1] if units_row else []


def _header_in_comment(
    lines_above: Sequence[tuple[int, list[str]]], width: int, decimal: str
) -> tuple[tuple[int, list[str]], list[str]] | None:
    """Return the names in comments right above the rows, and the units below them.

    The line that is nearest to the rows and has a name for each column is that of the names.
    """
    units: list[str] = []
    for number, cells in reversed(lines_above[-_COMMENT_LINES:]):
        if not cells[0].startswith("#"):
            break
        names = [cells[0].removeprefix("#").strip(), *cells[1:]]
        nonempty_names = [name for name in names if name]
        if len(names) != width or len(nonempty_names) != width or width < 2:
            continue
        if names[0].endswith(":") or any(_is_number(name, decimal) for name in nonempty_names):
            continue  # a remark, such as "note: at rest"
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
    """Return the line of names and that of units below it; None if there are none near the rows."""
    for index in range(len(lines_above) - 1, max(0, len(lines_above) - 2 - _LINES_BELOW_UNITS), -1):
        if _are_units(lines_above[index][1], lines_above[index - 1][1], width):
            return lines_above[index - 1 : index + 1]
        if len(lines_above[index][1]) != width:
            return None  # a line about the measurement
    return None


def _longest_run(
    table: Sequence[tuple[int, list[str]]], decimal: str, start_line: int
) -> tuple[int, int]:
    """Return from where to where the longest stretch of rows of one width goes."""
    longest, start = (0, 0), 0
    for index in range(len(table) + 1):
        number, cells = table[index] if index < len(table) else (0, [])
        comment = bool(cells) and cells[0].startswith("#")
        matches = number > start_line and (comment or _has_numbers(cells, decimal))
        is_same_width = index > start and len(cells) == len(table[start][1])
        if matches and (comment or index == start or is_same_width):
            continue
        if index - start > longest[1] - longest[0]:
            longest = (start, index)
        start = index if matches and not comment else index + 1
    return longest


def footer_lines(split_lines: Sequence[Sequence[str]], decimal: str) -> int:
    """Return the number of lines at the end of a table that are not rows, such as a mean.

    split_lines: Cells of the rows of the table and of what stands below them.
    """
    body = [cells for cells in split_lines[:_PLAIN_ROWS] if any(cells)]
    if len(body) < _MIN_ROWS:
        return 0
    width = max(set(map(len, body)), key=list(map(len, body)).count)
    full_rows = [cells for cells in body if len(cells) == width]
    numeric = [n for n in range(width) if any(_is_number(cells[n], decimal) for cells in full_rows)]
    max_lines = [sum(_is_row_cell(cells[n], decimal) for cells in full_rows) for n in range(width)]
    numeric = [n for n in numeric if max_lines[n] >= _NUMERIC_PART * len(full_rows)]
    if not numeric:
        return 0
    is_time = [_is_number(cells[0], decimal) for cells in full_rows]
    last = max((index for index, number in enumerate(is_time) if number), default=0)
    times = [cells[0].replace(decimal, ".") for cells in full_rows[: last + 1]]
    first_rises = all(is_time[: last + 1]) and all(
        float(before) < float(after) for before, after in pairwise(times)
    )
    count = 0
    for index, cells in enumerate(reversed(split_lines[-MAX_FOOTER_LINES:]), 1):
        if not any(cells) or cells[0].startswith("#"):
            count += index == count + 1 and count > 0
            continue
        fits = all(_is_row_cell(cells[n], decimal) for n in numeric if n < len(cells))
        fits = fits and any(n < len(cells) and _is_number(cells[n], decimal) for n in numeric)
        # A row may have a word where most have a number, such as `up` among `+1` and `-1`, but not
        # in place of a time.
        adjacent = [] if first_rises else [n for n in numeric if n > 0]
        fits = fits or bool(
            adjacent
            and len(cells) == width
            and all(_is_number(cells[n], decimal) for n in adjacent)
        )
        if fits and not _RESULT_LABEL.fullmatch(cells[0]):
            break
        count = index
    return count if count < len(split_lines) - _MIN_ROWS else 0


def _is_row_cell(cell: str, decimal: str) -> bool:
    """Return whether a cell is a number, a time or empty."""
    empty = cell.lower() in EMPTY_CELL_TEXTS
    return empty or _is_number(cell, decimal) or bool(STAMP.fullmatch(cell))


def split_cells(line: str, delimiter: str) -> list[str]:
    """Return the cells of a line, without blanks around them."""
    if delimiter == BLANKS:
        return [cell.strip('"') for cell in _BETWEEN_BLANKS.findall(line)]
    cells = line.split(delimiter)
    if '"' in line:
        with suppress(csv.Error):  # a line that is no text
            cells = next(csv.reader([line], delimiter=delimiter))
    return [cell.strip() for cell in cells]


def describe_lines(lines: Sequence[Line], max_lines: int = 6) -> str:
    """Say what the first lines look like, where no table was found among them."""
    descriptions = []
    for number, line in [line for line in lines if line[1].strip()][:max_lines]:
        mark = max(SINGLE_DELIMITERS, key=line.count)
        cells = split_cells(line, mark if mark in line else BLANKS)
        number_count = sum(any(_is_number(cell, mark) for mark in _NUMBERS) for cell in cells)
        count = f"{len(cells)} cell" + "s" * (len(cells) > 1)
        descriptions.append(
            f"  line {number}: {count}, {number_count or 'none'} a number: {line.strip()[:60]}"
        )
    return "\n".join(descriptions)


def _are_units(cells: Sequence[str], names: Sequence[str], width: int) -> bool:
    """Return whether cells are units, and those above them names."""
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
        if _is_number(cell, decimal):
            has_value = True
        elif cell.lower() not in EMPTY_CELL_TEXTS and not STAMP.fullmatch(cell):
            return False
    return has_value


def _has_numbers(cells: Sequence[str], decimal: str) -> bool:
    """Return whether at least half of what is not empty are numbers: there may be remarks."""
    nonempty = [cell for cell in cells if cell]
    number_count = sum(
        _is_number(cell, decimal) or bool(STAMP.fullmatch(cell)) for cell in nonempty
    )
    return 2 * number_count >= len(nonempty) and any(_is_number(cell, decimal) for cell in nonempty)


def _is_number(cell: str, decimal: str) -> bool:
    return _NUMBERS[decimal].fullmatch(cell) is not None

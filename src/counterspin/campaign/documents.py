"""TOML documents: read with located errors, patched, compared; sources of campaigns."""

from __future__ import annotations

import datetime
import hashlib
import os
import re
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import field
from functools import cached_property
from pathlib import Path, PurePath
from typing import Any, Final, Literal, Protocol, TypeVar

from counterspin.errors import (
    CampaignError,
    CounterspinError,
    Problem,
    describe_read_error,
    error_code,
    read_error_code,
)
from counterspin.frozen import frozen
from counterspin.input import detect_file_type, read_file, to_path
from counterspin.toml_text import NestingError, format_document, parse_toml

#: Advice if a folder contains no campaign.
CAMPAIGN_ADVICE: Final = "`counterspin init DIR` creates an example campaign"

#: Kind of a TOML document.
DocumentKind = Literal["campaign", "plan", "laboratory"]
_KIND_LABELS: Final[Mapping[DocumentKind, str]] = {
    "campaign": "a campaign",
    "plan": "a plan",
    "laboratory": "laboratory data for certificates",
}

#: Largest size of a TOML file.
_MAX_BYTES: Final = 5_000_000
#: Largest length of a text in a TOML file.
_MAX_CHARACTERS: Final = 10_000
#: Largest length of a key path, which messages and tables of line numbers repeat.
_MAX_PATH_CHARACTERS: Final = 1_000

#: Name of a campaign without a file, for messages.
IN_MEMORY_LABEL: Final = "campaign in memory"

#: Advice on Windows paths.
BACKSLASH_ADVICE: Final = "write paths with /, or in single quotation marks, 'C:\\data\\run1.csv'"

_KEY_PART: Final = r"""(?:[\w-]+|"[^"\n]*"|'[^'\n]*')"""
_KEY: Final = re.compile(rf"\s*({_KEY_PART}(?:\s*\.\s*{_KEY_PART})*)\s*=")
_HEADER: Final = re.compile(
    rf"\s*\[(\[?)\s*({_KEY_PART}(?:\s*\.\s*{_KEY_PART})*)\s*\]\]?\s*(?:#.*)?"
)
#: Strings and comments, in which brackets have no meaning.
_STRING_OR_COMMENT: Final = re.compile(r"""\"(?:[^"\\]|\\.)*\"|'[^']*'|#.*""")
#: Key path at the start of a message; last part of a key path.
_MESSAGE_KEY: Final = re.compile(rf"({_KEY_PART}(?:\.{_KEY_PART}|\[\d+\])*): ")
#: File and row of a table of readings at the start of a message.
_TABLE_ROW: Final = re.compile(r'readings\.("[^"]*")')
#: Largest number of rows whose identical problems are stated for each row.
_MAX_LISTED_ROWS: Final = 3
_LAST_KEY_PART: Final = re.compile(r'(?:\.[\w-]+|(?<!^readings)\."[^"]*"|\[\d+\])$')

DESCRIPTION_NAME: Final = "campaign.toml"  #: the description's file in a campaign folder


#: The path of a key; items of lists count from 0.
KeyPath = tuple[str | int, ...]


def format_key_path(path: KeyPath) -> str:
    """Format a key path as it is written in TOML."""
    text = ""
    for key in path:
        if isinstance(key, int):
            text += f"[{key}]"
        else:
            is_bare = key.replace("_", "").replace("-", "").isalnum()
            text += ("." if text else "") + (key if is_bare else f'"{key}"')
    return text


def description_file(location: Path | str) -> Path:
    """Return the description file of a campaign, given its folder or the file itself."""
    path = to_path(location, "the folder or description file of a campaign")
    return path / DESCRIPTION_NAME if os.path.isdir(path) else path  # noqa: PTH112 -- any name


def is_inside_folder(file: Path, folder: Path) -> bool:
    """Return whether a path is inside a folder; the path of the folder may contain ``..``."""
    return file.is_relative_to(folder) and ".." not in file.relative_to(folder).parts


def flatten_keys(
    table: Mapping[str, Any], prefix: str = "", is_value: Callable[[object], bool] = lambda _: False
) -> dict[str, Any]:
    """Flatten nested tables to keys with dots, such as ``platform.tilt``; empty ones are values.

    is_value: Predicate for tables that are values and stay unflattened.
    """
    flat_table: dict[str, Any] = {}
    for key, value in table.items():
        if isinstance(value, Mapping) and value and not is_value(value):
            flat_table |= flatten_keys(value, f"{prefix}{key}.", is_value)
        else:
            flat_table[prefix + key] = value
    return flat_table


def table_of(document: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    """Return a table of a document; an empty one if it is missing."""
    value = document.get(key)
    return value if isinstance(value, Mapping) else {}


def list_of(document: Mapping[str, Any], key: str) -> list[Any]:
    """Return a list of a document; an empty one if it is missing."""
    value = document.get(key)
    return value if isinstance(value, list) else []


def load_document(
    file: Path, advice: str = CAMPAIGN_ADVICE, kind: DocumentKind | None = None
) -> dict[str, Any]:
    """Return a TOML document; parameters as in `load_with_checksum`."""
    return load_with_checksum(file, advice, kind)[0]


def load_with_checksum(
    file: Path, advice: str, kind: DocumentKind | None = None
) -> tuple[dict[str, Any], str]:
    """Return a TOML document and its checksum.

    advice: Remedy if the file does not exist or is of another kind.
    kind: The required kind; None: any. Another kind is refused here, because its reader would only
        report unknown keys and missing ones.
    """
    full_advice = advice
    if kind == "campaign":
        full_advice = f"give the folder that contains {DESCRIPTION_NAME}; {advice}"
    try:
        content = read_file(file, _MAX_BYTES)
        if kind is not None and (file_type := _describe_other_file(file, content)):
            raise CampaignError(
                str(file),
                [f"{file_type}, not {_KIND_LABELS[kind]}; {full_advice}"],
                code="wrong-document",
            )
    except OSError as error:
        problem, code = describe_read_error(error), read_error_code(error)
        needs_advice = isinstance(error, FileNotFoundError | IsADirectoryError)
        problem += f"; {advice}" if needs_advice else ""
    except ValueError as error:
        code = "invalid-name"
        problem = f"cannot be read: {error}".partition(";")[0]  # a name with NUL
    else:
        document = parse_document(content, str(file))
        document_kind = _detect_kind(document)
        if kind in (None, document_kind) or document_kind is None:
            return document, f"sha256:{hashlib.sha256(content).hexdigest()}"
        code = "wrong-document"
        problem = f"{_KIND_LABELS[document_kind]}, not {_KIND_LABELS[kind]}; {full_advice}"
    raise CampaignError(str(file), [problem], code=code)


def _describe_other_file(file: Path, content: bytes) -> str:
    """Return the type of a file that is not TOML; empty text if it may be TOML."""
    file_type = detect_file_type(content)
    if file_type or file.suffix.lower() == ".toml":
        return file_type
    from counterspin.records.format_registry import RECORD_FORMATS

    return "a record" if file.suffix.lower() in RECORD_FORMATS else ""


def _detect_kind(document: Mapping[str, Any]) -> DocumentKind | None:
    """Return the kind of a document, detected from its sections; None if it is ambiguous."""
    kinds: set[DocumentKind] = set()
    if "goal" in document:
        kinds.add("plan")
    if "runs" in document or "readings" in document:
        kinds.add("campaign")
    if "laboratory" in document and "customer" in document:
        kinds.add("laboratory")
    return kinds.pop() if len(kinds) == 1 else None


def campaign_error(file: Path, problems: Sequence[str]) -> CampaignError:
    """Return the error with the problems of a file, in the order of its lines.

    A problem of many rows of a table is stated once, with the number of these rows.
    """
    problems = _merge_rows(problems)
    lines = message_lines(problems, file)
    pairs = sorted(
        zip(problems, lines, strict=True), key=lambda pair: (pair[1] is None, pair[1] or 0)
    )
    return CampaignError(str(file), [problem for problem, _ in pairs], [line for _, line in pairs])


def _merge_rows(problems: Sequence[str]) -> list[str]:
    """Return the problems, with the identical problems of many rows merged."""
    rows_by_problem: dict[str, list[str]] = {}
    for problem in problems:
        if (row := _TABLE_ROW.match(problem)) is not None:
            rows_by_problem.setdefault(problem[row.end() :], []).append(row[1])
    merged_problems = []
    for problem in problems:
        row = _TABLE_ROW.match(problem)
        rows = [] if row is None else rows_by_problem[problem[row.end() :]]
        if row is None or len(rows) <= _MAX_LISTED_ROWS:
            merged_problems.append(problem)
        elif row[1] == rows[0]:
            note = f"(the same in {len(rows)} rows, up to {rows[-1]})"
            merged_problems.append(Problem(f"{problem} {note}", error_code(problem)))
    return merged_problems


#: Starts of a message of the TOML parser -> message in plain words, and the action to take.
_SYNTAX_ERRORS: Final = (
    (
        (
            "Cannot overwrite",
            "Cannot mutate",
            "Cannot redefine",
            "Duplicate inline table key",
        ),
        "the key occurs twice",
        "keep only one of them",
    ),
    (("Expected ']'",), "']' is missing after the name of the table", "write, for example, [site]"),
    (("Expected '='",), "'=' is missing after the key", "write KEY = VALUE"),
    (
        ("Invalid statement", "Invalid initial character for a key"),
        "a key, a table or a comment must begin here",
        "write KEY = VALUE, [TABLE] or # COMMENT, with text in quotation marks",
    ),
    (
        ("Expected newline or end of document",),
        "more text follows the value",
        "write text, such as a quantity, in quotation marks",
    ),
    (("Unclosed array",), "a comma or the ']' of the list is missing", "write [ITEM, ITEM]"),
    (
        ("Unclosed inline table",),
        "a comma or the '}' of the table is missing on this line",
        "write { KEY = VALUE, KEY = VALUE }",
    ),
    (
        (r"Illegal character '\n'", r"Illegal character '\r'"),
        "the closing quotation mark is missing on this line",
        "add it, because a text must end on its line",
    ),
    (
        (r"Found invalid character '\r'",),
        "the line ends with a carriage return only",
        "save the file with the line endings of Windows or Linux",
    ),
)


def _explain_syntax_error(message: str, location: str, text: str) -> str:
    """Return the message of the TOML parser in plain words, with the action to take."""
    if location == "end of document":
        n_lines = text.rstrip().count("\n") + 1
        return (
            f"line {n_lines}: the file ends within a key, a value or a table; complete it, or "
            "close the quotation mark or bracket that is open"
        )
    if message.startswith("Cannot declare"):
        table_name = ".".join(re.findall(r"'([^']*)'", message))
        return f"{location}: the table [{table_name}] occurs twice; keep only one of them"
    if message.startswith(("Unescaped", "Invalid hex value", "Escaped character")):
        return (
            f"{location}: {message[:1].lower()}{message[1:]}; in double quotation marks, a "
            f"backslash starts an escape sequence such as \\n; {BACKSLASH_ADVICE}"
        )
    for starts, plain_message, advice in _SYNTAX_ERRORS:
        if message.startswith(starts):
            return f"{location}: {plain_message}; {advice}"
    plain_message = message[:1].lower() + message[1:]
    return f"{location}: {plain_message}; write text, such as a quantity, in quotation marks"


def parse_document(content: bytes, source: str) -> dict[str, Any]:
    """Parse a TOML document; `source` is its name in messages."""
    code = "invalid-toml"
    try:
        # Editors on Windows write a byte-order mark, which TOML does not allow.
        document = parse_toml(content.decode("utf-8-sig"))
        invalid_values = list(find_invalid_values(document, ""))
        if not invalid_values:
            return document
        raise CampaignError(source, invalid_values, code="invalid-value")
    except UnicodeDecodeError:
        code = "wrong-encoding"
        problem = (
            "is not UTF-8 text; save it as UTF-8 (required for the sign ±, which can also "
            "be written as +/-)"
        )
    except NestingError as error:
        problem = str(error) if error.line is None else f"line {error.line}: {error}"
    except tomllib.TOMLDecodeError as error:
        match = re.fullmatch(r"(.*) \(at (.*)\)", str(error), flags=re.DOTALL)
        message, location = (match[1], match[2]) if match else (str(error), "TOML")
        text = content.decode("utf-8-sig", "replace")
        problem = _explain_syntax_error(message, location, text)
    except ValueError as error:
        # Python refuses integers with thousands of digits.
        problem = f"cannot be read: {error}".partition(";")[0]
    raise CampaignError(source, [problem], code=code)


def find_invalid_values(value: Any, path: str) -> Iterator[str]:
    """Yield values that TOML may contain but no key accepts: long integers, long keys, NUL."""
    if len(path) > _MAX_PATH_CHARACTERS:
        yield f"{path}: the path of a key may have at most {_MAX_PATH_CHARACTERS} characters"
    elif isinstance(value, dict):
        for key, inner_value in value.items():
            yield from find_invalid_values(inner_value, f"{path}.{key}" if path else key)
    elif isinstance(value, list):
        for index, inner_value in enumerate(value):
            yield from find_invalid_values(inner_value, f"{path}[{index}]")
    elif isinstance(value, int) and not -(2**63) <= value < 2**63:
        yield f"{path}: an integer may have at most 64 bits"
    if isinstance(value, str) and "\0" in value:
        yield f"{path}: contains a NUL character"
    if isinstance(value, str) and len(value) > _MAX_CHARACTERS:
        yield f"{path}: a text may have at most {_MAX_CHARACTERS} characters"


# Line numbers of keys, for messages


def message_lines(messages: Sequence[str], file: Path) -> list[int | None]:
    """Return the line number in a file to which each message refers, from 1.

    A missing key has the line of its table. The line is None if a message names no existing key, or
    if the file cannot be read.
    """
    try:
        lines_by_key = key_lines(file.read_text("utf-8-sig"))
    except (OSError, ValueError):
        lines_by_key = {}
    return [_message_line(message, lines_by_key) for message in messages]


def _message_line(message: str, lines_by_key: dict[str, int]) -> int | None:
    match = _MESSAGE_KEY.match(message)
    key = match[1] if match else ""
    path = key.replace('"', "")
    if key and path not in lines_by_key:
        # A table without a header, which only the headers of inner tables name.
        for inner_path, line in lines_by_key.items():
            if inner_path.startswith(f"{path}."):
                return line
    while key and key.replace('"', "") not in lines_by_key:
        # A part in quotation marks may be the row of another file.
        parent_key = _LAST_KEY_PART.sub("", key)
        key = parent_key if parent_key != key else ""
    return lines_by_key.get(key.replace('"', ""))


def key_lines(text: str) -> dict[str, int]:
    """Return key -> line number of a TOML document; keys as in messages, unquoted."""
    lines_by_key: dict[str, int] = {}
    table_counts: dict[KeyPath, int] = {}
    table: KeyPath = ()
    depth, open_quotes = 0, ""
    for line_number, line in enumerate(text.splitlines(), 1):
        if open_quotes:  # within a multi-line string
            open_quotes = "" if line.count(open_quotes) % 2 else open_quotes
            continue
        header = _HEADER.fullmatch(line) if depth == 0 else None
        if header is not None:
            table = _open_table(header, table_counts)
            lines_by_key.setdefault(_unquoted_path(table), line_number)
            continue
        key = _KEY.match(line) if depth == 0 else None
        if key is not None:
            path = table
            for key_part in _split_key(key[1]):
                path = (*path, key_part)
                lines_by_key.setdefault(_unquoted_path(path), line_number)
        open_quotes = next(
            (delimiter for delimiter in ('"""', "'''") if line.count(delimiter) % 2), ""
        )
        unquoted_line = _STRING_OR_COMMENT.sub("", line[key.end() :] if key else line)
        depth += sum(map(unquoted_line.count, "[{")) - sum(map(unquoted_line.count, "]}"))
    return lines_by_key


def _open_table(
    header: re.Match[str], table_counts: dict[tuple[str | int, ...], int]
) -> tuple[str | int, ...]:
    """Return the path of the table that a header opens, and count the tables of each list."""
    path: tuple[str | int, ...] = ()
    *parent_keys, last_key = _split_key(header[2])
    for key_part in parent_keys:
        path = (*path, key_part)
        path = (*path, table_counts[path]) if path in table_counts else path
    path = (*path, last_key)
    if header[1]:
        table_counts[path] = table_counts.get(path, -1) + 1
    return (*path, table_counts[path]) if path in table_counts else path


def _split_key(key: str) -> list[str]:
    return [part.strip("\"'") for part in re.findall(_KEY_PART, key)]


def _unquoted_path(path: tuple[str | int, ...]) -> str:
    return format_key_path(path).replace('"', "")


# Documents as mappings, in Python


def to_toml_value(value: Any, path: KeyPath, report: Callable[[KeyPath, str], None]) -> Any:
    """Convert a Python value to the value that TOML would be read as.

    value: Text, a number, a date, a `Quantity` or `HeadTurn`, or a mapping or sequence of these.
        Keys whose value is None are omitted.
    report: Function that receives key path and message of an invalid value.
    """
    if isinstance(value, Mapping):
        for key in value:
            if not isinstance(key, str):
                report(path, Problem(f"the key {key!r} must be a string", "wrong-type"))
        return {
            key: to_toml_value(item, (*path, key), report)
            for key, item in value.items()
            if isinstance(key, str) and item is not None
        }
    if isinstance(value, list | tuple):
        return [to_toml_value(item, (*path, index), report) for index, item in enumerate(value)]
    if hasattr(value, "written"):  # a quantity, or a turn
        return getattr(value, "document", value.written)
    if hasattr(value, "tolist"):  # a number of NumPy, or an array
        return to_toml_value(value.tolist(), path, report)
    if isinstance(value, PurePath):
        return str(value)
    if not isinstance(value, str | bool | int | float | datetime.date | datetime.time):
        message = f"a {type(value).__name__} is not allowed here; write text or a number"
        report(path, Problem(message, "wrong-type"))
    return value


def merge_patch(document: Mapping[str, Any], patch: Mapping[str, Any]) -> dict[str, Any]:
    """Return a document with a JSON Merge Patch (RFC 7396).

    Tables are patched key by key, None removes a key, and other values are replaced.
    """
    merged_document = dict(document)
    for key, value in patch.items():
        old_value = merged_document.get(key)
        if value is None:
            merged_document.pop(key, None)
        elif isinstance(value, Mapping):
            merged_document[key] = merge_patch(
                old_value if isinstance(old_value, Mapping) else {}, value
            )
        else:
            merged_document[key] = value
    return merged_document


def changed_keys(old: Any, new: Any, path: KeyPath = ()) -> Iterator[str]:
    """Yield the keys in which two documents differ; lists of different lengths count as one key."""
    if isinstance(old, Mapping) and isinstance(new, Mapping):
        for key in dict.fromkeys([*old, *new]):
            yield from changed_keys(old.get(key), new.get(key), (*path, key))
    elif isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        for index, (old_item, new_item) in enumerate(zip(old, new, strict=True)):
            yield from changed_keys(old_item, new_item, (*path, index))
    elif type(old) is not type(new) or old != new:
        yield format_key_path(path)


@frozen(eq=False)
class Source:
    """The description from which a campaign was resolved."""

    document: Mapping[str, Any]  #: The parsed document.
    file: Path | None = None  #: The description file; None: made in Python.
    #: SHA-256 of the file as read, such as ``sha256:9f86...``; None without a file.
    checksum: str | None = None
    #: The parsed file, from which `document` may differ.
    file_document: Mapping[str, Any] = field(default_factory=dict)

    @cached_property
    def changed(self) -> tuple[str, ...]:
        """The keys that differ from the file; empty without a file."""
        return () if self.file is None else tuple(changed_keys(self.file_document, self.document))

    @property
    def in_memory(self) -> bool:
        """True if no file has the document's content."""
        return self.file is None or bool(self.changed)

    @property
    def label(self) -> str:
        """The description's name in messages."""
        if self.file is None:
            return IN_MEMORY_LABEL
        return f"{self.file}, changed in memory" if self.changed else str(self.file)

    @property
    def text(self) -> str:
        """The document as TOML."""
        return format_document(self.document)

    def content_checksum(self) -> str:
        """Return the SHA-256 checksum of the file, or of the text that would be written."""
        if self.checksum is not None and not self.in_memory:
            return self.checksum
        return f"sha256:{hashlib.sha256(self.text.encode()).hexdigest()}"


class HasSource(Protocol):
    """An object with a description, such as a campaign."""

    @property
    def path(self) -> Path:
        """The path of the description, or a substitute."""

    @property
    def source(self) -> Source | None:
        """The document from which the campaign was resolved."""


C = TypeVar("C", bound=HasSource)


def require_source(campaign: HasSource) -> Source:
    """Return the source of a campaign; CounterspinError if it is unknown."""
    if campaign.source is None:
        raise CounterspinError(
            f"{campaign.path}: the campaign was modified without `change`, so its description "
            "is unknown; use `change` for all changes",
            code="unknown-description",
        )
    return campaign.source


def set_source(campaign: C, source: Source) -> C:
    """Set the source of a campaign that has just been resolved, and return it.

    The source is not an argument of the class, so that a copy by `dataclasses.replace` has none.
    """
    object.__setattr__(campaign, "source", source)
    return campaign

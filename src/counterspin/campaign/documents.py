"""Documents in TOML: read with errors that say where, patched, compared; where they came from."""

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
    read_error_code,
)
from counterspin.frozen import frozen
from counterspin.input import detect_file_type, read_file, to_path
from counterspin.toml_text import NestingError, format_document, parse_toml

#: What to do where no campaign is.
CAMPAIGN_ADVICE: Final = "`counterspin init DIR` creates an example campaign"

#: What a TOML file may be.
Kind = Literal["campaign", "plan", "laboratory"]
_KINDS: Final[Mapping[Kind, str]] = {
    "campaign": "a campaign",
    "plan": "a plan",
    "laboratory": "laboratory data for certificates",
}

#: No TOML file has more bytes.
_TEXT_BYTES: Final = 5_000_000
#: Nor is any text in it longer.
_MAX_CHARACTERS: Final = 10_000
#: Nor is the path of any key, which messages and tables of lines repeat.
_MAX_PATH_CHARACTERS: Final = 1_000

#: What messages call a campaign without a file.
IN_MEMORY: Final = "campaign in memory"

#: How the path of a file on Windows is written.
BACKSLASH_ADVICE: Final = "write paths with /, or in single quotation marks, 'C:\\data\\run1.csv'"

_PART: Final = r"""(?:[\w-]+|"[^"\n]*"|'[^'\n]*')"""
_KEY: Final = re.compile(rf"\s*({_PART}(?:\s*\.\s*{_PART})*)\s*=")
_HEADER: Final = re.compile(rf"\s*\[(\[?)\s*({_PART}(?:\s*\.\s*{_PART})*)\s*\]\]?\s*(?:#.*)?")
#: Texts and a comment, in which brackets are no brackets.
_TEXTS: Final = re.compile(r"""\"(?:[^"\\]|\\.)*\"|'[^']*'|#.*""")
#: The key with which a message begins, and the last part of a key.
_MESSAGE_KEY: Final = re.compile(rf"({_PART}(?:\.{_PART}|\[\d+\])*): ")
_LAST: Final = re.compile(r"(?:\.[\w-]+|\[\d+\])$")

DESCRIPTION_NAME: Final = "campaign.toml"  #: the description's file in a campaign folder


#: The path of a key; items of lists count from 0.
KeyPath = tuple[str | int, ...]


def key_path(path: KeyPath) -> str:
    """Write the path of a key as TOML users know it."""
    text = ""
    for part in path:
        if isinstance(part, int):
            text += f"[{part}]"
        else:
            plain = part.replace("_", "").replace("-", "").isalnum()
            text += ("." if text else "") + (part if plain else f'"{part}"')
    return text


def description_file(where: Path | str) -> Path:
    """Return the description's file, of a campaign's folder or of the file itself."""
    given = to_path(where, "the folder or description file of a campaign")
    return given / DESCRIPTION_NAME if os.path.isdir(given) else given  # noqa: PTH112 -- any name


def flatten_keys(
    table: Mapping[str, Any],
    prefix: str = "",
    is_value: Callable[[object], bool] = lambda _: False,
) -> dict[str, Any]:
    """Undo TOML's nesting of keys with dots that are not quoted, ``platform.tilt = ...``.

    is_value: Whether a table is a value and not a part of a key.
    """
    flat: dict[str, Any] = {}
    for key, value in table.items():
        if isinstance(value, Mapping) and not is_value(value):
            flat |= flatten_keys(value, f"{prefix}{key}.", is_value)
        else:
            flat[prefix + key] = value
    return flat


def table_of(document: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    """Return a table of a document; an empty one if it is missing."""
    value = document.get(key)
    return value if isinstance(value, Mapping) else {}


def list_of(document: Mapping[str, Any], key: str) -> list[Any]:
    """Return a list of a document; an empty one if it is missing."""
    value = document.get(key)
    return value if isinstance(value, list) else []


def load_document(
    file: Path, advice: str = CAMPAIGN_ADVICE, kind: Kind | None = None
) -> dict[str, Any]:
    """Return a TOML document; as `load_with_checksum`."""
    return load_with_checksum(file, advice, kind)[0]


def load_with_checksum(
    file: Path, advice: str, kind: Kind | None = None
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
        content = read_file(file, _TEXT_BYTES)
        if kind is not None and (file_type := _describe_other_file(file, content)):
            raise CampaignError(
                str(file),
                [f"{file_type}, not {_KINDS[kind]}; {full_advice}"],
                code="wrong-document",
            )
    except OSError as error:
        problem, code = describe_read_error(error), read_error_code(error)
        advised = isinstance(error, FileNotFoundError | IsADirectoryError)
        problem += f"; {advice}" if advised else ""
    except ValueError as error:
        code = "invalid-name"
        problem = f"cannot be read: {error}".partition(";")[0]  # a name with NUL
    else:
        document = parse_document(content, str(file))
        document_kind = _kind_of(document)
        if kind in (None, document_kind) or document_kind is None:
            return document, f"sha256:{hashlib.sha256(content).hexdigest()}"
        code = "wrong-document"
        problem = f"{_KINDS[document_kind]}, not {_KINDS[kind]}; {full_advice}"
    raise CampaignError(str(file), [problem], code=code)


def _describe_other_file(file: Path, content: bytes) -> str:
    """Return the type of a file that is not TOML; empty text if it may be TOML."""
    file_type = detect_file_type(content)
    if file_type or file.suffix.lower() == ".toml":
        return file_type
    from counterspin.records.format_registry import RECORD_FORMATS

    return "a record" if file.suffix.lower() in RECORD_FORMATS else ""


def _kind_of(document: Mapping[str, Any]) -> Kind | None:
    """Return the kind of a document by sections that only this kind has; None if there are none."""
    kinds: set[Kind] = set()
    if "goal" in document:
        kinds.add("plan")
    if "runs" in document or "readings" in document:
        kinds.add("campaign")
    if "laboratory" in document and "customer" in document:
        kinds.add("laboratory")
    return kinds.pop() if len(kinds) == 1 else None


def campaign_error(file: Path, problems: Sequence[str]) -> CampaignError:
    """Return the error that says what is wrong in a file, in the order of its lines."""
    lines = message_lines(problems, file)
    ordered = sorted(
        zip(problems, lines, strict=True), key=lambda pair: (pair[1] is None, pair[1] or 0)
    )
    return CampaignError(str(file), [words for words, _ in ordered], [line for _, line in ordered])


def parse_document(content: bytes, source: str) -> dict[str, Any]:
    """Return the TOML document that the bytes of a file hold; `source` is what messages call it."""
    code = "invalid-toml"
    try:
        # Editors on Windows put a byte-order mark before the text; TOML knows none.
        document = parse_toml(content.decode("utf-8-sig"))
        faults = list(find_invalid_values(document, ""))
        if not faults:
            return document
        raise CampaignError(source, faults, code="invalid-value")
    except UnicodeDecodeError:
        code = "wrong-encoding"
        problem = "is not UTF-8 text; save it as UTF-8 (needed for the sign ±; +/- works too)"
    except NestingError as error:
        problem = str(error) if error.line is None else f"line {error.line}: {error}"
    except tomllib.TOMLDecodeError as error:
        match = re.fullmatch(r"(.*) \(at (.*)\)", str(error), flags=re.DOTALL)
        message, location = (match[1], match[2]) if match else (str(error), "TOML")
        message = message[:1].lower() + message[1:]
        advice = "write text, such as a quantity, in quotation marks"
        if "\\" in message or "hex value" in message:
            advice = (
                "in double quotation marks, a backslash starts an escape sequence such as \\n;  "
                + BACKSLASH_ADVICE
            )
        problem = f"{location}: {message}; {advice}"
    except ValueError as error:
        # A number of thousands of digits, which Python reads no further.
        problem = f"cannot be read: {error}".partition(";")[0]
    raise CampaignError(source, [problem], code=code)


def find_invalid_values(value: Any, path: str) -> Iterator[str]:
    """Yield what is TOML, or almost, and no value of any key: long integers and keys, NUL."""
    if len(path) > _MAX_PATH_CHARACTERS:
        yield f"{path}: the path of a key may have at most {_MAX_PATH_CHARACTERS} characters"
    elif isinstance(value, dict):
        for key, item in value.items():
            yield from find_invalid_values(item, f"{path}.{key}" if path else key)
    elif isinstance(value, list):
        for index, item in enumerate(value):
            yield from find_invalid_values(item, f"{path}[{index}]")
    elif isinstance(value, int) and not -(2**63) <= value < 2**63:
        yield f"{path}: an integer may have at most 64 bits"
    if isinstance(value, str) and "\0" in value:
        yield f"{path}: contains a NUL character"
    if isinstance(value, str) and len(value) > _MAX_CHARACTERS:
        yield f"{path}: a text may have at most {_MAX_CHARACTERS} characters"


# The lines in which keys stand, for messages


def message_lines(messages: Sequence[str], file: Path) -> list[int | None]:
    """Return the line of a document's file to which each message refers, from 1.

    Of a key that is missing it is that of its table; None where a message names no key that is
    there, or the file cannot be read.
    """
    try:
        lines_by_key = key_lines(file.read_text("utf-8-sig"))
    except (OSError, ValueError):
        lines_by_key = {}
    return [_message_line(message, lines_by_key) for message in messages]


def _message_line(message: str, lines_by_key: dict[str, int]) -> int | None:
    match = _MESSAGE_KEY.match(message)
    key = match[1] if match else ""
    while key and key.replace('"', "") not in lines_by_key:
        # What stands in quotation marks may be the row of another file.
        shorter = _LAST.sub("", key)
        key = shorter if shorter != key else ""
    return lines_by_key.get(key.replace('"', ""))


def key_lines(text: str) -> dict[str, int]:
    """Return key -> line, of a document in TOML; keys as messages write them, unquoted."""
    lines_by_key: dict[str, int] = {}
    counts: dict[KeyPath, int] = {}
    table: KeyPath = ()
    depth, quotes = 0, ""
    for number, line in enumerate(text.splitlines(), 1):
        if quotes:  # within a text of several lines
            quotes = "" if line.count(quotes) % 2 else quotes
            continue
        header = _HEADER.fullmatch(line) if depth == 0 else None
        if header is not None:
            table = _open_table(header, counts)
            lines_by_key.setdefault(_unquoted_path(table), number)
            continue
        key = _KEY.match(line) if depth == 0 else None
        if key is not None:
            path = table
            for part in _split_key(key[1]):
                path = (*path, part)
                lines_by_key.setdefault(_unquoted_path(path), number)
        quotes = next((q for q in ('"""', "'''") if line.count(q) % 2), "")
        brackets = _TEXTS.sub("", line[key.end() :] if key else line)
        depth += sum(map(brackets.count, "[{")) - sum(map(brackets.count, "]}"))
    return lines_by_key


def _open_table(
    header: re.Match[str], counts: dict[tuple[str | int, ...], int]
) -> tuple[str | int, ...]:
    """Return the table that a header opens, counting those of each list of tables."""
    path: tuple[str | int, ...] = ()
    *outer, last = _split_key(header[2])
    for part in outer:
        path = (*path, part)
        path = (*path, counts[path]) if path in counts else path
    path = (*path, last)
    if header[1]:
        counts[path] = counts.get(path, -1) + 1
    return (*path, counts[path]) if path in counts else path


def _split_key(key: str) -> list[str]:
    return [part.strip("\"'") for part in re.findall(_PART, key)]


def _unquoted_path(path: tuple[str | int, ...]) -> str:
    return key_path(path).replace('"', "")


# Documents as mappings, in Python


def to_toml_value(value: Any, path: KeyPath, note: Callable[[KeyPath, str], None]) -> Any:
    """Return a copy of what stands at a key as TOML would be read.

    value: Text, a number, a date, a `Quantity` or `HeadTurn`, or a mapping or sequence of these.
        Keys whose value is None are left out.
    note: Takes the key of what cannot stand in a document, and why.
    """
    if isinstance(value, Mapping):
        for key in value:
            if not isinstance(key, str):
                note(path, Problem(f"the key {key!r} must be a string", "wrong-type"))
        return {
            key: to_toml_value(inner, (*path, key), note)
            for key, inner in value.items()
            if isinstance(key, str) and inner is not None
        }
    if isinstance(value, list | tuple):
        return [to_toml_value(inner, (*path, place), note) for place, inner in enumerate(value)]
    if hasattr(value, "written"):  # a quantity, or a turn
        return getattr(value, "document", value.written)
    if hasattr(value, "tolist"):  # a number of NumPy, or an array
        return to_toml_value(value.tolist(), path, note)
    if isinstance(value, PurePath):
        return str(value)
    if not isinstance(value, str | bool | int | float | datetime.date | datetime.time):
        message = f"a {type(value).__name__} is not allowed here; write text or a number"
        note(path, Problem(message, "wrong-type"))
    return value


def merge_patch(document: Mapping[str, Any], patch: Mapping[str, Any]) -> dict[str, Any]:
    """Return a document with keys changed, as a JSON Merge Patch does it (RFC 7396).

    Tables are patched key by key, None takes a key away, all else is replaced.
    """
    merged = dict(document)
    for key, value in patch.items():
        existing = merged.get(key)
        if value is None:
            merged.pop(key, None)
        elif isinstance(value, Mapping):
            merged[key] = merge_patch(existing if isinstance(existing, Mapping) else {}, value)
        else:
            merged[key] = value
    return merged


def differences(before: Any, after: Any, path: KeyPath = ()) -> Iterator[str]:
    """Yield the keys in which documents differ; those of a list whose length differs as one."""
    if isinstance(before, Mapping) and isinstance(after, Mapping):
        for key in dict.fromkeys([*before, *after]):
            yield from differences(before.get(key), after.get(key), (*path, key))
    elif isinstance(before, list) and isinstance(after, list) and len(before) == len(after):
        for index, (item_before, item_after) in enumerate(zip(before, after, strict=True)):
            yield from differences(item_before, item_after, (*path, index))
    elif type(before) is not type(after) or before != after:
        yield key_path(path)


@frozen(eq=False)
class Source:
    """The description that a campaign was resolved from."""

    document: Mapping[str, Any]  #: As TOML is read.
    file: Path | None = None  #: The description's file; None: it was made in Python.
    #: SHA-256 of that file as it was read, such as ``sha256:9f86...``; None without a file.
    checksum: str | None = None
    #: What the file says, which `document` may have changed since.
    of_file: Mapping[str, Any] = field(default_factory=dict)

    @cached_property
    def changed(self) -> tuple[str, ...]:
        """The keys that are no longer as in the file; empty if it was made in Python."""
        return () if self.file is None else tuple(differences(self.of_file, self.document))

    @property
    def in_memory(self) -> bool:
        """True if no file has the document's content."""
        return self.file is None or bool(self.changed)

    @property
    def label(self) -> str:
        """The description's name in messages."""
        if self.file is None:
            return IN_MEMORY
        return f"{self.file}, changed in memory" if self.changed else str(self.file)

    @property
    def text(self) -> str:
        """The document as TOML, as text."""
        return format_document(self.document)

    def content_checksum(self) -> str:
        """Return SHA-256 of the description: of the file, or of the text that would be written."""
        if self.checksum is not None and not self.in_memory:
            return self.checksum
        return f"sha256:{hashlib.sha256(self.text.encode()).hexdigest()}"


class HasSource(Protocol):
    """A campaign, as far as its description is concerned."""

    @property
    def path(self) -> Path:
        """The path of the description, or a substitute."""

    @property
    def source(self) -> Source | None:
        """The document that the campaign was resolved from."""


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


def with_source(campaign: C, source: Source) -> C:
    """Set the source of a campaign that has just been resolved, and return it.

    The source is not an argument of the class: a copy that `dataclasses.replace` changes has none.
    """
    object.__setattr__(campaign, "source", source)
    return campaign

"""Base classes of all results, and their JSON files, reports and figures."""

from __future__ import annotations

import hashlib
import json
import platform
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Final, Self

import numpy
from pydantic import BaseModel, ConfigDict, Field, PrivateAttr, ValidationError, field_validator
from pydantic_core import PydanticSerializationError

from counterspin.errors import DamagedFileError, RecordError, describe_read_error, read_error_code
from counterspin.input import detect_file_type, parse_json, path_of, read_file
from counterspin.loading import load_name

if TYPE_CHECKING:
    from datetime import datetime

    from counterspin.output import FileType
    from counterspin.reports.blocks import Block, Picture
    from counterspin.reports.text import Report

#: How files are written; results that nobody writes do without.
_OUTPUT: Final = "counterspin.output"

#: A list of numbers and nulls as it stands in JSON; no text has such line breaks in it.
_NUMBERS: Final = re.compile(r"\[\n[-+.\denul,\s]+\]")

#: How JSON writes half of a character of two halves.
_HALF: Final = re.compile(r"\\u[dD][89a-fA-F]")


#: Largest number of results named in a sentence.
_MAX_NAMED: Final = 5

#: No number of any result is larger; squares of larger ones would be beyond all numbers.
_LARGEST_NUMBER: Final = 1e100
#: No uncertainty but 0 is smaller: the square of a number over it would be beyond all numbers too.
_SMALLEST_UNCERTAINTY: Final = 1e-50

#: The keys of standard uncertainties.
_UNCERTAINTY: Final = re.compile(r"u(_\w+)?")


class UnknownNameError(KeyError):
    """A name that a result does not have."""

    def __str__(self) -> str:
        """Return the name with the closest known name, or with all known names."""
        from difflib import get_close_matches  # needed only for this error

        name, known = self.args
        folded = {key.lower(): key for key in known}
        near = get_close_matches(str(name).lower(), folded, n=1)
        hint = f'did you mean "{folded[near[0]]}"?' if near else f"known: {', '.join(known)}"
        return f"{name!r} is not in this result; {hint}"


class NamedParts(dict[str, Any]):
    """Parts of a result by name; the error for an unknown name suggests the closest one."""

    def __missing__(self, name: object) -> Any:
        raise UnknownNameError(name, list(self))


class ResultPart(BaseModel):  # noqa: PLW1641 -- pydantic adds the hash of what is frozen
    """A part of a result; unknown keys are refused so that a slip is seen at once."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, ser_json_inf_nan="null", defer_build=True
    )

    def __eq__(self, other: object) -> bool:
        """Return whether the two state the same, whatever either remembers beside it."""
        return type(other) is type(self) and vars(self) == vars(other)

    def __dir__(self) -> list[str]:
        """Return the names of fields, methods and properties, without those of pydantic."""
        hidden = set(dir(BaseModel))
        names = [name for name in super().__dir__() if name not in hidden]
        return [name for name in names if name[0] != "_" and not name.isupper()]


class ResultFile(ResultPart):
    """The result of a command, as one JSON document.

    A subclass adds the fields, in the order in which they are written, and says in `KIND` what a
    message calls it. Within one schema version keys keep their names and meaning; new ones may be
    added.
    """

    KIND: ClassVar[str] = "result"

    schema_version: Annotated[int, Field(alias="schema")] = 1  #: Version of this format.
    #: SHA-256 checksum of the rest of the file; counterspin verifies it when it reads the file.
    seal: str | None = None

    _content: bytes | None = PrivateAttr(default=None)
    _sealed: bool = PrivateAttr(default=True)

    @field_validator("seal")
    @classmethod
    def _of_files(cls, _: str | None) -> None:
        """Forget it: it is the file's, and what is in memory may become another."""

    @property
    def content(self) -> bytes:
        """The bytes of the file, as they were read; else as `write` writes them."""
        return self.to_json().encode() if self._content is None else self._content

    @property
    def sealed(self) -> bool:
        """Whether nobody has changed the file; False where it has no seal, so that none can say."""
        return self._sealed

    def model_copy(self, *, update: Mapping[str, Any] | None = None, deep: bool = False) -> Self:
        """Return a copy; a changed one is no longer what was read."""
        copied = super().model_copy(update=update, deep=deep)
        if update:
            copied._content = None
        return copied

    @classmethod
    def newest_schema(cls) -> int:
        """Return the version that is written, and the newest that can be read."""
        return int(cls.model_fields["schema_version"].default)

    @classmethod
    def json_schema(cls) -> dict[str, Any]:
        """Return the JSON Schema (draft 2020-12) of what `to_json` writes."""
        return cls.model_json_schema(by_alias=True, mode="serialization")

    def to_json(self) -> str:
        """Return the JSON text, with a newline at the end; NaN and infinity become null."""
        try:
            text = self.model_dump_json(by_alias=True, indent=1)
        except PydanticSerializationError:
            # A file's name that is not UTF-8, as JSON must be.
            return (
                type(self)
                .model_validate(_escape_surrogates(self.model_dump(by_alias=True)))
                .to_json()
            )
        # A list of numbers is one line, however many they are.
        text = _NUMBERS.sub(lambda numbers: re.sub(r"\s+", " ", numbers[0]), text) + "\n"
        # What was read without one is not vouched for by writing it again.
        seal = f'"{_seal_of(text)}"' if self._sealed else "null"
        return re.sub(r'"seal": [^\n]*,', f'"seal": {seal},', text, count=1)

    def with_seal(self) -> Self:
        """Return it with the seal of its own file, to stand in another result's."""
        return self.model_copy(update={"seal": json.loads(self.to_json())["seal"]})

    def write(self, path: Path | str, *, overwrite: bool = False) -> None:
        """Write the JSON file, whole or not at all.

        overwrite: Whether an earlier result of the same kind may be replaced; nothing else is.
        """
        write = load_name(f"{_OUTPUT}:write_text")
        write(Path(path), self.to_json(), self.file_kind, overwrite=overwrite)

    @classmethod
    def file_kind(cls) -> FileType:
        """Return how a file of this class is known again: by the keys that it must have."""
        fields = cls.model_fields.items()
        needed = {field.alias or name for name, field in fields if field.is_required()}

        def recognises(path: Path) -> bool:
            try:
                document = parse_json(read_file(path))
            except ValueError:
                return False
            return isinstance(document, dict) and needed <= set(document)

        known: FileType = load_name(f"{_OUTPUT}:FileType")(f"the file of a {cls.KIND}", recognises)
        return known

    @classmethod
    def read(cls, path: Path | str) -> Self:
        """Read a file that `write` has written, now or in an earlier version."""
        path = path_of(path, f"the file of a {cls.KIND}")
        wanted = f"give the JSON file of a {cls.KIND}"
        content = b""
        try:
            content = read_file(path)
            text = content.decode("utf-8")
            document = parse_json(text)
            if _HALF.search(text) and document != _escape_surrogates(document):
                raise ValueError("a string contains an incomplete character")
        except OSError as error:
            raise RecordError(
                f"{path}: {describe_read_error(error)}; {wanted}", code=read_error_code(error)
            ) from error
        except ValueError as error:
            reason = str(error)
            if content.lstrip()[:1] not in (b"{", b"["):
                reason = f"this is {detect_file_type(content) or 'not JSON'}"
            raise DamagedFileError(
                f"{path}: not a {cls.KIND} file, or damaged ({reason}); {wanted}, or write the "
                "file again"
            ) from error
        schema = document.get("schema") if isinstance(document, dict) else None
        if isinstance(schema, int) and schema > cls.newest_schema():
            raise RecordError(
                f"{path} was written by a newer version of counterspin (schema {schema}; this "
                f"version reads schemas up to {cls.newest_schema()}); update counterspin",
                code="newer-version",
            )
        try:
            result = cls.model_validate(document)
        except ValidationError as error:
            first = error.errors()[0]
            where = "".join(f"{key}: " for key in first["loc"])
            raise RecordError(
                f"{path}: not a {cls.KIND} file: {where}{first['msg']}; {wanted}",
                code="wrong-document",
            ) from error
        seal = document.get("seal")
        if seal is not None and seal != _seal_of(text):
            raise RecordError(
                f"{path} was changed after it was written: the seal does not match the content; "
                "use the original file, or compute the result again",
                code="result-altered",
            )
        for fault in (
            *result.validation_errors(),
            *_implausible_numbers(result.model_dump(by_alias=True), ""),
        ):
            raise DamagedFileError(f"{path}: a damaged {cls.KIND}: {fault}")
        result._content, result._sealed = content, seal is not None
        return result

    def validation_errors(self) -> Iterator[str]:
        """Yield errors of a document whose parts are individually valid."""
        yield from ()


def _seal_of(text: str) -> str:
    """Return the checksum of all that a document says but its seal, however it is set."""
    # 1.0 and 1 are one number, as for every other program.
    document = json.loads(text, parse_int=float)
    document.pop("seal", None)
    canonical = json.dumps(document, sort_keys=True, separators=(",", ":"))
    return f"sha256:{hashlib.sha256(canonical.encode()).hexdigest()}"


def _escape_surrogates(value: Any) -> Any:
    """Return a document with what is not UTF-8 in its texts as backslashes and numbers."""
    if isinstance(value, dict):
        return {_escape_surrogates(key): _escape_surrogates(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_escape_surrogates(item) for item in value]
    return value.encode("utf-8", "backslashreplace").decode() if isinstance(value, str) else value


def _implausible_numbers(value: Any, path: str, key: str = "") -> Iterator[str]:
    """Yield messages on numbers of a document that no result has."""
    if isinstance(value, dict):
        for name, item in value.items():
            yield from _implausible_numbers(item, f"{path}.{name}" if path else name, name)
    elif isinstance(value, list | tuple):
        for index, item in enumerate(value):
            yield from _implausible_numbers(item, f"{path}[{index}]", key)
    elif isinstance(value, int | float):
        if not abs(value) <= _LARGEST_NUMBER:
            yield f"{path} is implausibly large"
        elif value < _SMALLEST_UNCERTAINTY and value != 0 and _UNCERTAINTY.fullmatch(key):
            wrong = "negative" if value < 0 else "implausibly small"
            yield f"{path} is {value:g}; an uncertainty of this size is {wrong}"


def unsealed_sentences(names: Sequence[str]) -> list[str]:
    """Return the warning of results whose files have no seal; nothing without such results."""
    if not names:
        return []
    listed = ", ".join(names[:_MAX_NAMED]) + (", ..." if len(names) > _MAX_NAMED else "")
    which = f"The file of {listed} has" if len(names) == 1 else f"{len(names)} files have"
    named = "" if len(names) == 1 else f" ({listed})"
    return [f"{which} no seal{named}, so later changes cannot be excluded."]


def environment() -> dict[str, str]:
    """Return the versions of Python, NumPy and SciPy, and the type of machine."""
    return {
        "python": platform.python_version(),
        "numpy": numpy.__version__,
        "scipy": _scipy(),
        "machine": f"{platform.system()} {platform.machine()}",
    }


@cache
def _scipy() -> str:
    """Return SciPy's version, asked of what is installed: SciPy itself takes long to load."""
    from importlib.metadata import version

    return version("scipy")


# Results that print and draw themselves. Pages import results: a result names its pages. ---------

_PUBLICATION: Final = "counterspin.reports.publication"


def make_frame(columns: Mapping[str, list[Any]], numeric: Iterable[str], library: str) -> Any:
    """Return columns as a frame of a library; `numeric` hold numbers, even if all are None."""
    if library == "pandas":
        return import_module("pandas").DataFrame(columns)
    if library != "polars":
        raise ValueError(f"library: {library!r} is not polars or pandas")
    import polars as pl

    return pl.DataFrame(columns, schema_overrides=dict.fromkeys(numeric, pl.Float64))


def draw_pictures(pictures: Iterable[Picture], axes: Any = None) -> list[Any]:
    """Draw pictures on axes of Matplotlib; see `counterspin.reports.publication.draw_on_axes`."""
    drawn: list[Any] = load_name(f"{_PUBLICATION}:draw_on_axes")(list(pictures), axes)
    return drawn


class ReportableResult(ResultFile):
    """A result with a representation in a notebook, on the terminal and as a report."""

    #: ``package.module:name`` of the function that returns its blocks for the screen.
    BLOCKS: ClassVar[str]
    #: Of the function that returns the blocks of its report, where a report has more.
    REPORT_BLOCKS: ClassVar[str | None] = None
    #: What the file of a report calls itself; None: derived from `KIND`.
    REPORT_KIND: ClassVar[str | None] = None

    def blocks(self) -> list[Block]:
        """Return the blocks of its screen, pictures included."""
        blocks: list[Block] = load_name(f"{_PUBLICATION}:with_seal_warning")(
            self, load_name(self.BLOCKS)(self)
        )
        return blocks

    @property
    def identifier(self) -> str:
        """Identifier of its report, derived from the bytes of its file."""
        return f"CS-{hashlib.sha256(self.content).hexdigest()[:12]}"

    @classmethod
    def report_kind(cls) -> str:
        """Return the name that the file of a report has for itself, such as "a history"."""
        return cls.REPORT_KIND or f"a {cls.KIND}"

    def publication(self, identifier: str | None = None) -> Any:
        """Return its report, a `counterspin.reports.publication.Publication`."""
        return load_name(f"{_PUBLICATION}:publish")(self, identifier)

    def write_report(
        self,
        path: Path | str,
        *,
        identifier: str | None = None,
        issued: datetime | None = None,
        overwrite: bool = False,
    ) -> None:
        """Write its report; see `counterspin.write_report`."""
        load_name(f"{_PUBLICATION}:write_report")(
            self, path, identifier=identifier, issued=issued, overwrite=overwrite
        )

    def __rich__(self) -> Report:
        """Return its screen for rich."""
        made: Report = load_name("counterspin.reports.text:Report")(self.blocks())
        return made

    def __repr__(self) -> str:
        """Return the first 20 lines of its screen."""
        return str(load_name(f"{_PUBLICATION}:short_text")(self._blocks_of_cell()))

    __str__ = __repr__

    def _repr_html_(self) -> str:
        return str(load_name("counterspin.reports.html:notebook_cell")(self._blocks_of_cell()))

    def _repr_markdown_(self) -> str:
        return str(load_name("counterspin.reports.markdown:markdown")(self._blocks_of_cell()))

    def _blocks_of_cell(self) -> list[Block]:
        shown: list[Block] = load_name("counterspin.reports.blocks:text_blocks")(self.blocks())
        return shown

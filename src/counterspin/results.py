"""Base classes of all results, and their JSON files, reports and figures."""

from __future__ import annotations

import hashlib
import json
import platform
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Final, Self

import numpy
from pydantic import BaseModel, ConfigDict, Field, PrivateAttr, ValidationError, field_validator
from pydantic_core import PydanticSerializationError

from counterspin.characters import with_article
from counterspin.errors import DamagedFileError, RecordError, describe_read_error, read_error_code
from counterspin.input import detect_file_type, parse_json, read_file, to_path
from counterspin.loading import load_name

if TYPE_CHECKING:
    from datetime import datetime

    from counterspin.output import FileType
    from counterspin.reports.blocks import Block, Picture
    from counterspin.reports.text import Report

#: Module that writes files, loaded on first use.
_OUTPUT_MODULE: Final = "counterspin.output"

#: An indented JSON list of numbers and nulls; JSON strings contain no line breaks.
_NUMBER_LIST: Final = re.compile(r"\[\n[-+.\denul,\s]+\]")

#: JSON escape of a surrogate.
_SURROGATE_ESCAPE: Final = re.compile(r"\\u[dD][89a-fA-F]")


#: Error type of pydantic -> message.
_PLAIN_MESSAGES: Final[Mapping[str, str]] = {
    "missing": "is missing",
    "extra_forbidden": "unknown key",
    "model_type": "must be an object",
    "dict_type": "must be an object",
    "dataclass_type": "must be an object",
    "list_type": "must be a list",
    "tuple_type": "must be a list",
    "string_type": "must be a string",
    "bool_type": "must be true or false",
    "float_type": "must be a number",
    "float_parsing": "must be a number",
    "int_type": "must be a whole number",
    "int_parsing": "must be a whole number",
}

#: Largest number of results named in a sentence.
_MAX_LISTED_NAMES: Final = 5

#: Largest plausible number in a result; squares of larger numbers would overflow.
_MAX_NUMBER: Final = 1e100
#: Smallest plausible uncertainty except 0; the square of a value divided by it would overflow.
_MIN_UNCERTAINTY: Final = 1e-50

#: The keys of standard uncertainties.
_UNCERTAINTY_KEY: Final = re.compile(r"u(_\w+)?")


class UnknownNameError(KeyError):
    """A name that a result does not have."""

    def __str__(self) -> str:
        """Return the name with the closest known name, or with all known names."""
        from difflib import get_close_matches  # needed only for this error

        name, known_names = self.args
        name_by_lower_case = {key.lower(): key for key in known_names}
        matches = get_close_matches(str(name).lower(), name_by_lower_case, n=1)
        hint = (
            f'did you mean "{name_by_lower_case[matches[0]]}"?'
            if matches
            else f"known: {', '.join(known_names)}"
        )
        return f"{name!r} is not in this result; {hint}"


class NamedParts(dict[str, Any]):
    """Parts of a result by name; the error for an unknown name suggests the closest name."""

    def __missing__(self, name: object) -> Any:
        raise UnknownNameError(name, list(self))


class ResultPart(BaseModel):  # noqa: PLW1641 -- pydantic adds the hash of frozen models
    """A part of a result; unknown keys are rejected."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, ser_json_inf_nan="null", defer_build=True
    )

    def __eq__(self, other: object) -> bool:
        """Return whether both have equal fields; private attributes are ignored."""
        return type(other) is type(self) and vars(self) == vars(other)

    def __dir__(self) -> list[str]:
        """Return the names of fields, methods and properties, without those of pydantic."""
        base_model_names = set(dir(BaseModel))
        names = [name for name in super().__dir__() if name not in base_model_names]
        return [name for name in names if name[0] != "_" and not name.isupper()]


#: Classes of all results: module and class.
RESULT_CLASSES: Final = (
    "calibration.result:Result",
    "planning.result:PlanResult",
    "studies.result:StudyResult",
    "histories.result:History",
    "acceleration_standard.result:AppliedAcceleration",
    "operating_tests.result:OperatingTests",
    "comparisons.result:ResultComparison",
    "comparisons.result:RepeatedCalibration",
    "comparisons.result:Intercomparison",
    "monitoring.result:CheckedRun",
    "monitoring.result:WatchState",
    "monitoring.result:NoiseResult",
    "calibration.batch:BatchResult",
    "validation.page:Dossier",
    "reproduction.plan:Reproduction",
)


def _required_keys(result_class: type[ResultFile]) -> set[str]:
    """Return the keys that every file of a class has."""
    fields = result_class.model_fields.items()
    return {field.alias or name for name, field in fields if field.is_required()}


def _detect_kind(document: object) -> str | None:
    """Return the kind of a result, detected from its keys; None if it is unknown."""
    if not isinstance(document, dict):
        return None
    for name in RESULT_CLASSES:
        with suppress(ModuleNotFoundError):  # of an extension that is not installed
            result_class: type[ResultFile] = load_name(f"counterspin.{name}")
            if _required_keys(result_class) <= set(document):
                return result_class.KIND
    return None


class ResultFile(ResultPart):
    """The result of a command, as one JSON document.

    A subclass adds the fields, in the order in which they are written. `KIND` is its name
    in messages. Within a schema version, keys keep their names and meanings; new keys may be added.
    """

    KIND: ClassVar[str] = "result"

    schema_version: Annotated[int, Field(alias="schema")] = 1  #: Version of this format.
    #: SHA-256 checksum of the rest of the file, verified whenever the file is read.
    seal: str | None = None

    _content: bytes | None = PrivateAttr(default=None)
    _has_seal: bool = PrivateAttr(default=True)

    @field_validator("seal")
    @classmethod
    def _discard_seal(cls, _: str | None) -> None:
        """Discard the seal of the file, because the result in memory may be changed."""

    @property
    def content(self) -> bytes:
        """The bytes of the file that was read, or those that `write` would write."""
        return self.to_json().encode() if self._content is None else self._content

    @property
    def sealed(self) -> bool:
        """Whether the file has a valid seal; without a seal, changes cannot be excluded."""
        return self._has_seal

    def model_copy(self, *, update: Mapping[str, Any] | None = None, deep: bool = False) -> Self:
        """Return a copy; a changed copy does not keep the bytes of the file."""
        copy = super().model_copy(update=update, deep=deep)
        if update:
            copy._content = None
        return copy

    @classmethod
    def newest_schema(cls) -> int:
        """Return the version written, which is the newest that can be read."""
        return int(cls.model_fields["schema_version"].default)

    @classmethod
    def json_schema(cls) -> dict[str, Any]:
        """Return the JSON Schema (draft 2020-12) of the text of `to_json`."""
        return cls.model_json_schema(by_alias=True, mode="serialization")

    def to_json(self) -> str:
        """Return the JSON text, with a newline at the end; NaN and infinity become null."""
        try:
            text = self.model_dump_json(by_alias=True, indent=1)
        except PydanticSerializationError:
            # A file name is not UTF-8, which JSON requires.
            return (
                type(self)
                .model_validate(_escape_surrogates(self.model_dump(by_alias=True)))
                .to_json()
            )
        # Write each list of numbers in one line.
        text = _NUMBER_LIST.sub(lambda list_match: re.sub(r"\s+", " ", list_match[0]), text) + "\n"
        # A result that was read without a seal stays without one.
        seal = f'"{_compute_seal(text)}"' if self._has_seal else "null"
        return re.sub(r'"seal": [^\n]*,', f'"seal": {seal},', text, count=1)

    def with_seal(self) -> Self:
        """Return a copy with the seal of its file, to be included in another result."""
        return self.model_copy(update={"seal": json.loads(self.to_json())["seal"]})

    def write(self, path: Path | str, *, overwrite: bool = False) -> None:
        """Write the JSON file atomically.

        Parameters
        ----------
        path
            Output file.
        overwrite
            Whether an existing result of the same type may be replaced; other files never are.

        Raises
        ------
        CounterspinError
            If the file exists and may not be replaced, or cannot be written.
        """
        write = load_name(f"{_OUTPUT_MODULE}:write_text")
        write(Path(path), self.to_json(), self.file_kind, overwrite=overwrite)

    @classmethod
    def file_kind(cls) -> FileType:
        """Return the type of the files of this class, which are recognised by required keys."""
        required_keys = _required_keys(cls)

        def recognises(path: Path) -> bool:
            try:
                document = parse_json(read_file(path))
            except ValueError:
                return False
            return isinstance(document, dict) and required_keys <= set(document)

        file_type: FileType = load_name(f"{_OUTPUT_MODULE}:FileType")(
            f"the file of {with_article(cls.KIND)}", recognises
        )
        return file_type

    @classmethod
    def read(cls, path: Path | str) -> Self:
        """Read a file that this or an earlier version of counterspin wrote.

        Parameters
        ----------
        path
            JSON file.

        Returns
        -------
        Self
            The result in the file.

        Raises
        ------
        RecordError
            If the file cannot be read, is not such a file, or was edited or damaged.
        """
        kind_text = with_article(cls.KIND)
        path = to_path(path, f"the file of {kind_text}")
        advice = f"give the JSON file of {kind_text}"
        content = b""
        try:
            content = read_file(path)
            text = content.decode("utf-8-sig")  # editors on Windows write a byte-order mark
            document = parse_json(text)
            if _SURROGATE_ESCAPE.search(text) and document != _escape_surrogates(document):
                raise ValueError("a string contains an incomplete character")
        except OSError as error:
            raise RecordError(
                f"{path}: {describe_read_error(error)}; {advice}", code=read_error_code(error)
            ) from error
        except ValueError as error:
            reason = str(error)
            if content.lstrip()[:1] not in (b"{", b"["):
                reason = f"this is {detect_file_type(content) or 'not JSON'}"
            raise DamagedFileError(
                f"{path}: not a {cls.KIND} file, or damaged ({reason}); {advice}, or "
                "write the file again"
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
            if (kind := _detect_kind(document)) and kind != cls.KIND:
                raise RecordError(
                    f"{path}: the file of {with_article(kind)}, not of {kind_text}; {advice}",
                    code="wrong-document",
                ) from error
            first_error = error.errors()[0]
            key_path = "".join(f"{key}: " for key in first_error["loc"])
            problem = _PLAIN_MESSAGES.get(first_error["type"], first_error["msg"])
            raise RecordError(
                f"{path}: not a {cls.KIND} file: {key_path}{problem}; {advice}",
                code="wrong-document",
            ) from error
        seal = document.get("seal")
        if seal is not None and seal != _compute_seal(text):
            raise RecordError(
                f"{path} was changed after it was written: the seal does not match the content; "
                "use the original file, or compute the result again",
                code="result-altered",
            )
        for problem in (
            *result.validation_errors(),
            *_find_implausible_numbers(result.model_dump(by_alias=True), ""),
        ):
            raise DamagedFileError(f"{path}: a damaged {cls.KIND}: {problem}")
        result._content, result._has_seal = content, seal is not None
        return result

    def validation_errors(self) -> Iterator[str]:
        """Yield errors of a document whose parts are individually valid."""
        yield from ()


def _compute_seal(text: str) -> str:
    """Return the checksum of a JSON document without its seal; formatting does not matter."""
    # 1.0 and 1 are the same number.
    document = json.loads(text, parse_int=float)
    document.pop("seal", None)
    canonical_json = json.dumps(document, sort_keys=True, separators=(",", ":"))
    return f"sha256:{hashlib.sha256(canonical_json.encode()).hexdigest()}"


def _escape_surrogates(value: Any) -> Any:
    """Return a document with surrogates in its texts replaced by backslash escapes."""
    if isinstance(value, dict):
        return {_escape_surrogates(key): _escape_surrogates(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_escape_surrogates(item) for item in value]
    return value.encode("utf-8", "backslashreplace").decode() if isinstance(value, str) else value


def _find_implausible_numbers(value: Any, path: str, key: str = "") -> Iterator[str]:
    """Yield messages on implausible numbers of a document."""
    if isinstance(value, dict):
        for name, item in value.items():
            yield from _find_implausible_numbers(item, f"{path}.{name}" if path else name, name)
    elif isinstance(value, list | tuple):
        for index, item in enumerate(value):
            yield from _find_implausible_numbers(item, f"{path}[{index}]", key)
    elif isinstance(value, int | float):
        if not abs(value) <= _MAX_NUMBER:
            yield f"{path} is implausibly large"
        elif value < _MIN_UNCERTAINTY and value != 0 and _UNCERTAINTY_KEY.fullmatch(key):
            problem = "negative" if value < 0 else "implausibly small"
            yield f"the uncertainty {path} is {problem} ({value:g})"


def unsealed_sentences(names: Sequence[str]) -> list[str]:
    """Return the warning on results whose files have no seal; empty if there are none."""
    if not names:
        return []
    names_text = ", ".join(names[:_MAX_LISTED_NAMES]) + (
        ", ..." if len(names) > _MAX_LISTED_NAMES else ""
    )
    subject = f"The file of {names_text} has" if len(names) == 1 else f"{len(names)} files have"
    parenthesis = "" if len(names) == 1 else f" ({names_text})"
    return [f"{subject} no seal{parenthesis}, so later changes cannot be excluded."]


def describe_environment() -> dict[str, str]:
    """Return the versions of Python, NumPy and SciPy, and the type of machine."""
    return {
        "python": platform.python_version(),
        "numpy": numpy.__version__,
        "scipy": _scipy_version(),
        "machine": f"{platform.system()} {platform.machine()}",
    }


@cache
def _scipy_version() -> str:
    """Return SciPy's version from the package metadata, because importing SciPy takes long."""
    from importlib.metadata import version

    return version("scipy")


# Results with reports. Pages import results, so a result refers to its pages by name. ------------

_PUBLICATION_MODULE: Final = "counterspin.reports.publication"


def make_frame(
    columns: Mapping[str, list[Any]], numeric_columns: Iterable[str], library: str
) -> Any:
    """Return columns as a data frame; `numeric_columns` are numeric, even if all are None."""
    if library == "pandas":
        return import_module("pandas").DataFrame(columns)
    if library != "polars":
        raise ValueError(f"library: {library!r} is not polars or pandas")
    import polars as pl

    return pl.DataFrame(columns, schema_overrides=dict.fromkeys(numeric_columns, pl.Float64))


def draw_pictures(pictures: Iterable[Picture], axes: Any = None) -> list[Any]:
    """Draw pictures on axes of Matplotlib; see `counterspin.reports.publication.draw_on_axes`."""
    drawn_axes: list[Any] = load_name(f"{_PUBLICATION_MODULE}:draw_on_axes")(list(pictures), axes)
    return drawn_axes


class ReportableResult(ResultFile):
    """A result with a representation in a notebook, on the terminal and as a report."""

    #: ``package.module:name`` of the function that returns the blocks for the screen.
    BLOCKS: ClassVar[str]
    #: The same for the blocks of the report; None: those of the screen.
    REPORT_BLOCKS: ClassVar[str | None] = None
    #: Document type in the mark of a report file; None: derived from `KIND`.
    REPORT_KIND: ClassVar[str | None] = None

    def blocks(self) -> list[Block]:
        """Return the blocks for the screen, including pictures."""
        blocks: list[Block] = load_name(f"{_PUBLICATION_MODULE}:add_seal_warning")(
            self, load_name(self.BLOCKS)(self)
        )
        return blocks

    @property
    def identifier(self) -> str:
        """Identifier of the report, derived from the bytes of the file."""
        return f"CS-{hashlib.sha256(self.content).hexdigest()[:12]}"

    @classmethod
    def report_kind(cls) -> str:
        """Return the document type in the mark of a report file, such as "a history"."""
        return cls.REPORT_KIND or f"a {cls.KIND}"

    def publication(self, identifier: str | None = None) -> Any:
        """Return the report, a `counterspin.reports.publication.Publication`."""
        return load_name(f"{_PUBLICATION_MODULE}:make_publication")(self, identifier)

    def write_report(
        self,
        path: Path | str,
        *,
        identifier: str | None = None,
        issued: datetime | None = None,
        overwrite: bool = False,
    ) -> None:
        """Write the report; see `counterspin.write_report`."""
        load_name(f"{_PUBLICATION_MODULE}:write_report")(
            self, path, identifier=identifier, issued=issued, overwrite=overwrite
        )

    def __rich__(self) -> Report:
        """Return the report for rich."""
        report: Report = load_name("counterspin.reports.text:Report")(self.blocks())
        return report

    def __repr__(self) -> str:
        """Return the first 20 lines of the report."""
        return str(load_name(f"{_PUBLICATION_MODULE}:short_text")(self._cell_blocks()))

    __str__ = __repr__

    def _repr_html_(self) -> str:
        return str(load_name("counterspin.reports.html:render_notebook_cell")(self._cell_blocks()))

    def _repr_markdown_(self) -> str:
        return str(load_name("counterspin.reports.markdown:render_markdown")(self._cell_blocks()))

    def _cell_blocks(self) -> list[Block]:
        blocks: list[Block] = load_name("counterspin.reports.blocks:remove_pictures")(self.blocks())
        return blocks

"""Mistakes in a campaign file, collected and reported with the path of the key."""

from __future__ import annotations

import re
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, Final, TypeVar

from pydantic import BaseModel, GetJsonSchemaHandler, TypeAdapter, ValidationError
from pydantic_core import CoreSchema, core_schema

from counterspin.campaign.documents import KeyPath, format_key_path
from counterspin.errors import Problem, error_code
from counterspin.loading import load_name

ModelT = TypeVar("ModelT", bound=BaseModel)
T = TypeVar("T")

#: Error type of pydantic -> message in plain words; other types keep pydantic's message.
_PLAIN_MESSAGES: Final[Mapping[str, str]] = {
    "missing": "is missing",
    "model_type": "must be a table",
    "model_attributes_type": "must be a table",
    "dict_type": "must be a table",
    "list_type": "must be a list",
    "string_type": "must be a string",
    "string_too_short": "must not be empty",
    "int_type": "must be a whole number",
    "too_short": "must have at least one entry",
    "literal_error": "this version of counterspin supports schema = 1",
    "finite_number": "must be a finite number",
    "float_type": "must be a number",
    "bool_type": "must be true or false",
    "date_type": "must be a date, such as 2026-03-02",
    "greater_than_equal": "must be at least {ge}",
    "less_than_equal": "must be at most {le}",
}

#: Error type of pydantic -> error code; ``value_error`` has the code of its exception.
_ERROR_CODES: Final[Mapping[str, str]] = {
    "missing": "missing-key",
    "extra_forbidden": "unknown-key",
    "literal_error": "unknown-choice",
    "string_too_short": "missing-value",
    "too_short": "missing-value",
    "greater_than": "value-out-of-range",
    "greater_than_equal": "value-out-of-range",
    "less_than": "value-out-of-range",
    "less_than_equal": "value-out-of-range",
    "finite_number": "value-out-of-range",
    "": "wrong-type",
}

#: Name of an alternative type in the location of a pydantic error.
_TYPE_NAME: Final = re.compile(r"(constrained-)?(str|int|float)|(list|dict|is-instance)\[.*\]")


def suggest_name(word: str, choices: Iterable[str]) -> str:
    """Return ``; did you mean "..."?``, or the known names, for the end of a message."""
    names = list(choices)
    name_by_lowercase = {name.lower(): name for name in names}
    from difflib import get_close_matches  # needed only for invalid files

    if not names:
        return ""
    matches = get_close_matches(word.lower(), name_by_lowercase, n=1)
    hint = f'; did you mean "{name_by_lowercase[matches[0]]}"?' if matches else ""
    return f"{hint}; known: {', '.join(names)}" if not matches else hint


class Section:
    """The contents of a table that is checked separately from the rest of its document.

    written: A class with the table's keys; a dictionary of such tables by name, or a list of them.
        For a table of an extension, the name ``package.module:Class``, loaded on demand.
    """

    def __init__(self, written: Any) -> None:
        self._written = written

    @property
    def model(self) -> Any:
        """The class, or classes, of the table."""
        return load_name(self._written) if isinstance(self._written, str) else self._written

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        """Return the JSON Schema of the table; for one class, the reference to it."""
        written = TypeAdapter(self.model).core_schema
        return handler(core_schema.definitions_schema(written, []))


def nested_models(document_class: type[BaseModel]) -> dict[str, Any]:
    """Return key -> model of each table that is checked separately."""
    return {
        field.alias or name: section.model
        for name, field in document_class.model_fields.items()
        for section in field.metadata
        if isinstance(section, Section)
    }


class Problems:
    """Collects the mistakes of one file.

    raw: Whole document, which contains the names of the runs for the messages.
    """

    def __init__(self, raw: Mapping[str, Any]) -> None:
        self.lines: list[str] = []
        self._raw = raw

    def add(self, path: KeyPath, message: str, code: str = "conflicting-keys") -> None:
        """Add a mistake at a key; a message that is a `Problem` has its own code."""
        text = f"{format_key_path(path)}: {message}{self._run_name(path)}"
        line = Problem(text, error_code(message, code))
        if line not in self.lines:
            self.lines.append(line)

    def check(
        self, model: type[ModelT], raw: Any, path: KeyPath, **context: object
    ) -> ModelT | None:
        """Validate a section; return its model, or None with the mistakes added.

        Contradictions between its keys are added, too.

        Parameters
        ----------
        model
            Class of the section.
        raw
            Unchecked section.
        path
            Key path of the section.
        **context
            Context of its validators: `gravity` of the site in m/s^2, for quantities that may be
            stated in m/s^2 or in g; `output`, in whose unit coefficients may be stated; `units` of
            readings by accelerometer; `folder` of the files.
        """
        instance, invalid_keys = self.validate_partial(model, raw, path, **context)
        return None if invalid_keys else instance

    def validate_partial(
        self, model: type[ModelT], raw: Any, path: KeyPath, **context: object
    ) -> tuple[ModelT | None, set[str]]:
        """Return the section with its valid keys, and the invalid keys; parameters as in `check`.

        A required key that is invalid has the value of its example.
        """
        invalid_keys: set[str] = set()
        instance = None
        try:
            instance = model.model_validate(raw, context=context)
        except ValidationError as error:
            for error_path, mistake in _deduplicate(error.errors(include_url=False)):
                text = _format_error(mistake, error_path, model)
                self.add((*path, *error_path), text, _error_code(mistake))
                invalid_keys.add(str(error_path[0]) if error_path else "")
            if isinstance(raw, Mapping) and "" not in invalid_keys:
                instance = _validate_without_keys(model, raw, invalid_keys, context)
        for key_path, message, *related_keys in _find_contradictions(instance):
            if not invalid_keys & {*map(str, key_path[:1]), *related_keys}:
                self.add((*path, *key_path), message)
        return instance, invalid_keys

    def collect(self, path: KeyPath, make: Callable[..., T], *args: Any, **kwargs: Any) -> T | None:
        """Return ``make(...)``; or None, with its ValueError added."""
        try:
            return make(*args, **kwargs)
        except ValueError as error:
            self.add(path, str(error), error_code(error))
            return None

    def _run_name(self, path: KeyPath) -> str:
        if len(path) < 3 or path[0] != "runs" or not isinstance(path[1], int):
            return ""
        run = self._raw["runs"][path[1]]
        name = run.get("name") if isinstance(run, Mapping) else None
        return f' (run "{name}")' if isinstance(name, str) and path[2] != "name" else ""


def _format_error(mistake: Any, path: KeyPath, model: type[BaseModel]) -> str:
    """Return the message of a pydantic error in plain words."""
    error_type, context = mistake["type"], mistake.get("ctx", {})
    if error_type == "extra_forbidden":
        return "unknown key" + suggest_name(str(path[-1]), _known_keys(model, path[:-1]))
    if error_type == "literal_error" and path[-1] != "schema":
        return f"{str(mistake['input'])!r} is not one of {context['expected']}"
    if error_type == "value_error":
        return str(context["error"])
    if error_type == "too_short" and context["min_length"] > 1:
        return f"must have at least {context['min_length']} entries"
    if error_type == "too_long":
        return f"must have at most {context['max_length']} entries"
    message: str = _PLAIN_MESSAGES.get(error_type, "{}").format(mistake["msg"], **context)
    return message


def _error_code(mistake: Any) -> str:
    kind = mistake["type"]
    if kind == "value_error":
        return error_code(mistake["ctx"]["error"])
    return _ERROR_CODES.get(kind, "wrong-type" if kind.endswith("_type") else "invalid-value")


def _find_contradictions(instance: Any) -> Iterator[Any]:
    """Yield the contradictions in a section and its nested sections."""
    yield from getattr(instance, "contradictions", tuple)()
    for name, field in (
        type(instance).model_fields.items() if isinstance(instance, BaseModel) else ()
    ):
        value = getattr(instance, name)
        for path, message, *related_keys in _find_contradictions(value):
            yield (field.alias or name, *path), message, *related_keys


def _validate_without_keys(
    model: type[ModelT], raw: Mapping[str, Any], invalid_keys: set[str], context: dict[str, object]
) -> ModelT | None:
    """Validate a section without its invalid keys; required ones get their examples."""
    examples = {
        field.alias or name: (field.examples or [None])[0]
        for name, field in model.model_fields.items()
        if field.is_required()
    }
    valid_values = {key: example for key, example in examples.items() if key in invalid_keys}
    valid_values |= {key: value for key, value in raw.items() if key not in invalid_keys}
    try:
        return model.model_validate(valid_values, context=context)
    except ValidationError:
        return None


def _deduplicate(mistakes: Iterable[Any]) -> Iterator[tuple[KeyPath, Any]]:
    """Yield errors with their key paths; errors of a value with alternative types count as one.

    If a value fits one of these types except for a nested error, yield the nested error.
    """
    errors_by_path: dict[KeyPath, list[Any]] = {}
    for mistake in mistakes:
        if mistake["type"] == "is_instance_of":
            continue  # a type that no document can contain
        error_path = mistake["loc"]
        type_index = next(
            (position for position, entry in enumerate(error_path) if _is_type_name(entry)),
            len(error_path),
        )
        errors_by_path.setdefault(error_path[:type_index], []).append(
            {**mistake, "loc": error_path[:type_index] + error_path[type_index + 1 :]}
        )
    for path, errors in errors_by_path.items():
        nested_errors = [error for error in errors if error["loc"] != path]
        candidates = nested_errors or [
            error for error in errors if not error["type"].endswith("_type")
        ]
        if nested_errors:
            yield from _deduplicate(nested_errors)
        elif candidates or len(errors) == 1:
            yield path, (candidates or errors)[0]
        else:
            *requirements, last_requirement = (
                _PLAIN_MESSAGES[error["type"]].partition("must be ")[2] for error in errors
            )
            text = f"must be {', '.join(requirements)} or {last_requirement}"
            yield path, {"type": "", "msg": text}


def _is_type_name(entry: str | int) -> bool:
    return isinstance(entry, str) and _TYPE_NAME.fullmatch(entry) is not None


def _known_keys(model: type[BaseModel], path: Sequence[str | int]) -> list[str]:
    """Return the keys of the (nested) model at a path."""
    current_model: Any = model
    is_user_key = False  # whether the next key is a name chosen by the user
    for key in path:
        if isinstance(key, int) or current_model is None or is_user_key:
            is_user_key = False
            continue
        fields = current_model.model_fields
        annotations = {field.alias or name: field.annotation for name, field in fields.items()}
        is_user_key = typing.get_origin(annotations.get(key)) is dict
        current_model = find_model(annotations.get(key))
    if current_model is None:
        return []
    return [field.alias or name for name, field in current_model.model_fields.items()]


def find_model(annotation: Any) -> type[BaseModel] | None:
    """Return the model in ``Model``, ``Model | None``, ``tuple[Model, ...]`` and the like."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    for argument in typing.get_args(annotation):
        model = find_model(argument)
        if model is not None:
            return model
    return None

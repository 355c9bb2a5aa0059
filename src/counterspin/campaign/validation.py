"""Mistakes in a campaign file, collected and reported with the path of the key."""

from __future__ import annotations

import re
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, Final, TypeVar

from pydantic import BaseModel, GetJsonSchemaHandler, TypeAdapter, ValidationError
from pydantic_core import CoreSchema, core_schema

from counterspin.campaign.documents import KeyPath, key_path
from counterspin.errors import Problem, error_code
from counterspin.loading import load_name

M = TypeVar("M", bound=BaseModel)
T = TypeVar("T")

#: Pydantic's kinds of mistake in plain words; the others keep pydantic's own.
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

#: Pydantic's kinds of mistake -> code of the error; ``value_error`` has that of its error.
_CODES: Final[Mapping[str, str]] = {
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

#: How pydantic names the one of several types as which a value was read, in a mistake's place.
_ONE_OF_SEVERAL: Final = re.compile(r"(constrained-)?(str|int|float)|(list|dict|is-instance)\[.*\]")


def suggest_name(word: str, choices: Iterable[str]) -> str:
    """Return ``; did you mean "..."?`` and what is known, for the end of a message."""
    names = list(choices)
    folded = {name.lower(): name for name in names}
    from difflib import get_close_matches  # needed only where a file is wrong

    if not names:
        return ""
    matches = get_close_matches(word.lower(), folded, n=1)
    hint = f'; did you mean "{folded[matches[0]]}"?' if matches else ""
    return f"{hint}; known: {', '.join(names)}" if not matches else hint


class Section:
    """The contents of a table that is checked separately from the rest of its document.

    written: A class with the table's keys; a dictionary of such tables by name, or a list of them.
        For a table of an extension, the name ``package.module:Class``, loaded where one is found.
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
        """Return the JSON Schema of what is written: of one class, the reference to it."""
        written = TypeAdapter(self.model).core_schema
        return handler(core_schema.definitions_schema(written, []))


def nested_models(document: type[BaseModel]) -> dict[str, Any]:
    """Return key -> what may stand there, of the tables of a document that are checked apart."""
    return {
        field.alias or name: section.model
        for name, field in document.model_fields.items()
        for section in field.metadata
        if isinstance(section, Section)
    }


class Problems:
    """Collects the mistakes of one file.

    raw: The whole document as read, from which a run's name is taken for the messages.
    """

    def __init__(self, raw: Mapping[str, Any]) -> None:
        self.lines: list[str] = []
        self._raw = raw

    def add(self, path: KeyPath, message: str, code: str = "conflicting-keys") -> None:
        """Note a mistake at a key; a message that is a `Problem` has its own code."""
        text = f"{key_path(path)}: {message}{self._run_name(path)}"
        line = Problem(text, error_code(message, code))
        if line not in self.lines:
            self.lines.append(line)

    def check(self, model: type[M], raw: Any, path: KeyPath, **context: object) -> M | None:
        """Return the section as its model, or None with its mistakes noted.

        What its keys contradict in each other is noted, too.

        Parameters
        ----------
        model
            What may stand in the section.
        raw
            What does.
        path
            Where the section is.
        **context
            What its values are read with: `gravity` of the site in m/s^2, for quantities that may
            be given in m/s^2 or in g; `output`, in whose unit coefficients may be; `units` of
            readings by accelerometer; `folder`, in which files are.
        """
        instance, invalid_keys = self.validate_partial(model, raw, path, **context)
        return None if invalid_keys else instance

    def validate_partial(
        self, model: type[M], raw: Any, path: KeyPath, **context: object
    ) -> tuple[M | None, set[str]]:
        """Return the section with its right keys, and the wrong ones; parameters as in `check`.

        What is required and wrong has the value of its example.
        """
        invalid_keys: set[str] = set()
        instance = None
        try:
            instance = model.model_validate(raw, context=context)
        except ValidationError as error:
            for error_path, mistake in _deduplicate(error.errors(include_url=False)):
                text = _error_text(mistake, error_path, model)
                self.add((*path, *error_path), text, _error_code(mistake))
                invalid_keys.add(str(error_path[0]) if error_path else "")
            if isinstance(raw, Mapping) and "" not in invalid_keys:
                instance = _validate_without(model, raw, invalid_keys, context)
        for location, message, *related in _contradictions(instance):
            if not invalid_keys & {*map(str, location[:1]), *related}:
                self.add((*path, *location), message)
        return instance, invalid_keys

    def collect(self, path: KeyPath, make: Callable[..., T], *args: Any, **kwargs: Any) -> T | None:
        """Return ``make(...)``, or None with its ValueError noted."""
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


def _error_text(mistake: Any, loc: KeyPath, model: type[BaseModel]) -> str:
    """Return pydantic's message on a mistake in plain words."""
    kind, sizes = mistake["type"], mistake.get("ctx", {})
    if kind == "extra_forbidden":
        return "unknown key" + suggest_name(str(loc[-1]), _known_keys(model, loc[:-1]))
    if kind == "literal_error" and loc[-1] != "schema":
        return f"{str(mistake['input'])!r} is not one of {sizes['expected']}"
    if kind == "value_error":
        return str(sizes["error"])
    if kind == "too_short" and sizes["min_length"] > 1:
        return f"must have at least {sizes['min_length']} entries"
    if kind == "too_long":
        return f"must have at most {sizes['max_length']} entries"
    words: str = _PLAIN_MESSAGES.get(kind, "{}").format(mistake["msg"], **sizes)
    return words


def _error_code(mistake: Any) -> str:
    kind = mistake["type"]
    if kind == "value_error":
        return error_code(mistake["ctx"]["error"])
    return _CODES.get(kind, "wrong-type" if kind.endswith("_type") else "invalid-value")


def _contradictions(instance: Any) -> Iterator[Any]:
    """Yield what contradicts itself in a section, and in those within it."""
    yield from getattr(instance, "contradictions", tuple)()
    for name, field in (
        type(instance).model_fields.items() if isinstance(instance, BaseModel) else ()
    ):
        inner = getattr(instance, name)
        for location, message, *related in _contradictions(inner):
            yield (field.alias or name, *location), message, *related


def _validate_without(
    model: type[M], raw: Mapping[str, Any], invalid_keys: set[str], context: dict[str, object]
) -> M | None:
    """Return a section without its wrong keys, with required ones as in their examples."""
    examples = {
        field.alias or name: (field.examples or [None])[0]
        for name, field in model.model_fields.items()
        if field.is_required()
    }
    valid = {key: example for key, example in examples.items() if key in invalid_keys}
    valid |= {key: value for key, value in raw.items() if key not in invalid_keys}
    try:
        return model.model_validate(valid, context=context)
    except ValidationError:
        return None


def _deduplicate(mistakes: Iterable[Any]) -> Iterator[tuple[KeyPath, Any]]:
    """Yield the mistakes with their places; those of a value with alternative types as one.

    If one of these types fits except for a mistake within, report that mistake.
    """
    errors_by_path: dict[KeyPath, list[Any]] = {}
    for mistake in mistakes:
        if mistake["type"] == "is_instance_of":
            continue  # what no document can hold
        loc = mistake["loc"]
        split = next((i for i, part in enumerate(loc) if _is_type(part)), len(loc))
        errors_by_path.setdefault(loc[:split], []).append(
            {**mistake, "loc": loc[:split] + loc[split + 1 :]}
        )
    for place, errors in errors_by_path.items():
        nested = [error for error in errors if error["loc"] != place]
        reported = nested or [error for error in errors if not error["type"].endswith("_type")]
        if nested:
            yield from _deduplicate(nested)
        elif reported or len(errors) == 1:
            yield place, (reported or errors)[0]
        else:
            *types, last_type = (
                _PLAIN_MESSAGES[error["type"]].partition("must be ")[2] for error in errors
            )
            yield place, {"type": "", "msg": f"must be {', '.join(types)} or {last_type}"}


def _is_type(part: str | int) -> bool:
    return isinstance(part, str) and _ONE_OF_SEVERAL.fullmatch(part) is not None


def _known_keys(model: type[BaseModel], loc: Sequence[str | int]) -> list[str]:
    """Return the keys of the (nested) model at a place."""
    current: Any = model
    is_user_key = False  # whether the next part is a name that a person gave
    for part in loc:
        if isinstance(part, int) or current is None or is_user_key:
            is_user_key = False
            continue
        fields = current.model_fields
        annotations = {field.alias or name: field.annotation for name, field in fields.items()}
        is_user_key = typing.get_origin(annotations.get(part)) is dict
        current = model_inside(annotations.get(part))
    if current is None:
        return []
    return [field.alias or name for name, field in current.model_fields.items()]


def model_inside(annotation: Any) -> type[BaseModel] | None:
    """Return the model in ``Model``, ``Model | None``, ``tuple[Model, ...]`` and the like."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    for inner in typing.get_args(annotation):
        model = model_inside(inner)
        if model is not None:
            return model
    return None

"""Generate the types of the application's responses for its scripts.

`python docs/answer_types.py` writes ``assets/answers.js`` from the types of
`counterspin.application.answers` and the signatures of the endpoints; a test compares.
"""

import json
import typing
from collections.abc import Sequence
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, NotRequired, Union

from counterspin.application import answers
from counterspin.application.endpoints import ENDPOINTS, ApiResponse

SCRIPT_FILE = Path(answers.__file__).parent / "assets" / "answers.js"

FILE_HEADER = """// @ts-check
// Types of the server's answers. `python docs/answer_types.py` makes this file.
"""

#: Python type -> JSDoc type.
SIMPLE_TYPES = {
    str: "string",
    bool: "boolean",
    int: "number",
    float: "number",
    NoneType: "null",
    Any: "any",
}

#: Origin of a generic type -> template of the JSDoc type, and separator of its arguments.
GENERIC_TYPES = {
    Union: ("{}", " | "),
    UnionType: ("{}", " | "),
    tuple: ("[{}]", ", "),
    dict: ("Record<{}>", ", "),
}


def to_jsdoc_type(annotation: Any) -> str:
    """Return the JSDoc type of an annotation."""
    if annotation in SIMPLE_TYPES or typing.is_typeddict(annotation):
        return SIMPLE_TYPES.get(annotation) or annotation.__name__
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is Literal:
        return " | ".join(map(json.dumps, arguments))
    argument_types = list(map(to_jsdoc_type, arguments))
    if origin in (list, Sequence):
        return f"({argument_types[0]})[]" if "|" in argument_types[0] else f"{argument_types[0]}[]"
    if origin in GENERIC_TYPES:
        template, separator = GENERIC_TYPES[origin]
        return template.format(separator.join(argument_types))
    raise TypeError(f"no JSDoc type for {annotation}")


def format_typedef(answer: type) -> str:
    """Return the JSDoc typedef of a TypedDict."""
    lines = [f" * {line}".rstrip() for line in (answer.__doc__ or "").strip().splitlines()]
    lines.append(" * @typedef {{")
    for name, hint in typing.get_type_hints(answer, include_extras=True).items():
        is_optional = typing.get_origin(hint) is NotRequired
        value_type = typing.get_args(hint)[0] if is_optional else hint
        lines.append(f" *   {name}{'?' * is_optional}: {to_jsdoc_type(value_type)},")
    return "\n".join(["/**", *lines, f" * }}}} {answer.__name__}", " */"])


def format_endpoint_types() -> str:
    """Return the JSDoc typedef of all responses, by method and endpoint name."""
    return_types = {("POST", "session"): answers.SessionKey}
    for key, handler in ENDPOINTS.items():
        return_types[key] = typing.get_type_hints(handler)["return"]
    lines = ["/**", " * Method -> name of an endpoint -> type of its answer.", " * @typedef {{"]
    for method in dict.fromkeys(method for method, _ in return_types):
        lines.append(f" *   {method}: {{")
        lines += [
            f' *     "{name}": {to_jsdoc_type(answer)},'
            for (endpoint_method, name), answer in return_types.items()
            if endpoint_method == method and answer is not ApiResponse
        ]
        lines.append(" *   },")
    return "\n".join([*lines, " * }} Answers", " */"])


def format_script() -> str:
    """Return the text of ``assets/answers.js``."""
    answer_classes = [answer for answer in vars(answers).values() if typing.is_typeddict(answer)]
    typedefs = [
        format_typedef(answer) for answer in answer_classes if answer.__module__ == answers.__name__
    ]
    return (
        "\n\n".join([FILE_HEADER.rstrip(), *typedefs, format_endpoint_types(), "export {};"]) + "\n"
    )


if __name__ == "__main__":
    SCRIPT_FILE.write_text(format_script(), encoding="utf-8")

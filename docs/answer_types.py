"""Make the types of the application's answers for its scripts.

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

FILE = Path(answers.__file__).parent / "assets" / "answers.js"

HEAD = """// @ts-check
// Types of the server's answers. `python docs/answer_types.py` makes this file.
"""

#: Python type -> type of a script.
SIMPLE = {
    str: "string",
    bool: "boolean",
    int: "number",
    float: "number",
    NoneType: "null",
    Any: "any",
}

#: Origin of a generic type -> form of the script's type, and separator of its parts.
FORMS = {
    Union: ("{}", " | "),
    UnionType: ("{}", " | "),
    tuple: ("[{}]", ", "),
    dict: ("Record<{}>", ", "),
}


def script_type(annotation: Any) -> str:
    """Return the type of a value as a script states it."""
    if annotation in SIMPLE or typing.is_typeddict(annotation):
        return SIMPLE.get(annotation) or annotation.__name__
    origin, parts = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is Literal:
        return " | ".join(map(json.dumps, parts))
    inner = list(map(script_type, parts))
    if origin in (list, Sequence):
        return f"({inner[0]})[]" if "|" in inner[0] else f"{inner[0]}[]"
    if origin in FORMS:
        form, separator = FORMS[origin]
        return form.format(separator.join(inner))
    raise TypeError(f"no type of a script for {annotation}")


def typedef(answer: type) -> str:
    """Return the type of a class as a JSDoc comment."""
    lines = [f" * {line}".rstrip() for line in (answer.__doc__ or "").strip().splitlines()]
    lines.append(" * @typedef {{")
    for name, hint in typing.get_type_hints(answer, include_extras=True).items():
        optional = typing.get_origin(hint) is NotRequired
        value = typing.get_args(hint)[0] if optional else hint
        lines.append(f" *   {name}{'?' * optional}: {script_type(value)},")
    return "\n".join(["/**", *lines, f" * }}}} {answer.__name__}", " */"])


def endpoint_types() -> str:
    """Return the type of the answer of each endpoint, by method and name."""
    returned = {("POST", "session"): answers.SessionKey}
    for key, handler in ENDPOINTS.items():
        returned[key] = typing.get_type_hints(handler)["return"]
    lines = ["/**", " * Method -> name of an endpoint -> type of its answer.", " * @typedef {{"]
    for method in dict.fromkeys(method for method, _ in returned):
        lines.append(f" *   {method}: {{")
        lines += [
            f' *     "{name}": {script_type(answer)},'
            for (of, name), answer in returned.items()
            if of == method and answer is not ApiResponse
        ]
        lines.append(" *   },")
    return "\n".join([*lines, " * }} Answers", " */"])


def script() -> str:
    """Return the text of ``assets/answers.js``."""
    named = [answer for answer in vars(answers).values() if typing.is_typeddict(answer)]
    typedefs = [typedef(answer) for answer in named if answer.__module__ == answers.__name__]
    return "\n\n".join([HEAD.rstrip(), *typedefs, endpoint_types(), "export {};"]) + "\n"


if __name__ == "__main__":
    FILE.write_text(script(), encoding="utf-8")

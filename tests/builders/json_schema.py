"""A validator of the JSON Schema (2020-12) keywords that the package's schemas use."""

import datetime
import re

#: Words that say something of a value and check nothing.
ANNOTATIONS = {
    *("$schema", "$id", "$defs", "title", "description", "examples", "default", "format"),
    *("x-unit", "then", "else"),
}
TYPES = {
    "object": dict,
    "array": list,
    "string": str | datetime.date,  # TOML has dates, JSON their text
    "integer": int,
    "number": int | float,
    "boolean": bool,
    "null": type(None),
}


def mistakes(schema, value, path="", root=None):
    """Yield the violations of a schema by a value."""
    root = schema if root is None else root
    if schema is True or schema is False:
        if not schema:
            yield f"{path}: may not stand here"
        return
    for word, said in schema.items():
        if word not in ANNOTATIONS:
            yield from WORDS[word](said, value, path, root, schema)


def _reference(said, value, path, root, _):
    inside = root
    for part in said.removeprefix("#/").split("/"):
        inside = inside[part]
    yield from mistakes(inside, value, path, root)


def _type(said, value, path, *_):
    fits = isinstance(value, TYPES[said]) and (said == "boolean" or not isinstance(value, bool))
    if not fits:
        yield f"{path}: {value!r} is no {said}"


def _properties(said, value, path, root, _):
    for key in said.keys() & value.keys() if isinstance(value, dict) else ():
        yield from mistakes(said[key], value[key], f"{path}.{key}", root)


def _others(said, value, path, root, schema):
    others = value.keys() - schema.get("properties", {}).keys() if isinstance(value, dict) else ()
    for key in others:
        yield from mistakes(said, value[key], f"{path}.{key}", root)


def _items(said, value, path, root, _):
    for place, inner in enumerate(value if isinstance(value, list) else ()):
        yield from mistakes(said, inner, f"{path}[{place}]", root)


def _prefix(said, value, path, root, _):
    for place, (one, inner) in enumerate(zip(said, value, strict=False)):
        yield from mistakes(one, inner, f"{path}[{place}]", root)


def _any_of(said, value, path, root, _):
    found = [list(mistakes(one, value, path, root)) for one in said]
    if all(found):
        yield f"{path}: is nothing of what may stand here: {min(found, key=len)[0]}"


def _if(said, value, path, root, schema):
    branch = "else" if any(mistakes(said, value, path, root)) else "then"
    yield from mistakes(schema.get(branch, True), value, path, root)


def _check(test, kind):
    def check(said, value, path, *_):
        if isinstance(value, kind) and not test(value, said):
            yield f"{path}: {value!r} against {said!r}"

    return check


def _always(test):
    return _check(test, object)


WORDS = {
    "$ref": _reference,
    "type": _type,
    "properties": _properties,
    "additionalProperties": _others,
    "items": _items,
    "prefixItems": _prefix,
    "anyOf": _any_of,
    "if": _if,
    "enum": _always(lambda value, said: value in said),
    "const": _always(lambda value, said: value == said and type(value) is type(said)),
    "required": _check(lambda value, said: set(said) <= set(value), dict),
    "minProperties": _check(lambda value, said: len(value) >= said, dict),
    "minItems": _check(lambda value, said: len(value) >= said, list),
    "maxItems": _check(lambda value, said: len(value) <= said, list),
    "minLength": _check(lambda value, said: len(value) >= said, str),
    "pattern": _check(lambda value, said: re.search(said, value) is not None, str),
    "minimum": _check(lambda value, said: value >= said, int | float),
    "maximum": _check(lambda value, said: value <= said, int | float),
    "exclusiveMinimum": _check(lambda value, said: value > said, int | float),
}

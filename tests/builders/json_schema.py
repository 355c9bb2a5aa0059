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


def find_violations(schema, value, path="", root=None):
    """Yield the violations of a schema by a value."""
    root = schema if root is None else root
    if schema is True or schema is False:
        if not schema:
            yield f"{path}: may not stand here"
        return
    for keyword, constraint in schema.items():
        if keyword not in ANNOTATIONS:
            yield from KEYWORDS[keyword](constraint, value, path, root, schema)


def _reference(reference, value, path, root, _):
    subschema = root
    for part in reference.removeprefix("#/").split("/"):
        subschema = subschema[part]
    yield from find_violations(subschema, value, path, root)


def _type(type_name, value, path, *_):
    is_valid = isinstance(value, TYPES[type_name]) and (
        type_name == "boolean" or not isinstance(value, bool)
    )
    if not is_valid:
        yield f"{path}: {value!r} is no {type_name}"


def _properties(schemas, value, path, root, _):
    for key in schemas.keys() & value.keys() if isinstance(value, dict) else ():
        yield from find_violations(schemas[key], value[key], f"{path}.{key}", root)


def _additional_properties(subschema, value, path, root, schema):
    keys = value.keys() - schema.get("properties", {}).keys() if isinstance(value, dict) else ()
    for key in keys:
        yield from find_violations(subschema, value[key], f"{path}.{key}", root)


def _items(subschema, value, path, root, _):
    for index, item in enumerate(value if isinstance(value, list) else ()):
        yield from find_violations(subschema, item, f"{path}[{index}]", root)


def _prefix(schemas, value, path, root, _):
    for index, (subschema, item) in enumerate(zip(schemas, value, strict=False)):
        yield from find_violations(subschema, item, f"{path}[{index}]", root)


def _any_of(schemas, value, path, root, _):
    violations = [list(find_violations(subschema, value, path, root)) for subschema in schemas]
    if all(violations):
        yield f"{path}: is nothing of what may stand here: {min(violations, key=len)[0]}"


def _if(condition, value, path, root, schema):
    branch = "else" if any(find_violations(condition, value, path, root)) else "then"
    yield from find_violations(schema.get(branch, True), value, path, root)


def _check(test, value_type):
    def check(constraint, value, path, *_):
        if isinstance(value, value_type) and not test(value, constraint):
            yield f"{path}: {value!r} against {constraint!r}"

    return check


def _always(test):
    return _check(test, object)


KEYWORDS = {
    "$ref": _reference,
    "type": _type,
    "properties": _properties,
    "additionalProperties": _additional_properties,
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

"""The parts of the reference that the code itself says: its commands and its public names.

A page has them where it says ``<!-- made from the code: commands -->``, ``... public names -->``,
``... parts -->`` or ``... coverage -->``. Groups and order of the names are those of the package's
docstring, and what their objects are made of follows from the types that these state: no name is
written twice.

- `filled`: a page with what the code says in its place
- `groups`, `parts`: the public names, and the classes of which their objects are made
- `own_words`: names of types that annotations use
"""

import inspect
import pkgutil
import re
from collections.abc import Iterator
from functools import cache
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from types import ModuleType
from typing import Any

from pydantic import BaseModel

import counterspin

_PLACE = re.compile(r"^<!-- made from the code: (.+) -->$", re.MULTILINE)


# Commands


def commands() -> str:
    """Return all commands and their options as Markdown, as `counterspin --help` has them."""
    from counterspin.cli import app

    page = app.generate_docs(output_format="markdown")
    page = page[page.index("\n## counterspin ") :]
    page = re.sub(r"(?<=\w) -m [\w.]+", "", page)  # it names the program that runs: Sphinx
    return re.sub(r"^\*\*(Arguments|Parameters|Commands)\*\*:", r"\1", page, flags=re.MULTILINE)


# Public names


def groups() -> dict[str, list[str]]:
    """Return heading -> public names, as the package's docstring has them, and what is left."""
    words = (counterspin.__doc__ or "").partition("\nGlossary")[0]
    public = set(counterspin.__all__)
    found: dict[str, list[str]] = {}
    parts = re.split(r"\n\n", words)
    for before, bullets in pairwise(parts):
        if bullets.startswith("- "):
            names = [n for n in re.findall(r"`(\w+)`", bullets) if n in public]
            found[before.strip().rstrip(":")] = list(dict.fromkeys(names))
    listed = {name for names in found.values() for name in names}
    left = sorted(public - listed)
    mistakes = [name for name in left if name.endswith(("Error", "Warning"))]
    found["Mistakes"] = mistakes
    found["More"] = [name for name in left if name not in mistakes]
    return {heading: names for heading, names in found.items() if names}


@cache
def _modules() -> list[ModuleType]:
    found = pkgutil.walk_packages(counterspin.__path__, "counterspin.")
    return [import_module(module.name) for module in found if "__main__" not in module.name]


@cache
def own_words() -> set[str]:
    """Return names of types that annotations use and no page tells: aliases, inner classes."""
    return {name for module in _modules() for name in vars(module)}


def _classes() -> dict[str, type]:
    """Return the classes of the package by name; a name has one meaning in it."""
    return {
        name: value
        for module in _modules()
        for name, value in vars(module).items()
        if inspect.isclass(value) and value.__module__ == module.__name__
    }


def _annotations(value: object) -> Iterator[Any]:
    """Yield the types of what an object offers: attributes, properties, what calls return."""
    if inspect.isfunction(value):
        yield value.__annotations__.get("return")
    if not inspect.isclass(value):
        return
    if issubclass(value, BaseModel):
        yield from (field.annotation for field in value.model_fields.values())
    for base in value.__mro__:
        if base.__module__.startswith("counterspin."):
            own = getattr(base, "__annotations__", {})
            yield from (kind for name, kind in own.items() if not name.startswith("_"))
            for name, member in vars(base).items():
                if not name.startswith("_"):
                    if isinstance(member, property):
                        yield from _annotations(member.fget)
                    inner = getattr(member, "__func__", None) or getattr(member, "func", None)
                    yield from _annotations(inner or member if inner is not value else None)


def parts() -> list[type]:
    """Return the classes, not public themselves, of which the public names' objects are made."""
    classes = _classes()
    todo = [getattr(counterspin, name) for name in counterspin.__all__]
    seen, found = {id(value) for value in todo}, []
    while todo:
        for kind in _annotations(todo.pop(0)):
            for name in re.findall(r"\w+", getattr(kind, "__name__", "") + str(kind)):
                part = classes.get(name)
                if part and not name.startswith("_") and id(part) not in seen:
                    seen.add(id(part))
                    found.append(part)
                    todo.append(part)
    return found


def _directive(name: str, value: object) -> str:
    """Return the directive that documents an object."""
    if inspect.isclass(value):
        options = "   :members:\n   :inherited-members: BaseModel, tuple\n"
        if issubclass(value, BaseException):
            options = "   :show-inheritance:\n"
        elif issubclass(value, BaseModel):
            options += "   :exclude-members: model_config, model_post_init\n"
        return f".. autoclass:: {name}\n{options}"
    if callable(value):
        return f".. autofunction:: {name}\n"
    return f".. autodata:: {name}\n   :no-value:\n"


def _section(heading: str, named: dict[str, object]) -> str:
    listed = "\n".join(_directive(name, value) for name, value in named.items())
    return f"## {heading}\n\n```{{eval-rst}}\n{listed}\n```\n"


def public_names() -> str:
    """Return the reference of all public names."""
    return "\n".join(
        _section(heading, {f"counterspin.{name}": getattr(counterspin, name) for name in names})
        for heading, names in groups().items()
    )


def parts_of_objects() -> str:
    """Return the reference of what their objects are made of, by room of the package."""
    rooms: dict[str, dict[str, object]] = {}
    for part in parts():
        room = part.__module__.split(".")[1]
        rooms.setdefault(room, {})[f"{part.__module__}.{part.__qualname__}"] = part
    return "\n".join(_section(f"counterspin.{room}", rooms[room]) for room in sorted(rooms))


def coverage() -> str:
    """Return the tables of how often intervals hold, as the page on methods has them."""
    page = (Path(__file__).parents[1] / "methods.md").read_text(encoding="utf-8")
    return "\n".join(re.findall(r"^<!-- \w*coverage -->\n(.*?)^<!-- /", page, re.M | re.DOTALL))


_MADE = {
    "commands": commands,
    "public names": public_names,
    "parts": parts_of_objects,
    "coverage": coverage,
}


def filled(page: str) -> str:
    """Return a page with what the code says where it asks for it."""
    return _PLACE.sub(lambda place: _MADE[place[1]](), page)

"""Sections of the reference that are generated from the code: commands and public names.

The comments ``<!-- made from the code: commands -->``, ``... public names -->``, ``... parts -->``
and ``... coverage -->`` of a page are replaced by these sections. The package's docstring defines
the groups and the order of the names; the classes used by public objects follow from their type
annotations.

- `filled`: page with its generated sections
- `groups`, `parts`: public names, and the classes that public objects consist of
- `type_names`: names of types that annotations use
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

_PLACEHOLDER = re.compile(r"^<!-- made from the code: (.+) -->$", re.MULTILINE)


# Commands


def commands() -> str:
    """Return all commands and their options as Markdown, as `counterspin --help` has them."""
    from counterspin.cli import app

    page = app.generate_docs(output_format="markdown")
    page = page[page.index("\n## counterspin ") :]
    page = re.sub(r"(?<=\w) -m [\w.]+", "", page)  # name of the running program, Sphinx
    return re.sub(r"^\*\*(Arguments|Parameters|Commands)\*\*:", r"\1", page, flags=re.MULTILINE)


# Public names


def groups() -> dict[str, list[str]]:
    """Return the public names by heading of the package's docstring; the others come last."""
    overview = (counterspin.__doc__ or "").partition("\nGlossary")[0]
    public = set(counterspin.__all__)
    names_by_heading: dict[str, list[str]] = {}
    paragraphs = re.split(r"\n\n", overview)
    for heading, bullets in pairwise(paragraphs):
        if bullets.startswith("- "):
            names = [n for n in re.findall(r"`(\w+)`", bullets) if n in public]
            names_by_heading[heading.strip().rstrip(":")] = list(dict.fromkeys(names))
    listed = {name for names in names_by_heading.values() for name in names}
    unlisted = sorted(public - listed)
    errors = [name for name in unlisted if name.endswith(("Error", "Warning"))]
    names_by_heading["Errors and warnings"] = errors
    names_by_heading["Other names"] = [name for name in unlisted if name not in errors]
    return {heading: names for heading, names in names_by_heading.items() if names}


@cache
def _modules() -> list[ModuleType]:
    modules = pkgutil.walk_packages(counterspin.__path__, "counterspin.")
    return [import_module(module.name) for module in modules if "__main__" not in module.name]


@cache
def type_names() -> set[str]:
    """Return the names of types that annotations use: classes, aliases, inner classes."""
    return {name for module in _modules() for name in vars(module)}


def _classes() -> dict[str, type]:
    """Return the classes of the package by name; class names are unique."""
    return {
        name: value
        for module in _modules()
        for name, value in vars(module).items()
        if inspect.isclass(value) and value.__module__ == module.__name__
    }


def _annotations(value: object) -> Iterator[Any]:
    """Yield the types of the attributes, properties and return values of an object."""
    if inspect.isfunction(value):
        yield value.__annotations__.get("return")
    if not inspect.isclass(value):
        return
    if issubclass(value, BaseModel):
        yield from (field.annotation for field in value.model_fields.values())
    for base in value.__mro__:
        if base.__module__.startswith("counterspin."):
            annotations = getattr(base, "__annotations__", {})
            yield from (hint for name, hint in annotations.items() if not name.startswith("_"))
            for name, member in vars(base).items():
                if not name.startswith("_"):
                    if isinstance(member, property):
                        yield from _annotations(member.fget)
                    wrapped = getattr(member, "__func__", None) or getattr(member, "func", None)
                    yield from _annotations(wrapped or member if wrapped is not value else None)


def parts() -> list[type]:
    """Return the non-public classes that public objects consist of."""
    classes = _classes()
    queue = [getattr(counterspin, name) for name in counterspin.__all__]
    visited, non_public = {id(value) for value in queue}, []
    while queue:
        for hint in _annotations(queue.pop(0)):
            for name in re.findall(r"\w+", getattr(hint, "__name__", "") + str(hint)):
                cls = classes.get(name)
                if cls and not name.startswith("_") and id(cls) not in visited:
                    visited.add(id(cls))
                    non_public.append(cls)
                    queue.append(cls)
    return non_public


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
    """Return the reference of the classes that public objects consist of, by package."""
    packages: dict[str, dict[str, object]] = {}
    for cls in parts():
        package = cls.__module__.split(".")[1]
        packages.setdefault(package, {})[f"{cls.__module__}.{cls.__qualname__}"] = cls
    return "\n".join(_section(f"counterspin.{name}", packages[name]) for name in sorted(packages))


def coverage() -> str:
    """Return the coverage tables of the page on methods."""
    page = (Path(__file__).parents[1] / "methods.md").read_text(encoding="utf-8")
    return "\n".join(re.findall(r"^<!-- \w*coverage -->\n(.*?)^<!-- /", page, re.M | re.DOTALL))


_GENERATORS = {
    "commands": commands,
    "public names": public_names,
    "parts": parts_of_objects,
    "coverage": coverage,
}


def filled(page: str) -> str:
    """Return a page with generated sections in place of its comments."""
    return _PLACEHOLDER.sub(lambda placeholder: _GENERATORS[placeholder[1]](), page)

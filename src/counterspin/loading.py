"""Lazy import of functions and classes by name."""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from typing import Any


def load_name(name: str) -> Any:
    """Import the module of ``package.module:name`` and return the object."""
    module, _, attribute = name.partition(":")
    return getattr(import_module(module), attribute)


def is_installed(name: str) -> bool:
    """Return whether the module of ``package.module:name`` exists."""
    try:
        return find_spec(name.partition(":")[0]) is not None
    except ModuleNotFoundError:  # the package is missing
        return False

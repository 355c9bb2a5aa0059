"""Names of functions and classes that are imported when they are used."""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from typing import Any


def load_name(name: str) -> Any:
    """Return the object ``package.module:name``; its module is imported on the call."""
    module, _, attribute = name.partition(":")
    return getattr(import_module(module), attribute)


def is_installed(name: str) -> bool:
    """Return whether the module of ``package.module:name`` exists."""
    try:
        return find_spec(name.partition(":")[0]) is not None
    except ModuleNotFoundError:  # its package
        return False

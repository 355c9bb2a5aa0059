"""Definition of a fuzzed format."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from random import Random


@dataclass(frozen=True)
class Format:
    """A file format: how to draw a case, and how to read it.

    Attributes
    ----------
    suffix
        Suffix of the file name.
    draw
        Function that draws the content of a file.
    read
        Function that reads a file; it must raise nothing but CounterspinError.
    """

    suffix: str
    draw: Callable[[Random], bytes]
    read: Callable[[Path], object]

"""A format and its reader, as the hunt tries it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from random import Random


@dataclass(frozen=True)
class Format:
    """A format and its reader.

    Attributes
    ----------
    suffix
        Of the file's name.
    make
        Draws a file's content.
    use
        Reads the file; raises a CounterspinError or nothing.
    """

    suffix: str
    make: Callable[[Random], bytes]
    use: Callable[[Path], object]

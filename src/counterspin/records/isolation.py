"""Choice of the files that the reader's process reads; see `reader_process`.

The readers of Parquet, HDF5, MATLAB and Excel files are native code, which a flipped bit can crash.
Text can do no harm, so that the calling process reads it.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

from counterspin.loading import load_name
from counterspin.records.format_registry import RECORD_FORMATS

if TYPE_CHECKING:
    from counterspin.records.memory import MemoryTable

R = TypeVar("R")

#: The functions that start the reader's process and ask it: loaded for the first file that is read
#: there.
PREPARE: Final = "counterspin.records.reader_process:prepare"
ASK: Final = "counterspin.records.reader_process:run_in_reader"

#: Endings of the formats that are read by native code -> the libraries.
NATIVE: Final = {
    **{ending: form.libraries for ending, form in RECORD_FORMATS.items() if form.libraries},
    ".pdf": ("pypdf",),
}


def run_isolated(function: Callable[..., R], path: Path | MemoryTable, *args: Any) -> R:
    """Return ``function(path, *args)``, called in the reader's process if the format needs it."""
    if not uses_reader_process(path):
        return function(path, *args)
    reply = load_name(ASK)(function, path, *args)
    if isinstance(reply, BaseException):
        raise reply
    if reply is None:  # the process cannot be started
        return function(path, *args)
    value: R = reply[0]
    return value


def uses_reader_process(path: Path | MemoryTable) -> bool:
    """Return whether a file is read in the reader process because of its format."""
    return isinstance(path, Path) and path.suffix.lower() in NATIVE


def prepare(path: Path) -> None:
    """Start the reader's process, if a file is read there and it does not run; wait for nothing."""
    if uses_reader_process(path):
        load_name(PREPARE)(path.suffix.lower())

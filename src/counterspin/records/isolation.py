"""Choice of the files that the reader process reads; see `reader_process`.

The readers of Parquet, HDF5, MATLAB and Excel files are native code, which a damaged file can
crash. The calling process reads text files itself.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

from counterspin.loading import load_name
from counterspin.records.format_registry import RECORD_FORMATS

if TYPE_CHECKING:
    from counterspin.records.memory import MemoryTable

ResultT = TypeVar("ResultT")

#: Functions that start the reader process and call a function in it; loaded on demand.
PREPARE_READER: Final = "counterspin.records.reader_process:prepare"
RUN_IN_READER: Final = "counterspin.records.reader_process:run_in_reader"

#: File extension of a format that is read by native code -> libraries.
NATIVE_LIBRARIES: Final = {
    **{
        ending: record_format.libraries
        for ending, record_format in RECORD_FORMATS.items()
        if record_format.libraries
    },
    ".pdf": ("pypdf",),
}


def run_isolated(function: Callable[..., ResultT], path: Path | MemoryTable, *args: Any) -> ResultT:
    """Return ``function(path, *args)``, called in the reader process if the format requires it."""
    if not uses_reader_process(path):
        return function(path, *args)
    reply = load_name(RUN_IN_READER)(function, path, *args)
    if isinstance(reply, BaseException):
        raise reply
    if reply is None:  # the process cannot be started
        return function(path, *args)
    value: ResultT = reply[0]
    return value


def uses_reader_process(path: Path | MemoryTable) -> bool:
    """Return whether the format of a file requires the reader process."""
    return isinstance(path, Path) and path.suffix.lower() in NATIVE_LIBRARIES


def prepare_reader(path: Path) -> None:
    """Start the reader process, if the file requires it, without waiting."""
    if uses_reader_process(path):
        load_name(PREPARE_READER)(path.suffix.lower())

"""Choice of the files that the reader's process reads; see `reader_process`.

The readers of Parquet, HDF5, MATLAB and Excel files are native code, which a flipped bit can crash.
Text can do no harm and is read here; but where it is long, and little comes back, the process at
hand loads what it needs next while another one reads.
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
#: Text of so many bytes takes longer to read than the reader's process takes to start.
_LONG_TEXT_BYTES: Final = 1 << 24


def run_isolated(function: Callable[..., R], path: Path | MemoryTable, *args: Any) -> R:
    """Return ``function(path, *args)``, called where it can do no harm."""
    if isinstance(path, Path) and path.suffix.lower() in NATIVE:
        return _run_isolated(function, path, *args)
    return function(path, *args)


def run_isolated_if_slow(function: Callable[..., R], path: Path | MemoryTable, *args: Any) -> R:
    """Return ``function(path, *args)``, small; as `run_isolated`, for long text too."""
    return (
        _run_isolated(function, path, *args) if uses_reader_process(path) else function(path, *args)
    )


def uses_reader_process(path: Path | MemoryTable) -> bool:
    """Return True if the format or the length of a file calls for the reader's process."""
    if not isinstance(path, Path):
        return False
    try:
        return path.suffix.lower() in NATIVE or path.stat().st_size >= _LONG_TEXT_BYTES
    except (OSError, ValueError):
        return False  # reading says what is wrong


def prepare(path: Path) -> None:
    """Start the reader's process, if a file is read there and it does not run; wait for nothing."""
    if uses_reader_process(path):
        load_name(PREPARE)(path.suffix.lower())


def _run_isolated(function: Callable[..., R], path: Path | MemoryTable, *args: Any) -> R:
    reply = load_name(ASK)(function, path, *args)
    if isinstance(reply, BaseException):
        raise reply
    if reply is None:
        return function(path, *args)
    value: R = reply[0]
    return value

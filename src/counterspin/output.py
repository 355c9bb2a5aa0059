"""Files that appear whole or not at all.

- `write_whole`: one file
- `write_text`: one file of text
- `make_folder`: where they go
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable
from pathlib import Path

from counterspin.errors import CounterspinError


def make_folder(folder: Path) -> None:
    """Make a folder, and those above it, where it is not there; CounterspinError if it cannot."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise CounterspinError(f"{folder}: cannot be made ({error.strerror})") from error


def write_whole(path: Path, write: Callable[[Path], object]) -> None:
    """Write a file under a temporary name beside its place, then move it there.

    A link keeps standing, and what it leads to is replaced; a device or a pipe such as
    ``/dev/stdout`` is written to.

    Parameters
    ----------
    path
        Where the file is to be; its folder must exist.
    write
        Writes the file under the name it is given, which has the same ending.

    Raises
    ------
    CounterspinError
        If the file cannot be written; nothing is left behind then.
    """
    place = path.resolve()
    stream = place.exists() and not (place.is_file() or place.is_dir())
    try:
        handle, name = tempfile.mkstemp(
            suffix=path.suffix, prefix=".", dir=None if stream else place.parent
        )
    except OSError as error:
        raise CounterspinError(_refusal(path, error)) from error
    os.close(handle)
    part = Path(name)
    try:
        write(part)
        if stream:
            place.write_bytes(part.read_bytes())
            return
        # mkstemp makes files for the owner only; a result is an ordinary file.
        mask = os.umask(0)
        os.umask(mask)
        part.chmod(0o666 & ~mask)
        part.replace(place)
    except OSError as error:
        raise CounterspinError(_refusal(path, error)) from error
    finally:
        part.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write text as UTF-8, whole or not at all; raises as `write_whole` does."""
    write_whole(path, lambda part: part.write_text(text, encoding="utf-8"))


def _refusal(path: Path, error: OSError) -> str:
    if path.is_dir():
        return f"{path}: cannot be written, being a folder; give the name of a file"
    reason = error.strerror or str(error)
    return f"{path}: cannot be written ({reason}); choose another place or free this one"

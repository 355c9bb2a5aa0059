"""Temporary folders, and removal of those that killed processes left behind."""

from __future__ import annotations

import os
import re
import shutil
import stat
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final

#: A file in each temporary folder that its process keeps open and locked.
_LOCK_NAME: Final = ".lock"

#: A process locks the file at once; a file of this age without a lock is abandoned, s.
_MAX_UNLOCKED_AGE: Final = 60.0

#: Suffix that `tempfile` appends to a prefix.
_RANDOM_SUFFIX: Final = "[a-z0-9_]{8}"


@contextmanager
def temporary_folder(prefix: str, parent: Path | None = None) -> Iterator[Path]:
    """Make a temporary folder and remove it at the end.

    Folders with the same prefix that killed processes left behind are removed first.

    parent: Parent folder; None: the system's folder for temporary files.
    """
    parent = parent or Path(tempfile.gettempdir())
    remove_abandoned_folders(prefix, parent)
    with tempfile.TemporaryDirectory(prefix=prefix, dir=parent) as name:
        folder = Path(name)
        with (folder / _LOCK_NAME).open("wb") as file:
            with suppress(OSError):  # a file system without locks
                _lock_file(file.fileno())
            yield folder


def remove_abandoned_folders(prefix: str, parent: Path) -> None:
    """Remove the temporary folders with a prefix whose processes have ended without doing so.

    A folder is removed only if `temporary_folder` made it for this user. A folder that cannot be
    removed is kept.
    """
    with suppress(OSError):
        for folder in list(parent.iterdir()):
            if re.fullmatch(re.escape(prefix) + _RANDOM_SUFFIX, folder.name):
                with suppress(OSError):
                    _remove_if_abandoned(folder)


def _remove_if_abandoned(folder: Path) -> None:
    """Remove a folder; OSError if another process uses it."""
    folder_status, lock_file = folder.lstat(), folder / _LOCK_NAME
    lock_status = lock_file.lstat()
    has_same_owner = (
        sys.platform == "win32" or folder_status.st_uid == lock_status.st_uid == os.getuid()
    )
    is_old = time.time() > lock_status.st_mtime + _MAX_UNLOCKED_AGE
    if not (
        has_same_owner
        and is_old
        and stat.S_ISDIR(folder_status.st_mode)
        and stat.S_ISREG(lock_status.st_mode)
    ):
        return
    with lock_file.open("rb") as file:
        _lock_file(file.fileno())
    lock_file.unlink()  # Windows refuses this while a process has the file open
    shutil.rmtree(folder, ignore_errors=True)


def _lock_file(file: int) -> None:
    """Lock a file; OSError if another process has locked it. On Windows, an open file suffices."""
    if sys.platform != "win32":
        import fcntl

        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)

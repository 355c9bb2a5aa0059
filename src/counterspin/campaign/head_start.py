"""What a calibration begins before anything else is loaded: checksums, and the reader's process.

Both take another core, which is idle while one process loads what the command line and the
description need.

- `head_start`: begins with the campaign that a command line names
- `checksums_of`: those that were begun, or begun now
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from counterspin.campaign.checksums import Checksums
from counterspin.records.isolation import prepare

#: The campaign that was begun with and is not asked for yet, as it was named.
_BEGUN: dict[Path, Checksums] = {}


@contextmanager
def head_start(words: Sequence[str]) -> Iterator[None]:
    """Begin with the campaign that the words of a command line name; give up what is left.

    Parameters
    ----------
    words
        Such as ``["calibrate", "FOLDER", "--json", "FILE"]``. Where they are others, or name
        several campaigns, nothing is begun, and what is wrong with them is for others to say.
    """
    named = words[1:2] if words[:1] == ["calibrate"] else []
    alone = all(word.startswith("-") for word in words[2:3])
    if not named or named[0].startswith("-") or not alone:
        yield
        return
    with Checksums() as checksums:
        _begin(checksums, named[0])
        _BEGUN[Path(named[0])] = checksums
        try:
            yield
        finally:
            _BEGUN.clear()


@contextmanager
def checksums_of(where: object) -> Iterator[Checksums]:
    """Return a campaign's checksums, with its files begun.

    Parameters
    ----------
    where
        The campaign's folder or its description; of a campaign already read nothing is begun.
    """
    named = Path(where) if isinstance(where, Path | str) else None
    if named is not None and named in _BEGUN:
        yield _BEGUN.pop(named)
        return
    with Checksums() as checksums:
        if named is not None:
            _begin(checksums, named)
        yield checksums


def _begin(checksums: Checksums, where: Path | str) -> None:
    for record in checksums.expect(where):
        prepare(record)

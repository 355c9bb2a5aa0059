"""Which three columns of a file may be the three axes of one sensor, by names and order."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import Final

from counterspin.exports.looking import FileColumn

Three = tuple[FileColumn, FileColumn, FileColumn]

#: Names of what a filter made of a sensor's rows: gravity's direction, which fits any sphere.
_OF_FILTER: Final = re.compile(r"(?i).*grav")


def threes(columns: Sequence[FileColumn]) -> Iterator[Three]:
    """Yield columns that may be axes X, Y and Z of a sensor, the likeliest first.

    Names that differ in these letters alone belong together, in the order of the letters, wherever
    they stand; other columns do if they follow one another.
    """
    named = _named(columns)
    yield from sorted(named, key=lambda three: bool(_OF_FILTER.match(three[0].name)))
    taken = {column.name for three in named for column in three}
    others = [column for column in columns if column.name not in taken]
    yield from zip(others, others[1:], others[2:], strict=False)


def _named(columns: Sequence[FileColumn]) -> list[Three]:
    """Return columns whose names differ in the letters x, y and z alone, in order of the file."""
    alike: dict[tuple[str, str, bool], dict[str, FileColumn]] = {}
    for column in columns:
        for letter in re.finditer("(?i)[xyz]", column.name):
            before, behind = column.name[: letter.start()], column.name[letter.end() :]
            family = alike.setdefault((before, behind, letter[0].isupper()), {})
            family[letter[0].lower()] = column
    return [(own["x"], own["y"], own["z"]) for own in alike.values() if len(own) == len("xyz")]

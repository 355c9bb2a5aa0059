"""Words that several commands share: types of their options, paths as a shell takes them.

- `OutputFolder`, `OutputFile`, `JsonFile`: options of the same name and meaning
- `shell_word`: a path as it may be typed into a shell
"""

from __future__ import annotations

from pathlib import Path
from shlex import quote
from typing import Annotated

from cyclopts import Parameter

OutputFolder = Annotated[Path, Parameter(name=["--output", "-o"])]
OutputFile = Annotated[Path | None, Parameter(name=["--output", "-o"])]
JsonFile = Annotated[Path | None, Parameter(name="--json")]


def shell_word(path: Path) -> str:
    """Return a path as it may be typed into a shell, blanks and all."""
    return quote(str(path))

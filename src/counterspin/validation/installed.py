"""What is installed: versions, environment, and whether the package's files are as delivered."""

from __future__ import annotations

import base64
import csv
import hashlib
from importlib import metadata
from pathlib import Path
from typing import Final

from counterspin._version import __version__
from counterspin.results import environment
from counterspin.validation.result import Installation

_PACKAGE: Final = "counterspin"


def installation() -> Installation:
    """Return versions of the package and what it needs, the environment, and its files' state."""
    folder = Path(__file__).parents[1]
    needed, record = dict[str, str](), None
    try:
        delivered = metadata.distribution(_PACKAGE)
    except metadata.PackageNotFoundError:
        delivered = None
    if delivered is not None:
        # An editable installation has other files beside its RECORD than those that are run.
        beside = Path(str(delivered.locate_file(_PACKAGE)))
        if beside.resolve() == folder.resolve():
            record = delivered.read_text("RECORD")
        for requirement in delivered.requires or []:
            if ";" not in requirement:
                name = "".join(c if c.isalnum() or c in "-_." else " " for c in requirement).split()
                needed[name[0]] = _version(name[0])
    files, altered, missing = (
        checked_files(record, folder) if record else (dict[str, str](), list[str](), list[str]())
    )
    own = sorted(path for path in folder.rglob("*") if path.is_file() and _is_own(path))
    digest = hashlib.sha256()
    for path in own:
        digest.update(path.relative_to(folder).as_posix().encode() + b"\0")
        digest.update(hashlib.sha256(path.read_bytes()).digest())
    return Installation(
        version=__version__,
        environment=environment(),
        packages=needed,
        files=len(own),
        checksum=f"sha256:{digest.hexdigest()}",
        recorded=len(files),
        altered=altered,
        missing=missing,
        unknown=_unknown(own, folder, files) if files else [],
    )


def checked_files(record: str, folder: Path) -> tuple[dict[str, str], list[str], list[str]]:
    """Compare the package's files with the hashes of a wheel's RECORD.

    record: Text of RECORD: CSV of path, ``sha256=`` and the hash in base64 for URLs, size.
    """
    files, altered, missing = dict[str, str](), list[str](), list[str]()
    for path, stated, *_ in csv.reader(record.splitlines()):
        inside = Path(path).parts
        if inside[0] != _PACKAGE or not stated:
            continue
        name = Path(*inside[1:]).as_posix()
        files[name] = stated
        algorithm, _, expected = stated.partition("=")
        place = folder / name
        if not place.is_file():
            missing.append(name)
            continue
        found = hashlib.new(algorithm, place.read_bytes()).digest()
        if base64.urlsafe_b64encode(found).rstrip(b"=").decode() != expected:
            altered.append(name)
    return files, altered, missing


def _is_own(path: Path) -> bool:
    return "__pycache__" not in path.parts and path.suffix != ".pyc"


def _unknown(own: list[Path], folder: Path, files: dict[str, str]) -> list[str]:
    return [n for n in (path.relative_to(folder).as_posix() for path in own) if n not in files]


def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "not installed"

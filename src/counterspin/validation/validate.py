"""`counterspin validate`: reference cases run on the installed package, and its files' state."""

from __future__ import annotations

import base64
import csv
import hashlib
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Any, Final

import numpy as np

from counterspin._version import __version__
from counterspin.certificates.schema import load_schema
from counterspin.output import check_writable, make_folder, marked_file_type
from counterspin.results import environment
from counterspin.validation.cases import Case, cases, document
from counterspin.validation.kernels import NotAvailableError, run_case
from counterspin.validation.page import CheckedCase, Dossier, Installation

_PACKAGE: Final = "counterspin"


def installation() -> Installation:
    """Return versions of the package and what it needs, the environment, and its files' state."""
    folder = Path(__file__).parents[1]
    dependencies, record = dict[str, str](), None
    try:
        distribution = metadata.distribution(_PACKAGE)
    except metadata.PackageNotFoundError:
        distribution = None
    if distribution is not None:
        # An editable installation runs other files than those next to its RECORD.
        location = Path(str(distribution.locate_file(_PACKAGE)))
        if location.resolve() == folder.resolve():
            record = distribution.read_text("RECORD")
        for requirement in distribution.requires or []:
            if ";" not in requirement:
                name = "".join(c if c.isalnum() or c in "-_." else " " for c in requirement).split()
                dependencies[name[0]] = _installed_version(name[0])
    files, altered, missing = (
        verify_files(record, folder) if record else (dict[str, str](), list[str](), list[str]())
    )
    paths = sorted(path for path in folder.rglob("*") if path.is_file() and _is_package_file(path))
    digest = hashlib.sha256()
    for path in paths:
        digest.update(path.relative_to(folder).as_posix().encode() + b"\0")
        digest.update(hashlib.sha256(path.read_bytes()).digest())
    return Installation(
        version=__version__,
        environment=environment(),
        packages=dependencies,
        files=len(paths),
        checksum=f"sha256:{digest.hexdigest()}",
        recorded=len(files),
        altered=altered,
        missing=missing,
        unknown=_unrecorded_files(paths, folder, files) if files else [],
    )


def verify_files(record: str, folder: Path) -> tuple[dict[str, str], list[str], list[str]]:
    """Compare the package's files with the hashes of a wheel's RECORD.

    record: Text of RECORD: CSV of path, ``sha256=`` and the hash in base64 for URLs, size.
    """
    files, altered, missing = dict[str, str](), list[str](), list[str]()
    for path, recorded_hash, *_ in csv.reader(record.splitlines()):
        parts = Path(path).parts
        if parts[0] != _PACKAGE or not recorded_hash:
            continue
        name = Path(*parts[1:]).as_posix()
        files[name] = recorded_hash
        algorithm, _, expected = recorded_hash.partition("=")
        file = folder / name
        if not file.is_file():
            missing.append(name)
            continue
        digest = hashlib.new(algorithm, file.read_bytes()).digest()
        if base64.urlsafe_b64encode(digest).rstrip(b"=").decode() != expected:
            altered.append(name)
    return files, altered, missing


def _is_package_file(path: Path) -> bool:
    return "__pycache__" not in path.parts and path.suffix != ".pyc"


def _unrecorded_files(paths: list[Path], folder: Path, files: dict[str, str]) -> list[str]:
    return [n for n in (path.relative_to(folder).as_posix() for path in paths) if n not in files]


def _installed_version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "not installed"


#: The files that `write_dossier` writes.
DOSSIER_FILES: Final = ("validation.html", "validation.pdf", "validation.json")

_MAX_DIGITS: Final = 16.0


def validate(
    *,
    schema: Path | str | None = None,
    chosen: Sequence[Case] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Dossier:
    """Run reference cases, and describe the installation.

    Parameters
    ----------
    schema
        Folder or file of DCC's schema, for the case of a certificate checked against it; None: that
        case is not run.
    chosen
        The cases; None: all.
    progress
        Called with (cases run, cases in all).

    Returns
    -------
    Dossier
        `passed` says whether every case stayed within its limit.

    Raises
    ------
    CounterspinError
        If `schema` is given and does not contain the complete schema.
    """
    selected = cases() if chosen is None else tuple(chosen)
    if schema is not None:
        load_schema(Path(schema))
        selected = tuple(_set_schema(case, schema) for case in selected)
    checked = []
    for case in selected:
        checked.append(check_case(case))
        if progress is not None:
            progress(len(checked), len(selected))
    installed = installation()
    is_unaltered = not (installed.altered or installed.missing)
    return Dossier(
        passed=is_unaltered and all(outcome.state != "failed" for outcome in checked),
        installation=installed,
        cases=checked,
        not_covered=[
            *document("cases.json")["not_covered"],
            *(
                f"{outcome.name}: {outcome.note}"
                for outcome in checked
                if outcome.state == "not run"
            ),
        ],
    )


def _set_schema(case: Case, schema: Path | str) -> Case:
    if not case.kernel.endswith(":check_schema"):
        return case
    return replace(case, given={**case.given, "schema": str(schema)})


def check_case(case: Case) -> CheckedCase:
    """Run a case; an error in its function or in its expected values is a failure."""
    try:
        reference, answer = case.expected, run_case(case)
    except NotAvailableError as error:
        return _failed_case(case, "not run", str(error))
    except Exception as error:  # report any error to the assessor
        return _failed_case(case, "failed", f"{type(error).__name__}: {error}")
    largest: tuple[float, str, float, float, float] | None = None
    count = 0
    for name, expected in reference.items():
        computed = np.asarray(answer.get(name, np.nan), np.float64)
        if computed.shape != expected.shape:
            return _failed_case(case, "failed", f"{name} is missing, or has a different shape")
        tolerance = np.broadcast_to(case.tolerance(name), expected.shape)
        for index in np.ndindex(expected.shape):
            count += 1
            deviation = _relative_deviation(
                float(computed[index]), float(expected[index]), float(tolerance[index])
            )
            if largest is None or deviation > largest[0]:
                label = name + "".join(f"[{i + 1}]" for i in index)
                numbers = (float(expected[index]), float(computed[index]), float(tolerance[index]))
                largest = (deviation, label, *numbers)
    assert largest is not None
    deviation, quantity, expected_value, computed_value, limit = largest
    return CheckedCase(
        **_case_fields(case),
        state="passed" if deviation <= 1.0 else "failed",
        numbers=count,
        quantity=quantity,
        expected=expected_value,
        found=computed_value if math.isfinite(computed_value) else None,
        digits=_correct_digits(computed_value, expected_value),
        limit=limit,
    )


def write_dossier(dossier: Dossier, folder: Path | str, *, overwrite: bool = False) -> None:
    """Write a dossier as `DOSSIER_FILES`.

    Parameters
    ----------
    dossier
        What `validate` returned.
    folder
        Where; made if it is not there.
    overwrite
        Whether an earlier dossier may be replaced; nothing else is.

    Raises
    ------
    CounterspinError
        If another file is in the way, or one cannot be written.
    """
    target = Path(folder)
    check_folder(target, overwrite=overwrite)
    *pages, json = (target / name for name in DOSSIER_FILES)
    for path in pages:
        dossier.write_report(path, overwrite=overwrite)
    dossier.write(json, overwrite=overwrite)


def check_folder(folder: Path, *, overwrite: bool) -> None:
    """Make the folder, and refuse it where a file would be lost."""
    make_folder(folder)
    for name in DOSSIER_FILES:
        path = folder / name
        page = partial(marked_file_type, Dossier.report_type())
        kind = Dossier.file_type if path.suffix == ".json" else page
        check_writable(path, kind, overwrite=overwrite)


def _case_fields(case: Case) -> dict[str, Any]:
    return {key: getattr(case, key) for key in ("name", "requirement", "kernel", "source")}


def _failed_case(case: Case, state: str, note: str) -> CheckedCase:
    empty_fields = dict.fromkeys(("expected", "found", "digits", "limit"))
    return CheckedCase.model_validate(
        {
            **_case_fields(case),
            **empty_fields,
            "state": state,
            "numbers": 0,
            "quantity": "",
            "note": note,
        }
    )


def _relative_deviation(value: float, expected: float, allowed: float) -> float:
    """Return a difference relative to the tolerance; infinite if the tolerance is zero."""
    if value == expected:
        return 0.0
    difference = abs(value - expected)
    return difference / allowed if allowed and difference < math.inf else math.inf


def _correct_digits(value: float, expected: float) -> float | None:
    if value == expected:
        return _MAX_DIGITS
    if not expected or not math.isfinite(value):
        return None
    return min(_MAX_DIGITS, -math.log10(abs(value - expected) / abs(expected)))

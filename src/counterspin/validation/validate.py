"""`counterspin validate`: run reference cases on the installed package and check its files."""

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
from counterspin.results import describe_environment
from counterspin.validation.cases import Case, cases, load_document
from counterspin.validation.kernels import NotAvailableError, run_case
from counterspin.validation.page import CheckedCase, Dossier, Installation

_PACKAGE_NAME: Final = "counterspin"


def inspect_installation() -> Installation:
    """Return the versions of the package and its dependencies, and the state of its files."""
    folder = Path(__file__).parents[1]
    dependencies, record = dict[str, str](), None
    try:
        distribution = metadata.distribution(_PACKAGE_NAME)
    except metadata.PackageNotFoundError:
        distribution = None
    if distribution is not None:
        # An editable installation runs files that are not listed in its RECORD.
        location = Path(str(distribution.locate_file(_PACKAGE_NAME)))
        if location.resolve() == folder.resolve():
            record = distribution.read_text("RECORD")
        for requirement in distribution.requires or []:
            if ";" not in requirement:
                name = "".join(
                    character if character.isalnum() or character in "-_." else " "
                    for character in requirement
                ).split()
                dependencies[name[0]] = _installed_version(name[0])
    recorded_files, altered_files, missing_files = (
        verify_files(record, folder) if record else (dict[str, str](), list[str](), list[str]())
    )
    paths = sorted(path for path in folder.rglob("*") if path.is_file() and _is_package_file(path))
    digest = hashlib.sha256()
    for path in paths:
        digest.update(path.relative_to(folder).as_posix().encode() + b"\0")
        digest.update(hashlib.sha256(path.read_bytes()).digest())
    return Installation(
        version=__version__,
        environment=describe_environment(),
        packages=dependencies,
        files=len(paths),
        checksum=f"sha256:{digest.hexdigest()}",
        recorded=len(recorded_files),
        altered=altered_files,
        missing=missing_files,
        unknown=_unrecorded_files(paths, folder, recorded_files) if recorded_files else [],
    )


def verify_files(record: str, folder: Path) -> tuple[dict[str, str], list[str], list[str]]:
    """Compare the package's files with the hashes of a wheel's RECORD.

    record: Text of RECORD: CSV of path, ``sha256=`` and the hash in base64 for URLs, size.
    """
    recorded_files, altered_files, missing_files = dict[str, str](), list[str](), list[str]()
    for path, recorded_hash, *_ in csv.reader(record.splitlines()):
        parts = Path(path).parts
        if parts[0] != _PACKAGE_NAME or not recorded_hash:
            continue
        name = Path(*parts[1:]).as_posix()
        recorded_files[name] = recorded_hash
        algorithm, _, expected_digest = recorded_hash.partition("=")
        file = folder / name
        if not file.is_file():
            missing_files.append(name)
            continue
        digest = hashlib.new(algorithm, file.read_bytes()).digest()
        if base64.urlsafe_b64encode(digest).rstrip(b"=").decode() != expected_digest:
            altered_files.append(name)
    return recorded_files, altered_files, missing_files


def _is_package_file(path: Path) -> bool:
    return "__pycache__" not in path.parts and path.suffix != ".pyc"


def _unrecorded_files(paths: list[Path], folder: Path, recorded_files: dict[str, str]) -> list[str]:
    names = (path.relative_to(folder).as_posix() for path in paths)
    return [name for name in names if name not in recorded_files]


def _installed_version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "not installed"


#: Names of the files that `write_dossier` writes.
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
        Folder or file of the DCC schema, for the case that checks a certificate against the schema;
        None: this case is not run.
    chosen
        Cases to run; None: all.
    progress
        Called with (number of finished cases, number of cases).

    Returns
    -------
    Dossier
        `passed` is True if all cases are within their tolerances and no file is altered.

    Raises
    ------
    CounterspinError
        If `schema` is given and does not contain the complete schema.
    """
    selected_cases = cases() if chosen is None else tuple(chosen)
    if schema is not None:
        load_schema(Path(schema))
        selected_cases = tuple(_set_schema(case, schema) for case in selected_cases)
    checked_cases = []
    for case in selected_cases:
        checked_cases.append(check_case(case))
        if progress is not None:
            progress(len(checked_cases), len(selected_cases))
    installation = inspect_installation()
    is_intact = not (installation.altered or installation.missing)
    return Dossier(
        passed=is_intact and all(checked_case.state != "failed" for checked_case in checked_cases),
        installation=installation,
        cases=checked_cases,
        not_covered=[
            *load_document("cases.json")["not_covered"],
            *(
                f"{checked_case.name}: {checked_case.note}"
                for checked_case in checked_cases
                if checked_case.state == "not run"
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
        expected_outputs, outputs = case.expected, run_case(case)
    except NotAvailableError as error:
        return _case_without_values(case, "not run", str(error))
    except Exception as error:  # report any error to the assessor
        return _case_without_values(case, "failed", f"{type(error).__name__}: {error}")
    worst_comparison: tuple[float, str, float, float, float] | None = None
    n_values = 0
    for name, expected_values in expected_outputs.items():
        computed_values = np.asarray(outputs.get(name, np.nan), np.float64)
        if computed_values.shape != expected_values.shape:
            return _case_without_values(
                case, "failed", f"{name} is missing, or has a different shape"
            )
        tolerances = np.broadcast_to(case.tolerance(name), expected_values.shape)
        for index in np.ndindex(expected_values.shape):
            n_values += 1
            tolerance_ratio = _tolerance_ratio(
                float(computed_values[index]),
                float(expected_values[index]),
                float(tolerances[index]),
            )
            if worst_comparison is None or tolerance_ratio > worst_comparison[0]:
                label = name + "".join(f"[{i + 1}]" for i in index)
                compared_values = (
                    float(expected_values[index]),
                    float(computed_values[index]),
                    float(tolerances[index]),
                )
                worst_comparison = (tolerance_ratio, label, *compared_values)
    assert worst_comparison is not None
    tolerance_ratio, quantity, expected_value, computed_value, limit = worst_comparison
    return CheckedCase(
        **_case_fields(case),
        state="passed" if tolerance_ratio <= 1.0 else "failed",
        numbers=n_values,
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
        Result of `validate`.
    folder
        Target folder; created if it does not exist.
    overwrite
        Whether an earlier dossier may be replaced; other files are never replaced.

    Raises
    ------
    CounterspinError
        If another file with the same name exists, or a file cannot be written.
    """
    folder_path = Path(folder)
    check_folder(folder_path, overwrite=overwrite)
    *report_paths, json_path = (folder_path / name for name in DOSSIER_FILES)
    for path in report_paths:
        dossier.write_report(path, overwrite=overwrite)
    dossier.write(json_path, overwrite=overwrite)


def check_folder(folder: Path, *, overwrite: bool) -> None:
    """Make the folder; raise an error if a file would be lost."""
    make_folder(folder)
    for name in DOSSIER_FILES:
        path = folder / name
        report_type = partial(marked_file_type, Dossier.report_kind())
        file_type = Dossier.file_kind if path.suffix == ".json" else report_type
        check_writable(path, file_type, overwrite=overwrite)


def _case_fields(case: Case) -> dict[str, Any]:
    return {key: getattr(case, key) for key in ("name", "requirement", "kernel", "source")}


def _case_without_values(case: Case, state: str, note: str) -> CheckedCase:
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


def _tolerance_ratio(value: float, expected: float, tolerance: float) -> float:
    """Return a difference relative to the tolerance; infinite if the tolerance is zero."""
    if value == expected:
        return 0.0
    difference = abs(value - expected)
    return difference / tolerance if tolerance and difference < math.inf else math.inf


def _correct_digits(value: float, expected: float) -> float | None:
    if value == expected:
        return _MAX_DIGITS
    if not expected or not math.isfinite(value):
        return None
    return min(_MAX_DIGITS, -math.log10(abs(value - expected) / abs(expected)))

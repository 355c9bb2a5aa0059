"""`counterspin rerun`: repeat the calibration of a result; differences between results."""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Final

from counterspin.calibration.calibrate import calibrate
from counterspin.calibration.findings import judge_result
from counterspin.calibration.options import parse_options
from counterspin.calibration.result import Result
from counterspin.calibration.result_parts import Coefficient
from counterspin.campaign.checksums import Checksums
from counterspin.campaign.description import Campaign, read_campaign
from counterspin.campaign.documents import require_source, set_source
from counterspin.campaign.model import ALL_TERMS
from counterspin.comparisons.result import Change, RepeatedCalibration, RepeatedCoefficient
from counterspin.errors import RecordError
from counterspin.physics.terms import find_symbol
from counterspin.reports.numbers import find_display_unit, format_estimate, format_number
from counterspin.temporary_folders import temporary_folder

#: Number of characters shown of a checksum.
_CHECKSUM_DIGITS: Final = 12

_NO_VALUE: Final = "-"


def find_changes(results: Sequence[Result]) -> list[Change]:
    """Return the differences between results: method and options, terms, noise, inputs, files."""
    descriptions = [dict(_describe_result(result)) for result in results]
    subjects = dict.fromkeys(subject for description in descriptions for subject in description)
    changes = []
    for subject in subjects:
        values = [description.get(subject, _NO_VALUE) for description in descriptions]
        if len(set(values)) > 1:
            changes.append(Change(subject=subject, values=values))
    return changes


def term_names(result: Result) -> set[str]:
    """Return the names of all terms of a result's model: ``Qx.K_II``, ``platform.drift.north``."""
    terms = set(result.platform)
    for owner_name, accelerometer in result.accelerometers.items():
        terms.update(f"{owner_name}.{symbol}" for symbol in accelerometer.coefficients)
    for owner_name, run in result.runs.items():
        terms.update(f"{owner_name}.{symbol}" for symbol in run.terms)
    return terms


def _describe_result(result: Result) -> Iterator[tuple[str, str]]:
    provenance, inputs = result.provenance, result.inputs
    yield "version", provenance.version
    yield from provenance.environment.items()
    yield "method", result.method
    yield "equations", result.model
    yield "options", " ".join(provenance.options) or _NO_VALUE
    yield "accepted misfit", result.accepted_misfit or _NO_VALUE
    for subject, value, u, unit in (
        ("gravity", inputs.gravity, inputs.u_gravity, "m/s^2"),
        ("latitude", math.degrees(inputs.latitude), math.degrees(inputs.u_latitude), "deg"),
        # Tumbles and poses have no radius.
        ("radius", inputs.radius or None, inputs.u_radius, "m"),
    ):
        yield subject, _format_quantity(value, u, unit)
    yield from _describe_model(result)
    yield from result.details.items()
    for file, checksum in provenance.inputs.items():
        suffix = ", in memory" if file in provenance.in_memory else ""
        yield file, checksum.removeprefix("sha256:")[:_CHECKSUM_DIGITS] + suffix


def _describe_model(result: Result) -> Iterator[tuple[str, str]]:
    for name, accelerometer in result.accelerometers.items():
        yield f"serial number of {name}", accelerometer.serial_number or _NO_VALUE
        output = accelerometer.nominal
        yield f"output of {name}", _NO_VALUE if output is None else output.words
        yield f"terms of {name}", ", ".join(accelerometer.coefficients)
        for symbol, known_coefficient in accelerometer.known.items():
            yield (
                f"prior of {name}.{symbol}",
                _format_quantity(
                    known_coefficient.value, known_coefficient.u, known_coefficient.unit
                ),
            )
        considered_terms, priors = _prior_information(result, name)
        yield f"considered terms of {name}", ", ".join(considered_terms) or _NO_VALUE
        for source, text in priors.items():
            yield f"{name}: {source}", text
        for component, line in accelerometer.noise.items():
            level_text = _format_quantity(line.value, 0.0, line.unit)
            yield f"noise of {name}, {component}", "estimated" if line.estimated else level_text
    yield "terms fixed at nominal", ", ".join(result.assumed) or _NO_VALUE
    yield "default priors", ", ".join(_default_priors(result)) or _NO_VALUE
    yield "platform terms", ", ".join(result.platform) or _NO_VALUE
    run_terms = dict.fromkeys(symbol for run in result.runs.values() for symbol in run.terms)
    yield "run terms", ", ".join(run_terms) or _NO_VALUE
    yield "runs", ", ".join(result.runs)


def _prior_information(result: Result, name: str) -> tuple[list[str], Mapping[str, str]]:
    """Return the considered terms, and the stated priors of the unknowns as text."""
    considered_terms, priors = dict[str, None](), dict[str, str]()
    for lines in result.accelerometers[name].budget.values():
        for line in lines:
            if line.kind == "held":
                considered_terms[line.source] = None
            elif line.kind == "stated" and line.u is not None:
                priors[f"prior u of {line.source}"] = _format_quantity(line.u, 0.0, line.unit)
    return sorted(considered_terms), priors


def _default_priors(result: Result) -> list[str]:
    """Return the terms with default priors and their uncertainties, once for all runs."""
    texts = dict[str, None]()
    for prior in result.rests_on:
        if prior.kind == "unstated":
            unit, factor = find_display_unit(prior.unit)
            text = f"{find_symbol(prior.name)} ± {format_number(prior.u * factor, 4)} {unit}"
            texts[text.removesuffix(" 1")] = None
    return list(texts)


def _format_quantity(value: float | None, u: float | None, unit: str) -> str:
    if value is None:
        return _NO_VALUE
    display_unit, factor = find_display_unit(unit)
    if not u:
        return f"{format_number(value * factor, 12)} {display_unit}"
    return format_estimate(value * factor, u * factor, display_unit)


#: Largest relative difference of numbers that are considered equal.
RELATIVE_TOLERANCE: Final = 1e-12


def rerun(
    result: Result | Path | str,
    folder: Path | str | None = None,
    *,
    progress: Callable[[int, int], None] | None = None,
) -> RepeatedCalibration:
    """Calibrate the inputs of a result again, and compare the numbers.

    Each input is searched by name, then by checksum among all files of the folder. A file with
    the same name and different content is used and reported as changed.

    Parameters
    ----------
    result
        Result or result file of this version or an earlier version.
    folder
        Campaign folder; None: folder of the result file.
    progress
        Called with (number of runs read, number of runs).

    Returns
    -------
    RepeatedCalibration
        Original and repeated numbers, and the other differences.

    Raises
    ------
    RecordError
        If the file is not a result, the result is from arrays in memory, or an input is missing.
    CampaignError
        If the campaign cannot be calibrated, or an option belongs to another version.
    """
    original_result = judge_result(result if isinstance(result, Result) else Result.read(result))
    result_name = (
        original_result.title or "the result" if isinstance(result, Result) else str(result)
    )
    if folder is None and isinstance(result, Result):
        raise RecordError(f"{result_name}: give the campaign folder (`folder`)", code="wrong-usage")
    campaign_folder = Path(result).parent if folder is None else Path(folder)  # type: ignore[arg-type]
    if folder is not None and not campaign_folder.is_dir():
        if not campaign_folder.exists():
            raise RecordError(f"{folder}: folder not found", code="file-not-found")
        campaign_folder = campaign_folder.parent  # the description was given
    if original_result.provenance.in_memory or not original_result.provenance.inputs:
        raise RecordError(
            f"{result_name}: computed from data in memory; only results from campaign files can "
            "be repeated",
            code="missing-in-result",
        )
    method, options, excluded_runs = parse_options(original_result.provenance.options)
    with ExitStack() as stack:
        paths, new_paths = _locate_inputs(
            original_result.provenance.inputs, campaign_folder, result_name
        )
        if new_paths:
            staging_folder = stack.enter_context(temporary_folder("counterspin-rerun-"))
            for name, file in paths.items():
                (staging_folder / name).parent.mkdir(parents=True, exist_ok=True)
                _link_or_copy(file, staging_folder / name)
            campaign_folder = staging_folder
        repeated_result = calibrate(
            _calibration_input(original_result, campaign_folder / next(iter(paths))),
            method=method,
            options=options,
            accept_misfit=original_result.accepted_misfit,
            without=excluded_runs,
            progress=progress,
        )
    return _compare_coefficients(result_name, original_result, repeated_result, new_paths)


def _calibration_input(original: Result, path: Path) -> Path | Campaign:
    """Return the campaign to calibrate; results of schema 1 use the defaults of schema 1."""
    if not original.assumes_all:
        return path
    campaign = read_campaign(path)
    model = replace(campaign.model, assume=(ALL_TERMS,))
    return set_source(replace(campaign, model=model), require_source(campaign))


def _locate_inputs(
    inputs: dict[str, str], folder: Path, result_name: str
) -> tuple[dict[str, Path], dict[str, str]]:
    """Return the path of each input, and the new paths of renamed inputs."""
    paths, new_paths = dict[str, Path](), dict[str, str]()
    with Checksums() as checksums:
        path_by_name = {name: folder / name for name in inputs}
        actual_checksums = dict(
            zip(path_by_name, checksums.checksums(path_by_name.values()), strict=True)
        )
        changed_names = {name for name in inputs if actual_checksums[name] != inputs[name]}
        path_by_checksum = _files_by_checksum(
            folder, {Path(name).suffix for name in changed_names}, checksums
        )
    for name, checksum in inputs.items():
        # A path outside the folder cannot be assigned to another file.
        new_path = path_by_checksum.get(checksum) if _is_inside_folder(name) else None
        if name in changed_names and new_path is not None:
            paths[name] = new_path
            new_paths[name] = str(new_path)
        elif name in changed_names and actual_checksums[name] == "unreadable":
            raise RecordError(
                f"{result_name}: the input {name} ({checksum}) is not in {folder} under this or "
                "any other name. Give the campaign folder",
                code="file-not-found",
            )
        else:
            paths[name] = path_by_name[name]
    if any(not _is_inside_folder(name) for name in inputs):
        new_paths = {} if not new_paths else _refuse_renamed_inputs(result_name, new_paths)
    return paths, new_paths


def _files_by_checksum(folder: Path, suffixes: set[str], checksums: Checksums) -> dict[str, Path]:
    if not suffixes:
        return {}
    files = sorted(file for file in folder.rglob("*") if file.suffix in suffixes and file.is_file())
    return dict(zip(checksums.checksums(files), files, strict=True))


def _is_inside_folder(name: str) -> bool:
    return not Path(name).is_absolute() and ".." not in Path(name).parts


def _refuse_renamed_inputs(result_name: str, new_paths: dict[str, str]) -> dict[str, str]:
    name, new_path = next(iter(new_paths.items()))
    raise RecordError(
        f"{result_name}: the input {name} is now named {new_path}; restore the earlier name, "
        "because other inputs are outside the campaign folder",
        code="path-outside-folder",
    )


def _link_or_copy(file: Path, target: Path) -> None:
    try:
        target.symlink_to(file.absolute())
    except OSError:  # on Windows, symbolic links need a privilege
        shutil.copyfile(file, target)


def _compare_coefficients(
    result_name: str, original: Result, repeated: Result, new_paths: dict[str, str]
) -> RepeatedCalibration:
    original_coefficients = dict(_all_coefficients(original))
    repeated_coefficients = dict(_all_coefficients(repeated))
    coefficients = [
        _compare_coefficient(name, original_coefficients.get(name), repeated_coefficients.get(name))
        for name in dict.fromkeys([*original_coefficients, *repeated_coefficients])
    ]
    relative_differences = [coefficient.relative for coefficient in coefficients]
    normalized_differences = [
        abs(coefficient.in_u) for coefficient in coefficients if coefficient.in_u is not None
    ]
    differences = [difference for difference in relative_differences if difference is not None]
    is_complete = len(differences) == len(relative_differences)
    largest_difference = max(differences, default=0.0) if is_complete else None
    return RepeatedCalibration(
        result=result_name,
        same=largest_difference is not None
        and largest_difference <= RELATIVE_TOLERANCE
        and original.state == repeated.state,
        limit=RELATIVE_TOLERANCE,
        largest=largest_difference,
        largest_in_u=max(normalized_differences, default=None),
        coefficients=coefficients,
        state_before=original.state,
        state_now=repeated.state,
        changes=find_changes([original, repeated]),
        moved=new_paths,
        unsealed=[] if original.sealed else [result_name],
    )


def _all_coefficients(result: Result) -> Iterator[tuple[str, Coefficient]]:
    for owner_name, accelerometer in result.accelerometers.items():
        for symbol, coefficient in accelerometer.coefficients.items():
            yield f"{owner_name}.{symbol}", coefficient
    yield from result.platform.items()
    for owner_name, run in result.runs.items():
        for symbol, coefficient in run.terms.items():
            yield f"{owner_name}.{symbol}", coefficient


def _compare_coefficient(
    name: str, original: Coefficient | None, repeated: Coefficient | None
) -> RepeatedCoefficient:
    coefficient = original or repeated
    assert coefficient is not None
    original_value, original_u = (original.value, original.u) if original else (None, None)
    repeated_value, repeated_u = (repeated.value, repeated.u) if repeated else (None, None)
    value_change = _relative_difference(original_value, repeated_value, original_u or 0.0)
    u_change = _relative_difference(original_u, repeated_u, 0.0)
    is_in_both = (original is None) == (repeated is None)
    normalized_difference = None
    if original_value is not None and repeated_value is not None and original_u:
        normalized_difference = (repeated_value - original_value) / original_u
    return RepeatedCoefficient(
        name=name,
        unit=coefficient.unit,
        before=original_value,
        u_before=original_u,
        now=repeated_value,
        u_now=repeated_u,
        relative=None
        if not is_in_both or value_change is None or u_change is None
        else max(value_change, u_change),
        in_u=normalized_difference,
    )


def _relative_difference(
    original: float | None, repeated: float | None, scale: float
) -> float | None:
    """Return a relative difference; None if only one of the numbers exists."""
    if original is None or repeated is None:
        return 0.0 if original is repeated else None
    if original == repeated:
        return 0.0
    return abs(repeated - original) / max(abs(original), abs(repeated), scale)

"""`counterspin rerun`: a result's calibration made again, and differences between results."""

from __future__ import annotations

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
from counterspin.campaign.documents import require_source, with_source
from counterspin.campaign.model import ALL_TERMS
from counterspin.comparisons.result import Change, RepeatedCalibration, RepeatedCoefficient
from counterspin.errors import RecordError
from counterspin.physics.terms import find_symbol
from counterspin.reports.numbers import field_unit, format_estimate, format_number
from counterspin.temporary_folders import temporary_folder

#: Number of characters shown of a checksum.
_CHECKSUM_DIGITS: Final = 12

_MISSING: Final = "-"


def find_changes(results: Sequence[Result]) -> list[Change]:
    """Return the differences between results: method and options, terms, noise, inputs, files."""
    rows = [dict(_description(result)) for result in results]
    subjects = dict.fromkeys(subject for row in rows for subject in row)
    differences = []
    for subject in subjects:
        values = [row.get(subject, _MISSING) for row in rows]
        if len(set(values)) > 1:
            differences.append(Change(subject=subject, values=values))
    return differences


def terms_of(result: Result) -> set[str]:
    """Return the names of all terms of a result's model: ``Qx.K_II``, ``platform.drift.north``."""
    terms = set(result.platform)
    for owner, accelerometer in result.accelerometers.items():
        terms.update(f"{owner}.{symbol}" for symbol in accelerometer.coefficients)
    for owner, run in result.runs.items():
        terms.update(f"{owner}.{symbol}" for symbol in run.terms)
    return terms


def _description(result: Result) -> Iterator[tuple[str, str]]:
    provenance, inputs = result.provenance, result.inputs
    yield "version", provenance.version
    yield from provenance.environment.items()
    yield "method", result.method
    yield "equations", result.model
    yield "options", " ".join(provenance.options) or _MISSING
    yield "accepted misfit", result.accepted_misfit or _MISSING
    for subject, value, u, unit in (
        ("gravity", inputs.gravity, inputs.u_gravity, "m/s^2"),
        ("latitude", inputs.latitude, inputs.u_latitude, "rad"),
        ("radius", inputs.radius, inputs.u_radius, "m"),
    ):
        yield subject, _quantity(value, u, unit)
    yield from _model(result)
    yield from result.details.items()
    for file, checksum in provenance.inputs.items():
        where = ", in memory" if file in provenance.in_memory else ""
        yield file, checksum.removeprefix("sha256:")[:_CHECKSUM_DIGITS] + where


def _model(result: Result) -> Iterator[tuple[str, str]]:
    for name, accelerometer in result.accelerometers.items():
        yield f"terms of {name}", ", ".join(accelerometer.coefficients)
        for symbol, known in accelerometer.known.items():
            yield f"{name}.{symbol}, known", _quantity(known.value, known.u, known.unit)
        considered, priors = _prior_information(result, name)
        yield f"held of {name}", ", ".join(considered) or _MISSING
        for source, text in priors.items():
            yield f"{name}: {source}", text
        for part, line in accelerometer.noise.items():
            size = _quantity(line.value, 0.0, line.unit)
            yield f"noise of {name}, {part}", "estimated" if line.estimated else size
    yield "assumed", ", ".join(result.assumed) or _MISSING
    yield "not stated", ", ".join(_default_priors(result)) or _MISSING
    yield "platform terms", ", ".join(result.platform) or _MISSING
    run_terms = dict.fromkeys(symbol for run in result.runs.values() for symbol in run.terms)
    yield "run terms", ", ".join(run_terms) or _MISSING
    yield "runs", ", ".join(result.runs)


def _prior_information(result: Result, name: str) -> tuple[list[str], Mapping[str, str]]:
    """Return the considered terms, and the stated priors of the unknowns in words."""
    considered, priors = dict[str, None](), dict[str, str]()
    for lines in result.accelerometers[name].budget.values():
        for line in lines:
            if line.kind == "held":
                considered[line.source] = None
            elif line.kind == "stated" and line.u is not None:
                priors[f"u of the prior for {line.source}"] = _quantity(line.u, 0.0, line.unit)
    return sorted(considered), priors


def _default_priors(result: Result) -> list[str]:
    """Return the terms with default priors and their sizes, once for all runs."""
    sizes = (
        f"{find_symbol(known.name)} ± {_quantity(known.u, 0.0, known.unit)}"
        for known in result.rests_on
        if known.kind == "unstated"
    )
    return list(dict.fromkeys(sizes))


def _quantity(value: float | None, u: float | None, unit: str) -> str:
    if value is None:
        return _MISSING
    shown, factor = field_unit(unit)
    if not u:
        return f"{format_number(value * factor, 12)} {shown}"
    return format_estimate(value * factor, u * factor, shown)


#: Largest relative difference of numbers that count as equal.
LIMIT: Final = 1e-12


def rerun(
    result: Result | Path | str,
    folder: Path | str | None = None,
    *,
    progress: Callable[[int, int], None] | None = None,
) -> RepeatedCalibration:
    """Calibrate the inputs of a result again, and compare the numbers.

    An input is looked for under its name, then among all files of the folder by its checksum. One
    that is there under its name with another content is used, and named as changed.

    Parameters
    ----------
    result
        The result or its file, of this version or an earlier one.
    folder
        Folder of its campaign; None: the folder of the result's file.
    progress
        Called with (runs read, runs in all).

    Returns
    -------
    RepeatedCalibration
        Each number before and now, and the other differences.

    Raises
    ------
    RecordError
        If the file is not a result, was made of arrays in memory, or an input is not found.
    CampaignError
        If the campaign can no longer be calibrated, or an option is of another version.
    """
    before = judge_result(result if isinstance(result, Result) else Result.read(result))
    result_name = before.title or "the result" if isinstance(result, Result) else str(result)
    if folder is None and isinstance(result, Result):
        raise RecordError(f"{result_name}: give the campaign folder (`folder`)", code="wrong-usage")
    campaign_folder = Path(result).parent if folder is None else Path(folder)  # type: ignore[arg-type]
    if before.provenance.in_memory or not before.provenance.inputs:
        raise RecordError(
            f"{result_name}: computed from data in memory; only results from campaign files can "
            "be repeated",
            code="missing-in-result",
        )
    method, options, without = parse_options(before.provenance.options)
    with ExitStack() as stack:
        paths, moved = _locate_inputs(before.provenance.inputs, campaign_folder, result_name)
        if moved:
            staged = stack.enter_context(temporary_folder("counterspin-rerun-"))
            for name, file in paths.items():
                (staged / name).parent.mkdir(parents=True, exist_ok=True)
                _link_or_copy(file, staged / name)
            campaign_folder = staged
        after = calibrate(
            _calibration_input(before, campaign_folder / next(iter(paths))),
            method=method,
            options=options,
            accept_misfit=before.accepted_misfit,
            without=without,
            progress=progress,
        )
    return _compare_coefficients(result_name, before, after, moved)


def _calibration_input(before: Result, path: Path) -> Path | Campaign:
    """Return the input of the calibration; for a result of schema 1, interpreted as in schema 1."""
    if not before.assumes_all:
        return path
    campaign = read_campaign(path)
    model = replace(campaign.model, assume=(ALL_TERMS,))
    return with_source(replace(campaign, model=model), require_source(campaign))


def _locate_inputs(
    inputs: dict[str, str], folder: Path, result_name: str
) -> tuple[dict[str, Path], dict[str, str]]:
    """Return the path of each input, and the new paths of renamed inputs."""
    paths, moved = dict[str, Path](), dict[str, str]()
    with Checksums() as checksums:
        named_paths = {name: folder / name for name in inputs}
        actual = dict(zip(named_paths, checksums.checksums(named_paths.values()), strict=True))
        changed = {name for name in inputs if actual[name] != inputs[name]}
        by_checksum = _files_by_checksum(folder, {Path(name).suffix for name in changed}, checksums)
    for name, checksum in inputs.items():
        # A path outside the folder cannot be assigned to another file.
        elsewhere = by_checksum.get(checksum) if _is_inside_folder(name) else None
        if name in changed and elsewhere is not None:
            paths[name] = elsewhere
            moved[name] = str(elsewhere)
        elif name in changed and actual[name] == "unreadable":
            raise RecordError(
                f"{result_name}: the input {name} ({checksum}) is not in {folder} under this or "
                "any other name. Give the campaign folder",
                code="file-not-found",
            )
        else:
            paths[name] = named_paths[name]
    if any(not _is_inside_folder(name) for name in inputs):
        moved = {} if not moved else _refuse_renamed(result_name, moved)
    return paths, moved


def _files_by_checksum(folder: Path, suffixes: set[str], checksums: Checksums) -> dict[str, Path]:
    if not suffixes:
        return {}
    files = sorted(f for f in folder.rglob("*") if f.suffix in suffixes and f.is_file())
    return dict(zip(checksums.checksums(files), files, strict=True))


def _is_inside_folder(name: str) -> bool:
    return not Path(name).is_absolute() and ".." not in Path(name).parts


def _refuse_renamed(result_name: str, moved: dict[str, str]) -> dict[str, str]:
    name, new_path = next(iter(moved.items()))
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
    result_name: str, before: Result, after: Result, moved: dict[str, str]
) -> RepeatedCalibration:
    old, new = dict(_coefficients(before)), dict(_coefficients(after))
    rows = [
        _compare_coefficient(name, old.get(name), new.get(name))
        for name in dict.fromkeys([*old, *new])
    ]
    relative = [row.relative for row in rows]
    in_u = [abs(row.in_u) for row in rows if row.in_u is not None]
    known = [size for size in relative if size is not None]
    complete = len(known) == len(relative)
    largest = max(known, default=0.0) if complete else None
    return RepeatedCalibration(
        result=result_name,
        same=largest is not None and largest <= LIMIT and before.state == after.state,
        limit=LIMIT,
        largest=largest,
        largest_in_u=max(in_u, default=None),
        coefficients=rows,
        state_before=before.state,
        state_now=after.state,
        changes=find_changes([before, after]),
        moved=moved,
        unsealed=[] if before.sealed else [result_name],
    )


def _coefficients(result: Result) -> Iterator[tuple[str, Coefficient]]:
    for owner, accelerometer in result.accelerometers.items():
        for symbol, c in accelerometer.coefficients.items():
            yield f"{owner}.{symbol}", c
    yield from result.platform.items()
    for owner, run in result.runs.items():
        for symbol, c in run.terms.items():
            yield f"{owner}.{symbol}", c


def _compare_coefficient(
    name: str, old: Coefficient | None, new: Coefficient | None
) -> RepeatedCoefficient:
    coefficient = old or new
    assert coefficient is not None
    before, u_before = (old.value, old.u) if old else (None, None)
    now, u_now = (new.value, new.u) if new else (None, None)
    value_change = _relative_difference(before, now, u_before or 0.0)
    u_change = _relative_difference(u_before, u_now, 0.0)
    in_both = (old is None) == (new is None)
    in_u = None
    if before is not None and now is not None and u_before:
        in_u = (now - before) / u_before
    return RepeatedCoefficient(
        name=name,
        unit=coefficient.unit,
        before=before,
        u_before=u_before,
        now=now,
        u_now=u_now,
        relative=None
        if not in_both or value_change is None or u_change is None
        else max(value_change, u_change),
        in_u=in_u,
    )


def _relative_difference(before: float | None, now: float | None, scale: float) -> float | None:
    """Return a relative difference; None if only one of the numbers exists."""
    if before is None or now is None:
        return 0.0 if before is now else None
    if before == now:
        return 0.0
    return abs(now - before) / max(abs(before), abs(now), scale)

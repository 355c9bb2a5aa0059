"""`counterspin calibrate`: estimate accelerometer error coefficients from a campaign folder."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import fields, replace
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, get_args

from counterspin.calibration.options import MONTE_CARLO, Method, TwoStageOptions, extra_arguments
from counterspin.campaign.checksums import checksums_of
from counterspin.campaign.documents import DESCRIPTION_NAME
from counterspin.errors import CampaignError, RecordError, UsageError
from counterspin.input import FileIdentity
from counterspin.loading import load_name
from counterspin.threads import single_blas_thread

if TYPE_CHECKING:
    from counterspin.calibration.observed_runs import ObservedRun
    from counterspin.calibration.result import Result
    from counterspin.campaign.checksums import Checksums
    from counterspin.campaign.description import Campaign


def calibrate(
    where: Path | str | Campaign,
    *,
    method: Method = "joint",
    options: TwoStageOptions | None = None,
    accept_misfit: str | None = None,
    without: Sequence[str] = (),
    monte_carlo: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Result:
    """Calibrate every accelerometer of a campaign.

    Parameters
    ----------
    where
        The campaign's folder, its ``campaign.toml``, or a campaign already read.
    method
        ``joint``: all samples of all records in one weighted fit; ``two-stage``: the paper's
        method, on one sample a revolution.
    options
        Options of the two-stage method.
    accept_misfit
        Reason for certifying and applying the result even if the records contradict it; the
        result stores the reason.
    without
        Names of runs to omit, in addition to those that the description omits.
    monte_carlo
        Number of Monte Carlo trials for coverage intervals (JCGM 101), 10^4 to 10^7; 0: none.
    progress
        Called with (runs read, total number of runs).

    Returns
    -------
    Result
        Coefficients in g-units of the campaign's gravity.

    Raises
    ------
    CampaignError
        If the campaign file is missing or invalid, the method is unknown, or the joint method
        receives two-stage options.
    RecordError
        If a record cannot be used.
    NotIdentifiableError
        If the records cannot determine the unknowns.
    """
    _check_method(method, options)
    if monte_carlo:
        load_name(f"{MONTE_CARLO}:check_trials")(monte_carlo, method)
    if accept_misfit is not None and not accept_misfit.strip():
        raise UsageError("calibrate", ["`accept_misfit`: state the reason in words"])
    with checksums_of(where) as checksums:
        # Imported here so that the checksums and the reader process start first.
        from counterspin.calibration.observed_runs import add_recorded_conditions
        from counterspin.campaign.description import Campaign, read_campaign

        campaign = where if isinstance(where, Campaign) else read_campaign(where)
        if without:
            campaign = _exclude_runs(campaign, without)
        from counterspin.calibration.assembly import assemble_result

        file_identities = _identify_averaged_files(campaign)
        with single_blas_thread():
            campaign = add_recorded_conditions(campaign)
            observed_runs = _observe_runs(campaign, progress)
            checksums.run_parallel()
            result = assemble_result(
                campaign,
                observed_runs,
                method,
                options or TwoStageOptions(),
                lambda: _collect_inputs(campaign, observed_runs, file_identities, checksums),
                accept_misfit,
            )
            if monte_carlo:
                add_intervals = load_name(f"{MONTE_CARLO}:add_intervals")
                result = add_intervals(result, campaign, observed_runs, monte_carlo)
        if not without and not monte_carlo:
            return result
        arguments = [*result.provenance.options, *extra_arguments(without, monte_carlo)]
        provenance = result.provenance.model_copy(update={"options": arguments})
        return result.model_copy(update={"provenance": provenance})


def _exclude_runs(campaign: Campaign, without: Sequence[str]) -> Campaign:
    """Return a campaign without some runs; its source is unchanged."""
    from counterspin.campaign.documents import require_source, set_source

    _check_excluded_runs(campaign, without)
    entries = require_source(campaign).document.get("runs", ())
    runs = [{**run, "skip": True} if run.get("name") in without else run for run in entries]
    try:
        subset = campaign.change({"runs": runs})
    except CampaignError as error:
        # The file itself is valid, so the error is due to the omitted runs.
        prefix = f"`without`: with {_quote_names(without)} omitted, "
        raise CampaignError(
            str(campaign.path), [prefix + problem for problem in error.problems], code=error.codes
        ) from error
    assert campaign.source is not None
    return set_source(replace(subset, path=campaign.path, title=campaign.title), campaign.source)


def _check_excluded_runs(campaign: Campaign, without: Sequence[str]) -> None:
    """Raise UsageError if a run to omit does not exist, or if no run would remain."""
    if campaign.source is None:  # `change` raises the error
        return
    document = campaign.source.document
    names = [str(run.get("name")) for run in document.get("runs", ())]
    reading_names = {reading.name for reading in campaign.readings} - set(names)
    problems = []
    for name in dict.fromkeys(without):
        if name in reading_names:
            file = document["readings"]["file"]
            problems.append(
                f'`without`: "{name}" is a row of the readings table, not an entry of [[runs]]; '
                f"remove the row from a copy of {file}"
            )
        elif name not in names:
            hint = f"the runs are {_quote_names(names)}" if names else "there are no [[runs]]"
            problems.append(f'`without`: no run is named "{name}"; {hint}')
    if not problems and not reading_names and set(names) <= {*without, *campaign.skipped}:
        problems.append(f"`without`: no run would remain; the runs are {_quote_names(names)}")
    if problems:
        raise UsageError(str(campaign.path), problems)


def _quote_names(names: Sequence[str]) -> str:
    return ", ".join(f'"{name}"' for name in names)


def _check_method(method: str, options: TwoStageOptions | None) -> None:
    """Raise UsageError for an unknown method, or for options that the method would ignore."""
    if method not in get_args(Method):
        method_names = " or ".join(get_args(Method))
        raise UsageError("calibrate", [f"`method`: {method!r} is not {method_names}"])
    if method == "joint" and options not in (None, TwoStageOptions()):
        options_text = "model, sigma, bias, ripple and weights are options of the two-stage method"
        raise UsageError("calibrate", [f'{options_text}; also give `method="two-stage"`'])


def _observe_runs(
    campaign: Campaign, progress: Callable[[int, int], None] | None
) -> tuple[ObservedRun, ...]:
    from counterspin.calibration.observed_runs import observe_runs

    observed_runs = []
    for run in observe_runs(campaign):
        observed_runs.append(run)
        if progress is not None:
            progress(len(observed_runs), len(campaign.runs))
    return tuple(observed_runs)


def _identify_averaged_files(campaign: Campaign) -> dict[Path, FileIdentity]:
    """Return the identities of records that are read only for means, before they are read."""
    files: dict[Path, FileIdentity] = {}
    for file in {*(reading.record for reading in campaign.readings), campaign.rest} - {None}:
        if file is not None and isinstance(campaign.record_at(file), Path):
            with suppress(OSError):  # reading the file raises the error
                files[file] = FileIdentity.from_file(file)
    return files


def _collect_inputs(
    campaign: Campaign,
    observed_runs: Sequence[ObservedRun],
    file_identities: Mapping[Path, FileIdentity],
    checksums: Checksums,
) -> tuple[dict[str, str], dict[str, str]]:
    """Return checksums of description and records by name, and origins of inputs in memory."""
    used_files: list[tuple[Path, FileIdentity]] = []
    for run in observed_runs:
        if run.record.identity is not None:
            used_files += [(run.run.record, run.record.identity), *run.record.other_files.items()]
    changed_files = [
        file for file, identity in file_identities.items() if _current_identity(file) != identity
    ]
    used_files += file_identities.items()
    changed_files += [file for file, identity in used_files if checksums.identity(file) != identity]
    if changed_files:
        raise RecordError(
            f"{changed_files[0]}: the file was changed during the calibration, so the result would "
            "contain a wrong checksum. Wait until the file is complete.",
            code="file-changed",
        )
    description_name, checksum, origin = _describe_source(campaign)
    inputs = {description_name: checksum}
    origins = {description_name: origin} if origin else {}
    files = []
    static_records = [campaign.rest] if campaign.rest is not None else []
    for file in (
        *(file for run in campaign.runs for file in run.files),
        *campaign.tables,
        *static_records,
    ):
        if isinstance(source := campaign.record_at(file), Path):
            files.append(file)
        else:
            inputs[_relative_name(campaign, file)] = source.checksum
            origins[_relative_name(campaign, file)] = "arrays"
    labels = (_relative_name(campaign, file) for file in files)
    inputs |= dict(zip(labels, checksums.checksums(files), strict=True))
    # Tables were hashed when they were read with the description.
    inputs |= {
        _relative_name(campaign, file): table_checksum
        for file, table_checksum in campaign.table_checksums.items()
    }
    return inputs, origins


def _current_identity(file: Path) -> FileIdentity | None:
    try:
        return FileIdentity.from_file(file)
    except OSError:
        return None


def _describe_source(campaign: Campaign) -> tuple[str, str, str | None]:
    """Return name, checksum and origin of the description; the origin of a file is None."""
    source = campaign.source
    if source is None:
        import numpy as np  # the campaign was modified in Python

        with np.printoptions(threshold=1_000_000, precision=17):
            copy = replace(campaign, path=Path(), folder=Path())
            content = repr([getattr(copy, attribute.name) for attribute in fields(copy)])
        return DESCRIPTION_NAME, f"sha256:{sha256(content.encode()).hexdigest()}", "changed"
    name = DESCRIPTION_NAME if source.file is None else _relative_name(campaign, source.file)
    origin = None
    if source.in_memory:
        origin = f"changed: {', '.join(source.changed)}" if source.changed else "made in Python"
    return name, source.content_checksum(), origin


def _relative_name(campaign: Campaign, file: Path) -> str:
    """Return a file's path relative to the campaign folder if it is below it."""
    try:
        return file.relative_to(campaign.folder).as_posix()
    except ValueError:
        return str(file)

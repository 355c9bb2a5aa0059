"""`counterspin calibrate`: from a campaign folder to the accelerometers' error coefficients."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import fields, replace
from hashlib import sha256
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, get_args

from counterspin.calibration.options import Method, TwoStageOptions, without_words
from counterspin.campaign.checksums import checksums_of
from counterspin.campaign.documents import DESCRIPTION_NAME
from counterspin.errors import CampaignError, RecordError
from counterspin.input import FileIdentity
from counterspin.records.isolation import uses_reader_process
from counterspin.records.memory import MemoryTable
from counterspin.threads import one_blas_thread

if TYPE_CHECKING:
    from counterspin.calibration.observed import ObservedRun
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
        Of the two-stage method.
    accept_misfit
        The reason for which the result may be certified and applied even if the records
        contradict it; it is kept in the result then.
    without
        Names of runs to leave out, beside those that the description leaves out.
    progress
        Called with (runs read, runs in all).

    Returns
    -------
    Result
        Coefficients in g-units of the campaign's gravity.

    Raises
    ------
    CampaignError
        If the campaign file is missing or wrong, the method is unknown, or the joint method is
        given options of the other.
    RecordError
        If a record cannot be used.
    NotIdentifiableError
        If the records cannot determine the unknowns.
    """
    _refuse_mixed(method, options)
    if accept_misfit is not None and not accept_misfit.strip():
        raise CampaignError("calibrate", ["accept_misfit: give the reason in words"])
    with checksums_of(where) as checksums, ThreadPoolExecutor(1) as beside:
        # Loaded only now: checksums need none of it, and are taken on another core meanwhile.
        from counterspin.calibration.observed import with_recorded_temperatures
        from counterspin.campaign.description import Campaign, read_campaign

        campaign = where if isinstance(where, Campaign) else read_campaign(where)
        if without:
            campaign = _left_out(campaign, without)
        beside.submit(_load, campaign)
        averaged = _averaged_files(campaign)
        with one_blas_thread():
            campaign = with_recorded_temperatures(campaign)
            observed = _observed(campaign, progress)
            checksums.hurry()
            from counterspin.calibration.assembly import calibration

            result = calibration(
                campaign,
                observed,
                method,
                options or TwoStageOptions(),
                lambda: _provenance(campaign, observed, averaged, checksums),
                accept_misfit,
            )
        if not without:
            return result
        words = [*result.provenance.options, *without_words(without)]
        provenance = result.provenance.model_copy(update={"options": words})
        return result.model_copy(update={"provenance": provenance})


def _left_out(campaign: Campaign, without: Sequence[str]) -> Campaign:
    """Return a campaign without runs; what it came from is still its file."""
    from counterspin.campaign.documents import keep, source_of

    _require_runs(campaign, without)
    described = source_of(campaign).document.get("runs", ())
    runs = [{**run, "skip": True} if run.get("name") in without else run for run in described]
    try:
        changed = campaign.change({"runs": runs})
    except CampaignError as error:
        # The file is right: what is wrong with the rest is due to what is left out.
        left = f"`without`: with {_quoted(without)} left out, "
        raise CampaignError(str(campaign.path), [left + p for p in error.problems]) from error
    assert campaign.source is not None
    return keep(replace(changed, path=campaign.path, title=campaign.title), campaign.source)


def _require_runs(campaign: Campaign, without: Sequence[str]) -> None:
    """Raise CampaignError if a run that is to be left out is none, or if none would be left."""
    if campaign.source is None:  # `change` says what to do
        return
    described = campaign.source.document
    runs = [str(run.get("name")) for run in described.get("runs", ())]
    of_table = {reading.name for reading in campaign.readings} - set(runs)
    problems = []
    for name in dict.fromkeys(without):
        if name in of_table:
            file = described["readings"]["file"]
            problems.append(
                f'`without`: "{name}" is a row of the table of readings and no entry of [[runs]]; '
                f"take the row out of a copy of {file}"
            )
        elif name not in runs:
            there = f"its runs are {_quoted(runs)}" if runs else "it has no [[runs]]"
            problems.append(f'`without`: there is no run "{name}"; {there}')
    if not problems and not of_table and set(runs) <= {*without, *campaign.skipped}:
        problems.append(f"`without`: no run would be left; its runs are {_quoted(runs)}")
    if problems:
        raise CampaignError(str(campaign.path), problems)


def _quoted(names: Sequence[str]) -> str:
    return ", ".join(f'"{name}"' for name in names)


def _load(campaign: Campaign) -> None:
    """Load beside the first record what the reading needs, then what comes after it."""
    records = [campaign.record_at(run.record) for run in campaign.runs]
    if not all(isinstance(r, MemoryTable) or uses_reader_process(r) for r in records):
        import_module("polars")
    import_module("counterspin.calibration.assembly")


def _refuse_mixed(method: str, options: TwoStageOptions | None) -> None:
    """Refuse what would be passed over in silence: half of K_II is at stake."""
    if method not in get_args(Method):
        known = " or ".join(get_args(Method))
        raise CampaignError("calibrate", [f"method: {method!r} is not {known}"])
    if method == "joint" and options not in (None, TwoStageOptions()):
        raise CampaignError(
            "calibrate",
            [
                "model, sigma, bias, ripple and weights are options of the "
                'two-stage method; with them give `method="two-stage"`'
            ],
        )


def _observed(
    campaign: Campaign, progress: Callable[[int, int], None] | None
) -> tuple[ObservedRun, ...]:
    from counterspin.calibration.observed import observe

    observed = []
    for run in observe(campaign):
        observed.append(run)
        if progress is not None:
            progress(len(observed), len(campaign.runs))
    return tuple(observed)


def _averaged_files(campaign: Campaign) -> dict[Path, FileIdentity]:
    """Return the files of means and of rest before they are read, each with its identity."""
    files: dict[Path, FileIdentity] = {}
    for file in {*(reading.record for reading in campaign.readings), campaign.rest} - {None}:
        if file is not None and isinstance(campaign.record_at(file), Path):
            with suppress(OSError):  # reading says why
                files[file] = FileIdentity.of(file)
    return files


def _provenance(
    campaign: Campaign,
    observed: Sequence[ObservedRun],
    averaged: Mapping[Path, FileIdentity],
    checksums: Checksums,
) -> tuple[dict[str, str], dict[str, str]]:
    """Return the checksums of description and records by name, and which were in memory only."""
    read: list[tuple[Path, FileIdentity]] = []
    for run in observed:
        if run.record.identity is not None:
            read += [(run.run.record, run.record.identity), *run.record.others.items()]
    # These are the same before and after they were read and hashed.
    changed = [file for file, identity in averaged.items() if _identity(file) != identity]
    read += averaged.items()
    changed += [file for file, identity in read if checksums.identity(file) != identity]
    if changed:
        raise RecordError(
            f"{changed[0]}: the file was changed while the campaign was calibrated; the result "
            "would state a wrong checksum. Wait until the file is complete."
        )
    description, checksum, how = _described(campaign)
    inputs = {description: checksum}
    in_memory = {description: how} if how else {}
    files = []
    rest = [campaign.rest] if campaign.rest is not None else []
    for file in (*(file for run in campaign.runs for file in run.files), *campaign.tables, *rest):
        if isinstance(record := campaign.record_at(file), Path):
            files.append(file)
        else:
            inputs[_name(campaign, file)] = record.checksum
            in_memory[_name(campaign, file)] = "arrays"
    names = (_name(campaign, file) for file in files)
    inputs |= dict(zip(names, checksums.of(files), strict=True))
    # What was read with the description is known as it was then.
    inputs |= {_name(campaign, file): sha for file, sha in campaign.table_checksums.items()}
    return inputs, in_memory


def _identity(file: Path) -> FileIdentity | None:
    try:
        return FileIdentity.of(file)
    except OSError:
        return None


def _described(campaign: Campaign) -> tuple[str, str, str | None]:
    """Return the description's name and checksum, and how it differs from a file's, if it does."""
    source = campaign.source
    if source is None:
        # Somebody replaced a part of it: what was used is all that can be said.
        import numpy as np

        with np.printoptions(threshold=1_000_000, precision=17):
            here = replace(campaign, path=Path(), folder=Path())
            used = repr([getattr(here, one.name) for one in fields(here)])
        return DESCRIPTION_NAME, f"sha256:{sha256(used.encode()).hexdigest()}", "changed"
    name = DESCRIPTION_NAME if source.file is None else _name(campaign, source.file)
    how = None
    if source.in_memory:
        how = f"changed: {', '.join(source.changed)}" if source.changed else "made in Python"
    return name, source.content_checksum(), how


def _name(campaign: Campaign, file: Path) -> str:
    """Return a file's name as the campaign knows it: relative to its folder where it can be."""
    try:
        return file.relative_to(campaign.folder).as_posix()
    except ValueError:
        return str(file)

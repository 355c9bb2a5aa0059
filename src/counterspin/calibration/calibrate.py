"""`counterspin calibrate`: from a campaign folder to the accelerometers' error coefficients."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import fields, replace
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, get_args

from counterspin.calibration.options import MONTE_CARLO, Method, TwoStageOptions, further_arguments
from counterspin.campaign.checksums import checksums_of
from counterspin.campaign.documents import DESCRIPTION_NAME
from counterspin.errors import CampaignError, RecordError, UsageError
from counterspin.input import FileIdentity
from counterspin.loading import load_name
from counterspin.threads import one_blas_thread

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
        Of the two-stage method.
    accept_misfit
        The reason for which the result may be certified and applied even if the records
        contradict it; it is kept in the result then.
    without
        Names of runs to leave out, beside those that the description leaves out.
    monte_carlo
        Trials of a Monte Carlo for coverage intervals (JCGM 101), 10^4 to 10^7; 0: none.
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
    _check_method(method, options)
    if monte_carlo:
        load_name(f"{MONTE_CARLO}:check_trials")(monte_carlo, method)
    if accept_misfit is not None and not accept_misfit.strip():
        raise UsageError("calibrate", ["`accept_misfit`: state the reason in words"])
    with checksums_of(where) as checksums:
        # Loaded only now: checksums and the start of the reader process run in the meantime.
        from counterspin.calibration.observed_runs import with_recorded_conditions
        from counterspin.campaign.description import Campaign, read_campaign

        campaign = where if isinstance(where, Campaign) else read_campaign(where)
        if without:
            campaign = _exclude_runs(campaign, without)
        from counterspin.calibration.assembly import assemble_result

        file_identities = _identify_averaged_files(campaign)
        with one_blas_thread():
            campaign = with_recorded_conditions(campaign)
            observed = _observe_runs(campaign, progress)
            checksums.run_parallel()
            result = assemble_result(
                campaign,
                observed,
                method,
                options or TwoStageOptions(),
                lambda: _collect_inputs(campaign, observed, file_identities, checksums),
                accept_misfit,
            )
            if monte_carlo:
                add_intervals = load_name(f"{MONTE_CARLO}:add_intervals")
                result = add_intervals(result, campaign, observed, monte_carlo)
        if not without and not monte_carlo:
            return result
        option_words = [*result.provenance.options, *further_arguments(without, monte_carlo)]
        provenance = result.provenance.model_copy(update={"options": option_words})
        return result.model_copy(update={"provenance": provenance})


def _exclude_runs(campaign: Campaign, without: Sequence[str]) -> Campaign:
    """Return a campaign without runs; what it came from is still its file."""
    from counterspin.campaign.documents import require_source, with_source

    _check_excluded(campaign, without)
    entries = require_source(campaign).document.get("runs", ())
    runs = [{**run, "skip": True} if run.get("name") in without else run for run in entries]
    try:
        changed = campaign.change({"runs": runs})
    except CampaignError as error:
        # The file is right: what is wrong with the rest is due to what is left out.
        prefix = f"`without`: with {_quote_names(without)} omitted, "
        raise CampaignError(
            str(campaign.path), [prefix + problem for problem in error.problems], code=error.codes
        ) from error
    assert campaign.source is not None
    return with_source(replace(changed, path=campaign.path, title=campaign.title), campaign.source)


def _check_excluded(campaign: Campaign, without: Sequence[str]) -> None:
    """Raise CampaignError if a run that is to be left out is none, or if none would be left."""
    if campaign.source is None:  # `change` says what to do
        return
    document = campaign.source.document
    runs = [str(run.get("name")) for run in document.get("runs", ())]
    table_rows = {reading.name for reading in campaign.readings} - set(runs)
    problems = []
    for name in dict.fromkeys(without):
        if name in table_rows:
            file = document["readings"]["file"]
            problems.append(
                f'`without`: "{name}" is a row of the readings table, not an entry of [[runs]]; '
                f"remove the row from a copy of {file}"
            )
        elif name not in runs:
            hint = f"the runs are {_quote_names(runs)}" if runs else "there are no [[runs]]"
            problems.append(f'`without`: no run is named "{name}"; {hint}')
    if not problems and not table_rows and set(runs) <= {*without, *campaign.skipped}:
        problems.append(f"`without`: no run would remain; the runs are {_quote_names(runs)}")
    if problems:
        raise UsageError(str(campaign.path), problems)


def _quote_names(names: Sequence[str]) -> str:
    return ", ".join(f'"{name}"' for name in names)


def _check_method(method: str, options: TwoStageOptions | None) -> None:
    """Refuse what would be passed over in silence: half of K_II is at stake."""
    if method not in get_args(Method):
        known = " or ".join(get_args(Method))
        raise UsageError("calibrate", [f"`method`: {method!r} is not {known}"])
    if method == "joint" and options not in (None, TwoStageOptions()):
        options_text = "model, sigma, bias, ripple and weights are options of the two-stage method"
        raise UsageError("calibrate", [f'{options_text}; with them give `method="two-stage"`'])


def _observe_runs(
    campaign: Campaign, progress: Callable[[int, int], None] | None
) -> tuple[ObservedRun, ...]:
    from counterspin.calibration.observed_runs import observe

    observed = []
    for run in observe(campaign):
        observed.append(run)
        if progress is not None:
            progress(len(observed), len(campaign.runs))
    return tuple(observed)


def _identify_averaged_files(campaign: Campaign) -> dict[Path, FileIdentity]:
    """Return the files of means and of rest before they are read, each with its identity."""
    files: dict[Path, FileIdentity] = {}
    for file in {*(reading.record for reading in campaign.readings), campaign.rest} - {None}:
        if file is not None and isinstance(campaign.record_at(file), Path):
            with suppress(OSError):  # reading says why
                files[file] = FileIdentity.of(file)
    return files


def _collect_inputs(
    campaign: Campaign,
    observed: Sequence[ObservedRun],
    file_identities: Mapping[Path, FileIdentity],
    checksums: Checksums,
) -> tuple[dict[str, str], dict[str, str]]:
    """Return the checksums of description and records by name, and which were in memory only."""
    read_files: list[tuple[Path, FileIdentity]] = []
    for run in observed:
        if run.record.identity is not None:
            read_files += [(run.run.record, run.record.identity), *run.record.other_files.items()]
    # These are the same before and after they were read and hashed.
    changed = [
        file for file, identity in file_identities.items() if _current_identity(file) != identity
    ]
    read_files += file_identities.items()
    changed += [file for file, identity in read_files if checksums.identity(file) != identity]
    if changed:
        raise RecordError(
            f"{changed[0]}: the file was changed during the calibration, so the result would "
            "contain a wrong checksum. Wait until the file is complete.",
            code="file-changed",
        )
    description, checksum, origin = _describe_source(campaign)
    inputs = {description: checksum}
    in_memory = {description: origin} if origin else {}
    files = []
    static_records = [campaign.rest] if campaign.rest is not None else []
    for file in (
        *(file for run in campaign.runs for file in run.files),
        *campaign.tables,
        *static_records,
    ):
        if isinstance(record := campaign.record_at(file), Path):
            files.append(file)
        else:
            inputs[_file_label(campaign, file)] = record.checksum
            in_memory[_file_label(campaign, file)] = "arrays"
    names = (_file_label(campaign, file) for file in files)
    inputs |= dict(zip(names, checksums.checksums(files), strict=True))
    # What was read with the description is known as it was then.
    inputs |= {
        _file_label(campaign, file): table_checksum
        for file, table_checksum in campaign.table_checksums.items()
    }
    return inputs, in_memory


def _current_identity(file: Path) -> FileIdentity | None:
    try:
        return FileIdentity.of(file)
    except OSError:
        return None


def _describe_source(campaign: Campaign) -> tuple[str, str, str | None]:
    """Return the description's name and checksum, and how it differs from a file's, if it does."""
    source = campaign.source
    if source is None:
        # Somebody replaced a part of it: what was used is all that can be said.
        import numpy as np

        with np.printoptions(threshold=1_000_000, precision=17):
            detached = replace(campaign, path=Path(), folder=Path())
            content = repr([getattr(detached, attribute.name) for attribute in fields(detached)])
        return DESCRIPTION_NAME, f"sha256:{sha256(content.encode()).hexdigest()}", "changed"
    name = DESCRIPTION_NAME if source.file is None else _file_label(campaign, source.file)
    origin = None
    if source.in_memory:
        origin = f"changed: {', '.join(source.changed)}" if source.changed else "made in Python"
    return name, source.content_checksum(), origin


def _file_label(campaign: Campaign, file: Path) -> str:
    """Return a file's name as the campaign knows it: relative to its folder where it can be."""
    try:
        return file.relative_to(campaign.folder).as_posix()
    except ValueError:
        return str(file)

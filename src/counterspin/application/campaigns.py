"""Campaigns and results of the folder, with their states."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final

from counterspin.application.answers import (
    CampaignEntry,
    CampaignOverview,
    FolderOverview,
    JobEntry,
    NamedText,
    PlanEntry,
    ResultEntry,
    RunEntry,
    WrittenCampaign,
)
from counterspin.application.app_state import AppState
from counterspin.application.campaign_files import COPY_PREFIX, find_free_name, list_trash
from counterspin.application.checklist import make_checklist
from counterspin.application.commands import calibrate_command, demo_command, init_command
from counterspin.application.jobs import Job, ProgressCallback, report_progress, run_calibration
from counterspin.application.laboratory import PROFILE_NAME
from counterspin.application.record_plots import STUDY_NAME
from counterspin.application.served_folder import RequestError
from counterspin.calibration.options import Method
from counterspin.calibration.pages.accelerometer import to_field_units
from counterspin.calibration.pages.card import STATE_NAMES, main_symbol
from counterspin.calibration.result import Result
from counterspin.campaign.documents import DESCRIPTION_NAME, load_document, table_of
from counterspin.errors import CampaignError, CounterspinError, RecordError
from counterspin.ingest.starter import Test
from counterspin.input import MAX_DOCUMENT_BYTES
from counterspin.physics.terms import TERMS
from counterspin.planning.plan_file import is_plan
from counterspin.reports.numbers import format_estimate
from counterspin.reports.typography import typeset
from counterspin.temporary_folders import temporary_folder

#: File name of a campaign's result; other results in the folder are variants.
_RESULT_NAME: Final = "result.json"

#: State of a campaign -> its label.
_STATE_LABELS: Final[Mapping[str, str]] = {
    "mistakes": "Errors in the description",
    "records missing": "Records missing",
    "not calibrated": "Not calibrated yet",
    "changed": "Changed since the last calibration",
    **{str(state): words for state, words in STATE_NAMES.items()},
}


def folder_overview(app: AppState) -> FolderOverview:
    """Return the folder's campaigns, other results, plans and laboratory data."""
    campaigns: list[CampaignEntry] = []
    other_results: list[ResultEntry] = []
    plans: list[PlanEntry] = []
    labs: list[str] = []
    for folder, files in app.folder.folders():
        name = app.folder.name(folder)
        results = list(_iter_results(app, folder, files))
        if DESCRIPTION_NAME in files and app.folder.contains(folder / DESCRIPTION_NAME):
            campaigns.append(_campaign_entry(app, name, results))
        else:
            other_results += results
        for file in files:
            match _detect_document_type(app, folder / file):
                case ("plan", title):
                    plans.append({"name": app.folder.name(folder / file), "title": title})
                case ("lab", _):
                    labs.append(app.folder.name(folder / file))
    return {
        "folder": app.folder.root.name,
        "campaigns": campaigns,
        "results": other_results,
        "plans": plans,
        "labs": labs,
        "trash": list_trash(app),
        "terms": [{"name": name, "words": row.words} for name, row in TERMS.items()],
    }


def _detect_document_type(app: AppState, path: Path) -> tuple[str, str]:
    """Return the type of a TOML file (``plan``, ``lab``, or empty if other), and its title."""
    if path.suffix.lower() != ".toml" or path.name in (DESCRIPTION_NAME, PROFILE_NAME):
        return "", ""
    if not app.folder.contains(path):
        return "", ""

    def detect_type() -> tuple[str, str]:
        try:
            document = load_document(path)
        except CounterspinError:
            return "", ""
        if is_plan(document):
            return "plan", str(table_of(document, "campaign").get("title", ""))
        return "lab" if {"certificate", "laboratory"} <= document.keys() else "", ""

    return app.cache.get(("kind", path), [path], detect_type)


def _iter_results(app: AppState, folder: Path, files: list[str]) -> Iterator[ResultEntry]:
    """Yield the results among the files of a folder."""
    for file in files:
        path = folder / file
        if path.suffix.lower() != ".json" or not app.folder.contains(path):
            continue
        entry = app.cache.get(("line", path), [path], partial(_result_entry, app, path))
        if entry is not None:
            yield entry


def _result_entry(app: AppState, path: Path) -> ResultEntry | None:
    """Return a result's entry for a list; None if the file is damaged or not a result."""
    from counterspin.calibration.findings import judge_result

    name = app.folder.name(path)
    try:
        if path.stat().st_size > MAX_DOCUMENT_BYTES or not Result.file_kind().recognises(path):
            return None
        result = judge_result(Result.read(path))
    except OSError:
        return None
    except RecordError as error:
        return {"name": name, "state": "damaged", "words": app.folder.relative_paths(str(error))}
    values: list[NamedText] = []
    for accelerometer, accelerometer_result in result.accelerometers.items():
        if coefficients := accelerometer_result.coefficients:
            symbol = main_symbol(coefficients)
            value, u, unit = to_field_units(coefficients[symbol])
            is_estimated = coefficients[symbol].estimated
            value_text = format_estimate(value, u, unit) if is_estimated else "not determined"
            values.append({"name": f"{symbol} of {accelerometer}", "text": typeset(value_text)})
    return {
        "name": name,
        "state": result.state or "good",
        "words": _STATE_LABELS[result.state or "good"],
        "title": result.title,
        "method": result.method,
        "answers": values,
        "serial_numbers": [a.serial_number for a in result.accelerometers.values()],
        "written": path.stat().st_mtime,
        "description": result.provenance.inputs.get(DESCRIPTION_NAME, ""),
    }


def _campaign_entry(app: AppState, name: str, results: list[ResultEntry]) -> CampaignEntry:
    """Return a campaign's entry for the list of campaigns."""
    path = app.description_path(name)
    entry: CampaignEntry = {
        "name": name,
        "title": name or app.folder.root.name,
        "results": sorted(results, key=_result_sort_key),
        "mistakes": [],
        "missing": [],
        "runs": 0,
        "instruments": [],
        "state": "",
        "words": "",
    }
    try:
        campaign = app.campaign(name)
    except CampaignError as error:
        entry["mistakes"] = [app.folder.relative_paths(problem) for problem in error.problems]
    except CounterspinError as error:
        entry["mistakes"] = [app.folder.relative_paths(str(error))]
    else:
        entry["title"] = campaign.title or entry["title"]
        triad = campaign.triad
        n_poses = len(triad.poses) + len(triad.records) if triad else 0
        entry["runs"] = len(campaign.runs) + len(campaign.readings) + n_poses
        entry["instruments"] = list(campaign.accelerometers)
        records = [run.record for run in campaign.runs]
        entry["missing"] = [app.folder.name(file) for file in records if not file.is_file()]
    entry["state"] = _campaign_state(app, path, entry)
    entry["words"] = _STATE_LABELS.get(entry["state"], entry["state"])
    return entry


def _result_sort_key(result: ResultEntry) -> tuple[bool, bool, bool, float]:
    """Return the sort key of a campaign's results, with the representative result first.

    The representative result is ``result.json``, otherwise the newest result of the joint method,
    otherwise the newest result. Results of other methods or fewer runs have other file names.
    """
    return (
        result["state"] == "damaged",
        Path(result["name"]).name != _RESULT_NAME,
        result.get("method") != "joint",
        -result.get("written", 0.0),
    )


def _campaign_state(app: AppState, path: Path, entry: CampaignEntry) -> str:
    """Return the state of a campaign."""
    if entry["mistakes"]:
        return "mistakes"
    result = next((result for result in entry["results"] if result["state"] != "damaged"), None)
    if result is None:
        return "records missing" if entry["missing"] else "not calibrated"
    checksum = app.folder.read(app.folder.name(path)).version
    records = [path.parent / run.record for run in app.campaign(entry["name"]).runs]
    has_newer_records = any(
        record.is_file() and record.stat().st_mtime > result["written"] for record in records
    )
    if has_newer_records or result["description"] not in ("", f"sha256:{checksum}"):
        return "changed"
    return str(result["state"])


def campaign_overview(app: AppState, name: str) -> CampaignOverview:
    """Return the data for the page of one campaign."""
    path = app.description_path(name)
    files = sorted(file.name for file in path.parent.iterdir() if file.is_file())
    entry = _campaign_entry(app, name, list(_iter_results(app, path.parent, files)))
    description_text = app.folder.read(app.folder.name(path))
    result_path = path.parent / _RESULT_NAME
    study_path = path.parent / STUDY_NAME
    return {
        **entry,
        "study": app.folder.name(study_path)
        if app.folder.contains(study_path) and study_path.is_file()
        else None,
        "text": description_text.text,
        "version": description_text.version,
        "run_list": _run_entries(app, name, path),
        "checklist": [] if entry["mistakes"] else make_checklist(app.campaign(name)),
        "command": calibrate_command(path.parent, result_path, "joint", None),
        "jobs": [job.to_dict() for job in app.jobs.all() if job.campaign == name],
    }


def _run_entries(app: AppState, name: str, path: Path) -> list[RunEntry]:
    """Return the runs of a description, even if it has mistakes."""
    try:
        campaign = app.campaign(name)
    except CounterspinError:
        try:
            runs = load_document(path).get("runs", [])
        except CounterspinError:
            return []
        valid_runs = (
            [run for run in runs if isinstance(run, dict)] if isinstance(runs, list) else []
        )
        return [
            {"name": str(run.get("name", "")), "rate": None, "record": None, "bytes": None}
            for run in valid_runs
        ]
    return [
        {
            "name": run.name,
            "rate": run.rate,
            "record": app.folder.name(run.record),
            "bytes": run.record.stat().st_size if run.record.is_file() else None,
        }
        for run in campaign.runs
    ]


def begin_calibration(
    app: AppState,
    name: str,
    output: str = _RESULT_NAME,
    method: Method = "joint",
    accept_misfit: str | None = None,
) -> JobEntry:
    """Start a campaign's calibration; return the job.

    name: The campaign's folder.
    output: Name of the result file in this folder.
    """
    path = app.description_path(name)
    app.campaign(name)
    if "/" in output or not output.lower().endswith(".json"):
        raise RequestError(
            f"{output!r} is not a valid name for a result file; use a name such as result.json"
        )
    target = app.folder.path(f"{name}/{output}" if name else output)
    command = calibrate_command(path.parent, target, method, accept_misfit)

    def make_job(number: int) -> Job:
        return Job(number, name, app.folder.name(target), command)

    return app.jobs.begin(make_job, run_calibration, path, target, method, accept_misfit).to_dict()


def begin_campaign(app: AppState, name: str, test: Test = "double-turntable") -> WrittenCampaign:
    """Write an example campaign into a folder; return its name and the command."""
    from counterspin.ingest.starter import init

    if not name:
        raise RequestError("enter a folder name for the new campaign")
    folder = app.target_path(name)
    init(folder, test)
    return {"name": name, "command": init_command(folder, test)}


def begin_sample(app: AppState) -> JobEntry:
    """Start to simulate and calibrate a sample campaign in a new folder; return the job."""
    name = find_free_name(app, "sample")
    target = app.target_path(name)

    def make_job(number: int) -> Job:
        return Job(number, name, name, demo_command(target), "sample")

    return app.jobs.begin(make_job, run_sample, target).to_dict()


def run_sample(connection: Connection, folder: Path) -> None:
    """Simulate and calibrate a sample; report to `connection` as `report_progress` does."""

    def simulate_and_calibrate(progress: ProgressCallback) -> None:
        from counterspin.calibration.calibrate import calibrate
        from counterspin.reproduction.demo import write_description
        from counterspin.simulation.simulate import simulate

        # A sample that fails or is stopped leaves no folder.
        with temporary_folder(COPY_PREFIX, folder.parent) as temporary_parent:
            sample_folder = temporary_parent / folder.name
            write_description(sample_folder)
            simulate(sample_folder, sample_folder)
            calibrate(sample_folder, progress=progress).write(sample_folder / _RESULT_NAME)
            sample_folder.rename(folder)

    report_progress(connection, simulate_and_calibrate)


def to_json(value: Any) -> str:
    """Return a response as JSON; infinite values and NaN become null.

    The text is ASCII, because file names may contain bytes that are not valid UTF-8.
    """
    try:
        return json.dumps(value, allow_nan=False, separators=(",", ":"))
    except ValueError:
        return json.dumps(_replace_nonfinite(value), allow_nan=False, separators=(",", ":"))


def _replace_nonfinite(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: _replace_nonfinite(item) for key, item in value.items()}
    return (
        [_replace_nonfinite(item) for item in value] if isinstance(value, list | tuple) else value
    )

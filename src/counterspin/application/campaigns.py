"""The campaigns of the folder, with their state."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final

from counterspin.application.checklist import checklist
from counterspin.application.desk import Desk, calibrate_command, demo_command, init_command
from counterspin.application.jobs import Job, Progress, calibrate_into, report_progress
from counterspin.application.keeping import COPY_PREFIX, free_name, trash_contents
from counterspin.application.laboratory import PROFILE_NAME
from counterspin.application.record_plots import STUDY_NAME
from counterspin.calibration.options import Method
from counterspin.calibration.pages.accelerometer import to_field_units
from counterspin.calibration.pages.card import STATE_WORDS
from counterspin.calibration.result import Result
from counterspin.campaign.documents import DESCRIPTION_NAME, load_document, table_of
from counterspin.errors import CampaignError, CounterspinError, RecordError
from counterspin.ingest.starter import Test
from counterspin.input import DOCUMENT_BYTES
from counterspin.physics.terms import TERMS
from counterspin.planning.plan_file import is_plan
from counterspin.reports.numbers import format_estimate
from counterspin.reports.typography import typeset
from counterspin.temporary_folders import temporary_folder

#: The file of a campaign's own result; other results beside it are tries.
_RESULT_NAME: Final = "result.json"

#: State of a campaign -> its words.
_WORDS: Final[Mapping[str, str]] = {
    "mistakes": "The description has mistakes",
    "records missing": "Records are missing",
    "not calibrated": "Not calibrated yet",
    "changed": "Changed since its result",
    **{str(state): words for state, words in STATE_WORDS.items()},
}


def folder_overview(desk: Desk) -> dict[str, Any]:
    """Return the folder's campaigns, and its results that belong to no campaign."""
    campaigns, others = [], []
    plans: list[dict[str, str]] = []
    labs: list[str] = []
    for folder, files in desk.folder.folders():
        name = desk.folder.name(folder)
        results = list(_results(desk, folder, files))
        if DESCRIPTION_NAME in files and desk.folder.holds(folder / DESCRIPTION_NAME):
            campaigns.append(_line(desk, name, results))
        else:
            others += results
        for file in files:
            match _toml_kind(desk, folder / file):
                case ("plan", title):
                    plans.append({"name": desk.folder.name(folder / file), "title": title})
                case ("lab", _):
                    labs.append(desk.folder.name(folder / file))
    return {
        "folder": desk.folder.root.name,
        "campaigns": campaigns,
        "results": others,
        "plans": plans,
        "labs": labs,
        "trash": trash_contents(desk),
        "terms": [{"name": name, "words": row.words} for name, row in TERMS.items()],
    }


def _toml_kind(desk: Desk, path: Path) -> tuple[str, str]:
    """Return the kind of a file, ``plan`` or ``lab`` (the laboratory's data), and its title."""
    if path.suffix.lower() != ".toml" or path.name in (DESCRIPTION_NAME, PROFILE_NAME):
        return "", ""
    if not desk.folder.holds(path):
        return "", ""

    def look() -> tuple[str, str]:
        try:
            document = load_document(path)
        except CounterspinError:
            return "", ""
        if is_plan(document):
            return "plan", str(table_of(document, "campaign").get("title", ""))
        return "lab" if {"certificate", "laboratory"} <= document.keys() else "", ""

    return desk.remembered.get(("kind", path), [path], look)


def _results(desk: Desk, folder: Path, files: list[str]) -> Iterator[dict[str, Any]]:
    """Yield the results among the files of a folder."""
    for file in files:
        path = folder / file
        if path.suffix.lower() != ".json" or not desk.folder.holds(path):
            continue
        shown = desk.remembered.get(("line", path), [path], partial(_result_line, desk, path))
        if shown is not None:
            yield shown


def _result_line(desk: Desk, path: Path) -> dict[str, Any] | None:
    """Return a result's entry for a list; None if the file is damaged or not a result."""
    from counterspin.calibration.findings import judge_result

    name = desk.folder.name(path)
    try:
        if path.stat().st_size > DOCUMENT_BYTES or not Result.file_kind().recognises(path):
            return None
        result = judge_result(Result.read(path))
    except OSError:
        return None
    except RecordError as error:
        return {"name": name, "state": "damaged", "words": desk.folder.spoken(str(error))}
    answers = []
    for accelerometer, found in result.accelerometers.items():
        if (k_ii := found.coefficients.get("K_II")) is not None:
            value, u, unit = to_field_units(k_ii)
            text = format_estimate(value, u, unit) if k_ii.estimated else "not determined"
            answers.append({"name": f"K_II of {accelerometer}", "text": typeset(text)})
    return {
        "name": name,
        "state": result.state,
        "words": _WORDS[result.state or "good"],
        "title": result.title,
        "method": result.method,
        "answers": answers,
        "serial_numbers": [a.serial_number for a in result.accelerometers.values()],
        "written": path.stat().st_mtime,
        "description": result.provenance.inputs.get(DESCRIPTION_NAME, ""),
    }


def _line(desk: Desk, name: str, results: list[dict[str, Any]]) -> dict[str, Any]:
    """Return a campaign's entry for the list of campaigns."""
    path = desk.description(name)
    line: dict[str, Any] = {
        "name": name,
        "title": name or desk.folder.root.name,
        "results": sorted(results, key=_rank),
        "mistakes": [],
        "missing": [],
        "runs": 0,
        "instruments": [],
    }
    try:
        campaign = desk.campaign(name)
    except CampaignError as error:
        line["mistakes"] = [desk.folder.spoken(problem) for problem in error.problems]
    except CounterspinError as error:
        line["mistakes"] = [desk.folder.spoken(str(error))]
    else:
        line["title"] = campaign.title or line["title"]
        triad = campaign.triad
        posed = len(triad.poses) + len(triad.records) if triad else 0
        line["runs"] = len(campaign.runs) + len(campaign.readings) + posed
        line["instruments"] = list(campaign.accelerometers)
        records = [run.record for run in campaign.runs]
        line["missing"] = [desk.folder.name(file) for file in records if not file.is_file()]
    line["state"] = _state(desk, path, line)
    line["words"] = _WORDS.get(line["state"], line["state"])
    return line


def _rank(result: dict[str, Any]) -> tuple[bool, bool, bool, float]:
    """Return the key that sorts a campaign's results, its representative result first.

    That is ``result.json``; without it, the newest by the joint method, then the newest. Another
    method or fewer runs are written to another file, and the campaign keeps its result.
    """
    return (
        result["state"] == "damaged",
        Path(result["name"]).name != _RESULT_NAME,
        result.get("method") != "joint",
        -result.get("written", 0.0),
    )


def _state(desk: Desk, path: Path, line: dict[str, Any]) -> str:
    """Return the state of a campaign."""
    if line["mistakes"]:
        return "mistakes"
    result = next((r for r in line["results"] if r["state"] != "damaged"), None)
    if result is None:
        return "records missing" if line["missing"] else "not calibrated"
    checksum = desk.folder.read(desk.folder.name(path)).version
    records = [path.parent / run.record for run in desk.campaign(line["name"]).runs]
    later = any(r.is_file() and r.stat().st_mtime > result["written"] for r in records)
    if later or result["description"] not in ("", f"sha256:{checksum}"):
        return "changed"
    return str(result["state"])


def campaign_overview(desk: Desk, name: str) -> dict[str, Any]:
    """Return the data for the page of one campaign."""
    path = desk.description(name)
    files = sorted(file.name for file in path.parent.iterdir() if file.is_file())
    line = _line(desk, name, list(_results(desk, path.parent, files)))
    text = desk.folder.read(desk.folder.name(path))
    output = path.parent / _RESULT_NAME
    study = path.parent / STUDY_NAME
    return line | {
        "study": desk.folder.name(study) if desk.folder.holds(study) and study.is_file() else None,
        "text": text.text,
        "version": text.version,
        "run_list": _runs(desk, name, path),
        "checklist": [] if line["mistakes"] else checklist(desk.campaign(name)),
        "command": calibrate_command(path.parent, output, "joint", None),
        "jobs": [job.shown() for job in desk.jobs.all() if job.campaign == name],
    }


def _runs(desk: Desk, name: str, path: Path) -> list[dict[str, Any]]:
    """Return the runs of a description, even if it has mistakes."""
    try:
        campaign = desk.campaign(name)
    except CounterspinError:
        try:
            runs = load_document(path).get("runs", [])
        except CounterspinError:
            return []
        named = [run for run in runs if isinstance(run, dict)] if isinstance(runs, list) else []
        return [{"name": str(run.get("name", "")), "record": None} for run in named]
    return [
        {
            "name": run.name,
            "rate": run.rate,
            "record": desk.folder.name(run.record),
            "bytes": run.record.stat().st_size if run.record.is_file() else None,
        }
        for run in campaign.runs
    ]


def begin_calibration(
    desk: Desk,
    name: str,
    output: str = _RESULT_NAME,
    method: Method = "joint",
    accept_misfit: str | None = None,
) -> dict[str, Any]:
    """Start a campaign's calibration; return the job.

    name: The campaign's folder.
    output: Name of the result's file in it.
    """
    path = desk.description(name)
    desk.campaign(name)
    if "/" in output or not output.lower().endswith(".json"):
        raise CounterspinError(f"{output!r}: name the result's file, such as result.json")
    place = desk.folder.path(f"{name}/{output}" if name else output)
    command = calibrate_command(path.parent, place, method, accept_misfit)

    def make(number: int) -> Job:
        return Job(number, name, desk.folder.name(place), command)

    return desk.jobs.begin(make, calibrate_into, path, place, method, accept_misfit).shown()


def begin_campaign(desk: Desk, name: str, test: Test = "double-turntable") -> dict[str, Any]:
    """Write an example campaign into a folder; return its name and the command."""
    from counterspin.ingest.starter import init

    if not name:
        raise CounterspinError("give the new campaign's folder a name")
    folder = desk.place(name)
    init(folder, test)
    return {"name": name, "command": init_command(folder, test)}


def begin_sample(desk: Desk) -> dict[str, Any]:
    """Start to simulate and calibrate a sample campaign in a new folder; return the job."""
    name = free_name(desk, "sample")
    place = desk.place(name)

    def make(number: int) -> Job:
        return Job(number, name, name, demo_command(place), "sample")

    return desk.jobs.begin(make, sample_into, place).shown()


def sample_into(there: Connection, folder: Path) -> None:
    """Simulate and calibrate a sample; report to `there` as `report_progress` does."""

    def work(progress: Progress) -> None:
        from counterspin.calibration.calibrate import calibrate
        from counterspin.reproduction.demo import write_description
        from counterspin.simulation.simulate import simulate

        # A sample that fails or is stopped leaves no folder.
        with temporary_folder(COPY_PREFIX, folder.parent) as temporary:
            sample = temporary / folder.name
            write_description(sample)
            simulate(sample, sample)
            calibrate(sample, progress=progress).write(sample / _RESULT_NAME)
            sample.rename(folder)

    report_progress(there, work)


def as_json(value: Any) -> str:
    """Return an answer as JSON; infinite values and NaN become null.

    The text is ASCII, because a file's name may have bytes without an encoding in UTF-8.
    """
    try:
        return json.dumps(value, allow_nan=False, separators=(",", ":"))
    except ValueError:
        return json.dumps(_finite(value), allow_nan=False, separators=(",", ":"))


def _finite(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: _finite(one) for key, one in value.items()}
    return [_finite(one) for one in value] if isinstance(value, list | tuple) else value

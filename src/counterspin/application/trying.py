"""What a campaign would tell before it is recorded: simulated records and studies."""

from __future__ import annotations

from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final

from counterspin.application.commands import simulate_command, study_command
from counterspin.application.desk import Desk
from counterspin.application.jobs import Job
from counterspin.application.processes import Progress, report_progress
from counterspin.campaign.toml_file import DESCRIPTION_NAME, load_document
from counterspin.errors import CounterspinError

#: Where a study of a campaign is kept, in its folder.
STUDY_NAME: Final = "study.json"


def begin_study(desk: Desk, name: str, trials: int) -> dict[str, Any]:
    """Begin to study a campaign; return the job.

    name: The campaign's folder; its ``study.json`` takes the result, in place of an earlier one.
    """
    from counterspin.studies.description import read_study

    path = desk.description(name)
    desk.campaign(name)
    read_study(path)
    place = desk.folder.path(f"{name}/{STUDY_NAME}" if name else STUDY_NAME)
    command = study_command(path.parent, trials, place)

    def make(number: int) -> Job:
        return Job(number, name, desk.folder.name(place), command, "study")

    return desk.jobs.begin(make, study_into, path, place, trials).shown()


def study_into(there: Connection, campaign: Path, output: Path, trials: int) -> None:
    """Study a campaign and write its result; `there` is told as of `processes.report_progress`."""

    def work(progress: Progress) -> None:
        from counterspin.output import reserve
        from counterspin.studies.result import StudyResult
        from counterspin.studies.study import study

        reserve(output, StudyResult.file_kind, overwrite=True)
        study(campaign, trials=trials, progress=progress).write(output, overwrite=True)

    report_progress(there, work)


def begin_simulation(desk: Desk, name: str, folder: str) -> dict[str, Any]:
    """Begin to make the records of a campaign, in another folder; return the job.

    name: The campaign's folder.
    """
    path = desk.description(name)
    desk.campaign(name)
    place = desk.place(folder)
    if not folder:
        raise CounterspinError("give the folder of the simulated records a name")
    if (place / DESCRIPTION_NAME).exists():
        raise CounterspinError(f"{folder} holds a campaign already; name another folder")
    desk.require_inside(place, load_document(path))
    command = simulate_command(path.parent, place)

    def make(number: int) -> Job:
        return Job(number, name, desk.folder.name(place), command, "simulation")

    return desk.jobs.begin(make, simulate_into, path, place).shown()


def simulate_into(there: Connection, campaign: Path, folder: Path) -> None:
    """Make a campaign's records in a folder; `there` is told as of `processes.report_progress`."""

    def work(progress: Progress) -> None:
        from counterspin.simulation.simulate import simulate

        simulate(campaign, folder, progress=progress)

    report_progress(there, work)

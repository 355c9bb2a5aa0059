"""What the page may ask, by name: each request's form, and what answers it."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import Any, Final, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, FiniteFloat, ValidationError

from counterspin.application import (
    campaigns,
    certification,
    descriptions,
    drafts,
    judging,
    pages,
    plans,
    record_plots,
    trying,
)
from counterspin.application.desk import Desk
from counterspin.application.folder import ChangedMeanwhileError, NotThereError, OutsideError
from counterspin.calibration.options import Method
from counterspin.campaign.starter import Test
from counterspin.errors import CampaignError, CounterspinError
from counterspin.frozen import frozen

T = TypeVar("T")


class Asked(BaseModel):
    """What a request says; nothing else may be said."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Nothing(Asked):
    """A request that says nothing."""


class Named(Asked):
    """A file or campaign, by its name in the folder."""

    name: str


class PageAsked(Asked):
    """A page of results, whose names stand one below the other."""

    kind: pages.Kind
    names: str
    term: str = "K_II"

    @property
    def files(self) -> list[str]:
        """The results' files."""
        return self.names.split("\n")


class PictureAsked(PageAsked):
    """A picture of such a page."""

    place: int


class RecordAsked(Named):
    """The record of a run."""

    run: str


class WatchAsked(Named):
    """The state of a campaign whose records grow."""

    goal: str = ""


class DraftAsked(Asked):
    """What files of a recorder show."""

    names: list[str]


class DraftedAsked(DraftAsked):
    """The campaign that they make."""

    folder: str
    answers: dict[str, str] = {}


class WindowAsked(RecordAsked):
    """A part of it, between two times."""

    low: FiniteFloat
    high: FiniteFloat
    parts: int = 1000


class LimitsAsked(Named):
    """A plan whose limits are moved."""

    moved: dict[str, FiniteFloat] = {}


class PlannedAsked(LimitsAsked):
    """The campaign of such a plan."""

    folder: str


class CertificateAsked(Asked):
    """A certificate that is to be issued."""

    result: str
    lab: str
    output: str


class CalibrationAsked(Named):
    """A calibration."""

    output: str = "result.json"
    method: Method = "joint"
    accept_misfit: str | None = None


class ReportAsked(Named):
    """The report of a result, as a file of a kind."""

    kind: Literal["html", "md", "pdf"]


class TicketAsked(Asked):
    """An address that counts once for a file, which the browser fetches by itself."""

    name: Literal["report", "file"]
    said: dict[str, str]


class StudyAsked(Named):
    """A study of a campaign."""

    trials: int


class SimulationAsked(Named):
    """Records of a campaign, made in a folder."""

    folder: str


class JobAsked(Asked):
    """A job, by its number."""

    number: int


class CampaignAsked(Named):
    """A new campaign."""

    test: Test = "double-turntable"


_STATUS: Final = {ChangedMeanwhileError: 409, NotThereError: 404, OutsideError: 403}


class LabAsked(Asked):
    """The laboratory's data, for the certificate of a result."""

    file: str
    result: str


class TextAsked(Asked):
    """A text in the place of a file; `result`: for whose certificate, if it is the laboratory's."""

    file: str
    text: str
    result: str | None = None


class ChangeAsked(TextAsked):
    """A text with another value at a key."""

    path: list[str | int]
    value: Any
    kind: Literal["", "date"] = ""


class SavingAsked(TextAsked):
    """A text that is to be the file's, in place of the version that was seen."""

    version: str


@frozen
class Answer:
    """What is answered: status, content, what it is, and under which name it is to be saved."""

    status: int
    content: Any
    kind: str = "application/json"
    name: str | None = None


Endpoint = tuple[type[Asked], Callable[[Desk, Any], Any]]

ENDPOINTS: Final[Mapping[tuple[str, str], Endpoint]] = {
    ("GET", "folder"): (Nothing, lambda desk, _: campaigns.folder_overview(desk)),
    ("GET", "campaign"): (Named, lambda desk, asked: campaigns.campaign_overview(desk, asked.name)),
    ("POST", "campaign"): (
        CampaignAsked,
        lambda desk, asked: campaigns.begin_campaign(desk, asked.name, asked.test),
    ),
    ("GET", "description"): (
        Named,
        lambda desk, asked: descriptions.description(desk, asked.name),
    ),
    ("GET", "lab"): (
        LabAsked,
        lambda desk, asked: descriptions.lab_data(desk, asked.file, asked.result),
    ),
    ("POST", "check"): (
        TextAsked,
        lambda desk, asked: descriptions.check_text(desk, asked.file, asked.text, asked.result),
    ),
    ("POST", "change"): (
        ChangeAsked,
        lambda desk, asked: descriptions.change_text(
            desk, asked.file, asked.text, asked.result, (asked.path, asked.value, asked.kind)
        ),
    ),
    ("PUT", "text"): (
        SavingAsked,
        lambda desk, asked: descriptions.save_text(
            desk, asked.file, asked.text, asked.version, asked.result
        ),
    ),
    ("GET", "page"): (
        PageAsked,
        lambda desk, asked: pages.page_of(desk, asked.kind, asked.files, asked.term),
    ),
    ("GET", "picture"): (
        PictureAsked,
        lambda desk, asked: Answer(
            200,
            pages.picture_of(desk, asked.kind, asked.files, asked.term, asked.place),
            "image/svg+xml",
        ),
    ),
    ("GET", "record-about"): (
        RecordAsked,
        lambda desk, asked: record_plots.record_overview(desk, asked.name, asked.run),
    ),
    ("GET", "record"): (
        WindowAsked,
        lambda desk, asked: record_plots.record_window(
            desk, asked.name, asked.run, (asked.low, asked.high), asked.parts
        ),
    ),
    ("GET", "check"): (
        RecordAsked,
        lambda desk, asked: judging.judged(desk, asked.name, asked.run),
    ),
    ("GET", "watch"): (
        WatchAsked,
        lambda desk, asked: judging.followed(desk, asked.name, asked.goal),
    ),
    ("POST", "draft"): (DraftAsked, lambda desk, asked: drafts.drafted(desk, asked.names)),
    ("POST", "drafted"): (
        DraftedAsked,
        lambda desk, asked: drafts.begin_drafted(desk, asked.folder, asked.names, asked.answers),
    ),
    ("POST", "certificate"): (
        CertificateAsked,
        lambda desk, asked: certification.begin_certificate(
            desk, asked.result, asked.lab, asked.output
        ),
    ),
    ("GET", "report"): (
        ReportAsked,
        lambda desk, asked: _offered(*certification.report_of(desk, asked.name, asked.kind)),
    ),
    ("GET", "file"): (
        Named,
        lambda desk, asked: _offered(*certification.taken_file(desk, asked.name)),
    ),
    ("POST", "ticket"): (
        TicketAsked,
        lambda desk, asked: {"ticket": desk.tickets.issue((asked.name, asked.said))},
    ),
    ("GET", "plan"): (Named, lambda desk, asked: plans.plan_overview(desk, asked.name)),
    ("POST", "plan"): (Named, lambda desk, asked: plans.begin_plan(desk, asked.name)),
    ("POST", "plan-try"): (
        LimitsAsked,
        lambda desk, asked: plans.tried_plan(desk, asked.name, asked.moved),
    ),
    ("DELETE", "plan-try"): (Named, lambda desk, asked: plans.end_trying(desk, asked.name)),
    ("POST", "planned"): (
        PlannedAsked,
        lambda desk, asked: plans.begin_planned(desk, asked.name, asked.moved, asked.folder),
    ),
    ("GET", "jobs"): (Nothing, lambda desk, _: [job.shown() for job in desk.jobs.all()]),
    ("POST", "jobs"): (
        CalibrationAsked,
        lambda desk, asked: campaigns.begin_calibration(
            desk, asked.name, asked.output, asked.method, asked.accept_misfit
        ),
    ),
    ("POST", "study"): (
        StudyAsked,
        lambda desk, asked: trying.begin_study(desk, asked.name, asked.trials),
    ),
    ("POST", "simulation"): (
        SimulationAsked,
        lambda desk, asked: trying.begin_simulation(desk, asked.name, asked.folder),
    ),
    ("DELETE", "jobs"): (JobAsked, lambda desk, asked: desk.jobs.stop(asked.number).shown()),
}


def _offered(name: str, content: bytes) -> Answer:
    return Answer(200, content, "application/octet-stream", name)


def answer(desk: Desk, method: str, name: str, said: Mapping[str, Any] | bytes) -> Answer:
    """Answer one request; whatever goes wrong is an answer, too."""
    if (method, name) not in ENDPOINTS:
        return Answer(404, {"error": "There is nothing of that name."})
    asked, respond = ENDPOINTS[method, name]

    def made() -> Any:
        document = json.loads(said) if isinstance(said, bytes) else dict(said)
        return respond(desk, asked.model_validate(document))

    told = answered(desk, made)
    return told if isinstance(told, Answer) else Answer(200, told)


def taken(desk: Desk, ticket: str) -> Answer:
    """Answer what a ticket was issued for, the first time that it is shown."""
    target = desk.tickets.take(ticket)
    if target is None:
        return Answer(404, {"error": "This address counted once; click again on the page."})
    return answer(desk, "GET", *target)


def answered(desk: Desk, work: Callable[[], T]) -> T | Answer:
    """Return what some work makes, or the answer that says what went wrong."""
    try:
        return work()
    except CounterspinError as error:
        return _refused(desk, error)
    except Exception as error:  # no traceback for a user
        return _failed(error)


def _refused(desk: Desk, error: CounterspinError) -> Answer:
    """Return the answer for what is wrong with a file or a request, in its words."""
    told: dict[str, Any] = {"error": desk.folder.spoken(str(error))}
    status = next((status for kind, status in _STATUS.items() if isinstance(error, kind)), 422)
    if isinstance(error, ChangedMeanwhileError):
        told |= {"text": error.now.text, "version": error.now.version}
    if isinstance(error, CampaignError):
        told["problems"] = list(error.problems)
    return Answer(status, told)


def _failed(error: Exception) -> Answer:
    """Return the answer for what nobody has foreseen, and for requests of another form."""
    match error:
        case ValidationError():
            first = error.errors(include_url=False)[0]
            return Answer(400, {"error": f"{'.'.join(map(str, first['loc']))}: {first['msg']}"})
        case json.JSONDecodeError() | UnicodeDecodeError() | RecursionError():
            return Answer(400, {"error": "The request is no JSON."})
        case OSError():
            return Answer(422, {"error": f"The operating system refuses: {error.strerror}"})
    return Answer(500, {"error": f"internal error ({type(error).__name__}: {error})"})

"""The requests of the page, by name, and the functions that answer them.

The signature of a function states its request: the parameters after `desk`.
"""

from __future__ import annotations

import inspect
import json
from collections.abc import Callable, Mapping
from functools import cache
from typing import Any, Final, Literal, TypeVar, get_type_hints

from pydantic import BaseModel, ConfigDict, ValidationError, create_model

from counterspin.application import (
    campaigns,
    certification,
    drafts,
    editing,
    improving,
    keeping,
    laboratory,
    pages,
    plans,
    record_plots,
)
from counterspin.application.desk import Desk
from counterspin.application.folder import ChangedMeanwhileError, NotThereError, OutsideError
from counterspin.errors import CampaignError, CounterspinError
from counterspin.frozen import frozen

T = TypeVar("T")


_STATUS: Final = {ChangedMeanwhileError: 409, NotThereError: 404, OutsideError: 403}


@frozen
class Answer:
    """An answer: status, content, media type, and the file name for saving."""

    status: int
    content: Any
    kind: str = "application/json"
    name: str | None = None


# Where the page says something else than a function takes


def _page(desk: Desk, kind: pages.Kind, names: str, term: str = "K_II") -> Any:
    return pages.page_of(desk, kind, names.split("\n"), term)


def _picture(desk: Desk, kind: pages.Kind, names: str, place: int, term: str = "K_II") -> Answer:
    drawn = pages.picture_of(desk, kind, names.split("\n"), term, place)
    return Answer(200, drawn, "image/svg+xml")


def _manual(_: Desk, name: str) -> Any:
    return pages.manual_page(name)


def _report(desk: Desk, name: str, kind: Literal["html", "md", "pdf"]) -> Answer:
    return _offered(*certification.report_of(desk, name, kind))


def _file(desk: Desk, name: str) -> Answer:
    return _offered(*certification.taken_file(desk, name))


def _ticket(desk: Desk, name: Literal["report", "file"], said: dict[str, str]) -> Any:
    """Return an address, valid once, of a file that the browser fetches by itself."""
    return {"ticket": desk.tickets.issue((name, said))}


def _jobs(desk: Desk) -> Any:
    return [job.shown() for job in desk.jobs.all()]


def _stop(desk: Desk, number: int) -> Any:
    return desk.jobs.stop(number).shown()


def _offered(name: str, content: bytes) -> Answer:
    return Answer(200, content, "application/octet-stream", name)


ENDPOINTS: Final[Mapping[tuple[str, str], Callable[..., Any]]] = {
    ("GET", "folder"): campaigns.folder_overview,
    ("GET", "campaign"): campaigns.campaign_overview,
    ("POST", "campaign"): campaigns.begin_campaign,
    ("POST", "copy"): keeping.copy_campaign,
    ("POST", "rename"): keeping.rename_campaign,
    ("POST", "put-away"): keeping.put_away,
    ("POST", "restore"): keeping.restore_campaign,
    ("POST", "sample"): campaigns.begin_sample,
    ("POST", "records"): keeping.add_records,
    ("GET", "description"): editing.description,
    ("GET", "lab"): laboratory.lab_data,
    ("GET", "plan-text"): editing.plan_text,
    ("POST", "check"): editing.check_text,
    ("POST", "change"): editing.change_text,
    ("PUT", "text"): editing.save_text,
    ("GET", "manual"): _manual,
    ("GET", "page"): _page,
    ("GET", "picture"): _picture,
    ("POST", "what-if"): improving.uncertainty_if,
    ("GET", "ways"): improving.ways,
    ("POST", "ways"): improving.begin_search,
    ("POST", "way"): improving.prepare_way,
    ("POST", "fit"): improving.begin_fit,
    ("GET", "record-about"): record_plots.record_overview,
    ("GET", "record"): record_plots.record_window,
    ("GET", "check"): record_plots.run_judgement,
    ("GET", "watch"): record_plots.campaign_state,
    ("POST", "draft"): drafts.draft_overview,
    ("POST", "drafted"): drafts.begin_drafted,
    ("POST", "certificate"): certification.begin_certificate,
    ("POST", "certificate-preview"): laboratory.draft_preview,
    ("POST", "certificate-check"): certification.check_file,
    ("POST", "profile"): laboratory.save_profile,
    ("GET", "report"): _report,
    ("GET", "file"): _file,
    ("POST", "ticket"): _ticket,
    ("GET", "plan"): plans.plan_overview,
    ("POST", "plan"): plans.begin_plan,
    ("POST", "plan-page"): plans.planned_page,
    ("POST", "planned"): plans.begin_planned,
    ("GET", "jobs"): _jobs,
    ("POST", "jobs"): campaigns.begin_calibration,
    ("POST", "study"): record_plots.begin_study,
    ("POST", "simulation"): record_plots.begin_simulation,
    ("DELETE", "jobs"): _stop,
}


@cache
def form_of(respond: Callable[..., Any]) -> type[BaseModel]:
    """Return the form of a request: exactly a function's parameters after desk."""
    hints = get_type_hints(respond, include_extras=True)
    parameters = list(inspect.signature(respond).parameters.values())[1:]
    fields: dict[str, Any] = {
        p.name: (hints[p.name], ... if p.default is p.empty else p.default) for p in parameters
    }
    return create_model(
        respond.__name__, __config__=ConfigDict(extra="forbid", frozen=True), **fields
    )


def answer(desk: Desk, method: str, name: str, said: Mapping[str, Any] | bytes) -> Answer:
    """Answer one request, also if it fails."""
    if (method, name) not in ENDPOINTS:
        return Answer(404, {"error": "There is nothing with that name."})
    respond = ENDPOINTS[method, name]

    def made() -> Any:
        document = json.loads(said) if isinstance(said, bytes) else dict(said)
        asked = form_of(respond).model_validate(document)
        return respond(desk, **{key: getattr(asked, key) for key in form_of(respond).model_fields})

    told = answer_of(desk, made)
    return told if isinstance(told, Answer) else Answer(200, told)


def ticket_answer(desk: Desk, ticket: str) -> Answer:
    """Answer the request of a ticket; a ticket is valid once."""
    target = desk.tickets.take(ticket)
    if target is None:
        return Answer(404, {"error": "This address works once; click again on the page."})
    return answer(desk, "GET", *target)


def answer_of(desk: Desk, work: Callable[[], T]) -> T | Answer:
    """Return the answer of some work, or the answer for its error."""
    try:
        return work()
    except CounterspinError as error:
        return _refused(desk, error)
    except Exception as error:  # no traceback for a user
        return _failed(error)


def _refused(desk: Desk, error: CounterspinError) -> Answer:
    """Return the answer for an error of a file or a request, in its words."""
    told: dict[str, Any] = {"error": desk.folder.spoken(str(error))}
    status = next((status for kind, status in _STATUS.items() if isinstance(error, kind)), 422)
    if isinstance(error, ChangedMeanwhileError):
        told |= {"text": error.now.text, "version": error.now.version}
    if isinstance(error, CampaignError):
        told["problems"] = list(error.problems)
    return Answer(status, told)


def _failed(error: Exception) -> Answer:
    """Return the answer for unforeseen errors, and for requests of another form."""
    match error:
        case ValidationError():
            first = error.errors(include_url=False)[0]
            return Answer(400, {"error": f"{'.'.join(map(str, first['loc']))}: {first['msg']}"})
        case json.JSONDecodeError() | UnicodeDecodeError() | RecursionError():
            return Answer(400, {"error": "The request is not JSON."})
        case OSError():
            return Answer(422, {"error": f"The operating system refuses: {error.strerror}"})
    return Answer(500, {"error": f"internal error ({type(error).__name__}: {error})"})

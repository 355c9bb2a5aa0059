"""Request handlers by name.

The parameters of a handler after `app` define the request.
"""

from __future__ import annotations

import inspect
import json
from collections.abc import Callable, Mapping
from functools import cache
from typing import Any, Final, Literal, TypeVar, get_type_hints

from pydantic import BaseModel, ConfigDict, ValidationError, create_model

from counterspin.application import (
    campaign_files,
    campaigns,
    certification,
    drafts,
    editing,
    laboratory,
    pages,
    plans,
    record_plots,
    what_if,
)
from counterspin.application.answers import JobEntry, ManualPage, PageContent, Ticket
from counterspin.application.app_state import AppState
from counterspin.application.served_folder import (
    EditConflictError,
    NotFoundError,
    PathForbiddenError,
)
from counterspin.errors import CampaignError, CounterspinError, describe_system_error
from counterspin.frozen import frozen

T = TypeVar("T")


_ERROR_STATUSES: Final = {EditConflictError: 409, NotFoundError: 404, PathForbiddenError: 403}


@frozen
class ApiResponse:
    """A response: status, content, media type, and file name of a download."""

    status: int
    content: Any
    media_type: str = "application/json"
    file_name: str | None = None


# Handlers that convert parameters


def _get_page(app: AppState, kind: pages.PageType, names: str, term: str = "K_II") -> PageContent:
    return pages.make_page_content(app, kind, names.split("\n"), term)


def _get_picture(
    app: AppState, kind: pages.PageType, names: str, place: int, term: str = "K_II"
) -> ApiResponse:
    svg = pages.render_page_picture(app, kind, names.split("\n"), term, place)
    return ApiResponse(200, svg, "image/svg+xml")


def _get_manual(_: AppState, name: str) -> ManualPage:
    return pages.make_manual_page(name)


def _get_report(app: AppState, name: str, kind: Literal["html", "md", "pdf"]) -> ApiResponse:
    return _make_download(*certification.make_report(app, name, kind))


def _get_file(app: AppState, name: str) -> ApiResponse:
    return _make_download(*certification.download_file(app, name))


def _issue_ticket(
    app: AppState, name: Literal["report", "file"], parameters: dict[str, str]
) -> Ticket:
    """Return a ticket for a file that the browser downloads by itself."""
    return {"ticket": app.tickets.issue((name, parameters))}


def _list_jobs(app: AppState) -> list[JobEntry]:
    jobs = [job.to_dict() for job in app.jobs.all()]
    return [{**job, "error": app.folder.relative_paths(job["error"])} for job in jobs]


def _stop_job(app: AppState, number: int) -> JobEntry:
    return app.jobs.stop(number).to_dict()


def _make_download(name: str, content: bytes) -> ApiResponse:
    return ApiResponse(200, content, "application/octet-stream", name)


ENDPOINTS: Final[Mapping[tuple[str, str], Callable[..., Any]]] = {
    ("GET", "folder"): campaigns.folder_overview,
    ("GET", "campaign"): campaigns.campaign_overview,
    ("POST", "campaign"): campaigns.begin_campaign,
    ("POST", "copy"): campaign_files.copy_campaign,
    ("POST", "rename"): campaign_files.rename_campaign,
    ("POST", "put-away"): campaign_files.move_to_trash,
    ("POST", "discard"): campaign_files.discard_uploads,
    ("POST", "restore"): campaign_files.restore_campaign,
    ("POST", "sample"): campaigns.begin_sample,
    ("POST", "records"): campaign_files.add_records,
    ("GET", "description"): editing.read_campaign_text,
    ("GET", "lab"): laboratory.read_lab_data,
    ("GET", "plan-text"): editing.read_plan_text,
    ("POST", "check"): editing.check_text,
    ("POST", "change"): editing.change_text,
    ("PUT", "text"): editing.save_text,
    ("GET", "manual"): _get_manual,
    ("GET", "page"): _get_page,
    ("GET", "picture"): _get_picture,
    ("POST", "what-if"): what_if.what_if,
    ("GET", "ways"): what_if.improvements,
    ("POST", "ways"): what_if.begin_search,
    ("POST", "way"): what_if.apply_improvement,
    ("POST", "fit"): record_plots.begin_fit,
    ("GET", "record-about"): record_plots.record_overview,
    ("GET", "record"): record_plots.record_window,
    ("GET", "check"): record_plots.check_run,
    ("GET", "watch"): record_plots.watch_state,
    ("POST", "draft"): drafts.draft_overview,
    ("POST", "drafted"): drafts.write_draft,
    ("POST", "certificate"): certification.begin_certificate,
    ("POST", "certificate-preview"): laboratory.render_draft,
    ("POST", "certificate-check"): certification.check_file,
    ("POST", "profile"): laboratory.save_profile,
    ("GET", "report"): _get_report,
    ("GET", "file"): _get_file,
    ("POST", "ticket"): _issue_ticket,
    ("GET", "plan"): plans.plan_overview,
    ("POST", "plan"): plans.begin_plan,
    ("POST", "plan-page"): plans.make_planned_page,
    ("POST", "planned"): plans.begin_planned,
    ("GET", "jobs"): _list_jobs,
    ("POST", "jobs"): campaigns.begin_calibration,
    ("POST", "study-duration"): record_plots.get_study_duration,
    ("POST", "study"): record_plots.begin_study,
    ("POST", "simulation"): record_plots.begin_simulation,
    ("DELETE", "jobs"): _stop_job,
}


@cache
def make_request_model(handler: Callable[..., Any]) -> type[BaseModel]:
    """Return the model of a request: the parameters of its handler after `app`."""
    type_hints = get_type_hints(handler, include_extras=True)
    parameters = list(inspect.signature(handler).parameters.values())[1:]
    fields: dict[str, Any] = {
        parameter.name: (
            type_hints[parameter.name],
            ... if parameter.default is parameter.empty else parameter.default,
        )
        for parameter in parameters
    }
    return create_model(
        handler.__name__, __config__=ConfigDict(extra="forbid", frozen=True), **fields
    )


def handle_request(
    app: AppState, method: str, name: str, payload: Mapping[str, Any] | bytes
) -> ApiResponse:
    """Handle a request; errors are returned as responses."""
    if (method, name) not in ENDPOINTS:
        text = "Unknown request: the server has no such endpoint."
        return ApiResponse(404, {"error": text, "code": "not-found"})
    handler = ENDPOINTS[method, name]

    def call_handler() -> Any:
        document = json.loads(payload) if isinstance(payload, bytes) else dict(payload)
        request = make_request_model(handler).model_validate(document)
        return handler(
            app, **{key: getattr(request, key) for key in make_request_model(handler).model_fields}
        )

    response = call_with_error_response(app, call_handler)
    return response if isinstance(response, ApiResponse) else ApiResponse(200, response)


def handle_ticket(app: AppState, ticket: str) -> ApiResponse:
    """Handle the request of a ticket."""
    request_target = app.tickets.redeem(ticket)
    if request_target is None:
        text = "This download link has already been used. Click the download button again."
        return ApiResponse(404, {"error": text, "code": "not-found"})
    return handle_request(app, "GET", *request_target)


def call_with_error_response(app: AppState, function: Callable[[], T]) -> T | ApiResponse:
    """Return the result of a function, or the response for its error."""
    try:
        return function()
    except CounterspinError as error:
        return _user_error_response(app, error)
    except Exception as error:  # no traceback for a user
        return _unexpected_error_response(app, error)


def _user_error_response(app: AppState, error: CounterspinError) -> ApiResponse:
    """Return the response for an error with a message for the user."""
    text = app.folder.relative_paths(str(error))
    content: dict[str, Any] = {"error": text, "code": error.code}
    status = next(
        (
            status
            for error_class, status in _ERROR_STATUSES.items()
            if isinstance(error, error_class)
        ),
        422,
    )
    if isinstance(error, EditConflictError):
        content |= {"text": error.current.text, "version": error.current.version}
    if isinstance(error, CampaignError):
        content |= {"problems": list(error.problems), "codes": list(error.codes)}
    return ApiResponse(status, content)


def _unexpected_error_response(app: AppState, error: Exception) -> ApiResponse:
    """Return the response for invalid requests and unexpected errors."""
    match error:
        case ValidationError():
            first_error = error.errors(include_url=False)[0]
            text = f"{'.'.join(map(str, first_error['loc']))}: {first_error['msg']}"
            return ApiResponse(400, {"error": text, "code": "invalid-request"})
        case json.JSONDecodeError() | UnicodeDecodeError() | RecursionError():
            text = "The body of the request is not JSON."
            return ApiResponse(400, {"error": text, "code": "invalid-request"})
        case OSError():
            text = app.folder.relative_paths(describe_system_error(error))
            return ApiResponse(422, {"error": text, "code": "system-error"})
    text = f"internal error ({type(error).__name__}: {error})"
    return ApiResponse(500, {"error": text, "code": "internal-error"})

"""Types of the responses to requests of the page.

`docs/answer_types.py` generates the types of the scripts, ``assets/answers.js``, from this module.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, NotRequired, TypedDict

from counterspin.ingest.starter import Test

JobKind = Literal[
    "calibration", "study", "estimate", "simulation", "forecast", "plan", "fit", "sample"
]
JobState = Literal["waiting", "running", "done", "failed", "stopped"]


class SessionKey(TypedDict):
    """The key for further requests."""

    key: str


class StoredFile(TypedDict):
    """An uploaded file."""

    name: str
    bytes: int


class NameAnswer(TypedDict):
    """The name of a folder or a file."""

    name: str


class WrittenCampaign(TypedDict):
    """A campaign that was written."""

    name: str
    command: str


class JobEntry(TypedDict):
    """A job and its progress."""

    number: int
    campaign: str
    output: str
    command: str
    kind: JobKind
    state: JobState
    progress: tuple[int, int]
    error: str
    seconds: float


# Folders and campaigns


class NamedText(TypedDict):
    """A text with its name."""

    name: str
    text: str


class ResultEntry(TypedDict):
    """A result in a list; a damaged result has only a state."""

    name: str
    state: str
    words: str
    title: NotRequired[str]
    method: NotRequired[str]
    answers: NotRequired[list[NamedText]]
    serial_numbers: NotRequired[list[str | None]]
    written: NotRequired[float]
    description: NotRequired[str]


class CampaignEntry(TypedDict):
    """A campaign in a list."""

    name: str
    title: str
    results: list[ResultEntry]
    mistakes: list[str]
    missing: list[str]
    runs: int
    instruments: list[str]
    state: str
    words: str


class RunEntry(TypedDict):
    """A run of a campaign; rate and record are None if the description has mistakes."""

    name: str
    rate: float | None
    record: str | None
    bytes: int | None


class ChecklistEntry(TypedDict):
    """An entry of the checklist, with its key in the description."""

    words: str
    stated: bool
    effect: str
    key: str


class CampaignOverview(CampaignEntry):
    """The data of the page of one campaign."""

    study: str | None
    text: str
    version: str
    run_list: list[RunEntry]
    checklist: list[ChecklistEntry]
    command: str
    jobs: list[JobEntry]


class PlanEntry(TypedDict):
    """A plan in a list."""

    name: str
    title: str


class TrashEntry(TypedDict):
    """A folder in the trash, and its former name."""

    place: str
    name: str


class TermEntry(TypedDict):
    """A coefficient and its description."""

    name: str
    words: str


class FolderOverview(TypedDict):
    """The contents of the served folder."""

    folder: str
    campaigns: list[CampaignEntry]
    results: list[ResultEntry]
    plans: list[PlanEntry]
    labs: list[str]
    trash: list[TrashEntry]
    terms: list[TermEntry]


class TrashPlace(TypedDict):
    """The name of a folder in the trash; None if no file was moved."""

    place: str | None


class RestoredFolder(TypedDict):
    """A folder from the trash, and the files of an unfinished import."""

    name: str
    files: list[str]


class AddedRuns(TypedDict):
    """Sentences on the runs that were added."""

    added: list[str]


# Forms and texts


class FormField(TypedDict):
    """A field of a form."""

    key: str
    label: str
    help: str
    links: list[tuple[str, str]]
    required: bool
    kind: str
    unit: NotRequired[str]
    units: NotRequired[list[str]]
    example: NotRequired[str]
    choices: NotRequired[list[Any]]
    suggestions: NotRequired[list[str]]
    names: NotRequired[dict[str, str]]
    rows: NotRequired[Sequence[TermRow]]
    fields: NotRequired[list[FormField]]


class TermRow(TypedDict):
    """A term that can be in a list of terms."""

    key: str
    words: str


class FormSection(TypedDict):
    """A section of a form."""

    key: str
    words: str
    explained: str
    repeat: str | None
    fields: list[FormField]
    reading_fields: NotRequired[list[FormField]]
    name_fields: NotRequired[list[FormField]]
    table_fields: NotRequired[dict[str, list[FormField]]]


class KeyedText(TypedDict):
    """A message on a key of a document; an empty key means the whole document."""

    key: str
    words: str


class EditedDocument(TypedDict):
    """A text, its document and its mistakes."""

    text: str
    document: dict[str, Any]
    problems: list[KeyedText]
    questions: list[str]
    missing: list[KeyedText]
    run_kinds: list[str]


class SavedDocument(EditedDocument):
    """A text that was saved."""

    file: str
    version: str


class EditedFile(SavedDocument):
    """A file with the form that edits it."""

    form: Sequence[FormSection]


class IssuedCertificate(TypedDict):
    """An issued certificate of a folder."""

    file: str
    identifier: str


class LaboratoryData(EditedFile):
    """The laboratory's data for a certificate."""

    signer: str
    profile: bool
    certificates: list[IssuedCertificate]


# Import


class QuestionEntry(TypedDict):
    """A question about files, and its possible answers."""

    key: str
    text: str
    example: str
    choices: Sequence[str]
    guess: str | None
    units: Sequence[str]


class Curve(TypedDict):
    """A preview of a column: minimum and maximum of each segment."""

    extent: list[tuple[float, float] | None]
    words: str
    size: float
    unit: str


class ColumnEntry(TypedDict):
    """A column of a file, and the reason why it may be unused; text columns have no curve."""

    name: str
    first: list[str]
    curve: Curve | None
    reason: str


class RememberedAnswer(TypedDict):
    """An answer from another campaign."""

    answer: str
    campaign: str


class DraftOverview(TypedDict):
    """Detected contents of files, questions and mistakes."""

    test: Test | None
    statements: list[str]
    questions: list[QuestionEntry]
    problems: list[str]
    file: str
    runs: int | None
    columns: list[ColumnEntry]
    directions: Sequence[float]
    remembered: dict[str, RememberedAnswer]


# Pages


class ManualPage(TypedDict):
    """A page of the documentation, and names and titles of all pages."""

    title: str
    html: str
    pages: list[tuple[str, str]]


class PageContent(TypedDict):
    """A page as HTML; while a job computes the page, all other entries are empty."""

    job: JobEntry | None
    title: str
    html: str
    command: str
    empty: bool
    accelerometers: list[str]
    state: str
    words: str
    refusal: str


class WhatIfSource(TypedDict):
    """A source of uncertainty, in SI or g-units; `factor` converts it to its unit."""

    name: str
    words: str
    u: float
    factor: float
    unit: str
    share: float


class WhatIfAnswer(TypedDict):
    """The uncertainty with smaller uncertainties of its sources."""

    symbol: str
    u: float
    text: str
    sources: list[WhatIfSource]


class PriorImprovement(TypedDict):
    """A prior that reduces the uncertainty of a coefficient."""

    symbol: str
    source: str
    words: str
    assumed_u: str
    current_u: str
    remaining_u: str


class RunImprovement(TypedDict):
    """Further runs that reduce the uncertainty of a coefficient."""

    attitude: str
    count: int
    minutes: str
    remaining_u: str
    current_u: str


class Improvement(TypedDict):
    """The best prior and the best further runs of an accelerometer."""

    accelerometer: str
    stated: PriorImprovement
    runs: RunImprovement | None


class Improvements(TypedDict):
    """Known ways to reduce the uncertainty."""

    ways: list[Improvement]
    searched: bool
    has_runs: bool


class PreparedCopy(TypedDict):
    """A copied campaign, and the key of the value to be replaced."""

    name: str
    key: str | None


# Records


class RecordColumn(TypedDict):
    """A column of a record."""

    name: str
    unit: str


class RecordOverview(TypedDict):
    """Columns of a record and its used time range."""

    columns_per_plot: int
    columns: list[RecordColumn]
    rows: int
    first: float
    last: float
    used: list[float | None]
    file: str


class RecordAnswer(TypedDict):
    """Overview of a record or its fit; None before the fit."""

    overview: RecordOverview | None


class RecordWindow(TypedDict):
    """The values of a record between two times."""

    time: list[float]
    columns: list[list[float | None]]
    is_complete: bool


class RunCheck(TypedDict):
    """The check of a record."""

    html: str
    good: bool
    command: str


class NamedUncertainty(TypedDict):
    """The uncertainty of a coefficient; None if it is not determined."""

    name: str
    u: float | None


class CurrentUncertainties(TypedDict):
    """The uncertainties after a recorded time."""

    minutes: float
    u: list[NamedUncertainty]


class LiveState(TypedDict):
    """The state of a campaign during recording."""

    html: str
    events: list[str]
    complete: bool
    reached: CurrentUncertainties | None
    error: NotRequired[str]


class LiveAnswer(LiveState):
    """The state of a campaign during recording, with the command."""

    command: str


class Duration(TypedDict):
    """The expected duration of a study, s."""

    preparation: float
    per_trial: float
    slow_analyses: str


class DurationAnswer(TypedDict):
    """The expected duration of a study, or the job that estimates the duration."""

    job: JobEntry | None
    duration: Duration | None


# Certificates


class CertificatePages(TypedDict):
    """The pages of a certificate as SVG images."""

    pages: list[str]


class Receipt(TypedDict):
    """A certificate that was written."""

    identifier: str
    draft: bool
    accelerometers: list[str]
    signed_by: str
    notes: list[str]
    files: list[str]
    checksums: list[str]
    pages: list[str]
    signer: str
    signer_certificate: str | None
    command: str


class CheckedFile(TypedDict):
    """The check of a certificate's file."""

    identifier: str
    checksum: str
    signature: Literal["none", "unchecked", "valid"]
    pages: str | None


class ProfileFile(TypedDict):
    """The file of the laboratory's profile."""

    file: str


class Ticket(TypedDict):
    """An address of a file, valid once."""

    ticket: str


# Plans


class Limit(TypedDict):
    """A limit of a plan and its range, in SI; `factor` converts its unit to SI."""

    key: str
    words: str
    is_integer: bool
    unit: str
    factor: float
    value: float
    low: float
    high: float


class PlanOverview(TypedDict):
    """A plan with its limits."""

    name: str
    title: str
    limits: list[Limit]
    command: str


class PlanPage(TypedDict):
    """The optimal plan as HTML; empty while a job computes the plan."""

    job: JobEntry | None
    html: str

"""Validation dossier: JSON and report."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar, Final, Literal

from counterspin.reports.blocks import Block, Column, Heading, Paragraph, Table
from counterspin.results import ReportableResult, ResultPart


class Installation(ResultPart):
    """The installed package, its environment and the state of its files."""

    version: str  #: Version of counterspin.
    environment: dict[str, str]  #: Versions of Python, NumPy and SciPy, and the machine.
    packages: dict[str, str]  #: Version of each required package.
    files: int  #: Number of files in the package.
    checksum: str  #: SHA-256 of the names and contents of all package files.
    #: Number of files whose hash is listed in the RECORD of the installation; 0 if there is no
    #: RECORD, as in an editable installation.
    recorded: int
    altered: list[str]  #: Files whose hash differs from the recorded hash.
    missing: list[str]  #: Missing files.
    unknown: list[str]  #: Files that RECORD does not list.


class CheckedCase(ResultPart):
    """A case and its value closest to the tolerance."""

    name: str  #: Name of the case.
    requirement: str  #: Requirement that the case checks.
    kernel: str  #: Function under test.
    source: str  #: Source of the expected values.
    #: State of the case: ``passed``, ``failed``, or ``not run`` because a package is not installed.
    state: Literal["passed", "failed", "not run"]
    numbers: int  #: Number of compared values.
    quantity: str  #: Name of the value that is closest to its limit.
    expected: float | None  #: Expected value of `quantity`.
    found: float | None  #: Value of `quantity` on this installation.
    #: Number of correct digits in the value found, -log10 of the relative difference, at most 16;
    #: null if the expected value is 0 or no value was found.
    digits: float | None
    #: Largest permitted difference between the expected value and the value found.
    limit: float | None
    note: str = ""  #: Reason why no value could be compared.


class Dossier(ReportableResult):
    """The result of `validate`."""

    BLOCKS: ClassVar[str] = "counterspin.validation.page:summary_blocks"
    REPORT_BLOCKS: ClassVar[str] = "counterspin.validation.page:dossier_blocks"
    KIND: ClassVar[str] = "validation dossier"

    passed: bool  #: Whether no case failed and no file of the installation is altered or missing.
    installation: Installation  #: Installed software.
    cases: list[CheckedCase]  #: All cases.
    not_covered: list[str]  #: Limitations of the validation, as text.

    @property
    def identifier(self) -> str:
        """The version that was validated."""
        return f"counterspin {self.installation.version}"

    @property
    def failed(self) -> list[str]:
        """Names of the cases that failed."""
        return [case.name for case in self.cases if case.state == "failed"]


_DOSSIER_TITLE: Final = "Validation of counterspin"

#: Description in the file of a dossier.
FILE_DESCRIPTION: Final = "a validation dossier"


def summary_blocks(dossier: Dossier) -> list[Block]:
    """Return the summary and the table of requirements."""
    return [
        Heading(_DOSSIER_TITLE, 1),
        *_summary_paragraphs(dossier),
        *_failure_blocks(dossier),
        _requirements_table(dossier),
    ]


def dossier_blocks(dossier: Dossier) -> Iterator[Block]:
    """Yield the summary, the installation, requirements, cases, and the parts not covered."""
    yield Heading(_DOSSIER_TITLE, 1)
    yield from _summary_paragraphs(dossier)
    yield from _failure_blocks(dossier)
    yield Heading("Requirements and the cases that test them")
    yield _requirements_table(dossier)
    yield Heading("Installed software")
    yield from _installation_blocks(dossier)
    for requirement in dict.fromkeys(case.requirement for case in dossier.cases):
        yield Heading(f"Cases: {requirement}")
        yield _cases_table([case for case in dossier.cases if case.requirement == requirement])
    yield Paragraph(
        "For each case, the table shows the number that is closest to its limit. Digits: number "
        "of correct digits (-log10 of the relative difference), at most 16. Limit: largest "
        "allowed difference.",
        "quiet",
    )
    yield Heading("Sources")
    for source in dict.fromkeys(case.source for case in dossier.cases):
        names = ", ".join(case.name for case in dossier.cases if case.source == source)
        yield Paragraph(f"{names}: {source}.")
    yield Heading("Limits of the validation")
    for text in dossier.not_covered:
        yield Paragraph(text)


def _summary_paragraphs(dossier: Dossier) -> Iterator[Block]:
    states = [case.state for case in dossier.cases]
    count_text = f"{states.count('passed')} of {len(states)} reference cases passed"
    if states.count("not run"):
        count_text += f", {states.count('not run')} could not be run"
    if dossier.passed:
        yield Paragraph(f"{count_text}; none failed.", "answer")
    elif dossier.failed:
        yield Paragraph(
            f"{count_text}. These cases failed: {'; '.join(dossier.failed)}.", "warning"
        )
    else:
        yield Paragraph(
            f"{count_text}, but the installed files differ from the delivered files.", "warning"
        )
    installation = dossier.installation
    if installation.altered or installation.missing:
        problems = [f"altered: {', '.join(installation.altered)}"] if installation.altered else []
        problems += [f"missing: {', '.join(installation.missing)}"] if installation.missing else []
        yield Paragraph(f"Problems with the installed files: {'; '.join(problems)}.", "warning")


def _failure_blocks(dossier: Dossier) -> Iterator[Block]:
    failed_cases = [case for case in dossier.cases if case.state == "failed"]
    if failed_cases:
        yield _cases_table(failed_cases)
    for case in failed_cases:
        if case.note:
            yield Paragraph(f"{case.name}: {case.note}", "warning")


def _requirements_table(dossier: Dossier) -> Table:
    rows = []
    for requirement in dict.fromkeys(case.requirement for case in dossier.cases):
        cases = [case for case in dossier.cases if case.requirement == requirement]
        states = [case.state for case in cases]
        passed_text = f"{states.count('passed')} of {len(cases)}"
        rows.append((requirement, passed_text, "; ".join(case.name for case in cases)))
    columns = (Column("Requirement", wraps=True), Column("Passed"), Column("Cases", wraps=True))
    return Table(columns, tuple(rows))


def _cases_table(cases: list[CheckedCase]) -> Table:
    return Table(
        (
            Column("Case", wraps=True),
            Column("Number", wraps=True),
            Column("Expected", "right"),
            Column("Found", "right"),
            Column("Digits", "right"),
            Column("Limit", "right"),
            Column("State"),
        ),
        tuple(
            (
                f"{case.name} ({case.numbers} numbers)" if case.numbers > 1 else case.name,
                case.quantity,
                *(_format_value(value) for value in (case.expected, case.found)),
                "" if case.digits is None else f"{case.digits:.1f}",
                "" if case.limit is None else f"{case.limit:.1e}",
                case.state,
            )
            for case in cases
        ),
    )


def _format_value(value: float | None) -> str:
    return "" if value is None else f"{value:.12g}"


def _installation_blocks(dossier: Dossier) -> Iterator[Block]:
    installation = dossier.installation
    rows = [("counterspin", installation.version), *installation.environment.items()]
    rows += [row for row in installation.packages.items() if row[0] not in installation.environment]
    yield Table((Column("Part"), Column("Version")), tuple(rows))
    yield Paragraph(
        f"The package has {installation.files} files with the combined checksum "
        f"{installation.checksum}."
    )
    if not installation.recorded:
        yield Paragraph(
            "The installation has no RECORD of these files (installed in place, or not "
            "installed), so the files cannot be compared with the delivered files."
        )
        return
    n_altered, n_missing = len(installation.altered), len(installation.missing)
    yield Paragraph(
        f"The RECORD of the installation lists {installation.recorded} files: {n_altered} "
        f"altered, {n_missing} missing. {len(installation.unknown)} files of the package are not "
        "in the RECORD."
    )
    if installation.unknown:
        yield Paragraph(f"Files not in the RECORD: {', '.join(installation.unknown)}.", "quiet")

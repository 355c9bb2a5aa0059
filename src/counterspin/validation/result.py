"""The dossier and its JSON."""

from __future__ import annotations

from typing import ClassVar, Literal

from counterspin.reports.shown import ShownResult
from counterspin.results import ResultPart


class Installation(ResultPart):
    """What is installed."""

    version: str  #: Of counterspin.
    environment: dict[str, str]  #: Python, NumPy, SciPy, the machine.
    packages: dict[str, str]  #: What counterspin needs -> its version.
    files: int  #: The package's own files.
    checksum: str  #: One SHA-256 over their names and contents.
    #: Files whose hash the installation's RECORD states; 0 where there is none, as of a package
    #: that was installed in place.
    recorded: int
    altered: list[str]  #: Files that differ from their hash.
    missing: list[str]  #: Files that are gone.
    unknown: list[str]  #: Files that RECORD does not know.


class CheckedCase(ResultPart):
    """A case and how close what was found came."""

    name: str  #: Of the case.
    requirement: str  #: What it belongs to.
    kernel: str  #: The function that is asked.
    source: str  #: Where the expected values come from.
    #: ``passed``, ``failed``, or ``not run`` because a package is not installed.
    state: Literal["passed", "failed", "not run"]
    numbers: int  #: How many were compared.
    quantity: str  #: The number nearest to its limit.
    expected: float | None  #: What it should be.
    found: float | None  #: What it is here.
    #: Right digits of that number: -log10 of the relative difference, at most 16; None where
    #: nothing was expected but 0, or where nothing was found.
    digits: float | None
    limit: float | None  #: Largest difference allowed of that number.
    note: str = ""  #: What went wrong where nothing could be compared.


class Dossier(ShownResult):
    """What `validate` returns.

    Attributes
    ----------
    passed
        Whether no case failed and no file of the installation is altered or missing.
    installation
        What is installed.
    cases
        All of them.
    not_covered
        What no case says anything about, in sentences.
    """

    BLOCKS: ClassVar[str] = "counterspin.validation.page:summary_blocks"
    REPORT_BLOCKS: ClassVar[str] = "counterspin.validation.page:dossier_blocks"
    KIND: ClassVar[str] = "validation dossier"

    passed: bool  #: Whether no case failed and no file is altered or missing.
    installation: Installation  #: What is installed.
    cases: list[CheckedCase]  #: All cases.
    not_covered: list[str]  #: What no case says anything about.

    @property
    def identifier(self) -> str:
        """The version that was validated."""
        return f"counterspin {self.installation.version}"

    @property
    def failed(self) -> list[str]:
        """Names of the cases that failed."""
        return [case.name for case in self.cases if case.state == "failed"]

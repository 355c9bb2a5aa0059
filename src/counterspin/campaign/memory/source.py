"""Where a campaign came from, so that a result can say it."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import field
from functools import cached_property
from pathlib import Path
from typing import Any, Final, Protocol, TypeVar

from counterspin.campaign.accelerometers import Accelerometer
from counterspin.campaign.memory.documents import differences
from counterspin.errors import CounterspinError
from counterspin.frozen import frozen
from counterspin.records.memory import MemoryTable
from counterspin.toml_text import write_document

#: What messages call a campaign without a file.
IN_MEMORY: Final = "campaign in memory"


@frozen(eq=False)
class Source:
    """The description that a campaign was resolved from."""

    document: Mapping[str, Any]  #: As TOML is read.
    file: Path | None = None  #: The description's file; None: it was made in Python.
    #: SHA-256 of that file as it was read, such as ``sha256:9f86...``; None without a file.
    checksum: str | None = None
    #: What the file says, which `document` may have changed since.
    of_file: Mapping[str, Any] = field(default_factory=dict)

    @cached_property
    def changed(self) -> tuple[str, ...]:
        """The keys that are no longer as in the file; empty if it was made in Python."""
        return () if self.file is None else tuple(differences(self.of_file, self.document))

    @property
    def in_memory(self) -> bool:
        """Whether no file says what the document does."""
        return self.file is None or bool(self.changed)

    @property
    def label(self) -> str:
        """What messages call the description."""
        if self.file is None:
            return IN_MEMORY
        return f"{self.file}, changed in memory" if self.changed else str(self.file)

    @property
    def text(self) -> str:
        """The document as TOML, as text."""
        return write_document(self.document)

    def content_checksum(self) -> str:
        """Return SHA-256 of the description: of the file, or of the text that would be written."""
        if self.checksum is not None and not self.in_memory:
            return self.checksum
        return f"sha256:{hashlib.sha256(self.text.encode()).hexdigest()}"


class Documented(Protocol):
    """A campaign, as far as its document and its files are concerned."""

    @property
    def title(self) -> str:
        """As a report names it."""

    @property
    def path(self) -> Path:
        """Its description, or what stands for it."""

    @property
    def folder(self) -> Path:
        """Of its files."""

    @property
    def source(self) -> Source | None:
        """What it was resolved from."""

    @property
    def accelerometers(self) -> Mapping[str, Accelerometer]:
        """By name."""

    @property
    def files(self) -> tuple[Path, ...]:
        """All record files."""

    @property
    def tables(self) -> tuple[Path, ...]:
        """Files of readings."""

    @property
    def rest(self) -> Path | None:
        """The record at rest that says the noise."""

    def record_at(self, file: Path) -> Path | MemoryTable:
        """Return the record in memory that stands in the place of a file, or else the file."""


C = TypeVar("C", bound=Documented)


def source_of(campaign: Documented) -> Source:
    """Return what a campaign came from; CounterspinError where nothing is known of it."""
    if campaign.source is None:
        raise CounterspinError(
            f"{campaign.path}: the campaign was modified without `change`, so that "
            "its description is unknown; make all changes with `change`"
        )
    return campaign.source


def keep(campaign: C, source: Source) -> C:
    """Give a campaign that has just been resolved its source, and return it.

    It is no argument of the class: a copy that `dataclasses.replace` changes has lost it.
    """
    object.__setattr__(campaign, "source", source)
    return campaign

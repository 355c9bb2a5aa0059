"""What reading a record found, in sentences: of a run, and of a reading that is a mean."""

from __future__ import annotations

from collections.abc import Iterator

from counterspin.calibration.result_parts import ReadingResult, RunResult
from counterspin.reports.blocks import Block, Paragraph


def note_blocks(name: str, found: RunResult | ReadingResult) -> Iterator[Block]:
    """Yield one paragraph for each thing that reading found."""
    for note in found.notes:
        yield Paragraph(note if note.startswith(name) else f"{name}: {note}")


def count_blocks(name: str, found: RunResult | ReadingResult) -> Iterator[Block]:
    """Yield how many rows of each kind there are."""
    counts = ", ".join(f"{key.replace('_', ' ')} {count}" for key, count in found.counts.items())
    if counts:
        yield Paragraph(f"{name}: {counts}.")

"""Results that show themselves where they are the last line of a notebook's cell, or printed."""

from __future__ import annotations

import hashlib
import io
from collections.abc import Callable, Sequence
from datetime import datetime
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Final, cast

from counterspin.reports.blocks import Block, Heading, Picture, without_pictures
from counterspin.reports.publication import Publication, issue_date
from counterspin.reports.typography import typeset_block
from counterspin.results import ResultFile

if TYPE_CHECKING:
    from counterspin.reports.text import Report

#: Lines of a result's text in a cell; what is beyond them is in `print_result` or the report.
LINES: Final = 20

_WIDTH: Final = 100


def loaded(face: str) -> Callable[..., Any]:
    """Return a function by ``package.module:name``, loaded when it is asked for.

    What draws a result imports the result, and not the other way: a result only names it.
    """
    module, _, name = face.partition(":")
    function: Callable[..., Any] = getattr(import_module(module), name)
    return function


class ShownResult(ResultFile):
    """A result that shows itself, in a cell, on the terminal and as a report."""

    #: ``package.module:name`` of the function that makes its blocks for the screen.
    BLOCKS: ClassVar[str]
    #: Of the one that makes those of its report, where a report has more.
    REPORT_BLOCKS: ClassVar[str | None] = None
    #: What the file of a report says that it is; None: what `KIND` says.
    REPORT_KIND: ClassVar[str | None] = None

    def blocks(self) -> list[Block]:
        """Return what a screen shows of it, pictures included."""
        return list(loaded(self.BLOCKS)(self))

    @property
    def identifier(self) -> str:
        """What its report is known by; it follows from the bytes of its file."""
        return f"CS-{hashlib.sha256(self.content).hexdigest()[:12]}"

    @classmethod
    def report_kind(cls) -> str:
        """Return what the file of a report says that it is, such as "a history"."""
        return cls.REPORT_KIND or f"a {cls.KIND}"

    def publication(self, identifier: str | None = None) -> Publication:
        """Return its report, to be written as HTML, PDF or Markdown."""
        blocks = list(loaded(self.REPORT_BLOCKS or self.BLOCKS)(self))
        title = next((block.text for block in blocks if isinstance(block, Heading)), self.KIND)
        return Publication(self.report_kind(), title, identifier or self.identifier, blocks)

    def write_report(
        self,
        path: Path | str,
        *,
        identifier: str | None = None,
        issued: datetime | None = None,
        overwrite: bool = False,
    ) -> None:
        """Write its report; see `counterspin.write_report`."""
        page = self.publication(identifier)
        page.write(Path(path), issued or issue_date(), overwrite=overwrite)

    def __rich__(self) -> Report:
        """Return what rich prints."""
        from counterspin.reports.text import Report

        return Report(self.blocks())

    def _first_screen(self) -> Sequence[Block]:
        """Return the blocks that a cell shows."""
        return without_pictures(self.blocks())

    def __repr__(self) -> str:
        """Return the beginning of what the terminal shows, at most 20 lines."""
        return short_text(self._first_screen())

    __str__ = __repr__

    def _repr_html_(self) -> str:
        from counterspin.reports.html import cell

        return cell(self._first_screen())

    def _repr_markdown_(self) -> str:
        from counterspin.reports.markdown import markdown

        return markdown(self._first_screen())


def short_text(blocks: Sequence[Block]) -> str:
    """Return blocks as text of at most `LINES` lines; what is left out is counted."""
    from rich.console import Console

    from counterspin.reports.text import Report

    console = Console(file=io.StringIO(), width=_WIDTH, highlight=False, color_system=None)
    with console.capture() as capture:
        console.print(Report(list(blocks)))
    lines = [line.rstrip() for line in capture.get().rstrip().split("\n")]
    if len(lines) <= LINES:
        return "\n".join(lines)
    return "\n".join([*lines[: LINES - 1], f"... {len(lines) - LINES + 1} more lines"])


def on_axes(pictures: Sequence[Picture], axes: Any = None) -> list[Any]:
    """Draw pictures in the style of the reports on axes of Matplotlib.

    axes: One matplotlib.axes.Axes, or as many as there are pictures. None: those of a new figure,
        below each other, which a notebook shows.
    """
    import numpy as np

    from counterspin.reports.drawing import COLOURS_OF_PAPER, draw, settings

    figure = None
    if axes is None:
        import matplotlib.pyplot as plt

        # The first figure loads what shows figures in a notebook, whose settings are to stay: so
        # it is made before those of the reports are set, which end with the drawing.
        size, ground = (7.0, 2.6 * len(pictures)), COLOURS_OF_PAPER["ground"]
        figure = plt.figure(figsize=size, facecolor=ground, layout="constrained")
    with settings(COLOURS_OF_PAPER):
        if figure is not None:
            axes = figure.subplots(len(pictures), 1)
        own = list(np.atleast_1d(np.asarray(axes, dtype=object)).ravel())
        if len(own) != len(pictures):
            raise ValueError(f"there are {len(pictures)} pictures to draw on {len(own)} axes")
        for picture, place in zip(pictures, own, strict=True):
            draw(place, cast("Picture", typeset_block(picture)))
    return own

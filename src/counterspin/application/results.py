"""A result as the application shows it: the report's own words and pictures.

- `result_page`: its words, with places for the pictures; `result_picture`: one of them
- `block_page`, `block_picture`: the same of any blocks
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from counterspin.application.commands import report_command
from counterspin.application.desk import Desk
from counterspin.application.folder import NotThereError
from counterspin.reports.blocks import Block, Picture


def result_page(desk: Desk, name: str) -> dict[str, Any]:
    """Return a result's page: title, state, HTML, and the command that writes its report.

    Parameters
    ----------
    desk
        What is served.
    name
        The result's file.
    """
    from counterspin.calibration.findings import judge_result

    result = judge_result(desk.result(name))
    path = desk.file(name)
    return {
        "name": name,
        "title": result.title or "Calibration",
        "state": result.state,
        "method": result.method,
        "html": desk.remembered.get(
            ("page", path), [path], lambda: block_page(_blocks(desk, name), result.title)
        ),
        "command": report_command(path),
    }


def result_picture(desk: Desk, name: str, place: int) -> str:
    """Return a picture of a result's page as SVG, by its place among them."""
    path = desk.file(name)
    with desk.drawing:
        return desk.remembered.get(
            ("picture", path, place), [path], lambda: block_picture(_blocks(desk, name), place)
        )


def _blocks(desk: Desk, name: str) -> Sequence[Block]:
    from counterspin.calibration.pages.full_report import document

    path = desk.file(name)
    return desk.remembered.get(("blocks", path), [path], lambda: document(desk.result(name)))


def block_page(blocks: Sequence[Block], title: str) -> str:
    """Return blocks as HTML for the page."""
    from counterspin.reports.html import part

    return part(blocks, title=title or "Calibration")


def block_picture(blocks: Sequence[Block], place: int) -> str:
    """Return one of the blocks' pictures as SVG; NotThereError if there are fewer."""
    from counterspin.reports.charts import svg

    pictures = [block for block in blocks if isinstance(block, Picture)]
    if not 0 <= place < len(pictures):
        raise NotThereError(f"there is no picture {place}")
    return str(svg(pictures[place], theme="page"))

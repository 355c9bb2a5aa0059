"""A calibration's result in the terminal, or as plain text where it is piped."""

from __future__ import annotations

from rich.console import Console

from counterspin.calibration.pages.sections import sections
from counterspin.calibration.result import Result
from counterspin.reports.text import Report, report_console


def print_result(
    result: Result, console: Console | None = None, *, budget: bool = False, details: bool = False
) -> None:
    """Print a result, to standard output if to no other console; otherwise as `render`."""
    console = console or report_console()
    console.print(render(result, budget=budget, details=details))


def render(result: Result, *, budget: bool = False, details: bool = False) -> Report:
    """Return a result as a rich renderable.

    budget: Whether to show the uncertainty budgets.
    details: Whether to show correlations, counts, input files and their checksums.
    """
    return Report(sections(result, budget=budget, details=details))

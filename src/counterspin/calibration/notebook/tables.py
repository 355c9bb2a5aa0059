"""The coefficients of a result as a table: a frame, or LaTeX for a paper."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

from counterspin.calibration.notebook.latex import (
    latex_number,
    latex_symbol,
    latex_text,
    latex_unit,
)
from counterspin.reports.blocks import escape_controls
from counterspin.reports.numbers import NOT_DETERMINED, field_unit, format_compact
from counterspin.reports.publication import LINES

if TYPE_CHECKING:
    from counterspin.calibration.result import Result
    from counterspin.calibration.result_parts import Coefficient

#: Characters of a finding that a line of text shows.
_LINE_CHARACTERS: Final = 100


def rows(result: Result) -> Iterator[tuple[str, str, Coefficient]]:
    """Yield owner, symbol and coefficient of all: accelerometers', the platform's, the runs'."""
    for name, accelerometer in result.accelerometers.items():
        for symbol, c in accelerometer.coefficients.items():
            yield name, symbol, c
    for symbol, c in result.platform.items():
        yield "", symbol, c
    for name, run in result.runs.items():
        for symbol, c in run.terms.items():
            yield name, symbol, c


def frame(result: Result, library: str = "polars") -> Any:
    """Return the coefficients as a frame, in the units of the field."""
    return frame_of_rows(rows(result), library)


def frame_of_rows(every: Iterable[tuple[str, str, Coefficient]], library: str) -> Any:
    """Return owners, symbols and coefficients as a frame, in the units of the field."""
    columns: dict[str, list[Any]] = {
        name: []
        for name in (
            *("owner", "term", "value", "u", "unit"),
            *("low", "high", "u_unstated", "dof", "estimated"),
        )
    }
    for owner, symbol, c in every:
        unit, factor = field_unit(c.unit)
        known = c.estimated and c.value is not None and c.u is not None
        low, high = c.interval() if known else (None, None)
        numbers = (c.value, c.u, low, high, c.u_unstated)
        value, u, low, high, typical = (
            None if number is None else number * factor for number in numbers
        )
        row = (owner, symbol, value, u, unit, low, high, typical, c.dof, c.estimated)
        for column, cell in zip(columns.values(), row, strict=True):
            column.append(cell)
    return frame_of(columns, ("value", "u", "low", "high", "u_unstated", "dof"), library)


def frame_of(columns: Mapping[str, list[Any]], numeric: Sequence[str], library: str) -> Any:
    """Return columns as a frame of a library; `numeric` hold numbers, even if all are None."""
    if library == "pandas":
        return import_module("pandas").DataFrame(columns)
    if library != "polars":
        raise ValueError(f"library: {library!r} is not polars or pandas")
    import polars as pl

    return pl.DataFrame(columns, schema_overrides=dict.fromkeys(numeric, pl.Float64))


def latex_table(result: Result) -> str:
    r"""Return the coefficients as a LaTeX ``tabular``: owner, symbol, value(u), unit."""
    lines = [r"\begin{tabular}{llrl}", r"& & value & unit \\", r"\hline"]
    for owner, symbol, c in rows(result):
        unit, factor = field_unit(c.unit)
        if c.value is None or c.u is None or not c.estimated:
            number = NOT_DETERMINED
        else:
            number = f"${latex_number(format_compact(c.value * factor, c.u * factor))}$"
        cells = (latex_text(owner), f"${latex_symbol(symbol)}$", number, f"${latex_unit(unit)}$")
        lines.append(rf"{' & '.join(cells)} \\")
    return "\n".join([*lines, r"\end{tabular}", ""])


def brief(result: Result) -> str:
    """Return title, state, coefficients and the gravest finding as text of at most 20 lines."""
    head = (
        f"{result.title or 'Calibration'}: {result.method} method, {result.state or 'not judged'}"
    )
    named = [
        (f"{owner}.{symbol}" if owner else symbol, str(c)) for owner, symbol, c in rows(result)
    ]
    width = max((len(name) for name, _ in named), default=0)
    lines = [f"{name.ljust(width)}  {text}" for name, text in named]
    findings = [f"{finding.subject}: {finding.text}" for finding in result.findings]
    remarks = [
        escape_controls(shortened)
        for text in findings[:1]
        if (shortened := text[:_LINE_CHARACTERS])
    ]
    if more := len(findings) - 1:
        remarks += [f"... {more} more findings"] if more > 0 else []
    room = LINES - 1 - len(remarks)
    if len(lines) > room:
        lines[room - 1 :] = [f"... {len(lines) - room + 1} more coefficients: .table() has all"]
    return "\n".join([escape_controls(head), *map(escape_controls, lines), *remarks])

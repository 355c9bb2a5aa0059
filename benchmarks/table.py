"""What the benchmarks print, and how it is written down.

- `Table`: figures with a heading and a remark
- `render`: tables as Markdown
- `place`: the folder for what was measured, or for what is kept of it
- `save`, `load`: all tables in one file there; what was kept stands in the documentation too
- `merge`: tables of which some were measured again
- `insert`: into a page of documentation
- `options`: the choices that all scripts offer
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

ROOT = Path(__file__).parent.parent
RESULTS = "results.json"

#: What stands between these two lines of a page is written by a full run.
BEGIN, END = "<!-- begin results -->", "<!-- end results -->"

Cell = str | int | float | None


@dataclass(frozen=True)
class Table:
    """Figures of one benchmark.

    Attributes
    ----------
    title, remark
        What was measured, and how.
    columns
        Headings; the first names the rows.
    rows
        Cells; None where there is nothing to say.
    """

    title: str
    remark: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Cell]]


def render(tables: Sequence[Table]) -> str:
    """Return tables as Markdown, numbers to three digits."""
    parts = []
    for table in tables:
        lines = [f"## {table.title}", "", table.remark, ""]
        lines.append("| " + " | ".join(table.columns) + " |")
        lines.append("|---" + "|---:" * (len(table.columns) - 1) + "|")
        lines += ["| " + " | ".join(_text(cell) for cell in row) + " |" for row in table.rows]
        parts.append("\n".join(lines) + "\n")
    return "\n".join(parts)


def _text(cell: Cell) -> str:
    if cell is None:
        return "–"
    if isinstance(cell, float):
        return f"{cell:.0f}" if 100.0 <= abs(cell) < 1e5 else f"{cell:.3g}"
    return str(cell)


def place(root: Path, keep: bool) -> Path:
    """Return the folder of what documentation quotes, or that of what anybody measures."""
    return root / ("benchmarks" if keep else "build/benchmarks")


def save(measured: Sequence[Table], keep: bool, root: Path = ROOT) -> list[Table]:
    """Write tables beside those that are there, and return all; kept, into the documentation."""
    folder = place(root, keep)
    folder.mkdir(parents=True, exist_ok=True)
    tables = merge(load(folder), measured)
    data = json.dumps([asdict(table) for table in tables], indent=1, ensure_ascii=False)
    (folder / RESULTS).write_text(data + "\n", encoding="utf-8")
    if keep:
        page = root / "docs" / "benchmarks.md"
        page.write_text(insert(tables, page.read_text("utf-8")), encoding="utf-8")
    print(f"Wrote {RESULTS} to {folder}.")
    return tables


def load(folder: Path) -> list[Table]:
    """Read the tables that `save` has written; none where there are none."""
    path = folder / RESULTS
    return (
        [Table(**table) for table in json.loads(path.read_text("utf-8"))] if path.exists() else []
    )


def merge(before: Sequence[Table], again: Sequence[Table]) -> list[Table]:
    """Return tables with those of the same title replaced, and what is new at the end."""
    renewed = {table.title: table for table in again}
    kept = [renewed.pop(table.title, table) for table in before]
    return [*kept, *renewed.values()]


def insert(tables: Sequence[Table], page: str) -> str:
    """Return a page of documentation with the tables between its two marks."""
    before, _, rest = page.partition(BEGIN)
    _, _, after = rest.partition(END)
    return f"{before}{BEGIN}\n\n{render(tables)}\n{END}{after}"


def options(summary: str) -> argparse.ArgumentParser:
    """Return a parser with what every script has."""
    parser = argparse.ArgumentParser(description=summary)
    parser.add_argument("--full", action="store_true", help="the sizes that the targets are for")
    parser.add_argument("--repeats", type=int, help="repetitions of each measurement")
    return parser


def script(summary: str, tables: Callable[[bool, int | None], Sequence[Table]]) -> None:
    """Run one benchmark by itself and print its tables."""
    chosen = options(summary).parse_args()
    print(render(tables(chosen.full, chosen.repeats)))

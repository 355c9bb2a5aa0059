"""Tables of the benchmarks: printed, stored and inserted into the documentation.

- `Table`: results of a benchmark, with a heading and a remark
- `render`: format tables as Markdown
- `results_folder`: folder of the stored results
- `save`, `load`: write and read all tables; with `keep`, also update the documentation
- `merge_tables`: replace tables with the same title
- `insert_tables`: insert tables into a page of the documentation
- `make_parser`, `run_script`: common options, and main function of a script
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

ROOT = Path(__file__).parent.parent
RESULTS = "results.json"

#: Lines of a page that enclose the generated tables.
BEGIN_MARKER, END_MARKER = "<!-- begin results -->", "<!-- end results -->"

Cell = str | int | float | None


@dataclass(frozen=True)
class Table:
    """Results of one benchmark.

    Attributes
    ----------
    title, remark
        Heading, and how the results were measured.
    columns
        Column headings; the first column names the rows.
    rows
        Cells of each row; None: not applicable.
    """

    title: str
    remark: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Cell]]


def render(tables: Sequence[Table]) -> str:
    """Return tables as Markdown, with numbers rounded to three digits."""
    sections = []
    for table in tables:
        lines = [f"## {table.title}", "", table.remark, ""]
        lines.append("| " + " | ".join(table.columns) + " |")
        lines.append("|---" + "|---:" * (len(table.columns) - 1) + "|")
        lines += [
            "| " + " | ".join(_format_cell(cell) for cell in row) + " |" for row in table.rows
        ]
        sections.append("\n".join(lines) + "\n")
    return "\n".join(sections)


def _format_cell(cell: Cell) -> str:
    if cell is None:
        return "–"
    if isinstance(cell, float):
        return f"{cell:.0f}" if 100.0 <= abs(cell) < 1e5 else f"{cell:.3g}"
    return str(cell)


def results_folder(root: Path, keep: bool) -> Path:
    """Return the folder of the published results if `keep`, otherwise that of local results."""
    return root / ("benchmarks" if keep else "build/benchmarks")


def save(new_tables: Sequence[Table], keep: bool, root: Path = ROOT) -> list[Table]:
    """Merge new tables into the stored ones; return all. `keep`: also update the documentation."""
    folder = results_folder(root, keep)
    folder.mkdir(parents=True, exist_ok=True)
    tables = merge_tables(load(folder), new_tables)
    text = json.dumps([asdict(table) for table in tables], indent=1, ensure_ascii=False)
    (folder / RESULTS).write_text(text + "\n", encoding="utf-8")
    if keep:
        page = root / "docs" / "benchmarks.md"
        page.write_text(insert_tables(tables, page.read_text("utf-8")), encoding="utf-8")
    print(f"Wrote {RESULTS} to {folder}.")
    return tables


def load(folder: Path) -> list[Table]:
    """Return the tables stored in a folder; empty if there are none."""
    path = folder / RESULTS
    return (
        [Table(**table) for table in json.loads(path.read_text("utf-8"))] if path.exists() else []
    )


def merge_tables(old_tables: Sequence[Table], new_tables: Sequence[Table]) -> list[Table]:
    """Return the old tables, with those of the same title replaced and other new ones appended."""
    new_by_title = {table.title: table for table in new_tables}
    merged = [new_by_title.pop(table.title, table) for table in old_tables]
    return [*merged, *new_by_title.values()]


def insert_tables(tables: Sequence[Table], page: str) -> str:
    """Return the text of a page with the tables between its markers."""
    before, _, remainder = page.partition(BEGIN_MARKER)
    _, _, after = remainder.partition(END_MARKER)
    return f"{before}{BEGIN_MARKER}\n\n{render(tables)}\n{END_MARKER}{after}"


def make_parser(summary: str) -> argparse.ArgumentParser:
    """Return a parser with the common options."""
    parser = argparse.ArgumentParser(description=summary)
    parser.add_argument(
        "--full", action="store_true", help="use the full sizes, to which the targets apply"
    )
    parser.add_argument("--repeats", type=int, help="repetitions of each measurement")
    return parser


def run_script(summary: str, tables: Callable[[bool, int | None], Sequence[Table]]) -> None:
    """Run one benchmark and print its tables."""
    options = make_parser(summary).parse_args()
    print(render(tables(options.full, options.repeats)))

"""All benchmarks, one after the other, into one set of tables.

    python benchmarks          # small sizes; tables in build/benchmarks
    python benchmarks --full   # the sizes of the targets; renews benchmarks/results.* and the docs

The figures that are kept come from a full run only.
"""

from __future__ import annotations

from pathlib import Path

import calibrate
import commands
import machine
import plan
from table import insert, options, render, save

ROOT = Path(__file__).parent.parent


def main() -> None:
    chosen = options(__doc__.splitlines()[0]).parse_args()
    tables = []
    for benchmark in (machine, commands, plan, calibrate):
        found = benchmark.tables(chosen.full, chosen.repeats)
        print(render(found), flush=True)
        tables += found
    folder = ROOT / ("benchmarks" if chosen.full else "build/benchmarks")
    save(tables, folder)
    if chosen.full:
        page = ROOT / "docs" / "benchmarks.md"
        page.write_text(insert(tables, page.read_text("utf-8")), encoding="utf-8")
    print(f"Wrote results.md and results.json to {folder}.")


if __name__ == "__main__":
    main()

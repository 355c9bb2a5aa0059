"""All benchmarks, one after the other, into one set of tables.

    python benchmarks                 # small sizes; tables in build/benchmarks
    python benchmarks --full          # the sizes of the targets; tables there too
    python benchmarks --full --keep   # for a release: renews benchmarks/results.* and the docs
    python benchmarks --full --only machine,study   # renews these tables alone

What documentation quotes, and tests hold it to, is what was kept: from a full run only.
"""

from __future__ import annotations

from pathlib import Path

import calibrate
import commands
import costs
import machine
import plan
import study
import workers
from table import insert, load, merge, options, place, render, save

ROOT = Path(__file__).parent.parent

BENCHMARKS = {
    "machine": machine,
    "commands": commands,
    "plan": plan,
    "study": study,
    "workers": workers,
    "calibrate": calibrate,
    "costs": costs,
}


def main(arguments: list[str] | None = None) -> None:
    parser = options(__doc__.splitlines()[0])
    parser.add_argument("--only", help=f"some of {','.join(BENCHMARKS)}; the others' stay")
    parser.add_argument("--keep", action="store_true", help="with --full: renew what docs quote")
    chosen = parser.parse_args(arguments)
    if chosen.keep and not chosen.full:
        parser.error("only a full run is kept: give --full too")
    folder = place(ROOT, chosen.keep)
    tables = []
    for name in chosen.only.split(",") if chosen.only else BENCHMARKS:
        found = BENCHMARKS[name].tables(chosen.full, chosen.repeats)
        print(render(found), flush=True)
        tables += found
    if chosen.only and (folder / "results.json").exists():
        tables = merge(load(folder), tables)
    save(tables, folder)
    if {costs.TRIALS, costs.SAMPLES} <= {table.title for table in tables}:
        pictures = ROOT / "docs/images" if chosen.keep else folder
        costs.draw(tables, pictures / "benchmarks.svg")
    if chosen.keep:
        page = ROOT / "docs" / "benchmarks.md"
        page.write_text(insert(tables, page.read_text("utf-8")), encoding="utf-8")
    print(f"Wrote results.md and results.json to {folder}.")


if __name__ == "__main__":
    main()

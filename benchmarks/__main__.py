"""All benchmarks, one after the other, into one set of tables.

    python benchmarks                 # small sizes; tables in build/benchmarks
    python benchmarks --full          # the sizes of the targets; tables there too
    python benchmarks --full --keep   # for a release: renews benchmarks/results.json and the docs
    python benchmarks --full --only machine,study   # renews these tables alone

What documentation quotes, and tests hold it to, is what was kept: from a full run only.
"""

from __future__ import annotations

import calibrate
import commands
import costs
import machine
import plan
import sizes
import study
import workers
from table import ROOT, options, place, render, save

BENCHMARKS = {
    "machine": machine,
    "commands": commands,
    "plan": plan,
    "study": study,
    "workers": workers,
    "calibrate": calibrate,
    "costs": costs,
    "sizes": sizes,
}


def main(arguments: list[str] | None = None) -> None:
    parser = options(__doc__.splitlines()[0])
    parser.add_argument("--only", help=f"some of {','.join(BENCHMARKS)}; the others' stay")
    parser.add_argument("--keep", action="store_true", help="with --full: renew what docs quote")
    chosen = parser.parse_args(arguments)
    if chosen.keep and not chosen.full:
        parser.error("only a full run is kept: give --full too")
    measured = []
    for name in chosen.only.split(",") if chosen.only else BENCHMARKS:
        found = BENCHMARKS[name].tables(chosen.full, chosen.repeats)
        print(render(found), flush=True)
        measured += found
    tables = save(measured, chosen.keep, ROOT)
    if {costs.TRIALS, costs.SAMPLES} <= {table.title for table in tables}:
        pictures = ROOT / "docs/images" if chosen.keep else place(ROOT, keep=False)
        costs.draw(tables, pictures / "benchmarks.svg")


if __name__ == "__main__":
    main()

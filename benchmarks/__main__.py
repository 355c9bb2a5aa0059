"""Run all benchmarks, one after the other, and write their tables.

    python benchmarks                 # small sizes; tables in build/benchmarks
    python benchmarks --full          # full sizes, to which the targets apply
    python benchmarks --full --keep   # for a release: updates benchmarks/results.json and the docs
    python benchmarks --full --only machine,study   # updates these tables only

The documentation shows the results of a full run with --keep, and tests compare them.
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
from table import ROOT, make_parser, render, results_folder, save

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
    parser = make_parser(__doc__.splitlines()[0])
    parser.add_argument("--only", help=f"some of {','.join(BENCHMARKS)}; other tables stay")
    parser.add_argument("--keep", action="store_true", help="with --full: update the documentation")
    options = parser.parse_args(arguments)
    if options.keep and not options.full:
        parser.error("--keep requires --full")
    new_tables = []
    for name in options.only.split(",") if options.only else BENCHMARKS:
        benchmark_tables = BENCHMARKS[name].tables(options.full, options.repeats)
        print(render(benchmark_tables), flush=True)
        new_tables += benchmark_tables
    tables = save(new_tables, options.keep, ROOT)
    if {costs.TRIALS, costs.SAMPLES} <= {table.title for table in tables}:
        image_folder = ROOT / "docs/images" if options.keep else results_folder(ROOT, keep=False)
        costs.draw(tables, image_folder / "benchmarks.svg")


if __name__ == "__main__":
    main()

"""`make fuzz`: documents, records and kills; see docs/harmful-files.md."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

from fuzz import ROOT
from fuzz.formats import FORMATS
from fuzz.hunt import hunt, run_worker
from fuzz.kills import kill_all
from fuzz.tracing import can_trace


def main() -> int:
    """Run the requested cases; return 1 if there are findings."""
    parser = argparse.ArgumentParser(prog="python -m fuzz", description=__doc__)
    parser.add_argument("--documents", type=int, default=20_000, help="cases read in the process")
    parser.add_argument("--records", type=int, default=400, help="cases read by native code")
    parser.add_argument("--kills", type=int, default=40, help="processes killed while they write")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--first", type=int, default=1, help="number of the first case")
    parser.add_argument("--only", default="", help=f"some of {','.join(FORMATS)}")
    parser.add_argument("--output", type=Path, default=ROOT / "build" / "fuzz")
    parser.add_argument("--work", nargs=5, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.work:
        names, seed, first, count, folder = arguments.work
        run_worker(names.split(","), int(seed), int(first), int(count), Path(folder))
        return 0
    os.nice(10)
    format_names = arguments.only.split(",") if arguments.only else list(FORMATS)
    has_findings = False
    for native, count, group in (
        (False, arguments.documents, "documents"),
        (True, arguments.records, "records"),
    ):
        names = [name for name in format_names if FORMATS[name].native == native]
        if names and count:
            statistics = hunt(
                names, arguments.seed, arguments.first, count, arguments.output / group
            )
            print(
                f"{group}: {statistics.tried} tried in {statistics.seconds:.0f} s, "
                f"seed {arguments.seed}"
            )
            print(statistics.table(), flush=True)
            has_findings = has_findings or bool(statistics.finds)
    if arguments.kills and not arguments.only:
        has_findings = run_kills(arguments.kills) or has_findings
    return int(has_findings)


def run_kills(n_kills: int) -> bool:
    """Kill commands while they write; return whether data was lost."""
    if not can_trace():
        print("kills: processes cannot be traced here")
        return False
    n_done, faults = kill_all(n_kills, report=lambda message: print(message, flush=True))
    print(f"kills: {n_done}, {len(faults)} with a loss")
    return bool(faults)


if __name__ == "__main__":
    sys.exit(main())

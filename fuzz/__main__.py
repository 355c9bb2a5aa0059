"""`make fuzz`: documents, records and kills; see docs/harmful-files.md."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

from fuzz import ROOT
from fuzz.formats import FORMATS
from fuzz.hunt import hunt, work
from fuzz.kills import kill_all
from fuzz.tracing import possible


def main() -> int:
    """Run what is asked for; return 1 if anything was found."""
    parser = argparse.ArgumentParser(prog="python -m fuzz", description=__doc__)
    parser.add_argument("--documents", type=int, default=20_000, help="cases read in the process")
    parser.add_argument("--records", type=int, default=400, help="cases read by native code")
    parser.add_argument("--kills", type=int, default=40, help="processes killed while they write")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--first", type=int, default=1, help="number of the first case")
    parser.add_argument("--only", default="", help=f"some of {','.join(FORMATS)}")
    parser.add_argument("--output", type=Path, default=ROOT / "build" / "fuzz")
    parser.add_argument("--work", nargs=5, help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.work:
        names, seed, first, count, folder = asked.work
        work(names.split(","), int(seed), int(first), int(count), Path(folder))
        return 0
    os.nice(10)
    only = asked.only.split(",") if asked.only else list(FORMATS)
    found = False
    for native, count, words in (
        (False, asked.documents, "documents"),
        (True, asked.records, "records"),
    ):
        names = [name for name in only if FORMATS[name].native == native]
        if names and count:
            bag = hunt(names, asked.seed, asked.first, count, asked.output / words)
            print(f"{words}: {bag.tried} tried in {bag.seconds:.0f} s, seed {asked.seed}")
            print(bag.table(), flush=True)
            found = found or bool(bag.finds)
    if asked.kills and not asked.only:
        found = kill(asked.kills) or found
    return int(found)


def kill(kills: int) -> bool:
    """Kill commands while they write; return whether anything was lost."""
    if not possible():
        print("kills: processes cannot be traced here")
        return False
    done, faults = kill_all(kills, say=lambda words: print(words, flush=True))
    print(f"kills: {done}, {len(faults)} with a loss")
    return bool(faults)


if __name__ == "__main__":
    sys.exit(main())

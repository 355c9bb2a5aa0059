"""Plant single errors into a copy of the package, and see whether `counterspin validate` does.

``make mutants``, or ``python -m mutants [--only TEXT] [--tests]``. The errors are those of
``mutants.toml`` beside this file. Each is planted by itself, and the reference cases are run in a
process of their own until one fails. Where none does, ``--tests`` runs the test files that the
error names. The end has status 1 if more than three errors pass `validate`, or one its tests.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from pathlib import Path

HERE = Path(__file__).parent
REPOSITORY = HERE.parent
SOURCE = REPOSITORY / "src" / "counterspin"

#: How many may pass `validate`.
MOST = 3

#: Whole campaigns first: they see most. Prints the first case that does not pass, if there is one.
RUN = """
from counterspin.validation.cases import cases
from counterspin.validation.validate import check_case
for one in sorted(cases(), key=lambda one: not one.kernel.endswith((":calibrate", ":apply"))):
    if check_case(one).state == "failed":
        print(one.name)
        break
"""


def mutants():
    """Return the errors: `file`, `old`, `new` and perhaps `tests` of each."""
    return tomllib.loads((HERE / "mutants.toml").read_text(encoding="utf-8"))["mutants"]


def planted(mutant):
    """Return the text of the file with the error in it; ValueError where its place is not there."""
    path = SOURCE / mutant["file"]
    text = path.read_text(encoding="utf-8") if path.exists() else ""
    if (times := text.count(mutant["old"])) != 1:
        raise ValueError(
            f"{mutant['file']}: {mutant['old']!r} stands there {times} times, not once"
        )
    if mutant["old"] == mutant["new"]:
        raise ValueError(f"{mutant['file']}: {mutant['old']!r} is not changed")
    return text.replace(mutant["old"], mutant["new"])


def run(words, folder):
    """Return the ended process of words, with the package of a folder."""
    there = os.environ | {"PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1"}
    words = [sys.executable, "-W", "ignore", *words]
    return subprocess.run(
        words, cwd=REPOSITORY, env=there, capture_output=True, text=True, check=False
    )


def seen_by(mutant, folder, with_tests):
    """Return what names an error, in words; empty where nothing does."""
    found = run(["-c", RUN], folder)
    if found.returncode:
        return f"validate ends: {found.stderr.strip().splitlines()[-1]}"
    if found.stdout:
        return f"validate: {found.stdout.strip()}"
    files = mutant.get("tests", [])
    if with_tests and files:
        tested = run(["-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *files], folder)
        if tested.returncode == 1:
            return f"tests: {', '.join(files)}"
    return ""


def main():
    """Plant what is asked for; return 1 if too many are seen by nothing."""
    words = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    words.add_argument("--only", default="", help="errors whose file or text has this")
    words.add_argument(
        "--tests", action="store_true", help="run the tests named where none is seen"
    )
    asked = words.parse_args()
    chosen = [m for m in mutants() if asked.only in m["file"] + m["old"]]
    counts, passed, started = {"validate": 0, "tests": 0}, [], time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "counterspin"
        shutil.copytree(SOURCE, copy)
        if reason := seen_by({}, folder, False):
            sys.exit(f"without any error, {reason}")
        for mutant in chosen:
            place = copy / mutant["file"]
            place.write_text(planted(mutant), encoding="utf-8")
            words = seen_by(mutant, folder, asked.tests)
            shutil.copy2(SOURCE / mutant["file"], place)  # with its time: its bytecode still counts
            print(
                f"{mutant['file']}: {mutant['new'].strip()[:70]!r}: {words or 'PASSES'}", flush=True
            )
            if words:
                counts[words.partition(":")[0].split()[0]] += 1
            else:
                passed.append(mutant)
    unseen = counts["tests"] + len(passed)
    minutes = (time.monotonic() - started) / 60.0
    print(
        f"{len(chosen)} errors: {counts['validate']} named by validate, {counts['tests']} by "
        f"tests, {len(passed)} by nothing, in {minutes:.0f} min"
    )
    return int(unseen > MOST or (asked.tests and bool(passed)))


if __name__ == "__main__":
    sys.exit(main())

"""Introduce single errors into a copy of the package; count those that tests detect.

``make mutants``, or ``python -m mutants [--only TEXT] [--tests]``. The errors (mutants) are listed
in ``mutants.toml``. For each mutant, a new process runs the reference cases of `counterspin
validate` until one fails. If none fails, ``--tests`` runs the test files of the mutant. The exit
status is 1 if more than three mutants survive `validate`, or one survives its tests.
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

#: Number of mutants that may survive `validate`.
MAX_SURVIVORS = 3

#: Print the name of the first failed case, if any; whole campaigns run first and detect most.
RUN_CASES = """
from counterspin.validation.cases import cases
from counterspin.validation.validate import check_case
for case in sorted(cases(), key=lambda case: not case.kernel.endswith((":calibrate", ":apply"))):
    if check_case(case).state == "failed":
        print(case.name)
        break
"""


def read_mutants():
    """Return the mutants: `file`, `old`, `new` and optional `tests` of each."""
    return tomllib.loads((HERE / "mutants.toml").read_text(encoding="utf-8"))["mutants"]


def mutate_source(mutant):
    """Return the text of the file with the error; raise ValueError unless `old` occurs once."""
    path = SOURCE / mutant["file"]
    text = path.read_text(encoding="utf-8") if path.exists() else ""
    if (n_occurrences := text.count(mutant["old"])) != 1:
        raise ValueError(f"{mutant['file']}: {mutant['old']!r} occurs {n_occurrences} times")
    if mutant["old"] == mutant["new"]:
        raise ValueError(f"{mutant['file']}: {mutant['old']!r} is not changed")
    return text.replace(mutant["old"], mutant["new"])


def run_python(arguments, folder):
    """Run Python with the package in a folder; return the completed process."""
    environment = os.environ | {"PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, "-W", "ignore", *arguments]
    return subprocess.run(
        command, cwd=REPOSITORY, env=environment, capture_output=True, text=True, check=False
    )


def detect_mutant(mutant, folder, with_tests):
    """Return the check that detects a mutant and the failed case or files; empty if none does."""
    validation = run_python(["-c", RUN_CASES], folder)
    if validation.returncode:
        return f"validate ends: {validation.stderr.strip().splitlines()[-1]}"
    if validation.stdout:
        return f"validate: {validation.stdout.strip()}"
    test_files = mutant.get("tests", [])
    if with_tests and test_files:
        tests = run_python(
            ["-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *test_files], folder
        )
        if tests.returncode == 1:
            return f"tests: {', '.join(test_files)}"
    return ""


def main():
    """Test the selected mutants; return 1 if too many survive."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--only", default="", help="mutants whose file or old text contains this")
    parser.add_argument(
        "--tests", action="store_true", help="run the test files of mutants that survive validate"
    )
    arguments = parser.parse_args()
    selected = [m for m in read_mutants() if arguments.only in m["file"] + m["old"]]
    counts, survivors, start = {"validate": 0, "tests": 0}, [], time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        package = Path(folder) / "counterspin"
        shutil.copytree(SOURCE, package)
        if failure := detect_mutant({}, folder, False):
            sys.exit(f"without a mutant, {failure}")
        for mutant in selected:
            path = package / mutant["file"]
            path.write_text(mutate_source(mutant), encoding="utf-8")
            detection = detect_mutant(mutant, folder, arguments.tests)
            shutil.copy2(SOURCE / mutant["file"], path)  # keeps its time, so its bytecode is valid
            print(
                f"{mutant['file']}: {mutant['new'].strip()[:70]!r}: {detection or 'SURVIVES'}",
                flush=True,
            )
            if detection:
                counts[detection.partition(":")[0].split()[0]] += 1
            else:
                survivors.append(mutant)
    n_undetected = counts["tests"] + len(survivors)
    minutes = (time.monotonic() - start) / 60.0
    print(
        f"{len(selected)} mutants: {counts['validate']} detected by validate, {counts['tests']} by "
        f"tests, {len(survivors)} survived, in {minutes:.0f} min"
    )
    return int(n_undetected > MAX_SURVIVORS or (arguments.tests and bool(survivors)))


if __name__ == "__main__":
    sys.exit(main())

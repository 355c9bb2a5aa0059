"""Readings without triads, and records without readings."""

import math
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from campaigns import write_description
from reading_descriptions import ACCELEROMETER, format_rest_run, format_site

import counterspin
from counterspin.calibration.calibrate import calibrate

PACKAGE = Path(counterspin.__file__).parent
TESTS = Path(__file__).parents[1]

#: Extension -> its packages.
EXTENSIONS = {"triads": ("triads",), "readings": ("readings", "triads")}

#: Tests of records without simulation.
OF_RECORDS = (
    "calibration/test_result.py",
    "campaign/test_validation.py",
    "inference/joint/test_outlier_rejection_rounds.py",
    "records/test_temperature_profile.py",
)

#: A tumble in steps of 30 deg, in mA: 1.25 mA/g times the cosine of the angle.
TUMBLE = (
    format_site()
    + ACCELEROMETER
    + "".join(
        format_rest_run(
            f"p{angle}", f"{angle} deg about north", f"{1.25 * math.cos(math.radians(angle))} mA"
        )
        for angle in range(0, 360, 30)
    )
)

CALIBRATE = """
import sys
from counterspin.calibration.calibrate import calibrate
print(calibrate(sys.argv[1]).to_json(), end="")
"""


@pytest.fixture(scope="module")
def run_without(tmp_path_factory):
    """Return a function that runs Python with a package that lacks an extension."""
    roots = {}

    def run_python(extension, *arguments):
        if extension not in roots:
            roots[extension] = root = tmp_path_factory.mktemp(extension)
            # Copy the bytecode, which the processes would otherwise compile again.
            shutil.copytree(PACKAGE, root / "counterspin")
            for name in EXTENSIONS[extension]:
                shutil.rmtree(root / "counterspin" / name)
        return subprocess.run(
            [sys.executable, *map(str, arguments)],
            env={**os.environ, "PYTHONPATH": str(roots[extension])},
            capture_output=True,
            text=True,
            encoding="utf-8",
            check=False,
        )

    return run_python


def test_readings_have_same_result_without_triads(tmp_path, run_without):
    write_description(tmp_path, TUMBLE)
    done = run_without("triads", "-c", CALIBRATE, tmp_path)
    assert done.stdout == calibrate(tmp_path).to_json(), done.stderr


def test_missing_readings_package_is_reported(tmp_path, run_without):
    write_description(tmp_path, TUMBLE)
    done = run_without("readings", "-m", "counterspin", "calibrate", tmp_path)
    assert done.returncode == 2
    assert "this installation cannot read tables of readings" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.slow
def test_record_tests_pass_without_readings(run_without):
    options = ("-q", "-p", "no:cacheprovider", "-p", "no:xdist", f"--rootdir={TESTS.parent}")
    files = (TESTS / name for name in OF_RECORDS)
    done = run_without("readings", "-m", "pytest", *options, *files)
    assert done.returncode == 0, done.stdout

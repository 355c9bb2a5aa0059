"""A calibration without its diagnosis: the numbers and the state stay."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from campaigns import SMALL, changed, write

import counterspin
from counterspin.calibration.calibrate import calibrate
from counterspin.simulation.simulate import simulate

PACKAGE = Path(counterspin.__file__).parent

#: The modules of the diagnosis.
DIAGNOSIS = ("calibration/diagnosis", "inference/joint/mistakes.py")

#: Statements that the records contradict by far.
CONTRADICTED = {
    "prior": ('"1.002 g/g"\ndisp', '"1.003 ± 1e-6 g/g"\ndisp'),
    "noise": ('[noise]\ndisplacement = "0.01 m"', '[noise]\ndisplacement = "0.001 m"'),
}

IMPORT_ALL = """
import importlib, pkgutil, counterspin
for module in pkgutil.walk_packages(counterspin.__path__, "counterspin."):
    if not module.name.endswith("__main__"):
        importlib.import_module(module.name)
"""

CALIBRATE = """
import sys
from counterspin.calibration.calibrate import calibrate
print(calibrate(sys.argv[1]).to_json())
"""


@pytest.fixture(scope="module")
def without_diagnosis(tmp_path_factory):
    """Return a function that runs a program with a package that has no diagnosis."""
    root = tmp_path_factory.mktemp("without")
    shutil.copytree(PACKAGE, root / "counterspin", ignore=shutil.ignore_patterns("__pycache__"))
    for name in DIAGNOSIS:
        path = root / "counterspin" / name
        shutil.rmtree(path) if path.is_dir() else path.unlink()

    def run(program, *arguments):
        finished = subprocess.run(
            [sys.executable, "-c", program, *map(str, arguments)],
            env={**os.environ, "PYTHONPATH": str(root)},
            stdout=subprocess.PIPE,
            check=True,
        )
        return finished.stdout

    return run


def test_every_other_module_can_be_imported(without_diagnosis):
    assert without_diagnosis(IMPORT_ALL) == b""


@pytest.mark.parametrize("which", CONTRADICTED)
def test_a_contradicted_campaign_stays_contradicted(tmp_path, without_diagnosis, which):
    simulate(write(tmp_path, SMALL, "plan.toml"), tmp_path / "records")
    description = tmp_path / "records" / "campaign.toml"
    description.write_text(changed(description.read_text("utf-8"), CONTRADICTED[which]), "utf-8")
    whole = calibrate(description.parent)
    plain = json.loads(without_diagnosis(CALIBRATE, description.parent))
    assert whole.state == plain["state"] == "contradicted"
    assert (
        plain["accelerometers"]["Qx"]["coefficients"]
        == json.loads(whole.to_json())["accelerometers"]["Qx"]["coefficients"]
    )

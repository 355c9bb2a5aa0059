"""The page on MATLAB: its commands run, its names exist, and Octave runs it if it is installed."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from campaigns import SMALL, write_description
from scipy.io import loadmat

import counterspin as cs
from counterspin import cli

PAGE = (Path(__file__).parents[1] / "docs" / "matlab.md").read_text(encoding="utf-8")
SCRIPT = "".join(re.findall(r"^```matlab\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL))
OCTAVE = shutil.which("octave-cli")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Return a folder with a small campaign, and the table of the page."""
    monkeypatch.chdir(tmp_path)
    cs.simulate(write_description(tmp_path, SMALL, "plan.toml"), tmp_path / "example" / "records")
    (table,) = re.findall(r"^```csv\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
    Path("flight.csv").write_text(table, encoding="utf-8")
    return tmp_path


def test_commands_run_and_result_keys_exist(folder):
    commands = re.findall(r"system\('counterspin ([^']*)'\)", SCRIPT)
    assert [command.split()[0] for command in commands] == ["calibrate", "apply", "export"]
    assert SCRIPT.count("system(") == len(commands)
    for command in commands:
        assert cli.main(command.split()) == 0
    result = json.loads((folder / "result.json").read_text(encoding="utf-8"))
    paths = re.findall(r"\bresult\.(?!json\b|mat\b)(\w+(?:\.\w+)*)", SCRIPT)
    paths += [f"accelerometers.Qx.coefficients.K_II.{key}" for key in ("value", "u", "unit")]
    assert len(paths) == 8
    for path in paths:
        value = result
        for key in path.split("."):
            value = value[key]
        assert value is not None
    exported = loadmat("result.mat", simplify_cells=True)["counterspin"]
    assert set(re.findall(r"\bc\.(\w+)", SCRIPT)) <= set(exported)
    assert set(re.findall(r"k\('(\w+)'\)", SCRIPT)) <= set(exported["coefficient"])
    header = (folder / "corrected.csv").read_text().splitlines()[0]
    assert header.replace(",", ", ") in SCRIPT

    # The iteration of the page, and its last assertion.
    of_qx = exported["accelerometer"] == "Qx"
    k = dict(zip(exported["coefficient"][of_qx], exported["value"][of_qx], strict=True))
    table = np.loadtxt("corrected.csv", delimiter=",", skiprows=1)
    y = a = table[:, 1]
    for _ in range(20):
        a = (y - k["K_F"] - k["K_II"] * a**2 - k["K_III"] * a**3) / k["K_I"]
    assert np.abs(a - table[:, 2]).max() < 1e-12


@pytest.mark.skipif(OCTAVE is None, reason="Octave is not installed")
def test_octave_runs_script(folder):
    (folder / "page.m").write_text(SCRIPT, encoding="utf-8")
    command = folder / "counterspin"
    command.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m counterspin "$@"\n')
    command.chmod(0o755)
    ran = subprocess.run(
        [OCTAVE, "--norc", "page.m"],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"PATH": f"{folder}{os.pathsep}{os.environ['PATH']}"},
    )
    assert ran.returncode == 0, ran.stderr
    result = json.loads((folder / "result.json").read_text(encoding="utf-8"))
    k_ii = result["accelerometers"]["Qx"]["coefficients"]["K_II"]
    assert f"K_II = {k_ii['value']:.6g}, u = {k_ii['u']:.3g}, g/g^2" in ran.stdout
    assert len(re.findall("^inverted", ran.stdout, re.MULTILINE)) == 4

"""No file in the working folder is executed: the folder may be untrusted."""

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import polars as pl
import pytest
from campaigns import SMALL, write_description
from results import make_qx_result
from served import ANSWERS

from certificates import write_lab
from counterspin import cli
from counterspin.application.jobs import Job, Jobs, LiveViews, run_calibration
from counterspin.calibration.calibrate import calibrate
from counterspin.records import reader_process
from counterspin.simulation.simulate import simulate

#: The first imports of new processes of Python, multiprocessing and the reader.
PLANTED = ("json", "signal", "multiprocessing")
TRAP = "import pathlib\npathlib.Path(__file__ + '.ran').touch()\nraise ImportError\n"

ANSWERED = [word for key, value in ANSWERS.items() for word in ("--answer", f"{key}={value}")]
RECORDS = [f"{run}.parquet" for run in ("slow", "middle", "fast")]

#: The commands that start processes.
COMMANDS = [
    ["init", "new", "--from", *RECORDS, "--yes", *ANSWERED],
    ["calibrate", "."],
    ["calibrate", ".", "again", "--workers", "2"],
    ["rerun", "result.json"],
    ["check", "slow.parquet", "--campaign", "."],
    ["watch", ".", "--once"],
    ["apply", "result.json", "force.parquet", "--accelerometer", "Qx", "-o", "out.parquet"],
    ["study", ".", "--trials", "10", "--workers", "2"],
    ["certificate", "--verify", "c.pdf"],
]


@pytest.fixture(scope="module")
def planted_folder(tmp_path_factory):
    """Return a folder with a campaign of Parquet files, a certificate and planted files."""
    folder, plan = tmp_path_factory.mktemp("foreign"), tmp_path_factory.mktemp("plan")
    short = SMALL.replace("revolutions = 20", "revolutions = 6").replace(".csv", ".parquet")
    simulate(write_description(plan, short), folder)
    calibrate(folder).write(folder / "result.json")
    shutil.copytree(folder, folder / "again")
    pl.DataFrame({"force": [1.0, 2.0]}).write_parquet(folder / "force.parquet")
    make_qx_result().write(folder / "r.json")
    words = [str(folder / "r.json"), str(write_lab(folder)), "-o", str(folder / "c.pdf")]
    assert cli.main(["certificate", *words]) == 0
    for name in PLANTED:
        (folder / f"{name}.py").write_text(TRAP)
    # Bytes that cannot be decoded instead of settings.
    (folder / "matplotlibrc").write_bytes(b"\xff\n")
    return folder


@pytest.fixture
def in_planted_folder(planted_folder, monkeypatch):
    """Work in the planted folder without reader processes that were started elsewhere."""
    monkeypatch.chdir(planted_folder)
    reader = reader_process._ReaderProcess()
    monkeypatch.setattr(reader_process, "_READER", reader)
    yield planted_folder
    reader.close()
    assert sorted(planted_folder.glob("*.ran")) == []


@pytest.mark.slow
@pytest.mark.parametrize("words", COMMANDS, ids=lambda words: "-".join(words[:2]))
def test_modules_in_working_folder_are_not_imported(words, in_planted_folder):
    if words[0] == "init":
        shutil.rmtree(in_planted_folder / "new", ignore_errors=True)
    assert cli.main(words) == 0


def test_application_jobs_do_not_import_from_working_folder(in_planted_folder):
    jobs, views = Jobs(), LiveViews()
    output = in_planted_folder / "job.json"

    def make_job(number):
        return Job(number, "", "job.json", "counterspin calibrate .")

    job = jobs.begin(
        make_job, run_calibration, in_planted_folder / "campaign.toml", output, "joint", None
    )
    while not views.poll(in_planted_folder / "campaign.toml", "")["complete"]:
        time.sleep(0.05)
    while job.state in ("waiting", "running"):
        time.sleep(0.05)
    jobs.close()
    views.close()
    assert (job.state, job.error) == ("done", "")


BESIDE = Path(sys.executable).parent


@pytest.mark.slow
@pytest.mark.parametrize(
    "command", [[BESIDE / "counterspin"], [sys.executable, "-m", "counterspin"]]
)
def test_new_process_ignores_files_in_working_folder(command, in_planted_folder):
    # As in a notebook cell, whose backend may not be installed for this Python.
    environment = {**os.environ, "MPLBACKEND": "widget of another Python"}
    environment.pop("PYTHONSAFEPATH", None)
    drawing = ["report", "result.json", "-o", "report.html"]
    # Both start differently and continue in the same way.
    for words in (["calibrate", "."], *([drawing] if len(command) == 1 else [])):
        done = subprocess.run(
            [*command, *words], env=environment, capture_output=True, check=False, text=True
        )
        assert (done.returncode, done.stderr) == (0, "")

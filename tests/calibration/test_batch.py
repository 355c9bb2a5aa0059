"""Batches of campaigns: results as for separate calibrations, and failures stay separate."""

import json
import multiprocessing
import os
import re
import shutil
import signal
import threading
from contextlib import suppress
from functools import cache
from importlib.resources import files
from pathlib import Path

import clusters
import pytest
from clusters import start_dask_cluster, start_documented_cluster

from counterspin import workers
from counterspin.calibration.batch import BatchResult, calibrate_many
from counterspin.calibration.calibrate import calibrate
from counterspin.cli import main
from counterspin.errors import CounterspinError
from counterspin.simulation.simulate import simulate
from counterspin.workers import Workers


def short_plan(seed):
    text = (files("counterspin.reproduction") / "paper.toml").read_text(encoding="utf-8")
    return text.replace("revolutions = 100", "revolutions = 6").replace(
        "seed = 2", f"seed = {seed}"
    )


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    place = tmp_path_factory.mktemp("batch")
    for name, seed in (("a", 1), ("b", 2)):
        description = place / f"{name}.toml"
        description.write_text(short_plan(seed), encoding="utf-8")
        simulate(description, place / name)
    (place / "broken").mkdir()
    return [place / "a", place / "broken", place / "b"]


@cache
def calibrate_alone(folder):
    """Return the result of a campaign that is calibrated separately."""
    return calibrate(folder)


def outcomes(batch):
    """Return the result or error of each campaign, in order."""
    return list(batch.campaigns.values())


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 2])
def test_batch_equals_separate_calibrations(folders, count):
    first, broken, last = outcomes(calibrate_many(folders, workers=Workers(count)))
    assert first == calibrate_alone(folders[0])
    assert last == calibrate_alone(folders[2])
    assert first != last
    assert "file not found" in broken.error


def test_command_prints_summary_and_exits_with_1_on_failure(folders, tmp_path, capsys):
    kept = tmp_path / "all.json"
    status = main(["calibrate", *map(str, folders), "--json", str(kept)])
    shown = capsys.readouterr()
    assert status == 1
    assert "1 of 3 campaigns " in shown.err
    assert "2 campaigns calibrated, 1 failed." in shown.out
    assert shown.out.count("Qx") == 2
    batch = BatchResult.read(kept)
    assert list(batch.campaigns) == [str(folder) for folder in folders]
    assert list(batch.failed) == [str(folders[1])]
    assert batch.campaigns[str(folders[0])] == calibrate_alone(folders[0])
    assert main(["calibrate", str(folders[0]), str(folders[2])]) == 0


def test_errors_of_campaigns_name_their_folder_once(folders, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(folders[0], "lost")
    for record in Path("lost").glob("*.csv"):
        record.unlink()
    shutil.copytree(folders[0], "slips")
    text = Path("slips/campaign.toml").read_text(encoding="utf-8")
    wrong_text = text.replace("[site]", "[site]\nheight = 1\ndepth = 1")
    Path("slips/campaign.toml").write_text(wrong_text, encoding="utf-8")
    assert main(["calibrate", "nope", "lost", "slips"]) == 1
    output = capsys.readouterr().out
    lines = output.splitlines()
    assert "\\n" not in output
    assert lines[0].startswith("nope: file not found; ")
    assert output.count("nope") == 1
    assert output.count(".csv: file not found") == len(list(folders[0].glob("*.csv")))
    assert sum(line.startswith("slips/campaign.toml: 2 mistakes") for line in lines) == 1
    assert sum("site.height: unknown key" in line for line in lines) == 1


def test_workers_of_single_campaign_are_checked(folders, capsys):
    assert main(["calibrate", str(folders[0]), "--workers", "0"]) == 2
    assert capsys.readouterr().err == "counterspin: --workers must be at least 1\n"
    assert main(["calibrate", str(folders[0]), "--workers", "100000"]) == 0
    assert capsys.readouterr().err.startswith("counterspin: --workers and --cluster have no effect")


def test_run_is_excluded_from_all_campaigns(folders, tmp_path, capsys):
    text = (folders[0] / "campaign.toml").read_text(encoding="utf-8")
    run = re.search(r'\[\[runs\]\]\nname = "(.+)"', text)[1]
    other = tmp_path / "other"
    shutil.copytree(folders[2], other)
    (other / "campaign.toml").write_text(text.replace(f'name = "{run}"', 'name = "else"'))
    kept = tmp_path / "all.json"
    several = [folders[0], other, folders[2]]
    assert main(["calibrate", *map(str, several), "--without", run, "--json", str(kept)]) == 1
    first, failed, last = outcomes(BatchResult.read(kept))
    assert first == calibrate(folders[0], without=[run])
    assert run not in first.runs | last.runs
    assert f'"{run}"; the runs are "else", ' in failed.error
    assert "1 of 3 campaigns could not be" in capsys.readouterr().err


def pool_pids():
    return [child.pid for child in multiprocessing.active_children()]


@pytest.fixture(scope="module", autouse=True)
def gated_workers():
    """Make workers wait at the gate of a campaign."""
    folder = Path(clusters.__file__).parent / "gate"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(folder), prepend=os.pathsep)
        yield


class WorkerKiller:
    """A campaign that blocks the worker that reads its description, and kills it."""

    def __init__(self, folder, real, workers, times):
        shutil.copytree(real, folder)
        self.gate = folder / "gate"
        self.workers, self.times, self.killed = workers, times, 0
        os.mkfifo(self.gate)
        threading.Thread(target=self._kill, daemon=True).start()

    def _kill(self):
        while self.killed < self.times:
            # Opening blocks until a reader opens the file.
            held = os.open(self.gate, os.O_WRONLY)
            self.killed += 1
            self.gate.unlink()
            if self.killed < self.times:
                os.mkfifo(self.gate)
            for pid in self.workers():
                # A pool that has lost a worker ends the others, possibly earlier.
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
            os.close(held)


@pytest.mark.slow
def test_campaign_is_retried_after_death_of_worker(folders, tmp_path):
    held = WorkerKiller(tmp_path / "held", folders[0], pool_pids, times=1)
    several = [folders[0], tmp_path / "held", folders[2]]
    result = calibrate_many(several, workers=Workers(2))
    assert held.killed == 1
    assert outcomes(result) == [calibrate_alone(folders[place]) for place in (0, 0, 2)]


@pytest.mark.slow
def test_campaign_that_kills_workers_fails_without_stopping_others(folders, tmp_path, capsys):
    WorkerKiller(tmp_path / "held", folders[0], pool_pids, times=2)
    kept = tmp_path / "all.json"
    several = [str(folders[0]), str(tmp_path / "held"), str(folders[2])]
    status = main(["calibrate", *several, "--workers", "2", "--json", str(kept)])
    shown = capsys.readouterr()
    assert status == 1
    assert "1 of 3 campaigns " in shown.err
    campaigns = json.loads(kept.read_text(encoding="utf-8"))["campaigns"]
    assert "the process of this campaign crashed" in campaigns[several[1]]["error"]
    assert all("accelerometers" in campaigns[several[i]] for i in (0, 2))


@pytest.fixture(scope="module")
def cluster(gated_workers):
    """Start one worker, because the worker of a campaign is unknown among several."""
    # Import before changing settings, because the end of a change removes later defaults.
    pytest.importorskip("distributed", reason="Dask is not installed ([cluster])")
    import dask

    # A task fails after the death of one worker, not only after four.
    with (
        dask.config.set({"distributed.scheduler.allowed-failures": 0}),
        start_dask_cluster(workers=1) as cluster,
    ):
        yield cluster


def test_dask_workers_give_same_results(folders, cluster, tmp_path, capsys):
    kept = tmp_path / "all.json"
    several = [*map(str, folders)]
    status = main(
        ["calibrate", *several, "--cluster", cluster.scheduler_address, "--json", str(kept)]
    )
    shown = capsys.readouterr()
    assert status == 1
    assert "1 of 3 campaigns " in shown.err
    campaigns = json.loads(kept.read_text(encoding="utf-8"))["campaigns"]
    assert "file not found" in campaigns[several[1]]["error"]
    for index in (0, 2):
        assert campaigns[several[index]] == json.loads(calibrate_alone(folders[index]).to_json())


def test_dead_dask_worker_loses_no_campaign(folders, cluster, tmp_path):
    def cluster_pids():
        return [worker.process.pid for worker in cluster.workers.values() if worker.process]

    held = WorkerKiller(tmp_path / "held", folders[0], cluster_pids, times=1)
    several = [folders[0], tmp_path / "held", folders[2]]
    result = calibrate_many(several, workers=Workers(cluster=cluster.scheduler_address))
    assert held.killed == 1
    assert outcomes(result) == [calibrate_alone(folders[place]) for place in (0, 0, 2)]


@pytest.fixture
def scheduler(tmp_path):
    """Start a scheduler with a worker as in docs/study.md; yield (address, process)."""
    with start_documented_cluster(tmp_path) as (address, process, _):
        yield address, process


@pytest.mark.slow
def test_lost_scheduler_is_reported_and_keeps_completed_results(
    folders, scheduler, tmp_path, monkeypatch
):
    address, process = scheduler

    def scheduler_pids():
        for client in pytest.importorskip("distributed").Client._instances:
            client._timeout = 0.5
        return [process.pid]

    WorkerKiller(tmp_path / "held", folders[0], scheduler_pids, times=1)
    first, second = outcomes(
        calibrate_many([folders[0], tmp_path / "held"], workers=Workers(cluster=address))
    )
    assert first == calibrate_alone(folders[0])
    assert "Dask scheduler" in second.error
    monkeypatch.setattr(workers, "_SCHEDULER_TIMEOUT", 0.5)
    with pytest.raises(CounterspinError, match="no Dask scheduler responds at this address"):
        calibrate_many([folders[0]], workers=Workers(cluster=address))

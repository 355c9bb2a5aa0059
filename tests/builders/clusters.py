"""Local Dask clusters for tests of distributed work."""

import json
import os
import re
import shlex
import subprocess
import sys
import time
import warnings
from contextlib import contextmanager
from pathlib import Path

import pytest

from counterspin import workers as counterspin_workers


@contextmanager
def extend_client_timeout():
    """Increase the timeout of clients for a busy machine."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(counterspin_workers, "_SCHEDULER_TIMEOUT", 300.0)
        yield


@contextmanager
def start_dask_cluster(workers=2):
    """Yield a cluster of single-threaded worker processes."""
    distributed = pytest.importorskip("distributed", reason="Dask is not installed ([cluster])")
    with extend_client_timeout(), warnings.catch_warnings():
        # Any free port: another cluster may run on this machine.
        warnings.simplefilter("ignore")
        with distributed.LocalCluster(
            n_workers=workers, threads_per_worker=1, dashboard_address=":0", processes=True
        ) as cluster:
            yield cluster


def read_documented_commands():
    """Return the commands by which docs/study.md starts a scheduler and workers on a laptop.

    And what it sets in the environment before.
    """
    page = (Path(__file__).parents[2] / "docs" / "study.md").read_text(encoding="utf-8")
    section = page[page.index("### On one or several computers") : page.index("### On Kubernetes")]
    scheduler, worker = (
        shlex.split(line) for line in re.findall(r"^    (dask .+)$", section, re.M)
    )
    return scheduler[1:], worker[1:], dict(re.findall(r"^    export (\w+)=(.+)$", section, re.M))


@contextmanager
def start_documented_cluster(folder):
    """Start both in a folder, with a free port and a single worker; yield address and processes."""
    pytest.importorskip("distributed", reason="Dask is not installed ([cluster])")
    scheduler, worker, environment = read_documented_commands()
    file = folder / "scheduler.json"
    dask = [sys.executable, "-m", "dask"]
    options = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    options |= {"cwd": folder, "env": os.environ | environment}
    scheduler[scheduler.index("127.0.0.1:8787")] = "127.0.0.1:0"
    scheduler += ["--port", "0", "--scheduler-file", str(file)]
    with subprocess.Popen([*dask, *scheduler], **options) as scheduler_process:
        while not file.exists() or not file.read_text():
            assert scheduler_process.poll() is None
            time.sleep(0.05)
        address = json.loads(file.read_text())["address"]
        worker[worker.index("tcp://127.0.0.1:8786")] = address
        worker[worker.index("--nworkers") + 1] = "1"
        with (
            extend_client_timeout(),
            subprocess.Popen([*dask, *worker], **options) as worker_process,
        ):
            yield address, scheduler_process, worker_process
            for process in (worker_process, scheduler_process):
                process.terminate()

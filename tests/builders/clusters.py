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
def patient_clients():
    """Increase the timeout of clients for a busy machine."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(counterspin_workers, "_SCHEDULER_TIMEOUT", 300.0)
        yield


@contextmanager
def dask_cluster(workers=2):
    """Yield a cluster of single-threaded worker processes."""
    distributed = pytest.importorskip("distributed", reason="Dask is not installed ([cluster])")
    with patient_clients(), warnings.catch_warnings():
        # Any free port: another cluster may run on this machine.
        warnings.simplefilter("ignore")
        with distributed.LocalCluster(
            n_workers=workers, threads_per_worker=1, dashboard_address=":0", processes=True
        ) as cluster:
            yield cluster


def commands_of_the_page():
    """Return the commands by which docs/study.md starts a scheduler and workers on a laptop.

    And what it sets in the environment before.
    """
    page = (Path(__file__).parents[2] / "docs" / "study.md").read_text(encoding="utf-8")
    laptop = page[page.index("### On one or several computers") : page.index("### On Kubernetes")]
    scheduler, worker = (shlex.split(line) for line in re.findall(r"^    (dask .+)$", laptop, re.M))
    return scheduler[1:], worker[1:], dict(re.findall(r"^    export (\w+)=(.+)$", laptop, re.M))


@contextmanager
def cluster_of_the_page(folder):
    """Start both in a folder, with a free port and a single worker; yield address and processes."""
    pytest.importorskip("distributed", reason="Dask is not installed ([cluster])")
    scheduler, worker, environment = commands_of_the_page()
    file = folder / "scheduler.json"
    dask = [sys.executable, "-m", "dask"]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    quiet |= {"cwd": folder, "env": os.environ | environment}
    scheduler[scheduler.index("127.0.0.1:8787")] = "127.0.0.1:0"
    scheduler += ["--port", "0", "--scheduler-file", str(file)]
    with subprocess.Popen([*dask, *scheduler], **quiet) as first:
        while not file.exists() or not file.read_text():
            assert first.poll() is None
            time.sleep(0.05)
        address = json.loads(file.read_text())["address"]
        worker[worker.index("tcp://127.0.0.1:8786")] = address
        worker[worker.index("--nworkers") + 1] = "1"
        with patient_clients(), subprocess.Popen([*dask, *worker], **quiet) as second:
            yield address, first, second
            for process in (second, first):
                process.terminate()

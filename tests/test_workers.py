"""Who does work that is shared out."""

import logging

import frames
import numpy as np  # noqa: F401 -- whose library takes the threads
import pytest
from clusters import cluster_of_the_page

from counterspin import workers
from counterspin.calibration import assembly
from counterspin.calibration.calibrate import calibrate
from counterspin.campaign.memory import make_campaign
from counterspin.cli import main
from counterspin.errors import CounterspinError, CounterspinWarning
from counterspin.studies import study as study_module
from counterspin.threads import BLAS_THREADS, one_blas_thread
from counterspin.workers import Workers


def test_more_workers_than_a_machine_can_use_are_capped_and_told(monkeypatch):
    monkeypatch.setattr(workers, "usable_cores", lambda: 3)
    with pytest.warns(
        CounterspinWarning, match=r"100000 were requested; more than 6 .*3 processor"
    ):
        assert Workers(100_000).capped() == Workers(6)
    assert Workers(6).capped() == Workers(6)
    # A cluster has as many as it has.
    assert Workers(100_000, "tcp://here").capped().processes == 100_000


def test_no_worker_is_refused():
    with pytest.raises(CounterspinError, match="`workers` must be at least 1"):
        Workers(0)


def test_command_says_that_it_has_capped_them(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(workers, "usable_cores", lambda: 1)
    main(["calibrate", str(tmp_path / "a"), str(tmp_path / "b"), "--workers", "5000"])
    error = capsys.readouterr().err
    assert error.count("--workers: 5000 were requested") == 1


@pytest.mark.slow
def test_cluster_of_a_laptop_listens_to_nobody_else_and_runs_nothing_of_its_folder(tmp_path):
    psutil = pytest.importorskip("psutil", reason="comes with Dask")
    for name in ("json", "signal", "multiprocessing"):
        (tmp_path / f"{name}.py").write_text("open(__file__ + '.ran', 'w')\nraise ImportError\n")
    with cluster_of_the_page(tmp_path) as (address, *processes):
        assert address.startswith("tcp://127.0.0.1:")
        with pytest.importorskip("distributed").Client(address, set_as_default=False) as client:
            client.wait_for_workers(1, timeout=120)
        family = [psutil.Process(process.pid) for process in processes]
        family += [child for process in family for child in process.children(recursive=True)]
        heard = {
            connection.laddr.ip
            for process in family
            for connection in process.net_connections(kind="inet")
            if connection.status == psutil.CONN_LISTEN
        }
    assert heard == {"127.0.0.1"}
    assert list(tmp_path.glob("*.ran")) == []


def threadpoolctl():
    return pytest.importorskip("threadpoolctl", reason="the environment is older than the pins")


def threads():
    """Return how many threads the libraries of linear algebra take that are loaded."""
    found = threadpoolctl().threadpool_info()
    return {info["num_threads"] for info in found if info["user_api"] == "blas"}


@pytest.fixture
def two_threads(monkeypatch):
    for name in BLAS_THREADS:
        monkeypatch.delenv(name, raising=False)
    with threadpoolctl().threadpool_limits(limits=2, user_api="blas"):
        yield


@pytest.mark.usefixtures("two_threads")
def test_linear_algebra_has_one_thread_until_the_last_who_asked_is_done():
    assert threads() == {2}
    first, second = one_blas_thread(), one_blas_thread()
    with first:
        second.__enter__()
        assert threads() == {1}
    assert threads() == {1}
    second.__exit__(None, None, None)
    assert threads() == {2}


@pytest.mark.usefixtures("two_threads")
def test_what_the_environment_says_stays(monkeypatch):
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "2")
    with one_blas_thread():
        assert threads() == {2}


@pytest.mark.usefixtures("two_threads")
def test_a_calibration_takes_one_thread_and_gives_the_others_back(tmp_path, monkeypatch):
    seen = []
    joint = assembly.fit_jointly
    monkeypatch.setattr(assembly, "fit_jointly", lambda *a: seen.append(threads()) or joint(*a))
    calibrate(make_campaign(frames.untrue(), frames.arrays(tmp_path)))
    assert (seen, threads()) == ([{1}], {2})


@pytest.mark.usefixtures("two_threads")
def test_so_does_a_study(monkeypatch):
    seen = []
    prepare = study_module.prepare_study
    monkeypatch.setattr(
        study_module, "prepare_study", lambda *a: seen.append(threads()) or prepare(*a)
    )
    study_module.study(make_campaign(frames.small()), trials=2, seed=1)
    assert (seen, threads()) == ([{1}], {2})


def test_a_library_s_log_is_silent_while_its_errors_are_ours_to_tell(caplog):
    log = logging.getLogger("library")
    with workers._without_log("library"):
        log.error("Traceback")
    log.error("afterwards")
    assert caplog.messages == ["afterwards"]

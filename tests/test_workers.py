"""Who does work that is shared out."""

import logging

import frames
import numpy as np  # noqa: F401 -- whose library takes the threads
import pytest
from clusters import start_documented_cluster

from counterspin import workers
from counterspin.calibration import assembly
from counterspin.calibration.calibrate import calibrate
from counterspin.campaign.memory import make_campaign
from counterspin.cli import main
from counterspin.errors import CounterspinError, CounterspinWarning
from counterspin.studies import study as study_module
from counterspin.threads import BLAS_THREAD_VARIABLES, single_blas_thread
from counterspin.workers import Workers


def test_excess_workers_are_capped_with_message(monkeypatch):
    monkeypatch.setattr(workers, "available_cores", lambda: 3)
    with pytest.warns(CounterspinWarning, match=r"100000 were requested, .* only 6, .*3 processor"):
        assert Workers(100_000).capped() == Workers(6)
    assert Workers(6).capped() == Workers(6)
    # A cluster has as many as it has.
    assert Workers(100_000, "tcp://here").capped().processes == 100_000


def test_zero_workers_raise():
    with pytest.raises(CounterspinError, match="`workers` must be at least 1"):
        Workers(0)


def test_command_reports_capped_workers(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(workers, "available_cores", lambda: 1)
    main(["calibrate", str(tmp_path / "a"), str(tmp_path / "b"), "--workers", "5000"])
    error = capsys.readouterr().err
    assert error.count("--workers: 5000 were requested") == 1


@pytest.mark.slow
def test_local_cluster_is_loopback_only_and_ignores_folder_modules(tmp_path):
    psutil = pytest.importorskip("psutil", reason="comes with Dask")
    for name in ("json", "signal", "multiprocessing"):
        (tmp_path / f"{name}.py").write_text("open(__file__ + '.ran', 'w')\nraise ImportError\n")
    with start_documented_cluster(tmp_path) as (address, *processes):
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


def count_threads():
    """Return the thread counts of the loaded linear algebra libraries."""
    threadpool_info = threadpoolctl().threadpool_info()
    return {info["num_threads"] for info in threadpool_info if info["user_api"] == "blas"}


@pytest.fixture
def two_threads(monkeypatch):
    for name in BLAS_THREAD_VARIABLES:
        monkeypatch.delenv(name, raising=False)
    with threadpoolctl().threadpool_limits(limits=2, user_api="blas"):
        yield


@pytest.mark.usefixtures("two_threads")
def test_thread_limit_lasts_until_last_context_exits():
    assert count_threads() == {2}
    first, second = single_blas_thread(), single_blas_thread()
    with first:
        second.__enter__()
        assert count_threads() == {1}
    assert count_threads() == {1}
    second.__exit__(None, None, None)
    assert count_threads() == {2}


@pytest.mark.usefixtures("two_threads")
def test_thread_count_of_environment_is_preserved(monkeypatch):
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "2")
    with single_blas_thread():
        assert count_threads() == {2}


@pytest.mark.usefixtures("two_threads")
def test_calibration_uses_single_thread_and_restores_threads(tmp_path, monkeypatch):
    seen = []
    joint = assembly.fit_jointly
    monkeypatch.setattr(
        assembly, "fit_jointly", lambda *a: seen.append(count_threads()) or joint(*a)
    )
    calibrate(
        make_campaign(frames.parse_description_without_truth(), frames.simulate_columns(tmp_path))
    )
    assert (seen, count_threads()) == ([{1}], {2})


@pytest.mark.usefixtures("two_threads")
def test_study_uses_single_thread_and_restores_threads(monkeypatch):
    seen = []
    prepare = study_module.prepare_study
    monkeypatch.setattr(
        study_module, "prepare_study", lambda *a: seen.append(count_threads()) or prepare(*a)
    )
    study_module.study(make_campaign(frames.parse_small_description()), trials=2, seed=1)
    assert (seen, count_threads()) == ([{1}], {2})


def test_library_log_is_silenced_temporarily(caplog):
    log = logging.getLogger("library")
    with workers._silence_logger("library"):
        log.error("Traceback")
    log.error("afterwards")
    assert caplog.messages == ["afterwards"]

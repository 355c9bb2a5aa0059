"""Who does work that is shared out."""

import pytest
from clusters import cluster_of_the_page

from counterspin import workers
from counterspin.cli import main
from counterspin.errors import CounterspinError, CounterspinWarning
from counterspin.workers import Workers


def test_more_workers_than_a_machine_can_use_are_capped_and_told(monkeypatch):
    monkeypatch.setattr(workers, "usable_cores", lambda: 3)
    with pytest.warns(
        CounterspinWarning, match=r"100000 were asked for; more than 6 .*3 processor"
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
    assert error.count("counterspin: --workers: 5000 were asked for; more than 2") == 1


def test_cluster_of_a_laptop_listens_to_nobody_else(tmp_path):
    psutil = pytest.importorskip("psutil", reason="comes with Dask")
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

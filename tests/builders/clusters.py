"""Dask clusters of this machine for the tests of work that is shared out."""

import warnings
from contextlib import contextmanager

import pytest


@contextmanager
def dask_cluster(workers=2):
    """Yield a cluster of single-threaded workers, each a process of its own."""
    distributed = pytest.importorskip("distributed", reason="Dask is not installed ([cluster])")
    with warnings.catch_warnings():
        # Any free port: another cluster may run on this machine.
        warnings.simplefilter("ignore")
        with distributed.LocalCluster(
            n_workers=workers, threads_per_worker=1, dashboard_address=":0", processes=True
        ) as cluster:
            yield cluster

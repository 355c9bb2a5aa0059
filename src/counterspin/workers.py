"""Parallel work in processes of this machine or on a Dask cluster."""

from __future__ import annotations

import importlib
import logging
import os
import signal
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, Executor, Future
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from multiprocessing.context import SpawnContext, SpawnProcess
from typing import Any, Final

from counterspin.errors import (
    CounterspinError,
    CounterspinWarning,
    MissingPackageError,
    install_command,
)
from counterspin.frozen import frozen
from counterspin.threads import BLAS_THREAD_VARIABLES

#: Largest number of processes per processor core.
_PROCESSES_PER_CORE: Final = 2

#: Timeout for the answer of a scheduler, s.
_SCHEDULER_TIMEOUT: Final = 10.0

#: Timeout for the first worker of a cluster, which a queue may have to start, s.
_FIRST_WORKER_TIMEOUT: Final = 600.0

#: Interval between counts of a cluster's workers, s.
_COUNT_INTERVAL: Final = 2.0


#: Environment of worker processes. Each has one thread, because the matrices are small and more
#: threads would compete for the cores; libraries read this when they are loaded. PYTHONSAFEPATH
#: prevents Python from importing modules from the working folder, which it would search first, so
#: that files next to a campaign are not executed.
_INHERITED_ENVIRONMENT: Final = {**dict.fromkeys(BLAS_THREAD_VARIABLES, "1"), "PYTHONSAFEPATH": "1"}

_ENVIRONMENT_LOCK: Final = threading.RLock()


@contextmanager
def _worker_environment() -> Iterator[None]:
    """Set the environment of worker processes temporarily.

    Worker processes also ignore Ctrl-C, which a terminal sends to all processes; the parent process
    handles it.
    """
    with _ENVIRONMENT_LOCK:
        previous_values = {name: os.environ.get(name) for name in _INHERITED_ENVIRONMENT}
        os.environ.update(_INHERITED_ENVIRONMENT)
        is_main_thread = threading.current_thread() is threading.main_thread()
        previous_handler = signal.signal(signal.SIGINT, signal.SIG_IGN) if is_main_thread else None
        try:
            yield
        finally:
            if is_main_thread:
                signal.signal(signal.SIGINT, previous_handler)
            for name, value in previous_values.items():
                if value is None:
                    os.environ.pop(name, None)
                else:
                    os.environ[name] = value


class _WorkerProcess(SpawnProcess):
    def start(self) -> None:
        with _worker_environment():
            super().start()


class _WorkerContext(SpawnContext):
    Process = _WorkerProcess


SPAWN_CONTEXT: Final = _WorkerContext()


@frozen
class Workers:
    """Where parallel work runs.

    Attributes
    ----------
    processes
        Number of processes on this machine; 1: the work runs in the calling process.
    cluster
        Address of a Dask scheduler, whose workers are used instead; None: use processes.

    Raises
    ------
    CounterspinError
        If `processes` is less than 1.
    """

    processes: int = 1
    cluster: str | None = None

    def __post_init__(self) -> None:
        if self.processes < 1:
            raise CounterspinError("`workers` must be at least 1", code="wrong-usage")

    @property
    def alone(self) -> bool:
        """Whether the work runs in the calling process."""
        return self.processes == 1 and self.cluster is None

    def capped(self) -> Workers:
        """Return the workers, limited to those this machine can use, with a warning if reduced."""
        max_processes = _PROCESSES_PER_CORE * available_cores()
        if self.cluster is not None or self.processes <= max_processes:
            return self
        warning_text = (
            f"`workers`: {self.processes} were requested, but counterspin starts only "
            f"{max_processes}, because more would not be useful with the {available_cores()} "
            "processor cores available"
        )
        warnings.warn(CounterspinWarning(warning_text, code="too-many-workers"), stacklevel=3)
        return replace(self, processes=max_processes)


SINGLE_PROCESS: Final = Workers()  #: The calling process only.


def available_cores() -> int:
    """Return the number of processor cores available to this process."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@dataclass
class WorkerPool:
    """A pool of workers."""

    executor: Executor
    death_errors: tuple[type[BaseException], ...]  #: Errors of a task whose worker died.
    #: Returns the current number of workers, which varies on a cluster.
    count_workers: Callable[[], int]
    _last_count: tuple[float, int] = field(default=(-1e9, 1), init=False)

    @property
    def size(self) -> int:
        """Number of workers, now or a moment ago; at least 1."""
        count_time, n_workers = self._last_count
        if time.monotonic() - count_time > _COUNT_INTERVAL:
            n_workers = max(1, self.count_workers())
            self._last_count = (time.monotonic(), n_workers)
        return n_workers


@contextmanager
def worker_pool(workers: Workers, module: str) -> Iterator[WorkerPool]:
    """Yield a pool of workers, which is closed at the end.

    module: Module that each process imports in advance.
    """
    if workers.cluster is not None:
        with _cluster_pool(workers.cluster) as pool:
            yield pool
        return
    from concurrent.futures import ProcessPoolExecutor

    with _worker_environment():  # the process that keeps count of its locks is started here
        executor = ProcessPoolExecutor(workers.processes, mp_context=SPAWN_CONTEXT)
    with executor:
        try:
            # Each of the first tasks starts a process.
            for _ in range(workers.processes):
                executor.submit(_import_module, module)
            yield WorkerPool(executor, (BrokenProcessPool,), lambda: workers.processes)
        except BaseException:
            executor.shutdown(wait=False, cancel_futures=True)
            raise


def _import_module(module: str) -> None:
    importlib.import_module(module)


class _DaskExecutor(Executor):
    """Submits tasks to a Dask client.

    Dask's own executor (`Client.get_executor`) fails if a worker leaves before its results have
    been fetched; with this executor, Dask computes them again.
    """

    def __init__(self, client: Any) -> None:
        self._client = client
        self._tasks: set[Any] = set()  # Dask drops tasks without references

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Submit a task; its future raises CancelledError if the scheduler is lost."""
        future: Future[Any] = Future()
        task = self._client.submit(fn, *args, **kwargs, pure=False)
        self._tasks.add(task)

        def copy_outcome(completed_task: Any) -> None:
            if future.set_running_or_notify_cancel():
                try:
                    future.set_result(completed_task.result())
                except BaseException as error:
                    future.set_exception(error)
            self._tasks.discard(task)

        task.add_done_callback(copy_outcome)
        return future


@contextmanager
def _silence_logger(name: str) -> Iterator[None]:
    """Suppress the log messages of a library; counterspin reports the error itself."""
    logger = logging.getLogger(name)
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        logger.setLevel(level)


@contextmanager
def _cluster_pool(address: str) -> Iterator[WorkerPool]:
    try:
        from distributed import Client, KilledWorker
    except ImportError as error:
        raise MissingPackageError(
            f"`cluster` requires Dask: {install_command('cluster')}"
        ) from error
    no_scheduler = (
        f"{address}: no Dask scheduler responds at this address; start a scheduler with "
        "`dask scheduler`"
    )
    try:
        client: Any = Client(address, timeout=_SCHEDULER_TIMEOUT, set_as_default=False)
    except (OSError, ValueError) as error:
        raise CounterspinError(no_scheduler, code="cluster-unreachable") from error
    with _silence_logger("distributed.client"), client:
        try:
            client.wait_for_workers(1, timeout=_FIRST_WORKER_TIMEOUT)
        except TimeoutError as error:
            raise CounterspinError(
                f"{address}: no worker joined this scheduler within {_FIRST_WORKER_TIMEOUT:.0f} "
                f"s; start workers with `dask worker {address}`",
                code="cluster-unreachable",
            ) from error
        except OSError as error:
            raise CounterspinError(no_scheduler, code="cluster-unreachable") from error

        def count_workers() -> int:
            try:
                return sum(client.nthreads().values())
            except OSError as error:
                raise CancelledError from error

        try:
            # Dask reassigns the tasks of a dead worker by itself, until it gives a task up.
            yield WorkerPool(_DaskExecutor(client), (KilledWorker,), count_workers)
        except CancelledError as error:
            raise CounterspinError(
                f"{address}: the connection to the Dask scheduler was lost; restore it and run "
                "the command again (a study with an `output` folder continues with "
                "`resume=True`)",
                code="cluster-unreachable",
            ) from error
        except ImportError as error:
            raise CounterspinError(
                f"a worker of the cluster cannot load counterspin ({error}); every worker must "
                "have the same versions of counterspin and Python as this computer",
                code="worker-failed",
            ) from error

"""Work shared out: to processes of this machine, or to the workers of a Dask cluster."""

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

from counterspin.errors import CounterspinError, CounterspinWarning, MissingPackageError, installing
from counterspin.frozen import frozen
from counterspin.threads import BLAS_THREADS

#: Most processes that are started for each processor core.
_PROCESSES_PER_CORE: Final = 2

#: How long a scheduler may take to answer, s.
_SCHEDULER_TIMEOUT: Final = 10.0

#: How long a cluster's first worker may take to join, as where a queue starts it, s.
_FIRST_WORKER_TIMEOUT: Final = 600.0

#: Time between two counts of a cluster's workers, s.
_COUNT_INTERVAL: Final = 2.0


#: What processes inherit. One thread each: the matrices are small, and more threads would compete
#: for the cores; libraries read that when they are loaded. And no module from the working folder,
#: where Python looks first when it is started for multiprocessing, until it has the path of the
#: process that starts it: whatever lies beside a campaign would be run.
_INHERITED: Final = {**dict.fromkeys(BLAS_THREADS, "1"), "PYTHONSAFEPATH": "1"}

_INHERITING: Final = threading.RLock()


@contextmanager
def _inheriting() -> Iterator[None]:
    """Set for a while what processes that are started inherit.

    They ignore Ctrl-C too, which a terminal sends to all processes: the one that hands out the work
    handles it.
    """
    with _INHERITING:
        before = {name: os.environ.get(name) for name in _INHERITED}
        os.environ.update(_INHERITED)
        in_main = threading.current_thread() is threading.main_thread()
        handler = signal.signal(signal.SIGINT, signal.SIG_IGN) if in_main else None
        try:
            yield
        finally:
            if in_main:
                signal.signal(signal.SIGINT, handler)
            for name, value in before.items():
                if value is None:
                    os.environ.pop(name, None)
                else:
                    os.environ[name] = value


class _Process(SpawnProcess):
    def start(self) -> None:
        with _inheriting():
            super().start()


class _Spawning(SpawnContext):
    Process = _Process


SPAWNING: Final = _Spawning()


@frozen
class Workers:
    """Who does work that is shared out.

    Attributes
    ----------
    processes
        Processes of this machine; 1 works in the caller's own.
    cluster
        Address of a Dask scheduler, whose workers are used instead; None: processes.

    Raises
    ------
    CounterspinError
        If there is no process.
    """

    processes: int = 1
    cluster: str | None = None

    def __post_init__(self) -> None:
        if self.processes < 1:
            raise CounterspinError("`workers` must be at least 1", code="wrong-usage")

    @property
    def alone(self) -> bool:
        """Whether the caller works by itself."""
        return self.processes == 1 and self.cluster is None

    def capped(self) -> Workers:
        """Return as many as this machine can use; warns where more were asked for."""
        most = _PROCESSES_PER_CORE * usable_cores()
        if self.cluster is not None or self.processes <= most:
            return self
        text = (
            f"`workers`: {self.processes} were requested, but only {most} are started, because "
            f"more than {most} would not help on this machine, which has {usable_cores()} "
            "processor cores available"
        )
        warnings.warn(CounterspinWarning(text, code="too-many-workers"), stacklevel=3)
        return replace(self, processes=most)


ALONE: Final = Workers()  #: nobody but the caller


def usable_cores() -> int:
    """Return how many processor cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@dataclass
class WorkerPool:
    """Workers that take tasks."""

    executor: Executor  #: Takes tasks.
    died: tuple[type[BaseException], ...]  #: What a task whose worker died raises.
    #: Returns how many workers there are now; those of a cluster come and go.
    count: Callable[[], int]
    _seen: tuple[float, int] = field(default=(-1e9, 1), init=False)

    @property
    def size(self) -> int:
        """How many workers there are, or were a moment ago; at least 1."""
        when, size = self._seen
        if time.monotonic() - when > _COUNT_INTERVAL:
            size = max(1, self.count())
            self._seen = (time.monotonic(), size)
        return size


@contextmanager
def worker_pool(workers: Workers, module: str) -> Iterator[WorkerPool]:
    """Yield workers, which end with the context.

    workers: How many, or which cluster's.
    """
    if workers.cluster is not None:
        with _on_cluster(workers.cluster) as pool:
            yield pool
        return
    from concurrent.futures import ProcessPoolExecutor

    with _inheriting():  # the process that keeps count of its locks is started here
        executor = ProcessPoolExecutor(workers.processes, mp_context=SPAWNING)
    with executor:
        try:
            # Each of the first tasks starts a process.
            for _ in range(workers.processes):
                executor.submit(_load, module)
            yield WorkerPool(executor, (BrokenProcessPool,), lambda: workers.processes)
        except BaseException:
            executor.shutdown(wait=False, cancel_futures=True)
            raise


def _load(module: str) -> None:
    importlib.import_module(module)


class _DaskExecutor(Executor):
    """Hands tasks to a Dask client.

    Dask's own executor (`Client.get_executor`) fails if a worker leaves before its results have
    been fetched; here Dask computes them again.
    """

    def __init__(self, client: Any) -> None:
        self._client = client
        self._tasks: set[Any] = set()  # Dask drops a task that nobody refers to

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Hand over a task; its future raises CancelledError if the scheduler is lost."""
        promised: Future[Any] = Future()
        task = self._client.submit(fn, *args, **kwargs, pure=False)
        self._tasks.add(task)

        def keep(done: Any) -> None:
            if promised.set_running_or_notify_cancel():
                try:
                    promised.set_result(done.result())
                except BaseException as error:
                    promised.set_exception(error)
            self._tasks.discard(task)

        task.add_done_callback(keep)
        return promised


@contextmanager
def _without_log(name: str) -> Iterator[None]:
    """Keep a library's tracebacks off the terminal: what happened is told in one sentence."""
    logger = logging.getLogger(name)
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        logger.setLevel(level)


@contextmanager
def _on_cluster(address: str) -> Iterator[WorkerPool]:
    try:
        from distributed import Client, KilledWorker
    except ImportError as error:
        raise MissingPackageError(f"`cluster` requires Dask: {installing('cluster')}") from error
    silent = (
        f"{address}: no Dask scheduler responds at this address; start a scheduler with "
        "`dask scheduler`"
    )
    try:
        client: Any = Client(address, timeout=_SCHEDULER_TIMEOUT, set_as_default=False)
    except (OSError, ValueError) as error:
        raise CounterspinError(silent, code="cluster-unreachable") from error
    with _without_log("distributed.client"), client:
        try:
            client.wait_for_workers(1, timeout=_FIRST_WORKER_TIMEOUT)
        except TimeoutError as error:
            raise CounterspinError(
                f"{address}: no worker joined this scheduler within {_FIRST_WORKER_TIMEOUT:.0f} "
                f"s; start workers with `dask worker {address}`",
                code="cluster-unreachable",
            ) from error
        except OSError as error:
            raise CounterspinError(silent, code="cluster-unreachable") from error

        def count() -> int:
            try:
                return sum(client.nthreads().values())
            except OSError as error:
                raise CancelledError from error

        try:
            # Dask hands a dead worker's tasks to others by itself, until it gives a task up.
            yield WorkerPool(_DaskExecutor(client), (KilledWorker,), count)
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

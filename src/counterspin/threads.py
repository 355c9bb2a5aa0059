"""Limit on the threads of linear-algebra libraries."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Final

#: Variables from which BLAS libraries read the number of their threads.
BLAS_THREAD_VARIABLES: Final = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


class _ThreadLimit:
    """A limit that the first user sets and the last user lifts."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._n_users = 0
        self._limit: Any = None

    def acquire(self) -> None:
        """Limit the threads of the libraries that are loaded."""
        from threadpoolctl import threadpool_limits

        with self._lock:
            self._n_users += 1
            if self._n_users == 1:
                self._limit = threadpool_limits(limits=1, user_api="blas")

    def release(self) -> None:
        """Restore the previous number of threads."""
        with self._lock:
            self._n_users -= 1
            if self._n_users == 0:
                self._limit.restore_original_limits()
                self._limit = None


_SINGLE_THREAD_LIMIT: Final = _ThreadLimit()


@contextmanager
def single_blas_thread() -> Iterator[None]:
    """Limit linear algebra to one thread, because several threads are slower for small matrices.

    A number of threads in the environment takes precedence; the command line sets one for its own
    process. The libraries must be loaded. Also usable as a decorator.
    """
    if any(os.environ.get(name) for name in BLAS_THREAD_VARIABLES):
        yield
        return
    _SINGLE_THREAD_LIMIT.acquire()
    try:
        yield
    finally:
        _SINGLE_THREAD_LIMIT.release()

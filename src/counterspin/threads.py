"""Threads of the libraries for linear algebra."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Final

#: Variables from which BLAS libraries read the number of their threads.
BLAS_THREADS: Final = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


class _ThreadLimit:
    """A limit that is set by the first who asks for it, and lifted by the last."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._asking = 0
        self._limit: Any = None

    def set(self) -> None:
        """Limit the threads of the libraries that are loaded."""
        from threadpoolctl import threadpool_limits

        with self._lock:
            self._asking += 1
            if self._asking == 1:
                self._limit = threadpool_limits(limits=1, user_api="blas")

    def lift(self) -> None:
        """Give the libraries the threads that they had."""
        with self._lock:
            self._asking -= 1
            if self._asking == 0:
                self._limit.restore_original_limits()
                self._limit = None


_ONE_THREAD: Final = _ThreadLimit()


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Keep linear algebra to one thread: matrices are small here, and more threads take longer.

    Nothing is done where the environment says how many threads there are to be, as the command line
    does for its own process. The libraries must be loaded. It is a decorator, too.
    """
    if any(os.environ.get(name) for name in BLAS_THREADS):
        yield
        return
    _ONE_THREAD.set()
    try:
        yield
    finally:
        _ONE_THREAD.lift()

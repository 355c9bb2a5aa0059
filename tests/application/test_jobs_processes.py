"""Worker processes report their progress and can be terminated."""

import os
import time
from errno import EIO, ENOENT

import pytest

from counterspin.application.jobs import Worker, report_progress
from counterspin.errors import CounterspinError


def collect_messages(worker):
    """Return all messages of a worker."""
    messages = []
    while not messages or messages[-1][0] not in ("done", "failed"):
        messages.append(worker.receive(300.0))
    worker.terminate()
    return messages


def double_with_progress(connection, number):
    def work(progress):
        progress(1, 2)
        return 2 * number

    report_progress(connection, work)


def fail_with(connection, kind):
    def work(_):
        raise kind("in words")

    report_progress(connection, work)


def fail_with_errno(connection, number):
    def work(_):
        raise OSError(number, os.strerror(number), "x/y")

    report_progress(connection, work)


def run_forever(connection):
    report_progress(connection, lambda _: time.sleep(1000.0))


def test_worker_reports_progress_and_result():
    worker = Worker(double_with_progress, 21)
    assert collect_messages(worker) == [("progress", 1, 2), ("done", 42)]
    assert not worker.is_alive


@pytest.mark.parametrize(
    ("work", "words", "message"),
    [
        (fail_with, (CounterspinError,), "in words"),
        (fail_with, (ValueError,), "internal error (ValueError: in words)"),
        (fail_with_errno, (EIO,), f"x/y: the operating system reports: {os.strerror(EIO)}"),
        (fail_with_errno, (ENOENT,), "x/y: file not found"),
        (exit, (), "the process ended unexpectedly, possibly because it ran out of memory"),
    ],
)
def test_worker_reports_failure(work, words, message):
    assert collect_messages(Worker(work, *words)) == [("failed", message)]


def test_worker_can_be_terminated():
    worker = Worker(run_forever)
    assert worker.receive() is None
    worker.terminate()
    assert not worker.is_alive

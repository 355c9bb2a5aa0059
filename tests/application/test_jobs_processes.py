"""A process that says how far it is, and can be ended."""

import time

import pytest

from counterspin.application.jobs import Worker, report_progress
from counterspin.errors import CounterspinError


def heard(worker):
    """Return all that a worker tells, to its end."""
    told = []
    while not told or told[-1][0] not in ("done", "failed"):
        told.append(worker.receive(300.0))
    worker.terminate()
    return told


def doubled(there, number):
    def work(progress):
        progress(1, 2)
        return 2 * number

    report_progress(there, work)


def wrong(there, kind):
    def work(_):
        raise kind("in words")

    report_progress(there, work)


def endless(there):
    report_progress(there, lambda _: time.sleep(1000.0))


def test_it_tells_its_progress_and_what_it_made():
    worker = Worker(doubled, 21)
    assert heard(worker) == [("progress", 1, 2), ("done", 42)]
    assert not worker.is_alive


@pytest.mark.parametrize(
    ("work", "words", "told"),
    [
        (wrong, (CounterspinError,), "in words"),
        (wrong, (ValueError,), "internal error (ValueError: in words)"),
        (exit, (), "the process ended unexpectedly, possibly because the memory was exhausted"),
    ],
)
def test_that_it_failed_is_told(work, words, told):
    assert heard(Worker(work, *words)) == [("failed", told)]


def test_it_is_ended_whatever_it_does():
    worker = Worker(endless)
    assert worker.receive() is None
    worker.terminate()
    assert not worker.is_alive

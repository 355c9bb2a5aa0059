"""Settings of all tests, and the options `--quick` and `--write-slow`.

`slow.txt` in this folder lists the tests that `--quick` leaves out. `make slow` runs all tests and
writes it again.
"""

import gc
import ipaddress
import os
import socket
import sys
import time
from collections import Counter, defaultdict
from pathlib import Path
from statistics import mean

import pytest
from hypothesis import HealthCheck, settings

# The matrices are small: a second thread of linear algebra slows the tests down, eight times with
# parallel tests. The setting has no effect after NumPy is loaded.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Results consist of many objects with few cycles, so that frequent garbage collections free little.
gc.set_threshold(100_000, 20, 100)

# Use the same examples each time, so that results are reproducible. `make fuzz` and
# COUNTERSPIN_FULL=1 draw new ones. They have no deadline, because a busy machine would exceed it.
settings.register_profile(
    "same", derandomize=True, deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
if not os.environ.get("COUNTERSPIN_FULL"):
    settings.load_profile("same")

#: File with the tests that `--quick` leaves out, one per line, without parameters.
SLOW_TESTS = "slow.txt"
#: Duration above which a test is slow, s.
SLOW_DURATION = 0.15

START_TIME = time.monotonic()

#: Tests of process limits, which Windows does not have.
collect_ignore = ["test_fuzz.py", "simulation/test_simulable.py"] if sys.platform == "win32" else []


def pytest_addoption(parser):
    parser.addoption(
        "--quick",
        type=float,
        metavar="SECONDS",
        help=f"leave out the tests of {SLOW_TESTS}, and start no test after so many seconds",
    )
    parser.addoption(
        "--write-slow", action="store_true", help=f"time the tests and write {SLOW_TESTS} anew"
    )


def pytest_configure(config):
    if config.getoption("--write-slow"):
        config.pluginmanager.register(Timing())
    elif config.getoption("--quick") is not None:
        config.pluginmanager.register(Quick(config.getoption("--quick")))


def pytest_collection_finish():
    # Loaded objects are permanent, so that garbage collections can skip them.
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def no_network():
    """Reject connections outside local networks."""
    connect = socket.socket.connect

    def connect_inside(self, address):
        if self.family in (socket.AF_INET, socket.AF_INET6):
            try:
                host = ipaddress.ip_address(address[0])
            except ValueError:
                host = ipaddress.ip_address(socket.gethostbyname(address[0]))
            if host.is_global:
                raise PermissionError(f"a test reaches the network: {address[0]}")
        return connect(self, address)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(socket.socket, "connect", connect_inside)
        yield


def remove_parameters(nodeid):
    return nodeid.partition("[")[0]


class Quick:
    """Start no test after the time limit, because the list of slow tests may be outdated."""

    def __init__(self, seconds):
        self.seconds = seconds
        self.n_deselected = 0
        self.n_skipped = 0

    def pytest_collection_modifyitems(self, config, items):
        slow_names = set(Path(__file__).with_name(SLOW_TESTS).read_text("utf-8").split())
        deselected = [item for item in items if remove_parameters(item.nodeid) in slow_names]
        self.n_deselected = len(deselected)
        config.hook.pytest_deselected(items=deselected)
        items[:] = [item for item in items if remove_parameters(item.nodeid) not in slow_names]

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_protocol(self):
        if time.monotonic() - START_TIME > self.seconds:
            self.n_skipped += 1
            return True
        return None

    def pytest_sessionfinish(self, session):
        if hasattr(session.config, "workeroutput"):
            session.config.workeroutput["quick"] = (self.n_deselected, self.n_skipped)

    @pytest.hookimpl(optionalhook=True)
    def pytest_testnodedown(self, node):
        n_deselected, n_skipped = getattr(node, "workeroutput", {}).get("quick", (0, 0))
        self.n_deselected = n_deselected
        self.n_skipped += n_skipped

    def pytest_terminal_summary(self, terminalreporter):
        terminalreporter.write_line(
            f"Left out: {self.n_deselected} tests that are listed as slow, and {self.n_skipped} "
            f"for which {self.seconds:g} s were not enough."
        )


class Timing:
    """Measure the time of each test and, separately, of its shared fixtures.

    The first test sets up a shared fixture, so its time is divided among all tests that use it.
    """

    def __init__(self):
        self.durations = Counter()
        self.fixture_durations = Counter()
        self.fixture_users = defaultdict(set)
        self.last_fixture_duration = 0.0

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef):
        start = time.monotonic()
        try:
            return (yield)
        finally:
            if fixturedef.scope != "function":
                seconds = time.monotonic() - start
                self.fixture_durations[get_fixture_name(fixturedef)] += seconds
                self.last_fixture_duration += seconds

    def pytest_runtest_setup(self, item):
        for name in item.fixturenames:
            for fixturedef in item.session._fixturemanager.getfixturedefs(name, item) or ():
                self.fixture_users[get_fixture_name(fixturedef)].add(item.nodeid)

    def pytest_runtest_logreport(self, report):
        self.durations[report.nodeid] += report.duration - self.last_fixture_duration
        self.last_fixture_duration = 0.0

    def pytest_sessionfinish(self):
        seconds = self.durations.copy()
        for name, users in self.fixture_users.items():
            for user in users:
                seconds[user] += self.fixture_durations[name] / len(users)
        cases = defaultdict(list)
        for nodeid, duration in seconds.items():
            cases[remove_parameters(nodeid)].append(duration)
        slow_names = sorted(
            name for name, duration in cases.items() if mean(duration) > SLOW_DURATION
        )
        Path(__file__).with_name(SLOW_TESTS).write_text("".join(f"{name}\n" for name in slow_names))


def get_fixture_name(fixturedef):
    return f"{fixturedef.baseid}::{fixturedef.argname}"

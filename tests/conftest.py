"""What every test runs under, `--quick` and `--write-slow`.

`slow.txt` beside this file lists the tests that `--quick` leaves out. `make slow` runs all tests
and writes it anew.
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

# The matrices are small: a second thread of linear algebra costs more than it brings, and eight
# times as much while tests run side by side. It counts only before NumPy is loaded.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Results consist of many objects and few cycles: frequent collections of garbage free little.
gc.set_threshold(100_000, 20, 100)

# The same examples each time: a test that draws others may fail where nothing has changed. New
# ones are drawn by `make fuzz`, and here with COUNTERSPIN_FULL=1. Their time has no limit, because
# a busy machine would exceed it.
settings.register_profile(
    "same", derandomize=True, deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
if not os.environ.get("COUNTERSPIN_FULL"):
    settings.load_profile("same")

#: The tests that `--quick` leaves out, one a line, whatever their parameters.
SLOW_TESTS = "slow.txt"
#: A test that lasts longer is slow, s.
SLOW = 0.15

START = time.monotonic()

#: Limits of processes that Windows does not have.
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
    # All that is loaded by now stays: no collection of garbage need go through it again.
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def no_network():
    """Reject connections beyond this machine and its local networks."""
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


def without_parameters(nodeid):
    return nodeid.partition("[")[0]


class Quick:
    """Start no test after the time limit, because the list of slow tests may be outdated."""

    def __init__(self, seconds):
        self.seconds = seconds
        self.listed = 0
        self.too_late = 0

    def pytest_collection_modifyitems(self, config, items):
        slow = set(Path(__file__).with_name(SLOW_TESTS).read_text("utf-8").split())
        left_out = [item for item in items if without_parameters(item.nodeid) in slow]
        self.listed = len(left_out)
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in items if without_parameters(item.nodeid) not in slow]

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_protocol(self):
        if time.monotonic() - START > self.seconds:
            self.too_late += 1
            return True
        return None

    def pytest_sessionfinish(self, session):
        if hasattr(session.config, "workeroutput"):
            session.config.workeroutput["quick"] = (self.listed, self.too_late)

    @pytest.hookimpl(optionalhook=True)
    def pytest_testnodedown(self, node):
        listed, too_late = getattr(node, "workeroutput", {}).get("quick", (0, 0))
        self.listed = listed
        self.too_late += too_late

    def pytest_terminal_summary(self, terminalreporter):
        terminalreporter.write_line(
            f"Left out: {self.listed} tests that are listed as slow, and {self.too_late} for which "
            f"{self.seconds:g} s were not enough."
        )


class Timing:
    """Measure the time of each test and, separately, of its shared fixtures.

    The first test sets up a shared fixture, so its time is divided among all tests that use it.
    """

    def __init__(self):
        self.own = Counter()
        self.shared = Counter()
        self.users = defaultdict(set)
        self.just_shared = 0.0

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef):
        start = time.monotonic()
        try:
            return (yield)
        finally:
            if fixturedef.scope != "function":
                seconds = time.monotonic() - start
                self.shared[fixture_name(fixturedef)] += seconds
                self.just_shared += seconds

    def pytest_runtest_setup(self, item):
        for name in item.fixturenames:
            for fixturedef in item.session._fixturemanager.getfixturedefs(name, item) or ():
                self.users[fixture_name(fixturedef)].add(item.nodeid)

    def pytest_runtest_logreport(self, report):
        self.own[report.nodeid] += report.duration - self.just_shared
        self.just_shared = 0.0

    def pytest_sessionfinish(self):
        seconds = self.own.copy()
        for name, users in self.users.items():
            for user in users:
                seconds[user] += self.shared[name] / len(users)
        cases = defaultdict(list)
        for nodeid, lasted in seconds.items():
            cases[without_parameters(nodeid)].append(lasted)
        slow = sorted(name for name, lasted in cases.items() if mean(lasted) > SLOW)
        Path(__file__).with_name(SLOW_TESTS).write_text("".join(f"{name}\n" for name in slow))


def fixture_name(fixturedef):
    return f"{fixturedef.baseid}::{fixturedef.argname}"

"""What every test runs under, and `--quick`."""

import os

from hypothesis import settings

# The matrices are small: a second thread of linear algebra costs more than it brings, and eight
# times as much while tests run side by side. It counts only before NumPy is loaded.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# The same examples each time: a test that draws others may fail where nothing has changed. New
# ones are drawn by `make fuzz`, and here with COUNTERSPIN_FULL=1.
settings.register_profile("same", derandomize=True, deadline=None)
if not os.environ.get("COUNTERSPIN_FULL"):
    settings.load_profile("same")

#: Where the durations are kept between runs, in pytest's cache.
DURATIONS = "counterspin/durations"
#: What a test that has never been run is taken to last, s.
UNKNOWN = 0.1

#: Test -> how long it lasts in this run, s.
LASTED = {}


def pytest_addoption(parser):
    parser.addoption(
        "--quick",
        type=float,
        metavar="SECONDS",
        help="only the shortest tests, as they were last timed, that last so long together",
    )


def pytest_collection_modifyitems(config, items):
    """Leave out the longest tests: nobody marks them, so that no mark can be out of date."""
    budget = config.getoption("--quick")
    if budget is None:
        return
    known = config.cache.get(DURATIONS, {})
    spent, kept = 0.0, set()
    for item in sorted(items, key=lambda item: known.get(item.nodeid, UNKNOWN)):
        spent += known.get(item.nodeid, UNKNOWN)
        if spent <= budget:
            kept.add(item)
    config.hook.pytest_deselected(items=[item for item in items if item not in kept])
    items[:] = [item for item in items if item in kept]


def pytest_runtest_logreport(report):
    """Add set-up, call and tear-down of each test; a fixture's time is with its first user."""
    seconds = LASTED.get(report.nodeid, 0.0) if report.when != "setup" else 0.0
    LASTED[report.nodeid] = seconds + report.duration


def pytest_sessionfinish(session):
    # xdist's workers report to the one that keeps; without pytest's cache nothing is kept.
    if not hasattr(session.config, "workerinput") and hasattr(session.config, "cache"):
        known = session.config.cache.get(DURATIONS, {})
        session.config.cache.set(DURATIONS, known | LASTED)

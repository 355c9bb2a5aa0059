"""Chromium, driven by Playwright, for tests of what a browser shows.

COUNTERSPIN_CHROMIUM names an executable; without it, ``chromium`` of the path is taken.
"""

import os
import shutil
from contextlib import contextmanager
from importlib.util import find_spec

import pytest

EXECUTABLE = os.environ.get("COUNTERSPIN_CHROMIUM") or shutil.which("chromium")

needs_chromium = pytest.mark.skipif(
    EXECUTABLE is None or find_spec("playwright") is None,
    reason="no Chromium: install Debian's package, or set COUNTERSPIN_CHROMIUM",
)


#: The longest wait for the browser, ms: a wait that succeeds ends earlier.
MAX_WAIT = 300_000


@contextmanager
def launch_chromium():
    """Start Chromium and close it at the end of the context."""
    from playwright.sync_api import sync_playwright

    # Chromium refuses to sandbox itself for root, as whom continuous integration often runs.
    root = hasattr(os, "geteuid") and os.geteuid() == 0
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=EXECUTABLE,
            args=["--no-sandbox"] if root else [],
            timeout=MAX_WAIT,
        )
        yield browser
        browser.close()


def open_context(browser, **settings):
    """Return a browser context with timeouts that suit a busy machine."""
    context = browser.new_context(**settings)
    context.set_default_timeout(MAX_WAIT)
    return context


def wait_until(tab, condition):
    """Wait until something holds; the page's policy lets no text be evaluated while it waits."""
    for _ in range(MAX_WAIT // 50):
        if condition():
            return
        tab.wait_for_timeout(50)
    assert condition()

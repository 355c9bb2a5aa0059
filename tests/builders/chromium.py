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


@contextmanager
def chromium():
    """Start Chromium; it ends with the context."""
    from playwright.sync_api import sync_playwright

    # Chromium refuses to sandbox itself for root, as whom continuous integration often runs.
    root = hasattr(os, "geteuid") and os.geteuid() == 0
    with sync_playwright() as playwright:
        started = playwright.chromium.launch(
            executable_path=EXECUTABLE, args=["--no-sandbox"] if root else []
        )
        yield started
        started.close()

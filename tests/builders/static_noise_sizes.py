"""Analyses of noise at rest for tests that look at sizes alone."""

from contextlib import contextmanager

import pytest

from counterspin.inference.noise import static_noise


@contextmanager
def without_intervals():
    """Leave out the search for the ends of intervals, which takes most of an analysis."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(static_noise, "_interval_end", lambda *_: None)
        yield

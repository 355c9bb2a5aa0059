"""Analyses of static noise for tests that use only point estimates."""

from contextlib import contextmanager

import pytest

from counterspin.inference.noise import static_noise


@contextmanager
def disable_intervals():
    """Skip the search for interval limits, which takes most of the time of an analysis."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(static_noise, "_interval_end", lambda *_: None)
        yield

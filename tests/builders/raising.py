"""Expected errors, by code."""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from counterspin.errors import CounterspinError, InputError


@contextmanager
def raises(code: str, *parts: str) -> Iterator[pytest.ExceptionInfo]:
    """Expect an error with a code, whose message contains these parts in this order.

    parts: The keys, files, lines and numbers that the message must state, but none of its prose.
    """
    with pytest.raises((CounterspinError, InputError)) as caught:
        yield caught
    assert_states(caught.value, code, *parts)


def assert_states(error: CounterspinError | InputError, code: str, *parts: str) -> None:
    """Assert that an error has a code, and that its message contains these parts in this order."""
    assert code in getattr(error, "codes", (error.code,)), (error.code, str(error))
    remaining_text = str(error)
    for part in parts:
        assert part in remaining_text, f"{part!r} is missing from {error}"
        remaining_text = remaining_text.partition(part)[2]

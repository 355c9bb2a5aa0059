"""Errors in words that a user can act on.

Every error that counterspin raises on purpose is a `CounterspinError`. The command line prints
its message as one short paragraph and ends with `exit_status`; Python users catch the class.

What a user should know though the work goes on is a `CounterspinWarning`; the command line prints
it. `installing` says how a part is had that not everybody installs.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from itertools import zip_longest
from typing import ClassVar, Final

from counterspin._version import __version__

#: The most characters of a value that a message shows.
_VALUE_LENGTH: Final = 200

#: A value that is longer: in quotation marks, or without blanks.
_LONG: Final = re.compile(
    rf"'[^']{{{_VALUE_LENGTH},}}'|\"[^\"]{{{_VALUE_LENGTH},}}\"|\S{{{_VALUE_LENGTH + 1},}}"
)

#: The most characters of a line.
_LINE_LENGTH: Final = 3000

#: The most characters of a library's complaint, or of a file's own words, that a message repeats.
REASON_LENGTH: Final = 150

#: What Polars reads the number of its threads from, and the most threads that counterspin allows.
_THREADS: Final = "POLARS_MAX_THREADS"
_MOST_THREADS: Final = 1024

#: As many lines at the beginning and at the end of a message are shown.
_END_LINES: Final = 20


def installing(extra: str) -> str:
    """Return how an extra of counterspin is installed, for a message that ends there.

    No index has counterspin, so its name alone installs nothing: whoever has it has a clone or a
    wheel, and pip takes the extra behind the path of either. A clone cannot be installed without
    a network, since what builds it is fetched; its wheel can.
    """
    wheel = f"counterspin-{__version__}-py3-none-any.whl[{extra}]"
    return (
        f"`pip install '.[{extra}]'` in the folder of counterspin's clone, or `pip install "
        f"'./{wheel}'` in the folder of the wheel; without a network, `pip wheel -w DIR` with the "
        "same arguments on a computer with a network, then `pip install --no-index --find-links "
        f"DIR 'DIR/{wheel}'` on this computer"
    )


def describe_read_error(error: OSError) -> str:
    """Return the reason why a file cannot be read, for a message that names the file."""
    if isinstance(error, FileNotFoundError):
        return "file not found"
    return f"cannot be read ({error.strerror})"


class CounterspinError(Exception):
    """The base of all errors that counterspin raises on purpose."""

    exit_status = 1

    def __str__(self) -> str:
        """Return the message, with long values and long lists cut in the middle."""
        lines = super().__str__().split("\n")
        left_out = len(lines) - 2 * _END_LINES
        if left_out > 1:
            lines[_END_LINES:-_END_LINES] = [f"  ... and {left_out} more"]
        return "\n".join(
            _cut(_LONG.sub(lambda value: _cut(value[0], _VALUE_LENGTH), line), _LINE_LENGTH)
            for line in lines
        )


def _cut(text: str, most: int) -> str:
    return text if len(text) <= most else f"{text[: most // 2 - 5]} ... {text[5 - most // 2 :]}"


class CampaignError(CounterspinError):
    """A campaign file (or another input that a person wrote) is wrong; all mistakes at once.

    Parameters
    ----------
    source
        The file, as the user named it.
    problems
        One line per mistake, each beginning with the path of its key.
    lines
        Where each stands in the source, from 1, as far as that is known.
    """

    exit_status = 2
    heading: ClassVar[str] = "mistakes"  #: Noun that follows the number of problems.

    def __init__(
        self, source: str, problems: Iterable[str], lines: Iterable[int | None] = ()
    ) -> None:
        self.source = source
        # A line end in a name that a file gave begins no further line.
        self.problems = tuple(problem.replace("\n", r"\n") for problem in problems)
        told = [
            problem if line is None else f"line {line}: {problem}"
            for problem, line in zip_longest(self.problems, lines)
        ]
        if len(told) == 1:
            text = f"{source}: {told[0]}"
        else:
            text = f"{source}: {len(told)} {self.heading}\n" + "\n".join(f"  {one}" for one in told)
        super().__init__(text)


class MissingAnswersError(CampaignError):
    """Questions about a file have no answer, or no valid one."""

    heading = "answers are still needed"


class RecordError(CounterspinError):
    """A record file is missing, damaged or not physically possible."""


class DamagedFileError(RecordError):
    """A file of which its reader could make nothing."""


class NotIdentifiableError(CounterspinError):
    """The data cannot determine the unknowns that are asked of them."""


class ConvergenceError(CounterspinError):
    """An iteration did not settle."""


class CounterspinWarning(UserWarning):
    """Something that a user should know, though the work goes on."""


def require_thread_count() -> None:
    """Raise `CampaignError` unless POLARS_MAX_THREADS is absent or a usable number of threads.

    Polars panics at 0, and starts as many threads as a large number states.
    """
    value = os.environ.get(_THREADS)
    if value is None or (re.fullmatch("0*[1-9][0-9]{0,3}", value) and int(value) <= _MOST_THREADS):
        return
    raise CampaignError(
        f"environment variable {_THREADS}",
        [f"{value!r} is not a whole number from 1 to {_MOST_THREADS}; correct or unset it"],
    )

"""Errors in words that a user can act on.

Every error that counterspin raises on purpose is a `CounterspinError`. The command line prints
its message as one short paragraph and ends with `exit_status`; Python users catch the class. The
`code` of an error names the kind of mistake. `error_codes.CODES` describes the codes, which do not
change when a message is reworded.

A `CounterspinWarning` informs the user while the work continues; the command line prints it.
`install_command` returns the installation command of an optional extra.
"""

from __future__ import annotations

import copyreg
import os
import re
from collections.abc import Iterable, Sequence
from itertools import zip_longest
from typing import Any, ClassVar, Final

from counterspin._version import __version__

#: Maximum number of characters of a value in a message.
_MAX_VALUE_LENGTH: Final = 200

#: A longer value, in quotation marks or without spaces.
_LONG_VALUE: Final = re.compile(
    rf"'[^']{{{_MAX_VALUE_LENGTH},}}'|\"[^\"]{{{_MAX_VALUE_LENGTH},}}\""
    rf"|\S{{{_MAX_VALUE_LENGTH + 1},}}"
)

#: Maximum number of characters of a line.
_MAX_LINE_LENGTH: Final = 3000

#: Maximum number of quoted characters of a library's message or a file's text.
MAX_REASON_LENGTH: Final = 150

#: Environment variable with the number of Polars threads, and the maximum that is allowed.
_THREADS_VARIABLE: Final = "POLARS_MAX_THREADS"
_MAX_THREADS: Final = 1024

#: Number of lines shown at the beginning and at the end of a message.
_N_END_LINES: Final = 20


def install_command(extra: str) -> str:
    """Return the installation command of an extra, as the end of a message.

    counterspin is in no package index, so pip needs the path of a clone or a wheel before the
    extra. Only the wheel can be installed without a network, because pip downloads the build
    requirements of a clone.
    """
    wheel = f"counterspin-{__version__}-py3-none-any.whl[{extra}]"
    return (
        f"`pip install '.[{extra}]'` in the clone of counterspin, or `pip install "
        f"'./{wheel}'` in the folder of the wheel; without a network, `pip wheel -w DIR` with the "
        "same arguments on a computer with a network, then `pip install --no-index --find-links "
        f"DIR 'DIR/{wheel}'` on this computer"
    )


def describe_read_error(error: OSError) -> str:
    """Return the reason why a file cannot be read, for a message that names the file."""
    if isinstance(error, FileNotFoundError):
        return "file not found"
    return f"cannot be read ({error.strerror})"


def describe_system_error(error: OSError) -> str:
    """Return the message for an error of the operating system, with the name of the file."""
    location = f"{error.filename}: " if error.filename else ""
    if location and isinstance(error, FileNotFoundError):
        return f"{location}{describe_read_error(error)}"
    return f"{location}the operating system reports: {error.strerror or error}"


def read_error_code(error: OSError) -> str:
    """Return the code of the error for a file that cannot be read."""
    return "file-not-found" if isinstance(error, FileNotFoundError) else "file-not-readable"


def error_code(error: object, default: str = "invalid-value") -> str:
    """Return the code of an error or a `Problem`; `default` for other errors and texts."""
    return getattr(error, "code", default)


class Problem(str):
    """The message of a mistake in an input, with its code."""

    code: str

    def __new__(cls, message: str, code: str) -> Problem:
        """Return the message with its code."""
        problem = super().__new__(cls, message)
        problem.code = code
        return problem


class InputError(ValueError):
    """A `ValueError` with a code, for a mistake that its caller reports with a key."""

    code: str = "invalid-value"

    def __init__(self, message: str, code: str | None = None) -> None:
        super().__init__(message)
        self.code = code or self.code


class OutOfRangeError(InputError):
    """A value is not finite, or outside the range that is allowed or plausible."""

    code = "value-out-of-range"


class CounterspinError(Exception):
    """Base class of all errors that counterspin raises on purpose.

    Parameters
    ----------
    *args
        The message.
    code
        The kind of mistake, a key of `error_codes.CODES`; None: the code of the class.
    """

    exit_status = 1
    code: str = "unspecified"  #: The kind of mistake, such as ``file-not-found``.

    def __init__(self, *args: object, code: str | None = None) -> None:
        super().__init__(*args)
        if code is not None:
            self.code = code
        if code == UsageError.code:
            self.exit_status = UsageError.exit_status

    def __reduce__(self) -> tuple[Any, ...]:
        """Return class, message and attributes, to pickle the error for another process."""
        return copyreg.__newobj__, (type(self), *self.args), self.__dict__  # type: ignore[attr-defined]

    def __str__(self) -> str:
        """Return the message, with the middle of long values and long lists omitted."""
        lines = super().__str__().split("\n")
        n_omitted = len(lines) - 2 * _N_END_LINES
        if n_omitted > 1:
            lines[_N_END_LINES:-_N_END_LINES] = [f"  ... and {n_omitted} more"]
        return "\n".join(
            _cut_middle(
                _LONG_VALUE.sub(lambda value: _cut_middle(value[0], _MAX_VALUE_LENGTH), line),
                _MAX_LINE_LENGTH,
            )
            for line in lines
        )


def _cut_middle(text: str, max_length: int) -> str:
    return (
        text
        if len(text) <= max_length
        else f"{text[: max_length // 2 - 5]} ... {text[5 - max_length // 2 :]}"
    )


class CampaignError(CounterspinError):
    """A campaign file (or another input that a person wrote) is wrong; all mistakes at once.

    Parameters
    ----------
    source
        The file, as the user named it.
    problems
        One line per mistake, each beginning with the path of its key.
    lines
        Line of each problem in the source, from 1; None: not known.
    code
        Code of all problems, or a code for each problem; None: the code of each `Problem`, or the
        code of the class.
    """

    exit_status = 2
    code: str = "invalid-value"
    heading: ClassVar[str] = "mistakes"  #: Noun that follows the number of problems.

    def __init__(
        self,
        source: str,
        problems: Iterable[str],
        lines: Iterable[int | None] = (),
        *,
        code: str | Sequence[str] | None = None,
    ) -> None:
        self.source = source
        problems = list(problems)
        if code is None or isinstance(code, str):
            code = [code or error_code(problem, self.code) for problem in problems]
        self.codes = tuple(code)  #: The code of each problem.
        # A line break in a name from a file must not begin a new line of the message.
        self.problems = tuple(problem.replace("\n", r"\n") for problem in problems)
        messages = [
            problem if line is None else f"line {line}: {problem}"
            for problem, line in zip_longest(self.problems, lines)
        ]
        if len(messages) == 1:
            text = f"{source}: {messages[0]}"
        else:
            text = f"{source}: {len(messages)} {self.heading}\n" + "\n".join(
                f"  {message}" for message in messages
            )
        super().__init__(text, code=next(iter(self.codes), None))


class UsageError(CampaignError):
    """The arguments of a command or of a function are missing, contradictory or not valid."""

    code = "wrong-usage"


class MissingAnswersError(CampaignError):
    """Questions about a file have no answer, or no valid one."""

    code = "missing-answer"
    heading = "answers are still needed"


class InvalidAnswersError(MissingAnswersError):
    """Some answers about a file are not valid; others may be missing."""

    heading = "answers are missing or not valid"


class RecordError(CounterspinError):
    """A record file is missing, damaged or not physically possible."""


class DamagedFileError(RecordError):
    """A record file cannot be parsed."""

    code = "file-damaged"


class ExistingFileError(CounterspinError):
    """A file or folder exists where output is to be written, and is not overwritten."""

    code = "file-exists"


class WriteError(CounterspinError):
    """A file or folder cannot be written."""

    code = "file-not-writable"


class MissingPackageError(CounterspinError):
    """An optional package is not installed."""

    code = "missing-package"


class NotIdentifiableError(CounterspinError):
    """The data cannot determine the requested unknowns."""

    code = "not-identifiable"


class ConvergenceError(CounterspinError):
    """An iteration did not converge."""

    code = "no-convergence"


class CounterspinWarning(UserWarning):
    """A warning for the user; the work continues.

    Parameters
    ----------
    message
        The message.
    code
        The kind of warning, a key of `error_codes.CODES`.
    """

    def __init__(self, message: str, *, code: str) -> None:
        super().__init__(message)
        self.code = code


def require_thread_count() -> None:
    """Raise `CampaignError` unless POLARS_MAX_THREADS is absent or a usable number of threads.

    Polars panics at 0, and starts as many threads as a large number states.
    """
    value = os.environ.get(_THREADS_VARIABLE)
    if value is None or (re.fullmatch("0*[1-9][0-9]{0,3}", value) and int(value) <= _MAX_THREADS):
        return
    raise UsageError(
        f"environment variable {_THREADS_VARIABLE}",
        [f"{value!r} is not a whole number from 1 to {_MAX_THREADS}; correct or unset it"],
    )

"""The command line: words to calls, errors to one paragraph, nothing else.

A command imports what it uses when it runs, so that `--help` answers at once.

- `init`, `calibrate`, `applied`, `operating`, `certificate`, `apply`, `plan`, `study`: one each
- `records`: `simulate`, `check`, `watch`, `noise`
- `results`: `report`, `history`, `compare`, `intercompare`, `rerun`, `export`,
  `ledger`
- `program`: `schema`, `serve`, `demo`, `reproduce`, `validate`
- `common`: shared options, output, and errors in the terms of a command line
"""

from __future__ import annotations

import os
import sys
import warnings
from contextlib import suppress
from errno import ENOSPC
from typing import Any

from cyclopts import App, CycloptsError, Parameter

from counterspin._version import __version__
from counterspin.cli.common import print_error, translate_message
from counterspin.errors import (
    CampaignError,
    CounterspinError,
    CounterspinWarning,
    UsageError,
    describe_read_error,
    require_thread_count,
)


def _format_default(value: object) -> str | None:
    """Return a default as the help shows it; nothing if omission of the option explains it."""
    if value is None or value is False or value == ():
        return None
    return "on" if value is True else str(value)


app = App(
    name="counterspin",
    help="Calibrate inertial accelerometers on precision centrifuges.",
    version=__version__,
    help_format="plaintext",  # nothing there is Markdown, whose reader takes long to load
    # Only what is on needs a word that turns it off, see `OnOff`.
    default_parameter=Parameter(
        negative_bool=(), negative_iterable=(), show_default=_format_default
    ),
    suppress_keyboard_interrupt=False,  # `main` has a word for it
)

for _path in (
    "init:init",
    "records:simulate",
    "calibrate:calibrate",
    "results:report",
    "certificate:certificate",
    "results:ledger",
    "results:history",
    "results:compare",
    "results:intercompare",
    "results:rerun",
    "applied:applied",
    "operating:operating",
    "records:check",
    "records:watch",
    "records:noise",
    "apply:apply",
    "results:export",
    "plan:plan",
    "study:study",
    "program:schema",
    "program:serve",
    "program:demo",
    "program:reproduce",
    "program:validate",
):
    app.command(f"{__name__}.{_path}")  # imported when the command is called


def _unexpected_error_message(error: Exception) -> str:
    """Return a message about an unforeseen error, usually but not always a defect of ours."""
    if isinstance(error, MemoryError):
        return "not enough memory"
    if isinstance(error, OSError) and error.errno == ENOSPC:
        return "the output cannot be written: no space left on device"
    if isinstance(error, OSError) and error.strerror:
        # A name that is too long, a folder that was taken away: none of our faults.
        where = f"{error.filename}: " if error.filename else ""
        if where and isinstance(error, FileNotFoundError):
            return f"{where}{describe_read_error(error)}"
        return str(CounterspinError(f"{where}the operating system reports: {error.strerror}"))
    if isinstance(error, ImportError):
        return (
            f"part of the installation cannot be loaded ({CounterspinError(str(error))}); "
            "reinstall counterspin, or check whether enough memory is free"
        )
    what = str(CounterspinError(f"{type(error).__name__}: {error}"))
    return (
        f"internal error ({what}). The error is in counterspin, not in your files. To help the "
        "maintainers, repeat the command with COUNTERSPIN_DEBUG=1 and send them the output."
    )


def _discard_output() -> None:
    """Drop what standard output has not taken: at the end it would be tried, and fail, again."""
    with suppress(OSError, ValueError, AttributeError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)


def main(arguments: list[str] | None = None) -> int:
    """Run the command line and return the exit status: 0 done, 1 failed, 2 wrong usage."""
    words = sys.argv[1:] if arguments is None else arguments
    with warnings.catch_warnings():
        warnings.simplefilter("always", CounterspinWarning)
        usual = warnings.showwarning

        def show(message: Warning | str, category: type[Warning], *where: Any, **more: Any) -> None:
            if issubclass(category, CounterspinWarning):
                print_error(translate_message(str(message), app, words))
            else:
                usual(message, category, *where, **more)

        warnings.showwarning = show
        return _run(words)


def _run(words: list[str]) -> int:
    try:
        require_thread_count()
        if any("\0" in word for word in words):
            raise UsageError("the arguments of the command", ["contain a NUL character"])
        if not words or words[0].startswith("-"):
            app.resolved_commands()  # for the list of commands with their descriptions
        app(words, exit_on_error=False, print_error=False, result_action="return_value")
        if sys.stdout is not None:
            sys.stdout.flush()
    except CounterspinError as error:
        print_error(translate_message(str(error), app, words))
        return error.exit_status
    except CycloptsError as error:
        print_error(str(error))
        command = " ".join(("counterspin", *(error.command_chain or ()), "--help"))
        print(f"Try {command}.", file=sys.stderr)
        return CampaignError.exit_status
    except KeyboardInterrupt as stop:
        print_error(str(stop) or "stopped")
        return 130
    except BrokenPipeError:
        _discard_output()
        return 0
    except Exception as error:
        # Never a traceback for a user; with this variable set, one for whoever mends it.
        if os.environ.get("COUNTERSPIN_DEBUG"):
            raise
        _discard_output()
        print_error(_unexpected_error_message(error))
        return 1
    return 0

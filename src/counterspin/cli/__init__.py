"""Command line: parses arguments, calls functions, and prints errors as one paragraph.

Each command imports modules when it runs, so that `--help` is fast.

- `init`, `calibrate`, `applied`, `operating`, `certificate`, `apply`, `plan`, `study`: one command
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
from counterspin.cli.common import (
    describe_usage_error,
    print_error,
    require_file_names,
    translate_message,
)
from counterspin.errors import (
    CampaignError,
    CounterspinError,
    CounterspinWarning,
    UsageError,
    describe_system_error,
    require_thread_count,
)


def _format_default(value: object) -> str | None:
    """Return a default value for the help; None if the default is to omit the option."""
    if value is None or value is False or value == ():
        return None
    return "on" if value is True else str(value)


app = App(
    name="counterspin",
    help="Calibrate inertial accelerometers on precision centrifuges.",
    version=__version__,
    help_format="plaintext",  # the Markdown parser takes long to load
    # Only options that are on by default have a negative form, see `OnOff`.
    default_parameter=Parameter(
        negative_bool=(), negative_iterable=(), show_default=_format_default
    ),
    suppress_keyboard_interrupt=False,  # `main` handles it
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
app.command(f"{__name__}.program:install_completion", name="--install-completion")


def _describe_unexpected_error(error: Exception) -> str:
    """Return a message about an unexpected error, which is usually a defect of counterspin."""
    if isinstance(error, MemoryError):
        return "not enough memory"
    if isinstance(error, OSError) and error.errno == ENOSPC:
        return "the output cannot be written: no space left on device"
    if isinstance(error, OSError) and error.strerror:
        # Not a defect of counterspin: the file name is too long, or the folder was removed.
        return str(CounterspinError(describe_system_error(error)))
    if isinstance(error, ImportError):
        return (
            f"part of the installation cannot be loaded ({CounterspinError(str(error))}); "
            "reinstall counterspin, or check whether enough memory is free"
        )
    error_text = str(CounterspinError(f"{type(error).__name__}: {error}"))
    return (
        f"internal error ({error_text}). The error is in counterspin, not in your files. To help "
        "the maintainers, repeat the command with COUNTERSPIN_DEBUG=1 and send them the output."
    )


def _discard_output() -> None:
    """Discard buffered output; flushing it at exit would fail again."""
    with suppress(OSError, ValueError, AttributeError):
        null_device = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null_device, sys.stdout.fileno())
        os.close(null_device)


def main(arguments: list[str] | None = None) -> int:
    """Run the command line and return the exit status: 0 done, 1 failed, 2 wrong usage."""
    arguments = sys.argv[1:] if arguments is None else arguments
    with warnings.catch_warnings():
        warnings.simplefilter("always", CounterspinWarning)
        default_showwarning = warnings.showwarning

        def show_warning(
            message: Warning | str, category: type[Warning], *location: Any, **options: Any
        ) -> None:
            if issubclass(category, CounterspinWarning):
                print_error(translate_message(str(message), app, arguments))
            else:
                default_showwarning(message, category, *location, **options)

        warnings.showwarning = show_warning
        return _run_command(arguments)


def _run_command(arguments: list[str]) -> int:
    try:
        require_thread_count()
        if any("\0" in argument for argument in arguments):
            raise UsageError("the arguments of the command", ["contain a NUL character"])
        require_file_names(app, arguments)
        if not arguments or arguments[0].startswith("-"):
            app.resolved_commands()  # for the list of commands with their descriptions
        app(arguments, exit_on_error=False, print_error=False, result_action="return_value")
        if sys.stdout is not None:
            sys.stdout.flush()
    except CounterspinError as error:
        print_error(translate_message(str(error), app, arguments))
        return error.exit_status
    except CycloptsError as error:
        print_error(describe_usage_error(error, arguments))
        help_command = " ".join(("counterspin", *(error.command_chain or ()), "--help"))
        print(f"Try {help_command}.", file=sys.stderr)
        return CampaignError.exit_status
    except KeyboardInterrupt as interrupt:
        print_error(str(interrupt) or "stopped")
        return 130
    except BrokenPipeError:
        _discard_output()
        return 0
    except Exception as error:
        # Users get no traceback; developers set this variable.
        if os.environ.get("COUNTERSPIN_DEBUG"):
            raise
        _discard_output()
        print_error(_describe_unexpected_error(error))
        return 1
    return 0

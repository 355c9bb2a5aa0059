"""Options and output shared by commands, and translation of messages for the command line."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from inspect import cleandoc
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, TextIO, TypeVar

from cyclopts import App, Parameter

from counterspin.characters import MultilineText, escape_controls, substitute_unencodable
from counterspin.errors import CounterspinError
from counterspin.frozen import frozen
from counterspin.output import FileType, check_writable
from counterspin.shell import quote_word

if TYPE_CHECKING:
    from counterspin.results import ResultFile

CommandT = TypeVar("CommandT", bound=Callable[..., None])
OptionsT = TypeVar("OptionsT")

OutputFolder = Annotated[Path, Parameter(name=["--output", "-o"])]
OutputFile = Annotated[Path | None, Parameter(name=["--output", "-o"])]
JsonFile = Annotated[Path | None, Parameter(name="--json")]

#: An option that is on or automatic by default, and is turned off by ``--no-...``.
OnOff = Annotated[bool, Parameter(negative_bool="no-")]


def unwrap_docstring(docstring: str) -> str:
    """Return a docstring with each paragraph and each parameter description on one line.

    The help wraps lines itself, and would keep the line breaks of the source in addition.
    """
    lines: list[str] = []
    has_sections = False
    for line in cleandoc(docstring).splitlines():
        has_sections |= line.startswith("---")
        previous_line = lines[-1] if lines else ""
        is_parameter_continuation = line.startswith("    ") and previous_line.startswith("    ")
        is_paragraph_continuation = not has_sections and line and previous_line
        if (
            (is_paragraph_continuation or is_parameter_continuation)
            and line.strip()
            and not line.startswith("---")
        ):
            lines[-1] += " " + line.strip()
        else:
            lines.append(line)
    return "\n".join(lines) + "\n"


def command(function: CommandT) -> CommandT:
    """Decorate a function of the command line: prepare its docstring for the help."""
    function.__doc__ = unwrap_docstring(function.__doc__ or "")
    return function


def option_group(options: type[OptionsT]) -> type[OptionsT]:
    """Decorate a class whose fields are options of the commands that have it as a parameter."""
    options.__doc__ = unwrap_docstring(options.__doc__ or "")
    return Parameter(name="*")(options)


@option_group
@frozen
class SaveOptions:
    """Output file of the result.

    Parameters
    ----------
    json
        Also write the result to this JSON file.
    overwrite
        Replace files that an earlier run of this command wrote; other files are never replaced.
    """

    json: JsonFile = None
    overwrite: bool = False

    def check_writable(self, file_type: Callable[[], FileType]) -> None:
        """Raise CounterspinError, before any computation, if the file cannot be written."""
        if self.json is not None:
            check_writable(self.json, file_type, overwrite=self.overwrite)

    @contextmanager
    def saving(self, result: ResultFile) -> Iterator[None]:
        """Write a result before it is printed; if that fails, print it and raise the error."""
        write_error = None
        if self.json is not None:
            try:
                result.write(self.json, overwrite=self.overwrite)
            except CounterspinError as error:
                write_error = error
        try:
            yield
        finally:
            if write_error is not None:
                raise write_error


#: Options without a result file.
NO_RESULT_FILE: Final = SaveOptions()

#: Function named in a message -> the equivalent command.
_COMMAND_BY_FUNCTION: Final = {
    "certificates.lab.write_example": "counterspin certificate --init LAB.toml",
    "forecast": "counterspin plan --check DIR",
    "planning.plan.write_example": "counterspin plan --init FILE",
    "write_result": "counterspin calibrate DIR --json FILE",
}

#: An argument in a message: `name`, `name=True`, `name="value"`.
_ARGUMENT: Final = re.compile(
    r'`(?P<name>[\w.]+)(?:=(?:(?P<truth>True|False)|"(?P<text>[^`"]*)"))?`'
)


def quote_path(path: Path) -> str:
    """Return a path, quoted for the shell."""
    return quote_word(str(path))


def print_output(*lines: str) -> None:
    """Print lines with control characters escaped and unencodable characters substituted."""
    for line in lines:
        _print_encodable(escape_controls(line), sys.stdout)


def print_error(message: str) -> None:
    """Print an error message to standard error like `print_output`, with hanging indentation."""
    indented_message = re.sub(r"\n(?!  )", "\n  ", MultilineText(*message.split("\n")))
    _print_encodable(f"counterspin: {indented_message}", sys.stderr)


def _print_encodable(text: str, stream: TextIO | None) -> None:
    # None: the parent process closed the stream.
    if stream is not None:
        print(substitute_unencodable(text, stream.encoding or "utf-8"), file=stream)


def translate_message(message: str, app: App, arguments: Iterable[str]) -> str:
    """Return a message with Python arguments replaced by options of the command.

    Other modules name arguments in Python notation, in backquotes: ``set `overwrite=True` ``. This
    function replaces them, as in ``set --overwrite``.

    Parameters
    ----------
    message
        Message of an error or warning.
    app
        The command line.
    arguments
        Arguments of the command line, beginning with the command. Unknown names are unchanged.
    """
    command_name = next(
        (candidate for candidate in arguments if candidate[:1] != "-" and candidate in app), None
    )
    options = {}
    if command_name is not None:
        for argument in app[command_name].assemble_argument_collection(parse_docstring=False):
            if argument.name.startswith("-"):
                options[argument.field_info.name] = argument

    def to_option(match: re.Match[str]) -> str:
        name, value = match["name"], match["text"]
        if name in _COMMAND_BY_FUNCTION:
            return f"`{_COMMAND_BY_FUNCTION[name]}`"
        if name not in options:
            return match[0]
        option = options[name]
        option_name = option.negatives[0] if match["truth"] == "False" else option.name
        return option_name if value is None else f"{option_name} {quote_word(value)}"

    return _ARGUMENT.sub(to_option, message)

"""Words that several commands share, and what is said below them in the words of a command line."""

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

Command = TypeVar("Command", bound=Callable[..., None])
Options = TypeVar("Options")

OutputFolder = Annotated[Path, Parameter(name=["--output", "-o"])]
OutputFile = Annotated[Path | None, Parameter(name=["--output", "-o"])]
JsonFile = Annotated[Path | None, Parameter(name="--json")]

#: What is on, or found out, unless ``--no-...`` turns it off; nothing else has such a word.
OnOff = Annotated[bool, Parameter(negative_bool="no-")]


def join_docstring(docstring: str) -> str:
    """Return a docstring with each paragraph, and each parameter's, on one line.

    The help breaks lines itself, and would keep the breaks of the source in addition to its own.
    """
    lines: list[str] = []
    sections = False
    for line in cleandoc(docstring).splitlines():
        sections |= line.startswith("---")
        before = lines[-1] if lines else ""
        of_parameter = line.startswith("    ") and before.startswith("    ")
        of_prose = not sections and line and before
        if (of_prose or of_parameter) and line.strip() and not line.startswith("---"):
            lines[-1] += " " + line.strip()
        else:
            lines.append(line)
    return "\n".join(lines) + "\n"


def command(function: Command) -> Command:
    """Return a function of the command line, with its docstring prepared for the help."""
    function.__doc__ = join_docstring(function.__doc__ or "")
    return function


def option_group(options: type[Options]) -> type[Options]:
    """Make each field of a class an option of the command that has it as a parameter."""
    options.__doc__ = join_docstring(options.__doc__ or "")
    return Parameter(name="*")(options)


@option_group
@frozen
class SaveOptions:
    """Where a command's result is written.

    Parameters
    ----------
    json
        Also write the result to this JSON file.
    overwrite
        Replace files that an earlier run of this command wrote; other files are never replaced.
    """

    json: JsonFile = None
    overwrite: bool = False

    def reserve(self, kind: Callable[[], FileType]) -> None:
        """Refuse a path at which a file would be lost, before there is a result to lose."""
        if self.json is not None:
            check_writable(self.json, kind, overwrite=self.overwrite)

    @contextmanager
    def writing(self, result: ResultFile) -> Iterator[None]:
        """Write a result before anything is printed; where it cannot be, print all the same."""
        failure = None
        if self.json is not None:
            try:
                result.write(self.json, overwrite=self.overwrite)
            except CounterspinError as error:
                failure = error
        try:
            yield
        finally:
            if failure is not None:
                raise failure


#: No result is written.
NOT_SAVED: Final = SaveOptions()

#: Function named in a message -> what the command line has in its place.
_COMMANDS: Final = {
    "certificates.lab.write_example": "counterspin certificate --init LAB.toml",
    "forecast": "counterspin plan --check DIR",
    "planning.plan.write_example": "counterspin plan --init FILE",
    "write_result": "counterspin calibrate DIR --json FILE",
}

#: An argument in a message: `name`, `name=True`, `name="value"`.
_ARGUMENT: Final = re.compile(
    r'`(?P<name>[\w.]+)(?:=(?:(?P<truth>True|False)|"(?P<text>[^`"]*)"))?`'
)


def shell_word(path: Path) -> str:
    """Return a path as a user may type it into a shell, with quotes around blanks."""
    return quote_word(str(path))


def print_output(*lines: str) -> None:
    """Print lines; what would act on the terminal, or what this cannot show, is put otherwise."""
    for line in lines:
        _print(escape_controls(line), sys.stdout)


def print_error(text: str) -> None:
    """Print what went wrong to standard error, as `print_output` does, further lines indented."""
    text_lines = re.sub(r"\n(?!  )", "\n  ", MultilineText(*text.split("\n")))
    _print(f"counterspin: {text_lines}", sys.stderr)


def _print(text: str, stream: TextIO | None) -> None:
    # None: whoever started the program closed it.
    if stream is not None:
        print(substitute_unencodable(text, stream.encoding or "utf-8"), file=stream)


def translate_message(message: str, app: App, words: Iterable[str]) -> str:
    """Return a message with each Python argument that it names as the option of the command.

    Rooms below the command line name an argument as a Python user writes it, in backquotes:
    ``set `overwrite=True` ``. Here that becomes ``set --overwrite``.

    Parameters
    ----------
    message
        What was raised.
    app
        The command line.
    words
        What was typed; the first names the command. Names that it does not have are left alone.
    """
    command = next((word for word in words if word[:1] != "-" and word in app), None)
    options = {}
    if command is not None:
        for argument in app[command].assemble_argument_collection(parse_docstring=False):
            if argument.name.startswith("-"):
                options[argument.field_info.name] = argument

    def to_option(match: re.Match[str]) -> str:
        name, text = match["name"], match["text"]
        if name in _COMMANDS:
            return f"`{_COMMANDS[name]}`"
        if name not in options:
            return match[0]
        option = options[name]
        option_name = option.negatives[0] if match["truth"] == "False" else option.name
        return option_name if text is None else f"{option_name} {quote_word(text)}"

    return _ARGUMENT.sub(to_option, message)

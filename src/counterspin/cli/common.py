"""Options and output shared by commands, and translation of messages for the command line."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from inspect import cleandoc
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, TextIO, TypeVar

from cyclopts import (
    App,
    CoercionError,
    CycloptsError,
    MissingArgumentError,
    Parameter,
    RepeatArgumentError,
    Token,
    UnknownCommandError,
    UnusedCliTokensError,
)
from cyclopts.argument import Argument

from counterspin.characters import MultilineText, escape_controls, substitute_unencodable
from counterspin.errors import CounterspinError, UsageError
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


def parse_whole_number(_: object, tokens: Sequence[Token]) -> int:
    """Parse a whole number; the command-line parser itself would round other numbers."""
    text = tokens[0].value
    with suppress(ValueError):
        return int(text)
    with suppress(ValueError):
        number = float(text)
        if number.is_integer():
            return int(number)
    raise ValueError(f'"{text}" is not a whole number')


WholeNumber = Annotated[int, Parameter(converter=parse_whole_number)]

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


def require_distinct_files(**paths: Path | None) -> None:
    """Raise UsageError if two options, named by their fields, name the same output file."""
    options: dict[Path, str] = {}
    for option, path in paths.items():
        if path is not None and options.setdefault(path.absolute(), option) != option:
            first_option = options[path.absolute()]
            raise UsageError(f"`{option}`", [f"{path} is also the file of `{first_option}`"])


#: Options without a result file.
NO_RESULT_FILE: Final = SaveOptions()

#: Function named in a message -> the equivalent command.
_COMMAND_BY_FUNCTION: Final = {
    "compare": "counterspin compare",
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
    """Return a path, quoted for the shell; it never looks like an option."""
    return quote_word(f"./{path}" if str(path).startswith("-") else str(path))


def make_prompts_interruptible() -> None:
    """Let Ctrl-C end a prompt at once; polars lets the operating system continue to read."""
    import signal

    if hasattr(signal, "siginterrupt"):  # not on Windows
        signal.siginterrupt(signal.SIGINT, True)


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


#: Type of an option -> description of its values.
_TYPE_DESCRIPTIONS: Final = {float: "a number", bool: "true or false"}


def describe_usage_error(error: CycloptsError, arguments: Sequence[str]) -> str:
    """Return the message of an error that the command-line parser found."""
    prefix = f"{' '.join(error.command_chain)}: " if error.command_chain else ""
    message = str(error)
    match error:
        case UnknownCommandError() if arguments and arguments[0].startswith("-"):
            message = f"unknown option: {arguments[0]}"
        case UnusedCliTokensError(unused_tokens=[*tokens]) if tokens:
            noun = "argument" if len(tokens) == 1 else "arguments"
            message = f"{prefix}unexpected {noun}: {' '.join(map(quote_word, tokens))}"
        case RepeatArgumentError():
            message = f"{prefix}{error.token.keyword} may be given only once"
        case MissingArgumentError(argument=Argument() as argument):
            position = next((i for i, a in enumerate(arguments) if a in argument.names), None)
            if position is None:
                message = f"{prefix}{argument.name} is missing"
            else:
                option, *values = arguments[position:]
                advice = f"; write {option}={quote_word(values[0])}" if values else ""
                message = f"{prefix}{option} requires a value{advice}"
        case CoercionError(token=Token(keyword=str() as option) as token, msg=None):
            types = getattr(error.target_type, "__args__", (error.target_type,))
            description = next(filter(None, map(_TYPE_DESCRIPTIONS.get, types)), None)
            if description is not None:
                message = f'Invalid value for {option}: "{token.value}" is not {description}'
    return message


def require_file_names(app: App, arguments: Sequence[str]) -> None:
    """Raise UsageError for empty arguments, as from a shell variable that is not set.

    An empty path would be the current folder. Options with other values may be empty.
    """
    empty_arguments = [a for a in arguments if not a or (a[:2] == "--" and a[-1] == "=")]
    if not empty_arguments:
        return
    path_options = {
        name
        for argument in _find_options(app, arguments).values()
        if "Path" in str(argument.hint)
        for name in argument.names
    }
    for previous, argument in zip(("", *arguments), arguments, strict=False):
        option = argument.removesuffix("=") or previous
        if argument in empty_arguments and (option[:1] != "-" or option in path_options):
            name = option if option[:1] == "-" else "the arguments of the command"
            raise UsageError(name, ["the name of a file or folder is empty"])


def _find_options(app: App, arguments: Iterable[str]) -> dict[str, Argument]:
    """Return the options of the command that is called, by the names of their fields."""
    command_name = next(
        (candidate for candidate in arguments if candidate[:1] != "-" and candidate in app), None
    )
    if command_name is None:
        return {}
    return {
        argument.field_info.name: argument
        for argument in app[command_name].assemble_argument_collection(parse_docstring=False)
        if argument.name.startswith("-")
    }


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
    options = _find_options(app, arguments)

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

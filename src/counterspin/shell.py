"""Commands as the user's shell reads them: the words of a command, and a command from its words."""

from __future__ import annotations

import os
import re
import shlex
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Final

#: Words that PowerShell and cmd read unchanged without quotation marks.
_PLAIN: Final = re.compile(r"[\w.:=/\\+-]+", re.ASCII)
#: What PowerShell expands, or reads as a quotation mark, between double quotation marks.
_EXPANDED: Final = re.compile('[$`"“”„]')
#: What PowerShell reads as the end of a text between single quotation marks.
_SINGLE: Final = re.compile("['‘’‚‛]")
#: Endings of the programs that Windows starts without a shell.
_PROGRAMS: Final = ("", ".exe", ".com")


def quote_word(word: str) -> str:
    """Return a word as a user types it: for a POSIX shell, or for PowerShell and cmd on Windows.

    Both shells of Windows read double quotation marks. PowerShell expands ``$`` and ``"`` between
    them, so that such a word has single ones, which cmd does not know.
    """
    if sys.platform != "win32":
        return shlex.quote(word)
    if _PLAIN.fullmatch(word):
        return word
    if _EXPANDED.search(word):
        return "'" + _SINGLE.sub(lambda mark: 2 * mark[0], word) + "'"
    return f'"{word}"'


def join_command(words: Iterable[str]) -> str:
    """Return a command as a user types it."""
    return " ".join(map(quote_word, words))


def split_command(command: str) -> list[str]:
    """Return the words of a command that a user gives as one text; ValueError if a mark is open.

    On Windows a backslash is a part of a path, and only double quotation marks enclose blanks.
    """
    if sys.platform != "win32":
        return shlex.split(command)
    reader = shlex.shlex(command, posix=True)
    reader.whitespace_split = True
    reader.commenters = reader.escape = ""
    reader.quotes = '"'
    return list(reader)


def find_program(program: str) -> str:
    """Return the path of a program that is named as the first word of a command.

    Windows would start a program of the working folder before one of PATH. FileNotFoundError if no
    folder of PATH has the program. Elsewhere the name itself is returned.
    """
    if sys.platform != "win32" or "\\" in program or "/" in program:
        return program
    folders = [Path(folder) for folder in os.get_exec_path()]
    for folder in folders:
        for ending in _PROGRAMS if folder.is_absolute() else ():
            if (file := folder / f"{program}{ending}").is_file():
                return str(file)
    raise FileNotFoundError(2, "program not found in PATH", program)

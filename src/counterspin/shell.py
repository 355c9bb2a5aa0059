"""Quoting and splitting of commands for the user's shell."""

from __future__ import annotations

import os
import re
import shlex
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Final

#: Word that needs no quotation marks in PowerShell and cmd.
_UNQUOTED_WORD: Final = re.compile(r"[\w.:=/\\+-]+", re.ASCII)
#: Character that PowerShell expands, or reads as a quotation mark, in double quotation marks.
_EXPANDED_CHARACTER: Final = re.compile('[$`"“”„]')
#: Character that PowerShell reads as a single quotation mark.
_SINGLE_QUOTE: Final = re.compile("['‘’‚‛]")
#: Suffixes of programs that Windows starts without a shell.
_PROGRAM_SUFFIXES: Final = ("", ".exe", ".com")


def quote_word(word: str) -> str:
    """Return a word quoted for a POSIX shell, or for PowerShell and cmd on Windows.

    Both Windows shells accept double quotation marks. PowerShell expands ``$`` and ``"`` inside
    them, so such a word gets single quotation marks, which cmd does not support.
    """
    if sys.platform != "win32":
        return shlex.quote(word)
    if _UNQUOTED_WORD.fullmatch(word):
        return word
    if _EXPANDED_CHARACTER.search(word):
        return "'" + _SINGLE_QUOTE.sub(lambda match: 2 * match[0], word) + "'"
    return f'"{word}"'


def join_command(words: Iterable[str]) -> str:
    """Return a command with its words quoted for the shell."""
    return " ".join(map(quote_word, words))


def split_command(command: str) -> list[str]:
    """Return the words of a command; ValueError if a quotation mark is not closed.

    On Windows, a backslash is part of a path, and only double quotation marks enclose spaces.
    """
    if sys.platform != "win32":
        return shlex.split(command)
    lexer = shlex.shlex(command, posix=True)
    lexer.whitespace_split = True
    lexer.commenters = lexer.escape = ""
    lexer.quotes = '"'
    return list(lexer)


def find_program(program: str) -> str:
    """Return the path of a program; FileNotFoundError if it is not in PATH.

    Windows would prefer a program in the working folder. On other systems the name itself is
    returned.
    """
    if sys.platform != "win32" or "\\" in program or "/" in program:
        return program
    folders = [Path(folder) for folder in os.get_exec_path()]
    for folder in folders:
        for suffix in _PROGRAM_SUFFIXES if folder.is_absolute() else ():
            if (file := folder / f"{program}{suffix}").is_file():
                return str(file)
    raise FileNotFoundError(2, "program not found in PATH", program)

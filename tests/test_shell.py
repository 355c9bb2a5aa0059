"""Commands as shells read them, those of Windows too."""

import os
import shlex

import pytest

from counterspin.shell import find_program, join_command, quote_word, split_command


@pytest.fixture
def windows(monkeypatch):
    monkeypatch.setattr("sys.platform", "win32")


def test_posix_command_round_trip():
    words = ["counterspin", "calibrate", "my run's", "a\\b", "$x"]
    assert split_command(join_command(words)) == shlex.split(join_command(words)) == words
    assert find_program("openssl") == "openssl"


@pytest.mark.parametrize(
    ("word", "quoted"),
    [
        (r"C:\runs\a-1.csv", r"C:\runs\a-1.csv"),
        ("--term=K_II", "--term=K_II"),
        (r"C:\my runs\a.csv", r'"C:\my runs\a.csv"'),
        ("two & three", '"two & three"'),
        ("it's", '"it\'s"'),
        ("µ.csv", '"µ.csv"'),
        ("", '""'),
        # PowerShell expands these between double quotation marks.
        ("$env:x", "'$env:x'"),
        ("a`b", "'a`b'"),
        ('said "no", it\'s', "'said \"no\", it''s'"),
    ],
)
def test_word_is_quoted_for_windows_shells(windows, word, quoted):
    assert quote_word(word) == quoted


@pytest.mark.parametrize(
    ("command", "words"),
    [
        (r"C:\keys\sign.exe --slot 1", [r"C:\keys\sign.exe", "--slot", "1"]),
        (r'"C:\my keys\sign.exe" -p "a b"', [r"C:\my keys\sign.exe", "-p", "a b"]),
        ("sign it's #2", ["sign", "it's", "#2"]),
        ("  ", []),
    ],
)
def test_backslashes_are_preserved_on_windows(windows, command, words):
    assert split_command(command) == words


def test_unclosed_quotation_mark_raises(windows):
    with pytest.raises(ValueError, match="quotation"):
        split_command('"C:\\my keys')


def test_program_in_working_folder_is_not_found_on_windows(windows, tmp_path, monkeypatch):
    tools = tmp_path / "tools"
    tools.mkdir()
    (tmp_path / "sign.exe").touch()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", os.pathsep.join([".", str(tools)]))
    with pytest.raises(FileNotFoundError, match="program not found in PATH"):
        find_program("sign")
    (tools / "sign.exe").touch()
    assert find_program("sign") == find_program("sign.exe") == str(tools / "sign.exe")
    assert find_program(r".\sign.exe") == r".\sign.exe"

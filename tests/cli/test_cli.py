"""The command line: words to calls, errors to one paragraph and a status."""

import errno
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from counterspin import cli

#: Where the command is installed: beside the interpreter.
BESIDE = str(Path(sys.executable).parent)
COMMANDS = [name for name in cli.app if not name.startswith("-")]


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_explains_itself(command, capsys):
    assert cli.main([command, "--help"]) == 0
    shown = capsys.readouterr().out
    assert shown.startswith(f"Usage: counterspin {command}")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["calibrat"], 'Unknown command "calibrat". Did you mean "calibrate"?'),
        (["calibrate"], "parameter DIRECTORY requires an argument"),
        (["init"], "parameter DIRECTORY requires an argument"),
        (["simulate"], "parameter CAMPAIGN requires an argument"),
        (["simulate", "x"], "parameter --output requires an argument"),
        (["apply", "r.json"], "parameter FILE requires an argument"),
        (["calibrate", "x", "--method", "magic"], 'Invalid value "magic" for --method'),
        (["demo", "--figure", "gif"], 'Choose from: "svg", "png", "pdf"'),
        (["demo", "here"], "here"),
    ],
)
def test_wrong_usage_is_told_in_two_lines(words, message, capsys):
    assert cli.main(words) == 2
    told = capsys.readouterr()
    assert told.out == ""
    assert message in told.err
    assert told.err.startswith("counterspin: ")
    assert told.err.endswith("\nTry counterspin --help.\n")
    assert told.err.count("\n") == 2


def test_campaign_that_is_not_there(tmp_path, capsys):
    assert cli.main(["calibrate", str(tmp_path / "nowhere")]) == 2
    assert "there is no such file; `counterspin init DIR` makes" in capsys.readouterr().err


def test_work_that_fails(tmp_path, capsys):
    assert cli.main(["init", str(tmp_path)]) == 0
    assert cli.main(["init", str(tmp_path)]) == 1
    assert "exists; edit it, or choose another folder" in capsys.readouterr().err
    assert cli.main(["calibrate", str(tmp_path)]) == 1
    assert "run1.csv: there is no such file" in capsys.readouterr().err


def test_advice_can_be_typed_as_it_stands(tmp_path, capsys):
    folder = tmp_path / "with blanks"
    assert cli.main(["init", str(folder)]) == 0
    advice = capsys.readouterr().out.splitlines()[1:]
    for line in advice:
        assert cli.main([*shlex.split(line)[1:]]) == 0


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (OSError(errno.ENOSPC, "No space left on device"), "there is no space left"),
        (MemoryError(), "there is not enough memory"),
        (OSError(errno.EIO, "worn out"), "internal error (OSError: [Errno 5] worn out)"),
    ],
)
def test_what_is_no_fault_of_the_program(error, words, monkeypatch, capsys):
    def fail():
        raise error

    monkeypatch.setattr("counterspin.reproduction.comparison.reproduce", fail)
    assert cli.main(["reproduce"]) == 1
    assert words in capsys.readouterr().err


def test_ctrl_c_is_acknowledged(monkeypatch, capsys):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("counterspin.campaign.starter.init", interrupted)
    assert cli.main(["init", "x"]) == 130
    assert capsys.readouterr().err == "counterspin: stopped\n"


@pytest.mark.parametrize(
    "command", [[sys.executable, "-m", "counterspin"], [shutil.which("counterspin", path=BESIDE)]]
)
def test_a_process_of_its_own_says_how_it_went(command):
    def status(*words):
        return subprocess.run([*command, *words], capture_output=True, check=False).returncode

    assert status("--version") == 0
    assert status("init") == 2
    assert status("apply", "no-result.json", "x.csv", "--accelerometer", "Qx", "-o", "y.csv") == 1

"""Commands shown on the page are valid on the command line."""

import inspect
import shlex
from pathlib import Path

import pytest

from counterspin import cli
from counterspin.application import commands

PLACE = Path("a folder") / "it's.json"

SHOWN = {
    "calibrate_command": commands.calibrate_command(PLACE, PLACE, "two-stage", "it --is so"),
    "certificate_command": commands.certificate_command(
        PLACE, PLACE, PLACE, True, {"key": "a key.p12", "cert": "c.pem"}
    ),
    "check_command": commands.check_command(PLACE, PLACE, "run 1"),
    "compare_command": commands.compare_command([PLACE, PLACE]),
    "demo_command": commands.demo_command(PLACE),
    "import_command": commands.import_command(PLACE, [PLACE], {"radius": "2.5 ± 1e-5 m"}, "tumble"),
    "forecast_command": commands.forecast_command(PLACE),
    "history_command": commands.history_command(PLACE, "K_I"),
    "init_command": commands.init_command(PLACE, "arm"),
    "plan_command": commands.plan_command(PLACE, PLACE),
    "report_command": commands.report_command(PLACE),
    "simulate_command": commands.simulate_command(PLACE, PLACE),
    "study_command": commands.study_command(PLACE, 100, PLACE),
    "watch_command": commands.watch_command(PLACE, "K_II 1e-8 g/g^2"),
}


def test_each_shown_command_is_tested():
    functions = inspect.getmembers(commands, inspect.isfunction)
    names = {name for name, _ in functions if name.endswith("_command")}
    assert names == set(SHOWN)


def test_commands_are_quoted_for_windows_shells(monkeypatch):
    monkeypatch.setattr("sys.platform", "win32")
    shown = commands.compare_command([Path(r"C:\my runs\a.json"), Path(r"C:\runs\b.json")])
    assert shown == r'counterspin compare "C:\my runs\a.json" C:\runs\b.json'


@pytest.mark.parametrize("shown", SHOWN.values(), ids=SHOWN)
def test_shown_command_is_valid_on_command_line(shown):
    program, *words = shlex.split(shown)
    assert program == "counterspin"
    _, bound, _ = cli.app.parse_args(words, exit_on_error=False, print_error=False)
    values = [*bound.args, *bound.kwargs.values()]
    assert PLACE in [Path(str(value)) for value in values]

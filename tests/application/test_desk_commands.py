"""What the page shows as a command is one that the command line takes."""

import inspect
import shlex
from pathlib import Path

import pytest

from counterspin import cli
from counterspin.application import desk

PLACE = Path("a folder") / "it's.json"

SHOWN = {
    "calibrate_command": desk.calibrate_command(PLACE, PLACE, "two-stage", "it --is so"),
    "certificate_command": desk.certificate_command(
        PLACE, PLACE, PLACE, True, {"key": "a key.p12", "cert": "c.pem"}
    ),
    "check_command": desk.check_command(PLACE, PLACE, "run 1"),
    "compare_command": desk.compare_command([PLACE, PLACE]),
    "demo_command": desk.demo_command(PLACE),
    "export_command": desk.export_command(PLACE, [PLACE], {"radius": "2.5 ± 1e-5 m"}, "tumble"),
    "forecast_command": desk.forecast_command(PLACE),
    "history_command": desk.history_command(PLACE, "K_I"),
    "init_command": desk.init_command(PLACE, "arm"),
    "plan_command": desk.plan_command(PLACE, PLACE),
    "report_command": desk.report_command(PLACE),
    "simulate_command": desk.simulate_command(PLACE, PLACE),
    "study_command": desk.study_command(PLACE, 100, PLACE),
    "watch_command": desk.watch_command(PLACE, "K_II 1e-8 g/g^2"),
}


def test_every_command_is_tried():
    functions = inspect.getmembers(desk, inspect.isfunction)
    made = {name for name, _ in functions if name.endswith("_command")}
    assert made == set(SHOWN)


def test_commands_are_quoted_for_the_shells_of_windows(monkeypatch):
    monkeypatch.setattr("sys.platform", "win32")
    shown = desk.compare_command([Path(r"C:\my runs\a.json"), Path(r"C:\runs\b.json")])
    assert shown == r'counterspin compare "C:\my runs\a.json" C:\runs\b.json'


@pytest.mark.parametrize("shown", SHOWN.values(), ids=SHOWN)
def test_the_command_line_takes_what_is_shown(shown):
    program, *words = shlex.split(shown)
    assert program == "counterspin"
    _, bound, _ = cli.app.parse_args(words, exit_on_error=False, print_error=False)
    values = [*bound.args, *bound.kwargs.values()]
    assert PLACE in [Path(str(value)) for value in values]

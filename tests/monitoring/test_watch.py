"""Watching a growing campaign: states, events and completeness."""

import json
import re
from pathlib import Path

import pytest

import counterspin as cs
from counterspin.cli import main
from counterspin.errors import CampaignError
from counterspin.monitoring.observer import GROWABLE_SUFFIXES

FAST = cs.Pace(interval=1e-3, share=1.0)


def split_last_run(folder, *, parts=4, last="fast"):
    """Remove the last run and return its lines in chunks."""
    content = (folder / f"{last}.csv").read_bytes()
    size = len(content) // parts
    (folder / f"{last}.csv").unlink()
    return [content[k * size : (k + 1) * size if k < parts - 1 else None] for k in range(parts)]


def append(folder, content, name="fast"):
    with (folder / f"{name}.csv").open("ab") as file:
        file.write(content)


def test_states_follow_records_until_calibration(folder):
    parts = split_last_run(folder)
    states = cs.watch(folder, goals=["K_II 1 ug/g^2"], pace=FAST)
    state = next(states)
    assert [run.state for run in state.runs] == ["read", "read", "waiting"]
    assert state.runs[2].why == "no file yet"
    seen = [state]
    for part in parts:
        append(folder, part)
        seen.append(next(states))
    with pytest.raises(StopIteration):
        next(states)
    u = [state.coefficients[0].u for state in seen if state.coefficients[0].u]
    assert u == sorted(u, reverse=True)
    assert [state.complete for state in seen] == [False] * len(parts) + [True]
    result = cs.calibrate(folder)
    coefficient, k_ii = seen[-1].coefficients[0], result.coefficient("Qx.K_II")
    assert abs(coefficient.value - k_ii.value) < 1e-9 * k_ii.u
    assert abs(coefficient.u - k_ii.u) < 1e-9 * k_ii.u
    for run in seen[-1].runs:
        assert run.rate == result.runs[run.run].rate
        assert run.rows == result.runs[run.run].counts["rows"]
    (goal,) = seen[-1].goals
    assert goal.met == (goal.u <= 1e-6)
    assert seen[-1].met


def test_restarted_watch_resumes(folder):
    parts = split_last_run(folder, parts=3)
    append(folder, parts[0])
    first = cs.watch(folder, pace=FAST)
    next(first)
    append(folder, parts[1])
    went_on = next(first)
    first.close()
    assert next(cs.watch(folder, pace=FAST)) == went_on


def test_file_changes_are_reported(folder):
    (folder / "slow.csv").write_bytes((folder / "slow.csv").read_bytes()[:3000])
    states = cs.watch(folder, pace=FAST)
    next(states)
    content = (folder / "middle.csv").read_bytes()
    (folder / "middle.csv").write_bytes(content[: len(content) // 2])
    state = next(states)
    assert state.events == [
        "middle.csv became shorter; counterspin now reads the file again from the start."
    ]
    (folder / "middle.csv").unlink()
    state = next(states)
    assert state.events == ["middle.csv has disappeared."]
    assert state.runs[1].state == "waiting"
    (folder / "middle.csv").write_bytes(content)
    assert next(states).runs[1].state == "read"


def test_record_in_several_files_is_read_completely(folder):
    rows = (folder / "fast.csv").read_bytes().splitlines(keepends=True)
    (folder / "fast.csv").write_bytes(b"".join(rows[:200]))
    (folder / "more.csv").write_bytes(b"".join(rows[:1] + rows[200:300]))
    description = folder / "campaign.toml"
    text = description.read_text(encoding="utf-8")
    described = 'record = "fast.csv"\ncontinued_in = ["more.csv"]'
    description.write_text(text.replace('record = "fast.csv"', described), encoding="utf-8")
    states = cs.watch(folder, pace=FAST)
    assert next(states).runs[2].rows == 299
    append(folder, b"".join(rows[300:]), "more")
    state = next(states)
    assert state.runs[2].rows == len(rows) - 1
    assert state.complete


def test_unusable_record_does_not_stop_other_runs(folder):
    append(folder, b"words,words,words\n", "slow")
    state = next(cs.watch(folder, pace=FAST))
    assert [run.state for run in state.runs] == ["failed", "read", "read"]
    assert "slow.csv" in state.runs[0].why
    assert not state.complete


def test_invalid_interval_is_rejected(folder, capsys):
    for interval in ("0", "-1", "nan", "inf"):
        assert main(["watch", str(folder), "--once", "--interval", interval]) == 2
        message = "counterspin: watch: --interval: must be greater than 0 s and less than 1e6 s\n"
        assert capsys.readouterr().err == message


def test_goals_are_checked(folder):
    for goal, words in (
        ("K_9 1e-8", '"K_9" is not estimated'),
        ("K_II much", "^goal: K_II: 'much' "),
        ("K_II -1", "greater than zero"),
        ("K_II 1 m", "^goal: K_II: "),
    ):
        with pytest.raises(CampaignError, match=words):
            cs.watch(folder, goals=[goal])
    (goal,) = next(cs.watch(folder, goals={"Qx.K_II": 1e-30}, pace=FAST, once=True)).goals
    assert (goal.met, goal.wanted, goal.unit) == (False, 1e-30, "g/g^2")
    plan = folder / "PLAN.toml"
    assert main(["plan", "--init", str(plan)]) == 0
    with pytest.raises(CampaignError, match=r"goal\.target: missing"):
        cs.watch(folder, goals=plan)
    text = plan.read_text(encoding="utf-8").replace('minimise = ["K_II"]', "")
    plan.write_text(text.replace("# target", "target"), encoding="utf-8")
    (goal,) = next(cs.watch(folder, goals=plan, pace=FAST, once=True)).goals
    assert (goal.name, goal.wanted) == ("Qx.K_II", 3e-8)
    with pytest.raises(CampaignError, match="interval"):
        cs.Pace(0.0)


def test_command_prints_lines_without_terminal(folder, capsys):
    words = ["watch", str(folder), "--interval", "0.01", "--goal", "K_II 1 ug/g^2"]
    assert main(words) == 0  # all runs are complete
    (line,) = capsys.readouterr().out.splitlines()
    assert "slow 60 of 60 s" in line
    assert "u(Qx.K_II)" in line
    assert line.endswith("goal met")
    assert main([*words, "--json-lines"]) == 0
    state = json.loads(capsys.readouterr().out)
    assert state["complete"]
    assert main([*words, "--once"]) == 0
    assert "The goal is met." in capsys.readouterr().out


def test_command_shows_live_table_on_terminal(folder, capsys, monkeypatch):
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    assert main(["watch", str(folder), "--interval", "0.01"]) == 0
    assert "Residuals / noise" in capsys.readouterr().out


def test_interrupt_exits_with_130(folder, capsys, monkeypatch):
    split_last_run(folder)

    def raise_interrupt(seconds):
        raise KeyboardInterrupt

    monkeypatch.setattr("time.sleep", raise_interrupt)
    assert main(["watch", str(folder)]) == 130
    captured = capsys.readouterr()
    assert "fast waits: no file yet" in captured.out
    assert captured.err == "counterspin: stopped\n"


def test_documentation_lists_growing_formats():
    page = (Path(__file__).parents[2] / "docs" / "monitoring.md").read_text(encoding="utf-8")
    appended = page.partition("**Text files** (")[2].partition(")")[0]
    assert tuple(re.findall(r"`(\.\w+)`", appended)) == GROWABLE_SUFFIXES

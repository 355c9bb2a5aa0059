"""The check of a record: its faults, its remarks and the uncertainty that it gives."""

import re
from pathlib import Path

import polars as pl
import pytest
from raising import raises

import counterspin as cs
from counterspin.cli import main
from counterspin.errors import CampaignError, RecordError

PAGE = Path(__file__).parents[2] / "docs" / "monitoring.md"


def change_record(file, **columns):
    frame = pl.read_csv(file)
    frame.with_columns(**{name: make(frame[name]) for name, make in columns.items()}).write_csv(
        file
    )


def test_good_run_has_no_remark(folder):
    checked = cs.check(folder / "slow.csv", folder)
    run = checked.run
    assert (checked.good, checked.remarks, checked.why_not) == (True, [], None)
    assert (run.run, run.state, run.gaps, run.outliers) == ("slow", "read", 0, 0)
    assert run.sampling_rate == pytest.approx(20.0)
    assert abs(run.rate - run.nominal_rate) < 1e-3 * run.nominal_rate
    assert 0.8 < run.residuals["Qx"].ratio < 1.2
    assert run.residuals["Qx"].stated == 0.01
    assert checked.others == ["middle", "fast"]
    result = cs.calibrate(folder).coefficient("Qx.K_II")
    (now,), (expected,) = checked.reached, checked.expected
    assert (now.value, now.u) == (result.value, result.u)
    assert expected.u == pytest.approx(result.u, rel=1e-3)


def test_page_explains_every_line_of_report(folder, capsys):
    assert main(["check", str(folder / "slow.csv"), "--campaign", str(folder)]) == 0
    printed = [line.split("  ")[0].strip() for line in capsys.readouterr().out.splitlines()]
    table = re.search(r"(?ms)^\| line \| content \|\n.*?\n\n", PAGE.read_text(encoding="utf-8"))[0]
    explained = [row.split(" | ")[0][2:] for row in table.splitlines()[2:] if row]
    shown = printed[printed.index("Clock") :]
    shown = [*shown[: shown.index("")], "Expected uncertainty"]
    assert [line.replace("of Qx", "of NAME") for line in shown] == explained


def test_first_run_predicts_uncertainty_of_whole_campaign(folder):
    result = cs.calibrate(folder).coefficient("Qx.K_II")
    for name in ("middle", "fast"):
        (folder / f"{name}.csv").unlink()
    checked = cs.check(folder / "slow.csv", folder)
    assert checked.others == []
    assert checked.reached[0].u is None or checked.reached[0].u > 3.0 * result.u
    assert checked.expected[0].u == pytest.approx(result.u, rel=1e-3)


def test_excess_noise_is_reported(folder):
    change_record(
        folder / "fast.csv", east_m=lambda x: x + 0.03 * (-1.0) ** pl.arange(len(x), eager=True)
    )
    checked = cs.check(folder / "fast.csv", folder)
    assert not checked.good
    assert checked.run.residuals["Qx"].ratio > 2.0
    assert any("as large as expected from the stated noise" in text for text in checked.remarks)


def scale_time(factor):
    return lambda frame: frame.with_columns(pl.col("time_s") * factor)


def keep_first(part):
    return lambda frame: frame.head(int(part * len(frame)))


def add_spikes(part):
    row = pl.int_range(pl.len())
    spike = pl.when(row % int(1.0 / part) == 1).then(2.0 - 4.0 * (row % 2)).otherwise(0.0)
    return lambda frame: frame.with_columns(east_m=pl.col("east_m") + spike)


@pytest.mark.parametrize(
    ("change", "wrong"),
    [
        (scale_time(1.0008), None),
        (scale_time(1.0012), "instead of the nominal"),
        (keep_first(0.91), None),
        (keep_first(0.89), "instead of the stated"),
        (add_spikes(0.04), None),
        (add_spikes(0.0625), "samples are outliers"),
    ],
)
def test_documented_faults_make_run_unfit(folder, change, wrong):
    change(pl.read_csv(folder / "slow.csv")).write_csv(folder / "slow.csv")
    text = " ".join(cs.check(folder / "slow.csv", folder).remarks)
    for words in ("instead of the nominal", "instead of the stated", "samples are outliers"):
        assert (words in text) == (words == wrong), text


def test_unreadable_record_fails_run(folder):
    (folder / "slow.csv").write_text("time_s,angle_rad,east_m\n0,0,0\n1,x,0\n")
    checked = cs.check(folder / "slow.csv", folder)
    assert (checked.good, checked.run.state) == (False, "failed")
    assert "line 3" in checked.run.why
    assert checked.reached == []


def test_frame_and_other_file_can_be_checked(folder, tmp_path):
    frame = pl.read_csv(folder / "slow.csv")
    by_file = cs.check(folder / "slow.csv", folder)
    in_memory = cs.check(frame, folder, run="slow")
    assert in_memory.run.residuals == by_file.run.residuals
    frame.write_csv(tmp_path / "slow.csv")
    assert cs.check(tmp_path / "slow.csv", folder).run.rate == by_file.run.rate
    frame.write_csv(tmp_path / "other.csv")
    with raises("wrong-usage", "slow, middle, fast"):
        cs.check(tmp_path / "other.csv", folder)
    with pytest.raises(CampaignError, match='no run is named "sloww"'):
        cs.check(tmp_path / "other.csv", folder, run="sloww")
    with pytest.raises(RecordError, match="file not found"):
        cs.check(tmp_path / "nowhere.csv", folder)


def test_given_file_replaces_record_of_run(folder, tmp_path):
    """In a campaign without records, and in one with another file for the run."""
    bare = tmp_path / "bare"
    bare.mkdir()
    (bare / "campaign.toml").write_text((folder / "campaign.toml").read_text("utf-8"), "utf-8")
    whole = cs.check(folder / "slow.csv", folder)
    assert cs.check(folder / "slow.csv", bare, run="slow").run.rate == whole.run.rate
    lines = (folder / "slow.csv").read_text("utf-8").splitlines(keepends=True)
    (tmp_path / "half.csv").write_text("".join(lines[: len(lines) // 2]), "utf-8")
    half = cs.check(tmp_path / "half.csv", folder, run="slow")
    assert half.run.rows == len(lines) // 2 - 1 < whole.run.rows


def test_command_prints_and_writes_check(folder, tmp_path, capsys):
    words = ["check", str(folder / "slow.csv"), "--campaign", str(folder)]
    assert main([*words, "--json", str(tmp_path / "c.json")]) == 0
    output = capsys.readouterr().out
    for word in ("The run is usable", "Clock", "Ripple", "Residuals of Qx", "Qx.K_II"):
        assert word in output
    checked = cs.CheckedRun.read(tmp_path / "c.json")
    assert checked == cs.check(folder / "slow.csv", folder)
    stated = checked.run.residuals["Qx"].stated
    assert f"m, stated {stated:g} m; " in output
    (folder / "slow.csv").write_text("")
    assert main(words) == 1
    assert "failed its checks" in capsys.readouterr().err

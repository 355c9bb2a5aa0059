"""The check of a record on an arm or at rest: its rate, mean and effect on u."""

import math
import tomllib

import numpy as np
import polars as pl
import pytest
from arm_records import DESCRIPTION_HEAD, GRAVITY, RADIUS, format_arm_run, simulate_arm_record

import counterspin as cs
from counterspin.cli import main

LEVELS = (1.0, 4.0, 9.0)
AT_REST = """[[runs]]
name = "up"
motion = "static"
axes = { input = "up", pendulous = "outward" }
record = "up.csv"
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a campaign on an arm whose run "in 4" has a rate 1 % above the stated rate."""
    rng = np.random.default_rng(1)
    text, records = DESCRIPTION_HEAD, {}
    for side in (1, -1):
        for level in LEVELS:
            rate = math.sqrt(level * GRAVITY / RADIUS)
            name = f"{'in' if side > 0 else 'out'} {level:.0f}"
            text += format_arm_run(name, side, rate)
            off = 1e-2 if name == "in 4" else 0.0
            records[name] = simulate_arm_record(
                rng, side, rate * (1.0 + off), ripple=1e-4, drift=1e-5, noise=1e-5, encoder=1e-5
            )
    t = np.arange(0.0, 20.0, 0.02)
    records["up"] = {"t": t, "f": 1.0026 + rng.normal(0.0, 1e-5, t.size)}
    campaign = cs.make_campaign(tomllib.loads(text + AT_REST), records)
    where = tmp_path_factory.mktemp("arm") / "campaign"
    campaign.write(where)
    return where


def test_arm_record_has_rate_and_mean(folder):
    checked = cs.check(folder / "in 9.csv", folder)
    run, rate = checked.run, math.sqrt(9.0 * GRAVITY / RADIUS)
    assert (checked.good, checked.remarks, run.state) == (True, [], "read")
    assert run.nominal_rate == rate
    # The drift acts at the middle of the revolutions; the last revolution ends within a row,
    # 0.2 rad, which has 2e-7 of the ripple.
    middle = run.means["A"].revolutions * math.pi / rate
    assert run.rate == pytest.approx(rate * (1.0 + 1e-5 * middle), rel=2e-7)
    assert 0.0 < run.u_rate < 1e-6 * rate
    assert run.drift == pytest.approx(1e-5, rel=0.05)
    assert (run.ripple, run.harmonic) == (pytest.approx(1e-4 * rate, rel=0.05), 1)
    assert run.means["A"].value == pytest.approx(9.0 * 1.0006 + 2e-3 + 15e-6 * 81, abs=5e-3)
    assert run.means["A"].revolutions == math.floor(20.0 * rate * 1.0001 / (2.0 * math.pi))
    result = cs.calibrate(folder)
    (reading,) = [
        reading for reading in result.accelerometers["A"].readings if reading.name == "in 9"
    ]
    assert (run.means["A"].value, run.rate) == (reading.value, reading.rate)
    assert checked.others == ["in 1", "in 4", "out 1", "out 4", "out 9", "up"]
    (reached,) = checked.reached
    coefficient = result.coefficient("A.K_II")
    assert (reached.name, reached.value, reached.u) == ("A.K_II", coefficient.value, coefficient.u)


def test_wrong_rate_has_same_remark_as_double_turntable(folder):
    checked = cs.check(folder / "in 4.csv", folder)
    assert not checked.good
    rate = math.sqrt(4.0 * GRAVITY / RADIUS)
    text = (
        f"The spindle turned at {checked.run.rate:.6f} rad/s instead of the nominal "
        f"{rate:.6f} rad/s"
    )
    assert any(remark.startswith(text) for remark in checked.remarks)


def test_record_at_rest_has_mean_and_no_rate(folder):
    checked = cs.check(folder / "up.csv", folder)
    assert (checked.good, checked.run.rate, checked.run.nominal_rate) == (True, None, 0.0)
    assert checked.run.means["A"].value == pytest.approx(1.0026, abs=2e-6)
    assert checked.run.means["A"].revolutions == 0


def test_other_file_and_frame_match_and_fault_fails_check(folder, tmp_path, capsys):
    frame = pl.read_csv(folder / "in 9.csv")
    whole = cs.check(folder / "in 9.csv", folder)
    assert cs.check(frame, folder, run="in 9").run.means == whole.run.means
    frame.write_csv(tmp_path / "in 9.csv")
    assert cs.check(tmp_path / "in 9.csv", folder).run.means == whole.run.means
    frame.with_columns(angle=-pl.col("angle")).write_csv(tmp_path / "in 9.csv")
    words = ["check", str(tmp_path / "in 9.csv"), "--campaign", str(folder)]
    assert main(words) == 1
    assert "The angle changes in the opposite sense" in capsys.readouterr().out
    assert main(["check", str(folder / "in 9.csv"), "--campaign", str(folder)]) == 0
    output = capsys.readouterr().out
    for text in ("The run is usable", "Rate", "Ripple", "Mean of A", "over 29 revolutions"):
        assert text in output

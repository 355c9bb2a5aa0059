"""Simulated records: what is in them, that they can be had again, and what stands in their way."""

import math
from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from campaigns import SMALL, remove_table, replace_parts, write_and_read_campaign, write_description
from raising import raises

from counterspin.calibration.calibrate import calibrate
from counterspin.campaign.description import read_campaign
from counterspin.cli import main
from counterspin.errors import CampaignError, CounterspinError
from counterspin.physics import simulation
from counterspin.physics.motion import Trajectory
from counterspin.simulation import simulate as module
from counterspin.simulation.simulate import simulate, simulate_run

SILENT = replace_parts(
    remove_table(SMALL, "truth.noise"), ('[noise]\ndisplacement = "0.01 m"', "[noise]")
)
RECORDS = ("slow.csv", "middle.csv", "fast.csv")


def simulate_columns(folder, text, run=0, seed=0):
    campaign = write_and_read_campaign(folder, text)
    return campaign, simulate_run(campaign, campaign.runs[run], np.random.default_rng(seed))


def file_contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


# --- what is recorded -----------------------------------------------------------------------------


def test_noise_free_record_matches_error_model(tmp_path):
    campaign, columns = simulate_columns(tmp_path, SILENT, run=1)
    run = campaign.runs[1]
    time = columns["time_s"]
    assert time.size == 20 * 2 * 20 + 1  # 40 s at 20 Hz, both ends included
    np.testing.assert_array_equal(time, np.arange(801) / 20.0)
    spindle = campaign.simulation.truth.runs[run.name].spindle
    assert spindle.drift == 1e-6
    assert spindle.ripples[0].amplitude == pytest.approx(1e-5 * math.pi, rel=1e-12)
    np.testing.assert_array_equal(columns["angle_rad"], spindle.angle(time))
    motion = Trajectory(spindle, 2.5, campaign.site)
    for name, column, start in (("Qx", "east_m", (0.02, -1e-3)), ("Qy", "north_m", (0.0, 0.0))):
        expected = simulation.simulate_record(
            motion,
            campaign.accelerometers[name].mounting,
            campaign.simulation.truth.coefficients[name],
            {},
            time,
        )
        expected = expected + start[0] + start[1] * time
        np.testing.assert_allclose(columns[column], expected, rtol=0.0, atol=1e-14)


def test_columns_have_units_of_campaign(tmp_path):
    _, si = simulate_columns(tmp_path, SILENT)
    text = replace_parts(
        SILENT,
        ('"time_s", unit = "s"', '"time", unit = "ms"'),
        ('"angle_rad", unit = "rad"', '"angle", unit = "deg"'),
        ('"east_m", unit = "m"', '"east", unit = "mm"'),
    )
    _, scaled = simulate_columns(tmp_path, text)
    assert list(scaled) == ["time", "angle", "east", "north_m"]
    np.testing.assert_allclose(scaled["time"], 1e3 * si["time_s"], rtol=1e-14)
    np.testing.assert_allclose(scaled["angle"], np.degrees(si["angle_rad"]), rtol=1e-14)
    np.testing.assert_allclose(scaled["east"], 1e3 * si["east_m"], rtol=1e-14)


def test_timing_offset_delays_angle_samples(tmp_path):
    text = replace_parts(
        SILENT, ("[accelerometers.Qx]", 'timing_offset = "2 ms"\n[accelerometers.Qx]')
    )
    campaign, columns = simulate_columns(tmp_path, text)
    expected = campaign.simulation.truth.runs["slow"].spindle.angle(columns["time_s"] + 2e-3)
    np.testing.assert_array_equal(columns["angle_rad"], expected)


def test_noise_has_stated_sizes(tmp_path):
    noise = 'displacement = "0.02 m"\nangle = "3e-6 rad"\ntiming = "1e-4 s"'
    text = replace_parts(SILENT, ("[noise]", f"[noise]\n{noise}"), ("= 20\n", "= 200\n"))
    _, clean = simulate_columns(tmp_path, replace_parts(SILENT, ("= 20\n", "= 200\n")))
    _, noisy = simulate_columns(tmp_path, text)
    n = clean["time_s"].size
    sizes = {"time_s": 1e-4, "angle_rad": 3e-6, "east_m": 0.02, "north_m": 0.02}
    drawn = np.array([(noisy[c] - clean[c]) / size for c, size in sizes.items()])
    np.testing.assert_allclose(drawn.std(axis=1), 1.0, atol=4.0 / math.sqrt(2 * n))
    assert np.abs(drawn.mean(axis=1)).max() < 4.0 / math.sqrt(n)
    assert np.abs(np.corrcoef(drawn) - np.eye(4)).max() < 4.5 / math.sqrt(n)


def test_accelerometer_noise_is_integrated_to_random_walk(tmp_path):
    text = replace_parts(SILENT, ("[noise]", '[noise]\nacceleration = "1e-5 g/Hz^0.5"'))
    _, clean = simulate_columns(tmp_path, SILENT)
    walk, step = 1e-5 * 9.8066, 0.05
    ends = []
    for seed in range(150):
        _, noisy = simulate_columns(tmp_path, text, seed=seed)
        drawn = noisy["east_m"] - clean["east_m"]
        ends.append(drawn[-1])
    assert abs(drawn[0]) < 1e-15
    # Second differences of the twice integrated noise have the variance 2/3 N^2 h^3.
    assert np.std(np.diff(drawn, 2)) == pytest.approx(walk * math.sqrt(2 / 3 * step**3), rel=0.1)
    duration = clean["time_s"][-1]
    expected = walk * math.sqrt(duration**3 / 3)
    assert np.std(ends) == pytest.approx(expected, rel=4.0 / math.sqrt(2 * 150))


def test_displacement_is_quantised_after_noise(tmp_path):
    text = replace_parts(
        SILENT, ("[noise]", '[noise]\nquantisation = "1 mm"\ndisplacement = "0.01 m"')
    )
    _, clean = simulate_columns(tmp_path, replace_parts(text, ('quantisation = "1 mm"\n', "")))
    _, rounded = simulate_columns(tmp_path, text)
    steps = rounded["east_m"] / 1e-3
    np.testing.assert_allclose(steps, np.round(steps), rtol=0.0, atol=1e-9)
    error = rounded["east_m"] - clean["east_m"]
    assert np.abs(error).max() <= 0.5e-3 * (1 + 1e-9)
    assert error.std() == pytest.approx(1e-3 / math.sqrt(12), rel=0.05)


def test_truth_and_length_of_run_take_precedence(tmp_path):
    text = replace_parts(
        SILENT,
        (
            'record = "slow.csv"',
            'record = "slow.csv"\nduration = "10 s"\n'
            'truth = { drift = "5e-6 1/s", tilt = { north = "10 arcsec" } }',
        ),
    )
    campaign, columns = simulate_columns(tmp_path, text)
    assert columns["time_s"][-1] == 10.0
    spindle, other = (campaign.simulation.truth.runs[run.name].spindle for run in campaign.runs[:2])
    assert (spindle.drift, other.drift) == (5e-6, 1e-6)
    _, level = simulate_columns(tmp_path, SILENT)
    tilt = math.radians(10 / 3600)
    change = columns["east_m"][-1] - level["east_m"][200]
    # -K_I g t^2/2 per radian, beside 5e-6 of drift in R cos(theta).
    assert change == pytest.approx(-1.002 * 9.8066 * 50.0 * tilt, rel=0.03)


# --- files ----------------------------------------------------------------------------------------


def test_files_are_determined_by_seed(tmp_path):
    path = write_description(tmp_path, SMALL)
    written = simulate(path, tmp_path / "a")
    assert [file.name for file in written] == list(RECORDS)
    simulate(path, tmp_path / "b")
    assert file_contents(tmp_path / "a") == file_contents(tmp_path / "b")
    assert (tmp_path / "a" / "campaign.toml").read_text(encoding="utf-8") == SMALL
    simulate(
        write_description(tmp_path, replace_parts(SMALL, ("seed = 1", "seed = 2"))), tmp_path / "c"
    )
    for name in RECORDS:
        assert (tmp_path / "a" / name).read_bytes() != (tmp_path / "c" / name).read_bytes()


def test_changing_run_changes_no_other_run(tmp_path):
    more = '[[runs]]\nname = "more"\nrate = "-1 rev/s"\nrecord = "more.csv"\n\n'
    text = replace_parts(
        SMALL,
        ("[simulation]", more + "[simulation]"),
        ('record = "slow.csv"', 'record = "slow.csv"\nrevolutions = 7'),
    )
    simulate(write_description(tmp_path, SMALL), tmp_path / "a")
    simulate(write_description(tmp_path, text), tmp_path / "b")
    before, after = file_contents(tmp_path / "a"), file_contents(tmp_path / "b")
    assert after["middle.csv"] == before["middle.csv"]
    assert after["fast.csv"] == before["fast.csv"]
    assert len(after["slow.csv"]) < 0.5 * len(before["slow.csv"])
    assert after["more.csv"] != before["fast.csv"]


def test_runs_of_same_rate_have_independent_noise(tmp_path):
    text = replace_parts(SMALL, ("1 rev/s", "0.5 rev/s"))
    simulate(write_description(tmp_path, text), tmp_path / "a")
    middle, fast = (pl.read_csv(tmp_path / "a" / name)["east_m"].to_numpy() for name in RECORDS[1:])
    apart = middle - fast
    assert apart.std() == pytest.approx(0.01 * math.sqrt(2), rel=0.1)


def test_parquet_equals_csv_exactly(tmp_path):
    simulate(write_description(tmp_path, SMALL), tmp_path / "a")
    simulate(write_description(tmp_path, SMALL.replace(".csv", ".parquet")), tmp_path / "b")
    for name in ("slow", "fast"):
        csv = pl.read_csv(tmp_path / "a" / f"{name}.csv")
        assert csv.columns == ["time_s", "angle_rad", "east_m", "north_m"]
        assert csv.equals(pl.read_parquet(tmp_path / "b" / f"{name}.parquet"))


def test_records_in_subfolders_are_simulated_and_calibrated(tmp_path):
    text = replace_parts(
        SMALL, ('"slow.csv"', '"data/slow/run.csv"'), ('"fast.csv"', '"data/fast.csv"')
    )
    written = simulate(write_description(tmp_path, text), tmp_path / "made")
    assert written[0] == tmp_path / "made" / "data" / "slow" / "run.csv"
    assert set(calibrate(tmp_path / "made", method="two-stage").runs) == {"slow", "middle", "fast"}


def test_path_of_campaign_may_contain_parent_folders(tmp_path, monkeypatch):
    write_description(tmp_path / "campaign", SMALL)
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    assert main(["simulate", "../campaign", "-o", "../made"]) == 0
    assert (tmp_path / "made" / "slow.csv").exists()
    assert main(["simulate", "../campaign/../made", "-o", "copy"]) == 0


def test_record_outside_campaign_folder_raises(tmp_path):
    outside = tmp_path / "elsewhere" / "run.csv"
    for record in (outside.as_posix(), "../elsewhere/run.csv"):
        path = write_description(
            tmp_path / "c", replace_parts(SMALL, ('"slow.csv"', f'"{record}"'))
        )
        with pytest.raises(CampaignError, match=r"runs\[0\]\.record: .*run\.csv.* outside") as info:
            simulate(path, tmp_path / "made")
        assert info.value.exit_status == 2
    assert not outside.exists()
    assert not (tmp_path / "made").exists()


def test_simulation_into_campaign_folder_preserves_description(tmp_path):
    path = write_description(tmp_path, SMALL)
    simulate(path, tmp_path)
    assert path.read_text(encoding="utf-8") == SMALL
    assert sorted(file_contents(tmp_path)) == sorted(["campaign.toml", *RECORDS])


# --- what stands in the way -----------------------------------------------------------------------


def test_existing_record_requires_overwrite(tmp_path):
    path = write_description(tmp_path, SMALL)
    there = {"middle.csv": b"an earlier one", "campaign.toml": b"[truth.Qx]"}
    for name, content in there.items():
        write_description(tmp_path / "made", content.decode(), name)
    with pytest.raises(CounterspinError, match=r"middle\.csv already exists; .*`overwrite=True`"):
        simulate(path, tmp_path / "made")
    assert file_contents(tmp_path / "made") == there
    simulate(path, tmp_path / "made", overwrite=True)
    assert not set(there.values()) & set(file_contents(tmp_path / "made").values())


def test_record_of_unknown_origin_is_never_overwritten(tmp_path):
    path = write_description(tmp_path, SMALL)
    write_description(tmp_path / "made", "measured", "middle.csv")
    with raises("file-exists", "middle.csv"):
        simulate(path, tmp_path / "made", overwrite=True)
    assert file_contents(tmp_path / "made") == {"middle.csv": b"measured"}


@pytest.mark.parametrize("text", ['schema = 1\n[site]\ngravity = "9.8 m/s^2"\n', "no TOML"])
def test_measured_campaign_is_never_overwritten(tmp_path, text):
    path = write_description(tmp_path, SMALL)
    write_description(tmp_path / "made", text)
    write_description(tmp_path / "made", "measured", "middle.csv")
    with raises("file-exists", "campaign.toml"):
        simulate(path, tmp_path / "made", overwrite=True)
    assert file_contents(tmp_path / "made") == {
        "campaign.toml": text.encode(),
        "middle.csv": b"measured",
    }


def test_campaign_without_truth_raises(tmp_path):
    text = SMALL
    for table in ("simulation", "truth.Qx", "truth.Qy", "truth.spindle", "truth.noise"):
        text = remove_table(text, table)
    with pytest.raises(CampaignError, match=r"truth: missing; .*\[truth.NAME\]"):
        simulate(write_description(tmp_path, text), tmp_path / "made")
    campaign = write_and_read_campaign(tmp_path, text)
    with pytest.raises(ValueError, match="has no data for a simulation"):
        simulate_run(campaign, campaign.runs[0], np.random.default_rng(0))


def test_unsupported_formats_raise_together(tmp_path):
    text = replace_parts(SMALL, ("slow.csv", "slow.mat"), ("fast.csv", "fast.h5"))
    with pytest.raises(CampaignError) as info:
        simulate(write_description(tmp_path, text), tmp_path / "made")
    assert "slow.mat cannot be simulated; " in str(info.value)
    assert "fast.h5" in str(info.value)
    assert not (tmp_path / "made").exists()


def test_folder_that_cannot_be_created_raises(tmp_path):
    path = write_description(tmp_path, SMALL)
    (tmp_path / "file").write_text("x", encoding="utf-8")
    with raises("file-not-writable", "made", "(Not a directory)"):
        simulate(path, tmp_path / "file" / "made")


def test_failed_write_leaves_no_partial_file(tmp_path, monkeypatch):
    def full(frame, path):
        path.write_text("time_s,ang", encoding="utf-8")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(module, "WRITERS", {".csv": full})
    with raises("file-not-writable", "slow.csv", "(No space left"):
        simulate(write_description(tmp_path, SMALL), tmp_path / "made")
    assert file_contents(tmp_path / "made") == {"campaign.toml": SMALL.encode()}
    monkeypatch.undo()
    assert len(simulate(tmp_path, tmp_path / "made", overwrite=True)) == 3


def test_command_line(tmp_path, capsys):
    path = write_description(tmp_path, SMALL)
    assert main(["simulate", str(path), "-o", str(tmp_path / "made")]) == 0
    assert "Wrote 3 files and campaign.toml" in capsys.readouterr().out
    assert sorted(file_contents(tmp_path / "made")) == sorted(["campaign.toml", *RECORDS])
    assert main(["simulate", str(path), "-o", str(tmp_path / "made")]) == 1
    error = capsys.readouterr().err
    assert error.startswith("counterspin: ")
    assert error.count("\n") == 1
    assert "Traceback" not in error
    bad = write_description(
        tmp_path / "bad", remove_table(SMALL, "truth.Qx").replace("20 Hz", "20 m")
    )
    assert main(["simulate", str(bad), "-o", str(tmp_path / "other")]) == 2
    assert "simulation.sampling_rate" in capsys.readouterr().err


def test_implausible_truth_raises(tmp_path):
    text = replace_parts(SMALL, ('K_II = "2.7e-5 g/g^2"', 'K_II = "27 g/g^2"'))
    text = replace_parts(
        text, ('[noise]\ndisplacement = "0.01 m"', '[noise]\nquantisation = "estimate"')
    )
    campaign = write_description(tmp_path, remove_table(text, "truth.noise"))
    with pytest.raises(CampaignError) as caught:
        simulate(campaign, tmp_path / "records")
    noise, coefficient = caught.value.problems
    assert noise.startswith("noise.quantisation: a simulation requires the true value; write it in")
    assert coefficient.startswith("truth.Qx.K_II: 27 g/g^2 is more than 5 times")
    assert not (tmp_path / "records").exists()


def test_excessive_row_count_raises(tmp_path):
    text = replace_parts(SMALL, ('rate = "0.5 rev/s"', 'rate = "1e-6 rad/s"'))
    campaign = write_description(tmp_path, text)
    with pytest.raises(CampaignError) as caught:
        simulate(campaign, tmp_path / "records")
    (problem,) = caught.value.problems
    assert problem.startswith("runs[1]: 1.257e+08 s at 1.59e-07 rev/s, sampled at 20 Hz,")
    assert "makes 2.51e+09 rows" in problem
    assert not (tmp_path / "records").exists()


# --- in memory ------------------------------------------------------------------------------------


def test_simulation_in_memory_equals_simulation_in_folder(tmp_path):
    campaign = write_and_read_campaign(tmp_path, SMALL)
    simulate(campaign, tmp_path / "made")
    in_memory = simulate(campaign)
    assert not (tmp_path / "slow.csv").exists()
    for run in in_memory.runs:
        written = pl.read_csv(tmp_path / "made" / run.record.name)
        for name, values in in_memory.record_at(run.record).columns.items():
            np.testing.assert_array_equal(written[name].to_numpy(), values)
    assert in_memory.simulation == campaign.simulation
    result = calibrate(in_memory)
    assert result.accelerometers == calibrate(tmp_path / "made").accelerometers
    assert set(result.provenance.in_memory) == set(RECORDS)


def test_changed_campaign_is_simulated_with_changes(tmp_path):
    changes = {"truth": {"Qx": {"K_II": "5e-5 g/g^2"}}, "noise": {"displacement": "0.02 m"}}
    campaign = write_and_read_campaign(tmp_path, SMALL).change(changes)
    simulate(campaign, tmp_path / "made")
    again = read_campaign(tmp_path / "made")
    assert again.simulation == campaign.simulation
    assert again.noise == campaign.noise
    in_memory = simulate(campaign)
    record = in_memory.runs[0].record
    written = pl.read_csv(tmp_path / "made" / record.name)
    np.testing.assert_array_equal(
        written["east_m"].to_numpy(), in_memory.record_at(record).columns["east_m"]
    )


def test_different_seeds_have_independent_noise(tmp_path):
    campaign = write_and_read_campaign(tmp_path, SMALL)
    first, second = (simulate(campaign.change({"simulation": {"seed": seed}})) for seed in (1, 2))
    record = first.runs[0].record
    errors = [c.record_at(record).columns["east_m"] for c in (first, second)]
    assert np.std(errors[0] - errors[1]) == pytest.approx(0.01 * math.sqrt(2.0), rel=0.1)


def test_campaign_without_description_raises_in_memory(tmp_path):
    campaign = replace(write_and_read_campaign(tmp_path, SMALL), title="other")
    with pytest.raises(CounterspinError, match="its description is unknown"):
        simulate(campaign)

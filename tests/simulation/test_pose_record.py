"""A simulated record of poses: its truth, and what a calibration makes of it."""

import numpy as np
import pytest

import counterspin as cs
import triads
from counterspin.campaign.reading import PoseRecord
from counterspin.cli import main
from counterspin.errors import CampaignError
from counterspin.physics.conditions import STATED_CONDITIONS
from counterspin.simulation.pose_record import record_duration, simulate_forces
from counterspin.simulation.readings import true_directions
from counterspin.studies.description import read_study
from counterspin.studies.study import study

NOISE = 5e-4  # g, of each row


def describe_pose_record(more="", clock='{ sampling_rate = "100 Hz" }', noise="[truth.noise]"):
    """Return a description with the truth of `triads`, and a record of poses."""
    text = triads.format_description(f"records = {{ time = {clock} }}\n")
    for name in triads.NAMES:
        column = f'specific_force = {{ column = "{name}", unit = "m/s^2" }}\n'
        text = text.replace(
            triads.format_accelerometer(name), triads.format_accelerometer(name, column)
        )
    text += '[[runs]]\nname = "all"\nmotion = "static"\nattitude = "unknown"\nrecord = "all.csv"\n'
    truth = dict(zip(triads.PARAMETERS, triads.true_parameters(), strict=True))
    text += '[simulation]\nsampling_rate = "100 Hz"\nseed = 5\n' + more
    for name in triads.NAMES:
        own = {symbol: value for (owner, symbol), value in truth.items() if owner == name}
        units = {"K_F": "g", "K_I": "g/g", "delta_O": "rad", "delta_P": "rad"}
        text += f"[truth.{name}]\n"
        text += "".join(f'{s} = "{value!r} {units[s]}"\n' for s, value in own.items())
    return (
        text.replace("np.float64(", "").replace(")", "")
        + f"{noise}\n"
        + (f'specific_force = "{NOISE} g"\n' if noise else "")
    )


def test_simulated_sensor_rests_and_rotates(tmp_path):
    record = PoseRecord("all", tmp_path / "a.csv", 1.5, None, **dict.fromkeys(STATED_CONDITIONS))
    time, force, along = simulate_forces(record, 40, 100.0, np.random.default_rng(2))
    assert time[-1] == pytest.approx(record_duration(record, 40)) == pytest.approx(40 * 5.5 - 1.5)
    np.testing.assert_allclose(np.linalg.norm(along, axis=1), 1.0)
    for k in range(40):
        at_rest = force[(time > 5.5 * k - 1e-6) & (time < 5.5 * k + 4.0 - 1e-6)]
        assert len(at_rest) == 400
        np.testing.assert_allclose(at_rest, np.tile(along[k], (400, 1)), rtol=0, atol=1e-12)
    # All over the sphere: each moment within 4.5 standard deviations of a third.
    assert np.abs(along.mean(axis=0)).max() < 4.5 * np.sqrt(1.0 / 3.0 / 40.0)
    moving = np.linalg.norm(force, axis=1)
    assert 0.05 < np.abs(moving - 1.0).max() < 0.2


def test_calibration_returns_simulated_truth(tmp_path):
    (tmp_path / "campaign.toml").write_text(describe_pose_record("poses = 30\n"), "utf-8")
    files = cs.simulate(tmp_path, tmp_path / "made")
    assert [file.name for file in files] == ["all.csv"]
    result = cs.calibrate(tmp_path / "made")
    assert len(result.triad.poses) == 30
    assert result.state == "good"
    (noise,) = result.accelerometers["X"].noise.values()
    # Of the mean of at least 2.5 s of rows; known to 21 degrees of freedom, 4.5 of its u.
    rows = min(pose.samples for pose in result.triad.poses)
    assert rows >= 250
    assert noise.value == pytest.approx(NOISE / np.sqrt(350), rel=0.15 + 4.5 / np.sqrt(42.0))
    coefficients = [result.coefficient(f"{owner}.{symbol}") for owner, symbol in triads.PARAMETERS]
    off = np.array([c.value for c in coefficients]) - triads.true_parameters()
    z = off / [c.u for c in coefficients]
    assert np.abs(z).max() < 5.0  # Student's t of 21 degrees of freedom, nine of them: p = 5e-4
    assert max(c.u for c in coefficients) < 1e-4
    record = PoseRecord("all", tmp_path / "a.csv", 1.5, None, **dict.fromkeys(STATED_CONDITIONS))
    campaign = cs.read_campaign(tmp_path)
    from counterspin.simulation.readings import reading_generator

    _, _, along = simulate_forces(record, 30, 100.0, reading_generator(campaign, 0, 3))
    directions = np.array([pose.direction for pose in result.triad.poses])
    np.testing.assert_allclose(directions, along, rtol=0, atol=10.0 * NOISE / np.sqrt(250))


@pytest.mark.parametrize("begun", ["", 'time = "100 s"\n'])
def test_drift_within_record_is_estimated(tmp_path, begun):
    drift = 5e-5  # g/s, 11 mg in the record
    text = describe_pose_record("poses = 40\n")
    text = text.replace('record = "all.csv"\n', f'record = "all.csv"\n{begun}')
    text = text.replace("[truth.Z]\n", f'[truth.Z]\n"K_F.trend" = "{drift!r} g/s"\n')
    plain = text.replace('"delta_P"]', '"delta_P", "K_F.trend"]')
    (tmp_path / "campaign.toml").write_text(plain, "utf-8")
    cs.simulate(tmp_path, tmp_path / "made")
    result = cs.calibrate(tmp_path / "made")
    for name, true in (("X", 0.0), ("Y", 0.0), ("Z", drift)):
        coefficient = result.coefficient(f"{name}.K_F.trend")
        assert coefficient.estimated
        assert abs(coefficient.value - true) < 5.0 * coefficient.u
        assert coefficient.u < 0.02 * drift
    # At the start of the record.
    bias = result.coefficient("Z.K_F")
    assert abs(bias.value - triads.BIAS[2]) < 5.0 * bias.u
    # With the drift left out nothing fits: 11 mg beside 0.03 mg.
    (tmp_path / "made" / "campaign.toml").write_text(text, "utf-8")
    assert cs.calibrate(tmp_path / "made").triad.rms_after > 20.0 * result.triad.rms_after


def test_result_does_not_depend_on_start_time(tmp_path):
    (tmp_path / "campaign.toml").write_text(
        describe_pose_record("poses = 20\n", clock='{ column = "t", unit = "s" }'), "utf-8"
    )
    cs.simulate(tmp_path, tmp_path / "made")
    first = cs.calibrate(tmp_path / "made")
    rows = (tmp_path / "made" / "all.csv").read_text("utf-8").splitlines()
    late = [rows[0]]
    for row in rows[1:]:
        time, comma, others = row.partition(",")
        late.append(f"{float(time) + 1.7e9:.3f}{comma}{others}")
    (tmp_path / "made" / "all.csv").write_text("\n".join(late) + "\n", "utf-8")
    again = cs.calibrate(tmp_path / "made")
    for name, c in first.triad.parameters.items():
        assert again.triad.parameters[name].value == pytest.approx(c.value, abs=0.05 * c.u)
        assert again.triad.parameters[name].u == pytest.approx(c.u, rel=0.02)


def test_in_memory_result_equals_result_from_files(tmp_path):
    clock = '{ column = "t", unit = "s" }'
    (tmp_path / "campaign.toml").write_text(describe_pose_record(clock=clock), "utf-8")
    cs.simulate(tmp_path, tmp_path / "made")
    by_file, in_memory = cs.calibrate(tmp_path / "made"), cs.calibrate(cs.simulate(tmp_path))
    assert len(by_file.triad.poses) == 24
    for name, c in by_file.triad.parameters.items():
        assert in_memory.triad.parameters[name].value == pytest.approx(c.value, abs=1e-12)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (describe_pose_record(noise=""), "truth.noise.specific_force: missing"),
        (
            describe_pose_record().replace('e = "100 Hz"\ns', 'e = "50 Hz"\ns'),
            "records.time states 100 Hz",
        ),
        (describe_pose_record("poses = 0\n"), "simulation.poses"),
        (describe_pose_record().replace("all.csv", "all.log"), "must end in .csv or .parquet"),
    ],
)
def test_invalid_pose_record_raises(tmp_path, text, words):
    (tmp_path / "campaign.toml").write_text(text, "utf-8")
    with pytest.raises(CampaignError, match=words):
        cs.simulate(tmp_path, tmp_path / "made")


def test_command_line_simulates_checks_and_studies(tmp_path, capsys):
    (tmp_path / "campaign.toml").write_text(describe_pose_record(), "utf-8")
    folder = str(tmp_path / "made")
    assert main(["simulate", str(tmp_path / "campaign.toml"), "-o", folder]) == 0
    assert main(["check", f"{folder}/all.csv", "--campaign", folder]) == 0
    assert main(["study", folder, "--trials", "2"]) == 0
    assert "Z.delta_P" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize("unit", ["g", "count"])
def test_study_u_matches_noise_of_pose_means(tmp_path, unit):
    """Their noise is that of the mean of 3 s of rows, whose u of a bias is known by algebra."""
    text = describe_pose_record("poses = 30\n")
    if unit == "count":
        output = 'output = { unit = "count", sensitivity = "16384 count/g", zero = "40 count" }\n'
        text = text.replace('unit = "m/s^2" }\n', 'unit = "count" }\n' + output)
    (tmp_path / "campaign.toml").write_text(text, "utf-8")
    studied = read_study(tmp_path)
    along = true_directions(studied.campaign)
    assert along.shape == (30, 3)
    x, y, z = along.T
    felt = np.column_stack([x, y, z, x * x, y * y, z * z, x * y, x * z, y * z])
    u = NOISE / np.sqrt(300.0) * np.sqrt(np.diag(np.linalg.inv(felt.T @ felt))[0])
    coefficient = study(studied, trials=60).analyses["joint"].coefficients["X.K_F"]
    assert coefficient.sd == pytest.approx(u, rel=5.0 / np.sqrt(2.0 * 60.0))
    assert coefficient.u == pytest.approx(u, rel=0.1)

"""[triad] and runs at unknown attitudes: what is read, and every mistake in words."""

import numpy as np
import pytest
from raising import raises

import counterspin as cs
import triads
from counterspin.errors import CampaignError

POSE = (
    '[[runs]]\nname = "{name}"\nmotion = "static"\nattitude = "unknown"\n'
    'reading = {{ X = "{x} g", Y = "{y} g", Z = "{z} g" }}\n'
)
ONE = POSE.format(name="one", x=0.1, y=-0.2, z=0.97)
TWO = POSE.format(name="two", x=-0.1, y=0.2, z=-0.95)


def _read(folder, text):
    (folder / "campaign.toml").write_text(text)
    return cs.read_campaign(folder)


def _refused(folder, text):
    with pytest.raises(CampaignError) as error:
        _read(folder, text)
    return "\n".join(error.value.problems)


def test_poses_and_frame_misalignments_are_read(tmp_path):
    campaign = _read(tmp_path, triads.format_description() + ONE + TWO)
    first, second = campaign.triad.poses
    assert [reading.value for reading in first] == [0.1, -0.2, 0.97]
    assert {reading.name for reading in second} == {"two"}
    # Y's pendulous axis points up, out of the plane of X and Y: a turn about its output axis
    # carries Y's input axis there.
    assert campaign.triad.frame_misalignments == (
        ("X", "delta_O"),
        ("X", "delta_P"),
        ("Y", "delta_O"),
    )
    assert campaign.readings == ()
    assert campaign.model.terms == ("K_F", "K_I", "delta_O", "delta_P")


def test_known_attitudes_determine_orientation_of_triad(tmp_path):
    known = ONE.replace('"unknown"', '"level"').replace("one", "known")
    campaign = _read(tmp_path, triads.format_description() + ONE + known)
    assert campaign.triad.frame_misalignments == ()
    assert {reading.name for reading in campaign.readings} == {"known"}
    assert {reading.name for reading in campaign.all_readings} == {"known", "one"}


def test_table_rows_may_be_poses(tmp_path):
    text = triads.format_description() + (
        '[readings]\nfile = "t.csv"\n'
        'columns = { attitude = "at", reading = { X = "x", Y = "y", Z = "z" } }\n'
    )
    (tmp_path / "t.csv").write_text("at,x,y,z\n0,0,0,1\nunknown,0.1,0.2,0.9\n90,1,0,0\n")
    campaign = _read(tmp_path, text)
    assert len(campaign.readings) == 6
    ((x, *_),) = campaign.triad.poses
    assert x.value == 0.1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("[triad]", "[fixture]"), "unknown key"),
        (('["X", "Y", "Z"]', '["X", "Y", "W"]'), 'no accelerometer is named "W"'),
        (('["X", "Y", "Z"]', '["X", "Y", "Y"]'), '"Y" is listed twice'),
        (
            ('["X", "Y", "Z"]', '["X", "Y"]'),
            "triad.accelerometers: must have at least 3 entries",
        ),
        (
            ('["X", "Y", "Z"]', '["X", "Y", "Z", "X"]'),
            "triad.accelerometers: must have at most 3 entries",
        ),
        (('motion = "static"\n', 'motion = "arm"\nrate = "1 rad/s"\n'), "unknown only at rest"),
        ((', Z = "0.97 g"', ""), "X, Y, Z must have readings, and no other"),
        (('attitude = "unknown"', 'attitude = "unknown"\nmounting = "in"'), "does not apply to a"),
        (('attitude = "unknown"', 'attitude = "unknown"\nposes = {}'), "are detected in a record"),
        (('attitude = "unknown"', 'attitude = "level"\nposes = {}'), 'attitude = "unknown"'),
        (('name = "one"', 'name = "one"\nrecord = "a.csv"'), "give either reading or record"),
        (
            (
                'input_axis = "up"\npendulous_axis = "east"',
                'input_axis = [1, 1, 0]\npendulous_axis = "up"',
            ),
            "lie (nearly) in one plane",
        ),
        (
            ('pendulous_axis = "up"\ngrade', "pendulous_axis = [1, 0, 1]\ngrade"),
            "must lie in the plane of the input axes of X and Y",
        ),
        (
            ('grade = "consumer"\n', 'grade = "consumer"\ndelta_P = "0 ± 1 mrad"\n'),
            "zero by definition",
        ),
    ],
)
def test_invalid_section_raises(tmp_path, change, message):
    text = triads.format_description() + ONE
    assert change[0] in text
    assert message in _refused(tmp_path, text.replace(*change, 1))


def test_unknown_attitude_requires_triad(tmp_path):
    text = (triads.format_description() + ONE).replace(
        '[triad]\naccelerometers = ["X", "Y", "Z"]\n', ""
    )
    assert "write [triad] accelerometers" in _refused(tmp_path, text)


def test_simulated_poses_return_true_bias(tmp_path):
    rows, bias = triads.ROWS, triads.BIAS
    truth = "".join(
        f'[truth.{name}]\nK_F = "{bias[k]} g"\nK_I = "{rows[k, k]} g/g"\n'
        for k, name in enumerate(triads.NAMES)
    )
    # Y's output axis points east, along which its row has 0.003; Z's pendulous axis does.
    truth = truth.replace("[truth.Z]", '[truth.Z]\ndelta_O = "-6 mrad"\ndelta_P = "-2 mrad"')
    truth = truth.replace("[truth.Y]", '[truth.Y]\ndelta_P = "-3 mrad"')
    truth += '[truth.noise]\nreading = "0 g"\n[simulation]\nseed = 4\n'
    text = triads.format_description() + "".join(
        POSE.format(name=f"p{k}", x="?", y="?", z="?").replace(" g", "") for k in range(9)
    )
    table = text + (
        '[readings]\nfile = "t.csv"\nattitude = "unknown"\n'
        'columns = { name = "n", reading = { Z = "z", X = "x", Y = "y" } }\n'
    )
    (tmp_path / "t.csv").write_text("n,x,y,z\n" + "a,?,?,?\n" * 6)
    (tmp_path / "campaign.toml").write_text(table + truth)
    cs.simulate(tmp_path, tmp_path / "made")
    campaign = cs.read_campaign(tmp_path / "made")
    assert len(campaign.triad.poses) == 15
    for pose in campaign.triad.poses:
        along = np.linalg.solve(rows, [reading.value for reading in pose] - bias)
        assert np.linalg.norm(along) == pytest.approx(1.0, abs=1e-9)
    result = cs.calibrate(tmp_path / "made")
    np.testing.assert_allclose(result.triad.bias, bias, atol=1e-9)


def test_pose_record_is_read(tmp_path):
    columns = '[records]\ntime = { column = "t", unit = "s" }\n'
    text = triads.format_description(columns) + (
        '[[runs]]\nname = "many"\nmotion = "static"\nattitude = "unknown"\nrecord = "a.csv"\n'
    )
    for name in triads.NAMES:
        plain = triads.format_accelerometer(name)
        more = f'specific_force = {{ column = "{name}", unit = "g" }}\n'
        text = text.replace(plain, triads.format_accelerometer(name, more))
    campaign = _read(tmp_path, text)
    (record,) = campaign.triad.records
    assert (record.min_rest, record.threshold) == (1.5, None)
    assert campaign.files == (tmp_path / "a.csv",)


def test_single_uncertainty_column_applies_to_all_axes(tmp_path):
    """It was that of the first accelerometer alone, so that the pose counted as without any."""
    values = triads.compute_indications(triads.draw_directions(12, np.random.default_rng(3)))
    folder = triads.write_pose_campaign(tmp_path, values, u=2e-4)
    file = folder / "campaign.toml"
    file.write_text(file.read_text().replace('u = { X = "u", Y = "u", Z = "u" }', 'u = "u"'))
    poses = cs.read_campaign(folder).triad.poses
    assert {reading.u for pose in poses for reading in pose} == {2e-4}


def test_uncertainty_of_some_axes_raises(tmp_path):
    values = triads.compute_indications(triads.draw_directions(12, np.random.default_rng(3)))
    folder = triads.write_pose_campaign(tmp_path, values, u=2e-4)
    file = folder / "campaign.toml"
    file.write_text(
        file.read_text().replace('u = { X = "u", Y = "u", Z = "u" }', 'u = { X = "u" }')
    )
    with raises("wrong-uncertainty"):
        cs.read_campaign(folder)


def test_default_axes_of_triad_are_body_axes(tmp_path):
    text = triads.format_description() + ONE + TWO
    bare = "\n".join(line for line in text.splitlines() if "_axis = " not in line)
    assert bare.count("[accelerometers.") == 3
    plain, stated = (_read(tmp_path, one).accelerometers for one in (bare, text))
    for name in triads.NAMES:
        np.testing.assert_array_equal(plain[name].mounting.matrix, stated[name].mounting.matrix)
    # One that is stated makes the others a matter of the description.
    some = text.replace('input_axis = "north"\npendulous_axis = "up"\n', "")
    assert some != text
    assert "accelerometers.Y.input_axis: is missing" in _refused(tmp_path, some)

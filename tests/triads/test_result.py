"""A triad at unknown attitudes, from its campaign to its result."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
from raising import raises

import counterspin as cs
import triads

NOISE = 3e-4
REAL = Path(__file__).parents[4] / "shared" / "real" / "mpu9150" / "imu0.log"


def _values(count, seed, noise=NOISE, **truth):
    generator = np.random.default_rng(seed)
    values = triads.compute_indications(triads.draw_directions(count, generator), **truth)
    return values + noise * generator.standard_normal(values.shape)


def _expected():
    """Return the true values of the nine NIST parameters."""
    sizes = np.linalg.norm(triads.ROWS, axis=1)
    x, y, z = triads.ROWS / sizes[:, None]
    return {
        **{f"offset.{name}": bias for name, bias in zip("XYZ", triads.BIAS, strict=True)},
        **{f"sensitivity.{name}": size for name, size in zip("XYZ", sizes, strict=True)},
        "angle.X.Y": math.acos(x @ y),
        "angle.X.Z": math.acos(x @ z),
        "angle.Y.Z": math.acos(y @ z),
    }


def test_parameters_matrix_and_bias_match_truth(tmp_path):
    values = _values(30, 1, noise=0.0)
    result = cs.calibrate(triads.write_pose_campaign(tmp_path, values, u=1e-5))
    triad = result.triad
    assert {name: c.value for name, c in triad.parameters.items()} == pytest.approx(
        _expected(), abs=1e-9
    )
    np.testing.assert_allclose(triad.matrix, np.linalg.inv(triads.ROWS), atol=1e-9)
    np.testing.assert_allclose(triad.bias, triads.BIAS, atol=1e-9)
    assert triad.rms_after < 1e-8
    plain = np.linalg.norm(values, axis=1) - 1.0
    assert triad.rms_before == pytest.approx(9.81 * np.sqrt(np.mean(plain**2)), rel=1e-9)
    assert result.state == "good"
    along = np.array([pose.direction for pose in triad.poses])
    np.testing.assert_allclose(
        along, triads.draw_directions(30, np.random.default_rng(1)), rtol=0, atol=1e-9
    )


def test_uncertainties_and_correlations_match_derivatives(tmp_path):
    # An angle's derivatives, and a sensitivity's, by differences of the matrix.
    result = cs.calibrate(triads.write_pose_campaign(tmp_path, _values(30, 2), u=NOISE))
    triad = result.triad
    covariance = result.covariance.matrix
    order = [f"{name}.{symbol}" for name, symbol in triads.PARAMETERS]
    places = [result.covariance.terms.index(name) for name in order]
    covariance = covariance[np.ix_(places, places)]
    at = np.array([result.coefficient(name).value for name in order])

    def parameters(x):
        own = triads.SIGNS * x
        rows = np.array([[own[3], 0, 0], [own[4], own[5], 0], own[6:]])
        sizes = np.linalg.norm(rows, axis=1)
        unit = rows / sizes[:, None]
        angles = [math.acos(unit[a] @ unit[b]) for a, b in ((0, 1), (0, 2), (1, 2))]
        return np.array([*own[:3], *sizes, *angles])

    step = 1e-6
    slopes = np.array(
        [(parameters(at + step * e) - parameters(at - step * e)) / (2 * step) for e in np.eye(9)]
    ).T
    expected = slopes @ covariance @ slopes.T
    u = np.array([c.u for c in triad.parameters.values()])
    np.testing.assert_allclose(u, np.sqrt(np.diag(expected)), rtol=1e-6)
    np.testing.assert_allclose(triad.correlation.matrix, expected / np.outer(u, u), atol=1e-6)
    assert triad.by_gravity == {}

    def inverse(x):
        own = triads.SIGNS * x
        return np.linalg.inv([[own[3], 0, 0], [own[4], own[5], 0], own[6:]]).ravel()

    slopes = np.array(
        [(inverse(at + step * e) - inverse(at - step * e)) / (2 * step) for e in np.eye(9)]
    ).T
    expected = np.sqrt(np.diag(slopes @ covariance @ slopes.T)).reshape(3, 3)
    np.testing.assert_allclose(triad.u_matrix, expected, rtol=1e-6)


def write_campaign_in_si(folder, values, gravity):
    """Write a campaign of poses whose indications are in m/s^2, of shape (n, 3)."""
    folder.mkdir()
    runs = (
        f'[[runs]]\nname = "p{k}"\nmotion = "static"\nattitude = "unknown"\nreading = {{ '
        + ", ".join(f'{n} = "{v!r} ± 3e-3 m/s^2"' for n, v in zip("XYZ", row, strict=True))
        + " }\n"
        for k, row in enumerate(np.asarray(values).tolist())
    )
    description = triads.format_description().replace('"9.81 m/s^2"', f'"{gravity} m/s^2"')
    (folder / "campaign.toml").write_text(description + "".join(runs), "utf-8")
    return folder


def test_sensitivity_to_gravity_matches_difference(tmp_path):
    values = 9.81 * _values(20, 5)
    stated = cs.calibrate(write_campaign_in_si(tmp_path / "stated", values, "9.81 ± 1e-3")).triad
    low, high = (
        cs.calibrate(write_campaign_in_si(tmp_path / g, values, g)).triad.parameters
        for g in ("9.809", "9.811")
    )
    differences = {name: (high[name].value - low[name].value) / 2e-3 for name in high}
    assert stated.by_gravity == pytest.approx(differences, rel=1e-5, abs=1e-7)
    assert abs(stated.by_gravity["sensitivity.X"]) == pytest.approx(1.004 / 9.81, rel=1e-2)


def test_poses_without_stated_noise_have_student_t_intervals(tmp_path):
    result = cs.calibrate(triads.write_pose_campaign(tmp_path, _values(20, 3)))
    for parameter in result.triad.parameters.values():
        assert parameter.dof == pytest.approx(11.0, abs=1e-3)
    (noise,) = result.accelerometers["Y"].noise.values()
    assert noise.estimated
    assert noise.value == pytest.approx(NOISE, abs=4.0 * NOISE / math.sqrt(22.0))
    assert set(result.accelerometers["X"].coefficients) == {"K_F", "K_I"}
    assert set(result.accelerometers["Y"].coefficients) == {"K_F", "K_I", "delta_P"}
    assert set(result.accelerometers["Z"].coefficients) == {"K_F", "K_I", "delta_O", "delta_P"}


def test_result_round_trip_and_report(tmp_path):
    result = cs.calibrate(triads.write_pose_campaign(tmp_path, _values(20, 3)))
    path = tmp_path / "result.json"
    result.write(path)
    again = cs.read_result(path)
    assert again.triad == result.triad
    assert json.loads(path.read_text("utf-8"))["triad"]["accelerometers"] == ["X", "Y", "Z"]
    for face in ("html", "md"):
        report = tmp_path / f"report.{face}"
        cs.write_report(result, report)
        assert "poses of unknown attitude" in report.read_text("utf-8")


def test_unused_positioning_error_has_warning(tmp_path):
    stated = '\n[fixture]\nposition = "0 ± 0.5 deg"\n'
    values = _values(20, 3)
    result = cs.calibrate(
        triads.write_pose_campaign(
            tmp_path / "poses", values, description=triads.format_description(stated)
        )
    )
    (warning,) = (text for text in result.warnings if "[fixture]" in text)
    assert "this campaign estimates all attitudes" in warning
    folder = triads.write_pose_campaign(
        tmp_path / "both", values, u=3e-4, description=triads.format_description(stated)
    )
    level = '[[runs]]\nname = "level"\nmotion = "static"\nattitude = "level"\n'
    level += 'reading = { X = "0.01 ± 3e-4 g", Y = "-0.01 ± 3e-4 g", Z = "1.04 ± 3e-4 g" }\n'
    description = (folder / "campaign.toml").read_text("utf-8")
    (folder / "campaign.toml").write_text(description + level, "utf-8")
    assert not any("[fixture]" in text for text in cs.calibrate(folder).warnings)


def test_single_known_attitude_leaves_azimuth_undetermined(tmp_path):
    folder = triads.write_pose_campaign(tmp_path, _values(20, 3), u=NOISE)
    x, y, z = triads.compute_indications(np.array([[0.0, 0.0, 1.0]]))[0].tolist()
    level = '[[runs]]\nname = "level"\nmotion = "static"\nattitude = "level"\nreading = '
    level += f'{{ X = "{x!r} ± 3e-4 g", Y = "{y!r} ± 3e-4 g", Z = "{z!r} ± 3e-4 g" }}\n'
    description = (folder / "campaign.toml").read_text("utf-8")
    (folder / "campaign.toml").write_text(description + level, "utf-8")
    result = cs.calibrate(folder)
    assert result.coefficient("X.delta_O").value is None
    assert result.coefficient("Y.delta_P").value is None
    for name, expected in _expected().items():
        c = result.triad.parameters[name]
        assert abs(c.value - expected) < 4.0 * c.u
        assert c.u < 5.0 * NOISE


def test_parameters_have_repr_and_frame(tmp_path):
    triad = cs.calibrate(triads.write_pose_campaign(tmp_path, _values(20, 3))).triad
    lines = repr(triad).splitlines()
    assert str(triad) == repr(triad)
    assert lines[0] == "Triad X, Y, Z: 20 poses"
    assert lines[1].split() == ["offset.X", *repr(triad.parameters["offset.X"]).split()]
    assert len(lines) == 11
    frame = triad.frame()
    assert frame["term"].to_list() == list(triad.parameters)
    assert set(frame["owner"]) == {"triad"}
    values = dict(zip(frame["term"], frame["value"], strict=True))
    assert values["offset.Y"] == pytest.approx(1e6 * triad.parameters["offset.Y"].value)  # ug


def test_default_priors_are_in_u(tmp_path):
    values = _values(40, 4)
    perfect = cs.calibrate(triads.write_pose_campaign(tmp_path / "a", values, u=NOISE))
    model = 'terms = ["K_F", "K_I", "delta_O", "delta_P"]'
    usual = cs.calibrate(
        triads.write_pose_campaign(
            tmp_path / "b", values, u=NOISE, description=triads.format_description(model=model)
        )
    )
    offset, plain = (r.triad.parameters["offset.X"] for r in (usual, perfect))
    assert plain.u_unstated == pytest.approx(0.0, abs=1e-6)
    # A square of 1e-3 g/g^2 is 3/5 bias where poses are all over the sphere; squares across too.
    assert 2e-4 < offset.u_unstated < 6e-4
    assert abs(offset.value - triads.BIAS[0]) < 4.0 * offset.u
    assert offset.u**2 == pytest.approx(
        offset.u_noise**2 + offset.u_stated**2 + offset.u_unstated**2, rel=1e-9
    )


def test_outlying_pose_is_named(tmp_path):
    values = _values(30, 5)
    values[12] *= 1.0 + 14.0 * NOISE
    names = [f"p{k}" for k in range(30)]
    result = cs.calibrate(triads.write_pose_campaign(tmp_path, values, u=NOISE, name=names))
    codes = {(finding.code, finding.subject) for finding in result.findings}
    assert ("outlying-reading", "triad.p12") in codes
    assert result.state == "contradicted"


def test_noise_stated_too_small_is_lack_of_fit(tmp_path):
    result = cs.calibrate(triads.write_pose_campaign(tmp_path, _values(40, 6), u=NOISE / 2.5))
    assert ("lack-of-fit", "triad") in {(f.code, f.subject) for f in result.findings}


def test_few_poses_are_unjudged(tmp_path):
    result = cs.calibrate(triads.write_pose_campaign(tmp_path, _values(12, 7)))
    (finding,) = [f for f in result.findings if f.code == "unjudged-readings"]
    assert finding.subject == "triad"
    assert result.state == "reservations"


@pytest.mark.parametrize(("model", "n_poses", "n_unknowns"), [("", 9, 9), ("few", 6, 6)])
def test_too_few_poses_are_compared_with_number_of_unknowns(tmp_path, model, n_poses, n_unknowns):
    model = model and 'terms = ["K_F", "K_I"]'
    description = triads.format_description(model=model)
    folder = triads.write_pose_campaign(tmp_path, _values(n_poses, 7), description=description)
    with raises("not-identifiable", f"{n_poses} poses", f"both {n_unknowns} unknowns without"):
        cs.calibrate(folder)


def test_six_faces_report_undetermined_parameters(tmp_path):
    faces = triads.compute_indications(np.vstack([np.eye(3), -np.eye(3)]))
    result = cs.calibrate(triads.write_pose_campaign(tmp_path, faces, u=NOISE))
    for name in ("angle.X.Y", "angle.X.Z", "angle.Y.Z"):
        assert result.triad.parameters[name].value is None
    assert result.triad.matrix is None
    subjects = {f.subject: f.text for f in result.findings if f.code == "not-determined"}
    assert {"Y.delta_P", "Z.delta_O", "Z.delta_P"} <= set(subjects)
    assert "6 poses cannot determine 9 unknowns" in subjects["Z.delta_P"]


def test_six_directions_leave_angles_and_matrix_undetermined(tmp_path):
    faces = np.repeat(np.vstack([np.eye(3), -np.eye(3)]), 4, axis=0)
    generator = np.random.default_rng(15)
    values = triads.compute_indications(faces) + NOISE * generator.standard_normal((24, 3))
    result = cs.calibrate(triads.write_pose_campaign(tmp_path, values))
    parameters = result.triad.parameters
    for k, name in enumerate(triads.NAMES):
        offset, size = parameters[f"offset.{name}"], parameters[f"sensitivity.{name}"]
        assert abs(offset.value - triads.BIAS[k]) < 4.0 * offset.u < 20.0 * NOISE
        assert abs(size.value - triads.ROWS[k, k]) < 4.0 * size.u < 20.0 * NOISE
    for name in ("angle.X.Y", "angle.X.Z", "angle.Y.Z"):
        assert parameters[name].value is None
        assert name in result.triad.why_no_matrix
    assert result.triad.matrix is None
    texts = {f.subject: f.text for f in result.findings if f.code == "not-determined"}
    assert texts.keys() == {"Y.delta_P", "Z.delta_O", "Z.delta_P"}
    assert "24 poses have only 6 different directions" in texts["Y.delta_P"]
    # The default prior of a misalignment contributes to what depends on it.
    budget = {line.source: line for line in result.accelerometers["Y"].budget["K_I"]}
    assert budget["Z.delta_P"].kind == "unstated"


def test_six_faces_determine_biases_and_scale_factors(tmp_path):
    faces = triads.compute_indications(np.vstack([np.eye(3), -np.eye(3)]))
    description = triads.format_description(
        model='typical = { K_II = "1 ug/g^2", K_0_asym = "1 ug" }'
    )
    result = cs.calibrate(
        triads.write_pose_campaign(tmp_path, faces, u=1e-5, description=description)
    )
    parameters = result.triad.parameters
    for k, name in enumerate(triads.NAMES):
        offset, size = parameters[f"offset.{name}"], parameters[f"sensitivity.{name}"]
        assert abs(offset.value - triads.BIAS[k]) < 3.0 * offset.u
        assert abs(size.value - triads.ROWS[k, k]) < 3.0 * size.u
        assert size.u < 1e-3
    # Of the angles nothing is found out: they are what they were, a right angle by 20 mrad.
    angle = parameters["angle.X.Y"]
    assert not angle.estimated
    assert angle.u == pytest.approx(0.02, rel=0.01)
    assert {accelerometer.state for accelerometer in result.accelerometers.values()} == {
        "reservations"
    }
    assert [f.code for f in result.findings] == ["unjudged-readings"]


def test_poses_in_single_hemisphere_are_reported(tmp_path):
    generator = np.random.default_rng(9)
    along = triads.draw_directions(40, generator)
    along[:, 2] = np.abs(along[:, 2])
    result = cs.calibrate(
        triads.write_pose_campaign(tmp_path, triads.compute_indications(along), u=0.03)
    )
    texts = [f.text for f in result.findings if f.code == "not-determined"]
    assert not texts or any("No pose has Z pointing down" in text for text in texts)


@pytest.mark.skipif(not REAL.exists(), reason="the real record is not part of the package")
def test_measured_pose_record_matches_published_values(tmp_path):
    runs = (
        '[[runs]]\nname = "poses"\nmotion = "static"\nattitude = "unknown"\n'
        'record = "imu0.log"\nposes = { rest = "1.5 s" }\n'
    )
    columns = "".join(
        triads.format_accelerometer(
            name, f'specific_force = {{ column = "column {k}", unit = "m/s^2" }}\n'
        )
        for k, name in enumerate(triads.NAMES, start=1)
    )
    plain = "".join(map(triads.format_accelerometer, triads.NAMES))
    text = triads.format_description('[records]\ntime = { sampling_rate = "100 Hz" }').replace(
        plain, columns
    )
    (tmp_path / "campaign.toml").write_text(text + runs)
    (tmp_path / "imu0.log").write_bytes(REAL.read_bytes())
    triad = cs.calibrate(tmp_path).triad
    # A fit of |f| = g by others, to poses that were picked another way: within one of its u.
    scale = {"X": 0.99638, "Y": 0.99672, "Z": 0.99375}
    bias = {"X": 0.1016, "Y": 0.0966, "Z": 0.3447}
    for place, name in enumerate(triads.NAMES):
        offset = triad.parameters[f"offset.{name}"]
        assert offset.value * 9.81 == pytest.approx(bias[name], abs=1.0e-3)
        assert offset.u * 9.81 == pytest.approx(1.0e-3, rel=0.1)
        assert triad.matrix[place][place] == pytest.approx(scale[name], abs=1.4e-4)
    assert len(triad.poses) == 22
    assert triad.rms_before == pytest.approx(0.2129, rel=0.01)
    # With 13 degrees of freedom of 22 poses.
    assert triad.rms_after * math.sqrt(22.0 / 13.0) == pytest.approx(0.0026, rel=0.1)

"""Correlated errors of accelerometers that were fitted jointly, in joint corrections."""

import math

import numpy as np
import polars as pl
import pytest
from raising import raises

import counterspin as cs
import triads
from counterspin.correction.apply_file import apply_file

FORCES = np.array([[0.0, 0.0, 1.0], [0.6, -0.8, 0.0], [0.3, 0.5, -0.7], [-1.0, 0.1, 0.2]])


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    generator = np.random.default_rng(5)
    values = triads.compute_indications(triads.draw_directions(14, generator))
    values += 3e-4 * generator.standard_normal(values.shape)
    return cs.calibrate(
        triads.write_pose_campaign(tmp_path_factory.mktemp("triad"), values, u=3e-4)
    )


def correct_all(result, y):
    options = cs.ApplyOptions(others={"Y": y[:, 1], "Z": y[:, 2]})
    first = cs.apply(result, "X", y[:, 0], options)
    return [first, first.others["Y"], first.others["Z"]]


def apply_nine_parameters(parameters, y):
    """Return f of indications, by three offsets, three sensitivities and three angles."""
    bias, size, (xy, xz, yz) = np.split(np.asarray(parameters), 3)
    z = [math.cos(xz), (math.cos(yz) - math.cos(xy) * math.cos(xz)) / math.sin(xy)]
    axes = np.array([[1.0, 0.0, 0.0], [math.cos(xy), math.sin(xy), 0.0], [*z, 0.0]])
    axes[2, 2] = math.sqrt(1.0 - z[0] ** 2 - z[1] ** 2)
    return np.linalg.solve(size[:, None] * axes, (y - bias).T).T


def test_output_and_u_match_nine_parameters(result):
    y = triads.compute_indications(FORCES)
    corrections = correct_all(result, y)
    values = [result.triad.parameters[name].value for name in result.triad.correlation.terms]
    u = np.array([result.triad.parameters[name].u for name in result.triad.correlation.terms])
    force = np.column_stack([correction.corrected for correction in corrections])
    assert force == pytest.approx(apply_nine_parameters(values, y), abs=1e-12)
    matrix, bias = np.array(result.triad.matrix), np.array(result.triad.bias)
    assert force == pytest.approx((y - bias) @ matrix.T, abs=1e-12)
    assert force == pytest.approx(FORCES, abs=2e-3)
    covariance = np.outer(u, u) * np.array(result.triad.correlation.matrix)
    slopes = []
    for place in range(9):
        step = np.zeros(9)
        step[place] = 1e-6
        slopes.append(
            (apply_nine_parameters(values + step, y) - apply_nine_parameters(values - step, y))
            / 2e-6
        )
    variance = np.einsum("pni,pq,qni->ni", slopes, covariance, slopes)
    claimed = np.column_stack([correction.u for correction in corrections])
    assert claimed == pytest.approx(np.sqrt(variance), rel=1e-6)


def test_correlations_between_accelerometers_are_included(result):
    # Along the force of a pose, u of |f| is smaller than from uncorrelated components.
    y = triads.compute_indications(FORCES)
    plain = result.model_copy(update={"correlation": None})
    alone = np.column_stack([correction.u for correction in correct_all(plain, y)])
    related = np.column_stack([correction.u for correction in correct_all(result, y)])
    assert np.abs(related / alone - 1.0).max() > 1e-3


def test_default_priors_are_included_for_all_three_axes(tmp_path, result):
    generator = np.random.default_rng(5)
    values = triads.compute_indications(triads.draw_directions(14, generator))
    text = triads.format_description(model='terms = ["K_F", "K_I", "delta_O", "delta_P"]')
    unstated = cs.calibrate(triads.write_pose_campaign(tmp_path, values, u=3e-4, description=text))
    y = triads.compute_indications(np.vstack([FORCES, 3.0 * FORCES]))
    corrections = correct_all(unstated, y)
    # Values apply at the temperature of the poses.
    texts = [
        text
        for text in corrections[0].warnings
        if "u does not include the uncertainty of these terms" in text
    ]
    assert all("temperature" in text for text in texts), texts
    u = np.column_stack([correction.u for correction in corrections])
    # The default u of K_II of a MEMS sensor is 1e-3 g/g^2: 9e-3 g at 3 g.
    assert u[4, 2] == pytest.approx(9e-3, rel=0.25)
    assert (
        u[:4] > np.column_stack([correction.u for correction in correct_all(result, y[:4])])
    ).all()
    # Half of the default K_0_asym of a MEMS sensor, 1.25 mg, acts on the output and on the bias.
    symmetric = text.replace("terms = ", 'assume = ["K_0_asym"]\nterms = ')
    known = cs.calibrate(
        triads.write_pose_campaign(tmp_path, values, u=3e-4, description=symmetric)
    )
    u_known = np.column_stack([correction.u for correction in correct_all(known, y[:4])])
    assert (u[:4] ** 2 - u_known**2 < 2.0 * 1.25e-3**2).all()


def test_file_has_all_three_axes_corrected(tmp_path, result):
    y = triads.compute_indications(FORCES)
    frame = pl.DataFrame({"t": [0.0, 0.1, 0.2, 0.3], "X": y[:, 0], "Y": y[:, 1], "Z": y[:, 2]})
    frame.write_csv(tmp_path / "in.csv")
    done = apply_file(result, None, tmp_path / "in.csv", tmp_path / "out.csv")
    assert [correction.column for correction in (done, *done.more)] == ["X", "Y", "Z"]
    written = pl.read_csv(tmp_path / "out.csv")
    assert written.columns[4:] == [f"{n}_corrected{u}" for n in "XYZ" for u in ("", "_u")]
    for one, name in zip(correct_all(result, y), "XYZ", strict=True):
        assert written[f"{name}_corrected"].to_numpy() == pytest.approx(one.corrected, abs=1e-12)
        assert written[f"{name}_corrected_u"].to_numpy() == pytest.approx(one.u, rel=1e-12)
    named = frame.rename({"X": "ax", "Y": "ay", "Z": "az"})
    named.write_csv(tmp_path / "named.csv")
    options = cs.ApplyOptions(others={"Z": "az", "X": "ax", "Y": "ay"})
    done = apply_file(result, None, tmp_path / "named.csv", tmp_path / "more.csv", options=options)
    assert [correction.column for correction in (done, *done.more)] == ["az", "ax", "ay"]
    again = pl.read_csv(tmp_path / "more.csv")["ay_corrected"].to_numpy()
    assert again == pytest.approx(written["Y_corrected"].to_numpy(), abs=1e-12)


def test_accelerometer_is_required_without_triad(tmp_path, result):
    pl.DataFrame({"X": [1.0]}).write_csv(tmp_path / "in.csv")
    plain = result.model_copy(update={"triad": None})
    with raises("wrong-usage", "`accelerometer`"):
        apply_file(plain, None, tmp_path / "in.csv", tmp_path / "out.csv")
    with raises("wrong-usage", "`accelerometer`"):
        apply_file(result, None, tmp_path / "in.csv", tmp_path / "out.csv", column="X")

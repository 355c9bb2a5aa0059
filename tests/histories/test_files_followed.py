"""History of a triad: its nine parameters and the inputs shared by its results."""

import math

import numpy as np
import pytest

import counterspin as cs
import triads
from counterspin.errors import CounterspinError

NOISE = 2e-4
DATES = ("2024-03-01", "2025-03-01", "2026-03-01", "2027-03-01")
MODEL = 'terms = ["K_F", "K_I", "delta_O", "delta_P"]'


def write_triad_result(folder, date, values, serials=("A", "B", "C"), model=MODEL):
    """Write the result of a triad of three serial numbers, poses in the same directions."""
    head = triads.format_description(model=model).replace('"9.81 m/s^2"', '"9.81 ± 1e-3 m/s^2"')
    head = head.replace("schema = 1", f'schema = 1\ncampaign = {{ date = "{date}" }}')
    for name, serial in zip(triads.NAMES, serials, strict=True):
        with_serial = triads.format_accelerometer(
            name, f'serial_number = "{serial}"\n' if serial else ""
        )
        head = head.replace(triads.format_accelerometer(name), with_serial)
    table = triads.write_pose_campaign(
        folder / f"campaign {date}", values, u=NOISE, description=head
    )
    result = cs.calibrate(table, accept_misfit="made")
    cs.write_result(result, folder / f"{date}.json")
    return result


def write_results(folder, **options):
    generator = np.random.default_rng(11)
    values = triads.compute_indications(triads.draw_directions(24, generator))
    return [
        write_triad_result(
            folder, date, values + NOISE * generator.standard_normal(values.shape), **options
        )
        for date in DATES
    ]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["offset", "sensitivity", "angle"])
def test_history_of_nine_parameters_has_shared_defaults(tmp_path, kind):
    results = write_results(tmp_path)
    parameters = [name for name in results[0].triad.parameters if name.startswith(kind)]
    history = cs.history([tmp_path], term=kind)
    assert [instrument.serial_number for instrument in history.instruments] == (
        ["A B", "A C", "B C"] if kind == "angle" else ["A", "B", "C"]
    )
    assert history.unit == {"offset": "g", "sensitivity": "g/g", "angle": "rad"}[kind]
    for parameter, one in zip(parameters, history.instruments, strict=True):
        coefficients = [result.triad.parameters[parameter] for result in results]
        offset = 0.5 * math.pi if kind == "angle" else 0.0
        assert [point.value for point in one.points] == pytest.approx(
            [coefficient.value - offset for coefficient in coefficients]
        )
        # Directions differ with the noise of the poses, and with them the effect of K_0_asym and
        # slopes: by up to 0.5 %, in almost equal proportions (the square of 0.5 % is 2.5e-5).
        noise = np.array([coefficient.u_noise for coefficient in coefficients])
        common = np.array(
            [
                math.hypot(coefficient.u_stated, coefficient.u_unstated)
                for coefficient in coefficients
            ]
        )
        covariance = np.outer(common, common) + np.diag(noise**2)
        u_mean = 1.0 / math.sqrt(np.linalg.inv(covariance).sum())
        assert one.u_mean == pytest.approx(u_mean, rel=1e-4)
        u = np.sqrt(np.diag(covariance))
        correlation = covariance / np.outer(u, u) - np.eye(4)
        assert one.correlation == pytest.approx(correlation.max(), rel=1e-4)
        assert one.drift.u == pytest.approx(
            noise[0] / math.sqrt(5.0), rel=2e-3
        )  # years -1.5 to 1.5
        assert one.verdict == "constant"
    if kind == "angle":
        assert "angle minus 90 deg" in str(history)


def test_triad_results_share_terms_of_other_accelerometers(tmp_path):
    results = write_results(tmp_path)
    (instrument, *_) = cs.history([tmp_path], term="K_F").instruments
    bias = results[0].coefficient("X.K_F")
    common = math.hypot(bias.u_stated, bias.u_unstated)
    assert instrument.u_mean == pytest.approx(math.hypot(bias.u_noise / 2.0, common), rel=1e-3)
    assert any(line.source.startswith(("Y.", "Z.")) for line in results[0].triad.budget["offset.X"])


def test_budget_sensitivity_matches_change_of_parameter(tmp_path):
    directions = triads.draw_directions(24, np.random.default_rng(12))
    delta = 1e-5
    original = write_triad_result(tmp_path, DATES[0], triads.compute_indications(directions))
    shifted = write_triad_result(
        tmp_path, DATES[1], triads.compute_indications(directions, squares=(0.0, delta, 0.0))
    )
    for name, parameter in original.triad.parameters.items():
        lines = original.triad.budget[name]
        assert sum(line.contribution**2 for line in lines) == pytest.approx(parameter.u**2)
        slope = sum(line.sensitivity for line in lines if line.source == "Y.K_II")
        change = shifted.triad.parameters[name].value - parameter.value
        assert change == pytest.approx(-slope * delta, rel=1e-2, abs=1e-9)
    assert abs(original.triad.parameters["offset.Y"].value - triads.BIAS[1]) < 1e-6


def test_result_without_parameter_is_reported(tmp_path):
    write_triad_result(
        tmp_path,
        DATES[0],
        triads.compute_indications(triads.draw_directions(24, np.random.default_rng(3))),
    )
    result = cs.read_result(tmp_path / f"{DATES[0]}.json")
    without_triad = result.model_copy(update={"triad": None, "details": {"date": DATES[1]}})
    (unused_result, *_) = cs.history([tmp_path, without_triad], term="angle").left_out
    assert (unused_result.accelerometer, unused_result.reason) == ("X", "the result has no angle")
    with pytest.raises(CounterspinError, match="the result has no angle"):
        cs.history([without_triad], term="angle")


def test_angle_requires_both_serial_numbers_or_campaign_number(tmp_path):
    values = triads.compute_indications(triads.draw_directions(24, np.random.default_rng(3)))
    result = write_triad_result(tmp_path, DATES[0], values, serials=("A", "B", None))
    history = cs.history([tmp_path], term="angle")
    assert [instrument.serial_number for instrument in history.instruments] == ["A B"]
    assert {unused_result.accelerometer for unused_result in history.left_out} == {"X, Z", "Y, Z"}
    with_campaign_number = result.model_copy(
        update={"details": {**result.details, "serial_number": "S"}}
    )
    history = cs.history([with_campaign_number], term="angle")
    assert [instrument.serial_number for instrument in history.instruments] == [
        "A B",
        "S X Z",
        "S Y Z",
    ]

"""Operating tests from files: quantities of known instruments, errors, command and JSON."""

import numpy as np
import pytest

import counterspin as cs
from counterspin.errors import CampaignError, CounterspinError
from counterspin.operating_tests.result import OperatingTests

RAMP = np.concatenate([np.arange(0, 11, 2), np.arange(8, -11, -2), np.arange(-8, 1, 2)]).astype(
    float
)


def write_ramp(path, first, output, names=("input_g", "output_mA")):
    rows = zip(first.tolist(), output.tolist(), strict=True)
    path.write_text(
        ",".join(names) + "\n" + "".join(f"{a!r},{b!r}\n" for a, b in rows), encoding="utf-8"
    )
    return path


def evaluate_ramp(path, **more):
    return cs.operating(path, input="input_g", output="output_mA", output_unit="mA", **more)


def test_parabola_and_loop_have_exact_errors(tmp_path):
    """Of y = 1.25 x + 1e-4 x^2 and 2e-4 for each direction, with the line of least squares."""
    direction = np.sign(np.diff(RAMP, prepend=0.0))
    output = 1.25 * RAMP + 1e-4 * RAMP**2 + 2e-4 * direction
    result = evaluate_ramp(write_ramp(tmp_path / "r.csv", RAMP, output), full_scale=20.0)
    slope, intercept = np.polyfit(RAMP, output, 1)
    assert result.quantity("scale-factor").value == pytest.approx(slope, rel=1e-12)
    assert result.quantity("bias").value == pytest.approx(intercept / slope, rel=1e-9)
    residuals = output - np.polyval((slope, intercept), RAMP)
    means = [residuals[x == RAMP].mean() for x in np.unique(RAMP)]
    linearity = result.quantity("linearity-error")
    assert abs(linearity.value) == pytest.approx(np.abs(means).max() / slope, rel=1e-9)
    assert linearity.percent == pytest.approx(5.0 * linearity.value, rel=1e-12)
    loop = result.quantity("hysteresis-error")
    assert loop.value == pytest.approx(4e-4 / slope, rel=1e-9)


def test_u_covers_errors_of_noisy_ramps():
    """200 ramps: z rms of slope, bias and linearity error within 4 sqrt(1 / 400) = 0.2 of 1.

    Use exact values of linearity and bias: one input deviates by 0.1 and is always the worst.
    """
    from counterspin.operating_tests.model import fit_line, linearity_error

    rng, z, noise = np.random.default_rng(5), [], []
    inputs = np.tile(RAMP, 3)
    exact = 1.25 * inputs + np.where(inputs == 4.0, 0.1, 0.0)
    slope, intercept = np.polyfit(inputs, exact, 1)
    worst = (exact - np.polyval((slope, intercept), inputs))[inputs == 4.0].mean() / slope
    for _ in range(200):
        line = fit_line(inputs, exact + rng.normal(0.0, 1e-3, inputs.size))
        linearity = linearity_error(line, inputs)
        z.append(
            [
                (line.slope - slope) / line.u_slope,
                (line.intercept - intercept) / line.u_intercept,
                (linearity.value - worst) / linearity.u,
            ]
        )
        noise.append(line.noise)
    assert np.sqrt(np.mean(np.square(z), axis=0)) == pytest.approx(1.0, abs=0.2)
    assert np.mean(noise) == pytest.approx(1e-3, rel=0.02)


def test_u_of_hysteresis_loop_follows_from_two_means():
    """Three repeats upwards and three downwards: u = sigma sqrt(2 / 3) / slope; z of 200 loops."""
    from counterspin.operating_tests.model import fit_line, hysteresis_error

    rng, z = np.random.default_rng(7), []
    inputs = np.tile([0.0, 5.0, 10.0, 5.0], 3)
    line = fit_line(np.tile(RAMP, 3), np.tile(1.25 * RAMP, 3) + rng.normal(0.0, 1e-3, 63))
    for _ in range(200):
        loop = hysteresis_error(line, inputs, 1.25 * inputs + rng.normal(0.0, 1e-3, inputs.size))
        z.append(loop.value / (1e-3 * (2.0 / 3.0) ** 0.5 / 1.25))
    assert loop.u == pytest.approx(line.noise * (2.0 / 3.0) ** 0.5 / line.slope, rel=1e-12)
    assert np.sqrt(np.mean(np.square(z))) == pytest.approx(1.0, abs=0.2)


@pytest.mark.parametrize("band", [0.0, 1.5e-6])
def test_threshold_and_dead_band_lie_between_tested_steps(tmp_path, band):
    """The output does not follow inputs below 1.5 ug; 1, 2, 5 and 10 ug are tested."""
    sizes = np.array([1e-6, 2e-6, 5e-6, 1e-5])
    inputs = np.concatenate([[0.0, size, 0.0, -size] for size in sizes] + [[0.0, 1.0, 0.0]])
    output = np.where(np.abs(inputs) < band, 0.0, 1.25 * inputs)
    result = evaluate_ramp(write_ramp(tmp_path / "r.csv", inputs, output))
    threshold, dead = result.quantity("threshold"), result.quantity("dead-band")
    tried = (0.0, 1e-6) if band == 0.0 else (1e-6, 2e-6)
    assert threshold.value == pytest.approx(sum(tried) / 2)
    assert threshold.u == pytest.approx((tried[1] - tried[0]) / 12**0.5)
    assert dead.value == pytest.approx(sum(tried))
    assert dead.u == pytest.approx((tried[1] - tried[0]) / 6**0.5)


def test_warm_up_time_constant_is_unbiased(tmp_path):
    """30 records of noise: z of the time constant is unbiased, its rms 1 within 4 sqrt(1 / 60)."""
    from counterspin.operating_tests.model import fit_warm_up

    time, rng, z = np.arange(30.0, 3600.0, 30.0), np.random.default_rng(6), []
    exact = 5e-3 - 8e-4 * np.exp(-time / 600.0)
    for _ in range(30):
        fitted = fit_warm_up(time, exact + rng.normal(0.0, 2e-6, time.size))
        z.append((fitted.time_constant.value - 600.0) / fitted.time_constant.u)
    assert abs(np.mean(z)) < 4.0 / np.sqrt(30)
    assert abs(np.sqrt(np.mean(np.square(z))) - 1.0) < 4.0 / np.sqrt(60)
    path = write_ramp(tmp_path / "w.csv", time, exact, ("t_s", "out"))
    result = cs.operating(path, time="t_s", output="out")
    assert result.quantity("time-constant").value == pytest.approx(600.0, rel=1e-6)
    assert result.quantity("change").value == pytest.approx(-8e-4, rel=1e-6)


def test_quantity_without_data_is_not_determined(tmp_path):
    result = evaluate_ramp(
        write_ramp(tmp_path / "r.csv", np.arange(1.0, 6.0), 1.25 * np.arange(1.0, 6.0))
    )
    missing = {q.name: q.note for q in result.quantities if q.value is None}
    assert set(missing) == {"hysteresis-error", "threshold", "dead-band"}
    assert "from below and from above" in missing["hysteresis-error"]
    assert "not determined" in str(result)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({}, "give an input column, or a time column"),
        ({"input": "input_g", "time": "input_g"}, "give an input column, or a time column"),
        ({"input": "input_g", "full_scale": 0.0}, "greater than zero"),
        ({"input": "force"}, "no column 'force'"),
        ({"input": "output_mA"}, "was given for both columns"),
        ({"time": "input_g"}, "increasing times"),
    ],
)
def test_rejects_invalid_arguments(tmp_path, arguments, message):
    path = write_ramp(tmp_path / "r.csv", RAMP, 1.25 * RAMP)
    with pytest.raises(CounterspinError, match=message):
        cs.operating(path, output="output_mA", **arguments)


def test_rejects_single_input(tmp_path):
    path = write_ramp(tmp_path / "r.csv", np.ones(5), np.arange(5.0))
    with pytest.raises(CampaignError, match="three points at two or more inputs"):
        evaluate_ramp(path)


def test_result_round_trip(tmp_path):
    result = evaluate_ramp(write_ramp(tmp_path / "r.csv", RAMP, 1.25 * RAMP))
    result.write(tmp_path / "r.json")
    assert OperatingTests.read(tmp_path / "r.json").quantities == result.quantities


def test_many_settings_are_evaluated():
    """Each input is reached once upwards and once downwards, and the loop is 4e-4 wide."""
    from counterspin.operating_tests.model import fit_line, hysteresis_error

    rise = np.linspace(0.0, 10.0, 100_000)
    inputs = np.append(rise, rise[-2::-1])
    outputs = 1.25 * inputs
    outputs[: rise.size] += 5e-4
    loop = hysteresis_error(fit_line(inputs, outputs), inputs, outputs)
    assert loop.value == pytest.approx(4e-4, rel=1e-4)


@pytest.mark.parametrize(
    ("first", "output", "message"),
    [
        ([1.0, 2.0, 3.0, 4.0], [2.0, 2.0, 2.0, 2.0], "does not depend on the input"),
        ([0.0, 1.0, 0.0, 1.0, 0.0, 1.0], [1.0, 2.0, 2.0, 1.0, 1.5, 1.5], "does not depend"),
        ([1e200, -1e200, 5.0], [1.0, 2.0, 3.0], "larger than 1e\\+150"),
    ],
)
def test_rejects_columns_without_response(tmp_path, first, output, message):
    path = write_ramp(tmp_path / "r.csv", np.array(first), np.array(output))
    with pytest.raises(CampaignError, match=message):
        evaluate_ramp(path)


def test_rejects_constant_warm_up(tmp_path):
    path = write_ramp(tmp_path / "w.csv", np.arange(8.0), np.ones(8), ("t", "out"))
    with pytest.raises(CampaignError, match="does not change"):
        cs.operating(path, time="t", output="out")


def test_steps_far_below_full_scale_are_resolved(tmp_path):
    """A step of 1e-8 g with a ramp to 50 g is not a zero input."""
    inputs = np.array([0.0, 1e-8, 0.0, 2e-8, 0.0, 25.0, 50.0, 25.0, 0.0])
    output = np.where(inputs < 1.5e-8, 0.0, 1.25 * inputs)
    threshold = evaluate_ramp(write_ramp(tmp_path / "r.csv", inputs, output)).quantity("threshold")
    assert threshold.value == pytest.approx(1.5e-8)


def test_u_of_linearity_error_matches_hat_matrix():
    from counterspin.operating_tests.model import fit_line, linearity_error

    inputs = np.array([0.0, 1.0, 2.0, 2.0, 1.0, 0.0, 0.0])
    line = fit_line(inputs, np.array([0.0, 1.3, 2.0, 2.1, 1.4, 0.1, 0.05]))
    design = np.column_stack([np.ones(7), inputs])
    residual = np.eye(7) - design @ np.linalg.inv(design.T @ design) @ design.T
    linearity = linearity_error(line, inputs)
    mean = np.where(
        inputs == linearity.input_value, 1.0 / np.sum(inputs == linearity.input_value), 0.0
    )
    u = line.noise * np.sqrt(mean @ residual @ mean) / line.slope
    assert linearity.u == pytest.approx(u, rel=1e-12)

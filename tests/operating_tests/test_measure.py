"""Operating tests from files: quantities of known instruments, errors, command and JSON."""

import numpy as np
import pytest

import counterspin as cs
from counterspin.errors import CampaignError, CounterspinError
from counterspin.operating_tests.result import OperatingTests

RAMP = np.concatenate([np.arange(0, 11, 2), np.arange(8, -11, -2), np.arange(-8, 1, 2)]).astype(
    float
)


def write(path, first, output, names=("input_g", "output_mA")):
    rows = zip(first.tolist(), output.tolist(), strict=True)
    path.write_text(
        ",".join(names) + "\n" + "".join(f"{a!r},{b!r}\n" for a, b in rows), encoding="utf-8"
    )
    return path


def evaluated(path, **more):
    return cs.operating(path, input="input_g", output="output_mA", output_unit="mA", **more)


def test_a_parabola_and_a_loop_have_their_errors(tmp_path):
    """Of y = 1.25 x + 1e-4 x^2 and 2e-4 for each direction, with the line of least squares."""
    direction = np.sign(np.diff(RAMP, prepend=0.0))
    output = 1.25 * RAMP + 1e-4 * RAMP**2 + 2e-4 * direction
    result = evaluated(write(tmp_path / "r.csv", RAMP, output), full_scale=20.0)
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


def test_errors_of_noisy_ramps_are_covered_by_their_u():
    """200 ramps: z rms of slope, linearity error and hysteresis within 4 sqrt(1 / 400) of 1."""
    from counterspin.operating_tests.model import fit_line, hysteresis

    rng, z = np.random.default_rng(5), []
    inputs = np.tile(RAMP, 3)
    for _ in range(200):
        line = fit_line(inputs, 1.25 * inputs + rng.normal(0.0, 1e-3, inputs.size))
        loop = hysteresis(line, np.tile([0.0, 5.0, 10.0, 5.0], 10), rng.normal(0.0, 1e-3, 40))
        z.append([(line.slope - 1.25) / line.u_slope, line.noise / 1e-3, loop.value / loop.u])
    rms = np.sqrt(np.mean(np.square(z), axis=0))
    assert abs(rms[0] - 1.0) < 0.2
    assert abs(rms[1] - 1.0) < 0.05


@pytest.mark.parametrize("band", [0.0, 1.5e-6])
def test_a_dead_band_limits_threshold_and_resolution_lies_between_tried_steps(tmp_path, band):
    """The output does not follow inputs below 1.5 ug; 1, 2, 5 and 10 ug are tried."""
    sizes = np.array([1e-6, 2e-6, 5e-6, 1e-5])
    inputs = np.concatenate([[0.0, size, 0.0, -size] for size in sizes] + [[0.0, 1.0, 0.0]])
    output = np.where(np.abs(inputs) < band, 0.0, 1.25 * inputs)
    result = evaluated(write(tmp_path / "r.csv", inputs, output))
    threshold, dead = result.quantity("threshold"), result.quantity("dead-band")
    tried = (0.0, 1e-6) if band == 0.0 else (1e-6, 2e-6)
    assert threshold.value == pytest.approx(sum(tried) / 2)
    assert threshold.u == pytest.approx((tried[1] - tried[0]) / 12**0.5)
    assert dead.value == pytest.approx(sum(tried))
    assert dead.u == pytest.approx((tried[1] - tried[0]) / 6**0.5)


def test_a_warm_up_has_its_time_constant(tmp_path):
    """30 records of noise: z of the time constant is unbiased, its rms 1 within 4 sqrt(1 / 60)."""
    from counterspin.operating_tests.model import fit_warm_up

    time, rng, z = np.arange(30.0, 3600.0, 30.0), np.random.default_rng(6), []
    exact = 5e-3 - 8e-4 * np.exp(-time / 600.0)
    for _ in range(30):
        fitted = fit_warm_up(time, exact + rng.normal(0.0, 2e-6, time.size))
        z.append((fitted.time_constant.value - 600.0) / fitted.time_constant.u)
    assert abs(np.mean(z)) < 4.0 / np.sqrt(30)
    assert abs(np.sqrt(np.mean(np.square(z))) - 1.0) < 4.0 / np.sqrt(60)
    path = write(tmp_path / "w.csv", time, exact, ("t_s", "out"))
    result = cs.operating(path, time="t_s", output="out")
    assert result.quantity("time-constant").value == pytest.approx(600.0, rel=1e-6)
    assert result.quantity("change").value == pytest.approx(-8e-4, rel=1e-6)


def test_what_the_rows_do_not_show_is_not_determined(tmp_path):
    result = evaluated(write(tmp_path / "r.csv", np.arange(1.0, 6.0), 1.25 * np.arange(1.0, 6.0)))
    missing = {q.name: q.note for q in result.quantities if q.value is None}
    assert set(missing) == {"hysteresis-error", "threshold", "dead-band"}
    assert "upwards and downwards" in missing["hysteresis-error"]
    assert "not determined" in str(result)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({}, "name a column of inputs, or one of times"),
        ({"input": "input_g", "time": "input_g"}, "name a column of inputs, or one of times"),
        ({"input": "input_g", "full_scale": 0.0}, "greater than zero"),
        ({"input": "force"}, "no column 'force'"),
        ({"time": "input_g"}, "increasing times"),
    ],
)
def test_wrong_arguments_are_named(tmp_path, arguments, message):
    path = write(tmp_path / "r.csv", RAMP, 1.25 * RAMP)
    with pytest.raises(CounterspinError, match=message):
        cs.operating(path, output="output_mA", **arguments)


def test_one_input_is_no_line(tmp_path):
    path = write(tmp_path / "r.csv", np.ones(5), np.arange(5.0))
    with pytest.raises(CampaignError, match="three points at two inputs"):
        evaluated(path)


def test_the_file_of_a_result_is_read_again(tmp_path):
    result = evaluated(write(tmp_path / "r.csv", RAMP, 1.25 * RAMP))
    result.write(tmp_path / "r.json")
    assert OperatingTests.read(tmp_path / "r.json").quantities == result.quantities

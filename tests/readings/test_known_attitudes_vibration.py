"""Readings during vibration: means by closed forms, coefficients of simulated tests, errors."""

import csv
import math
from dataclasses import replace

import numpy as np
import pytest
from reading_campaigns import SITE, make_considered, make_model, make_readings
from reading_descriptions import ACCELEROMETER, format_site
from scipy.integrate import quad
from stations import Station, combine_stations

from counterspin import calibrate, simulate
from counterspin.errors import CampaignError
from counterspin.physics.accelerometer import Mounting
from counterspin.physics.station import mean_products
from counterspin.physics.terms import TERMS
from counterspin.readings.fit import solve_readings

UP = Mounting.from_axes([0.0, 0.0, 1.0], [1.0, 0.0, 0.0])
COEFFICIENTS = ("K_F", "K_I", "K_II", "K_III")
TRUTH = {"K_F": 0.002, "K_I": 1.001, "K_II": 2e-5, "K_III": 3e-6}
HEAD = format_site(gravity="9.8 m/s^2") + ACCELEROMETER
AMPLITUDES = (2.0, 5.0, 10.0, 15.0, 20.0)


def vibration_means(mounting=UP, amplitude=5.0, bias=0.0):
    """Return the mean products by symbol; amplitude and bias acceleration in g."""
    station = Station(
        "vibration",
        mounting,
        amplitude=amplitude * SITE.gravity,
        bias_acceleration=bias * SITE.gravity,
    )
    return dict(zip(TERMS, mean_products(combine_stations([station]), SITE)[0], strict=True))


@pytest.mark.parametrize(("amplitude", "bias"), [(5.0, 0.0), (0.7, 0.0), (3.0, -1.0), (20.0, 9.0)])
def test_means_match_closed_forms(amplitude, bias):
    """Of a0 + A sin wt, a0 being gravity along an upright input axis and the bias acceleration."""
    a0, square = 1.0 + bias, amplitude**2
    means = vibration_means(amplitude=amplitude, bias=bias)
    closed = {
        "K_F": 1.0,
        "K_I": a0,
        "K_II": a0**2 + square / 2,
        "K_III": a0**3 + 1.5 * a0 * square,
        "K_4": a0**4 + 3 * a0**2 * square + 3 / 8 * square**2,
        "K_5": a0**5 + 5 * a0**3 * square + 15 / 8 * a0 * square**2,
    }
    assert {symbol: means[symbol] for symbol in closed} == pytest.approx(closed, rel=1e-13)


@pytest.mark.parametrize("amplitude", [0.7, 3.0])
def test_means_of_kinked_products_match_quadrature(amplitude):
    means = vibration_means(amplitude=amplitude, bias=-0.5)

    def mean_over_cycle(function):
        start = math.asin(max(-1.0, -0.5 / amplitude))
        kinks = sorted((start % (2 * math.pi), (math.pi - start) % (2 * math.pi)))
        whole = quad(
            lambda angle: function(0.5 + amplitude * math.sin(angle)), 0, 2 * math.pi, points=kinks
        )
        return whole[0] / (2 * math.pi)

    assert means["K_OQ"] == pytest.approx(mean_over_cycle(lambda a: a * abs(a)), abs=1e-8)
    assert means["K_I_asym"] == pytest.approx(0.5 * mean_over_cycle(abs), abs=1e-8)


def test_vibration_acts_along_level_input_axis():
    """Gravity acts along the output axis, and the vibration along the input axis alone."""
    level = Mounting.from_axes([1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    means = vibration_means(level, amplitude=4.0)
    expected = {"K_I": 0.0, "K_II": 8.0, "K_OO": 1.0, "K_IO": 0.0, "delta_P": -1.0, "K_III": 0.0}
    assert {symbol: means[symbol] for symbol in expected} == pytest.approx(expected, abs=1e-12)


def vibration_runs(u_amplitude=0.0, reading="? ± 2e-6 mA"):
    """Return the runs of a test: at rest and at five amplitudes, input axis up and down."""
    text = ""
    for side in ("level", "180 deg about north"):
        text += (
            f'[[runs]]\nname = "rest {side}"\nmotion = "static"\nattitude = "{side}"\n'
            f'reading = "{reading}"\n'
        )
        for size in AMPLITUDES:
            stated = f"{size} ± {u_amplitude * size} g" if u_amplitude else f"{size} g"
            text += (
                f'[[runs]]\nname = "{size} g {side}"\nmotion = "vibration"\namplitude = "{stated}"'
                f'\nattitude = "{side}"\nreading = "{reading}"\n'
            )
    return text


TRUE = "[truth.A]\n" + "".join(
    f'{symbol} = "{value} {unit}"\n'
    for (symbol, value), unit in zip(TRUTH.items(), ("g", "g/g", "g/g^2", "g/g^3"), strict=True)
)
MODEL = '[model]\nterms = ["K_F", "K_I", "K_II", "K_III"]\nassume = "all"\n'


def test_coefficients_are_unbiased_and_have_coverage():
    """100 tests by closed forms, amplitudes with a common error of 0.5 % and random ones of 0.1 %.

    The mean of 100 z is within 4 / sqrt(100) of 0; their mean square within 4 sqrt(2 / 100) of 1.
    """
    down = Mounting.from_axes([0.0, 0.0, -1.0], [1.0, 0.0, 0.0])
    a0, sizes = (column.ravel() for column in np.meshgrid((1.0, -1.0), (0.0, 0.0, *AMPLITUDES)))
    stations = [
        Station("vibration", UP if side > 0.0 else down, amplitude=size * SITE.gravity)
        for side, size in zip(a0, sizes, strict=True)
    ]
    test = stations, [""] * len(stations), np.zeros((len(stations), 3))
    parameters = make_model(COEFFICIENTS, considered=[make_considered("vibration.amplitude", 5e-3)])
    rng, z = np.random.default_rng(3), []
    for _ in range(100):
        errors = rng.normal(0.0, 5e-3) + rng.normal(0.0, 1e-3, sizes.size)
        square = (sizes * (1.0 + errors)) ** 2
        columns = (1.0, a0, a0**2 + square / 2, a0**3 + 1.5 * a0 * square)
        value = sum(size * column for size, column in zip(TRUTH.values(), columns, strict=True))
        group = make_readings(test, value + rng.normal(0.0, 2e-6, sizes.size), 2e-6)
        group = replace(group, u_amplitude=np.full(sizes.size, 1e-3))
        solution = solve_readings([group], parameters).solution
        estimate = solution.estimate + np.array([0.0, 1.0, 0.0, 0.0])
        z.append((estimate - list(TRUTH.values())) / solution.u)
    z = np.array(z)
    assert np.abs(z.mean(axis=0)).max() < 4.0 / math.sqrt(100)
    assert np.abs((z**2).mean(axis=0) - 1.0).max() < 4.0 * math.sqrt(2.0 / 100)


def test_amplitude_error_of_1_percent_is_in_u_of_rectification(tmp_path):
    (tmp_path / "campaign.toml").write_text(
        HEAD
        + MODEL.replace('assume = "all"\n', "")
        + TRUE
        + '[truth.machine]\n"vibration.amplitude" = "0.01 1"\n'
        + vibration_runs(),
        encoding="utf-8",
    )
    simulate(tmp_path, tmp_path / "simulated")
    result = calibrate(tmp_path / "simulated")
    k_ii = result.accelerometers["A"].coefficients["K_II"]
    assert k_ii.value == pytest.approx(2e-5 * 1.01**2, abs=5e-7)
    assert abs(k_ii.value - 2e-5) < 3.0 * k_ii.u


def test_table_and_runs_return_same_result(tmp_path):
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs/campaign.toml").write_text(
        HEAD + MODEL + TRUE + vibration_runs(), encoding="utf-8"
    )
    simulate(tmp_path / "runs", tmp_path / "a")
    by_runs = calibrate(tmp_path / "a").accelerometers["A"]
    assert {r.amplitude for r in by_runs.readings} == {None, *(9.8 * size for size in AMPLITUDES)}
    with (tmp_path / "readings.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["kind", "angle", "peak", "mean", "u"])
        for r in by_runs.readings:
            up = r.input_axis[2] > 0.0
            peak = "" if r.amplitude is None else repr(r.amplitude)
            writer.writerow([r.motion, 0 if up else 180, peak, repr(1.25 * r.value), "2e-6"])
    (tmp_path / "campaign.toml").write_text(
        HEAD
        + MODEL
        + '[readings]\nfile = "readings.csv"\nabout = "north"\namplitude_unit = "m/s^2"\n'
        + 'columns = { motion = "kind", attitude = "angle", amplitude = "peak", reading = "mean", '
        + 'u = "u" }\n',
        encoding="utf-8",
    )
    by_table = calibrate(tmp_path).accelerometers["A"]
    for symbol in COEFFICIENTS:
        assert by_table.coefficients[symbol].value == pytest.approx(
            by_runs.coefficients[symbol].value, rel=1e-9
        )


@pytest.mark.parametrize(
    ("changed", "to", "message"),
    [
        ('amplitude = "5.0 g"\n', "", "amplitude: is missing"),
        ('amplitude = "5.0 g"', 'amplitude = "-5.0 g"', "must be greater than zero"),
        ('amplitude = "5.0 g"', 'amplitude = "5.0 mm"', "amplitude"),
        ('amplitude = "5.0 g"', 'amplitude = "5.0 g"\nrate = "1 rad/s"', "has no rotation"),
        ('motion = "vibration"', 'motion = "static"', 'write motion = "vibration"'),
        ('attitude = "level"\nreading', "reading", "requires a position"),
    ],
)
def test_invalid_run_raises_with_key(tmp_path, changed, to, message):
    right = vibration_runs(reading="0.1 ± 2e-6 mA")
    start = right.index('[[runs]]\nname = "5.0 g level"')
    wrong = right[:start] + right[start:].replace(changed, to, 1)
    assert wrong != right
    (tmp_path / "campaign.toml").write_text(HEAD + MODEL + wrong, encoding="utf-8")
    with pytest.raises(CampaignError, match=message):
        calibrate(tmp_path)

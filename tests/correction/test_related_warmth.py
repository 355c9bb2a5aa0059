"""Correction of records at temperatures other than that of the calibration."""

import math
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from raising import raises
from results import make_accelerometer_result as found_of
from results import make_bare_result

import counterspin as cs
from counterspin import cli
from counterspin.calibration.result_parts import Coefficient, Correlation, Knowledge
from counterspin.correction.apply import ApplyOptions, apply
from counterspin.errors import CampaignError
from counterspin.physics.accelerometer import QX, QY, Mounting, indicated
from counterspin.physics.correction import CalibratedAccelerometer, TemperatureOffset, correct
from counterspin.physics.terms import ACCELEROMETER_TERMS

G = 9.8066
REFERENCE = 20.0  # degC
MODEL = {"K_F": 0.005, "K_I": 1.002, "K_II": 2.7e-5, "K_III": 3e-6}
SLOPES = {
    "K_F.temperature": 3e-5,
    "K_F.temperature.2": -4e-7,
    "K_I.temperature": 1.5e-4,
    "K_I.temperature.3": 2e-9,
    "K_II.temperature": 5e-8,
}
FORCE = np.linspace(-15.0, 15.0, 31)
CELSIUS = np.linspace(-10.0, 60.0, 31)


def make_result(values, u=(), temperatures=(270.0, 340.0), reference=REFERENCE, **more):
    u = dict(u)
    own = {
        s: Coefficient(value=v, u=u.get(s, 0.0), unit=ACCELEROMETER_TERMS[s].unit, estimated=True)
        for s, v in values.items()
    }
    inputs = {"gravity": G, "latitude": 0.8, "radius": 2.5, "temperatures": list(temperatures)}
    inputs["reference_temperature"] = None if reference is None else reference + 273.15
    parts = {"coefficients": own, "axes": list(QX.axes), "observable": "displacement"}
    return make_bare_result(accelerometers={"A": found_of(**parts)}, inputs=inputs, **more)


def predict_indication(celsius, force=FORCE):
    """Return Eq. 7 with the coefficients at the temperature of each sample."""
    t = np.broadcast_to(np.asarray(celsius) - REFERENCE, force.shape)
    indications = []
    for warm, f in zip(t, force, strict=True):
        at = dict(MODEL)
        at["K_F"] += 3e-5 * warm - 4e-7 * warm**2
        at["K_I"] += 1.5e-4 * warm + 2e-9 * warm**3
        at["K_II"] += 5e-8 * warm
        indications.append(indicated(QX, at, np.array([[f, 0.0, 0.0]]))[0])
    return np.array(indications)


def test_slopes_use_temperature_of_each_row():
    y = predict_indication(CELSIUS)
    done = apply(make_result(MODEL | SLOPES), "A", y, ApplyOptions(temperature=CELSIUS))
    np.testing.assert_allclose(done.corrected, FORCE, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(done.u, 0.0)
    first_correction = apply(
        make_result(MODEL | SLOPES),
        "A",
        predict_indication(35.0),
        ApplyOptions(temperature="35 degC"),
    )
    np.testing.assert_allclose(first_correction.corrected, FORCE, rtol=0, atol=1e-12)
    kelvin = ApplyOptions(temperature="308.15 K")
    np.testing.assert_allclose(
        apply(make_result(MODEL | SLOPES), "A", predict_indication(35.0), kelvin).corrected,
        FORCE,
        atol=1e-12,
    )
    assert "are relative to 20 degC" in first_correction.notes[-1]


def test_slopes_have_no_effect_at_reference_temperature():
    plain = apply(make_result(MODEL, {"K_II": 1e-6}), "A", FORCE)
    warm = apply(
        make_result(MODEL | SLOPES, {"K_II": 1e-6}), "A", FORCE, ApplyOptions(temperature=REFERENCE)
    )
    np.testing.assert_allclose(warm.corrected, plain.corrected, rtol=1e-15)
    np.testing.assert_allclose(warm.u, plain.u, rtol=1e-12)


@pytest.mark.parametrize("power", [1, 2, 3])
def test_u_of_slope_and_temperature(power):
    """Of c t^n with c ± s and t ± u: (n c t^(n-1) u)^2 + s^2 E[t^(2n)], of a normal t."""
    symbol = "K_F.temperature" + (f".{power}" if power > 1 else "")
    c, s, t, u = 2e-5, 3e-6, 12.0, 1.5
    result = make_result({"K_F": 0.0, "K_I": 1.0, symbol: c}, {symbol: s})
    taken = ApplyOptions(temperature=f"{REFERENCE + t} ± {u} degC")
    moments = {1: t**2 + u**2, 2: t**4 + 6 * t**2 * u**2 + 3 * u**4}
    # Three nodes give the sixth moment except for 6 u^6 of 15.
    moments[3] = t**6 + 15 * t**4 * u**2 + 45 * t**2 * u**4 + 9 * u**6
    expected = math.sqrt((power * c * t ** (power - 1) * u) ** 2 + s**2 * moments[power])
    done = apply(result, "A", [0.5, -0.5], taken)
    np.testing.assert_allclose(done.u, expected, rtol=1e-12)
    # At the calibration temperature, u of the slope acts only through u of the temperature.
    there = ApplyOptions(temperature=f"{REFERENCE} ± {u} degC")
    at_reference = apply(result, "A", [0.5], there).u[0]
    assert at_reference >= s * u**power * 0.999


def test_correlation_of_slope_and_coefficient_is_included():
    result = make_result(
        {"K_F": 0.0, "K_F.temperature": 0.0}, {"K_F": 3e-6, "K_F.temperature": 1e-6}
    )
    own = result.accelerometers["A"].model_copy(
        update={
            "correlation": Correlation(
                terms=["K_F", "K_F.temperature"], matrix=[[1.0, -1.0], [-1.0, 1.0]]
            )
        }
    )
    result = result.model_copy(update={"accelerometers": {"A": own}})
    done = apply(result, "A", [0.1, 0.1], ApplyOptions(temperature=[REFERENCE + 3, REFERENCE + 4]))
    np.testing.assert_allclose(done.u, [0.0, 1e-6], rtol=1e-9, atol=1e-18)


def test_u_of_cross_coupled_accelerometers_matches_jacobian():
    """u against the numerical Jacobian of all coefficients, and of the temperature."""
    values = (
        {"K_F": 1e-3, "K_I": 1.001, "K_OO": 3e-3, "K_I.temperature": 2e-4},
        {"K_F": -2e-3, "K_I": 0.999, "K_OO": -2e-3, "K_F.temperature": 3e-5},
    )
    rng = np.random.default_rng(4)
    half = rng.standard_normal((8, 8)) * 1e-5
    whole = half @ half.T
    mountings = (
        Mounting(QX.axes),
        Mounting(QY.axes),
    )

    def make_instruments(shift):
        return [
            CalibratedAccelerometer(
                f"Q{k}",
                mounting,
                {s: v + shift[4 * k + i] for i, (s, v) in enumerate(own.items())},
                whole[4 * k : 4 * k + 4, 4 * k : 4 * k + 4],
            )
            for k, (mounting, own) in enumerate(zip(mountings, values, strict=True))
        ]

    y = np.array([[1.5, -0.7], [9.0, 4.0]])
    warm = np.array([7.0, -12.0])
    between = {(0, 1): whole[:4, 4:]}

    def compute_forces(shift, more=0.0):
        return correct(
            make_instruments(shift), y, (), between, TemperatureOffset(warm + more)
        ).force

    jacobian = []
    for place in range(8):
        step = np.zeros(8)
        step[place] = 1e-6
        jacobian.append((compute_forces(step) - compute_forces(-step)) / 2e-6)
    jacobian = np.array(jacobian)  # (8, n, m)
    exact = correct(make_instruments(np.zeros(8)), y, (), between, TemperatureOffset(warm))
    expected = np.sqrt(np.einsum("inm,ij,jnm->nm", jacobian, whole, jacobian))
    np.testing.assert_allclose(exact.u, expected, rtol=1e-6)
    by_warmth = (compute_forces(np.zeros(8), 1e-3) - compute_forces(np.zeros(8), -1e-3)) / 2e-3
    sure = [
        CalibratedAccelerometer(i.name, i.mounting, i.coefficients, np.zeros((4, 4)))
        for i in make_instruments(np.zeros(8))
    ]
    alone = correct(sure, y, (), {}, TemperatureOffset(warm, 0.3))
    np.testing.assert_allclose(alone.u, 0.3 * np.abs(by_warmth), rtol=1e-6)


def test_known_slopes_require_temperature():
    with pytest.raises(CampaignError) as refused:
        apply(make_result(MODEL | {"K_F.temperature": 3e-5}), "A", [1.0])
    (problem,) = refused.value.problems
    assert problem.startswith(
        "K_F.temperature of A changes with the temperature of the record; give"
    )
    with raises("missing-input"):
        apply(
            make_result(MODEL | SLOPES, reference=None),
            "A",
            [1.0],
            ApplyOptions(temperature="20 degC"),
        )
    with raises("invalid-value", "`temperature`", "'20 g'"):
        apply(make_result(MODEL | SLOPES), "A", [1.0], ApplyOptions(temperature="20 g"))


def test_default_slopes_are_in_u_where_temperature_is_known():
    unstated = [
        Knowledge(name=f"A.{s}", kind="unstated", unit=ACCELEROMETER_TERMS[s].unit, value=0.0, u=u)
        for s, u in (("K_F.temperature", 3e-5), ("K_I.temperature", 1e-4))
    ]
    result = make_result({"K_F": 0.0, "K_I": 1.0}, rests_on=unstated)
    there = apply(result, "A", [2.0], ApplyOptions(temperature=REFERENCE - 5.0))
    assert there.u == pytest.approx([5.0 * math.hypot(3e-5, 2e-4)], rel=1e-12)
    assert not there.warnings
    unknown = apply(result, "A", [2.0])
    assert unknown.u == pytest.approx([0.0])
    (warning,) = unknown.warnings
    assert (
        "no value is stated for K_F.temperature, K_I.temperature, and the temperature is not"
        in warning
    )


def test_half_of_hysteresis_of_unknown_sign_is_in_u():
    """h ± u with an unknown sign gives (h^2 + u^2)/4 in addition to the variance of K_F."""
    values, u = {"K_F": 1e-3, "K_I": 1.0, "K_F.hysteresis": 3e-5}, {"K_F": 2e-6}
    result = make_result(values, u | {"K_F.hysteresis": 4e-6})
    expected = math.sqrt(4e-12 + (9e-10 + 1.6e-11) / 4.0)
    done = apply(result, "A", [0.5])
    assert (done.corrected[0], done.u[0]) == pytest.approx((0.499, expected), rel=1e-9)
    assert not done.warnings
    row = {"kind": "unstated", "unit": "g", "value": 0.0, "u": 2e-5}
    unstated = [Knowledge(name="A.K_F.hysteresis", **row)]
    result = make_result({"K_F": 1e-3, "K_I": 1.0}, u, rests_on=unstated)
    assert apply(result, "A", [0.5]).u[0] == pytest.approx(math.hypot(2e-6, 1e-5), rel=1e-9)


def test_temperature_beyond_calibration_is_reported():
    calibration = make_result(MODEL | SLOPES, temperatures=(283.15, 303.15))
    inside = apply(calibration, "A", [1.0], ApplyOptions(temperature=30.9))
    assert not inside.warnings
    (warning,) = apply(
        calibration, "A", [1.0, 1.0], ApplyOptions(temperature=[25.0, 40.0])
    ).warnings
    assert warning.startswith(
        "The temperature is 25 to 40 degC, but the calibration temperature was 10 "
    )
    result = make_result(MODEL | {"K_F.trend": 1e-9, "K_F.heating": 1e-7})
    (warning,) = apply(result, "A", [1.0]).warnings
    assert "the correction does not apply K_F.trend, K_F.heating" in warning
    (note,) = apply(make_result(MODEL), "A", [1.0], ApplyOptions(temperature=25.0)).notes[1:]
    assert note == "The result contains no temperature slope, so the temperature has no effect."


# --- files ----------------------------------------------------------------------------------


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    cs.write_result(make_result(MODEL | SLOPES), tmp_path / "result.json")
    return tmp_path


def run(*words):
    return cli.main(["apply", "result.json", "in.csv", "-o", "out.csv", "--overwrite", *words])


def test_temperature_column_of_file_is_used(folder, capsys):
    y = predict_indication(CELSIUS)
    words = ["--accelerometer=A", "--input=y", "--temperature"]
    pl.DataFrame({"y": y, "degC": CELSIUS}).write_csv("in.csv")
    assert run(*words, "degC") == 0
    np.testing.assert_allclose(pl.read_csv("out.csv")["y_corrected"], FORCE, atol=1e-12)
    rows = "".join(f"{a},{b}\n" for a, b in zip(y, CELSIUS + 273.15, strict=True))
    Path("in.csv").write_text("y,T\ng,K\n" + rows, encoding="utf-8")
    assert run(*words, "T") == 0
    np.testing.assert_allclose(pl.read_csv("out.csv")["y_corrected"], FORCE, atol=1e-12)
    Path("in.csv").write_text("y,T\ng,V\n" + rows, encoding="utf-8")
    assert run(*words, "T") == 1
    assert "is in 'V' according to" in capsys.readouterr().err
    Path("in.csv").write_text("y,T\n1.0,20\n1.0,\n", encoding="utf-8")
    assert run(*words, "T") == 0
    assert pl.read_csv("out.csv")["y_corrected"].is_null().to_list() == [False, True]
    assert run("--accelerometer=A", "--input=y") == 2
    error = " ".join(capsys.readouterr().err.split())
    assert "of A change with the temperature of the record; give --temperature: a column" in error
    assert run(*words, "degC") == 2
    assert 'such as "23 degC"' in capsys.readouterr().err


# --- from a calibration ---------------------------------------------------------------------


def test_result_contains_calibration_temperatures():
    angles = np.deg2rad(np.arange(0.0, 360.0, 30.0))
    rng = np.random.default_rng(7)
    rows = [(a, t) for t in (10.0, 25.0, 40.0) for a in angles]
    frame = pl.DataFrame(
        {
            "deg": [math.degrees(a) for a, _ in rows],
            "g": [
                0.002 + 3e-5 * (t - 25) + (1.001 + 1e-4 * (t - 25)) * math.cos(a) for a, t in rows
            ]
            + 1e-6 * rng.standard_normal(len(rows)),
            "warm": [t for _, t in rows],
        }
    )
    slopes = ["K_F.temperature", "K_I.temperature"]
    described = {
        "site": {"gravity": f"{G} m/s^2", "latitude": "45 deg"},
        "centrifuge": {"radius": "1 m"},
        "records": {"time": {"column": "t", "unit": "s"}},
        "accelerometers": {"A": {"input_axis": "up", "pendulous_axis": "east"}},
        "model": {"terms": ["K_F", "K_I", *slopes], "assume": "all"},
        "readings": {
            "columns": {"attitude": "deg", "reading": "g", "temperature": "warm"},
        },
    }
    result = cs.calibrate(cs.make_campaign(described, readings=frame))
    assert result.inputs.reference_temperature == pytest.approx(298.15)
    assert result.inputs.temperatures == pytest.approx([283.15, 313.15])
    # 3 g cos(60 deg) at 35 degC, 10 K above the reference.
    y = 0.002 + 3e-4 + (1.001 + 1e-3) * 0.5
    done = apply(result, "A", [y], ApplyOptions(temperature=35.0))
    assert abs(done.corrected[0] - 0.5) < 4 * done.u[0]
    assert 1e-7 < done.u[0] < 1e-6
    described["centrifuge"]["reference_temperature"] = "20 degC"
    moved = cs.calibrate(cs.make_campaign(described, readings=frame))
    again = apply(moved, "A", [y], ApplyOptions(temperature=35.0))
    # The reference temperature of the slopes does not change the corrected values.
    assert again.corrected == pytest.approx(done.corrected, abs=1e-10)
    assert again.u == pytest.approx(done.u, rel=1e-4)

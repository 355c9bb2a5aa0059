"""Forecasts: a campaign of records and readings is foretold as it is calibrated."""

import numpy as np
import pytest
from campaigns import PLACE, SMALL, format_runs, replace_parts, write_description
from mixed_campaign import MixedCampaign

import triads
from counterspin.calibration.calibrate import calibrate
from counterspin.errors import CampaignError
from counterspin.planning.forecast import forecast
from counterspin.simulation.simulate import simulate


def test_forecast_matches_calibration_of_mixed_campaign(tmp_path):
    """Records on a double turntable, readings on an arm and at rest: every u, and the budget's."""
    mixed = MixedCampaign(tmp_path)
    result = mixed.calibrated()
    folder = tmp_path / "all"
    text = (folder / "campaign.toml").read_text(encoding="utf-8")
    planned = text.replace('record = "run', 'revolutions = 20\nrecord = "run')
    (folder / "campaign.toml").write_text(planned, encoding="utf-8")
    prediction = forecast(folder, sampling_rate=10.0)
    for symbol, c in result.accelerometers["A"].coefficients.items():
        # Records are reduced to block means and know their own rotation; a forecast samples.
        assert c.u == pytest.approx(prediction.u[f"A.{symbol}"], rel=5e-3)


def test_forecast_matches_calibration_of_poses(tmp_path):
    values = triads.compute_indications(triads.draw_directions(15, np.random.default_rng(1)))
    folder = triads.write_pose_campaign(tmp_path, values, u=1e-4)
    prediction, result = forecast(folder), calibrate(folder)
    # A forecast takes derivatives at nominal coefficients: these are off by a percent or less.
    for name in ("X.K_F", "Y.K_I", "Z.delta_O"):
        assert prediction.u[name] == pytest.approx(result.coefficient(name).u, rel=0.05)
    with pytest.raises(CampaignError, match="requires the standard uncertainty"):
        forecast(triads.write_pose_campaign(tmp_path / "unstated", values))


def test_encoder_noise_acts_through_estimated_k_iii(tmp_path):
    """Two rates nearly the same, and time stamps that hide the ripple: u(K_II) rests on K_III.

    Expecting none, a forecast is right of a calibration that finds none; expecting what one has
    found, it is right of that one.
    """
    noise = 'displacement = "0.01 m"\ntiming = "200 us"\nangle = "1e-6 rad"\n'
    text = f"""{PLACE}
[accelerometers.Qx]
input_axis = "east"
pendulous_axis = "down"
displacement = {{ column = "east_m", unit = "m" }}

[noise]
{noise}acceleration = "0 g/Hz^0.5"

[model]
terms = ["K_F", "K_I", "K_II", "K_III"]
assume = "all"
{format_runs("slow", "fast", rates=("0.9 rev/s", "1 rev/s"))}
[simulation]
sampling_rate = "16 Hz"
revolutions = 25
seed = 2

[truth.Qx]
K_F = "0.005 g"
K_III = "0 g/g^3"

[truth.noise]
{noise}"""
    simulate(write_description(tmp_path / "true", text), tmp_path / "records")
    result = calibrate(tmp_path / "records")
    prediction = forecast(write_description(tmp_path / "true", text))
    actual_text = f"{result.coefficient('Qx.K_III').value!r} g/g^3"
    again = forecast(
        write_description(tmp_path / "found", replace_parts(text, ("0 g/g^3", actual_text)))
    )
    u = result.coefficient("Qx.K_II").u
    assert u > 1.5 * prediction.u["Qx.K_II"]
    assert u == pytest.approx(again.u["Qx.K_II"], rel=0.05)


MODELS = {"perfect": 'assume = "all"\nterms = ["K_F", "K_I", "K_II"]\n', "nothing assumed": ""}


@pytest.mark.parametrize("timing", ["0 s", "1 ms"])
@pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
def test_forecast_matches_calibration_of_records(model, timing, tmp_path):
    """With noise of the time stamps too: of outputs it goes with their slope, and of angles too.

    A ripple that the angles do not show does to K_II what K_III is. So K_III is in the model only
    where K_II rests on something else.
    """
    noise = f'displacement = "0.01 m"\ntiming = "{timing}"\n'
    text = replace_parts(
        SMALL,
        ('[noise]\ndisplacement = "0.01 m"\n', f"[noise]\n{noise}"),
        ('[truth.noise]\ndisplacement = "0.01 m"\n', f"[truth.noise]\n{noise}"),
        ('assume = "all"\n', model),
        ('scale_factor = "1.002 g/g"', 'scale_factor = "1.002 ± 1e-4 g/g"'),
        ('scale_factor = "0.999 g/g"', 'scale_factor = "0.999 ± 1e-4 g/g"'),
        ('K_III = "3e-6 g/g^3"\n', ""),
    )
    simulate(write_description(tmp_path, text), tmp_path / "simulated")
    u = forecast(tmp_path / "simulated").u
    for name, accelerometer in calibrate(tmp_path / "simulated").accelerometers.items():
        for symbol, c in accelerometer.coefficients.items():
            if c.estimated:
                assert c.u == pytest.approx(u[f"{name}.{symbol}"], rel=0.01)


def test_forecast_does_not_depend_on_velocity_feedback(tmp_path):
    """What it took off is put back, noise included: a forecast, or a study, need not know of it."""
    walk = 'acceleration = "1e-5 g/Hz^0.5"\n'
    calibrated, predicted = [], []
    for reference in ("platform", "own velocity"):
        folder = tmp_path / reference
        text = replace_parts(
            SMALL,
            ("[records]\n", f'[records]\nreference = "{reference}"\n'),
            ("[noise]\n", f"[noise]\n{walk}"),
            ("[truth.noise]\n", f"[truth.noise]\n{walk}"),
        )
        simulate(write_description(folder, text), folder)
        calibrated.append(calibrate(folder))
        predicted.append(forecast(folder).u)
    assert predicted[0] == predicted[1]
    given, own = (result.accelerometers for result in calibrated)
    for name, accelerometer in given.items():
        for symbol in ("K_F", "K_II", "K_III"):
            c, other = accelerometer.coefficients[symbol], own[name].coefficients[symbol]
            assert other.value != c.value
            assert other.value == pytest.approx(c.value, abs=0.01 * c.u)
            assert other.u == pytest.approx(predicted[1][f"{name}.{symbol}"], rel=5e-3)


def test_forecast_repr_has_line_per_coefficient(tmp_path):
    prediction = forecast(write_description(tmp_path, SMALL))
    head, *lines = repr(prediction).splitlines()
    assert head == f"Forecast of {prediction.campaign.title}"
    names = [unknown.name for unknown in prediction.fit.model.of_interest]
    assert [line.split()[0] for line in lines] == names
    shown = dict(line.split(maxsplit=1) for line in lines)
    value, unit = shown["Qx.K_II"].removeprefix("u = ").split()
    assert unit == "ug/g^2"
    assert float(value) == pytest.approx(1e6 * prediction.u["Qx.K_II"], rel=0.05)


def test_readings_without_uncertainty_are_named_in_one_message(tmp_path):
    text = """schema = 1
[site]
gravity = "9.8066 m/s^2"
latitude = "45.75 deg"
[accelerometers.A]
input_axis = "up"
pendulous_axis = "east"
[readings]
file = "readings.csv"
columns = { reading = "g", attitude = "deg" }
motion = "static"
about = "north"
attitude_unit = "deg"
"""
    rows = [f"{angle},{np.cos(np.radians(angle)):.6f}" for angle in range(0, 360, 60)]
    (tmp_path / "readings.csv").write_text("\n".join(["deg,g", *rows]), encoding="utf-8")
    with pytest.raises(CampaignError) as caught:
        forecast(write_description(tmp_path, text))
    (problem,) = caught.value.problems
    assert problem.startswith("a prediction requires the standard uncertainty of each reading;")
    assert problem.endswith('("reading 1", "reading 2", "reading 3" and 3 more)')

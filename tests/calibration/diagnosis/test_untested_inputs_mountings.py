"""A wrong pendulous axis is named if the records reveal it; otherwise a remark warns of it."""

import re
from types import SimpleNamespace

import mixed_campaign
import numpy as np
import pytest
import reading_campaigns
from campaigns import PLACE, format_runs, replace_parts, write_and_read_campaign, write_description
from reading_descriptions import format_rest_run

from counterspin.calibration.calibrate import calibrate
from counterspin.calibration.diagnosis.untested_inputs import (
    AlternativeMounting,
    find_better_mounting,
    undetermined_axis_remarks,
)
from counterspin.simulation.simulate import simulate

UNITS = {"displacement": ("m", "0.01 m"), "specific_force": ("m/s^2", "1e-4 m/s^2")}
STATED = """K_OO = "2e-6 ± 1e-8 g/g^2"
K_IO = "3e-6 ± 1e-8 g/g^2"
"""


def describe(observable, known=STATED):
    unit, noise = UNITS[observable]
    return f"""{PLACE}
[accelerometers.Qx]
input_axis = "east"
pendulous_axis = "down"
bias = "0.005 ± 2e-6 g"
scale_factor = "1.002 ± 1e-5 g/g"
{known}{observable} = {{ column = "east", unit = "{unit}" }}

[noise]
{observable} = "{noise}"

[model]
assume = "all"

{format_runs("slow", "middle", "fast")}
[simulation]
sampling_rate = "20 Hz"
seed = 5
revolutions = 20

[truth.Qx]
K_F = "0.005 g"
K_I = "1.002 g/g"
K_II = "2.7e-5 g/g^2"
K_OO = "2e-6 g/g^2"
K_IO = "3e-6 g/g^2"
"""


@pytest.fixture(scope="module", params=UNITS)
def recorded_campaign(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp(request.param)
    simulate(write_and_read_campaign(folder / "true", describe(request.param)), folder / "made")
    return request.param, folder / "made"


def calibrate_axis(recorded_campaign, axis, known=STATED):
    observable, folder = recorded_campaign
    text = replace_parts(describe(observable, known), ('"down"', f'"{axis}"'))
    return calibrate(write_description(folder, text).parent)


def mounting_remarks(result):
    return [
        text
        for text in result.warnings
        if "do not determine the direction of the pendulous axis" in text
    ]


def test_correct_axis_is_good(recorded_campaign):
    result = calibrate_axis(recorded_campaign, "down")
    assert (result.state, result.findings) == ("good", [])
    if recorded_campaign[0] == "specific_force":
        assert mounting_remarks(result) == []
        return
    # In displacement K_OO has the t^2 of K_II: only the description defines the axis.
    (text,) = mounting_remarks(result)
    assert re.search(
        r"With (north|south) instead of down, the records would fit equally well, but K_II would "
        r"be 2 ug/g\^2 larger",
        text,
    )


@pytest.mark.parametrize("axis", ["north", "up", "south"])
def test_wrong_axis_is_named_if_detectable(recorded_campaign, axis):
    result = calibrate_axis(recorded_campaign, axis)
    first = result.findings[0] if result.findings else None
    k_ii = result.accelerometers["Qx"].coefficients["K_II"]
    if recorded_campaign[0] == "specific_force":
        assert (first.code, first.subject) == ("wrong-mounting", "Qx")
        assert f"pointed down instead of the stated {axis}" in first.text
        assert [finding for finding in result.findings if finding.code == "wrong-mounting"] == [
            first
        ]
    elif axis != "up":
        # The error is about 298 u and the records do not reveal it: a remark states the dependence.
        assert abs(k_ii.value - 2.7e-5) > 30.0 * k_ii.u
        assert (
            "stated values of K_IO and K_OO depend on this direction" in mounting_remarks(result)[0]
        )


def test_wrong_axis_is_named_with_estimated_noise_and_default_priors(tmp_path):
    """The full fit has more unknowns than the fit that estimates the noise."""
    text = describe("specific_force").replace("2e-6", "4e-5").replace("3e-6", "6e-5")
    simulate(write_and_read_campaign(tmp_path / "true", text), tmp_path / "made")
    own = ('[noise]\nspecific_force = "1e-4 m/s^2"\n', ""), ('[model]\nassume = "all"\n', "")
    result = calibrate(
        write_description(
            tmp_path / "made", replace_parts(text, *own, ('"down"', '"north"'))
        ).parent
    )
    first = result.findings[0]
    assert (first.code, first.subject) == ("wrong-mounting", "Qx")
    assert "pointed down instead of the stated north" in first.text


def test_no_remark_without_stated_cross_axis_terms(recorded_campaign):
    assert mounting_remarks(calibrate_axis(recorded_campaign, "down", known="")) == []


def test_readings_and_records_jointly_reveal_wrong_axis(tmp_path, monkeypatch):
    """delta_O = -1 mrad with the pendulous axis down equals 1 mrad with the axis up."""
    monkeypatch.setitem(mixed_campaign.TRUTH, "delta_O", 1e-3)
    true = ('K_F = "2e-3 g"', 'K_F = "2e-3 g"\ndelta_O = "1e-3 rad"')
    monkeypatch.setattr(
        mixed_campaign, "SIMULATION", replace_parts(mixed_campaign.SIMULATION, true)
    )
    campaign = mixed_campaign.MixedCampaign(tmp_path)
    model = replace_parts(mixed_campaign.MODEL, ('"K_III", "delta_O"', '"K_III"'))

    def describe_delta_o(value):
        return campaign.calibrated(model=f'{model}"delta_O" = "{value} ± 1e-6 rad"\n')

    right, wrong = describe_delta_o("1e-3"), describe_delta_o("-1e-3")
    assert (right.state, right.findings) == ("good", [])
    first = wrong.findings[0]
    assert (first.code, first.subject, wrong.state) == ("wrong-mounting", "A", "contradicted")
    assert "pointed up instead of the stated down" in first.text
    assert (
        "the sense of rotation of the attitudes, and the axes of the stated delta_O" in first.text
    )
    # All findings are grouped under their cause.
    assert wrong.findings == [first]
    explained = {finding.code for finding in first.explains}
    assert {"lack-of-fit", "run-disagrees"} <= explained


def test_readings_with_and_without_uncertainty_are_separate_groups(tmp_path):
    """In the trial fit both groups have an uncertainty; only the first determines the bias."""
    text = """schema = 1
site = { gravity = "9.80665 m/s^2", latitude = "0.8 rad" }
[accelerometers.A]
input_axis = "east"
pendulous_axis = "up"
bias = "2.1e-3 ± 1e-6 g"
output = { unit = "mA", sensitivity = "1.25 mA/g" }
[model]
assume = "all"
terms = ["K_F", "K_I", "delta_O", "K_IP"]
[model.priors]
delta_O = "1e-3 ± 1e-6 rad"
K_IP = "1e-4 ± 1e-6 g/g^2"
"""
    truth = reading_campaigns.TRUTH | {"delta_O": 1e-3, "K_IP": 1e-4, "K_II": 0.0, "K_III": 0.0}
    stations, sides, head = mixed_campaign.make_tumble()
    again = [stations[3]] * 6, sides[:6], head[:6]
    rng = np.random.default_rng(5)
    for turns, test, u in (
        (range(12), (stations, sides, head), " ± 2.5e-6"),
        ([3] * 6, again, ""),
    ):
        read = reading_campaigns.simulate_readings(test, rng, 2e-6, truth=truth).tolist()
        for turn, value in zip(turns, read, strict=True):
            name = f"{30 * turn} deg about north"
            text += format_rest_run(f"{len(text)}", name, f"{1.25 * value!r}{u} mA")
    result = calibrate(write_description(tmp_path, text).parent)
    finding_keys = {(finding.code, finding.subject) for finding in result.findings}
    assert finding_keys == {("wrong-mounting", "A"), ("prior-conflict", "A.K_F")}


def make_mounting(gain, dof):
    """Return a mounting with a gain and a noise with `dof` degrees of freedom."""
    return AlternativeMounting(view=None, quarter_turns=2, fit=None, gain=gain, dof=dof)


@pytest.mark.parametrize(
    ("gain", "dof", "blamed"),
    [
        # A level of 1/1200 for each of three: 3.14 standard deviations of a normal distribution,
        # or 11 of Student's t distribution with 3 degrees of freedom.
        (3.1**2, None, False),
        (3.2**2, None, True),
        (10.0**2, 3.0, False),
        (12.0**2, 3.0, True),
        (-5.0, None, False),
    ],
)
def test_better_mounting_requires_significant_gain(gain, dof, blamed):
    others = [make_mounting(gain, dof), make_mounting(-40.0, dof), make_mounting(-50.0, dof)]
    assert (find_better_mounting(others) is others[0]) == blamed


def test_no_better_mounting_without_alternatives():
    assert find_better_mounting([]) is None


def test_equivalent_quarter_turns_are_ordered_independently_of_rounding():
    """Both quarter turns change K_II equally if no record determines the cross axes."""

    def make_candidate(quarters, found, size):
        model = SimpleNamespace(priors={"K_PP": (0.0, 1e-6)})
        view = SimpleNamespace(
            name="A",
            accelerometer=SimpleNamespace(priors={}),
            campaign=SimpleNamespace(model=model),
        )
        moved = "K_II", 1e-6, size
        return SimpleNamespace(
            view=view,
            gain=0.0,
            pendulous_directions=("down", found),
            largest_shift=lambda: moved,
            quarter_turns=quarters,
        )

    for more, less in ((1.3, 1.3 - 1e-13), (1.3 - 1e-13, 1.3)):
        (text,) = undetermined_axis_remarks(
            [make_candidate(1, "north", more), make_candidate(3, "south", less)]
        )
        assert "With north instead of down" in text

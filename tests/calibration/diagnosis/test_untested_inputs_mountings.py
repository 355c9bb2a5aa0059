"""A pendulous axis that is stated wrongly is named where the records show it, else remarked on."""

import re
from types import SimpleNamespace

import mixed_campaign
import numpy as np
import pytest
import reading_campaigns
from campaigns import PLACE, campaign_of, changed, runs, write
from reading_descriptions import at_rest

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


def described(observable, known=STATED):
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

{runs("slow", "middle", "fast")}
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
def recorded(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp(request.param)
    simulate(campaign_of(folder / "true", described(request.param)), folder / "made")
    return request.param, folder / "made"


def calibrated(recorded, axis, known=STATED):
    observable, folder = recorded
    text = changed(described(observable, known), ('"down"', f'"{axis}"'))
    return calibrate(write(folder, text).parent)


def remarks(result):
    return [
        text
        for text in result.warnings
        if "do not determine the direction of the pendulous axis" in text
    ]


def test_the_right_axis_is_good(recorded):
    result = calibrated(recorded, "down")
    assert (result.state, result.findings) == ("good", [])
    if recorded[0] == "specific_force":
        assert remarks(result) == []
        return
    # In displacement K_OO has the t^2 of K_II: only the description knows which way it lies.
    (text,) = remarks(result)
    assert re.search(
        r"With (north|south) instead of down, the records would fit equally well, and K_II would "
        r"be 2 ug/g\^2 larger",
        text,
    )


@pytest.mark.parametrize("axis", ["north", "up", "south"])
def test_a_wrong_axis_is_named_where_the_records_show_it(recorded, axis):
    result = calibrated(recorded, axis)
    first = result.findings[0] if result.findings else None
    k_ii = result.accelerometers["Qx"].coefficients["K_II"]
    if recorded[0] == "specific_force":
        assert (first.code, first.subject) == ("wrong-mounting", "Qx")
        assert f"pointed down instead of the stated {axis}" in first.text
        assert [finding for finding in result.findings if finding.code == "wrong-mounting"] == [
            first
        ]
    elif axis != "up":
        # 298 u off or so, and nothing in the records to tell it by: it is said what it rests on.
        assert abs(k_ii.value - 2.7e-5) > 30.0 * k_ii.u
        assert "stated values of K_IO and K_OO depend on this direction" in remarks(result)[0]


def test_a_wrong_axis_is_named_beside_noise_that_is_found_and_terms_that_nobody_states(tmp_path):
    """The whole fit has more unknowns than the one in which the noise was found."""
    text = described("specific_force").replace("2e-6", "4e-5").replace("3e-6", "6e-5")
    simulate(campaign_of(tmp_path / "true", text), tmp_path / "made")
    own = ('[noise]\nspecific_force = "1e-4 m/s^2"\n', ""), ('[model]\nassume = "all"\n', "")
    result = calibrate(write(tmp_path / "made", changed(text, *own, ('"down"', '"north"'))).parent)
    first = result.findings[0]
    assert (first.code, first.subject) == ("wrong-mounting", "Qx")
    assert "pointed down instead of the stated north" in first.text


def test_where_nothing_is_stated_nothing_rests_on_it(recorded):
    assert remarks(calibrated(recorded, "down", known="")) == []


def test_readings_and_records_tell_it_together(tmp_path, monkeypatch):
    """A delta_O of -1 mrad with a pendulous axis down is one of 1 mrad with the axis up."""
    monkeypatch.setitem(mixed_campaign.TRUTH, "delta_O", 1e-3)
    true = ('K_F = "2e-3 g"', 'K_F = "2e-3 g"\ndelta_O = "1e-3 rad"')
    monkeypatch.setattr(mixed_campaign, "TRUE", changed(mixed_campaign.TRUE, true))
    campaign = mixed_campaign.MixedCampaign(tmp_path)
    model = changed(mixed_campaign.MODEL, ('"K_III", "delta_O"', '"K_III"'))

    def stating(value):
        return campaign.calibrated(model=f'{model}"delta_O" = "{value} ± 1e-6 rad"\n')

    right, wrong = stating("1e-3"), stating("-1e-3")
    assert (right.state, right.findings) == ("good", [])
    first = wrong.findings[0]
    assert (first.code, first.subject, wrong.state) == ("wrong-mounting", "A", "contradicted")
    assert "pointed up instead of the stated down" in first.text
    assert (
        "the sense of rotation of the attitudes, and the axes of the stated delta_O" in first.text
    )
    # All that was found is below its cause.
    assert wrong.findings == [first]
    explained = {finding.code for finding in first.explains}
    assert {"lack-of-fit", "run-disagrees"} <= explained


def test_readings_with_and_without_uncertainty_stay_two_groups(tmp_path):
    """In the trial both have an uncertainty, and one name; only the first ones tell the bias."""
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
    stations, sides, head = mixed_campaign.tumble()
    again = [stations[3]] * 6, sides[:6], head[:6]
    rng = np.random.default_rng(5)
    for turns, test, u in (
        (range(12), (stations, sides, head), " ± 2.5e-6"),
        ([3] * 6, again, ""),
    ):
        read = reading_campaigns.simulated(test, rng, 2e-6, truth=truth).tolist()
        for turn, value in zip(turns, read, strict=True):
            name = f"{30 * turn} deg about north"
            text += at_rest(f"{len(text)}", name, f"{1.25 * value!r}{u} mA")
    result = calibrate(write(tmp_path, text).parent)
    found = {(finding.code, finding.subject) for finding in result.findings}
    assert found == {("wrong-mounting", "A"), ("prior-conflict", "A.K_F")}


def other(gain, dof):
    """Return a mounting that is better by a gain, with a noise of so many degrees of freedom."""
    return AlternativeMounting(view=None, quarter_turns=2, fit=None, gain=gain, dof=dof)


@pytest.mark.parametrize(
    ("gain", "dof", "blamed"),
    [
        # One in 1200 for each of three: 3.14 standard deviations of the normal distribution, and
        # 11 of Student's with 3 degrees of freedom.
        (3.1**2, None, False),
        (3.2**2, None, True),
        (10.0**2, 3.0, False),
        (12.0**2, 3.0, True),
        (-5.0, None, False),
    ],
)
def test_a_better_mounting_is_one_beyond_chance(gain, dof, blamed):
    others = [other(gain, dof), other(-40.0, dof), other(-50.0, dof)]
    assert (find_better_mounting(others) is others[0]) == blamed


def test_without_other_mountings_none_is_better():
    assert find_better_mounting([]) is None


def test_rounding_does_not_choose_between_turns_that_do_the_same():
    """A quarter turn either way moves K_II alike where no record shows what is across."""

    def after(quarters, found, size):
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
        (text,) = undetermined_axis_remarks([after(1, "north", more), after(3, "south", less)])
        assert "With north instead of down" in text

"""Accelerometer cards: value, interval, shares of the variance and quality checks."""

import pytest
from results import make_coefficient, make_qx_result

from counterspin.calibration.findings import judge_result
from counterspin.calibration.pages.card import accelerometer_card

#: Residuals eight times as large as the stated noise.
MISFIT = {"rms": 0.08, "unit": "m", "dof": 100.0, "chi2": 6400.0, "lack_of_fit_p": 0.0}


def make_card(**changes):
    judged = judge_result(make_qx_result(**changes))
    return accelerometer_card("Qx", judged.accelerometers["Qx"], ())


def check_outcomes(result):
    return {check.title: check.outcome for check in result.checks}


def test_card_of_good_result():
    card = make_card()
    assert (card.state, card.symbol, card.value, card.unit) == (
        "good",
        "K_II",
        "27.0000 ± 0.0010",
        "ug/g^2",
    )
    # Student's t for 50 degrees of freedom: 2.0086.
    assert card.remarks == (
        "= (2.70000 ± 0.00010) x 1e-5 g/g^2",
        "95 % interval: 26.9980 to 27.0020 ug/g^2",
        "U = 0.0020 ug/g^2, k = 2.01",
    )
    assert check_outcomes(card) == {"Fit": "passed", "Runs": "passed", "Method": "passed"}
    assert card.detail == "serial number Q-104, input axis east, pendulous axis down"


def test_shares_of_bar_sum_to_one():
    card = make_card()
    assert sum(share.fraction for share in card.shares) == pytest.approx(1.0, abs=1e-9)
    assert card.shares[0].label == "noise of Qx 64 %"


def test_contradicted_result_has_no_interval():
    card = make_card(residual=MISFIT)
    assert card.state == "contradicted"
    assert card.remarks == ()
    assert check_outcomes(card)["Fit"] == "failed"
    assert card.note.startswith("The residuals are 8")


def test_interval_requires_a_degree_of_freedom():
    coefficients = {"K_II": make_coefficient(2.7e-5, 1e-9, "g/g^2") | {"dof": 0.1}}
    card = make_card(coefficients=coefficients)
    assert card.value == "27.0000 ± 0.0010"
    assert card.remarks[1:] == ("no 95 % interval: less than one degree of freedom remains",)


def test_missing_check_is_open():
    card = make_card(jackknife=[], two_stage=None)
    assert check_outcomes(card) == {"Fit": "passed", "Runs": "open", "Method": "open"}


def test_influential_run_fails_check():
    card = make_card(jackknife=[{"run": "slow", "value": 1e-5, "shift": 1e-8, "z": -7.0}])
    assert check_outcomes(card)["Runs"] == "failed"
    assert "from omitting slow" in next(c.text for c in card.checks if c.title == "Runs")


def test_undetermined_coefficient_has_no_value():
    undetermined = make_coefficient(0.0, 1e-5, "g/g^2", estimated=False)
    card = make_card(coefficients={"K_II": undetermined})
    assert card.value == ""
    assert card.remarks == card.shares == ()


def test_card_without_k_ii_has_first_coefficient():
    assert make_card(coefficients={"K_I": make_coefficient(0.0, 1e-6, "g/g")}).symbol == "K_I"
    assert make_card(coefficients={}) is None

"""Checks of a joint result that need no records."""

from types import SimpleNamespace

import numpy as np
import pytest

from counterspin.campaign.result_parts import Coefficient
from counterspin.commands.joint import shared_warnings
from counterspin.commands.joint_checks import hidden_walk, unseen_ripple
from counterspin.inference.joint import Unknown
from counterspin.physics.accelerometer import DEGREE_PER_HOUR


def found(gain: float, dropped: tuple[str, ...] = ("random_walk",)) -> SimpleNamespace:
    tried = {("white",): 100.0, ("white", "random_walk"): 100.0 + gain / 2.0}
    return SimpleNamespace(
        components={"Qx": SimpleNamespace(dropped=dropped, log_likelihoods=tried)}
    )


@pytest.mark.parametrize("gain", [0.0, 0.9])
def test_a_walk_of_which_there_is_no_hint_is_not_spoken_of(gain):
    assert hidden_walk(found(gain), "Qx") == []


def test_a_hint_of_a_walk_is_a_warning():
    (warning,) = hidden_walk(found(1.8), "Qx")
    assert "gains 1.8" in warning
    assert "state it in [noise]" in warning


def test_kept_or_given_noise_is_no_hint():
    assert hidden_walk(found(1.8, dropped=()), "Qx") == []
    assert hidden_walk(found(1.8), "Qy") == []


def seen(noise: float) -> tuple[SimpleNamespace, list[SimpleNamespace], SimpleNamespace]:
    """A campaign of specific force at 10 g whose encoder has this noise in rad."""
    campaign = SimpleNamespace(
        accelerometers={"Qx": SimpleNamespace(observable="specific_force")},
        radius=SimpleNamespace(value=2.5),
        gravity=SimpleNamespace(value=9.8),
    )
    rotation = SimpleNamespace(rms=noise, residuals=np.zeros(5000))
    runs = [SimpleNamespace(run=SimpleNamespace(rate=2 * np.pi), rotation=rotation)]
    unknown = SimpleNamespace(owner="Qx", symbol="K_II")
    fit = SimpleNamespace(
        model=SimpleNamespace(unknowns=[unknown]), solution=SimpleNamespace(u=np.array([2e-9]))
    )
    return campaign, runs, SimpleNamespace(fit=fit)


def test_a_ripple_that_a_noisy_encoder_hides_is_a_warning():
    campaign, runs, fitted = seen(1e-5)
    (warning,) = unseen_ripple(campaign, runs, fitted, "Qx")
    # 1e-5 rad over 5000 samples hides 4.6 x 2e-7 of the rate, which at 10 g is 9e-8 g/g^2.
    assert "below 9e-07 of the rate" in warning
    assert "by 9e-08 g/g^2" in warning


def test_a_quiet_encoder_or_displacement_hides_no_ripple():
    campaign, runs, fitted = seen(1e-8)
    assert unseen_ripple(campaign, runs, fitted, "Qx") == []
    campaign, runs, fitted = seen(1e-5)
    campaign.accelerometers["Qx"].observable = "displacement"
    assert unseen_ripple(campaign, runs, fitted, "Qx") == []


@pytest.mark.parametrize(
    ("drift", "longest", "warned"),
    [(0.3, 400.0, True), (0.1, 400.0, False), (0.3, 100.0, False), (0.1, 800.0, True)],
)
def test_a_drift_is_large_for_the_length_of_the_runs(drift, longest, warned):
    # g d^2 T^4/24 reaches 0.01 m at 0.2 deg/h over 400 s, and at 0.05 deg/h over 800 s.
    unknown = Unknown("", "platform.drift.north", (0.0, np.inf), 1e-4)
    found = Coefficient(value=-drift * DEGREE_PER_HOUR, u=1e-12, unit="rad/s", estimated=True)
    assert bool(shared_warnings({unknown: found}, longest)) == warned

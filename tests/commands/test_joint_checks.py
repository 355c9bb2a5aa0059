"""Checks of a joint result that need no records."""

from types import SimpleNamespace

import pytest

from counterspin.commands.joint_checks import hidden_walk


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

"""Noise that is most of an uncertainty without showing."""

from types import SimpleNamespace

import numpy as np

from counterspin.calibration.diagnosis.noise import hidden_walk
from counterspin.calibration.joint_problem import AccelerometerView


def walking(share: float, name: str = "Qx") -> AccelerometerView:
    """A fit of which this share of u^2 of K_II is noise that the records do not show."""
    unknown = SimpleNamespace(owner="Qx", symbol="K_II", asked=True)
    fit = SimpleNamespace(
        model=SimpleNamespace(unknowns=[unknown]),
        solution=SimpleNamespace(u=np.array([2e-9])),
        unseen={name: (1e-5, np.array([[share * 4e-18]]))},
    )
    return AccelerometerView(SimpleNamespace(campaign=None), SimpleNamespace(fit=fit), None, "Qx")


def test_noise_that_is_most_of_k_ii_without_showing_is_remarked_on():
    (remark,) = hidden_walk([walking(0.8)])
    assert remark.startswith("Qx: 80% of u^2 of K_II")
    assert "acceleration in [noise]" in remark


def test_a_smaller_part_or_another_s_noise_is_not():
    assert list(hidden_walk([walking(0.3)])) == []
    assert list(hidden_walk([walking(0.8, name="Qy")])) == []

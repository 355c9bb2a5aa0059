"""What a run left out moves an estimate by, and how far chance moves it."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from joint_campaign import add_noise, make_unknowns, simulate_three_rates

from counterspin.inference.joint.agreement import jackknife_runs, shift_variance_sensitivities
from counterspin.inference.joint.estimated_noise import information_losses
from counterspin.inference.joint.estimation import estimate
from counterspin.inference.joint.unknowns import Unknowns
from counterspin.inference.noise.model import ESTIMATE, Noise

TRUTH = {"K_F": 0.005, "K_I": 1.002, "K_II": 2.7e-5}
WHITE = 0.01
MODEL = Unknowns(make_unknowns(["K_F", "K_I", "K_II"], {"K_F": (0.005, 2e-6)}))
K_II = 2


def fitted(seed, request, model=MODEL):
    rng = np.random.default_rng(seed)
    series = [add_noise(record, Noise(WHITE), rng) for record in simulate_three_rates(TRUTH)]
    return estimate(series, model, {"Qx": request}, rejects_outliers=False)


def shift_gains(fit, run):
    """Return the derivative of the shift with respect to each whitened row, by series."""
    ends = np.cumsum([0, *(block.factor.shape[0] for block in fit.blocks)])
    weights = np.eye(len(fit.model.unknowns))[K_II]
    own = [part.run == run for part in fit.design_blocks]
    kept = np.repeat([not left for left in own], np.diff(ends))
    shift = -fit.solution.combine(weights).noise_rows
    shift[kept] += fit.without_run(run).combine(weights).noise_rows
    return [shift[low:high] for low, high in pairwise(ends)]


@pytest.fixture(scope="module")
def fit_with_given_noise():
    return fitted(1, Noise(WHITE, 0.0))


def test_shift_matches_fit_without_run(fit_with_given_noise):
    *_, shift = jackknife_runs(fit_with_given_noise, K_II)
    without = estimate(
        fit_with_given_noise.series[:2], MODEL, {"Qx": Noise(WHITE, 0.0)}, rejects_outliers=False
    )
    assert shift.value == pytest.approx(without.fit.solution.estimate[K_II], rel=1e-9)
    assert shift.shift == pytest.approx(
        shift.value - fit_with_given_noise.fit.solution.estimate[K_II], rel=1e-9
    )
    assert shift.dof is None


def test_variance_of_shift_matches_gains(fit_with_given_noise):
    for shift in jackknife_runs(fit_with_given_noise, K_II):
        noise = sum(float(rows @ rows) for rows in shift_gains(fit_with_given_noise.fit, shift.run))
        # The prior of K_F moves both estimates, and the shift by the difference.
        without, whole = (
            fit_with_given_noise.fit.without_run(shift.run),
            fit_with_given_noise.fit.solution,
        )
        moved = without.sensitivity_prior[K_II, 0] - whole.sensitivity_prior[K_II, 0]
        prior = (moved * 2e-6) ** 2
        assert (shift.shift / shift.z) ** 2 == pytest.approx(noise + prior, rel=1e-6)


def test_additional_noise_is_propagated_by_gains(fit_with_given_noise):
    fit = fit_with_given_noise.fit
    runs = [part.run for part in fit.design_blocks]
    for run, slopes in zip(
        runs,
        shift_variance_sensitivities(fit, information_losses(fit, "Qx"), runs, K_II),
        strict=True,
    ):
        # Every row's gain counts, in rows of unit variance.
        noise = sum(float(rows @ rows) for rows in shift_gains(fit, run))
        assert slopes[0] * WHITE**2 == pytest.approx(noise, rel=1e-6)


def test_shift_has_degrees_of_freedom_of_estimated_noise():
    fit_result = fitted(2, Noise(ESTIMATE, 0.0), Unknowns(make_unknowns(["K_F", "K_I", "K_II"])))
    (component,) = fit_result.estimated_noise.values()
    for shift in jackknife_runs(fit_result, K_II):
        # White noise alone: rows less unknowns, as of every estimate.
        assert shift.dof == pytest.approx(component.degrees_of_freedom, rel=1e-3)


def test_undetected_noise_is_in_variance():
    fit_result = fitted(3, Noise(ESTIMATE, ESTIMATE))
    (component,) = fit_result.estimated_noise.values()
    assert component.undetected_walk is not None
    known = replace(fit_result, estimated_noise={"Qx": replace(component, undetected_walk=None)})
    for wide, narrow in zip(
        jackknife_runs(fit_result, K_II), jackknife_runs(known, K_II), strict=True
    ):
        assert abs(wide.z) < abs(narrow.z)
        assert wide.dof < narrow.dof

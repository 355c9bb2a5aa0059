"""Shared inputs correlate results: covariances, mean, drift and E_n."""

import math

import numpy as np
import pytest
from results import make_coefficient, make_qx_result

from counterspin.histories.consistency import en_score, find_shared_inputs, fit_drift, weighted_mean
from counterspin.histories.files import source_shifts

V = np.array([[4.0, 1.5, 0.5], [1.5, 9.0, 2.0], [0.5, 2.0, 1.0]])
X = np.array([1.0, 4.0, 2.0])


def test_mean_and_drift_match_generalised_least_squares():
    inverse = np.linalg.inv(V)
    mean = weighted_mean(X, np.sqrt(np.diag(V)), V)
    variance = 1.0 / inverse.sum()
    assert mean.value == pytest.approx(variance * (inverse @ X).sum())
    assert mean.u == pytest.approx(math.sqrt(variance))
    residuals = X - mean.value
    assert mean.scatter.chi2 == pytest.approx(residuals @ inverse @ residuals)
    project = np.eye(3) - variance * np.ones((3, 1)) @ np.ones((1, 3)) @ inverse
    assert mean.z == pytest.approx(residuals / np.sqrt(np.diag(project @ V @ project.T)))
    time = np.array([0.0, 1.0, 4.0])
    design = np.stack([np.ones(3), time], axis=1)
    covariance = np.linalg.inv(design.T @ inverse @ design)
    line = fit_drift(time, X, np.sqrt(np.diag(V)), V)
    expected = covariance @ design.T @ inverse @ X
    assert (line.slope, line.u) == pytest.approx((expected[1], math.sqrt(covariance[1, 1])))
    value, u = line.evaluate(4.0)
    assert float(value) == pytest.approx(expected @ [1.0, 4.0])
    assert float(u) == pytest.approx(math.sqrt(np.array([1.0, 4.0]) @ covariance @ [1.0, 4.0]))


def test_independent_results_are_unchanged():
    mean, mean_with_covariance = (
        weighted_mean(X, [1.0, 2.0, 3.0]),
        weighted_mean(X, [1.0, 2.0, 3.0], np.diag([1.0, 4.0, 9.0])),
    )
    assert mean_with_covariance.value == pytest.approx(mean.value)
    assert mean_with_covariance.z == pytest.approx(mean.z)


def test_shared_uncertainty_cancels_in_difference():
    # Each U is 1.96 u; the shared part cancels in the difference.
    first, second = (1.0, 5.0, None), (2.0, 5.0, None)
    assert en_score(first, second, 16.0) == pytest.approx(1.0 / (1.959964 * math.sqrt(18.0)))
    assert en_score(first, second) == pytest.approx(1.0 / (1.959964 * math.sqrt(50.0)))


def budget_arguments(calibration):
    """Return a result and u and budget of its K_II."""
    qx = calibration.accelerometers["Qx"]
    return calibration, qx.coefficients["K_II"].u, qx.budget["K_II"]


def budget_line(source, u, sensitivity, total=1e-9, kind="stated"):
    contribution = abs(sensitivity * u)
    share = (contribution / total) ** 2
    return {
        "source": source,
        "kind": kind,
        "u": u,
        "unit": "",
        "sensitivity": sensitivity,
        "contribution": contribution,
        "share": share,
    }


def test_default_priors_are_shared_by_results_of_instrument():
    lines = [
        budget_line("K_OO", 2e-6, -3e-4, kind="unstated"),
        budget_line("centrifuge.stretch", 5e-9, 4e-2, kind="unstated"),
        budget_line("centrifuge.radius", 1e-5, -3e-5, kind="unstated"),
        budget_line("records.timing_offset", 1e-6, 1e-4, kind="unstated"),
        budget_line("fixture.misalignment.in.forward", 1e-5, 1e-5, kind="unstated"),
        budget_line("slow.platform.tilt.north", 1e-6, 1e-4, kind="unstated"),
        budget_line("slow.ripple1", 1e-6, 1e-4, kind="noise"),
    ]
    first_shifts = source_shifts(*budget_arguments(make_qx_result(budget={"K_II": lines})))
    assert {source for source, _ in first_shifts} == {
        "K_OO",
        "centrifuge.stretch",
        "centrifuge.radius",
        "records.timing_offset",
    }
    # (6e-10)^2 + (2e-10)^2 + (3e-10)^2 + (1e-10)^2 over (1e-9)^2.
    assert find_shared_inputs(
        [1e-9, 1e-9], [first_shifts, first_shifts]
    ).largest_correlation == pytest.approx(0.50)
    # Defaults of different sizes may differ: the shared part is then smaller, never larger.
    lines[0] = budget_line("K_OO", 1e-6, -3e-4, kind="unstated")
    sources = source_shifts(*budget_arguments(make_qx_result(budget={"K_II": lines})))
    assert find_shared_inputs(
        [1e-9, 1e-9], [first_shifts, sources]
    ).largest_correlation == pytest.approx(0.14)


LINES = [
    budget_line("centrifuge.radius", 1e-5, -6e-5),
    budget_line("K_I", 5e-6, 4e-5),
    budget_line("slow.platform.tilt.north", 1e-6, 1e-4),
]


def test_radius_and_priors_are_shared_but_not_run_inputs():
    calibration = make_qx_result(budget={"K_II": LINES})
    shifts = source_shifts(*budget_arguments(calibration))
    assert {source for source, _ in shifts} == {"centrifuge.radius", "K_I"}
    assert shifts["K_I", "5e-06"] == pytest.approx(2e-10)
    common = find_shared_inputs([1e-9, 1e-9], [shifts, shifts])
    # (6e-10)^2 + (2e-10)^2 over (1e-9)^2.
    assert common.largest_correlation == pytest.approx(0.40)
    assert common.covariance[0, 0] == pytest.approx(1e-18)
    assert common.names == ("centrifuge.radius", "K_I")
    # A different radius is a separate measurement.
    inputs = calibration.inputs.model_copy(update={"radius": 2.51})
    sources = source_shifts(*budget_arguments(calibration.model_copy(update={"inputs": inputs})))
    assert find_shared_inputs([1e-9, 1e-9], [shifts, sources]).names == ("K_I",)
    assert find_shared_inputs([1e-9, 1e-9], [shifts, {}]) is None


def test_budget_of_different_uncertainty_is_ignored():
    coefficients = {"K_II": make_coefficient(2.7e-5, 1e-10, "g/g^2")}
    assert (
        source_shifts(
            *budget_arguments(make_qx_result(coefficients=coefficients, budget={"K_II": LINES}))
        )
        == {}
    )


def test_terms_of_same_second_accelerometer_are_shared():
    lines = [
        budget_line("Qx.K_OO", 2e-6, -3e-4, kind="unstated"),
        budget_line("slow.K_F", 1e-6, 1e-4),
    ]
    calibration = make_qx_result(budget={"K_II": lines}, serial_number="Q-1")
    shifts = source_shifts(*budget_arguments(calibration))
    assert shifts == {("Qx.K_OO", "2e-06 of Q-1"): pytest.approx(-6e-10)}
    sources = source_shifts(
        *budget_arguments(make_qx_result(budget={"K_II": lines}, serial_number="Q-2"))
    )
    assert find_shared_inputs([1e-9, 1e-9], [shifts, shifts]).largest_correlation == pytest.approx(
        0.36
    )
    assert find_shared_inputs([1e-9, 1e-9], [shifts, sources]) is None

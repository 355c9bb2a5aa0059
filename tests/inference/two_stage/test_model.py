"""Records as rows of a joint fit: against a dense weighted least squares, and tests of priors."""

import math
from functools import cache

import numpy as np
import pytest

from counterspin.inference.joint.alternatives import prior_alternatives, run_score_tests
from counterspin.inference.joint.budget import budget
from counterspin.inference.joint.fit import estimate_considered
from counterspin.inference.joint.series import ResidualSeries
from counterspin.inference.joint.unknowns import ROTATION, Considered, Unknown, Unknowns
from counterspin.inference.least_squares import NO_PRIOR
from counterspin.inference.two_stage.first_stage import Strobes, first_stage, strobe_angle
from counterspin.inference.two_stage.model import (
    DRIFT,
    TwoStageRequest,
    considered_terms,
    select_strobes,
    two_stage_model,
)
from counterspin.inference.two_stage.second_stage import StrobedRun, resolve, second_stage
from counterspin.physics import observation, simulation
from counterspin.physics.accelerometer import QX, QY
from counterspin.physics.motion import Site, Trajectory
from counterspin.physics.spindle import Ripple, Spindle

RATES = (math.pi / 2, math.pi, 1.5 * math.pi, 2 * math.pi)
R, SITE = 2.5, Site(9.8, 0.8)
TRUTH = {"K_F": 0.004, "K_I": 1.001, "K_II": 2e-5}
SIGMA, PSI = 0.01, "platform.tilt.north"
PRIORS = {"K_F": (0.00402, 2e-6), "K_I": (1.001, 0.0), PSI: (0.0, 2e-6)}


def make_run(rate, rng, *, mounting=QX, drift=0.0, nominal=False, n=100):
    """Return a run with strobe noise and a known rotation or only a nominal rate."""
    true = Trajectory(Spindle(rate, drift, (Ripple(1, 1e-5 * rate, 0.5),)), R, SITE)
    known = Trajectory(Spindle(rate), R, SITE) if nominal else true
    phase = strobe_angle(mounting.input_axis)
    time = known.spindle.time_at(phase + 2 * math.pi * np.arange(1, n + 1))
    factor = rng.uniform(0.7, 1.0, n)
    error = simulation.simulate_record(true, mounting, TRUTH, {}, time)
    error = error - observation.reference(known, mounting, time)
    error = error + SIGMA * factor * rng.standard_normal(n)
    parabola = first_stage(Strobes(time, error, factor, lost=0), SIGMA)
    return StrobedRun(f"{rate:.2f}", known, parabola)


@cache
def make_runs(**more):
    rng = np.random.default_rng(3)
    return [make_run(rate, rng, **more) for rate in RATES]


# The rows


def curvature(strobes, values):
    """Return the t^2 coefficient of a weighted parabola through values at the strobes."""
    weight = 1.0 / strobes.noise_factor
    span = strobes.time.max()
    powers = np.vander(strobes.time / span, 3) * weight[:, None]
    return np.linalg.lstsq(powers, (values.T * weight).T, rcond=None)[0][0] / span**2


def dense_least_squares(make_runs, mounting, priors, columns, drift=None):
    """Weighted least squares of curvatures, what is held being carried; with numpy alone.

    Returns estimates and standard uncertainties from noise, priors and what is held.
    """
    b2 = np.array([curvature(r.parabola.strobes, r.parabola.strobes.error) for r in make_runs])
    inverse = []
    for run in make_runs:
        strobes = run.parabola.strobes
        powers = np.vander(strobes.time, 3) / (SIGMA * strobes.noise_factor)[:, None]
        scale = np.linalg.norm(powers, axis=0)
        inverse.append(np.linalg.inv((powers / scale).T @ (powers / scale))[0, 0] / scale[0] ** 2)
    sigma = np.sqrt(inverse)
    texts = ["K_II", "K_F"]
    design = np.column_stack([columns(symbol) for symbol in texts])
    if drift is not None:
        design = np.column_stack([design, drift])
    known = {s: p for s, p in priors.items() if s not in texts}
    effects, spread = [], []
    for symbol, (value, u) in known.items():
        nominal = 1.0 if symbol == "K_I" else 0.0
        b2 = b2 - (value - nominal) * columns(symbol)
        per_run = symbol == PSI
        effects += list(np.diag(columns(symbol))) if per_run else [columns(symbol)]
        spread += [u] * (len(make_runs) if per_run else 1)
    p = design.shape[1]
    means, weights = np.zeros(p), np.zeros(p)
    for place, symbol in enumerate(texts):
        if symbol in priors:
            means[place], weights[place] = priors[symbol][0], 1.0 / priors[symbol][1]
    rows = np.vstack([design / sigma[:, None], np.diag(weights)])
    right = np.concatenate([b2 / sigma, means * weights])
    scale = np.linalg.norm(rows, axis=0)
    gain = np.linalg.pinv(rows / scale) / scale[:, None]
    held_part = (gain[:, : len(make_runs)] / sigma) @ np.array(effects).T * spread
    parts = gain[:, : len(make_runs)], gain[:, len(make_runs) :], held_part
    return gain @ right, [np.linalg.norm(part, axis=1) for part in parts]


@pytest.mark.parametrize("mounting", [QX, QY], ids=["Qx", "Qy"])
@pytest.mark.parametrize("nominal", [False, True], ids=["angle recorded", "nominal angle"])
def test_fit_matches_dense_weighted_least_squares(mounting, nominal):
    priors = {**PRIORS, "K_III": (3e-6, 1e-6), "platform.g_sensitivity.zx": (1e-9, 2e-9)}
    those = make_runs(mounting=mounting, drift=2e-8, nominal=nominal)
    along = {"drift": 0.0}

    def columns(symbol):
        shown = []
        for run in those:
            spindle = run.trajectory.spindle
            if nominal:
                spindle = Spindle(spindle.rate, along["drift"])
            time = run.parabola.strobes.time
            values = observation.columns(
                Trajectory(spindle, R, SITE), mounting, [symbol], time, scale_factor=1.001
            )
            shown.append(curvature(run.parabola.strobes, values[:, 0]))
        return np.array(shown)

    of_drift = -0.5 * 1.001 * R * np.array(RATES) if nominal else None
    expected, parts = dense_least_squares(those, mounting, priors, columns, of_drift)
    if nominal:
        along["drift"] = expected[2]
        expected, parts = dense_least_squares(those, mounting, priors, columns, of_drift)
    request = TwoStageRequest(priors=priors, nominal_angle=nominal)
    second_stage_result = second_stage(those, mounting, request, ignored=())
    assert second_stage_result.symbols == ("K_II", "K_F", DRIFT)[: 2 + nominal]
    solution = second_stage_result.fit.solution
    near = 1e-6 if nominal else 1e-9
    np.testing.assert_array_less(np.abs(solution.estimate - expected), near * solution.u)
    covariances = (
        solution.covariance_noise,
        solution.covariance_prior,
        solution.covariance_considered,
    )
    for covariance, u in zip(covariances, parts, strict=True):
        np.testing.assert_array_less(np.abs(np.sqrt(np.diag(covariance)) - u), near * solution.u)


@pytest.mark.parametrize("weighted", [True, False])
def test_budget_sums_to_u_and_names_sources(weighted):
    priors = {**PRIORS, "K_III": (3e-6, 1e-6)}
    second_stage_result = second_stage(
        make_runs(),
        QX,
        TwoStageRequest(priors=priors, weighted=weighted, u_radius=1e-4),
        ignored=(),
    )
    for place in range(2):
        lines = budget(second_stage_result.fit, place)
        total = math.hypot(*(line.contribution for line in lines))
        assert total == pytest.approx(second_stage_result.fit.solution.u[place], rel=1e-9)
        assert {line.kind for line in lines} == {"noise", "stated", "held"}
    k_ii, _ = second_stage_result.estimate("K_II")
    radius = next(
        line for line in budget(second_stage_result.fit, 0) if line.source == "centrifuge.radius"
    )
    assert radius.contribution == pytest.approx(2e-4 * k_ii, rel=1e-4)
    noise = next(line for line in budget(second_stage_result.fit, 0) if line.kind == "noise")
    sigma = [parabola.u_b2 for parabola in second_stage_result.parabolas]
    assert noise.contribution == pytest.approx(
        np.linalg.norm(second_stage_result.gain[0] * sigma), rel=1e-9
    )


def test_printed_equations_include_uncertain_inputs():
    request = TwoStageRequest("as-printed", PRIORS, u_radius=1e-3, u_gravity=2e-3)
    second_stage_result = second_stage(make_runs(), QX, request)
    k_ii, _ = second_stage_result.estimate("K_II")
    lines = {line.source: line.contribution for line in budget(second_stage_result.fit, 0)}
    # b2 is K_II R^2 w^4/(2 g).
    assert lines["centrifuge.radius"] == pytest.approx(2e-3 * k_ii, rel=1e-9)
    assert lines["site.gravity"] == pytest.approx(2e-3 * k_ii, rel=1e-9)


def test_record_is_sampled_at_strobes():
    motion = Trajectory(Spindle(math.pi), R, SITE)
    time = np.arange(0.0, 20.0, 0.03)
    shown = np.cos(time)
    series = ResidualSeries(
        accelerometer="Qx",
        run="slow",
        trajectory=motion,
        mounting=QX,
        observable="displacement",
        attitude=observation.LEVEL,
        time=time,
        time_sd=np.zeros_like(time),
        count=np.ones_like(time),
        spacing=0.03,
        error=shown,
        latitude_sensitivity=2.0 * shown,
    )
    at, strobes = select_strobes(series)
    np.testing.assert_allclose(at.time, 0.5 + 2.0 * np.arange(10), atol=1e-12)
    # Between two samples 0.03 s apart, a straight line is off by 0.03^2/8 at the most.
    np.testing.assert_allclose(at.error, np.cos(at.time), atol=1.2e-4)
    np.testing.assert_allclose(at.latitude_sensitivity, 2.0 * at.error, rtol=1e-12)
    np.testing.assert_array_equal(at.count, strobes.noise_factor**-2.0)
    assert at.count.max() <= 2.0 + 1e-12
    assert at.count.min() >= 1.0


def test_unestimated_terms_are_considered_with_priors():
    (actual_strobed_series, _) = strobed_series()
    model = Unknowns(
        (
            Unknown("Qx", "K_II", (1e-5, 1e-6), 1e-4),
            Unknown("Qx", "K_I", (1.001, 1e-6), 0.1),
            Unknown("Qx", "K_III", NO_PRIOR, 1e-4),
            Unknown("Qy", "K_III", (0.0, 1e-6), 1e-4),
            Unknown("slow", PSI, (0.0, 1e-6), 1e-2),
            Unknown("slow", ROTATION[1], NO_PRIOR, 1.0),
            Unknown("", "site.gravity", (0.0, 1e-5), 0.08, is_of_interest=False),
        ),
        (Considered("", "platform.g_sensitivity.zx", (0.0, 1e-9), 1e-6),),
    )
    expected = [
        ("Qx", "K_I", (1.001, 1e-6)),
        ("Qx", "K_III", (0.0, 0.0)),  # of which nothing is known
        ("slow", PSI, (0.0, 1e-6)),
        ("", "site.gravity", (0.0, 1e-5)),
        ("", "platform.g_sensitivity.zx", (0.0, 1e-9)),
    ]
    kept = considered_terms(model, ["K_II", "K_F"], [actual_strobed_series])
    assert [(other.owner, other.symbol, other.prior) for other in kept] == expected
    two_stage_request = TwoStageRequest(priors={"K_II": (1e-5, 1e-6)}, nominal_angle=True)
    ours = two_stage_model(model, two_stage_request, [actual_strobed_series])
    assert [(u.name, u.prior, u.limit) for u in ours.unknowns] == [
        ("Qx.K_II", (1e-5, 1e-6), 1e-4),
        ("Qx.K_F", NO_PRIOR, 0.1),
        (DRIFT, NO_PRIOR, 1e-2),
    ]
    assert ours.considered == kept


def strobed_series():
    """One run at its strobes as a series of an accelerometer with a name, and its parabola."""
    (run,) = [run for run in make_runs() if run.name == "3.14"]
    strobes = run.parabola.strobes
    series = ResidualSeries(
        accelerometer="Qx",
        run="slow",
        trajectory=run.trajectory,
        mounting=QX,
        observable="displacement",
        attitude=run.attitude,
        time=strobes.time,
        time_sd=np.zeros_like(strobes.time),
        count=strobes.noise_factor**-2.0,
        spacing=2.0,
        error=strobes.error,
    )
    return series, run.parabola


def test_strobe_residuals_are_in_row():
    series, parabola = strobed_series()
    request = TwoStageRequest(priors={"K_F": (0.004, 1e-6)})
    model = two_stage_model(Unknowns(()), request, [series])
    resolved = resolve([series], [parabola], model, request)
    (block,) = resolved.fit.blocks
    assert block.rss == parabola.chi2
    # Of the strobes two numbers are their own and one is b2.
    assert (block.rows - block.n_nuisance, block.factor.shape[0]) == (parabola.dof + 1, 1)
    assert resolved.fit.degrees_of_freedom[0] == pytest.approx(parabola.dof, rel=1e-6)


# Tests of priors, those of the joint fit


def solve_second_stage(priors):
    return second_stage(make_runs(), QX, TwoStageRequest(priors=priors), ignored=())


def compare_with_runs(second):
    relaxed = estimate_considered(second.fit)
    some = [
        other
        for other in prior_alternatives(relaxed)
        if all(relaxed.model.unknowns[place].prior[1] > 0.0 for place in other.prior_shifts)
    ]
    score_tests = run_score_tests(relaxed, some, noise_given=True)
    each = zip(score_tests.value, score_tests.u, score_tests.z, strict=True)
    return {other.name: line for other, line in zip(some, each, strict=True)}


def test_estimated_term_is_compared_with_fit_without_prior():
    """Compare with generalised least squares with considered terms in the covariance."""
    value, u, size = compare_with_runs(solve_second_stage(PRIORS))["K_F"]
    second = solve_second_stage(PRIORS)
    sigma = np.array([parabola.u_b2 for parabola in second.parabolas])
    design, fixed = (
        sigma[:, None] * np.vstack([getattr(block, part) for block in second.fit.blocks])
        for part in ("factor", "considered")
    )
    moved = fixed * second.fit.solution.considered_sd
    weight = np.linalg.inv(np.diag(sigma**2) + moved @ moved.T)
    b2 = (
        np.array([run.parabola.b2 for run in make_runs()])
        - fixed @ second.fit.model.considered_means
    )
    covariance = np.linalg.inv(design.T @ weight @ design)
    alone = (covariance @ design.T @ weight @ b2)[1]
    assert value == pytest.approx(alone - 0.00402, rel=1e-6)
    assert size > 5.0
    # The residuals' own scale counts where it is larger; that of 4 x 97 strobes is close to one.
    ratio = u / math.hypot(2e-6, covariance[1, 1] ** 0.5)
    assert 1.0 - 1e-6 < ratio < 1.0 + 4.0 / math.sqrt(2 * 4 * 97)


def test_tilts_of_runs_are_compared_separately_and_jointly():
    comparison = compare_with_runs(solve_second_stage(PRIORS))
    assert {name for name in comparison if name.endswith(PSI)} == {
        PSI,
        *(f"{run.name}.{PSI}" for run in make_runs()),
    }
    # All tilts alike are a bias: g psi is K_F, and tells the same of the same mistake.
    assert comparison[PSI][2] == pytest.approx(comparison["K_F"][2], rel=1e-6)


def test_term_without_other_information_is_not_tested():
    # As many runs as unknowns, K_F's prior among what is needed.
    request = TwoStageRequest(priors={"K_F": (0.004, 2e-6)})
    comparison = compare_with_runs(second_stage(make_runs()[:1], QX, request, ignored=()))
    assert comparison["K_F"][2] == 0.0
    assert math.isinf(comparison["K_F"][1])

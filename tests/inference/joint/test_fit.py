"""The joint fit itself: its bound, its coverage, what it separates and what it says it cannot."""

import math
import os
from dataclasses import replace

import numpy as np
import pytest
from joint_campaign import (
    ARCSEC,
    DEG_H,
    NO_PRIOR,
    RATES,
    SITE,
    add_noise,
    make_considered_inputs,
    make_unknowns,
    redraw_noise,
    simulate_series,
    simulate_three_rates,
)
from prose import find_numbers, parse_number
from scipy.special import ndtri

from counterspin.errors import NotIdentifiableError
from counterspin.inference.diagnostics import SIGNIFICANCE, diagnose
from counterspin.inference.distributions import chi_square_tail
from counterspin.inference.identifiability import assess
from counterspin.inference.joint.design_blocks import build_design_blocks, update_design_blocks
from counterspin.inference.joint.estimation import estimate
from counterspin.inference.joint.fit import solve_joint
from counterspin.inference.joint.series import INPUT_PERTURBATIONS, TIMING
from counterspin.inference.joint.unknowns import Considered, Unknown, Unknowns
from counterspin.inference.noise.model import Noise
from counterspin.physics.spindle import Spindle

FULL = bool(os.environ.get("COUNTERSPIN_FULL"))
TRIALS = 10_000 if FULL else 80
TRUTH = {"K_F": 5.03e-3, "K_I": 1.00197, "K_II": 2.7e-5, "K_III": 3.4e-6}
PRIORS = {"K_F": (5.03e-3, 2e-6), "K_I": (1.00197, 5e-6)}
WHITE = Noise(0.01)
MIXED = Noise(0.01, 3e-4)  # the walk reaches six times the white noise within a run
SCALES = {"Qx": TRUTH["K_I"], "Qy": TRUTH["K_I"]}


def true_offsets(model, truth):
    """Return true minus nominal values in the order of the model."""
    return np.array([truth[u.symbol] - u.nominal for u in model.unknowns])


def interval_contains_truth(z, level):
    return np.abs(z) < ndtri(0.5 + level / 2)


def is_within_sampling_error(inside, level):
    """Return whether a success rate agrees with its probability within 4 sigma."""
    inside = np.asarray(inside)
    spread = math.sqrt(level * (1 - level) / inside.shape[0])
    return np.abs(inside.mean(axis=0) - level) < 4 * spread


def dense_bound(prepared, model, noise):
    """Return the Cramer-Rao bound from dense n x n covariances, with scaled columns."""
    sd = np.array([u.prior[1] for u in model.unknowns])
    information = np.zeros((sd.size, sd.size))
    scale = np.sqrt(sum(np.square(one.design).sum(axis=0) for one in prepared))
    for one in prepared:
        t = one.series.time
        early, late = np.minimum.outer(t, t), np.maximum.outer(t, t)
        covariance = noise.white**2 * np.eye(t.size)
        covariance += noise.random_walk**2 * early**2 * (3 * late - early) / 6
        own = np.column_stack([np.ones(t.size), t / t[-1]])
        whole = np.column_stack([own, one.design / scale])
        block = whole.T @ np.linalg.solve(covariance, whole)
        information += block[2:, 2:] - block[2:, :2] @ np.linalg.solve(block[:2, :2], block[:2, 2:])
    information += np.diag((scale * sd) ** -2.0)
    return np.sqrt(np.diag(np.linalg.inv(information))) / scale


@pytest.fixture(scope="module")
def paper_series():
    """Return series of the four coefficients and three rates of the paper, without noise."""
    model = Unknowns(make_unknowns(TRUTH, PRIORS))
    return model, build_design_blocks(simulate_three_rates(TRUTH), model, SCALES)


@pytest.mark.slow
@pytest.mark.parametrize("noise", [WHITE, MIXED], ids=["white", "mixed"])
def test_cramer_rao_bound_is_reached_and_intervals_have_coverage(paper_series, noise):
    model, prepared = paper_series
    fit = solve_joint(prepared, model, {"Qx": noise})
    np.testing.assert_allclose(fit.solution.u, dense_bound(prepared, model, noise), rtol=1e-5)

    # Trials: noise is drawn and so are the priors' values, as in a campaign.
    rng = np.random.default_rng(1)
    errors = np.empty((TRIALS, len(TRUTH)))
    for errors_of in errors:
        drawn = {s: (v + u * rng.standard_normal(), u) for s, (v, u) in PRIORS.items()}
        trial = replace(model, unknowns=make_unknowns(TRUTH, drawn))
        fit = solve_joint(redraw_noise(prepared, noise, rng), trial, {"Qx": noise})
        errors_of[:] = fit.solution.estimate - true_offsets(model, TRUTH)
    z = errors / fit.solution.u
    # A standard deviation of n draws has one of 1/sqrt(2 n) of itself.
    np.testing.assert_allclose(z.std(axis=0), 1.0, atol=3.5 / math.sqrt(2 * TRIALS))
    assert (np.abs(z.mean(axis=0)) < 4 / math.sqrt(TRIALS)).all()
    for level in (0.68, 0.95, 0.99):
        assert is_within_sampling_error(interval_contains_truth(z, level), level).all()


def test_uncertainty_is_split_into_noise_and_priors(paper_series):
    model, prepared = paper_series
    solution = solve_joint(prepared, model, {"Qx": WHITE}).solution
    # K_I is known four times better beforehand than from such short records.
    k_i = [u.symbol for u in model.unknowns].index("K_I")
    assert solution.u[k_i] < PRIORS["K_I"][1]
    assert solution.sensitivity_prior[k_i, k_i] == pytest.approx(
        (solution.u[k_i] / PRIORS["K_I"][1]) ** 2, rel=1e-9
    )
    shifted = replace(
        model, unknowns=make_unknowns(TRUTH, PRIORS | {"K_F": (5.03e-3 + 1e-6, 2e-6)})
    )
    moved = solve_joint(prepared, shifted, {"Qx": WHITE}).solution
    np.testing.assert_allclose(
        moved.estimate - solution.estimate, 1e-6 * solution.sensitivity_prior[:, 0], atol=1e-14
    )


@pytest.mark.slow
@pytest.mark.parametrize("noise", [WHITE, MIXED], ids=["white", "mixed"])
def test_u_but_not_noise_part_covers_considered_term(paper_series, noise):
    model, _ = paper_series
    k_oo = Considered("Qx", "K_OO", (1e-6, 2e-6), 1e-4)
    tilts = [
        Considered(f"run{i}", "platform.tilt.north", (0.0, 0.5 * ARCSEC), 1e-2) for i in (1, 2, 3)
    ]
    considering = replace(model, considered=(k_oo, *tilts))
    prepared = build_design_blocks(simulate_three_rates(TRUTH), considering, SCALES)
    rng = np.random.default_rng(2)
    z = np.empty((TRIALS, 2))
    for row in z:
        drawn = redraw_noise(prepared, noise, rng)
        drawn = [
            # The series' own considered columns: K_OO, then its run's tilt.
            replace(
                record,
                series=replace(
                    record.series,
                    error=record.series.error
                    + record.considered_design @ [rng_k_oo, 0.5 * ARCSEC * rng.standard_normal()],
                ),
            )
            for rng_k_oo in (1e-6 + 2e-6 * rng.standard_normal(),)
            for record in drawn
        ]
        solution = solve_joint(drawn, considering, {"Qx": noise}).solution
        error = solution.estimate[2] - TRUTH["K_II"]
        row[:] = error / solution.u[2], error / math.sqrt(solution.covariance_noise[2, 2])
    assert is_within_sampling_error(interval_contains_truth(z[:, 0], 0.95), 0.95)
    assert z[:, 0].std() == pytest.approx(1.0, abs=3.5 / math.sqrt(2 * TRIALS))
    assert interval_contains_truth(z[:, 1], 0.95).mean() < 0.5


# What is left out -----------------------------------------------------------------------------

EXTRA = {"K_OO": 1e-6}
D_ZX = 0.05 * DEG_H


@pytest.fixture(scope="module")
def cross_coupled():
    """Return series with K_OO and gyro g-sensitivity, simulated on the rotated platform."""
    return simulate_three_rates(
        TRUTH | EXTRA, {"platform.g_sensitivity.zx": D_ZX}, per_revolution=64
    )


def make_model(kind, owner_prior=(0.0, 2e-6), gyro_prior=(0.0, 0.05 * DEG_H)):
    return (
        kind("Qx", "K_OO", owner_prior, 1e-4),
        kind("", "platform.g_sensitivity.zx", gyro_prior, 10 * DEG_H),
    )


def solve_k_ii(series, model, noise=WHITE):
    fit = solve_joint(build_design_blocks(series, model, SCALES), model, {"Qx": noise})
    index = [u.name for u in model.unknowns].index("Qx.K_II")
    return fit.solution, index, fit.solution.estimate[index] - TRUTH["K_II"]


def test_omitted_terms_bias_k_ii_beyond_noise(cross_coupled):
    fine = Noise(1e-4)
    solution, index, error = solve_k_ii(cross_coupled, Unknowns(make_unknowns(TRUTH, PRIORS)), fine)
    assert abs(error) > 30 * math.sqrt(solution.covariance_noise[index, index])
    # Level, one sense: K_OO adds itself to K_II; D_zx adds g D/(R w) at the weights of the rates.
    # Level, K_OO adds itself to K_II; so does g D/(R w), of which the fastest run's counts most.
    gyro = D_ZX * SITE.gravity / (2.5 * RATES[2])
    assert error == pytest.approx(EXTRA["K_OO"] + gyro, abs=0.02 * EXTRA["K_OO"] + gyro)


@pytest.mark.parametrize("kind", [Unknown, Considered], ids=["estimated", "considered"])
@pytest.mark.parametrize("noise", [WHITE, Noise(1e-4)], ids=["centimetres", "tenth-millimetres"])
def test_u_covers_estimated_or_considered_term(cross_coupled, kind, noise):
    base = make_unknowns(TRUTH, PRIORS)
    extra = make_model(kind)
    model = Unknowns(base + extra) if kind is Unknown else Unknowns(base, extra)
    solution, index, error = solve_k_ii(cross_coupled, model, noise)
    u = math.sqrt(solution.covariance[index, index])
    u_noise = math.sqrt(solution.covariance_noise[index, index])
    assert abs(error) < 2 * u
    if noise is not WHITE and kind is Considered:
        assert u > 1000 * u_noise


def test_both_senses_separate_gyro_sensitivity_from_k_ii():
    terms = ("K_F", "K_I", "K_II", "K_III")
    gyro = Unknown("", "platform.g_sensitivity.zx", NO_PRIOR, 10 * DEG_H)
    model = Unknowns((*make_unknowns(terms), gyro))
    platform = {"platform.g_sensitivity.zx": 0.3 * DEG_H}
    one_sense = simulate_three_rates(TRUTH, platform)
    two_senses = [
        *simulate_three_rates(TRUTH, platform, revolutions=6),
        *[
            simulate_series(f"back{i}", -rate, TRUTH, platform, revolutions=6)
            for i, rate in enumerate(RATES)
        ],
    ]
    alone, index, _ = solve_k_ii(one_sense, Unknowns(make_unknowns(terms)))
    free_one, _, error_one = solve_k_ii(one_sense, model)
    free_two, _, error_two = solve_k_ii(two_senses, model)
    known_two, _, _ = solve_k_ii(two_senses, Unknowns(make_unknowns(terms)))
    assert abs(error_one) < 0.1 * free_one.u[index]
    assert abs(error_two) < 0.1 * free_two.u[index]
    # One sense pays for the gyro's term; both senses do not.
    assert free_one.u[index] > 3 * alone.u[index]
    assert free_two.u[index] == pytest.approx(known_two.u[index], rel=1e-2)


# Several accelerometers, attitudes, observables ---------------------------------------------------


def test_two_accelerometers_share_platform():
    platform = {
        "platform.drift.up": 2e-8,
        "platform.tilt.north": 0.4 * ARCSEC,
        "platform.tilt.east": -0.7 * ARCSEC,
    }
    runs = ("run1", "run2", "run3")
    shared = (
        Unknown("", "platform.drift.up", NO_PRIOR, 10 * DEG_H),
        *(
            Unknown(run, f"platform.tilt.{axis}", (0.0, 0.5 * ARCSEC), 1e-2)
            for run in runs
            for axis in ("north", "east")
        ),
    )
    own = {
        name: make_unknowns(("K_F", "K_I", "K_II"), {"K_F": (TRUTH["K_F"], 2e-6)}, name)
        for name in ("Qx", "Qy")
    }
    truth = {s: TRUTH[s] for s in ("K_F", "K_I", "K_II")}
    series = {
        name: simulate_three_rates(truth, platform, accelerometer=name) for name in ("Qx", "Qy")
    }
    noise = {"Qx": WHITE, "Qy": Noise(0.02)}

    def drift_of(names):
        model = Unknowns((*(u for name in names for u in own[name]), *shared))
        chosen = [one for name in names for one in series[name]]
        fit = solve_joint(build_design_blocks(chosen, model, SCALES), model, noise)
        index = [u.symbol for u in model.unknowns].index("platform.drift.up")
        estimate, u = fit.solution.estimate[index], fit.solution.u[index]
        assert estimate == pytest.approx(2e-8, abs=0.2 * u)
        return u, model, fit.solution

    u_x, _, _ = drift_of(("Qx",))
    u_y, _, _ = drift_of(("Qy",))
    u_both, model, solution = drift_of(("Qx", "Qy"))
    # Two independent determinations of one drift: their information adds up.
    assert u_both**-2 == pytest.approx(u_x**-2 + u_y**-2, rel=1e-3)
    # A tilt about north is Qx's alone, about east Qy's; each differs from run to run.
    names = [u.name for u in model.unknowns]
    for axis in ("north", "east"):
        tilts = [solution.estimate[names.index(f"{run}.platform.tilt.{axis}")] for run in runs]
        u = [solution.u[names.index(f"{run}.platform.tilt.{axis}")] for run in runs]
        error = np.array(tilts) - platform[f"platform.tilt.{axis}"]
        # K_F's own prior leaves the mean tilt as uncertain as it was.
        assert (np.abs(error) < 2 * np.array(u)).all()
        assert max(u) < 0.5 * ARCSEC


#: East stays the input axis's place for two of them; rows say where x, y, z of the platform point.
PENDULOUS_VERTICAL = np.eye(3)
OUTPUT_VERTICAL = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])
INPUT_VERTICAL = np.array([[0, 0, 1.0], [0, 1.0, 0], [-1.0, 0, 0]])
SQUARES = {"K_II": 2.7e-5, "K_OO": -8e-6, "K_PP": 1.5e-5}


def test_three_attitudes_separate_squares():
    truth = {"K_F": 5.03e-3, "K_I": 1.00197} | SQUARES
    attitudes = {"p": PENDULOUS_VERTICAL, "o": OUTPUT_VERTICAL, "i": INPUT_VERTICAL}
    model = Unknowns(make_unknowns(truth, {"K_F": (5.03e-3, 2e-6), "K_I": (1.00197, 5e-6)}))
    series = [
        simulate_series(f"{name}{i}", rate, truth, attitude=attitude)
        for name, attitude in attitudes.items()
        for i, rate in enumerate(RATES)
    ]
    level, tipped = (
        solve_joint(build_design_blocks(chosen, model, SCALES), model, {"Qx": WHITE}).solution
        for chosen in (series[:3], series)
    )
    names = [u.name for u in model.unknowns]
    for symbol, value in SQUARES.items():
        index = names.index(f"Qx.{symbol}")
        assert tipped.u[index] < 2e-7
        assert tipped.estimate[index] == pytest.approx(value, abs=0.1 * tipped.u[index])

    nominal = [u.nominal for u in model.unknowns]
    assessment = assess(level, names, nominal=nominal)
    assert not assessment.determined["Qx.K_II"]
    assert not assessment.determined["Qx.K_OO"]
    sums = [item for item in assessment.confounded if {"Qx.K_II", "Qx.K_OO"} <= set(item.terms)]
    assert len(sums) == 1
    assert sums[0].determined == "Qx.K_II + Qx.K_OO"
    assert sums[0].value == pytest.approx(SQUARES["K_II"] + SQUARES["K_OO"], abs=2 * sums[0].u)
    assert sums[0].u < 3e-7
    assert all(assess(tipped, names, nominal=nominal).determined[f"Qx.{s}"] for s in SQUARES)


@pytest.mark.parametrize(
    ("observable", "noise"),
    [
        ("displacement", WHITE),
        ("displacement", MIXED),
        ("velocity", Noise(1e-3)),
        ("velocity", Noise(1e-3, 3e-4)),
        ("specific_force", Noise(1e-3)),
        ("specific_force", Noise(0.0, 3e-4)),
    ],
)
def test_all_observables_return_same_truth(observable, noise):
    model = Unknowns(make_unknowns(TRUTH))
    clean = build_design_blocks(simulate_three_rates(TRUTH, observable=observable), model, SCALES)
    solution = solve_joint(clean, model, {"Qx": noise}).solution
    # The truth is linear in these coefficients: without noise nothing but rounding is left.
    assert (np.abs(solution.estimate - true_offsets(model, TRUTH)) < 1e-6 * solution.u).all()
    correlation = solution.covariance / np.outer(solution.u, solution.u)
    rng = np.random.default_rng(5)
    trials, distance, misfit = 40, 0.0, 0.0
    for _ in range(trials):
        fit = solve_joint(redraw_noise(clean, noise, rng), model, {"Qx": noise})
        z = (fit.solution.estimate - true_offsets(model, TRUTH)) / solution.u
        distance += z @ np.linalg.solve(correlation, z)
        misfit += fit.solution.chi2
    for chi2, dof in ((distance, trials * len(TRUTH)), (misfit, trials * fit.solution.dof)):
        assert abs(chi2 - dof) < 4 * math.sqrt(2 * dof)
    left, rows = fit.residuals[0].unweighted, fit.residuals[0].whitened
    assert left.shape == clean[0].series.time.shape
    assert rows.std() == pytest.approx(1.0, abs=4 / math.sqrt(2 * rows.size))


# What cannot be told apart ------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["Qx", "Qy"])
def test_only_difference_of_k_i_and_k_ip_is_determined(name):
    truth = TRUTH | {"K_IP": 4e-6}
    model = Unknowns(make_unknowns(truth, owner=name))
    # As many samples and revolutions as the real campaign; u(K_IP) of Qy is then 1.7e-4.
    series = simulate_three_rates(truth, accelerometer=name, revolutions=100, per_revolution=64)
    solution = solve_joint(
        build_design_blocks(series, model, {name: 1.0}), model, {name: WHITE}
    ).solution
    assessment = assess(
        solution,
        [u.symbol for u in model.unknowns],
        nominal=[u.nominal for u in model.unknowns],
    )
    assert not assessment.determined["K_IP"]
    assert assessment.determined["K_II"]
    pair = next(item for item in assessment.confounded if set(item.terms) == {"K_I", "K_IP"})
    assert pair.determined == "K_I - K_IP"
    assert abs(pair.correlation) > 0.97
    assert pair.value == pytest.approx(truth["K_I"] - truth["K_IP"], abs=3 * pair.u)
    assert pair.u < 6e-5  # 0.01/2.5 sqrt(2/19200), and what K_III costs


def test_bias_and_collinear_terms_have_single_combination():
    symbols = ("K_F", "K_I", "K_II", "K_PP", "delta_O")
    tilt = Unknown("", "platform.tilt.north", NO_PRIOR, 1e-2)
    model = Unknowns((*make_unknowns(symbols), tilt))
    truth = {"K_F": 5e-3, "K_I": 1.002, "K_II": 2e-5, "K_PP": 3e-6}
    solution = solve_joint(
        build_design_blocks(simulate_three_rates(truth), model, SCALES), model, {"Qx": WHITE}
    ).solution
    names = [u.symbol for u in model.unknowns]
    assessment = assess(solution, names, nominal=[u.nominal for u in model.unknowns])
    alike = {"K_F", "K_PP", "delta_O", "platform.tilt.north"}
    assert not any(assessment.determined[name] for name in alike - {"K_F"})
    item = next(item for item in assessment.confounded if set(item.terms) == alike)
    # a_P = -1 in the level attitude, so that delta_O a_P is a bias of the other sign; a tilt is
    # seen through the scale factor.
    assert item.determined == "K_F + K_PP - delta_O - 1.00197 platform.tilt.north"
    assert item.value == pytest.approx(5e-3 + 3e-6, abs=3 * item.u)
    assert item.u < 1e-6
    assert assessment.determined["K_II"]


# Checks of an answer ------------------------------------------------------------------------------


def test_omitted_run_matches_fit_without_records(paper_series):
    model, prepared = paper_series
    rng = np.random.default_rng(6)
    fit = solve_joint(redraw_noise(prepared, WHITE, rng), model, {"Qx": WHITE})
    without = fit.without_run("run2")
    direct = solve_joint(
        [fit.design_blocks[0], fit.design_blocks[2]], model, {"Qx": WHITE}
    ).solution
    np.testing.assert_allclose(without.estimate, direct.estimate, rtol=1e-12)
    np.testing.assert_allclose(without.covariance, direct.covariance, rtol=1e-12)
    alone = replace(fit, observations=fit.design_blocks[:1], blocks=fit.blocks[:1])
    assert alone.without_run("run1") is None


def test_changed_noise_matches_fit_with_that_noise():
    model = Unknowns(tuple(u for name in SCALES for u in make_unknowns(("K_F", "K_I"), owner=name)))
    truth = {s: TRUTH[s] for s in ("K_F", "K_I")}
    series = [
        record for name in SCALES for record in simulate_three_rates(truth, accelerometer=name)
    ]
    prepared = build_design_blocks(series, model, SCALES)
    fit = solve_joint(prepared, model, {"Qx": WHITE, "Qy": MIXED})
    changed = fit.with_noise({"Qy": WHITE})
    direct = solve_joint(prepared, model, {"Qx": WHITE, "Qy": WHITE})
    assert changed.noise == direct.noise
    np.testing.assert_array_equal(changed.solution.covariance, direct.solution.covariance)
    assert not np.allclose(fit.solution.u[2:], direct.solution.u[2:], rtol=0.1)


@pytest.mark.parametrize("level", [Noise(0.02), Noise(3.0, 0.0, 0.5)])
def test_changed_white_noise_matches_fit_with_that_noise(level):
    model = Unknowns(
        make_unknowns(("K_F", "K_I", "K_II")), (Considered("Qx", "K_III", (0.0, 1e-7), 1e-4),)
    )
    # Of time stamps' noise the runs have differently much.
    series = [
        record.with_timestamp_noise(1e-3 * i)
        for i, record in enumerate(simulate_three_rates(TRUTH))
    ]
    prepared = redraw_noise(
        build_design_blocks(series, model, SCALES), WHITE, np.random.default_rng(8)
    )
    changed = solve_joint(prepared, model, {"Qx": WHITE}).with_noise({"Qx": level})
    direct = solve_joint(prepared, model, {"Qx": level})
    np.testing.assert_allclose(changed.solution.covariance, direct.solution.covariance, rtol=1e-10)
    np.testing.assert_allclose(changed.solution.estimate, direct.solution.estimate, rtol=1e-10)
    for first, second in zip(changed.blocks, direct.blocks, strict=True):
        assert first.rss == pytest.approx(second.rss, rel=1e-9, abs=0)
    assert changed.noise == direct.noise


def test_residuals_are_noise_minus_projection_on_design(paper_series):
    model, prepared = paper_series
    rng = np.random.default_rng(7)
    for noise in (WHITE, MIXED):
        fit = solve_joint(redraw_noise(prepared, noise, rng), model, {"Qx": noise})
        whitened = [fit.residuals[i].whitened for i in range(3)]
        rss = sum(float(w @ w) for w in whitened)
        step = fit.solution.estimate - [
            u.prior[0] - u.nominal if math.isfinite(u.prior[1]) else 0.0 for u in model.unknowns
        ]
        priors = sum(
            (step[i] / u.prior[1]) ** 2
            for i, u in enumerate(model.unknowns)
            if math.isfinite(u.prior[1])
        )
        # Block by block, the same sum of squares as the solution's own.
        assert rss + priors == pytest.approx(fit.solution.chi2, rel=1e-9)
        plain = fit.residuals[0].unweighted
        own = np.column_stack([np.ones(plain.size), prepared[0].series.time])
        if noise is WHITE:
            assert np.abs(own.T @ plain).max() < 1e-8 * np.abs(own.T).max() * plain.size


def test_block_means_preserve_information_on_k_ii():
    dense = [
        record.drop_rows(record.time == record.time[-1])
        for record in simulate_three_rates(TRUTH, per_revolution=320, revolutions=6)
    ]
    size = 5  # 64 blocks a revolution
    blocks = []
    for one in dense:
        whole = one.time.reshape(-1, size)
        blocks.append(
            replace(
                one,
                time=whole.mean(axis=1),
                time_sd=whole.std(axis=1),
                count=np.full(len(whole), float(size)),
                error=one.error.reshape(-1, size).mean(axis=1),
            )
        )
    model = Unknowns(make_unknowns(TRUTH))
    (percent,) = find_numbers(
        "campaign", "averaging increases the standard uncertainty of K_II by less than {} %"
    )
    for noise in (WHITE, MIXED):
        full, means = (
            solve_joint(build_design_blocks(s, model, SCALES), model, {"Qx": noise}).solution
            for s in (dense, blocks)
        )
        np.testing.assert_allclose(means.estimate, full.estimate, atol=2e-4 * full.u.min())
        ratio = means.u / full.u
        assert ratio[2] == pytest.approx(1.0, abs=parse_number(percent) / 100.0)
        assert (ratio < 1.006).all()


def test_record_too_short_for_start_errors_raises():
    model = Unknowns(make_unknowns(("K_F", "K_II")))
    short = simulate_series("run1", 2.0, {}, revolutions=1, per_revolution=1)
    short = short.drop_rows(np.array([True, False]))
    with pytest.raises(NotIdentifiableError, match="too short"):
        solve_joint(build_design_blocks([short], model, SCALES), model, {"Qx": WHITE})


# Uncertain inputs ---------------------------------------------------------------------------------


def test_updated_design_blocks_match_new_ones():
    k_oo = Considered("Qx", "K_OO", (1e-6, 2e-6), 1e-4)
    gyro = Considered("", "platform.drift.up", (0.0, 1e-9), 1e-6)
    tilt = Unknown("run1", "platform.tilt.north", (0.0, 1e-5), 1e-2)
    series = simulate_three_rates(TRUTH)
    before = Unknowns((*make_unknowns(TRUTH, PRIORS), tilt), (gyro,))
    after = replace(
        before, considered=(k_oo, gyro, *make_considered_inputs({"centrifuge.radius": 1e-4}))
    )
    fit = solve_joint(build_design_blocks(series, before, SCALES), before, {"Qx": WHITE})
    other = {"Qx": 1.5}
    known = dict(zip(before.unknowns, fit.solution.estimate.tolist(), strict=True))
    again = update_design_blocks(fit.design_blocks, before, after, other, known)
    anew = build_design_blocks(series, after, other, fit.solution.estimate)
    for first, second in zip(again, anew, strict=True):
        assert (first.scale_factor, first.unknowns, first.considered) == (
            second.scale_factor,
            second.unknowns,
            second.considered,
        )
        for got, expected in (
            (first.design, second.design),
            (first.considered_design, second.considered_design),
        ):
            error = np.abs(got - expected).max(axis=0)
            assert (error < 1e-12 * np.abs(expected).max(axis=0)).all()


def test_input_sensitivity_matches_difference_of_estimates():
    spindle = {rate: Spindle(rate, 1e-6, start_angle=0.4) for rate in RATES}
    series = [
        simulate_series(f"run{i}", rate, TRUTH, spindle=spindle[rate])
        for i, rate in enumerate(RATES)
    ]
    sizes = {
        "centrifuge.radius": 1e-4,
        "site.gravity": 1e-4,
        "site.latitude": 1e-3,
        TIMING: 1e-6,
    }
    model = Unknowns(make_unknowns(TRUTH, PRIORS), make_considered_inputs(sizes))
    plain = model.without_inputs()
    noise = {"Qx": WHITE}
    first = solve_joint(build_design_blocks(series, plain, SCALES), plain, noise).solution
    fit = solve_joint(build_design_blocks(series, model, SCALES, first.estimate), model, noise)

    def assumed(name, size):
        """The estimate from the same output when another value of the input is taken."""
        moved = []
        for record in series:
            if name == TIMING:
                # Angles taken later were reached later: the spindle was behind by that time.
                behind = replace(
                    record.trajectory.spindle,
                    start_angle=float(record.trajectory.spindle.angle(np.array([-size]))[0]),
                    rate=float(record.trajectory.spindle.angular_rate(np.array([-size]))[0]),
                )
                motion = replace(record.trajectory, spindle=behind)
            else:
                motion = INPUT_PERTURBATIONS[name](record.trajectory, size)
            error = record.error + record.reference() - record.reference(motion)
            moved.append(replace(record, trajectory=motion, error=error))
        prepared = build_design_blocks(moved, plain, SCALES)
        return solve_joint(prepared, plain, noise).solution.estimate

    for place, (name, size) in enumerate(sizes.items()):
        by_difference = (assumed(name, size) - assumed(name, -size)) / (2 * size)
        scale = np.abs(fit.solution.sensitivity_considered[:, place]).max()
        np.testing.assert_allclose(
            fit.solution.sensitivity_considered[:, place],
            by_difference,
            rtol=5e-3,
            atol=1e-6 * scale,
            err_msg=name,
        )


@pytest.mark.parametrize("noise", [Noise(5e-4), Noise(5e-4, 1.5e-5)], ids=["white", "mixed"])
def test_input_with_prior_matches_dense_least_squares(noise):
    """Use dense covariances, priors as observations and a simulated radius column."""
    radius, u = 2.5, 1e-4
    sizes = {"site.gravity": 1e-4, "centrifuge.radius": u}
    true_radius = radius + 1.5 * u
    rng = np.random.default_rng(41)
    series, rows, values = [], [], []
    for i, rate in enumerate(RATES):
        nominal = simulate_series(f"run{i}", rate, TRUTH)

        def output(of_run=(f"run{i}", rate), nominal=nominal, **changed):
            """What is recorded in another world, less what this one would show."""
            series = simulate_series(*of_run, TRUTH, **changed)
            return series.error + series.reference() - nominal.reference()

        new_noise = add_noise(replace(nominal, error=output(radius=true_radius)), noise, rng)
        columns = [
            *new_noise.columns(list(TRUTH), 1.0).T,
            (output(site=replace(SITE, gravity=SITE.gravity + 1e-3)) - nominal.error) / 1e-3,
            (output(radius=radius + 1e-3) - output(radius=radius - 1e-3)) / 2e-3,
        ]
        t = new_noise.time
        early, late = np.minimum.outer(t, t), np.maximum.outer(t, t)
        walk = noise.random_walk**2 * early**2 * (3 * late - early) / 6
        root = np.linalg.cholesky(noise.white**2 * np.eye(t.size) + walk)
        start = np.zeros((t.size, 2 * len(RATES)))
        start[:, 2 * i : 2 * i + 2] = np.column_stack([np.ones(t.size), t])
        rows.append(np.linalg.solve(root, np.column_stack([*columns, start])))
        values.append(np.linalg.solve(root, new_noise.error))
        series.append(new_noise)
    known = [*(PRIORS.get(s, NO_PRIOR) for s in TRUTH), *((0.0, size) for size in sizes.values())]
    for place, (value, size) in enumerate(known):
        if math.isfinite(size):
            row = np.zeros((1, rows[0].shape[1]))
            row[0, place] = 1.0 / size
            rows.append(row)
            values.append([(value - (1.0 if place == 1 else 0.0)) / size])
    design, observed = np.vstack(rows), np.concatenate(values)
    scale = np.linalg.norm(design, axis=0)
    normal = np.linalg.inv((design / scale).T @ (design / scale))
    expected = normal @ ((design / scale).T @ observed) / scale
    p = len(known)
    covariance = (normal / scale / scale[:, None])[:p, :p]

    inputs = [Unknown("", s, (0.0, u), 0.1, is_of_interest=False) for s, u in sizes.items()]
    model = Unknowns((*make_unknowns(TRUTH, PRIORS), *inputs))
    request = {"Qx": Noise(noise.white, noise.random_walk)}
    solution = estimate(series, model, request, rejects_outliers=False).fit.solution
    spread = np.sqrt(np.diag(covariance))
    # Derivatives are taken at the estimate here, at the truth there.
    np.testing.assert_allclose(solution.estimate / spread, expected[:p] / spread, atol=2e-3)
    np.testing.assert_allclose(
        solution.covariance / np.outer(spread, spread),
        covariance / np.outer(spread, spread),
        atol=1e-3,
    )
    # The records tell of the radius, with K_I known beforehand, what its prior does not.
    assert solution.u[-1] < 0.5 * u
    assert solution.estimate[-1] == pytest.approx(1.5 * u, abs=4 * solution.u[-1])


def test_gravity_derivative_of_record_in_g_has_no_noise():
    """Else a gravity of zero explains all of the record: its noise is then as small as it is."""
    truth = {"K_F": 5e-3, "K_II": 2.7e-5}
    model = Unknowns(make_unknowns(truth), make_considered_inputs({"site.gravity": 1e-5}))
    true = np.array(list(truth.values()))
    clean = [
        replace(record, in_g=True)
        for record in simulate_three_rates(truth, observable="specific_force", per_revolution=16)
    ]
    rng = np.random.default_rng(31)
    noisy = [
        replace(one, error=one.error + 0.01 * rng.standard_normal(one.time.size)) for one in clean
    ]
    columns = [
        [part.considered_design for part in build_design_blocks(series, model, {"Qx": 1.0}, true)]
        for series in (clean, noisy)
    ]
    for one, same, other in zip(clean, *columns, strict=True):
        np.testing.assert_array_equal(other, same)
        # g K_F + K_II a^2/g, a being what it is in m/s^2, less what the record is in g.
        acting = one.trajectory.site.gravity
        force = one.reference() + one.columns(list(truth), 1.0) @ true
        change = one.columns(["K_F", "K_II"], 1.0) @ (true * [1.0, -1.0])
        np.testing.assert_allclose(same[:, 0], (change - force) / acting, atol=1e-6)


def test_mean_chi_square_of_runs_is_degrees_of_freedom():
    """Priors drawn, noise drawn: the mean of each run's sum of squares, to sampling error."""
    priors = {"K_F": (5.03e-3, 2e-6), "K_II": (2.7e-5, 1e-7)}
    model = Unknowns(
        (
            *make_unknowns(TRUTH, priors),
            Unknown("run1", "platform.tilt.north", (0.0, ARCSEC), 1e-2),
            Unknown("", "platform.drift.up", (0.0, np.inf), 10 * DEG_H),
        )
    )
    rng = np.random.default_rng(23)
    clean = build_design_blocks(
        simulate_three_rates(TRUTH, revolutions=2, per_revolution=6), model, SCALES
    )
    sd = np.array([u.prior[1] if np.isfinite(u.prior[1]) else 0.0 for u in model.unknowns])
    trials, sums = 700, np.zeros(3)
    for _ in range(trials):
        off = sd * rng.standard_normal(sd.size)
        drawn = []
        for one in redraw_noise(clean, WHITE, rng):
            error = one.series.error + one.design @ off[list(one.unknowns)]
            drawn.append(replace(one, series=replace(one.series, error=error)))
        fit = solve_joint(drawn, model, {"Qx": WHITE})
        sums += [np.sum(fit.residuals[index].whitened ** 2) for index in range(3)]
    expected = np.array(fit.degrees_of_freedom)
    np.testing.assert_allclose(
        sums / trials, expected, atol=4 * np.sqrt(2 * expected / trials).max()
    )
    # Eleven unknowns in all and three priors: not a whole number, and not the same in each run.
    assert expected.sum() == pytest.approx(fit.solution.dof - 3, abs=3)
    assert np.ptp(expected) > 0.1


@pytest.mark.slow
@pytest.mark.parametrize("noise", [WHITE, MIXED], ids=["white", "mixed"])
def test_considered_term_within_uncertainty_fits(noise):
    """Tilts drawn from their priors: false alarms are as frequent as stated, 1 in 100.

    The tilts are seen in the records, forty times the noise at the end of the longest run, and so
    would be a lack of fit against the noise alone in every trial.
    """
    own = make_unknowns(TRUTH, {"K_F": (TRUTH["K_F"], 2e-6)})
    tilts = tuple(
        Considered(f"run{i}", "platform.tilt.north", (0.0, 30 * ARCSEC), 1e-2) for i in (1, 2, 3)
    )
    model = Unknowns(own, tilts)
    clean = build_design_blocks(
        simulate_three_rates(TRUTH, revolutions=6, per_revolution=16), model, SCALES
    )
    rng = np.random.default_rng(31)
    trials, alarms, p_values, naive = 300 if FULL else 60, 0, [], 0
    for _ in range(trials):
        drawn = []
        for part in redraw_noise(clean, noise, rng):
            tilt = 30 * ARCSEC * rng.standard_normal()
            error = part.series.error + part.considered_design[:, 0] * tilt
            drawn.append(replace(part, series=replace(part.series, error=error)))
        fit = solve_joint(drawn, model, {"Qx": noise})
        rows = {f"run{i + 1}": left.whitened for i, left in enumerate(fit.residuals)}
        freedom = dict(zip(rows, fit.degrees_of_freedom, strict=True))
        tests = diagnose(rows, freedom, noise_given=True)
        alarms += bool(tests.findings)
        p_values.append(tests.lack_of_fit_p)
        naive += chi_square_tail(fit.solution.dof, fit.solution.chi2) < SIGNIFICANCE
    assert naive > 0.5 * trials
    expected = SIGNIFICANCE * trials
    assert alarms <= expected + 4 * math.sqrt(expected)
    # The probability of a worse fit is evenly spread: mean 1/2, variance 1/12.
    assert np.mean(p_values) == pytest.approx(0.5, abs=4 / math.sqrt(12 * trials))

import math
import os
from dataclasses import replace

import numpy as np
import pytest
from scipy.special import ndtri, stdtrit

from counterspin.errors import NotIdentifiableError
from counterspin.inference.noise.likelihood import RecordData, RestrictedLikelihood
from counterspin.inference.noise.model import (
    ESTIMATE,
    Differences,
    Noise,
    information_loss,
    make_whitener,
)
from counterspin.inference.noise.search import (
    MIN_LIKELIHOOD_GAIN,
    _newton_step,
    effective_dof,
    estimate_noise,
)
from counterspin.inference.noise.simulation import draw_bias_noise

TRIALS = 4000 if os.environ.get("COUNTERSPIN_FULL") else 80
STEP = 0.5
BOTH = Noise(ESTIMATE, ESTIMATE)


def ratio(size):
    return (1.0, size, 0.0, 0.0)


def columns(times, rate=2.0):
    """K_F's column, that is K_II's slow part, and the two harmonics of a turn, metres per unit."""
    return np.column_stack([times**2 / 2, np.cos(rate * times), np.cos(2 * rate * times)])


def walk_of(rng, order, n, step):
    """Exact samples of a once or doubly integrated unit white noise."""
    push, lever = rng.normal(size=(2, n))
    velocity = np.sqrt(step) * push
    if order == 1:
        return np.cumsum(velocity)
    before = np.concatenate(([0], np.cumsum(velocity)[:-1]))
    return np.cumsum(before * step + step**1.5 * (push / 2 + lever / np.sqrt(12)))


def record(rng, n, noise, order=2):
    times = np.arange(n) * STEP
    signal = noise.random_walk * walk_of(rng, order, n, STEP) + noise.white * rng.normal(size=n)
    if noise.quantisation:
        signal = noise.quantisation * np.round(signal / noise.quantisation)
    return RecordData(times, order, columns(times), signal + 3.0 + 0.2 * times * (order == 2))


def test_white_noise_is_rss_over_degrees_of_freedom():
    rng = np.random.default_rng(1)
    data = record(rng, 200, Noise(0.3))
    noise = estimate_noise([data], Noise(ESTIMATE))
    everything = np.column_stack([np.ones(200), data.times, data.design])
    rss = np.linalg.lstsq(everything, data.observations, rcond=None)[1][0]
    assert noise.noise.white**2 == pytest.approx(rss / 195, rel=1e-9)
    assert noise.degrees_of_freedom == 195
    assert noise.estimated == ("white",)
    assert noise.covariance[0, 0] == pytest.approx(2 * (rss / 195) ** 2 / 195, rel=1e-8)
    assert not noise.covariance[1].any()

    variances = noise.noise.white**2 * np.array([1.0, 7.0])
    slope = np.outer([1.0, 7.0], [1.0, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(effective_dof(variances, slope, noise.covariance), 195, rtol=1e-8)


def dense_restricted(data, noise, prior_rows, prior_values):
    """Restricted log-likelihood as the textbooks write it, n x n."""
    n = len(data.times)
    t = data.times - data.times[0]
    early, late = np.minimum.outer(t, t), np.maximum.outer(t, t)
    covariance = (
        noise.white**2 * np.eye(n) + noise.random_walk**2 * early**2 * (3 * late - early) / 6
    )
    x = np.column_stack([np.ones(n), t, data.design])
    rows = np.column_stack([np.zeros((len(prior_rows), 2)), prior_rows])
    information = x.T @ np.linalg.solve(covariance, x) + rows.T @ rows
    right = x.T @ np.linalg.solve(covariance, data.observations) + rows.T @ prior_values
    beta = np.linalg.solve(information, right)
    e, f = data.observations - x @ beta, prior_values - rows @ beta
    return -0.5 * (
        np.linalg.slogdet(covariance)[1]
        + np.linalg.slogdet(information)[1]
        + e @ np.linalg.solve(covariance, e)
        + f @ f
    )


@pytest.mark.parametrize("priors", [np.zeros((0, 3)), np.diag([50.0, 0.0, 3.0])[[0, 2]]])
def test_likelihood_matches_dense_likelihood_up_to_constant(priors):
    data = record(np.random.default_rng(2), 40, Noise(0.3, 0.2))
    values = np.full(len(priors), 0.4)
    likelihood = RestrictedLikelihood.from_records([data], priors, values)
    noises = [
        Noise(0.3, 0.2),
        Noise(0.5, 0.01),
        Noise(0.02, 0.4),
        Noise(1.0, 0.0),
    ]
    ours = [
        likelihood.value(2 * np.log(n.white), ratio((n.random_walk / n.white) ** 2)) for n in noises
    ]
    dense = [dense_restricted(data, n, priors, values) for n in noises]
    np.testing.assert_allclose(np.diff(ours), np.diff(dense), atol=1e-6)
    # The slope that finds the scale is the value's.
    unit = ratio(0.3)
    up, down = (likelihood.value(a, unit) for a in (-2 + 1e-4, -2 - 1e-4))
    assert likelihood.slope(-2, unit) == pytest.approx((up - down) / 2e-4, rel=1e-6)
    assert likelihood.slope(likelihood.best_scale(unit), unit) == pytest.approx(0, abs=1e-9)


@pytest.fixture(scope="module")
def mixed_noise_trials():
    """Trials of a short mixed-noise record: noise components, coefficients, u, dof."""
    noise, n, rng = Noise(0.3, 0.1), 120, np.random.default_rng(3)
    times = np.arange(n) * STEP
    polynomials = np.column_stack([np.ones(n), times])

    def covariance(level):
        whitener = make_whitener(times, 2, level)
        design = columns(times)
        if whitener.polynomials:
            design = np.column_stack([design, polynomials])
        return whitener, np.linalg.pinv(whitener.apply(design))

    def variances(level):
        return np.square(covariance(level)[1][:3]).sum(axis=1)

    rows = []
    for _ in range(TRIALS):
        data = record(rng, n, noise)
        actual_noise = estimate_noise([data], BOTH)
        whitener, gain = covariance(actual_noise.noise)
        estimated = gain[:3] @ whitener.apply(data.observations)
        u = np.sqrt(variances(actual_noise.noise))
        inverse = gain[:3] @ gain[:3].T
        lost = information_loss(
            Differences.from_times(times, 2), columns(times), actual_noise.noise
        )
        slopes = np.diagonal(inverse @ lost @ inverse, axis1=1, axis2=2).T
        rows.append(
            (actual_noise, estimated, u, effective_dof(u**2, slopes, actual_noise.covariance))
        )
    return noise, rows, np.sqrt(variances(noise))


@pytest.mark.slow
def test_components_are_unbiased_and_covariance_matches_scatter(mixed_noise_trials):
    noise, rows, _ = mixed_noise_trials
    components = np.array([f.noise.variances[:2] for f, *_ in rows])
    truth = np.array([noise.white, noise.random_walk]) ** 2
    spread = components.std(axis=0, ddof=1)
    assert (np.abs(components.mean(axis=0) - truth) < 4 * spread / np.sqrt(TRIALS)).all()
    # The information is observed at each estimate: its typical value, to what 80 trials can tell.
    claimed = np.sqrt([np.median([f.covariance[k, k] for f, *_ in rows]) for k in range(2)])
    np.testing.assert_allclose(claimed, spread, rtol=0.3)


@pytest.mark.slow
def test_estimates_reach_bound(mixed_noise_trials):
    _, rows, bound = mixed_noise_trials
    scatter = np.array([estimated for _, estimated, *_ in rows]).std(axis=0, ddof=1)
    # Estimated weights cost a few per cent; the scatter itself is known to 1/sqrt(2 trials).
    assert (scatter < bound * (1.04 + 3 / np.sqrt(2 * TRIALS))).all()
    assert (scatter > bound * (1 - 4 / np.sqrt(2 * TRIALS))).all()


@pytest.mark.slow
def test_student_t_intervals_have_coverage(mixed_noise_trials):
    _, rows, _ = mixed_noise_trials
    estimated, u, dof = (np.array([row[k] for row in rows]) for k in (1, 2, 3))
    student = (np.abs(estimated) < stdtrit(dof, 0.975) * u).mean(axis=0)
    normal = (np.abs(estimated) < ndtri(0.975) * u).mean(axis=0)
    sampling = np.sqrt(0.95 * 0.05 / TRIALS)
    np.testing.assert_allclose(student, 0.95, atol=3 * sampling + 0.01)
    # A handful of degrees of freedom carry the slow column, nearly all rows the harmonic.
    assert np.median(dof[:, 0]) < 0.5 * np.median(dof[:, 2]) < 60
    assert (normal <= student).all()


@pytest.mark.slow
def test_absent_walk_is_rarely_estimated():
    rng = np.random.default_rng(4)
    kept = sum(
        "random_walk" in estimate_noise([record(rng, 100, Noise(0.3))], BOTH).estimated
        for _ in range(TRIALS)
    )
    # 5 % at most; the mixture's half at zero is larger in short records, so somewhat fewer.
    assert kept / TRIALS < 0.05 + 3 * np.sqrt(0.05 * 0.95 / TRIALS)
    assert kept > 0


def test_threshold_matches_chi_square_mixture():
    from scipy.special import chdtrc

    assert 0.5 * chdtrc(1, MIN_LIKELIHOOD_GAIN) == pytest.approx(0.05, rel=1e-12)


def test_present_walk_is_estimated():
    rng = np.random.default_rng(5)
    noise = estimate_noise([record(rng, 800, Noise(0.3, 0.05))], BOTH)
    assert noise.estimated == ("white", "random_walk")
    assert noise.dropped == ()
    levels = np.array([noise.noise.white**2, noise.noise.random_walk**2])
    assert (np.abs(levels - [0.09, 0.0025]) < 4 * np.sqrt(np.diag(noise.covariance)[:2])).all()
    assert noise.evaluations <= 30
    likelihoods = noise.log_likelihoods
    assert likelihoods["white", "random_walk"] - likelihoods["white",] > 10


def test_negligible_component_does_not_delay_search():
    """Its likelihood goes with -e^x: a factor of e a step; the other is found in one."""

    def value(x):
        return -50.0 * (x[0] - 1.3) ** 2 - 0.02 * math.exp(x[1])

    x, gain = _newton_step(value, np.array([1.0, 0.0]))
    np.testing.assert_allclose(x, [1.3, -1.0], atol=1e-3)
    assert gain == pytest.approx(50.0 * 0.3**2 + 0.01, rel=1e-3)
    # From where it does not show, upward and as far as may be.
    x, _ = _newton_step(lambda x: 0.02 * math.exp(x[0]), np.zeros(1))
    assert x[0] == 3.0


@pytest.mark.parametrize("order", [2, 1])
def test_pure_walk_has_no_white_noise(order):
    noise = estimate_noise([record(np.random.default_rng(6), 400, Noise(0.0, 0.2), order)], BOTH)
    assert noise.dropped == ("white",)
    assert noise.noise.white == 0
    assert noise.noise.random_walk == pytest.approx(0.2, rel=4 / np.sqrt(2 * 400))
    assert noise.covariance[1, 1] == pytest.approx(2 * 0.2**4 / 395, rel=0.3)


@pytest.mark.parametrize("added", [0.0, 2.5e-5], ids=["all to be found", "part of it known"])
def test_misfit_is_estimated_as_most_likely_noise(added):
    """A wave that the unknowns do not follow: a little walk only makes it less likely."""
    times = 0.1 * np.arange(400)
    wave = 0.3 * np.sin(math.pi * times)
    observed = wave + 0.01 * np.random.default_rng(11).standard_normal(times.size)
    data = RecordData(times, 2, np.empty((times.size, 0)), observed, added_variance=added)
    likelihood = RestrictedLikelihood.from_records([replace(data, added_variance=0.0)], None, None)
    grid = [ratio(math.exp(size)) for size in np.arange(-25.0, 20.0, 0.25)]
    dense = [likelihood.value(likelihood.best_scale(unit), unit) for unit in grid]
    assert min(dense[: int(np.argmax(dense))]) < dense[0] - 10.0
    noise = estimate_noise([data], BOTH)
    assert noise.estimated == ("white", "random_walk")
    assert noise.log_likelihoods["white", "random_walk"] >= max(dense) - 1e-6
    assert math.hypot(noise.noise.white, math.sqrt(added)) < 0.02


def test_velocity_records_share_noise():
    rng = np.random.default_rng(7)
    records = [record(rng, n, Noise(0.3, 0.2), order=1) for n in (300, 500)]
    noise = estimate_noise(records, BOTH)
    levels = np.array([noise.noise.white**2, noise.noise.random_walk**2])
    assert (np.abs(levels - [0.09, 0.04]) < 4 * np.sqrt(np.diag(noise.covariance)[:2])).all()
    alone = estimate_noise(records[:1], BOTH)
    assert (np.diag(noise.covariance)[:2] < np.diag(alone.covariance)[:2]).all()


def test_specific_force_does_not_separate_walk_from_white_noise():
    rng = np.random.default_rng(8)
    design = rng.normal(size=(300, 2))
    data = RecordData(np.arange(300) * 0.5, 0, design, 0.1 * rng.normal(size=300))
    noise = estimate_noise([data], BOTH)
    assert noise.estimated == ("white",)
    assert noise.degrees_of_freedom == 298
    # With the walk given, the white part is what is left: 0.1^2 = white^2 + N^2/h.
    given = estimate_noise([data], Noise(ESTIMATE, 0.03)).noise
    assert given.white**2 + 0.03**2 / 0.5 == pytest.approx(noise.noise.white**2, rel=1e-3)
    assert given.random_walk == 0.03


def test_given_components_are_fixed():
    data = record(np.random.default_rng(9), 400, Noise(0.3, 0.1))
    both = estimate_noise([data], BOTH)
    white_only = estimate_noise([data], Noise(ESTIMATE, both.noise.random_walk))
    walk_only = estimate_noise([data], Noise(both.noise.white, ESTIMATE))
    assert white_only.noise.white == pytest.approx(both.noise.white, rel=1e-3)
    assert walk_only.noise.random_walk == pytest.approx(both.noise.random_walk, rel=2e-3)
    # Knowing the other one helps, and how much is what the joint covariance says.
    given = 1 / np.diag(np.linalg.inv(both.covariance[:2, :2]))
    assert white_only.covariance[0, 0] == pytest.approx(given[0], rel=0.01)
    assert walk_only.covariance[1, 1] == pytest.approx(given[1], rel=0.01)
    neither = estimate_noise([data], Noise(0.3, 0.1))
    assert (neither.noise, neither.estimated) == (Noise(0.3, 0.1), ())
    assert not neither.covariance.any()


def test_quantisation_larger_than_noise():
    rng = np.random.default_rng(10)
    data = record(rng, 500, Noise(0.05, 0.0, 1.0))
    # The start velocity sweeps the signal over many steps, so that rounding errors are spread.
    swept = 1.0 * np.round(data.observations + 0.37 * data.times)
    noise = estimate_noise([replace(data, observations=swept)], Noise(ESTIMATE, ESTIMATE, 1.0))
    assert noise.noise.quantisation == 1.0
    assert noise.noise.sample_variance == pytest.approx(1 / 12, rel=4 * np.sqrt(2 / 500))
    # Most residuals equal zero: no smaller than the step allows, and not singular.
    still = np.zeros(500)
    still[::50] = 1.0
    noise = estimate_noise([replace(data, observations=still)], Noise(ESTIMATE, ESTIMATE, 1.0))
    assert noise.noise.white == 0
    assert noise.estimated == ()
    assert noise.noise.sample_variance == pytest.approx(1 / 12)


def test_start_errors_and_repeated_columns_count_once():
    data = record(np.random.default_rng(11), 200, Noise(0.3))
    more = np.column_stack(
        [data.design, np.ones(200), data.times, data.design[:, 0], np.zeros(200)]
    )
    plain, padded = estimate_noise([data], BOTH), estimate_noise([replace(data, design=more)], BOTH)
    assert padded.degrees_of_freedom == plain.degrees_of_freedom
    assert padded.noise.white == pytest.approx(plain.noise.white, rel=1e-6)


def test_priors_increase_degrees_of_freedom():
    data = record(np.random.default_rng(12), 60, Noise(0.3))
    loose, tight = (
        estimate_noise([data], Noise(ESTIMATE), np.eye(3) * w, np.zeros(3)) for w in (1e-6, 1e6)
    )
    free = estimate_noise([data], Noise(ESTIMATE))
    assert loose.noise.white == pytest.approx(free.noise.white, rel=1e-6)
    assert loose.degrees_of_freedom == pytest.approx(55, abs=1e-6)
    assert tight.degrees_of_freedom == pytest.approx(58, abs=1e-6)


def test_dof_of_sum_matches_welch_satterthwaite():
    """Welch-Satterthwaite: s1^2/n1 + s2^2/n2."""
    s1, s2, n1, n2 = 2.0, 3.0, 8, 15
    covariance = np.diag([2 * s1**4 / (n1 - 1), 2 * s2**4 / (n2 - 1)])
    parts = np.array([s1**2 / n1, s2**2 / n2])
    welch = parts.sum() ** 2 / (parts**2 / [n1 - 1, n2 - 1]).sum()
    gradient = [[1 / n1, 1 / n2], [0, 0]]
    dof = effective_dof([parts.sum(), 1.0], gradient, covariance)
    np.testing.assert_allclose(dof, [welch, np.inf], rtol=1e-12)


def test_undeterminable_noise_raises():
    data = record(np.random.default_rng(13), 40, Noise(0.3))
    with pytest.raises(NotIdentifiableError, match="all residuals are zero"):
        estimate_noise([replace(data, observations=np.zeros(40))], BOTH)
    short = RecordData(data.times[:5], 2, np.asarray(data.design)[:5], data.observations[:5])
    with pytest.raises(NotIdentifiableError, match="too few"):
        estimate_noise([short], BOTH)
    with pytest.raises(ValueError, match="without records"):
        estimate_noise([], BOTH)
    with pytest.raises(ValueError, match="different observables"):
        estimate_noise([data, replace(data, order=1)], BOTH)
    with pytest.raises(ValueError, match="all components"):
        estimate_noise([data], Noise(0.0, 0.0))


def test_records_may_list_affected_unknowns():
    """A column of a record's own, with a prior: compact and with zeros for the others."""
    rng = np.random.default_rng(31)
    compact, dense = [], []
    for k in range(3):
        times = np.sort(rng.uniform(0, 40, 150)) + 0.05 * np.arange(150)
        common, own = np.cos(times), np.sin((k + 2) * times)
        y = 0.3 * common + 0.1 * rng.standard_normal(150) + 2e-2 * walk_of(rng, 2, 150, STEP)
        compact.append(
            RecordData(times, 2, np.column_stack([own, common]), y, column_indices=[k + 1, 0])
        )
        design = np.zeros((150, 4))
        design[:, [k + 1, 0]] = np.column_stack([own, common])
        dense.append(RecordData(times, 2, design, y))
    prior = {"prior_rows": np.eye(4) / 0.05, "prior_values": np.zeros(4)}
    first, second = (estimate_noise(records, BOTH, **prior) for records in (compact, dense))
    assert first.noise.variances == pytest.approx(second.noise.variances, rel=1e-6)
    assert first.degrees_of_freedom == pytest.approx(second.degrees_of_freedom, rel=1e-9)
    for names, value in first.log_likelihoods.items():
        assert value == pytest.approx(second.log_likelihoods[names], rel=1e-9)


# Wander -------------------------------------------------------------------------------------------


def test_flicker_sizes_are_estimated():
    """Two records of specific force: each size within three of its standard errors."""
    rng = np.random.default_rng(11)
    noise = Noise(1e-4, 0.0, 0.0, flicker=4e-5, bias_walk=0.0)
    times = np.arange(400) * 0.5
    records = [
        RecordData(
            times,
            0,
            np.ones((times.size, 1)),
            noise.white * rng.standard_normal(times.size)
            + draw_bias_noise(rng, times, Noise(0.0, flicker=noise.flicker), 0),
            column_indices=[0],
        )
        for _ in range(2)
    ]
    actual_noise = estimate_noise(records, Noise(ESTIMATE, 0.0, 0.0, ESTIMATE, 0.0))
    assert actual_noise.estimated == ("white", "flicker")
    for place, name in ((0, "white"), (2, "flicker")):
        square = getattr(noise, name) ** 2
        error = math.sqrt(actual_noise.covariance[place, place])
        assert error < square
        assert abs(getattr(actual_noise.noise, name) ** 2 - square) < 3 * error


def test_absent_wander_is_dropped_or_small():
    rng = np.random.default_rng(4)
    times = np.arange(400) * 0.5
    white = 1e-3 * rng.standard_normal(times.size)
    records = [RecordData(times, 1, np.empty((times.size, 0)), white)]
    noise = estimate_noise(records, Noise(ESTIMATE, 0.0, 0.0, ESTIMATE, ESTIMATE))
    assert noise.noise.white == pytest.approx(1e-3, rel=0.1)
    assert "bias_walk" in noise.dropped
    # Over the whole record it would add less than the white noise of one sample.
    assert noise.noise.flicker * times[-1] < 2e-3

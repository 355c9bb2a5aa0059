"""What can be told apart: the cases of a level campaign, from closed forms at constant rate."""

import itertools
import math
import re

import mpmath
import numpy as np
import pytest

from counterspin.inference.identifiability import (
    NEAR_COLLINEAR,
    _Information,
    assess,
    format_combination,
)
from counterspin.inference.least_squares import reduce_block, solve
from counterspin.physics.accelerometer import QX, QY
from counterspin.physics.motion import Site, Trajectory
from counterspin.physics.observation import columns as exact_columns
from counterspin.physics.spindle import Spindle
from counterspin.physics.terms import term

GRAVITY, RADIUS, SIGMA = 9.8066, 2.5, 0.01
RATES = (np.pi / 2, np.pi, 2 * np.pi)
LIMITS = {"K_F": 0.1, "K_I": 0.1, "delta_O": 1e-2, "delta_P": 1e-2, "tilt": 1e-2}
TRUTH = {"K_F": 5e-3, "K_I": 2e-3, "K_II": 2e-5, "K_III": 5e-6, "K_IP": 1e-5, "K_OO": 3e-6}

# In the closed forms K_IP is -K_I; Earth rate adds a part in quadrature, of this relative size:
# with Qx the correlation becomes 1 - 6e-11, with Qy 0.98.
EARTH_QX, EARTH_QY = np.sqrt(2 * 6e-11), 0.2


def columns(t, rate, quadrature):
    """Metres per unit coefficient at constant rate (double integrals times g)."""
    phase = rate * t
    square = RADIUS**2 * rate**4 / GRAVITY
    ripple = (1 - np.cos(2 * phase)) / (8 * rate**2)
    bias = GRAVITY * t**2 / 2
    return {
        "K_F": bias,
        "K_PP": bias,
        "delta_O": -bias,
        "tilt": -bias,
        "K_I": RADIUS * (np.cos(phase) - 1),
        "K_IP": RADIUS * (1 - np.cos(phase) + quadrature * np.sin(phase)),
        "K_II": square * (t**2 / 4 + ripple),
        "K_OO": square * (t**2 / 4 - ripple),
        "K_IO": square * (t / (4 * rate) - np.sin(2 * phase) / (8 * rate**2)),
        "K_III": RADIUS**3
        * rate**4
        / GRAVITY**2
        * (3 / 4 * np.cos(phase) + np.cos(3 * phase) / 36 - 7 / 9),
        "K_PO": -RADIUS * (np.sin(phase) - phase),
        "delta_P": -RADIUS * (np.sin(phase) - phase),
    }


def campaign(symbols, priors=None, rates=RATES, quadrature=0.0, sigma=SIGMA):
    """Solve a synthetic campaign of 100 revolutions at each rate and assess it."""
    rng = np.random.default_rng(20)
    blocks = []
    for rate in rates:
        t = np.linspace(0.0, 100 * 2 * np.pi / rate, 4001)
        column = columns(t, rate, quadrature)
        # A term called "tilt.2" exists in the second run only.
        design = np.column_stack([_per_run(s, column, rates.index(rate)) for s in symbols])
        y = design @ [TRUTH.get(s, 0.0) for s in symbols] / sigma + rng.normal(size=t.size)
        own = np.column_stack([np.ones_like(t), t]) / sigma
        blocks.append(reduce_block(design / sigma, y, own))
    priors = priors or {}
    solution = solve(
        blocks,
        prior_mean=[TRUTH.get(s, 0.0) if s in priors else 0.0 for s in symbols],
        prior_sd=[priors.get(s, np.inf) for s in symbols],
        limits=[LIMITS.get(s.split(".")[0], 1e-4) for s in symbols],
    )
    return solution, assess(solution, symbols)


def _per_run(symbol, column, run):
    name, _, own_run = symbol.partition(".")
    return column[name] * (not own_run or int(own_run) == run + 1)


def evaluated(text, values):
    """Return each term's part of a combination that was printed."""
    parts = {}
    for sign, size, symbol in re.findall(r"([+-]?) ?([\d.e-]* ?)(K_\w+)", text):
        parts[symbol] = float(f"{sign}{size.strip() or 1}") * values[symbol]
    return parts


def found(assessment):
    return {item.determined: item for item in assessment.confounded}


class TestLevelCampaign:
    def test_independent_terms_are_determined(self):
        symbols = ["K_F", "K_I", "K_II", "K_III"]
        solution, assessment = campaign(symbols)
        assert assessment.determined == dict.fromkeys(symbols, True)
        assert assessment.confounded == ()
        np.testing.assert_allclose(assessment.u, solution.u, rtol=1e-9)

    def test_collinear_bias_and_scale_factor_are_confounded(self):
        symbols = ["K_F", "K_I", "K_II", "K_III", "K_IP", "K_PP"]
        plain, _ = campaign(symbols[:4])
        _, assessment = campaign(symbols)
        assert assessment.determined == {
            "K_F": False,
            "K_I": False,
            "K_II": True,
            "K_III": True,
            "K_IP": False,
            "K_PP": False,
        }
        sets = found(assessment)
        assert list(sets) == ["K_F + K_PP", "K_I - K_IP"]
        for text, terms, correlation, truth, twin in (
            ("K_F + K_PP", ["K_F", "K_PP"], -1.0, 5e-3, 0),
            ("K_I - K_IP", ["K_I", "K_IP"], 1.0, 2e-3 - 1e-5, 1),
        ):
            item = sets[text]
            assert item.terms == terms
            assert item.correlation == pytest.approx(correlation, abs=1e-12)
            # The sum is as well known as the first term is without its twin.
            assert item.u == pytest.approx(plain.u[twin], rel=1e-6)
            assert abs(item.value - truth) < 4.5 * item.u

    def test_nearly_collinear_columns_are_undetermined_at_full_rank(self):
        symbols = ["K_I", "K_II", "K_IP"]
        solution, assessment = campaign(symbols, quadrature=EARTH_QX)
        singular = np.linalg.svd(
            solution.information / np.linalg.norm(solution.information, axis=0), compute_uv=False
        )
        assert singular[-1] > 1e4 * np.finfo(float).eps * singular[0]  # full rank
        assert not assessment.determined["K_I"]
        assert not assessment.determined["K_IP"]
        item = found(assessment)["K_I - K_IP"]
        assert 1 - item.correlation == pytest.approx(6e-11, rel=0.05)
        assert abs(item.value - (2e-3 - 1e-5)) < 4.5 * item.u
        assert item.u < 1e-4

    def test_term_may_be_determined_without_partner(self):
        symbols = ["K_I", "K_II", "K_IP"]
        _, assessment = campaign(symbols, quadrature=EARTH_QY, sigma=SIGMA * 0.9)
        # u of both is about 2e-4: below 0.1 g/g, not below 1e-4 g/g^2
        assert assessment.determined["K_I"]
        assert not assessment.determined["K_IP"]
        item = found(assessment)["K_I - K_IP"]
        assert item.correlation == pytest.approx(1 / np.sqrt(1 + EARTH_QY**2), rel=1e-3)

    def test_two_second_order_terms_need_information(self):
        symbols = ["K_F", "K_I", "K_II", "K_III", "K_OO"]
        plain, _ = campaign(symbols[:4])
        _, weak = campaign(symbols, sigma=SIGMA / 4)
        # Told apart by their double harmonics, but a thousand times worse than their sum.
        assert weak.determined["K_II"]
        assert weak.determined["K_OO"]
        item = found(weak)["K_II + K_OO"]
        assert item.correlation < -0.999999
        assert item.u == pytest.approx(plain.u[2] / 4, rel=1e-3)
        assert weak.u[2] > 1000 * item.u
        assert abs(item.value - 2.3e-5) < 4.5 * item.u

    def test_prior_separates_second_order_terms(self):
        symbols = ["K_F", "K_I", "K_II", "K_III", "K_OO"]
        _, assessment = campaign(symbols, {"K_OO": 2e-6})
        assert assessment.determined["K_II"]
        assert not assessment.determined["K_OO"]  # its prior is all that is known of it
        assert assessment.u[2] == pytest.approx(2e-6, rel=1e-2)
        assert found(assessment)["K_II + K_OO"].correlation < -0.999999  # before the prior

    def test_prior_of_term_determines_collinear_term(self):
        symbols = ["K_F", "K_I", "K_II", "K_III", "K_PP"]
        solution, assessment = campaign(symbols, {"K_F": 2e-6})
        assert not assessment.determined["K_F"]
        assert assessment.determined["K_PP"]
        assert assessment.u[4] == pytest.approx(2e-6, rel=1e-4)
        assert abs(solution.estimate[4]) < 4.5 * 2e-6
        item = found(assessment)["K_F + K_PP"]
        assert item.correlation == pytest.approx(-1.0, abs=1e-12)
        assert item.u < 1e-8

    def test_priors_of_both_collinear_terms(self):
        symbols = ["K_F", "K_I", "K_II", "K_III", "K_PP"]
        _, assessment = campaign(symbols, {"K_F": 2e-6, "K_PP": 1e-6})
        # The sum ties them: u of both is that of the better prior, combined with the other.
        u = 1 / np.hypot(1 / 2e-6, 1 / 1e-6)
        assert assessment.u[0] == pytest.approx(u, rel=1e-3)
        assert assessment.u[4] == pytest.approx(u, rel=1e-3)
        assert assessment.determined["K_F"]  # the variance falls to a fifth
        assert assessment.determined["K_PP"]  # and to four fifths
        assert found(assessment)["K_F + K_PP"].correlation == pytest.approx(-1.0, abs=1e-12)

    def test_four_collinear_terms_have_single_combination(self):
        symbols = ["K_F", "K_I", "K_II", "K_PP", "delta_O", "tilt"]
        _, assessment = campaign(symbols)
        item = found(assessment)["K_F + K_PP - delta_O - tilt"]
        assert abs(item.correlation) == pytest.approx(1.0, abs=1e-12)
        assert abs(item.value - 5e-3) < 4.5 * item.u
        assert len(assessment.confounded) == 1

    def test_three_collinear_terms_with_priors(self):
        symbols = ["K_F", "K_I", "K_II", "K_PP", "delta_O"]
        priors = {"K_F": 2e-6, "K_PP": 2e-6, "delta_O": 2e-6}
        _, assessment = campaign(symbols, priors)
        assert found(assessment)["K_F + K_PP - delta_O"].u < 1e-8

    def test_azimuth_misalignment_is_confounded(self):
        _, assessment = campaign(["K_F", "K_II", "K_PO", "delta_P"])
        assert list(found(assessment)) == ["K_PO + delta_P"]

    def test_tilts_of_runs_and_bias_are_confounded(self):
        # A bias is seen only together with each run's own tilt; what is left are differences.
        _, assessment = campaign(["K_F", "tilt.1", "tilt.2", "tilt.3"])
        assert not any(assessment.determined.values())
        assert sorted(found(assessment)) == [
            "K_F - tilt.3",
            "tilt.1 - tilt.3",
            "tilt.2 - tilt.3",
        ]

    def test_priors_of_tilts_determine_bias(self):
        priors = dict.fromkeys(["tilt.1", "tilt.2", "tilt.3"], 2.4e-6)
        _, assessment = campaign(["K_F", "K_I", *priors], priors)
        # The tilts average out, so that no pair is confounded by itself.
        assert assessment.determined["K_F"]
        assert assessment.u[0] == pytest.approx(2.4e-6 / np.sqrt(3), rel=1e-3)

    def test_single_rate_confounds_bias_and_k_ii(self):
        symbols = ["K_F", "K_I", "K_II", "K_III"]
        rate = 0.5
        solution, assessment = campaign(symbols, rates=(rate,))
        # K_II R^2 w^4/(4 g) t^2 stands beside K_F g t^2/2
        factor = RADIUS**2 * rate**4 / (2 * GRAVITY**2)
        assert not assessment.determined["K_II"]
        item = next(item for item in assessment.confounded if "K_II" in item.terms)
        assert item.terms == ["K_F", "K_II"]
        assert item.determined == f"K_F + {factor:.4g} K_II"
        assert item.weights == pytest.approx([1.0, factor], rel=1e-4)
        assert item.u < 1e-7 < solution.u[0]

    @pytest.mark.parametrize("sigma", [0.01, 1e-5, 1e-9])
    def test_printed_combination_has_value_of_weights(self, sigma):
        # K_I is 1.002 and not 0.002: what multiplies it needs the more digits.
        symbols, nominal = ["K_F", "K_II", "K_I", "K_III"], np.array([0.0, 0.0, 1.0, 0.0])
        solution, _ = campaign(symbols, rates=(0.5,), sigma=sigma)
        known = assess(solution, symbols, nominal=nominal)
        item = next(item for item in known.confounded if "K_II" in item.terms)
        printed = evaluated(item.determined, dict.fromkeys(symbols, 1.0))
        assert [printed[s] for s in item.terms] == pytest.approx(item.weights, rel=5e-4)
        # Whatever the terms are within their credible sizes:
        rounding = [abs(printed[s] - w) for s, w in zip(item.terms, item.weights, strict=True)]
        for symbol, error in zip(item.terms, rounding, strict=True):
            largest = LIMITS.get(symbol, 1e-4) + nominal[symbols.index(symbol)]
            assert error * largest <= 0.1 * item.u

    def test_unobserved_term_is_undetermined(self):
        symbols = ["K_F", "K_I", "tilt.4"]
        _, assessment = campaign(symbols)
        assert assessment.determined == {"K_F": True, "K_I": True, "tilt.4": False}
        assert assessment.confounded == ()
        _, assessment = campaign(symbols, {"tilt.4": 1e-6})
        assert not assessment.determined["tilt.4"]
        assert assessment.confounded == ()

    def test_exactly_known_term_is_not_determined_by_data(self):
        _, assessment = campaign(["K_F", "K_I", "K_PP"], {"K_PP": 0.0})
        assert assessment.determined == {"K_F": True, "K_I": True, "K_PP": False}
        assert assessment.u[2] == 0.0
        assert assessment.confounded == ()


class TestEarthRate:
    """The exact columns, on a level platform at 45.75 degrees north, 100 revolutions a rate."""

    @staticmethod
    def campaign(mounting, symbols, priors=None):
        names = []
        for symbol in symbols:
            runs = [f"{symbol}@{k}" for k in range(len(RATES))]
            names += runs if term(symbol).per_run else [symbol]
        blocks = []
        for k, rate in enumerate(RATES):
            t = np.arange(0.0, 100 * 2 * np.pi / rate, 0.02)
            spindle = Trajectory(Spindle(rate), RADIUS, Site(GRAVITY, math.radians(45.75)))
            design = np.zeros((t.size, len(names)))
            exact = exact_columns(spindle, mounting, symbols, t)
            for symbol, column in zip(symbols, exact.T, strict=True):
                place = f"{symbol}@{k}" if term(symbol).per_run else symbol
                design[:, names.index(place)] = column
            own = np.column_stack([np.ones_like(t), t])
            blocks.append(reduce_block(design / SIGMA, np.zeros(t.size), own / SIGMA))
        bare = [name.partition("@")[0] for name in names]
        solution = solve(
            blocks,
            prior_sd=[(priors or {}).get(name, np.inf) for name in bare],
            limits=[term(name).limit for name in bare],
        )
        return assess(solution, names)

    @pytest.mark.parametrize(
        ("mounting", "apart", "u_ip", "bias_known"),
        [(QX, 6e-11, 3.0, False), (QY, 0.018, 1.7e-4, True)],
    )
    def test_earth_rate_separates_scale_factor_and_cross_coupling(
        self, mounting, apart, u_ip, bias_known
    ):
        symbols = ["K_F", "K_I", "K_II", "K_III", "K_IP"]
        assessment = self.campaign(mounting, symbols)
        assert not assessment.determined["K_IP"]
        assert assessment.determined["K_I"] == bias_known
        assert assessment.u[4] == pytest.approx(u_ip, rel=0.05)
        item = found(assessment)["K_I - K_IP"]
        assert 1 - item.correlation == pytest.approx(apart, rel=0.1)

    def test_complete_model_with_priors(self):
        # Only what is worth saying: of all the pairs that priors separate, two combinations are
        # known better than their terms.
        tilt = "platform.tilt.north"
        symbols = ["K_F", "K_I", "K_II", "K_III", "K_OO", "K_PP", tilt]
        symbols += ["platform.drift.north", "platform.g_sensitivity.zx"]
        priors = {"K_F": 2e-6, "K_I": 5e-6, "K_OO": 2e-6, "K_PP": 2e-6, tilt: 2.4e-6}
        assessment = self.campaign(QX, symbols, priors)
        assert [item.terms for item in assessment.confounded] == [
            ["K_F", "K_PP"],
            ["K_II", "K_OO"],
        ]
        assert assessment.determined["K_II"]
        assert not assessment.determined["K_OO"]


class TestRules:
    @staticmethod
    def scalar(information, prior=np.inf, considered=0.0):
        block = reduce_block([[information]], [0.0], considered=[[information]])
        solution = solve([block], prior_sd=[prior], considered_sd=[considered], limits=[1.0])
        return assess(solution, ["x"]).determined["x"]

    def test_uncertainty_limit_decides(self):
        assert self.scalar(1.01)
        assert not self.scalar(0.99)

    def test_considered_uncertainty_counts_against_limit(self):
        assert self.scalar(2.0, considered=0.8)  # u^2 = 0.25 + 0.64
        assert not self.scalar(2.0, considered=0.9)

    def test_variance_must_shrink_relative_to_prior(self):
        # 1/var = 1/prior^2 + i^2; var/prior^2 = 1/(1 + (i prior)^2) is 0.9 at i prior = 1/3
        assert self.scalar(0.34 / 0.1, prior=0.1)
        assert not self.scalar(0.33 / 0.1, prior=0.1)

    def test_combination_includes_nominal_values(self):
        block = reduce_block([[100.0, -100.0], [0.0, 0.0]], [0.2, 0.0])
        solution = solve([block], limits=[0.1, 1e-4])
        item = assess(solution, ["K_I", "K_IP"], nominal=[1.0, 0.0]).confounded[0]
        assert item.determined == "K_I - K_IP"
        assert item.value == pytest.approx(1.002, rel=1e-9)
        assert item.u == pytest.approx(0.01, rel=1e-9)

    def test_negligible_partner_is_named_but_not_third_term(self):
        # At 1e-4 the twin adds 1e-3 of u: the reason why x is undetermined all the same.
        rows = np.array([[10.0, 10.0, 1e-3], [0.0, 0.0, 0.0]])
        solution = solve([reduce_block(rows, [0.0, 0.0])], limits=[0.5, 1e-4, 1e-4])
        assessment = assess(solution, ["x", "twin", "third"])
        assert not assessment.determined["x"]
        assert found(assessment)["x + twin"].terms == ["x", "twin"]

    def test_value_and_u_match_weights(self):
        symbols = ["K_F", "K_II", "K_OO", "K_PP"]
        solution, assessment = campaign(symbols, {"K_OO": 2e-6})
        for item in assessment.confounded:
            weights = dict(zip(item.terms, item.weights, strict=True))
            part = solution.combine(np.array([weights.get(symbol, 0.0) for symbol in symbols]))
            assert (item.value, item.u) == (part.value, part.u)

    def test_invalid_arguments_raise(self):
        block = reduce_block(np.eye(2), np.ones(2))
        with pytest.raises(ValueError, match="computed with limits"):
            assess(solve([block]), ["a", "b"])
        with pytest.raises(ValueError, match="1 symbols for 2 unknowns"):
            assess(solve([block], limits=[1.0, 1.0]), ["a"])

    def test_unnamed_unknowns_are_projected_out_with_priors(self):
        rng = np.random.default_rng(22)
        design = rng.normal(size=(60, 5))
        design[:, 1] = design[:, 0] + 1e-3 * rng.normal(size=60)  # two alike
        limits, prior_sd = np.full(5, 10.0), [np.inf, np.inf, np.inf, 0.05, 0.2]
        y = rng.normal(size=60)
        whole = solve([reduce_block(design, y)], prior_sd=prior_sd, limits=limits)
        seen = assess(whole, ["a", "b", "c"])
        # The same with the two as part of the noise.
        covariance = np.eye(60) + design[:, 3:] @ np.diag([0.05**2, 0.2**2]) @ design[:, 3:].T
        white = np.linalg.inv(np.linalg.cholesky(covariance))
        block = reduce_block(white @ design[:, :3], white @ y)
        alone = assess(solve([block], limits=limits[:3]), ["a", "b", "c"])
        np.testing.assert_allclose(seen.u, alone.u, rtol=1e-9)
        assert seen.determined == alone.determined
        (one,), (other,) = seen.confounded, alone.confounded
        assert one.terms == other.terms == ["a", "b"]
        assert one.correlation == pytest.approx(other.correlation, rel=1e-9)
        assert (one.value, one.u) == pytest.approx((other.value, other.u), rel=1e-9)

    def test_combination_is_unbiased_in_monte_carlo(self):
        # The value of K_F + K_PP scatters by its u although neither term is determined.
        rng = np.random.default_rng(21)
        t = np.linspace(0.0, 400.0, 200)
        design = np.column_stack([GRAVITY * t**2 / 2] * 2) / SIGMA
        own = np.column_stack([np.ones_like(t), t]) / SIGMA
        errors, trials = [], 400
        for _ in range(trials):
            y = design[:, 0] * 5e-3 + rng.normal(size=t.size)
            solution = solve([reduce_block(design, y, own)], limits=[0.1, 1e-4])
            part = solution.combine([1.0, 1.0])
            errors.append((part.value - 5e-3) / part.u)
        assert abs(np.mean(errors)) < 4.5 / np.sqrt(trials)
        assert np.var(errors) == pytest.approx(1.0, abs=4.5 * np.sqrt(2 / trials))


@pytest.mark.parametrize(
    ("weights", "slack", "text"),
    [
        ([1.0, -1.0], 0.0, "K_F - K_I"),
        ([1.0, -1.00001], 1e-4, "K_F - K_I"),
        ([1.0, -1.00001], 1e-7, "K_F - 1.00001 K_I"),
        ([1.0, 1.123987654321], 1.0e-3, "K_F + 1.124 K_I"),
        ([1.0, 1.123987654321], 1.0e-8, "K_F + 1.12398765 K_I"),
        ([1.0, 1.0 / 3.0], 0.0, "K_F + 0.3333333333333333 K_I"),
    ],
)
def test_weights_have_sufficient_digits(weights, slack, text):
    assert format_combination(["K_F", "K_I"], weights, slack) == text


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
def test_collinear_pairs_match_50_digits(seed):
    """Pairs as close as 1e-9, and priors from a millionth to a million times the data's weight."""
    rng = np.random.default_rng(seed)
    size = 10
    data = rng.standard_normal((30, size))
    for first, exponent in zip((0, 2, 4, 6), rng.uniform(-9, -0.5, 4), strict=True):
        data[:, first + 1] = data[:, first] + 10.0**exponent * data[:, first + 1]
    weights = 10.0 ** rng.uniform(-6, 6, size)
    information = _Information(data, np.diag(weights), limits := 10.0 ** rng.uniform(-1, 3, size))

    with mpmath.workdps(50):
        rows = mpmath.matrix(information.data.tolist())
        gram = rows.T * rows
        priors = [
            mpmath.mpf(w) ** 2 + mpmath.mpf(f) ** 2
            for w, f in zip(weights, information.floor, strict=True)
        ]
        expected = {}
        for i, j in itertools.combinations(range(size), 2):
            total = gram.copy()
            for k in set(range(size)) - {i, j}:
                total[k, k] += priors[k]
            inverse = total**-1
            block = (
                mpmath.matrix([[inverse[i, i], inverse[i, j]], [inverse[j, i], inverse[j, j]]])
                ** -1
            )
            cosine = abs(block[0, 1]) / mpmath.sqrt(block[0, 0] * block[1, 1])
            seen = block[0, 0] * limits[i] ** 2 >= 1 and block[1, 1] * limits[j] ** 2 >= 1
            if seen and cosine > NEAR_COLLINEAR:
                expected[i, j] = float(cosine)
    assert information.collinear_pairs() == pytest.approx(expected, abs=1e-9)
    assert expected

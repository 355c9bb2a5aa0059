"""Least squares against textbook formulas, 50-digit arithmetic and Monte-Carlo draws."""

import mpmath
import numpy as np
import pytest

from counterspin.errors import NotIdentifiableError
from counterspin.inference.least_squares import Block, fit, reduce_block, solve

GRAVITY, RADIUS, SIGMA = 9.8066, 2.5, 0.01


def make_blocks(rng, truth, considered=None, runs=3, n=40, noise=1.0):
    """Return well-conditioned records with two separate unknowns each and new noise."""
    fixed = np.random.default_rng(5)
    columns, blocks = [], []
    for _ in range(runs):
        design = fixed.normal(size=(n, truth.size))
        own = np.column_stack([np.ones(n), np.arange(n)])
        extra = fixed.normal(size=(n, 0 if considered is None else considered.size))
        y = design @ truth + own @ [100.0, -3.0] + noise * rng.normal(size=n)
        if considered is not None:
            y += extra @ considered
        columns.append((design, own, extra, y))
        blocks.append(reduce_block(design, y, own, extra))
    return columns, blocks


def full_problem(columns):
    """Return the records as a single design matrix with all unknowns."""
    rows = sum(len(y) for *_, y in columns)
    own = np.zeros((rows, 2 * len(columns)))
    start = 0
    for k, (_, block_own, _, y) in enumerate(columns):
        own[start : start + y.size, 2 * k : 2 * k + 2] = block_own
        start += y.size
    design = np.vstack([column[0] for column in columns])
    extra = np.vstack([column[2] for column in columns])
    return np.hstack([design, own]), extra, np.concatenate([column[3] for column in columns])


class TestReduceBlock:
    def test_blocks_match_full_problem(self):
        truth = np.array([1.0, -2.0, 0.5])
        columns, blocks = make_blocks(np.random.default_rng(1), truth)
        design, _, y = full_problem(columns)
        estimate, rss, *_ = np.linalg.lstsq(design, y)
        covariance = np.linalg.inv(design.T @ design)[:3, :3]
        solution = solve(blocks)
        np.testing.assert_allclose(solution.estimate, estimate[:3], rtol=1e-12)
        np.testing.assert_allclose(solution.covariance, covariance, rtol=1e-11, atol=1e-15)
        assert solution.chi2 == pytest.approx(rss[0], rel=1e-12)
        assert solution.dof == 120 - 6 - 3

    def test_record_longer_than_chunk_matches_lstsq(self):
        rng = np.random.default_rng(2)
        n = 40_000
        t = np.linspace(0.0, 1.0, n)
        own, design = np.column_stack([np.ones(n), t]), np.column_stack([t**2, np.cos(9 * t)])
        y = design @ [1.0, 2.0] + rng.normal(size=n)
        expected, rss, *_ = np.linalg.lstsq(np.hstack([design, own]), y)
        solution = solve([reduce_block(design, y, own)])
        np.testing.assert_allclose(solution.estimate, expected[:2], rtol=1e-10)
        assert solution.chi2 == pytest.approx(rss[0], rel=1e-12)

    def test_omitting_block_matches_solution_without_it(self):
        columns, blocks = make_blocks(np.random.default_rng(3), np.array([1.0, 2.0]))
        design, _, y = full_problem(columns[1:])
        np.testing.assert_allclose(
            solve(blocks[1:]).estimate, np.linalg.lstsq(design, y)[0][:2], rtol=1e-12
        )

    def test_record_shorter_than_unknowns_has_empty_factor(self):
        # Two samples and two nuisances: no information, but nothing wrong either.
        block = reduce_block(np.ones((2, 1)), [1.0, 2.0], [[1.0, 0.0], [1.0, 1.0]])
        assert block.factor.shape == (0, 1)
        assert block.rss == 0.0
        with pytest.raises(NotIdentifiableError, match="record is too short"):
            reduce_block(np.ones((1, 1)), [1.0], [[1.0, 0.0]])
        with pytest.raises(NotIdentifiableError, match="record is too short"):
            reduce_block(np.ones((3, 1)), [1.0, 2.0, 3.0], [[1.0, 2.0]] * 3)

    def test_invalid_block_raises(self):
        with pytest.raises(ValueError, match="must each have 3 rows"):
            reduce_block(np.ones((2, 1)), np.ones(3))
        with pytest.raises(ValueError, match="not finite"):
            reduce_block(np.ones((3, 1)), [1.0, np.nan, 2.0])


class TestAccuracy:
    """The columns of a real campaign against 50-digit arithmetic (physics of K_F and K_II)."""

    @staticmethod
    def columns(t, rate):
        phase = rate * t
        return np.column_stack(
            [
                GRAVITY * t**2 / 2,
                RADIUS * (np.cos(phase) - 1),
                RADIUS**2
                * rate**4
                / GRAVITY
                * (t**2 / 4 + (1 - np.cos(2 * phase)) / (8 * rate**2)),
            ]
        )

    @staticmethod
    def exact(records):
        """Normal equations with 50 digits, nuisances included."""
        with mpmath.workdps(50):
            shared, runs = records[0][0].shape[1], len(records)
            size = shared + 2 * runs
            gram, right = mpmath.zeros(size), mpmath.zeros(size, 1)
            for k, (design, own, y) in enumerate(records):
                place = [*range(shared), shared + 2 * k, shared + 2 * k + 1]
                rows = [[mpmath.mpf(float(v)) for v in row] for row in np.hstack([design, own]).T]
                ys = [mpmath.mpf(float(v)) for v in y]
                for a, column in zip(place, rows, strict=True):
                    right[a] += mpmath.fdot(column, ys)
                    for b, other in zip(place, rows, strict=True):
                        gram[a, b] += mpmath.fdot(column, other)
            x = mpmath.lu_solve(gram, right)
            return np.array([float(v) for v in x[:shared]])

    @pytest.mark.parametrize("truth", [[5e-3, 2e-3, 2e-5], [0.0, 0.0, 0.0]])
    def test_bias_and_second_order_term_have_nine_digits(self, truth):
        records = []
        for rate in (np.pi / 2, np.pi, 2 * np.pi):
            t = np.linspace(0.0, 100 * 2 * np.pi / rate, 301)
            own = np.column_stack([np.ones_like(t), t])
            design = self.columns(t, rate)
            records.append((design / SIGMA, own / SIGMA, design @ truth / SIGMA + np.sin(1e3 * t)))
        solution = solve([reduce_block(design, y, own) for design, own, y in records])
        exact = self.exact(records)
        np.testing.assert_allclose(solution.estimate, exact, rtol=1e-9)
        assert (np.abs(solution.estimate - exact) < 1e-8 * solution.u).all()

    def test_scaled_columns_return_scaled_solution(self):
        rng = np.random.default_rng(4)
        scale = 10.0 ** np.array([-6.0, -2.0, 0.0, 3.0, 6.0])
        design, own, y = rng.normal(size=(50, 5)), np.ones((50, 2)), rng.normal(size=50)
        own[:, 1] = np.arange(50) * 1e6
        plain = solve([reduce_block(design, y, own)])
        scaled = solve([reduce_block(design * scale, y, own)])
        np.testing.assert_allclose(scaled.estimate * scale, plain.estimate, rtol=1e-11)
        np.testing.assert_allclose(scaled.u * scale, plain.u, rtol=1e-12)

    def test_strong_prior_determines_estimate(self):
        # Rows that differ by 1e10 in size: the estimate of the other unknown must not suffer.
        rng = np.random.default_rng(6)
        design, y = rng.normal(size=(50, 2)), rng.normal(size=50)
        tight = solve([reduce_block(design, y)], prior_mean=[0.3, 0.0], prior_sd=[1e-10, np.inf])
        known = np.linalg.lstsq(design[:, 1:], y - 0.3 * design[:, 0])[0]
        assert tight.estimate[1] == pytest.approx(known[0], rel=1e-9)


class TestPriorsAndConsideredTerms:
    def test_solution_matches_textbook_posterior(self):
        truth, considered = np.array([1.0, -2.0, 0.5]), np.array([0.3, -0.1])
        columns, blocks = make_blocks(np.random.default_rng(7), truth, considered)
        design, extra, y = full_problem(columns)
        mean, sd = np.array([0.9, 0.0, 0.4]), np.array([0.05, np.inf, 0.2])
        c_mean, c_sd = np.array([0.2, 0.1]), np.array([0.1, 0.3])
        solution = solve(
            blocks, prior_mean=mean, prior_sd=sd, considered_mean=c_mean, considered_sd=c_sd
        )
        weight = np.zeros(9)
        weight[:3] = 1 / sd**2
        posterior = np.linalg.inv(design.T @ design + np.diag(weight))
        gain = posterior @ design.T
        prior_part = np.zeros(9)
        prior_part[:3] = weight[:3] * mean
        estimate = posterior @ (design.T @ (y - extra @ c_mean) + prior_part)
        np.testing.assert_allclose(solution.estimate, estimate[:3], rtol=1e-11)
        spread = (gain @ extra)[:3] * c_sd
        np.testing.assert_allclose(
            solution.covariance_noise, (gain @ gain.T)[:3, :3], rtol=1e-10, atol=1e-14
        )
        np.testing.assert_allclose(
            solution.covariance_prior,
            (posterior @ np.diag(weight) @ posterior)[:3, :3],
            rtol=1e-10,
            atol=1e-14,
        )
        np.testing.assert_allclose(solution.covariance_considered, spread @ spread.T, rtol=1e-10)
        residual = y - extra @ c_mean - design @ estimate
        misfit = (estimate[:3] - mean) / sd
        assert solution.chi2 == pytest.approx(residual @ residual + misfit @ misfit, rel=1e-11)
        assert solution.dof == 120 - 6 + 2 - 3

    def test_sensitivities_match_derivatives(self):
        # The estimate is linear in all of them, so that a difference quotient is exact.
        _, blocks = make_blocks(np.random.default_rng(8), np.ones(3), np.ones(2))
        sd, c_sd = np.array([0.05, np.inf, 0.0]), np.array([0.1, 0.3])

        def estimate(mean, c_mean):
            return solve(
                blocks, prior_mean=mean, prior_sd=sd, considered_mean=c_mean, considered_sd=c_sd
            )

        base = estimate(np.zeros(3), np.zeros(2))
        for k in range(3):
            moved = estimate(np.eye(3)[k], np.zeros(2)).estimate - base.estimate
            np.testing.assert_allclose(moved, base.sensitivity_prior[:, k], atol=1e-13)
        for k in range(2):
            moved = estimate(np.zeros(3), np.eye(2)[k]).estimate - base.estimate
            np.testing.assert_allclose(moved, base.sensitivity_considered[:, k], atol=1e-13)

    def test_exactly_known_unknown_is_fixed(self):
        columns, blocks = make_blocks(np.random.default_rng(9), np.array([1.0, 2.0]))
        solution = solve(blocks, prior_mean=[1.5, 0.0], prior_sd=[0.0, np.inf])
        design, _, y = full_problem(columns)
        expected = np.linalg.lstsq(design[:, 1:], y - 1.5 * design[:, 0])[0][0]
        assert solution.estimate[0] == 1.5
        assert solution.u[0] == 0.0
        assert solution.estimate[1] == pytest.approx(expected, rel=1e-12)
        assert solution.dof == 120 - 6 - 1

    def test_contributions_of_combination_match_covariances(self):
        _, blocks = make_blocks(np.random.default_rng(10), np.ones(3), np.ones(2))
        solution = solve(
            blocks,
            prior_sd=[0.05, np.inf, 0.2],
            considered_sd=[0.1, 0.3],
            limits=[10.0, 10.0, 10.0],
        )
        c = np.array([1.0, -2.0, 3.0])
        part = solution.combine(c)
        assert part.value == pytest.approx(c @ solution.estimate)
        assert part.noise**2 == pytest.approx(c @ solution.covariance_noise @ c, rel=1e-12)
        sd = np.array([0.05, 0.0, 0.2])
        np.testing.assert_allclose(part.prior, c @ solution.sensitivity_prior * sd, atol=1e-15)
        np.testing.assert_allclose(
            part.considered, c @ solution.sensitivity_considered * solution.considered_sd
        )
        assert part.u**2 == pytest.approx(c @ solution.covariance @ c, rel=1e-12)


class TestMonteCarlo:
    """Each source drawn alone gives its own part; all together give bias and coverage.

    The estimate is linear in what is drawn, so that its response to each unit draw is taken from
    `solve` once and the trials are one matrix product.
    """

    TRIALS = 100_000
    SD = np.array([0.1, np.inf, 0.05])
    C_SD = np.array([0.1, 0.2])
    N = 24

    def solve_unit_draw(self, source, index, size=1.0):
        """Return errors and chi-square for a single unit draw, with all other draws zero."""
        rng = np.random.default_rng(11)
        design, extra = rng.normal(size=(self.N, 3)), rng.normal(size=(self.N, 2))
        own = np.column_stack([np.ones(self.N), np.arange(self.N)])
        truth, mean, y = np.array([1.0, -2.0, 0.5]), np.zeros(3), np.zeros(self.N)
        mean[[0, 2]] = truth[[0, 2]]
        if source == "noise":
            y[index] = size
        elif source == "prior":
            mean[index] += size * self.SD[index]
        else:
            y += extra[:, index] * self.C_SD[index] * size
        block = reduce_block(design, y + design @ truth + own @ [9.0, -2.0], own, extra)
        solution = solve([block], prior_mean=mean, prior_sd=self.SD, considered_sd=self.C_SD)
        return solution.estimate - truth, solution

    def responses(self, source):
        indices = {"noise": range(self.N), "prior": (0, 2), "considered": (0, 1)}[source]
        return np.array([self.solve_unit_draw(source, index)[0] for index in indices])

    def draw(self, source, seed):
        gain = self.responses(source)
        return np.random.default_rng(seed).normal(size=(self.TRIALS, len(gain))) @ gain

    @pytest.mark.parametrize("source", ["noise", "prior", "considered"])
    def test_single_source_has_stated_variance(self, source):
        errors = self.draw(source, 13)
        solution = self.solve_unit_draw("noise", 0)[1]
        variance = np.diag(getattr(solution, f"covariance_{source}"))
        # The sample variance of N normal draws has relative standard deviation sqrt(2/N).
        np.testing.assert_allclose(
            np.mean(errors**2, axis=0) / variance, 1.0, atol=4.5 * np.sqrt(2 / self.TRIALS)
        )

    def test_all_sources_have_no_bias_and_full_coverage(self):
        sources = ("noise", "prior", "considered")
        errors = sum(self.draw(source, seed) for seed, source in enumerate(sources))
        u = self.solve_unit_draw("noise", 0)[1].u
        assert (np.abs(errors.mean(axis=0)) < 4.5 * u / np.sqrt(self.TRIALS)).all()
        coverage = np.mean(np.abs(errors) < 1.959964 * u, axis=0)
        np.testing.assert_allclose(coverage, 0.95, atol=4.5 * np.sqrt(0.95 * 0.05 / self.TRIALS))
        noise_only = np.sqrt(np.diag(self.solve_unit_draw("noise", 0)[1].covariance_noise))
        # The unknowns that priors and considered terms touch are not covered by noise alone.
        assert (np.mean(np.abs(errors) < 1.959964 * noise_only, axis=0)[[0, 2]] < 0.6).all()

    def test_response_is_linear(self):
        for source in ("noise", "prior", "considered"):
            one, five = (
                self.solve_unit_draw(source, 0)[0],
                self.solve_unit_draw(source, 0, size=5.0)[0],
            )
            np.testing.assert_allclose(five, 5.0 * one, atol=1e-13)

    def test_mean_chi_square_is_degrees_of_freedom(self):
        # Chi-square is a quadratic form of the standardised draws; its mean is the form's trace.
        draws = [("noise", k) for k in range(self.N)] + [("prior", 0), ("prior", 2)]
        solutions = [self.solve_unit_draw(*draw)[1] for draw in draws]
        assert solutions[0].dof == self.N - 2 + 2 - 3
        assert sum(s.chi2 for s in solutions) == pytest.approx(solutions[0].dof, rel=1e-10)


class TestRegularisation:
    LIMITS = np.array([0.1, 1e-4, 1e-4])

    @staticmethod
    def campaign(*, twin):
        """Return K_F and K_II at three rates, with or without K_PP, which is collinear with K_F."""
        rng = np.random.default_rng(12)
        blocks = []
        for rate in (np.pi / 2, np.pi, 2 * np.pi):
            t = np.linspace(0.0, 100 * 2 * np.pi / rate, 2001)
            bias = GRAVITY * t**2 / 2
            second = (
                RADIUS**2
                * rate**4
                / GRAVITY
                * (t**2 / 4 + (1 - np.cos(2 * rate * t)) / (8 * rate**2))
            )
            design = np.column_stack([bias, second] + [bias] * twin) / SIGMA
            own = np.column_stack([np.ones_like(t), t]) / SIGMA
            y = design[:, :2] @ [5e-3, 2e-5] + rng.normal(size=t.size)
            blocks.append(reduce_block(design, y, own))
        return blocks

    def test_regularisation_preserves_determined_unknowns(self):
        blocks = self.campaign(twin=False)
        plain, held = solve(blocks), solve(blocks, limits=self.LIMITS[:2])
        assert (np.abs(held.estimate - plain.estimate) < 1e-6 * plain.u).all()
        np.testing.assert_allclose(held.u, plain.u, rtol=1e-6)
        assert (np.sqrt(np.diag(held.covariance_unresolved)) < 1e-6 * held.u).all()
        assert held.dof == pytest.approx(plain.dof, abs=1e-6)

    def test_identical_columns_have_finite_covariance(self):
        plain = solve(self.campaign(twin=False))
        twin = solve(self.campaign(twin=True), limits=self.LIMITS)
        assert np.isfinite(twin.covariance).all()
        total = twin.combine([1.0, 0.0, 1.0])
        # The sum is what was K_F alone; the twin is not an unknown that costs a degree of freedom.
        assert abs(total.value - plain.estimate[0]) < 1e-6 * plain.u[0]
        assert total.u == pytest.approx(plain.u[0], rel=1e-6)
        assert abs(twin.estimate[1] - plain.estimate[1]) < 1e-6 * plain.u[1]
        assert twin.u[1] == pytest.approx(plain.u[1], rel=1e-6)
        assert twin.dof == pytest.approx(plain.dof, abs=1e-6)
        assert twin.chi2 == pytest.approx(plain.chi2, rel=1e-9)
        # By themselves they are held at some 1e4 of their limits, far above anybody's belief.
        assert twin.u[0] > 0.1
        assert twin.u[2] > 1e-4

    def test_identical_columns_without_limits_raise(self):
        with pytest.raises(NotIdentifiableError, match="column 3 of the design"):
            solve(self.campaign(twin=True))

    def test_prior_of_term_determines_collinear_term(self):
        blocks = self.campaign(twin=True)
        sd = [2e-6, np.inf, np.inf]
        solution = solve(blocks, prior_mean=[5e-3, 0, 0], prior_sd=sd, limits=self.LIMITS)
        assert solution.u[2] == pytest.approx(2e-6, rel=1e-3)
        assert abs(solution.estimate[2]) < 5 * solution.u[2]

    def test_unobserved_unknown_has_limit_as_u(self):
        solution = solve([reduce_block([[1.0, 0.0]] * 3, [1.0, 2.0, 3.0])], limits=[10.0, 0.5])
        assert solution.estimate[1] == 0.0
        assert solution.u[1] == pytest.approx(1e4 * 0.5)
        assert solution.dof == pytest.approx(2.0)


class TestWrongInput:
    def test_invalid_arguments_raise(self):
        block = reduce_block(np.eye(3)[:, :2], np.ones(3))
        with pytest.raises(ValueError, match="no block"):
            solve([])
        with pytest.raises(ValueError, match="prior_sd must contain 2 numbers"):
            solve([block], prior_sd=[1.0])
        with pytest.raises(ValueError, match="prior_mean must contain 2 numbers"):
            solve([block], prior_mean=[1.0, np.nan])
        with pytest.raises(ValueError, match="must not be negative"):
            solve([block], prior_sd=[-1.0, 1.0])
        with pytest.raises(ValueError, match="limits must be positive"):
            solve([block], limits=[0.0, 1.0])


class TestFit:
    X = np.column_stack([np.ones(5), np.arange(5.0)])
    Y = np.array([1.0, 3.1, 4.9, 7.2, 8.8])

    def test_sigma_is_estimated_or_given(self):
        free, given = fit(self.X, self.Y), fit(self.X, self.Y, sigma=0.1)
        assert free.sigma_from_residuals
        assert not given.sigma_from_residuals
        np.testing.assert_allclose(free.estimate, given.estimate, rtol=1e-13)
        rss = free.residuals @ free.residuals
        assert free.chi2 == pytest.approx(rss, rel=1e-12)
        assert free.sigma == pytest.approx(np.sqrt(rss / 3), rel=1e-12)
        assert given.chi2 == pytest.approx(rss / 0.01, rel=1e-12)
        inverse = np.linalg.inv(self.X.T @ self.X)
        np.testing.assert_allclose(given.covariance, 0.01 * inverse, rtol=1e-12)
        np.testing.assert_allclose(free.covariance, rss / 3 * inverse, rtol=1e-12)
        assert free.dof == given.dof == 3

    def test_sigma_per_row_weights_fit(self):
        sigma = np.array([0.1, 0.2, 0.1, 0.3, 0.1])
        weighted = fit(self.X, self.Y, sigma)
        w = 1 / sigma**2
        normal = self.X.T @ (w[:, None] * self.X)
        np.testing.assert_allclose(
            weighted.estimate, np.linalg.solve(normal, self.X.T @ (w * self.Y)), rtol=1e-12
        )
        np.testing.assert_allclose(weighted.covariance, np.linalg.inv(normal), rtol=1e-12)

    def test_unidentifiable_fit_raises(self):
        with pytest.raises(NotIdentifiableError, match="give sigma"):
            fit(self.X[:2], self.Y[:2])
        with pytest.raises(NotIdentifiableError, match="column 2"):
            fit(np.ones((5, 2)), self.Y)
        with pytest.raises(NotIdentifiableError, match="column 2"):
            fit(self.X[:1], self.Y[:1], sigma=1.0)
        with pytest.raises(ValueError, match="sigma must be positive"):
            fit(self.X, self.Y, sigma=0.0)
        with pytest.raises(ValueError, match="one per observation"):
            fit(self.X, self.Y, sigma=[1.0, 2.0])


def test_row_noise_changes_uncertainty_and_not_estimate():
    rng = np.random.default_rng(12)
    a, y = rng.standard_normal((8, 2)), rng.standard_normal(8)
    prior_sd, noise = np.array([0.5, np.inf]), rng.uniform(0.2, 3.0, 8)
    rows = Block(a, y, a[:, :1], 0.0, 8, 0)
    even = solve([rows], prior_sd=prior_sd, considered_sd=[0.1])
    replace_row_noise = even.replace_row_noise(noise)
    inverse = np.linalg.inv(a.T @ a + np.diag([4.0, 0.0]))
    gain = inverse @ a.T
    np.testing.assert_array_equal(replace_row_noise.estimate, even.estimate)
    np.testing.assert_allclose(
        replace_row_noise.covariance_noise, gain * noise**2 @ gain.T, rtol=1e-12
    )
    np.testing.assert_array_equal(
        replace_row_noise.covariance_considered, even.covariance_considered
    )
    parts = replace_row_noise.combine([1.0, 0.0])
    np.testing.assert_allclose(parts.noise_rows, gain[0] * noise, rtol=1e-10, atol=1e-15)
    np.testing.assert_allclose(parts.considered, even.combine([1.0, 0.0]).considered, rtol=1e-12)
    assert parts.u == pytest.approx(replace_row_noise.u[0], rel=1e-12)

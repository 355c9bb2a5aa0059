"""How often to read what: against every choice there is."""

import itertools
import math

import numpy as np
import pytest

from counterspin.planning.candidate_set import CandidateSet
from counterspin.planning.design import Criterion
from counterspin.planning.reading_plan import best_counts, least_counts

FORCE = np.array([-1.0, -0.6, -0.2, 0.3, 0.7, 1.0])


def make_candidates(considered=False, time=0.0):
    """Return readings of a quadratic, one of them twice as noisy."""
    design = np.vander(FORCE, 3, increasing=True)[:, None, :]
    design[1] *= 0.5
    fixed = 0.3 * FORCE[:, None, None] ** 3 if considered else np.zeros((6, 1, 0))
    known = 1e-3 * np.eye(3), np.zeros((3, fixed.shape[2]))
    return CandidateSet(design, fixed, *known, np.full(6, time))


CRITERIA = {
    "one": Criterion((2,), (1.0,)),
    "sum": Criterion((0, 1), (1.0, 2.0)),
    "determinant": Criterion((0, 1, 2), (1.0, 1.0, 1.0), "determinant"),
}


@pytest.mark.parametrize("considered", [False, True], ids=["estimated", "considered"])
@pytest.mark.parametrize("criterion", CRITERIA.values(), ids=CRITERIA)
def test_counts_match_exhaustive_search(criterion, considered):
    possible = make_candidates(considered)
    every = np.array([n for n in itertools.product(range(8), repeat=6) if sum(n) == 7])
    best = float(possible.value(criterion, every).min())
    chosen = best_counts(possible, criterion, 7, math.inf)
    assert chosen.design.sum() == 7
    assert chosen.value == pytest.approx(best, abs=1e-9)
    assert chosen.bound <= best + 1e-9


def test_covariance_matches_least_squares():
    possible = make_candidates(considered=True)
    counts = np.array([2, 1, 0, 3, 1, 2])
    rows = np.repeat(possible.design[:, 0], counts, axis=0)
    bias = np.repeat(possible.considered[:, 0], counts, axis=0)
    inner = np.linalg.inv(rows.T @ rows + 1e-6 * np.eye(3))
    moved = inner @ rows.T @ bias
    assert possible.covariance(counts) == pytest.approx(inner + moved @ moved.T, rel=1e-9)


@pytest.mark.parametrize("considered", [False, True], ids=["estimated", "considered"])
@pytest.mark.parametrize("criterion", CRITERIA.values(), ids=CRITERIA)
def test_value_with_addition_matches_recomputation(criterion, considered, monkeypatch):
    possible, counts = make_candidates(considered), np.array([2, 1, 0, 3, 1, 2])
    each = [float(possible.value(criterion, counts + one)) for one in np.eye(6)]
    alike = np.array([0, 0, 0, 0, 0, 9])  # which leave two of three to the prior: anew
    anew = [float(possible.value(criterion, alike + one)) for one in np.eye(6)]
    assert possible.values_with_addition(criterion, alike) == pytest.approx(anew, rel=1e-8)
    monkeypatch.setattr(CandidateSet, "value", None)
    assert possible.values_with_addition(criterion, counts) == pytest.approx(each, rel=1e-9)


def test_counts_are_within_time_limit_and_minimal():
    possible, criterion = make_candidates(time=2.0), CRITERIA["one"]
    chosen = best_counts(possible, criterion, math.inf, 15.0)
    assert chosen.design.sum() == 7
    u = math.exp(chosen.value)
    target = Criterion((2,), (u,))

    def least_of(possible, target, *limits):
        def u_of(counts):
            return np.sqrt(np.diag(possible.covariance(counts)))[list(target.indices)]

        return least_counts(possible, target, *limits, u_of)

    least, floor = least_of(possible, target, math.inf, 60.0)
    assert least.design.sum() == 7
    assert floor * 60.0 <= 14.0 + 1e-9
    by_number, _ = least_of(make_candidates(), target, 30, math.inf)
    assert by_number.design.sum() == 7
    assert least_of(make_candidates(), Criterion((2,), (1e-3,)), 30, math.inf) is None

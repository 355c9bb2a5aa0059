"""Agreement of kinds of data: closed forms of two and three means."""

import math

import numpy as np
import pytest

from counterspin.frozen import frozen
from counterspin.inference.joint.fit import solve_joint
from counterspin.inference.joint.unknowns import Considered, Observation, Unknown, Unknowns
from counterspin.inference.least_squares import reduce_block
from counterspin.readings.agreement import compare_motions

FREE = (0.0, math.inf)
MEAN = Unknown("A", "K_F", FREE, 0.1)


@frozen
class Values(Observation):
    """Plain values of one standard uncertainty."""

    values: np.ndarray
    u: float
    kind: str

    @property
    def source(self):
        return self.kind

    run = motion = source

    def block(self, noise):
        return reduce_block(
            self.design / self.u, self.values / self.u, None, self.considered_design / self.u
        )


def make_values(kind, values, u, columns=None, considered=None):
    values = np.atleast_1d(values)
    design = np.ones((values.size, 1)) if columns is None else np.asarray(columns, float)
    fixed = np.zeros((values.size, 0)) if considered is None else np.asarray(considered, float)
    places = tuple(range(design.shape[1])), design, tuple(range(fixed.shape[1])), fixed
    return Values(*places, values, u, kind)


def test_shift_of_two_means_is_their_difference():
    kinds = [make_values("first", [1e-3, 3e-3], 1e-3), make_values("second", 5e-3, 2e-3)]
    model = Unknowns((MEAN,))
    whole = solve_joint(kinds, model, {})
    u = math.hypot(1e-3 / math.sqrt(2.0), 2e-3)
    for kind, other in (("first", 5e-3), ("second", 2e-3)):
        comparison = compare_motions(whole)[kind]
        assert comparison.other_solution.estimate[0] == pytest.approx(other)
        assert abs(comparison.shift[0] / comparison.u_shift[0]) == pytest.approx(3e-3 / u)
        # Its own scatter, 1e-3 to 3e-3, is no part of it.
        assert (comparison.chi2, comparison.dof) == (pytest.approx((3e-3 / u) ** 2, rel=1e-6), 1)


def test_shared_considered_term_cancels_in_shift():
    """A considered term that moves both alike takes no part in their difference."""
    both = Considered("A", "K_PP", (0.0, 1e-2), 1.0)
    kinds = [
        make_values("first", 2e-3, 1e-3, considered=[[1.0]]),
        make_values("second", 5e-3, 2e-3, considered=[[1.0]]),
    ]
    model = Unknowns((MEAN,), (both,))
    whole = solve_joint(kinds, model, {})
    first = compare_motions(whole)["first"]
    z = 3e-3 / math.hypot(1e-3, 2e-3)
    assert abs(first.shift[0] / first.u_shift[0]) == pytest.approx(z)
    assert first.chi2 == pytest.approx(z**2, rel=1e-6)


def test_considered_term_of_one_kind_widens_shift():
    own = Considered("A", "K_PP", (0.0, 3e-3), 1.0)
    kinds = [
        make_values("first", 2e-3, 1e-3, considered=[[1.0]]),
        make_values("second", 5e-3, 2e-3, considered=[[0.0]]),
    ]
    model = Unknowns((MEAN,), (own,))
    whole = solve_joint(kinds, model, {})
    second = compare_motions(whole)["second"]
    z = 3e-3 / math.hypot(1e-3, 2e-3, 3e-3)
    assert abs(second.shift[0] / second.u_shift[0]) == pytest.approx(z)
    assert second.chi2 == pytest.approx(z**2, rel=1e-6)


def test_undetermined_combination_is_not_tested():
    """The first kind determines both unknowns, the second their sum alone: one comparison."""
    other = Unknown("A", "K_PP", FREE, 1e-4)
    kinds = [
        make_values("first", [1e-3, 2e-3, 2.5e-3], 1e-6, [[1, 0], [0, 1], [1, 1]]),
        make_values("second", [4e-3], 1e-6, [[1, 1]]),
    ]
    model = Unknowns((MEAN, other))
    whole = solve_joint(kinds, model, {})
    comparison = compare_motions(whole)
    assert [comparison[kind].dof for kind in ("first", "second")] == [1, 1]
    design = np.array([[1, 0], [0, 1], [1, 1]])
    estimate = np.linalg.lstsq(design, np.array([1e-3, 2e-3, 2.5e-3]), rcond=None)[0]
    u_sum = 1e-6 * math.sqrt(np.ones(2) @ np.linalg.inv(design.T @ design) @ np.ones(2))
    z = (4e-3 - estimate.sum()) / math.hypot(u_sum, 1e-6)
    for kind in ("first", "second"):
        assert comparison[kind].chi2 == pytest.approx(z**2, rel=1e-5)

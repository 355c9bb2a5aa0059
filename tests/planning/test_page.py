"""The page of a plan: what it says of other plans."""

import pytest

from counterspin.planning.page import _optimality_sentence
from counterspin.planning.result import GoalResult


@pytest.mark.parametrize(
    ("kind", "efficiency", "timed", "message"),
    [
        ("minimise", 1.0, True, "No plan within these limits is more than 0.05 % better."),
        ("minimise", 0.9, True, "can reduce the uncertainty by more than 10 %"),
        ("target", 0.98, True, "can be more than 2 % shorter"),
        ("target", 0.8, False, "needs more than 20 % fewer readings"),
        # A bound that allows next to nothing says nothing of the plan.
        ("target", 0.001, True, "which is the bound for all plans"),
        ("target", None, True, "because no bound is known"),
    ],
)
def test_optimality_sentence_states_possible_gain(kind, efficiency, timed, message):
    goal = GoalResult(kind=kind, criterion="sum", sizes={"Qx.K_II": 1.0}, efficiency=efficiency)
    assert message in _optimality_sentence(goal, timed)

"""What is known better, as an update, beside the whole problem solved again with another prior."""

import dataclasses
import math

import numpy as np
import pytest

from counterspin.inference.joint.budget import budget
from counterspin.inference.joint.fit import JointFit, solve_blocks
from counterspin.inference.joint.unknowns import Considered, Observation, Unknown, Unknowns
from counterspin.inference.joint.what_if import what_if
from counterspin.inference.least_squares import Block

#: Priors such that the data tell much of some and next to nothing of others.
PRIORS = {"K_F": math.inf, "K_II": math.inf, "K_OO": 2e-6, "K_PP": 1e-6, "K_4": 1e-9}


class Rows(Observation):
    """Provide rows that are already reduced."""

    source = run = motion = "rows"

    def block(self, noise):
        raise NotImplementedError


_OF_NOTHING = (), np.empty((0, 0)), (), np.empty((0, 0))


def make_fit(priors, held=()):
    """Return a fit of 40 rows in which K_OO is nearly collinear with K_II."""
    rng = np.random.default_rng(5)
    names = [name for name in priors if name not in held]
    columns = {name: rng.normal(size=40) for name in ("K_F", "K_II", "K_PP", "K_4")}
    columns["K_OO"] = columns["K_II"] + 1e-2 * rng.normal(size=40)
    scale = {"K_F": 1e6, "K_II": 1e6, "K_OO": 1e6, "K_PP": 1e6, "K_4": 1e9}
    factor = np.column_stack([scale[name] * columns[name] for name in names])
    fixed = np.column_stack([scale[name] * columns[name] for name in held] or [np.empty((40, 0))])
    block = Block(factor, rng.normal(size=40), fixed, 0.0, 40, 0)
    model = Unknowns(
        tuple(
            Unknown("Qx", name, (0.0, priors[name]), 1e-3, name in ("K_F", "K_II"))
            for name in names
        ),
        tuple(Considered("Qx", name, (0.0, priors[name]), 1e-3) for name in held),
    )
    return JointFit(model, solve_blocks([block], model), (Rows(*_OF_NOTHING),), (block,), {})


def make_what_if(fit):
    places = {"K_F": 0, "K_II": 1}
    return what_if(fit, places, {k: budget(fit, place, "Qx") for k, place in places.items()}, "Qx")


BETTER = [{"K_OO": 2e-7}, {"K_OO": 1e-5}, {"K_4": 1e-12}, {"K_OO": 3e-8, "K_4": 5e-9}]
HELD_BETTER = [{"K_PP": 1e-7}, {"K_PP": 3e-6, "K_OO": 3e-8}]


@pytest.mark.parametrize(
    ("held", "known"),
    [*(((), known) for known in BETTER), *((("K_PP",), known) for known in BETTER + HELD_BETTER)],
)
def test_update_matches_fit_with_other_prior(known, held):
    what_if = make_what_if(make_fit(PRIORS, held))
    again = make_fit(PRIORS | known, held)
    for place, name in enumerate(("K_F", "K_II")):
        shares = {line.source: line.contribution**2 for line in budget(again, place, "Qx")}
        parts = what_if.parts(name, known)
        for source in what_if.known:
            assert parts[source] == pytest.approx(shares.get(source, 0.0), rel=1e-6, abs=1e-24)
        assert what_if.u(name, known) == pytest.approx(float(again.solution.u[place]), rel=1e-9)
    assert what_if.u("K_II", {}) == pytest.approx(
        float(make_fit(PRIORS, held).solution.u[1]), rel=1e-9
    )


def test_scaling_budget_lines_is_inaccurate():
    """A better prior of a partly determined term has less effect: 8 % of u here."""
    fit = make_fit(PRIORS)
    what_if, u = make_what_if(fit), float(fit.solution.u[1])
    (line,) = (line for line in budget(fit, 1, "Qx") if line.source == "K_OO")
    naive = math.sqrt(u**2 - line.contribution**2 * (1.0 - 0.3**2))
    assert naive > 1.05 * what_if.u("K_II", {"K_OO": 0.3 * PRIORS["K_OO"]})


def test_undetected_noise_follows_update():
    """The noise acts like a considered term with the same column."""
    held = make_fit(PRIORS, ("K_PP",))
    column = held.solution.sensitivity_considered[:, 0] * PRIORS["K_PP"]
    plain = make_fit({k: v for k, v in PRIORS.items() if k != "K_PP"})
    # The same rows: K_PP's column is drawn before K_4's.
    solution = dataclasses.replace(plain.solution, covariance_undetected=np.outer(column, column))
    seen = dataclasses.replace(plain, solution=solution)
    expected = make_what_if(held).u("K_II", {"K_OO": 1e-7})
    assert make_what_if(seen).u("K_II", {"K_OO": 1e-7}) == pytest.approx(expected, rel=1e-9)


def test_term_without_prior_cannot_be_changed():
    what_if = make_what_if(make_fit(PRIORS))
    assert set(what_if.known) <= {"K_OO", "K_PP", "K_4"}
    with pytest.raises(ValueError, match="K_F"):
        what_if.u("K_II", {"K_F": 1e-6})
    with pytest.raises(ValueError, match="greater than zero"):
        what_if.u("K_II", {"K_OO": 0.0})


def test_fit_without_relevant_prior_has_no_what_if():
    fit = make_fit({"K_F": math.inf, "K_II": math.inf})
    assert make_what_if(fit) is None

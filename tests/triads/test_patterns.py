"""Columns that residuals of poses may follow."""

from dataclasses import replace

import numpy as np

import triads
from counterspin.physics.terms import CONDITION_TERMS, TERMS
from counterspin.readings.fit import solve_readings
from counterspin.triads.patterns import pose_candidates


def residuals(poses, fit):
    """Return the residual of each pose after refitting its angles, g."""
    rows = poses.linearize(fit.model, fit.solution.estimate)
    return rows.target - rows.design @ fit.solution.estimate


def test_column_matches_finite_difference_of_pose_residuals():
    # Indications without the term, and with a little of it, after both fits have turned each pose
    # so that its three indications fit best: what is left along the force differs by the column.
    generator = np.random.default_rng(4)
    along = triads.draw_directions(20, generator)
    poses = triads.make_poses(triads.compute_indications(along), u=1e-4)
    conditions = {
        "time": np.linspace(0.0, 500.0, 20),
        "temperature": generator.uniform(-10.0, 10.0, 20),
    }
    poses = replace(poses, conditions={**poses.conditions, **conditions})
    fit = solve_readings([poses], triads.make_unknowns()).fit
    unknown = set(triads.PARAMETERS)
    every = {(o.owner, o.kind, o.symbol): o for o in pose_candidates(poses, 0, fit, unknown, ())}
    assert not {(owner, "term", symbol) for owner, symbol in unknown} & set(every)
    assert {(name, "drift", "time") for name in triads.NAMES} <= set(every)
    size = 1e-6
    left = residuals(poses, fit)
    cubes = along[:, 1] ** 3
    temperatures = poses.conditions["temperature"] * along[:, 2]
    for key, added in (
        (("Y", "term", "K_III"), np.outer(cubes, [0.0, 1.0, 0.0])),
        (("Z", "term", "K_I.temperature"), np.outer(temperatures, [0.0, 0.0, 1.0])),
        (("X", "drift", "time"), np.outer(np.linspace(-0.5, 0.5, 20), [1.0, 0.0, 0.0])),
    ):
        other = replace(poses, value=poses.value + size * added)
        moved = residuals(other, fit) - left
        np.testing.assert_allclose(every[key].columns[0], moved / size, rtol=0, atol=1e-4)


def test_constant_conditions_are_not_tested():
    along = triads.draw_directions(20, np.random.default_rng(4))
    poses = triads.make_poses(triads.compute_indications(along), u=1e-4)
    fit = solve_readings([poses], triads.make_unknowns()).fit
    tried = {(o.kind, o.symbol) for o in pose_candidates(poses, 0, fit, triads.PARAMETERS, ())}
    # Without times there is the order, and without temperatures no slope with them.
    assert ("drift", "order") in tried
    assert {symbol for kind, symbol in tried if kind == "term"} <= set(TERMS)
    assert not {symbol for _, symbol in tried} & set(CONDITION_TERMS)

"""Condensed columns: what is asked for is the same, with a fraction of the unknowns."""

import math
from dataclasses import replace

import numpy as np
import pytest
from joint_campaign import add_noise, make_unknowns, simulate_three_rates

from counterspin.inference.joint.design_blocks import build_design_blocks, compress_nuisance
from counterspin.inference.joint.fit import solve_joint
from counterspin.inference.joint.unknowns import Considered, Unknown, Unknowns
from counterspin.inference.noise.model import Noise
from counterspin.physics.terms import INPUTS, SHARED_TERMS, TERMS

TRUTH = {"K_F": 5.03e-3, "K_I": 1.00197, "K_II": 2.7e-5, "K_III": 3.4e-6}
SCALES = {"Qx": 1.002, "Qy": 1.002}
NOISES = {
    "white": Noise(0.01),
    "random walk": Noise(0.01, 3e-4),
    "white and small": Noise(1e-5),
}


def default_term(row, owner=""):
    """Return the unknown of a nuisance term of the table."""
    mean = row.nominal + 0.3 * row.typical
    return Unknown(
        owner,
        row.symbol,
        (mean, row.typical),
        row.limit,
        is_of_interest=False,
        has_default_prior=True,
    )


def complete_model(*names):
    """Return a model with four coefficients per accelerometer and all nuisance terms."""
    own = [default_term(TERMS[s], name) for name in names for s in TERMS if s not in TRUTH]
    shared = [
        default_term(row, owner)
        for row in SHARED_TERMS.values()
        for owner in (("run1", "run2", "run3") if row.per_run else ("",))
    ]
    inputs = [
        Unknown(
            "", symbol, (0.0, row.typical), row.limit, is_of_interest=False, has_default_prior=True
        )
        for symbol, row in INPUTS.items()
    ]
    unknowns = [unknown for name in names for unknown in make_unknowns(TRUTH, owner=name)]
    return Unknowns((*unknowns, *own, *shared, *inputs))


def make_problem(names, noise, considered=()):
    """Return the complete model, its columns and records with noise."""
    rng = np.random.default_rng(3)
    model = replace(complete_model(*names), considered=considered)
    series = [
        add_noise(record, noise, rng)
        for name in names
        for record in simulate_three_rates(TRUTH, accelerometer=name)
    ]
    return build_design_blocks(series, model, SCALES), model


def assert_matches_full_fit(prepared, model, few, condensed, noise):
    """Assert that the parameters of interest are equal in both fits; return u."""
    noises = {part.accelerometer: noise for part in prepared}
    whole = solve_joint(prepared, model, noises).solution
    solution = solve_joint(few, condensed, noises).solution
    p = len(model.of_interest)
    assert condensed.of_interest == model.of_interest
    u = whole.u[:p]
    np.testing.assert_allclose(solution.estimate[:p] / u, whole.estimate[:p] / u, atol=1e-3)
    for name in ("covariance", "covariance_considered"):
        first, second = (getattr(s, name)[:p, :p] / np.outer(u, u) for s in (solution, whole))
        np.testing.assert_allclose(first, second, atol=1e-3)
    return u


@pytest.mark.parametrize("noise", NOISES.values(), ids=NOISES)
@pytest.mark.parametrize("stated", [True, False], ids=["noise given", "noise to be found"])
def test_compressed_fit_matches_full_fit(noise, stated):
    prepared, model = make_problem(["Qx"], noise)
    few, condensed = compress_nuisance(prepared, model, {"Qx": noise.white if stated else None})
    assert_matches_full_fit(prepared, model, few, condensed, noise)
    before, after = (len(one.unknowns) - len(model.of_interest) for one in (model, condensed))
    assert after < before / (2 if noise.white < 1e-3 else 4)


def test_compressed_terms_contribute_to_u():
    """Otherwise the comparison would pass without these terms."""
    noise = NOISES["white"]
    prepared, model = make_problem(["Qx"], noise)
    alone = Unknowns(model.of_interest)
    bare = build_design_blocks([part.series for part in prepared], alone, SCALES)
    u = assert_matches_full_fit(
        prepared, model, *compress_nuisance(prepared, model, {"Qx": 0.01}), noise
    )
    assert (u > 1.1 * solve_joint(bare, alone, {"Qx": noise}).solution.u).any()


def test_two_accelerometers_share_compressed_columns():
    noise = NOISES["white"]
    prepared, model = make_problem(["Qx", "Qy"], noise)
    few, condensed = compress_nuisance(prepared, model, dict.fromkeys(SCALES, noise.white))
    assert_matches_full_fit(prepared, model, few, condensed, noise)
    assert len(condensed.unknowns) < len(model.unknowns) / 2
    common = {
        place for place, unknown in enumerate(condensed.unknowns) if not unknown.is_of_interest
    }
    shown = [common.intersection(part.unknowns) for part in few]
    assert all(one == common for one in shown)


def test_considered_terms_are_not_compressed():
    noise = NOISES["white"]
    held = (Considered("Qx", "K_F.trend", (0.0, 1e-9), 1e-6, is_of_interest=False),)
    prepared, model = make_problem(["Qx"], noise, held)
    few, condensed = compress_nuisance(prepared, model, {"Qx": noise.white})
    assert condensed.considered == held
    assert_matches_full_fit(prepared, model, few, condensed, noise)


def test_nonzero_priors_are_subtracted_from_records():
    """Shift all priors to zero and subtract their effect from the records."""
    noise = NOISES["white"]
    prepared, model = make_problem(["Qx"], noise)
    _, condensed = compress_nuisance(prepared, model, {"Qx": noise.white})
    p = len(model.of_interest)
    assert any(unknown.prior_mean != 0.0 for unknown in model.unknowns[p:])
    assert all(unknown.prior == (0.0, 1.0) for unknown in condensed.unknowns[p:])


def test_rows_of_compressed_columns_may_be_omitted():
    """The directions are computed from all rows and remain valid for fewer rows."""
    noise = NOISES["white"]
    prepared, model = make_problem(["Qx"], noise)
    few, condensed = compress_nuisance(prepared, model, {"Qx": noise.white})
    drop = np.zeros(prepared[2].series.time.size, dtype=bool)
    drop[50:120] = True
    prepared, few = ((*one[:2], one[2].drop_rows(drop)) for one in (prepared, few))
    assert_matches_full_fit(prepared, model, few, condensed, noise)


@pytest.mark.parametrize("level", [0.0, None], ids=["said so", "not said"])
def test_noise_free_records_are_not_compressed(level):
    """Without noise, no direction is negligible."""
    model = complete_model("Qx")
    silent = [
        replace(record, error=np.zeros(record.time.size)) for record in simulate_three_rates(TRUTH)
    ]
    prepared = build_design_blocks(silent, model, SCALES)
    few, condensed = compress_nuisance(prepared, model, {"Qx": level})
    assert condensed is model
    assert few == prepared


def test_terms_without_prior_are_not_compressed():
    prepared, model = make_problem(["Qx"], NOISES["white"])
    loose = replace(model.unknowns[-1], prior=(0.0, math.inf))
    model = replace(model, unknowns=(*model.unknowns[:-1], loose))
    few, condensed = compress_nuisance(prepared, model, {"Qx": 0.01})
    assert condensed is model
    assert few == prepared
    alone = Unknowns(model.of_interest)
    assert compress_nuisance(prepared, alone, {"Qx": 0.01})[1] is alone

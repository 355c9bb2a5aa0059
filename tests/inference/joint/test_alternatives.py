"""Alternatives held against a fit are what fits with them, or without a prior, give."""

import math
from dataclasses import replace

import numpy as np
import pytest
from joint_campaign import (
    ARCSEC,
    add_noise,
    make_considered_inputs,
    make_unknowns,
    simulate_three_rates,
)

from counterspin.inference.joint.alternatives import (
    Alternative,
    default_prior_alternatives,
    prior_alternatives,
    run_score_tests,
)
from counterspin.inference.joint.estimation import estimate
from counterspin.inference.joint.fit import augment, estimate_considered
from counterspin.inference.joint.unknowns import Considered, Unknown, Unknowns
from counterspin.inference.noise.model import ESTIMATE, Noise

TRUTH = {"K_F": 0.005, "K_I": 1.002, "K_II": 2.7e-5}
WHITE = 0.01
PRIORS = {"K_F": (0.005, 2e-6), "K_I": (1.002, 5e-6), "K_III": (0.0, 0.0)}
TILTS = tuple(Unknown(f"run{i}", "platform.tilt.north", (0.0, ARCSEC), 1e-2) for i in (1, 2, 3))
MODEL = Unknowns(
    (*make_unknowns(["K_F", "K_I", "K_II", "K_III"], PRIORS), *TILTS),
    (
        Considered("Qx", "K_PP", (0.0, 1e-6), 1e-4),
        *make_considered_inputs({"centrifuge.radius": 1e-5}),
    ),
)


def fitted(series, model=MODEL, white=WHITE):
    return estimate(series, model, {"Qx": Noise(white, 0.0)}, rejects_outliers=False)


@pytest.fixture(scope="module")
def series():
    rng = np.random.default_rng(7)
    return [add_noise(record, Noise(WHITE), rng) for record in simulate_three_rates(TRUTH)]


@pytest.fixture(scope="module")
def relaxed(series):
    return estimate_considered(fitted(series).fit)


def without_prior(relaxed, places):
    """Return the relaxed fit without priors of some unknowns."""
    loose = list(relaxed.model.unknowns)
    for place in places:
        loose[place] = replace(loose[place], prior=(loose[place].nominal, math.inf))
    return fitted_again(relaxed, Unknowns(tuple(loose)))


def fitted_again(relaxed, model):
    return replace(relaxed, model=model).with_noise(relaxed.noise)


def test_considered_terms_and_inputs_are_unknowns_with_priors(relaxed):
    names = [unknown.name for unknown in relaxed.model.unknowns]
    assert names[-2:] == ["Qx.K_PP", "centrifuge.radius"]
    np.testing.assert_allclose(relaxed.solution.prior_sd[-2:], [1e-6, 1e-5])
    again = fitted_again(relaxed, relaxed.model)
    np.testing.assert_allclose(again.solution.estimate, relaxed.solution.estimate, rtol=1e-9)


@pytest.mark.parametrize("name", ["Qx.K_F", "Qx.K_I", "run2.platform.tilt.north"])
def test_prior_is_compared_with_fit_without_it(relaxed, name):
    held = run_score_tests(relaxed, prior_alternatives(relaxed), noise_given=True)
    place = [other.name for other in held.alternatives].index(name)
    (unknown,) = held.alternatives[place].prior_shifts
    without = without_prior(relaxed, [unknown]).solution
    prior = relaxed.model.unknowns[unknown]
    apart = float(without.estimate[unknown]) - prior.prior_mean
    spread = math.hypot(float(without.u[unknown]), prior.prior[1])
    scale = max(1.0, without.chi2 / without.dof)
    # The numerical regularisation stands for no prior: 1e-8 of u, and more for what is weak.
    assert held.value[place] == pytest.approx(apart, rel=1e-6)
    assert held.u[place] == pytest.approx(spread * math.sqrt(scale), rel=1e-6)
    assert held.z[place] == pytest.approx(abs(apart) / spread / math.sqrt(scale), rel=1e-6)


def test_exact_prior_is_compared_with_fit_of_unknown_term(relaxed):
    held = run_score_tests(relaxed, prior_alternatives(relaxed), noise_given=True)
    place = [other.name for other in held.alternatives].index("Qx.K_III")
    without = without_prior(relaxed, [3]).solution
    scale = max(1.0, without.chi2 / without.dof)
    assert held.value[place] == pytest.approx(float(without.estimate[3]), rel=1e-6)
    assert held.u[place] == pytest.approx(float(without.u[3]) * math.sqrt(scale), rel=1e-6)


def test_column_is_compared_with_fit_that_includes_it(relaxed):
    outputs = {
        i: part.series.error for i, part in enumerate(relaxed.design_blocks) if part.run == "run2"
    }
    jumps = {2: (relaxed.design_blocks[2].series.time > 5.0).astype(float)}
    alternatives = [
        Alternative("jump", "run3", "jump", jumps),
        Alternative("scale", "run2", "scale", outputs),
    ]
    held = run_score_tests(relaxed, alternatives, noise_given=True)
    for k, columns in enumerate((jumps, outputs)):
        unknown = Unknown("", "other", (0.0, math.inf), 1.0)
        whole = augment(relaxed, [unknown], [columns]).solution
        scale = max(1.0, whole.chi2 / whole.dof)
        assert held.value[k] == pytest.approx(float(whole.estimate[-1]), rel=1e-6)
        assert held.u[k] == pytest.approx(float(whole.u[-1]) * math.sqrt(scale), rel=1e-6)
        gain = relaxed.solution.chi2 - whole.chi2
        assert held.z[k] ** 2 * scale == pytest.approx(gain, rel=1e-4, abs=1e-6)


def test_column_spanned_by_unknowns_is_undetermined(relaxed):
    gravity = relaxed.design_blocks[0].series.trajectory.site.gravity
    bias = {i: gravity * part.series.time**2 / 2 for i, part in enumerate(relaxed.design_blocks)}
    loose = without_prior(relaxed, [0])
    held = run_score_tests(loose, [Alternative("bias", "Qx", "bias", bias)], noise_given=True)
    assert math.isinf(held.u[0])
    assert held.z[0] == 0.0
    assert held.n_tests == 0


def test_default_prior_is_alternative_term_or_input(series):
    """Stated and default priors are separate lists; each alternative is the fit without one."""
    model = Unknowns(
        (*MODEL.unknowns[:4], replace(TILTS[0], has_default_prior=True), *TILTS[1:]),
        tuple(replace(other, has_default_prior=True) for other in MODEL.considered),
    )
    relaxed = estimate_considered(fitted(series, model).fit)
    alternatives = default_prior_alternatives(relaxed)
    assert [(other.kind, other.name) for other in alternatives] == [
        ("term", "run1.platform.tilt.north"),
        ("term", "Qx.K_PP"),
        ("input", "centrifuge.radius"),
    ]
    stated = {other.name for other in prior_alternatives(relaxed)}
    assert stated == {
        *("Qx.K_F", "Qx.K_I", "Qx.K_III", "run2.platform.tilt.north", "run3.platform.tilt.north"),
        "platform.tilt.north",
    }
    between = [(-1e-2, 1e-2), (-1e-4, 1e-4), (-0.1, 0.1)]
    assert [other.credible_range for other in alternatives] == between
    assert [other.default_sd for other in alternatives] == [ARCSEC, 1e-6, 1e-5]
    held = run_score_tests(relaxed, alternatives, noise_given=True)
    for k, other in enumerate(alternatives):
        (place,) = other.prior_shifts
        without = without_prior(relaxed, [place]).solution
        spread = math.hypot(float(without.u[place]), relaxed.model.unknowns[place].prior[1])
        scale = max(1.0, without.chi2 / without.dof)
        apart = abs(float(without.estimate[place]))
        assert held.z[k] == pytest.approx(apart / spread / math.sqrt(scale), rel=1e-6, abs=1e-6)


def test_common_error_of_all_runs_is_found(series):
    off = replace(
        MODEL,
        unknowns=(
            *MODEL.unknowns[:4],
            *(replace(tilt, prior=(60.0 * ARCSEC, ARCSEC)) for tilt in TILTS),
        ),
    )
    relaxed = estimate_considered(fitted(series, off).fit)
    held = run_score_tests(relaxed, prior_alternatives(relaxed), noise_given=True)
    names = [other.name for other in held.alternatives]
    together = names.index("platform.tilt.north")
    single = [names.index(f"run{i}.platform.tilt.north") for i in (1, 2, 3)]
    assert held.z[together] > max(held.z[single])
    assert abs(held.value[together] + 60.0 * ARCSEC) < 4.0 * held.u[together]


def test_standardised_sizes_are_normal_for_correct_model():
    rng = np.random.default_rng(11)
    sizes = []
    clean = simulate_three_rates(TRUTH)
    for _ in range(60):
        drawn = [add_noise(one, Noise(WHITE), rng) for one in clean]
        priors = {
            "K_F": (TRUTH["K_F"] + 2e-6 * rng.standard_normal(), 2e-6),
            "K_I": (TRUTH["K_I"] + 5e-6 * rng.standard_normal(), 5e-6),
        }
        model = Unknowns(make_unknowns(["K_F", "K_I", "K_II"], priors))
        relaxed = estimate_considered(fitted(drawn, model, ESTIMATE).fit)
        columns = {0: drawn[0].time ** 2}
        own = Alternative("bias", "run1", "bias", columns)
        sizes.append(
            run_score_tests(relaxed, [*prior_alternatives(relaxed), own], noise_given=False).z
        )
    squares = np.square(sizes)
    # Sums of 60 squares of normal variables: 60 ± sqrt(120), held to 4 standard deviations.
    assert np.all(np.abs(squares.sum(axis=0) - 60.0) < 4.0 * math.sqrt(120.0))

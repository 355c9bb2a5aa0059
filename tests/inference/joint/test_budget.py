"""The budget: every line what it says, and all of them the whole."""

import math
from dataclasses import replace

import numpy as np
import pytest
from joint_campaign import (
    ARCSEC,
    DEG_H,
    RATES,
    SITE,
    add_noise,
    make_considered_inputs,
    make_unknowns,
    simulate_series,
    simulate_three_rates,
)

from counterspin.inference.joint.budget import budget, unknown_u_by_category
from counterspin.inference.joint.design_blocks import build_design_blocks
from counterspin.inference.joint.fit import solve_joint
from counterspin.inference.joint.series import INPUT_PERTURBATIONS, TIMING
from counterspin.inference.joint.summary import CONSIDERED, DEFAULT_PRIOR, NOISE, STATED
from counterspin.inference.joint.unknowns import Considered, Unknown, Unknowns
from counterspin.inference.noise.model import Noise

TRUTH = {"K_F": 5.03e-3, "K_I": 1.00197, "K_II": 2.7e-5, "K_III": 3.4e-6}
PRIORS = {"K_F": (5.03e-3, 2e-6), "K_I": (1.00197, 5e-6), "K_OO": (1e-6, 2e-6)}
SIZES = {
    "centrifuge.radius": 1e-4,
    "site.gravity": 1e-4,
    "site.latitude": 1e-3,
    TIMING: 1e-5,
}
NOISES = {"Qx": Noise(0.01), "Qy": Noise(0.02, 3e-4)}
SCALES = {"Qx": TRUTH["K_I"], "Qy": TRUTH["K_I"]}


@pytest.fixture(scope="module")
def series():
    rng = np.random.default_rng(1)
    clean = [
        record
        for name in ("Qx", "Qy")
        for record in simulate_three_rates(TRUTH, accelerometer=name)
    ]
    return [add_noise(one, NOISES[one.accelerometer], rng) for one in clean]


@pytest.fixture(scope="module")
def model():
    tilts = tuple(
        Unknown(
            f"run{i}",
            f"platform.tilt.{axis}",
            (0.0, 0.5 * ARCSEC),
            1e-2,
            is_of_interest=False,
            has_default_prior=axis == "north",
        )
        for i in (1, 2, 3)
        for axis in ("north", "east")
    )
    drift = Unknown("", "platform.drift.up", (0.0, 0.01 * DEG_H), 10 * DEG_H)
    own = tuple(u for name in ("Qx", "Qy") for u in make_unknowns((*TRUTH, "K_OO"), PRIORS, name))
    considered = (
        Considered("Qx", "K_PP", (0.0, 2e-6), 1e-4),
        Considered("Qy", "K_IO", (1e-6, 3e-6), 1e-4),
        Considered(
            "", "platform.g_sensitivity.zx", (0.0, 0.02 * DEG_H), 10 * DEG_H, has_default_prior=True
        ),
    )
    return Unknowns((*own, drift, *tilts), (*considered, *make_considered_inputs(SIZES)))


@pytest.fixture(scope="module")
def fit(series, model):
    plain = model.without_inputs()
    first = solve_joint(build_design_blocks(series, plain, SCALES), plain, NOISES)
    return solve_joint(
        build_design_blocks(series, model, SCALES, first.solution.estimate), model, NOISES
    )


def test_lines_sum_to_variance(fit, model):
    for index, unknown in enumerate(model.unknowns):
        lines = budget(fit, index)
        squares = math.fsum(line.contribution**2 for line in lines)
        whole = fit.solution.covariance[index, index]
        assert squares == pytest.approx(whole, rel=1e-10), unknown.name
        assert math.fsum(line.share for line in lines) == pytest.approx(1.0, abs=1e-10)
        assert [x.contribution for x in lines] == sorted(
            (x.contribution for x in lines), reverse=True
        )
        for line in lines:
            if line.kind == NOISE:
                assert line.u is None
                assert line.sensitivity is None
            else:
                assert line.contribution == pytest.approx(
                    abs(line.sensitivity) * line.u, rel=1e-9
                ), (unknown.name, line)


def test_kinds_sum_to_covariance_parts(fit, model):
    parts = {
        (NOISE,): fit.solution.covariance_noise,
        (STATED, DEFAULT_PRIOR): fit.solution.covariance_prior,
        (CONSIDERED,): fit.solution.covariance_considered,
    }
    for index in range(len(model.unknowns)):
        lines = budget(fit, index)
        for kinds, covariance in parts.items():
            squares = sum(line.contribution**2 for line in lines if line.kind in kinds)
            assert squares == pytest.approx(
                covariance[index, index], rel=1e-8, abs=1e-8 * fit.solution.u[index] ** 2
            )


def test_u_by_kind_matches_lines_and_sums_to_u(fit, model):
    """Considered terms count as stated or default; K_II of Qx has all three parts."""
    typical = {
        other.name for other in (*model.unknowns, *model.considered) if other.has_default_prior
    }
    for index, unknown in enumerate(model.unknowns):
        lines = budget(fit, index)
        u = fit.solution.u[index]
        squares = [
            sum(line.contribution**2 for line in lines if line.kind == NOISE),
            sum(x.contribution**2 for x in lines if x.kind != NOISE and x.source not in typical),
            sum(line.contribution**2 for line in lines if line.source in typical),
        ]
        parts = unknown_u_by_category(fit, index)
        assert math.hypot(*parts) == pytest.approx(u, rel=1e-10), unknown.name
        assert np.square(parts) == pytest.approx(squares, rel=1e-8, abs=1e-8 * u**2), unknown.name
        if unknown.name == "Qx.K_II":
            assert min(parts) > 1e-3 * u


def test_noise_of_accelerometers_has_separate_lines(series, fit, model):
    names = [u.name for u in model.unknowns]
    index = names.index("Qx.K_II")
    lines = {line.source: line for line in budget(fit, index) if line.kind == NOISE}
    # Qx's K_II rests on Qx's records.
    assert (
        lines["noise of Qx"].contribution
        > 100 * lines.get("noise of Qy", replace(lines["noise of Qx"], contribution=0)).contribution
    )
    drift = {line.source: line for line in budget(fit, names.index("platform.drift.up"))}
    assert {"noise of Qx", "noise of Qy"} <= set(drift)


def test_sensitivities_match_differences_of_estimates(series, fit, model):
    """Change priors, considered terms and inputs in turn and re-estimate."""
    index = [u.name for u in model.unknowns].index("Qx.K_II")
    plain = model.without_inputs()

    def estimate(changed, chosen=series):
        fit = solve_joint(build_design_blocks(chosen, changed, SCALES), changed, NOISES)
        return fit.solution.estimate[index]

    base = estimate(plain)
    compared = set()
    for line in budget(fit, index):
        if line.kind == NOISE:
            continue
        step = 10 * line.u

        def shifted(group, line=line, step=step):
            return tuple(
                replace(u, prior=(u.prior[0] + step, u.prior[1])) if u.name == line.source else u
                for u in group
            )

        if line.kind in (STATED, DEFAULT_PRIOR):
            changed = estimate(replace(plain, unknowns=shifted(plain.unknowns)))
        elif line.source == TIMING:
            continue  # its own test goes through the records' angles
        elif line.source not in SIZES:
            changed = estimate(replace(plain, considered=shifted(plain.considered)))
        else:
            step = line.u
            moved = []
            for record in series:
                motion = INPUT_PERTURBATIONS[line.source](record.trajectory, step)
                error = record.error + record.reference() - record.reference(motion)
                moved.append(replace(record, trajectory=motion, error=error))
            changed = estimate(plain, moved)
        compared.add("input" if line.source in SIZES else line.kind)
        derivative = (changed - base) / step
        small = 1e-3 * fit.solution.u[index] / step
        assert derivative == pytest.approx(line.sensitivity, rel=2e-3, abs=small), line.source
    assert compared == {STATED, DEFAULT_PRIOR, CONSIDERED, "input"}


def test_record_in_g_depends_on_assumed_gravity():
    """The assumed gravity converts a record from g to m/s^2."""
    changed_series = [
        replace(simulate_series(f"run{i}", r, TRUTH, observable="specific_force"), in_g=True)
        for i, r in enumerate(RATES)
    ]
    model = Unknowns(make_unknowns(TRUTH), make_considered_inputs({"site.gravity": 1e-4}))
    plain = model.without_inputs()
    noise = {"Qx": Noise(1e-3)}
    first = solve_joint(build_design_blocks(changed_series, plain, SCALES), plain, noise).solution
    fit = solve_joint(
        build_design_blocks(changed_series, model, SCALES, first.estimate), model, noise
    )
    step = 1e-3
    moved = []
    for s in changed_series:
        motion = INPUT_PERTURBATIONS["site.gravity"](s.trajectory, step)
        output = (s.error + s.reference()) * (SITE.gravity + step) / SITE.gravity
        moved.append(replace(s, trajectory=motion, error=output - s.reference(motion)))
    after = solve_joint(build_design_blocks(moved, plain, SCALES), plain, noise).solution
    np.testing.assert_allclose(
        (after.estimate - first.estimate) / step,
        fit.solution.sensitivity_considered[:, 0],
        rtol=2e-3,
        atol=1e-7 * np.abs(fit.solution.sensitivity_considered).max(),
    )


def test_exactly_known_unknown_has_no_budget():
    model = Unknowns(make_unknowns(TRUTH, {"K_F": (5.03e-3, 0.0)}))
    fit = solve_joint(
        build_design_blocks(simulate_three_rates(TRUTH), model, SCALES), model, {"Qx": Noise(0.01)}
    )
    assert budget(fit, 0) == []
    assert sum(line.share for line in budget(fit, 2)) == pytest.approx(1.0, abs=1e-9)

"""The whole joint estimate: noise given and estimated, rotation without angles, outliers on top."""

import math
import os
from dataclasses import replace

import numpy as np
import pytest
from joint_campaign import (
    DEG_H,
    NO_PRIOR,
    RATES,
    SITE,
    add_noise,
    make_considered_inputs,
    make_unknowns,
    simulate_series,
    simulate_three_rates,
)
from scipy.special import stdtrit

from counterspin.errors import ConvergenceError
from counterspin.inference.joint import outlier_rejection
from counterspin.inference.joint.design_blocks import build_design_blocks
from counterspin.inference.joint.estimation import estimate
from counterspin.inference.joint.fit import solve_joint
from counterspin.inference.joint.rotation import find_rotation
from counterspin.inference.joint.series import TIMING
from counterspin.inference.joint.unknowns import ROTATION, Considered, Unknown, Unknowns
from counterspin.inference.noise.model import ESTIMATE, Noise
from counterspin.physics.motion import Trajectory
from counterspin.physics.spindle import Spindle

FULL = bool(os.environ.get("COUNTERSPIN_FULL"))
TRUTH = {"K_F": 5.03e-3, "K_I": 1.00197, "K_II": 2.7e-5, "K_III": 3.4e-6}
PRIORS = {"K_F": (5.03e-3, 2e-6), "K_I": (1.00197, 5e-6)}
MODEL = Unknowns(make_unknowns(TRUTH))
TRUE = np.array([TRUTH[u.symbol] - u.nominal for u in MODEL.unknowns])
WHITE = Noise(0.01)
#: A walk that the records show in every trial: within a run it reaches forty times the white.
MIXED = Noise(0.01, 2e-3)


@pytest.fixture(scope="module")
def noise_free_series():
    return simulate_three_rates(TRUTH, per_revolution=16)


def bound_on_u(series, noise):
    """Return the standard uncertainties with known noise."""
    prepared = build_design_blocks(series, MODEL, {"Qx": TRUTH["K_I"]})
    return solve_joint(prepared, MODEL, {"Qx": noise}).solution.u


@pytest.mark.slow
@pytest.mark.parametrize(
    ("noise", "request_", "trials"),
    [
        (WHITE, Noise(ESTIMATE, 0.0), 4000 if FULL else 30),
        (MIXED, Noise(ESTIMATE, ESTIMATE), 4000 if FULL else 10),
        (MIXED, Noise(0.01, ESTIMATE), 4000 if FULL else 8),
    ],
    ids=["white", "mixed", "white given"],
)
def test_estimated_noise_reaches_bound_with_coverage(noise_free_series, noise, request_, trials):
    rng = np.random.default_rng(11)
    error, u, dof = (np.empty((trials, TRUE.size)) for _ in range(3))
    for row in range(trials):
        drawn = [add_noise(record, noise, rng) for record in noise_free_series]
        estimation = estimate(drawn, MODEL, {"Qx": request_}, rejects_outliers=False)
        assert estimation.estimated_noise["Qx"].dropped == ()
        error[row] = estimation.fit.solution.estimate - TRUE
        u[row], dof[row] = estimation.fit.solution.u, estimation.dof
    # Estimated weights cost a little where few degrees of freedom lie behind them.
    ratio = error.std(axis=0) / bound_on_u(noise_free_series, noise)
    np.testing.assert_allclose(ratio, 1.0, atol=0.02 + 3.5 / math.sqrt(2 * trials))
    for level in (0.68, 0.95, 0.99):
        inside = np.abs(error / u) < stdtrit(dof, 0.5 + level / 2)
        spread = math.sqrt(level * (1 - level) / trials)
        # Satterthwaite's approximation is allowed half a per cent.
        assert (np.abs(inside.mean(axis=0) - level) < 0.005 + 3.5 * spread).all()
    if noise is WHITE:
        rows = sum(record.time.size - 2 for record in noise_free_series)
        np.testing.assert_allclose(dof, rows - TRUE.size, rtol=1e-6)
    else:
        # K_F rests on the walk, of which a run has few degrees of freedom; K_I does not.
        assert np.median(dof[:, 0]) < 60
        assert np.median(dof[:, 1]) > 200


def test_given_noise_is_used(noise_free_series):
    rng = np.random.default_rng(12)
    drawn = [add_noise(record, WHITE, rng) for record in noise_free_series]
    estimation = estimate(drawn, MODEL, {"Qx": Noise(0.02, 0.0)})
    assert estimation.fit.noise == {"Qx": Noise(0.02)}
    assert not estimation.estimated_noise
    assert np.isinf(estimation.dof).all()
    np.testing.assert_allclose(
        estimation.fit.solution.u, 2 * bound_on_u(noise_free_series, WHITE), rtol=1e-6
    )


def test_absent_component_is_dropped_without_cost(noise_free_series):
    rng = np.random.default_rng(13)
    (trials, most), kept = (20, 4) if FULL else (10, 3), 0
    for _ in range(trials):
        drawn = [add_noise(record, WHITE, rng) for record in noise_free_series]
        estimation = estimate(
            drawn, MODEL, {"Qx": Noise(ESTIMATE, ESTIMATE)}, rejects_outliers=False
        )
        kept += "random_walk" in estimation.estimated_noise["Qx"].estimated
        if estimation.estimated_noise["Qx"].dropped:
            assert estimation.estimated_noise["Qx"].dropped == ("random_walk",)
            # Its weights are those of white noise; what may not show is beside them in u.
            solution = replace(estimation.fit.solution, covariance_undetected=None)
            alone = bound_on_u(noise_free_series, Noise(estimation.fit.noise["Qx"].white))
            np.testing.assert_allclose(solution.u, alone, rtol=1e-5)
            assert estimation.fit.solution.u[0] > 1.05 * alone[0]
    # At most 5 % at the boundary: more than 3 of 10 have a probability of 1e-3, than 4 of 20 3e-3.
    assert kept <= most


@pytest.mark.parametrize("white", [ESTIMATE, 2e-3])
def test_quantisation_larger_than_noise(white):
    step, noise = 0.01, Noise(2e-3)
    # 31.4 samples a revolution, so that the steps do not fall alike in every revolution.
    series = [simulate_series(f"run{i}", r, TRUTH, per_revolution=31) for i, r in enumerate(RATES)]
    rng = np.random.default_rng(14)
    trials, distance = 25 if FULL else 12, 0.0
    for _ in range(trials):
        drawn = []
        for record in series:
            reference = record.reference()
            # A platform is never started twice at the same place.
            output = add_noise(record, noise, rng).error + reference + rng.uniform(0, step)
            drawn.append(replace(record, error=step * np.round(output / step) - reference))
        estimation = estimate(drawn, MODEL, {"Qx": Noise(white, 0.0, step)})
        level = estimation.fit.noise["Qx"]
        assert level.quantisation == step
        assert math.sqrt(level.sample_variance) == pytest.approx(
            math.hypot(2e-3, step / math.sqrt(12)), rel=0.1
        )
        z = (estimation.fit.solution.estimate - TRUE) / estimation.fit.solution.u
        distance += z[2] ** 2
        assert sum(mask.sum() for mask in estimation.outliers) == 0
    assert abs(distance - trials) < 4 * math.sqrt(2 * trials)


def test_considered_term_is_subtracted_before_noise_estimation(noise_free_series):
    model = Unknowns(
        make_unknowns(("K_I", "K_II", "K_III")), (Considered("Qx", "K_F", PRIORS["K_F"], 0.1),)
    )
    drawn = [add_noise(record, WHITE, np.random.default_rng(15)) for record in noise_free_series]
    estimation = estimate(drawn, model, {"Qx": Noise(ESTIMATE, 0.0)})
    # 5 mg in 48 s are 57 m.
    assert estimation.fit.noise["Qx"].white == pytest.approx(0.01, rel=4 / math.sqrt(2 * 570))


@pytest.mark.parametrize("held", [False, True], ids=["unknown", "held"])
def test_delay_within_uncertainty_is_not_noise(noise_free_series, held):
    """Angles are taken 6 ms late, known to 5 ms: 0.1 m at the highest rate, ten times the noise."""
    rng = np.random.default_rng(20)
    late = [
        replace(record, error=record.error + record.reference() - record.reference(delay=6e-3))
        for record in noise_free_series
    ]
    drawn = [add_noise(one, WHITE, rng) for one in late]
    drawn[2].error[100] += 0.15
    delay = make_considered_inputs({TIMING: 5e-3})
    model = Unknowns(MODEL.unknowns, delay) if held else Unknowns((*MODEL.unknowns, *delay))
    estimation = estimate(drawn, model, {"Qx": Noise(ESTIMATE, 0.0)})
    assert estimation.fit.noise["Qx"].white == pytest.approx(0.01, rel=4 / math.sqrt(2 * 570))
    assert [np.flatnonzero(mask).tolist() for mask in estimation.outliers] == [[], [], [100]]


def test_early_outliers_do_not_bias_input_derivatives(noise_free_series):
    """A radius known to 1e-3 of itself does to the records what K_I is found to be, not guessed."""
    model = Unknowns((*MODEL.unknowns, *make_considered_inputs({"centrifuge.radius": 2.5e-3})))
    drawn = [add_noise(record, WHITE, np.random.default_rng(21)) for record in noise_free_series]
    for new_record in drawn:
        new_record.error[::97] += 2e3
    estimation = estimate(drawn, model, {"Qx": WHITE})
    at, k = estimation.fit.solution.estimate, 1.0 + estimation.fit.solution.estimate[1]
    kept = [record.drop_rows(mask) for record, mask in zip(drawn, estimation.outliers, strict=True)]
    again = solve_joint(
        build_design_blocks(kept, model, {"Qx": k}, at), model, {"Qx": WHITE}
    ).solution
    assert np.max(np.abs(at - again.estimate) / again.u) < 1e-3
    np.testing.assert_allclose(estimation.fit.solution.u, again.u, rtol=1e-3)


def test_time_stamp_noise_counts_once(noise_free_series):
    rng = np.random.default_rng(16)
    drawn = []
    for rank, new_record in enumerate(noise_free_series):
        series = new_record.with_timestamp_noise(5e-4 * rank)
        late = np.sqrt(series.jitter_variance) * rng.standard_normal(new_record.time.size)
        drawn.append(add_noise(replace(series, error=new_record.error + late), WHITE, rng))
    rows = sum(record.time.size for record in drawn)
    for request in (Noise(ESTIMATE, 0.0), Noise(ESTIMATE, ESTIMATE), Noise(0.01, 0.0)):
        estimation = estimate(drawn, MODEL, {"Qx": request})
        assert estimation.fit.noise["Qx"].white == pytest.approx(0.01, rel=6 / math.sqrt(2 * rows))
        chi2 = estimation.fit.solution.chi2 / estimation.fit.solution.dof
        assert chi2 == pytest.approx(1.0, abs=4 * math.sqrt(2 / rows))
        assert estimation.fit.noise["Qx"].quantisation == 0.0


def test_two_accelerometers_have_separate_noise_and_shared_platform():
    platform = {"platform.drift.up": 0.1 * DEG_H}
    series = [
        record
        for name in ("Qx", "Qy")
        for record in simulate_three_rates(TRUTH, platform, accelerometer=name, per_revolution=16)
    ]
    levels = {"Qx": WHITE, "Qy": Noise(0.03)}
    rng = np.random.default_rng(17)
    drawn = [add_noise(record, levels[record.accelerometer], rng) for record in series]
    drift = Unknown("", "platform.drift.up", NO_PRIOR, 10 * DEG_H)
    model = Unknowns((*make_unknowns(TRUTH), *make_unknowns(TRUTH, owner="Qy"), drift))
    both = {"Qx": Noise(ESTIMATE, 0.0), "Qy": Noise(ESTIMATE, 0.0)}
    estimation = estimate(drawn, model, both)
    for name, level in levels.items():
        assert estimation.fit.noise[name].white == pytest.approx(level.white, rel=0.12)
    # What both say has more degrees of freedom than either; what one says has its own.
    own, shared = estimation.dof[2], estimation.dof[-1]
    assert own == pytest.approx(577 - 6 + 2 - 5, abs=12)
    weight = estimation.fit.solution.u[-1] ** 2
    parts = []
    for name in ("Qx", "Qy"):
        alone = [record for record in drawn if record.accelerometer == name]
        solo = estimate(
            alone, Unknowns((*make_unknowns(TRUTH, owner=name), drift)), {name: both[name]}
        )
        parts.append((weight / solo.fit.solution.u[-1] ** 2, solo.dof[-1]))
    # Welch and Satterthwaite: 1/dof is the sum of (share^2/dof).
    assert 1 / shared == pytest.approx(sum(share**2 / dof for share, dof in parts), rel=0.02)
    given = estimate(drawn, model, {"Qx": Noise(0.01, 0.0), "Qy": Noise(ESTIMATE, 0.0)})
    assert np.isinf(given.dof[:4]).all() or (given.dof[:4] > 1e5).all()
    assert set(given.estimated_noise) == {"Qy"}


def test_platform_errors_scale_with_estimated_scale_factor():
    truth = TRUTH | {"K_I": 1.05}
    platform = {"platform.tilt.north": 3e-3}
    series = simulate_three_rates(truth, platform, per_revolution=16)
    tilts = tuple(Unknown(f"run{i}", "platform.tilt.north", NO_PRIOR, 1e-2) for i in (1, 2, 3))
    model = Unknowns((*make_unknowns(TRUTH, {"K_F": (5.03e-3, 1e-9)}), *tilts))
    estimation = estimate(series, model, {"Qx": Noise(1e-4, 0.0)})
    # 1.05 x 3e-3: with K_I = 1 the tilt would be 5 % too large.
    for tilt in estimation.fit.solution.estimate[-3:]:
        assert tilt == pytest.approx(3e-3, rel=1e-4)


# No angle -----------------------------------------------------------------------------------------


def make_series_without_angle(start, rate_error, drift, observable="displacement", revolutions=12):
    """Return series at the nominal rate of a spindle with a different rotation."""
    series = []
    for i, rate in enumerate(RATES, start=1):
        turned = Spindle(rate * (1 + rate_error), drift, start_angle=start)
        new_series = simulate_series(
            f"run{i}", rate, TRUTH, spindle=turned, revolutions=revolutions, observable=observable
        )
        nominal = Trajectory(Spindle(rate), 2.5, SITE)
        moved = new_series.error + new_series.reference() - new_series.reference(nominal)
        series.append(replace(new_series, trajectory=nominal, error=moved))
    return series


ROTATIONS = tuple(
    Unknown(f"run{i}", symbol, NO_PRIOR, limit)
    for i in (1, 2, 3)
    for symbol, limit in zip(ROTATION, (math.pi, 1.0, 1e-2), strict=True)
)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("start", "rate_error", "drift", "revolutions"),
    [
        (0.0, 1e-4, 1e-6, 12),
        (0.3, 1e-4, 1e-6, 100),
        (-2.5, 1e-3, 1e-6, 12),
        (math.pi, 1e-4, 0.0, 12),
        (1.5, 1e-2, 1e-6, 100),
    ],
)
def test_rotation_is_estimated_from_displacement(start, rate_error, drift, revolutions):
    model = Unknowns((*make_unknowns(TRUTH, PRIORS), *ROTATIONS))
    rng = np.random.default_rng(18)
    series = make_series_without_angle(start, rate_error, drift, revolutions=revolutions)
    trials, z = (8 if revolutions < 50 else 4), []
    for _ in range(trials):
        drawn = [add_noise(record, WHITE, rng) for record in series]
        estimation = estimate(drawn, model, {"Qx": Noise(0.01, 0.0)})
        z.append((estimation.fit.solution.estimate[:4] - TRUE) / estimation.fit.solution.u[:4])
        for design_block, rate in zip(estimation.fit.design_blocks, RATES, strict=True):
            spindle = design_block.series.trajectory.spindle
            turn = math.remainder(spindle.start_angle - start, 2 * math.pi)
            index = [u.name for u in model.unknowns].index(
                f"{design_block.series.run}.spindle.start_angle"
            )
            u = estimation.fit.solution.u[index : index + 3]
            assert abs(turn) < 5 * u[0]
            assert abs(spindle.rate - rate * (1 + rate_error)) < 5 * u[1]
            assert abs(spindle.drift - drift) < 5 * u[2]
    z = np.array(z)
    assert abs(np.sum(z[:, 2] ** 2) - trials) < 4 * math.sqrt(2 * trials)
    assert abs(z[:, 2].mean()) < 4 / math.sqrt(trials)


def test_rotating_term_is_not_confused_with_start_angle():
    """Compliance about up by force along it turns the output as a common start angle does."""
    compliance = Unknown("", "platform.compliance.zz", NO_PRIOR, 1e-4)
    model = Unknowns((*make_unknowns(TRUTH, PRIORS), compliance, *ROTATIONS))
    rng = np.random.default_rng(4)
    drawn = [
        add_noise(one, Noise(0.1), rng)
        for one in make_series_without_angle(0.3, 1e-4, 1e-6, revolutions=12)
    ]
    rough = {"Qx": TRUTH["K_I"]}, {"Qx": Noise(1.0)}
    known = Unknowns((*make_unknowns(TRUTH, PRIORS), *ROTATIONS))
    starts = [
        [one.trajectory.spindle.start_angle for one in find_rotation(drawn, each, *rough)]
        for each in (model, known)
    ]
    # Sizes beyond the credible 1e-4 rad/g are not looked at: what is left of it is that small.
    np.testing.assert_allclose(*starts, rtol=0.0, atol=1e-3)


def test_rotation_that_does_not_converge_raises():
    model = Unknowns((*make_unknowns(TRUTH, PRIORS), *ROTATIONS))
    with pytest.raises(ConvergenceError, match="nominal rate is too inaccurate"):
        estimate(make_series_without_angle(0.0, 0.7, 0.0), model, {"Qx": Noise(0.01, 0.0)})


# Outliers -----------------------------------------------------------------------------------------


def test_k_ii_is_within_u_with_outliers_and_gaps(noise_free_series):
    series = simulate_three_rates(TRUTH, per_revolution=64)
    rng = np.random.default_rng(19)
    trials, z, planted_in_all, missed, false_alarms = 20, [], 0, 0, 0
    for _ in range(trials):
        drawn, masks = [], []
        for record in series:
            n = record.time.size
            gap = np.zeros(n, dtype=bool)
            first = rng.integers(n // 3, n // 2)
            gap[first : first + 40] = True
            dirty = add_noise(record, WHITE, rng)
            spikes = rng.random(n) < 0.005
            size = np.exp(rng.uniform(math.log(0.1), math.log(5.0), n)) * rng.choice([-1, 1], n)
            dirty = replace(dirty, error=dirty.error + spikes * size).drop_rows(gap)
            drawn.append(dirty)
            masks.append(spikes[~gap])
        estimation = estimate(drawn, MODEL, {"Qx": Noise(0.01, 0.0)})
        planted = np.concatenate(masks)
        seen = np.concatenate(estimation.outliers)
        planted_in_all += planted.sum()
        missed += (planted & ~seen).sum()
        false_alarms += (seen & ~planted).sum()
        z.append((estimation.fit.solution.estimate - TRUE) / estimation.fit.solution.u)
        for record, mask, data in zip(
            estimation.fit.design_blocks, estimation.outliers, drawn, strict=True
        ):
            np.testing.assert_array_equal(record.series.time, data.time[~mask])
    # Ten standard deviations and more: all are found; 0.01 good samples of a series are lost.
    assert planted_in_all > 100
    assert missed == 0
    assert false_alarms <= 4
    distance = np.sum(np.square(z), axis=0)
    assert (np.abs(distance - trials) < 4 * math.sqrt(2 * trials)).all()


@pytest.mark.parametrize(
    ("observable", "noise"),
    [
        ("displacement", Noise(1e-2, 2e-3)),
        ("displacement", Noise(1e-3, 2e-3)),
        ("displacement", Noise(1e-4, 2e-3)),
        ("displacement", Noise(1e-6, 2e-3)),
        ("velocity", Noise(1e-6, 3e-4)),
        ("specific_force", Noise(0.0, 3e-4)),
    ],
)
def test_random_walk_is_not_outlying(observable, noise):
    rng = np.random.default_rng(21)
    series = simulate_three_rates(TRUTH, per_revolution=64, observable=observable)
    rejected = 0
    for _ in range(4):
        drawn = [add_noise(record, noise, rng) for record in series]
        estimation = estimate(drawn, MODEL, {"Qx": Noise(noise.white, noise.random_walk)})
        rejected += sum(mask.sum() for mask in estimation.outliers)
    assert rejected <= 2


@pytest.mark.parametrize("white", [ESTIMATE, 0.02])
def test_time_stamp_noise_is_proportional_to_slope(white):
    """It is less than the white noise at the lowest rate, and forty times it at the highest."""
    rng = np.random.default_rng(22)
    timing, drawn = 2e-3, []
    for i, rate in enumerate(RATES):
        series = simulate_series(f"run{i}", rate, TRUTH, observable="specific_force")
        slope = (series.reference(delay=1e-4) - series.reference(delay=-1e-4)) / 2e-4
        late = timing * rng.standard_normal(series.time.size)
        moved = add_noise(replace(series, error=series.error + slope * late), Noise(0.02), rng)
        drawn.append(moved.with_timestamp_noise(timing))
    estimation = estimate(drawn, MODEL, {"Qx": Noise(white, 0.0)})
    solution = estimation.fit.solution
    assert estimation.fit.noise["Qx"].white == pytest.approx(0.02, rel=0.2)
    assert abs(solution.chi2 / solution.dof - 1.0) < 4 * math.sqrt(2 / solution.dof)
    assert np.abs((solution.estimate - TRUE) / solution.u).max() < 4
    # By chance a hundredth of a sample is lost of each record.
    assert sum(mask.sum() for mask in estimation.outliers) == 0


def test_samples_rejected_by_previous_model_are_restored(noise_free_series):
    rng = np.random.default_rng(23)
    drawn = [add_noise(record, WHITE, rng) for record in noise_free_series]
    drawn[2].error[100] += 0.15
    outliers = [np.zeros(record.time.size, dtype=bool) for record in drawn]
    outliers[2][50:101] = True
    prepared = build_design_blocks(drawn, MODEL, {"Qx": TRUTH["K_I"]})
    kept = [part.drop_rows(mask) for part, mask in zip(prepared, outliers, strict=True)]
    fit = solve_joint(kept, MODEL, {"Qx": WHITE})
    noise, outliers = {"Qx": Noise(0.01, 0.0)}, tuple(outliers)
    again, left = outlier_rejection.reinstate_rows(fit, (prepared, MODEL), drawn, noise, outliers)
    assert [np.flatnonzero(mask).tolist() for mask in left] == [[], [], [100]]
    only = [part.drop_rows(mask) for part, mask in zip(prepared, left, strict=True)]
    expected = solve_joint(only, MODEL, {"Qx": WHITE}).solution
    np.testing.assert_allclose(again.solution.u, expected.u, rtol=1e-9)
    np.testing.assert_allclose(again.solution.estimate, expected.estimate, rtol=1e-6, atol=1e-12)

"""What the encoder's noise hides of the rotation is in the columns, in u and in the budget."""

import math
import os
from dataclasses import replace

import numpy as np
import pytest
from joint_campaign import LEVEL, RATES, add_noise, make_unknowns, simulate_series
from scipy.special import stdtrit

from counterspin.inference.joint import encoder
from counterspin.inference.joint.budget import budget, u_by_category, unknown_u_by_category
from counterspin.inference.joint.design_blocks import build_design_blocks
from counterspin.inference.joint.estimation import estimate
from counterspin.inference.joint.fit import solve_joint
from counterspin.inference.joint.summary import NOISE
from counterspin.inference.joint.unknowns import Considered, Unknowns
from counterspin.inference.noise.model import ESTIMATE, Noise
from counterspin.physics import simulation
from counterspin.physics.accelerometer import QX
from counterspin.physics.spindle import Ripple, Spindle, fit_spindle

FULL = bool(os.environ.get("COUNTERSPIN_FULL"))
TRUTH = {"K_F": 5.03e-3, "K_I": 1.00197, "K_II": 2.7e-5, "K_III": 3.4e-6}
MODEL = Unknowns(make_unknowns(TRUTH))
TRUE = np.array([TRUTH[u.symbol] - u.nominal for u in MODEL.unknowns])
#: Coefficients large enough for their part of a column to show in differences.
LARGE = {
    "K_F": 0.01,
    "K_I": 1.05,
    "K_II": 3e-3,
    "K_III": 3e-4,
    "K_IP": 2e-3,
    "K_IO": 4e-3,
    "K_OO": -2e-3,
    "K_PP": 1e-3,
    "K_OQ": 2e-3,
    "delta_O": 5e-3,
    "delta_P": 8e-3,
}
TILTED = np.array([[1.0, 0.0, 0.0], [0.0, 0.6, 0.8], [0.0, -0.8, 0.6]])


def fit_encoder_angle(series, encoder_noise, rng):
    """Return the series relative to the spindle that is fitted to a noisy angle."""
    fitted_series = []
    for record in series:
        angle = record.trajectory.spindle.angle(record.time)
        angle = angle + encoder_noise * rng.standard_normal(record.time.size)
        fit = fit_spindle(record.time, angle, record.trajectory.spindle.rate * (1 + 1e-6))
        motion = replace(record.trajectory, spindle=fit.spindle)
        error = record.error + record.reference() - record.reference(motion)
        fitted_series.append(replace(record, trajectory=motion, error=error, angle_error=fit.error))
    return fitted_series


def make_rippled_series(observable, size, rng, **more):
    """Return runs with a first and third harmonic of the rate with random phases."""
    series = []
    for i, rate in enumerate(RATES, start=1):
        phases = rng.uniform(0, 2 * math.pi, 2)
        ripples = tuple(
            Ripple(n, rate * size, phase) for n, phase in zip((1, 3), phases, strict=True)
        )
        spindle = Spindle(rate, 1e-6, ripples, start_angle=rng.uniform(0, 6))
        series.append(
            simulate_series(f"run{i}", rate, TRUTH, observable=observable, spindle=spindle, **more)
        )
    return series


# Columns ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("observable", ["displacement", "velocity", "specific_force"])
@pytest.mark.parametrize("attitude", [LEVEL, TILTED], ids=["level", "tilted"])
def test_columns_match_simulation(observable, attitude):
    """Compare the chain rule with full simulations of ripple, start angle and drift."""
    spindle = Spindle(RATES[1], 1e-5, start_angle=0.4)
    series = simulate_series("run", RATES[1], LARGE, observable=observable, spindle=spindle)
    rng = np.random.default_rng(1)
    fit = fit_spindle(
        series.time,
        spindle.angle(series.time) + 1e-6 * rng.standard_normal(series.time.size),
        RATES[1],
    )
    # The root as a diagonal: each term is one parameter then.
    u = np.sqrt(np.sum(fit.error.root**2, axis=1))
    error = replace(fit.error, rate=RATES[1], root=np.diag(u), deviation=0 * u)
    series = replace(series, attitude=attitude, angle_error=error)
    symbols = ["encoder.angle"] + [
        f"encoder.ripple{n}.{q}" for n in (1, 2, 3, 4) for q in ("cos", "sin")
    ]
    known = {s: value - (s == "K_I") for s, value in LARGE.items() if s != "K_F"}
    columns = encoder.columns(series, symbols, known)

    def recorded(turned):
        motion = replace(series.trajectory, spindle=turned)
        return simulation.simulate_record(
            motion, QX, LARGE, {}, series.time, observable, attitude=attitude
        )

    def shift_angle(symbol, step):
        if symbol == "encoder.angle":
            return replace(spindle, start_angle=spindle.start_angle + step)
        n = int(symbol.split(".")[1].removeprefix("ripple"))
        cos = symbol.endswith("cos")
        more = Ripple(n, step, math.pi if cos else math.pi / 2)
        start = spindle.start_angle + (step / (n * RATES[1]) if cos else 0.0)
        return replace(spindle, ripples=(more,), start_angle=start)

    own = np.vander(series.time, series.order, increasing=True)
    for symbol, column in zip(symbols, columns.T, strict=True):
        step = 1e-4
        change = (recorded(shift_angle(symbol, step)) - recorded(shift_angle(symbol, -step))) / (
            2 * step
        )
        expected = change * u[0 if symbol == "encoder.angle" else 3 + symbols.index(symbol) - 1]
        apart = column - expected
        if series.order:
            apart = apart - own @ np.linalg.lstsq(own, apart, rcond=None)[0]
        # Differences err by the step squared; integrated Coriolis forces of K_I - 1 are left out.
        assert np.abs(apart).max() < 2e-5 * np.abs(expected).max() + 1e-12, symbol
    # Without the coefficients' part the comparison would fail.
    plain = encoder.columns(series, symbols, {})
    assert np.abs(plain - columns).max() > 1e-3 * np.abs(columns).max()


def test_terms_over_blocks_are_averaged():
    one = fit_encoder_angle(
        [simulate_series("run", RATES[2], TRUTH)], 1e-6, np.random.default_rng(2)
    )[0]
    spread = np.full(one.time.size, 2e-3)
    mean = encoder.columns(replace(one, time_sd=spread), ["encoder.ripple2.sin"], {"K_I": 0.0})
    fine = [
        encoder.columns(replace(one, time=one.time + shift), ["encoder.ripple2.sin"], {})
        for shift in (-2e-3, 2e-3)
    ]
    np.testing.assert_allclose(mean, 0.5 * (fine[0] + fine[1]), rtol=1e-12)


# Which terms --------------------------------------------------------------------------------------


def choose_encoder_terms(observable, encoder_noise, noise):
    rng = np.random.default_rng(3)
    series = fit_encoder_angle(make_rippled_series(observable, 0.0, rng), encoder_noise, rng)
    model = encoder.add_encoder_terms(MODEL, series, {"Qx": noise})
    return series, model


def test_low_noise_encoder_needs_no_terms_in_displacement():
    _, model = choose_encoder_terms("displacement", 1e-6, Noise(0.01))
    assert model is MODEL


def test_terms_determined_by_records_are_unknowns():
    _, model = choose_encoder_terms("specific_force", 1e-5, Noise(1e-4))
    assert not model.considered
    assert len(model.unknowns) == len(TRUTH) + 3 * 11
    assert {u.owner for u in model.unknowns} == {"Qx", "run1", "run2", "run3"}


@pytest.mark.parametrize(
    ("observable", "encoder_noise", "noise"),
    [
        ("displacement", 2e-5, Noise(0.01)),
        ("displacement", 2e-5, Noise(0.01, 1e-3)),
        ("velocity", 2e-7, Noise(1e-4)),
        ("specific_force", 4e-8, Noise(1e-4, 1e-6)),
    ],
)
def test_omitted_and_considered_terms_are_below_limit(observable, encoder_noise, noise):
    series, model = choose_encoder_terms(observable, encoder_noise, noise)
    assert model.considered
    every = tuple(
        Considered(run.run, symbol, (0.0, 1.0), 10.0)
        for run in series
        for symbol in encoder._angle_error_symbols(run.angle_error)
    )
    whole = replace(MODEL, considered=every)
    prepared = build_design_blocks(series, whole, {"Qx": TRUTH["K_I"]})
    solution = solve_joint(prepared, whole, {"Qx": noise}).solution
    names = [c.name for c in every]
    kept = {c.name for c in model.considered}
    taken = {u.name for u in model.unknowns}
    share = solution.sensitivity_considered**2 / np.diag(solution.covariance_noise)[:, None]
    for place, name in enumerate(names):
        limit = math.inf if name in taken else 1e-2 if name in kept else 1e-5
        assert share[:, place].max() < limit, name


def test_u_from_encoder_is_noise():
    """The uncertainty of the rotation comes from the noise of the angle, not from a prior."""
    noise = Noise(1e-4)
    series, model = choose_encoder_terms("specific_force", 1e-5, noise)
    fit = solve_joint(
        build_design_blocks(series, model, {"Qx": TRUTH["K_I"]}), model, {"Qx": noise}
    )
    for index, unknown in enumerate(MODEL.unknowns):
        prior = float(fit.solution.covariance_prior[index, index])
        assert prior > 1e-3 * fit.solution.u[index] ** 2, unknown.name
        expected = (fit.solution.u[index], 0.0, 0.0)
        weights = np.eye(len(model.unknowns))[index]
        for parts in (unknown_u_by_category(fit, index), u_by_category(fit, weights)):
            assert parts == pytest.approx(expected, rel=1e-10, abs=1e-10 * expected[0])


def test_run_without_angle_has_no_encoder_terms():
    assert encoder.add_encoder_terms(
        MODEL, make_rippled_series("velocity", 0.0, np.random.default_rng(4)), {}
    ) is (MODEL)


# Coverage -----------------------------------------------------------------------------------------


def simulate_hidden_ripple(encoder_noise, samples):
    """Return runs with a ripple of twice its standard uncertainty from the encoder."""
    return 2.0 * encoder_noise * math.sqrt(2.0 / samples)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("observable", "encoder_noise", "request_"),
    [
        ("specific_force", 1e-5, Noise(1e-4, 0.0)),
        ("specific_force", 1e-5, Noise(ESTIMATE, 0.0)),
        ("velocity", 1e-4, Noise(1e-4, 0.0)),
        ("velocity", 1e-4, Noise(ESTIMATE, 0.0)),
        ("displacement", 1e-3, Noise(1e-2, 0.0)),
    ],
)
def test_u_covers_hidden_ripple(observable, encoder_noise, request_):
    rng = np.random.default_rng(5)
    noise = Noise(1e-2 if observable == "displacement" else 1e-4)
    # Who takes the rotation as exact need not look for the noise: once is enough.
    compared = observable != "displacement" and request_.white is not ESTIMATE
    trials = 2000 if FULL else 40 if compared else 8
    inside, distance, blind = np.zeros(TRUE.size), np.zeros(TRUE.size), np.zeros(TRUE.size)
    for _ in range(trials):
        size = simulate_hidden_ripple(encoder_noise, 385)
        true = [
            add_noise(record, noise, rng) for record in make_rippled_series(observable, size, rng)
        ]
        series = fit_encoder_angle(true, encoder_noise, rng)
        estimation = estimate(series, MODEL, {"Qx": request_}, rejects_outliers=False)
        p = TRUE.size
        z = (estimation.fit.solution.estimate[:p] - TRUE) / estimation.fit.solution.u[:p]
        inside += np.abs(z) < stdtrit(np.minimum(estimation.dof[:p], 1e6), 0.975)
        distance += z**2
        if compared:
            ignorant = [replace(record, angle_error=None) for record in series]
            without = estimate(
                ignorant, MODEL, {"Qx": Noise(noise.white, 0.0)}, rejects_outliers=False
            )
            blind += ((without.fit.solution.estimate - TRUE) / without.fit.solution.u) ** 2
    assert (np.abs(inside / trials - 0.95) < 4 * math.sqrt(0.95 * 0.05 / trials)).all()
    by_chance = 5 * math.sqrt(2 * trials)
    assert (np.abs(distance - trials) < by_chance).all()
    if compared:
        # Taken as exact, the rotation puts K_II farther off than its u explains.
        assert blind[2] - trials > by_chance


def test_hidden_ripple_does_not_increase_noise():
    """Ripple that the encoder hides is in the residuals and must not count as noise."""
    rng = np.random.default_rng(6)
    true = make_rippled_series("specific_force", simulate_hidden_ripple(1e-5, 385), rng)
    series = fit_encoder_angle([add_noise(one, Noise(1e-4), rng) for one in true], 1e-5, rng)
    estimation = estimate(series, MODEL, {"Qx": Noise(ESTIMATE, 0.0)}, rejects_outliers=False)
    rows = sum(record.time.size for record in series)
    assert estimation.fit.noise["Qx"].white == pytest.approx(1e-4, rel=4 / math.sqrt(2 * rows))


def test_budget_has_lines_of_rotation():
    rng = np.random.default_rng(7)
    series = fit_encoder_angle(make_rippled_series("specific_force", 0.0, rng), 1e-5, rng)
    series = [add_noise(record, Noise(1e-4), rng) for record in series]
    estimation = estimate(series, MODEL, {"Qx": Noise(1e-4, 0.0)}, rejects_outliers=False)
    for index, u in enumerate(estimation.fit.solution.u[:4]):
        lines = budget(estimation.fit, index)
        assert math.fsum(x.contribution**2 for x in lines) == pytest.approx(u**2, rel=1e-10)
        for line in lines:
            if line.source.startswith("run"):
                product = abs(line.sensitivity) * line.u
                assert line.contribution == pytest.approx(product, rel=1e-12)
    lines = {line.source: line for line in budget(estimation.fit, 2)}
    # The fastest run decides K_II, and its ripple of twice the angle stands where K_II does.
    ripples = lines["run3.ripple1"], lines["run3.ripple3"]
    assert all(line.kind == NOISE for line in ripples)
    for n, line in zip((1, 3), ripples, strict=True):
        expected = n * RATES[2] * 1e-5 * math.sqrt(2 / 385)
        assert line.u == pytest.approx(expected, rel=0.15)
    assert max(x.share for x in ripples) > 1e-3
    # Two quadratures are one line, and the noise keeps its own.
    assert len([s for s in lines if s.startswith("run3.ripple")]) <= 4
    assert lines["noise of Qx"].kind == "noise"


def test_u_increases_with_encoder_noise():
    """A perfect encoder changes nothing; a very noisy encoder leaves the output alone."""
    rng = np.random.default_rng(8)
    true = [
        add_noise(record, Noise(1e-4), rng)
        for record in make_rippled_series("specific_force", 0.0, rng)
    ]
    request = {"Qx": Noise(1e-4, 0.0)}
    exact = estimate(true, MODEL, request, rejects_outliers=False).fit.solution
    u = []
    for size in (1e-9, 1e-6, 1e-5, 1e-3):
        series = fit_encoder_angle(true, size, np.random.default_rng(9))
        u.append(estimate(series, MODEL, request, rejects_outliers=False).fit.solution.u[2])
    assert u[0] == pytest.approx(exact.u[2], rel=1e-3)
    assert u == sorted(u)
    assert u[3] < 3 * exact.u[2]
    series = fit_encoder_angle(true, 1e-9, np.random.default_rng(9))
    solution = estimate(series, MODEL, request, rejects_outliers=False).fit.solution
    np.testing.assert_allclose(solution.estimate[:4], exact.estimate, atol=0.05 * exact.u.max())

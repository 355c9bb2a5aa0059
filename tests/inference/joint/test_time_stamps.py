"""A time stamp that errs moves the angle and the output of its row: found, followed, and in u."""

import math
from dataclasses import replace

import numpy as np
import pytest
from dense_stamps import Machine, Records, fit_rows
from joint_campaign import RATES, SITE, add_noise, make_unknowns, simulate_series

from counterspin.inference.joint import encoder, rotation
from counterspin.inference.joint.estimation import estimate
from counterspin.inference.joint.rotation import second_order_bound
from counterspin.inference.joint.series import TimestampErrors
from counterspin.inference.joint.unknowns import Unknowns
from counterspin.inference.noise.model import ESTIMATE, Noise
from counterspin.physics.spindle import Ripple, Spindle, fit_spindle

TRUTH = {"K_F": 5e-3, "K_I": 1.002, "K_II": 2e-5, "K_III": 3e-6}
MODEL = Unknowns(make_unknowns(TRUTH))
TRUE = np.array([TRUTH[u.symbol] - u.nominal for u in MODEL.unknowns])
WHITE = {"displacement": 1e-3, "velocity": 1e-3, "specific_force": 1e-4}
ENCODER = 1e-6  # rad


@pytest.fixture(scope="module")
def noise_free_series():
    """Return noise-free records sampled at their time stamps."""
    return {
        observable: [
            simulate_series(f"run{i}", rate, TRUTH, observable=observable, revolutions=25)
            for i, rate in enumerate(RATES)
        ]
        for observable in WHITE
    }


def add_time_jitter(series, timing, rng, *, encoder_noise=ENCODER, stated=(0.0, 0.0)):
    """Return the series with time-stamp errors relative to the sampling times."""
    drawn = []
    for record in series:
        rate, times = record.trajectory.spindle.rate, record.time
        white = add_noise(record, Noise(WHITE[record.observable]), rng)
        output = record.reference() + white.error
        stamps = times + timing * rng.standard_normal(times.size)
        turned = record.trajectory.spindle.angle(times)
        angle = turned + encoder_noise * rng.standard_normal(times.size)
        fit = fit_spindle(stamps, angle, rate)
        delay = fit.residuals / fit.spindle.angular_rate(stamps)
        known = (stated[0], stated[1] / rate)
        late = replace(
            record,
            time=stamps,
            trajectory=replace(record.trajectory, spindle=fit.spindle),
            angle_error=fit.error,
            timestamp_errors=TimestampErrors(
                delay, fit.rms / rate, fit.dof, np.zeros(delay.size), *known
            ),
        )
        late = replace(late, error=output - late.reference()).with_timestamp_noise(stated[0])
        drawn.append(late.correct_times(late.timestamp_errors.prior[0]))
    return drawn


def z_scores(estimation):
    solution = estimation.fit.solution
    return ((solution.estimate[:4] - TRUE) / solution.u[:4]).tolist()


@pytest.mark.slow
@pytest.mark.parametrize("stated", [True, False], ids=["stated", "found"])
@pytest.mark.parametrize(
    ("observable", "timing"), [*((observable, 1e-3) for observable in WHITE), ("velocity", 2e-5)]
)
def test_u_matches_scatter(noise_free_series, observable, timing, stated):
    white = WHITE[observable]
    request = {"Qx": Noise(white if stated else ESTIMATE, 0.0)}
    rng, trials, z = np.random.default_rng(1), 5, []
    for _ in range(trials):
        stated_noise = (timing if stated else 0.0, 0.0)
        estimation = estimate(
            add_time_jitter(noise_free_series[observable], timing, rng, stated=stated_noise),
            MODEL,
            request,
        )
        z += z_scores(estimation)
        solution = estimation.fit.solution
        assert solution.chi2 / solution.dof == pytest.approx(1.0, abs=5 * math.sqrt(2 / 2400))
    # K_F and K_II are correlated, hence half as many independent ones.
    assert np.mean(np.square(z)) == pytest.approx(1.0, abs=4.0 * math.sqrt(2.0 / (2 * trials)))


def test_few_samples_per_revolution_are_sufficient():
    """With eight of them the eighth harmonic at the time stamps is nothing but their errors."""
    noise_free_series = [
        simulate_series(
            f"run{i}", w, TRUTH, observable="specific_force", per_revolution=8, revolutions=20
        )
        for i, w in enumerate(RATES)
    ]
    for seed in range(3):
        drawn = add_time_jitter(noise_free_series, 2e-4, np.random.default_rng(seed))
        estimation = estimate(drawn, MODEL, {"Qx": Noise(WHITE["specific_force"])})
        assert min(record.corrected_fraction for record in estimation.series) > 0.99
        assert np.abs(z_scores(estimation)).max() < 4.0


def test_recorded_angle_corrects_time_stamps(noise_free_series):
    """Treating the delays of output and angle as independent would lose this information."""
    drawn = add_time_jitter(
        noise_free_series["specific_force"], 2e-4, np.random.default_rng(2), stated=(2e-4, 0.0)
    )
    request = {"Qx": Noise(WHITE["specific_force"])}
    alone = [replace(record.correct_times(0.0), timestamp_errors=None) for record in drawn]
    apart = estimate(alone, MODEL, request).fit.solution.u[2]
    assert apart > 50.0 * estimate(drawn, MODEL, request).fit.solution.u[2]


@pytest.mark.parametrize("stated", [(0.0, 0.0), (2e-4, 0.0), (2e-4, 4e-4)])
def test_encoder_noise_is_separated_from_time_stamp_noise(noise_free_series, stated):
    """Their shares are s^2 w^2 to s_a^2, and u of the outcome is right."""
    timing, noise = 2e-4, 4e-4
    drawn = add_time_jitter(
        noise_free_series["velocity"],
        timing,
        np.random.default_rng(3),
        encoder_noise=noise,
        stated=stated,
    )
    estimation = estimate(drawn, MODEL, {"Qx": Noise(WHITE["velocity"])})
    for record, rate in zip(estimation.series, RATES, strict=True):
        share = (timing * rate) ** 2 / ((timing * rate) ** 2 + noise**2)
        assert record.corrected_fraction == pytest.approx(share, abs=0.12)
        assert record.timestamp_sd == pytest.approx(noise / rate * math.sqrt(share), rel=0.2)
    assert np.abs(z_scores(estimation)).max() < 4.0


@pytest.mark.parametrize("observable", WHITE)
def test_accurate_time_stamps_are_not_corrected(noise_free_series, observable):
    rng = np.random.default_rng(4)
    for _ in range(5):
        drawn = add_time_jitter(noise_free_series[observable], 0.0, rng, encoder_noise=1e-5)
        estimation = estimate(drawn, MODEL, {"Qx": Noise(ESTIMATE, 0.0)})
        assert all(record is other for record, other in zip(estimation.series, drawn, strict=True))


@pytest.mark.parametrize("observable", WHITE)
def test_angle_column_at_corrected_times_matches_differences(noise_free_series, observable):
    """Angles that are off by a wave of their own: by differences of what is left of the output."""
    noisy_one = add_time_jitter(noise_free_series[observable], 0.0, np.random.default_rng(5))[1]
    error, step, symbol = noisy_one.angle_error, 1e-3, "encoder.ripple2.cos"
    unit = np.sqrt(np.sum(error.root**2, axis=1))
    one = replace(
        noise_free_series[observable][1],
        angle_error=replace(error, root=np.diag(unit)),
        timestamp_errors=noisy_one.timestamp_errors,
    )
    known = {s: value - (s == "K_I") for s, value in TRUTH.items() if s != "K_F"}
    share = 0.7
    stamps = replace(one.timestamp_errors, delay=np.zeros(one.time.size), fraction=share)
    plain = encoder.columns(replace(one, timestamp_errors=None), [symbol], known)[:, 0]
    column = encoder.columns(replace(one, timestamp_errors=stamps), [symbol], known)[:, 0]
    place = 3 + 2 * error.harmonics.index(2)
    wave = unit[place] * error.functions(one.time)[0][:, place]
    # True angles ahead by the wave are recorded so; of their delay a share is taken for time.
    delay = step * wave / one.trajectory.spindle.angular_rate(one.time)
    output = one.reference() + one.error
    later = replace(one, time=one.time + share * delay)
    moved = np.interp(later.time, one.time, one.error) + later.reference()
    np.testing.assert_allclose(
        (plain - column)[2:-2],
        ((moved - output) / step)[2:-2],
        atol=2e-3 * np.abs(plain - column).max(),
    )


@pytest.mark.parametrize("observable", WHITE)
@pytest.mark.parametrize("symbol", ["encoder.rate", "encoder.ripple1.cos"])
def test_columns_match_advanced_rotation(noise_free_series, observable, symbol):
    """At 1 ms, K_III's third harmonic at wrong times looked like a rate: by differences."""
    drawn = add_time_jitter(noise_free_series[observable], 1e-3, np.random.default_rng(6))[
        2
    ].correct_times(1.0)
    known = {s: value - (s == "K_I") for s, value in TRUTH.items()}
    values, step = np.array([*known.values()]), 0.1

    def left(series):
        return series.error - series.columns([*known], 1.0) @ values

    place = encoder.SYMBOLS.index(symbol)
    ahead, behind = (drawn.add_angle(s * drawn.angle_error.root[:, place]) for s in (step, -step))
    column = encoder.columns(drawn, [symbol], known)[:, 0]
    difference = (left(behind) - left(ahead)) / (2.0 * step)
    # The start errors of the record, which each fit removes, change too.
    start = drawn.polynomials(drawn.order)
    column, difference = (
        one - start @ np.linalg.lstsq(start, one, rcond=None)[0] for one in (column, difference)
    )
    # The Coriolis part of an integrated column is left out.
    tolerance = 2e-4 if observable == "specific_force" else 5e-3
    np.testing.assert_allclose(difference, column, atol=tolerance * np.abs(column).max())


@pytest.mark.parametrize("observable", WHITE)
@pytest.mark.parametrize("share", [0.0, 0.6, 1.0])
def test_second_order_bound_holds(noise_free_series, observable, share):
    rng = np.random.default_rng(7)
    for drawn in add_time_jitter(noise_free_series[observable], 1e-3, rng):
        times = drawn.correct_times(share)
        error, largest = times.angle_error, 0.0
        for _ in range(20):
            sds = np.clip(rng.standard_normal(error.deviation.size), -1.7, 1.7)
            step = np.linalg.norm(error.root, axis=1) * sds
            second = times.add_angle(step).error + times.add_angle(-step).error - 2.0 * times.error
            largest = max(largest, float(np.abs(0.5 * second).max()))
        assert 0.0 < largest < second_order_bound(times)


def test_ripples_hidden_by_jitter_are_followed_to_second_order():
    """Four ripples of 6e-4 rad: the square of their rates is ten times the noise of a row."""
    hidden = [tuple(Ripple(n, 6e-4 * n * w, 0.7 * n) for n in (1, 2, 3, 4)) for w in RATES]
    ripples = [Spindle(w, ripples=one) for w, one in zip(RATES, hidden, strict=True)]
    noise_free_series = [
        simulate_series(
            f"run{i}",
            ripple.rate,
            TRUTH,
            observable="specific_force",
            revolutions=25,
            spindle=ripple,
        )
        for i, ripple in enumerate(ripples)
    ]
    z = []
    for seed in range(3):
        drawn = add_time_jitter(noise_free_series, 1e-3, np.random.default_rng(seed))
        assert len(drawn[2].trajectory.spindle.ripples) < 4
        z.append(z_scores(estimate(drawn, MODEL, {"Qx": Noise(WHITE["specific_force"])})))
    assert np.abs(z).max() < 4.0


@pytest.mark.parametrize("timing", [2e-4, 1e-3])
def test_dense_fit_with_time_of_each_row_agrees(noise_free_series, timing):
    """Of the noise of the angle the package has an estimate, of 785 degrees of freedom."""
    rng = np.random.default_rng(9)
    drawn = add_time_jitter(
        noise_free_series["specific_force"], timing, rng, stated=(timing, ENCODER)
    )
    runs = []
    for record in drawn:
        stamped = record.time - record.corrected_fraction * record.timestamp_errors.delay
        turned = record.trajectory.spindle.angle(stamped + record.timestamp_errors.delay)
        runs.append(Records(stamped, turned, record.error + record.reference()))
    machine = Machine(2.5, SITE.gravity, SITE.latitude)
    white = WHITE["specific_force"]
    value, u = fit_rows(runs, machine, timing, ENCODER, white)
    solution = estimate(drawn, MODEL, {"Qx": Noise(white)}).fit.solution
    np.testing.assert_allclose(solution.u[:4], u, rtol=0.06)
    assert np.abs((solution.estimate[:4] - (value - [0, 1, 0, 0])) / u).max() < 0.15


def test_small_angle_errors_need_no_additional_rotation(noise_free_series, monkeypatch):
    """The bound says so beforehand: no rotation is tried."""
    monkeypatch.setattr(rotation, "rotate_to_estimate", None)
    drawn = add_time_jitter(noise_free_series["specific_force"], 0.0, np.random.default_rng(8))
    estimation = estimate(drawn, MODEL, {"Qx": Noise(WHITE["specific_force"])})
    assert any(unknown.symbol in encoder.SYMBOLS for unknown in estimation.fit.model.unknowns)

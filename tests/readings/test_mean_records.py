"""Arm runs whose recorded angle identifies the rotation, against records from first principles."""

import math
import tomllib

import numpy as np
import pytest
from arm_records import (
    DESCRIPTION_HEAD,
    GRAVITY,
    RADIUS,
    TRUTH,
    format_arm_run,
    simulate_arm_record,
)
from raising import raises

import counterspin as cs
from counterspin.readings.mean_records import average_record

LEVELS = (1.0, 4.0, 6.0, 9.0, 15.0)
STEADY = {"ripple": 0.0, "drift": 0.0}


def make_arm_campaign(
    seed, off, *, head=DESCRIPTION_HEAD, sense=1, ripple=1e-4, drift=2e-5, noise=1e-4, encoder=1e-5
):
    """Return a campaign whose spindle turns `off` faster than stated, relative to the rate."""
    rng = np.random.default_rng(seed)
    text, records = head, {}
    for side in (1, -1):
        for level in LEVELS:
            stated = math.sqrt(level * GRAVITY / RADIUS)
            name = f"{'in' if side > 0 else 'out'} {level:.0f}"
            text += format_arm_run(name, side, sense * stated)
            records[name] = simulate_arm_record(
                rng,
                side,
                sense * stated * (1.0 + off),
                drift=rng.choice([-1.0, 1.0]) * drift,
                ripple=ripple,
                harmonic=int(rng.integers(1, 4)),
                noise=noise,
                encoder=encoder,
            )
    return cs.make_campaign(tomllib.loads(text), records)


def coefficient_errors(result):
    coefficients = {symbol: result.coefficient(f"A.{symbol}") for symbol in TRUTH}
    return {symbol: (c.value - TRUTH[symbol], c.u) for symbol, c in coefficients.items()}


@pytest.mark.parametrize("off", [1e-2, -1e-3])
@pytest.mark.parametrize("sense", [1, -1])
def test_coefficients_follow_recorded_angle(off, sense):
    """Without noise: what remains is the second moment of w^2, 2 ripple^2 of K_II a^2."""
    result = cs.calibrate(make_arm_campaign(1, off, sense=sense, noise=1e-9, encoder=0.0))
    assert abs(coefficient_errors(result)["K_I"][0]) < 1e-9
    assert abs(coefficient_errors(result)["K_II"][0]) < 1e-11
    assert abs(coefficient_errors(result)["K_III"][0]) < 1e-11


def test_u_covers_noise_ripple_and_drift():
    """In 20 campaigns; u of means allows for a wander of the level: up to 1.5 times too large."""
    trials = 20
    results = [cs.calibrate(make_arm_campaign(seed, 1e-2)) for seed in range(trials)]
    z = np.array(
        [[error / u for error, u in coefficient_errors(result).values()] for result in results]
    )
    assert np.abs(z[:, 1]).max() < 3.0
    rms = np.sqrt(np.mean(z**2, axis=0))
    assert (rms < 1.0 + 3.0 / math.sqrt(2.0 * trials)).all()
    assert (rms > 1.0 / 1.9 - 3.0 / math.sqrt(2.0 * trials) / 1.9).all()
    assert all(result.state == "reservations" for result in results)
    assert {finding.code for result in results for finding in result.findings} == {"time-base"}


def test_rates_and_means_scatter_by_their_noise():
    """In 20 campaigns with the u of white noise in place of that which allows for a wander."""
    trials, z = 20, []
    head = DESCRIPTION_HEAD.replace('specific_force = { column = "f", unit = "g" }\n', "")
    records = head.index("[records]"), head.index("[accelerometers")
    for seed in range(trials):
        arm_campaign, text = make_arm_campaign(seed, 1e-2), head[: records[0]] + head[records[1] :]
        for reading in arm_campaign.readings:
            averaged = average_record(arm_campaign, reading)
            value, u = averaged.reading.value, 1e-4 / math.sqrt(averaged.mean.samples)
            side = 1 if reading.name.startswith("in") else -1
            calibrate_with_clock = format_arm_run(
                reading.name, side, averaged.reading.measured_rate.value
            )
            of_record = f'record = "{reading.name}.csv"'
            text += calibrate_with_clock.replace(of_record, f'reading = "{value!r} ± {u!r} g"')
        result = cs.calibrate(cs.make_campaign(tomllib.loads(text)))
        z.append([error / u for error, u in coefficient_errors(result).values()])
    squares = np.mean(np.square(z), axis=0)
    assert (np.abs(squares - 1.0) < 3.5 * math.sqrt(2.0 / trials)).all()


def test_deviating_rate_is_named():
    arm_campaign = make_arm_campaign(2, 0.0)
    result = cs.calibrate(with_stated_rate(arm_campaign, "9.3 rad/s"))
    (finding,) = result.findings
    rate = math.sqrt(9.0 * GRAVITY / RADIUS)
    assert finding.code == "other-rate"
    (measured,) = (r.rate for r in calibrated_readings(result) if r.name == "in 9")
    assert finding.text == (
        f"in 9: the spindle turned at {measured:.6f} rad/s instead of the nominal 9.300000 rad/s. "
        "The fit uses the recorded angle."
    )
    assert measured == pytest.approx(rate, rel=1e-3)
    assert cs.calibrate(arm_campaign).state == "good"


def with_stated_rate(campaign, rate):
    """Return the campaign with another stated rate of the run "in 9"."""
    runs = campaign.source.document["runs"]
    return campaign.change(
        {
            "runs": [
                calibrate_with_clock | {"rate": rate}
                if calibrate_with_clock["name"] == "in 9"
                else calibrate_with_clock
                for calibrate_with_clock in runs
            ]
        }
    )


def calibrated_readings(result):
    return result.accelerometers["A"].readings


def test_opposite_sense_raises():
    one = with_stated_rate(make_arm_campaign(3, 0.0), "-9.39 rad/s")
    with raises("rate-mismatch", "opposite sense"):
        cs.calibrate(one)


def test_rate_is_rms_over_whole_revolutions():
    """Closed form of w(t)^2 at the rows, with a drift of 0.3 % and a ripple of 1 %."""
    record = simulate_arm_record(
        np.random.default_rng(4), 1, 6.0, ripple=1e-2, drift=1e-4, noise=1e-6
    )
    text = DESCRIPTION_HEAD.replace(', "K_II", "K_III"', "").replace(
        '"K_F", ', ""
    ) + format_arm_run("r", 1, 6.03)
    (reading,) = calibrated_readings(
        cs.calibrate(cs.make_campaign(tomllib.loads(text), {"r": record}))
    )
    angle = np.unwrap(np.radians(-record["angle"]))
    turned = angle - angle[0]
    whole = turned < 2.0 * math.pi * math.floor(turned[-1] / (2.0 * math.pi))
    # w by central differences: exact to the square of the step, 2e-4 of the ripple.
    w = np.gradient(angle, record["t"])[whole]
    assert reading.rate == pytest.approx(math.sqrt(np.mean(w[1:] ** 2)), rel=2e-6)
    assert reading.rate > np.mean(w[1:]) * (1.0 + 2e-5)


def test_recorder_clock_affects_rates_from_angle():
    """A clock that runs fast by 20 ppm: K_I is 40 ppm high, which u of the clock covers.

    The Coriolis part, which is linear in the rate, tells 1 % of that from K_I.
    """
    fast = 1.0 + 20e-6

    def calibrate_with_clock(head):
        arm_campaign = make_arm_campaign(5, 0.0, head=head, noise=1e-6, **STEADY)
        frames = {
            name: {**f, "t": f["t"] * fast} for name, f in record_columns(arm_campaign).items()
        }
        return cs.calibrate(arm_campaign.change({}, records=frames))

    for clock, missing, u_clock in (("0 ± 20 ppm", 20e-6, 20e-6), ("20 ± 1 ppm", 0.0, 1e-6)):
        stated = DESCRIPTION_HEAD.replace("[records]", f'[records]\nclock = "{clock}"')
        error, u = coefficient_errors(calibrate_with_clock(stated))["K_I"]
        assert error == pytest.approx(2.0 * missing, abs=1e-6)
        assert u == pytest.approx(2.0 * u_clock, rel=1e-2)
    result = calibrate_with_clock(DESCRIPTION_HEAD.replace('assume = "all"\n', ""))
    assert {row.name: row.u for row in result.rests_on}["records.clock"] == 2e-5
    assert abs(coefficient_errors(result)["K_I"][0]) < 3.0 * coefficient_errors(result)["K_I"][1]


def record_columns(campaign):
    return {r.name: campaign.record_at(r.record).columns for r in campaign.readings}


def test_stated_rate_is_used_without_angle_column():
    arm_campaign = make_arm_campaign(6, 0.0, **STEADY)
    frames = {
        name: {c: f[c] for c in ("t", "f")} for name, f in record_columns(arm_campaign).items()
    }
    result = cs.calibrate(arm_campaign.change({}, records=frames))
    (warning,) = [text for text in result.warnings if "no angle" in text]
    assert warning.startswith("The records of in 1, in 4, in 6, in 9, in 15, out 1")
    assert calibrated_readings(result)[0].rate == math.sqrt(GRAVITY / RADIUS)
    assert abs(coefficient_errors(result)["K_I"][0]) < 3.0 * coefficient_errors(result)["K_I"][1]


def make_campaign_partly_without_angle(seed, by_recorder, by_counter, head):
    """Return a campaign in which every second record has no angle.

    by_recorder, by_counter: True relative errors of the clocks behind recorded angles and behind
        the stated rates of records without angle.
    """
    every = make_arm_campaign(seed, by_counter, head=head, **STEADY)
    frames = record_columns(every)
    for position, name in enumerate(frames):
        frame = {**frames[name], "t": frames[name]["t"] * (1.0 + by_recorder)}
        frames[name] = {c: frame[c] for c in ("t", "f")} if position % 2 else frame
    return every.change({}, records=frames)


def describe_clocks(recorder, counter):
    """Return the description with the clocks stated, and all else assumed perfect."""
    head = DESCRIPTION_HEAD.replace("[records]", f'[records]\nclock = "0 ± {recorder}"')
    return head.replace("[centrifuge]", f'[centrifuge]\nclock = "0 ± {counter}"')


@pytest.mark.parametrize(
    ("by_recorder", "by_counter", "head", "largest_u"),
    [
        (0.0, 2e-5, DESCRIPTION_HEAD.replace('assume = "all"\n', ""), 1e-3),
        (0.0, 2e-5, describe_clocks("1e-9", "2e-5"), 3e-6),
        (2e-5, 0.0, describe_clocks("2e-5", "1e-9"), 3e-6),
    ],
)
def test_records_with_and_without_angle_have_separate_clocks(
    by_recorder, by_counter, head, largest_u
):
    """The recorder's clock acts on identified rates, that of the rate counter on stated ones."""
    for seed in range(3):
        result = cs.calibrate(
            make_campaign_partly_without_angle(seed, by_recorder, by_counter, head)
        )
        error, u = coefficient_errors(result)["K_I"]
        assert abs(error) < 3.0 * u < 3.0 * largest_u
        assert {"records.clock", "centrifuge.clock"} <= {row.name for row in result.rests_on}
        assert result.state != "contradicted"


SIMULATED = """[simulation]
sampling_rate = "50 Hz"
revolutions = 30
[truth.A]
K_F = "2e-3 g"
K_I = "1.0006 g/g"
K_II = "1.5e-5 g/g^2"
K_III = "1e-6 g/g^3"
[truth.spindle]
rate_error = 0.01
drift = "1e-5 1/s"
ripple = [{ ratio = 1e-4 }]
[truth.records]
clock = "20 ppm"
[truth.noise]
specific_force = "1e-5 m/s^2"
angle = "1e-5 rad"
"""


def test_simulated_records_return_true_coefficients():
    """At another rate than the stated one, with a clock that is known to be fast."""
    text = DESCRIPTION_HEAD.replace("[records]", '[records]\nclock = "20 ± 1e-3 ppm"') + SIMULATED
    for side in (1, -1):
        for level in LEVELS:
            rate = math.sqrt(level * GRAVITY / RADIUS)
            text += format_arm_run(f"{'in' if side > 0 else 'out'} {level:.0f}", side, rate)
    result = cs.calibrate(cs.simulate(cs.make_campaign(tomllib.loads(text))))
    assert all(abs(error) < 4.0 * u for error, u in coefficient_errors(result).values())
    assert coefficient_errors(result)["K_I"][1] < 1e-6
    assert {finding.code for finding in result.findings} == {"time-base"}


def test_settling_records_at_rest_are_not_called_stated():
    rng, time = np.random.default_rng(4), np.arange(0.0, 60.0, 0.02)
    runs, records = [], {}
    for k in range(12):
        direction = ("up", "down")[k % 2]
        axes = {"input": direction, "pendulous": "east"}
        runs.append({"name": f"r{k}", "motion": "static", "axes": axes})
        level = 2e-3 + (1.0 if direction == "up" else -1.0)
        noise = 2e-5 * rng.standard_normal(time.size)
        records[f"r{k}"] = {"t": time, "f": level + 2e-3 * np.exp(-time / 5.0) + noise}
    description = {
        "site": {"gravity": "9.8066 m/s^2", "latitude": "45.75 deg"},
        "records": {"time": {"column": "t", "unit": "s"}},
        "accelerometers": {
            "A": {
                "input_axis": "up",
                "pendulous_axis": "east",
                "specific_force": {"column": "f", "unit": "g"},
            }
        },
        "model": {"terms": ["K_F", "K_I"], "assume": "all"},
        "runs": runs,
    }
    result = cs.calibrate(cs.make_campaign(description, records))
    (remark,) = (text for text in result.warnings if "scatter by" in text)
    assert "times the uncertainty computed from the records, 3" in remark
    assert "omit that part with `start` or `stop`" in remark
    assert "stated" not in remark

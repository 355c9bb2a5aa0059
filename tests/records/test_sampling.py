"""Samples of a sensor in the rows of a log."""

import numpy as np
import pytest

from counterspin.inference.noise.samples import SensorSamples
from counterspin.records.sampling import ValueHolding, estimate_row_rate, is_bursty, join_bursts

STEP = 0.01


def white_noise(n, seed=1):
    return 9.8 + 1e-3 * np.random.default_rng(seed).standard_normal(n)


def repeat_samples(values, ratio):
    """Return the log with `ratio` rows per sample."""
    rows = np.arange(int(len(values) * ratio))
    return values[np.minimum((rows / ratio).astype(int), len(values) - 1)]


@pytest.mark.parametrize("ratio", [1.25, 2.0, 2.5, 4.0, 7.3])
def test_samples_behind_repeated_values_are_found(ratio):
    values = white_noise(2000)
    logged = repeat_samples(values, ratio)
    samples = SensorSamples.from_rows(np.arange(len(logged)) * STEP, logged)
    assert np.array_equal(samples.values, values[: len(samples.values)])
    assert len(samples.values) >= 1999
    assert samples.repeated == len(logged) - len(samples.values)
    steps = np.diff(samples.time)
    assert steps.max() - steps.min() < 1e-9
    assert steps.mean() == pytest.approx(ratio * STEP, rel=2e-3)


@pytest.mark.parametrize("resolution", [0.0, 1e-4, 1e-3, 4e-3])
def test_equal_samples_by_chance_are_not_repeats(resolution):
    values = white_noise(4000)
    if resolution:
        values = np.round(values / resolution) * resolution
    assert ValueHolding.detect(values) is None


def test_coarse_sensor_in_faster_log_is_thinned_or_raises():
    values = np.round(white_noise(4000) / 1e-3) * 1e-3
    samples = SensorSamples.from_rows(np.arange(12000) * STEP, repeat_samples(values, 3.0))
    assert np.array_equal(samples.values, values)
    with pytest.raises(ValueError, match="too coarse to tell"):
        SensorSamples.from_rows(np.arange(10000) * STEP, repeat_samples(values, 2.5))


@pytest.mark.parametrize("burst", [2, 3, 8])
def test_rows_with_repeated_time_stamps_are_counted(burst):
    """All samples of a packet have the time stamp of the packet."""
    values, row = white_noise(4001), np.arange(4001)
    samples = SensorSamples.from_rows(np.floor(row / burst) * burst * STEP, values)
    assert samples.restamped > 0.4 * 4001
    assert np.array_equal(samples.values, values)
    assert np.diff(samples.time) == pytest.approx(STEP, rel=1e-2)


def test_lost_or_equal_samples_leave_gaps_in_time():
    values = white_noise(2000)
    values[[300, 301, 900]] = values[[299, 299, 899]]
    for ratio in (1.25, 2.5, 7.3):
        logged = repeat_samples(values, ratio)
        samples = SensorSamples.from_rows(np.arange(len(logged)) * STEP, logged)
        steps = np.diff(samples.time) / (ratio * STEP)
        assert np.round(steps).tolist() == [
            3.0 if n == 299 else 2.0 if n == 897 else 1.0 for n in range(len(steps))
        ]
        assert steps.sum() == pytest.approx(1999, abs=2)


@pytest.mark.parametrize("step", [0.0, 2e-4])
@pytest.mark.parametrize("lost", [0, 20])
def test_rows_of_packet_bursts_are_counted(step, lost):
    """Packets of 8 rows with equal or close time stamps arrive up to one row late."""
    rng = np.random.default_rng(5)
    packet, row = np.divmod(np.arange(8000), 8)
    stamps = (8 * packet + rng.random(1000)[packet]) * STEP + row * step
    keep = ~np.isin(packet, rng.choice(np.arange(1, 999), lost, replace=False))
    values = np.round(white_noise(8000) / 1e-3) * 1e-3  # equal neighbours are no doubled rows
    samples = SensorSamples.from_rows(stamps[keep], values[keep])
    assert np.array_equal(samples.values, values[keep])
    assert np.median(np.diff(samples.time)) == pytest.approx(STEP, rel=2e-3)
    if lost:
        with pytest.raises(ValueError, match="samples are missing"):
            estimate_row_rate(stamps[keep])
    else:
        assert estimate_row_rate(stamps) == pytest.approx(1.0 / STEP, rel=2e-4)


def test_pauses_are_not_bursts():
    time = np.arange(10000) * STEP + 60.0 * (np.arange(10000) // 2000)
    assert not is_bursty(np.diff(time))
    assert join_bursts(time) is time


def test_gap_is_preserved_with_coarse_clock():
    """Rows at 1666 Hz are stamped in whole milliseconds; one second is missing."""
    row = np.arange(20000)
    time = np.floor(row / 1.666) * 1e-3
    keep = (row < 9000) | (row > 10666)
    samples = SensorSamples.from_rows(time[keep], white_noise(20000)[keep])
    steps = np.diff(samples.time)
    assert np.sum(steps > 0.5) == 1
    assert np.median(steps) == pytest.approx(1e-3 / 1.666, rel=1e-3)


def test_repeated_stamps_with_lost_samples_raise():
    row = np.arange(20000)
    keep = np.random.default_rng(3).random(20000) > 0.2
    time = np.floor(row / 2) * 2 * STEP
    with pytest.raises(ValueError, match="cannot be calculated from the row count"):
        SensorSamples.from_rows(time[keep], white_noise(20000)[keep])


@pytest.mark.parametrize("ratio", [1.7, 2.0, 2.5, 4.0])
def test_rate_of_repeated_samples_tolerates_lost_rows(ratio):
    """Lost rows delay the first row of a sample without changing the sensor rate."""
    logged = repeat_samples(white_noise(3000), ratio)
    keep = np.random.default_rng(4).random(len(logged)) > 0.2
    samples = SensorSamples.from_rows((np.arange(len(logged)) * STEP)[keep], logged[keep])
    assert np.median(np.diff(samples.time)) == pytest.approx(ratio * STEP, rel=6e-3)


@pytest.mark.parametrize("part", [0.0, 0.05, 0.2])
@pytest.mark.parametrize("step", [STEP, 0.1 * STEP])
def test_lost_rows_with_stamps_in_seconds_raise(part, step):
    row = np.arange(20000)
    keep = np.random.default_rng(6).random(20000) >= part
    time, values = np.floor(row * step + 1e-9)[keep], white_noise(20000)[keep]
    if part:
        with pytest.raises(ValueError, match="samples are missing"):
            SensorSamples.from_rows(time, values)
    else:
        assert np.median(np.diff(SensorSamples.from_rows(time, values).time)) == pytest.approx(step)


def test_late_rows_are_not_lost():
    """A clock with a resolution of 1 s stamps rows up to 0.3 s late."""
    late = np.random.default_rng(7).uniform(0.0, 0.3, 12000)
    time = np.floor(np.maximum.accumulate(np.arange(12000) * STEP + late))
    samples = SensorSamples.from_rows(time, white_noise(12000))
    assert np.median(np.diff(samples.time)) == pytest.approx(STEP, rel=0.3 / 120.0)


@pytest.mark.parametrize("mean_delay", [0.2, 1.0])
@pytest.mark.parametrize("lost", [0.0, 0.05])
def test_packets_with_exponential_delays_determine_rate(mean_delay, lost):
    """Packets of 10 rows arrive in their order, late by so many packets in the mean.

    The two rows that give the rate are 1330 rows apart or more. The first and the last third have
    133 packets each, whose least delay is below 0.1 packet with a probability above 1 - 2e-3.
    """
    refused, errors = 0, []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        arrival = np.maximum.accumulate(np.arange(400) + rng.exponential(mean_delay, 400))
        time = 10 * STEP * np.repeat(arrival[rng.random(400) >= lost], 10)
        try:
            steps = np.diff(SensorSamples.from_rows(time, white_noise(time.size)).time)
        except ValueError:
            refused += 1
            continue
        errors.append(np.median(steps) / STEP - 1.0)
        assert np.sum(steps > 1.5 * np.median(steps)) <= 1
    assert refused >= 17 if lost else refused <= 3
    assert lost or np.abs(errors).max() < 10.0 * 0.1 / 1330


def test_duplicate_rows_count_once():
    repeated_result = np.repeat(np.arange(500), 2)
    samples = SensorSamples.from_rows(repeated_result * STEP, white_noise(500)[repeated_result])
    assert (len(samples.values), samples.repeated, samples.restamped) == (500, 0, 0)

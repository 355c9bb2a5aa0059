"""The frequency response of records, against the differential equation of the sensor."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import integrate

from counterspin.physics import observation
from counterspin.physics.accelerometer import QX
from counterspin.physics.frequency_response import FrequencyResponse, ResponseTable
from counterspin.physics.motion import Site, Trajectory
from counterspin.physics.simulation import simulate_record
from counterspin.physics.spindle import Ripple, Spindle

G, RADIUS, RATE = 9.8, 2.5, math.pi
DRIFT, RIPPLE, PHASE = 1e-5, 1e-4, 0.7
COEFFICIENTS = {"K_F": 5e-3, "K_I": 1.002, "K_II": 3e-3, "K_III": 2e-3, "K_5": 1e-3, "K_OO": 1e-3}
SITE = Site(gravity=G, latitude=math.radians(45.0))
TRAJECTORY = Trajectory(Spindle(RATE, DRIFT, (Ripple(1, RIPPLE * RATE, PHASE),)), RADIUS, SITE)


def static_output(t):
    """Return the indicated force of an accelerometer without dynamics, m/s^2, from Eq. 2 and 7."""
    angle = RATE * t + 0.5 * DRIFT * RATE * t**2
    angle -= RIPPLE * (math.cos(RATE * t + PHASE) - math.cos(PHASE))
    w = RATE * (1.0 + DRIFT * t + RIPPLE * math.sin(RATE * t + PHASE))
    dw = RATE * (DRIFT + RIPPLE * RATE * math.cos(RATE * t + PHASE))
    east, north = math.cos(angle), math.sin(angle)
    omega_north, omega_up = (7.292115e-5 * part for part in (math.cos(math.pi / 4),) * 2)
    velocity = -RADIUS * w * north, RADIUS * w * east
    force = (
        -RADIUS * (w**2 * east + dw * north) - 2.0 * omega_up * velocity[1],
        -RADIUS * (w**2 * north - dw * east) + 2.0 * omega_up * velocity[0],
        G - 2.0 * omega_north * velocity[0],
    )
    i, o = force[0] / G, force[1] / G
    c = COEFFICIENTS
    output = c["K_F"] + c["K_I"] * i + c["K_II"] * i**2 + c["K_III"] * i**3 + c["K_5"] * i**5
    return G * (output + c["K_OO"] * o**2)


def integrate_second_order_sensor(natural_frequency, damping, times):
    """Integrate y'' + 2 zeta w0 y' + w0^2 y = w0^2 u from rest, long before the first time."""
    w0 = 2.0 * math.pi * natural_frequency

    def slope(t, state):
        y, v = state
        return v, w0**2 * (static_output(t) - y) - 2.0 * damping * w0 * v

    start = times[0] - 30.0 / (damping * w0)
    result = integrate.solve_ivp(
        slope,
        (start, times[-1]),
        (static_output(start), 0.0),
        method="DOP853",
        t_eval=times,
        rtol=1e-11,
        atol=1e-11,
    )
    return result.y[0]


def test_second_order_sensor_obeys_differential_equation():
    natural_frequency, damping = 50.0, 0.5
    times = np.linspace(5.0, 5.6, 13)
    mounting = replace(QX, response=FrequencyResponse(natural_frequency, damping))
    record = simulate_record(
        TRAJECTORY, mounting, COEFFICIENTS, {}, times, observable="specific_force"
    )
    expected = integrate_second_order_sensor(natural_frequency, damping, times)
    assert np.abs(expected - [static_output(t) for t in times]).max() > 0.1
    assert np.abs(record - expected).max() < 1e-9 * RADIUS * RATE**2


RESPONSE = FrequencyResponse(400.0, 0.7, cutoff_frequency=80.0)
EVEN = Trajectory(Spindle(RATE), RADIUS, Site(gravity=G, latitude=0.0))
TIMES = np.arange(800) * 0.01  # four revolutions


def fit_harmonics(values, order):
    """Return the complex harmonics 0 to 3 of values of four revolutions, polynomials aside."""
    waves = np.exp(1j * RATE * np.outer(TIMES, np.arange(1, 4)))
    shape = np.column_stack([np.vander(TIMES, order + 1), waves.real, -waves.imag])
    fitted = np.linalg.lstsq(shape, values, rcond=None)[0]
    return fitted[order], fitted[order + 1 : order + 4] + 1j * fitted[order + 4 :]


@pytest.mark.parametrize("observable", ["specific_force", "velocity", "displacement"])
@pytest.mark.parametrize("symbol", ["K_I", "K_II", "K_III", "platform.compliance.zy"])
def test_column_harmonics_are_multiplied_by_gain(observable, symbol):
    """The factor is H(k w), whatever the observable, and the mean force keeps its value."""
    order = observation.ORDERS[observable]
    plain, filtered = (
        observation.columns(EVEN, mounting, [symbol], TIMES, observable)[:, 0]
        for mounting in (QX, replace(QX, response=RESPONSE))
    )
    (mean, before), (filtered_mean, after) = (
        fit_harmonics(values, order) for values in (plain, filtered)
    )
    gains = 1.0 / (1.0 - (ratio := np.arange(1, 4) * 0.5 / 400.0) ** 2 + 1.4j * ratio)
    gains /= 1.0 + 1j * np.arange(1, 4) * 0.5 / 80.0
    scale = np.abs(before).max()
    assert np.abs(after - gains * before).max() < 1e-9 * scale
    if order == 0:
        assert filtered_mean == pytest.approx(mean, abs=1e-9 * scale)
    elif symbol == "K_II":  # its parabola
        assert np.polyfit(TIMES, filtered, order)[0] == pytest.approx(
            np.polyfit(TIMES, plain, order)[0], rel=1e-3
        )


def test_recorder_but_not_sensor_filters_coriolis_acceleration():
    site = Site(gravity=G, latitude=math.radians(45.0))
    motion = replace(EVEN, site=site)
    plain = observation.reference(motion, QX, TIMES)
    sensed = observation.columns(motion, QX, ["K_I"], TIMES)[:, 0]
    position, force = (fit_harmonics(values, 2)[1][0] for values in (plain, sensed))
    for response in (FrequencyResponse(400.0, 0.7), FrequencyResponse(cutoff_frequency=80.0)):
        filtered = observation.reference(motion, replace(QX, response=response), TIMES)
        gain = response.gain(np.array([0.5]))[0]
        expected = position + (gain - 1.0) * (
            force if math.isfinite(response.natural_frequency) else position
        )
        assert abs(fit_harmonics(filtered, 2)[1][0] - expected) < 1e-9 * abs(position)
    assert abs(force - position) > 1e-6 * abs(position)


def test_gain_table_of_second_order_sensor_matches_formula():
    frequency = np.linspace(0.25, 20.0, 80)
    sensor = FrequencyResponse(400.0, 0.7)
    gain = sensor.gain(frequency)
    table = ResponseTable(
        tuple(frequency), tuple(np.abs(gain)), tuple(np.angle(gain)), tuple(1e-5 * frequency)
    )
    measured = FrequencyResponse(table=table)
    at = np.array([0.0, 0.5, 1.0, 3.3])
    assert np.abs(measured.gain(at) - sensor.gain(at)).max() < 1e-7
    by_table, by_formula = (
        observation.reference(EVEN, replace(QX, response=response), TIMES)
        for response in (measured, sensor)
    )
    assert np.abs(by_table - by_formula).max() < 1e-7 * RADIUS
    changed = measured.deviate("sensor.gain", 2.0)
    assert np.abs(changed.gain(at)) - np.abs(measured.gain(at)) == pytest.approx(2e-5 * at)


@pytest.mark.parametrize(
    "table",
    [
        ResponseTable((1.0, 10.0, 50.0), (1.0, 0.98, 0.7), (-0.01, -0.1, -0.8)),
        ResponseTable(
            (1.0, 2.5, 3.0, 3.5, 6.0), (1.0, 1.2, 8.0, 1.2, 0.1), (0.0, -0.2, -1.6, -3, -3)
        ),
    ],
    ids=["three rows", "resonance"],
)
def test_tabulated_gain_is_exact_at_harmonics(table):
    response, spindle, times = FrequencyResponse(table=table), Spindle(6.0), np.linspace(0, 3, 50)
    for harmonic in range(1, 9):
        shown = response.total_shifts(spindle.rate).apply(
            spindle, lambda turned, n=harmonic: np.cos(n * turned.angle(times))
        )
        (gain,) = response.gain(np.array([harmonic * spindle.rate / (2.0 * math.pi)]))
        wave = gain * np.exp(1j * harmonic * spindle.angle(times))
        np.testing.assert_allclose(shown, wave.real, rtol=0, atol=1e-12)

"""What would move K_II unseen: against considered terms, estimated terms and faulty records."""

import math
from dataclasses import replace

import numpy as np
import pytest

from counterspin.inference.joint.fit import solve_joint
from counterspin.physics.accelerometer import QX, QY
from counterspin.physics.motion import Trajectory
from counterspin.physics.observation import ORDERS
from counterspin.planning.design import Design, RunType
from counterspin.planning.faults import (
    fault_sensitivities,
    mean_square_fault,
    path_fault,
    possible_faults,
    square_term_fault,
)
from counterspin.planning.forecast import forecast
from counterspin.planning.plan import plan
from counterspin.planning.plan_file import read_plan
from counterspin.planning.search import Search
from counterspin.reports.text import make_console

SMALL = ('total_time = "700 s"', 'total_time = "240 s"')
FORCE = [
    ('displacement = "0.01 m"', 'specific_force = "1e-4 g"'),
    ("bias = ", 'specific_force = { column = "f", unit = "m/s^2" }\nbias = '),
]
VELOCITY = [
    ('displacement = "0.01 m"', 'velocity = "1e-3 m/s"'),
    ("bias = ", 'velocity = { column = "v", unit = "m/s" }\nbias = '),
]
LEVEL = RunType("level", 1)


@pytest.fixture
def predict(write_starter):
    """Return the forecast of three runs of the example plan, changed by pairs of text."""

    def made(*changes, rates=(2.0, 4.0, 6.0)):
        search = Search(read_plan(write_starter(*changes)))
        rate = np.array(rates)
        design = Design((LEVEL,) * rate.size, rate, np.full(rate.size, 30.3))
        return forecast(search.campaign(design))

    return made


ECCENTRICITY = path_fault("encoder.harmonic.1")
IMBALANCE = path_fault("centrifuge.imbalance.1")


def coefficient_index(prediction, name="Qx.K_II"):
    return [unknown.name for unknown in prediction.fit.model.unknowns].index(name)


def fault_of_symbol(prediction, symbol):
    """Return the effect of a fault with this symbol on the campaign."""
    responses = fault_sensitivities(prediction, possible_faults(prediction.campaign, "Qx"))
    return next(response for response in responses if response.fault.symbol == symbol)


def simulate_fault_signal(fault_of_symbol, series):
    """Return the signal of one unit of each component of a fault in a record."""
    return series.columns([part.symbol for part in fault_of_symbol.terms], 1.0)


# Against the model that knows them


@pytest.mark.parametrize(
    ("symbol", "size"),
    [("K_OO", "2e-6 g/g^2"), ("delta_O", "5e-5 rad"), ("platform.tilt.north", "0.5 arcsec")],
)
def test_shift_is_contribution_of_considered_term_to_u(symbol, size, predict):
    name = symbol.rpartition(".")[0] or symbol
    out = [('"platform.tilt", ', ""), ('"platform.tilt" = "0 ± 0.5 arcsec"', "")]
    known = f'[model.priors]\n"{name}" = "0 ± {size}"'
    named = ('# hold = ["K_PP"]  ', f'hold = ["{name}"]')
    held = [named, ("[model.priors]", known)]
    left_out = predict(*out)
    response = fault_of_symbol(left_out, symbol)
    solution = predict(*out, *held).fit.solution
    place = coefficient_index(left_out)
    added = math.sqrt(solution.u[place] ** 2 - left_out.fit.solution.u[place] ** 2)
    assert response.shift(place) == pytest.approx(added, rel=1e-6)


@pytest.mark.parametrize("symbol", ["K_OO", "K_IO"])
def test_deviation_matches_fit_that_estimates_fault(symbol, predict):
    left_out = predict(*VELOCITY)
    response = fault_of_symbol(left_out, symbol)
    estimated = predict(*VELOCITY, ('"K_III", ', f'"K_III", "{symbol}", '))
    u = estimated.u[f"Qx.{symbol}"]
    size = response.fault.typical_size
    assert response.z_score(coefficient_index(left_out)) == pytest.approx(size / u, rel=1e-6)


# Against records that have the fault


OBSERVABLES = {"displacement": [], "velocity": VELOCITY, "specific_force": FORCE}


@pytest.mark.parametrize("changes", OBSERVABLES.values(), ids=OBSERVABLES)
def test_shift_matches_fit_of_record_with_fault(changes, predict):
    prediction = predict(*changes)
    (response,) = fault_sensitivities(prediction, [ECCENTRICITY])
    place = coefficient_index(prediction)
    moved = response.shifts[place]
    phase = moved / np.linalg.norm(moved)
    prepared = []
    for part in prediction.fit.design_blocks:
        shown = simulate_fault_signal(ECCENTRICITY, part.series)
        error = ECCENTRICITY.typical_size * (shown @ phase)
        prepared.append(replace(part, series=replace(part.series, error=error)))
    fit = solve_joint(prepared, prediction.fit.model, prediction.fit.noise)
    estimate = float(fit.solution.estimate[place])
    assert estimate == pytest.approx(response.shift(place), rel=1e-6)
    # And what it leaves in the residuals is what the test of them will see.
    left = sum(float(residual.whitened @ residual.whitened) for residual in fit.residuals)
    seen = response.residual_ss(response.accelerometer_products["Qx"], place)
    assert left == pytest.approx(seen, rel=1e-4)


def derivatives(position, time, order):
    """Return a function's value, first or second derivative, by central differences."""
    step = 2e-3
    if order == 2:
        return position(time)
    ahead, here, behind = position(time + step), position(time), position(time - step)
    return (ahead - behind) / (2 * step) if order == 1 else (ahead - 2 * here + behind) / step**2


@pytest.mark.parametrize("mounting", [QX, QY], ids=["Qx", "Qy"])
@pytest.mark.parametrize("changes", OBSERVABLES.values(), ids=OBSERVABLES)
@pytest.mark.parametrize("phase", [0, 1], ids=["cosine", "sine"])
def test_columns_match_derivatives_of_motion(phase, changes, mounting, predict):
    part = predict(*changes, rates=(2.9,)).fit.design_blocks[0]
    series = replace(part.series, mounting=mounting)
    axis = mounting.input_axis[:2]
    radius, rate = series.trajectory.radius, series.trajectory.spindle.rate
    wave = (np.cos, np.sin)[phase]

    def place(distance, angle):
        return distance * (np.cos(angle) * axis[0] + np.sin(angle) * axis[1])

    def imbalanced(t):
        return place(wave(rate * t), rate * t)

    def eccentric(t):
        # The reference goes where the encoder says; what is recorded is that much behind.
        ahead, behind = (rate * t + small * wave(rate * t) for small in (1e-3, -1e-3))
        return (place(radius, behind) - place(radius, ahead)) / 2e-3

    time = series.time[:400]
    for fault, position in ((IMBALANCE, imbalanced), (ECCENTRICITY, eccentric)):
        expected = derivatives(position, time, ORDERS[series.observable])
        shown = simulate_fault_signal(fault, series)[:400, phase]
        assert np.abs(shown - expected).max() < 1e-4 * np.abs(expected).max(), fault.symbol


def test_stretch_equals_radius_change_per_rate(predict):
    series = predict(rates=(5.0,)).fit.design_blocks[0].series
    stretch = next(
        actual_possible_fault
        for actual_possible_fault in possible_faults(predict().campaign, "Qx")
        if "stretch" in actual_possible_fault.symbol
    )
    motion = series.trajectory
    grown = motion.radius * (1.0 + 1e-6 * motion.radius * 25.0)
    longer = Trajectory(motion.spindle, grown, motion.site)
    change = (series.reference(longer) - series.reference()) / 1e-6
    assert simulate_fault_signal(stretch, series)[:, 0] == pytest.approx(change, rel=1e-4, abs=1e-6)


# How much of K_II rests on its harmonic


def predict_harmonic_share(prediction):
    place = coefficient_index(prediction)
    responses = fault_sensitivities(prediction, [mean_square_fault("Qx"), square_term_fault("Qx")])
    mean, whole = (response.shifts[place, 0] for response in responses)
    return 1.0 - mean / whole


def test_harmonic_share_depends_on_prior(write_starter, predict):
    text = write_starter().read_text(encoding="utf-8")
    terms = next(line for line in text.splitlines() if line.startswith("terms"))
    priors = text.partition("[model.priors]\n")[2].partition("\n[limits]")[0]
    alone = [*FORCE, (priors, ""), ('bias = "0 ± 5e-7 g" ', "")]
    # a_I^2 = A^2/2 (1 + cos 2 th): mean squares 1 of the mean to 1/2 of the harmonic.
    known = predict(*alone, (terms, 'terms = ["K_II"]'), rates=(6.0,))
    assert predict_harmonic_share(known) == pytest.approx(1.0 / 3.0, abs=1e-3)
    # One rate and a free bias leave the harmonic alone.
    free = predict(*alone, (terms, 'terms = ["K_F", "K_II"]'), rates=(6.0,))
    assert predict_harmonic_share(free) == pytest.approx(1.0, abs=1e-3)
    assert abs(predict_harmonic_share(predict())) < 1e-3


# What a user reads


def test_report_and_result_name_undetected_faults(write_starter, capsys):
    result = plan(write_starter(SMALL)).result
    qx = result.accelerometers["Qx"]
    unseen = {effect.symbol: effect for effect in qx.faults if not effect.noticed}
    assert {"K_OO", "delta_O"} <= set(unseen)
    ratios = [effect.ratio for effect in qx.faults]
    assert ratios == sorted(ratios, reverse=True)
    assert min(ratios) > 1.0
    k_oo = unseen["K_OO"]
    assert k_oo.shift / qx.coefficients["K_II"].u == pytest.approx(k_oo.ratio)
    console = make_console()
    console.width = 140
    console.print(result)
    printed = " ".join(capsys.readouterr().out.split())
    assert "Effects on Qx that the plan cannot detect" in printed
    assert "second-order output-axis coefficient (K_OO) 2 ug/g^2" in printed
    assert "Less than 0.1 % of the information on K_II comes from the second harmonic" in printed


def test_force_campaign_depends_on_harmonic_and_eccentricity(write_starter):
    qx = plan(write_starter(SMALL, *FORCE)).result.accelerometers["Qx"]
    assert qx.harmonic_share > 0.3
    faults = {effect.symbol: effect for effect in qx.faults}
    assert faults["encoder.harmonic.1"].ratio > 10.0
    assert faults["encoder.harmonic.3"].noticed


def test_model_without_k_ii_has_no_fault_report(write_starter):
    file = write_starter(SMALL, ('"K_II", ', ""), ('minimise = ["K_II"]  ', 'minimise = ["K_I"]  '))
    qx = plan(file).result.accelerometers["Qx"]
    assert qx.harmonic_share is None
    assert qx.faults is None

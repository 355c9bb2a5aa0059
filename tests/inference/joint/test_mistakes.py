"""What a mistake does to a record is what it does to an exact one; which of several is likelier."""

import math
from dataclasses import replace

import numpy as np
import pytest
from joint_campaign import RATES, make_unknowns, simulate_series, simulate_three_rates
from scipy import integrate, stats

from counterspin.inference.joint import mistakes
from counterspin.inference.joint.alternatives import Alternative, run_score_tests
from counterspin.inference.joint.estimation import estimate
from counterspin.inference.joint.fit import estimate_considered
from counterspin.inference.joint.unknowns import Unknowns
from counterspin.inference.noise.model import Noise

MODEL = Unknowns(make_unknowns(["K_F", "K_I", "K_II"]))
SIZE = 30e-6  # g


def compare_steps(records):
    """Return the score tests of steps in the records."""
    fit = estimate_considered(
        estimate(records, MODEL, {"Qx": Noise(0.01, 0.0)}, rejects_outliers=False).fit
    )
    return run_score_tests(fit, tuple(mistakes.changepoints(fit, 9)), noise_given=True)


@pytest.fixture(scope="module")
def correct_records():
    return simulate_three_rates({"K_F": 0.005, "K_I": 1.002, "K_II": 2.7e-5})


def test_bias_step_is_found_with_time_and_size(correct_records):
    """From a step of b at a time s on, a displacement grows by b g (t - s)^2/2."""
    *others, last = correct_records
    low, high = float(last.time[0]), float(last.time[-1])
    for part in (0.1, 0.4, 0.8):  # of the ten parts between nine steps
        at = low + part * (high - low)
        later = np.maximum(last.time - at, 0.0)
        fallen = SIZE * last.trajectory.site.gravity * later**2 / 2.0
        every = compare_steps([*others, replace(last, error=last.error + fallen)])
        best = int(np.argmax(every.z))
        other = every.alternatives[best]
        assert (other.kind, other.owner) == (mistakes.BIAS_STEP, f"{last.run}.Qx")
        assert other.time == pytest.approx(at, abs=1e-9 * high)
        assert float(every.value[best]) == pytest.approx(SIZE, rel=1e-3)


@pytest.mark.parametrize("observable", ["velocity", "specific_force"])
def test_low_pass_is_found_with_time_constant(observable):
    """|H| = 1/sqrt(1 + (w tau)^2), exactly, times the wave of each record."""
    tau, records = 5e-3, []
    truth = {"K_F": 0.005, "K_I": 1.002, "K_II": 2.7e-5}
    for k, rate in enumerate(RATES):
        series = simulate_series(f"run{k}", rate, truth, observable=observable)
        wave = series.reference()
        wave -= wave.mean()
        gain = 1.0 / math.sqrt(1.0 + (rate * tau) ** 2)
        records.append(replace(series, error=series.error + (gain - 1.0) * wave))
    fit = estimate_considered(
        estimate(records, MODEL, {"Qx": Noise(1e-4, 0.0)}, rejects_outliers=False).fit
    )
    others = mistakes.record_mistakes(fit, {"Qx": 1.7e-9}, has_recorded_angle=True)
    every = run_score_tests(fit, tuple(others), noise_given=True)
    best = int(np.argmax(every.z))
    assert every.alternatives[best].name == "Qx.response"
    assert float(every.value[best]) == pytest.approx(tau**2, rel=0.01)


def term_log_bayes_factor(typical, value, u):
    return mistakes.log_bayes_factor(
        Alternative("term", "Qx", "K_OO", default_sd=typical), value, u
    )


@pytest.mark.parametrize("value", [5e-7, 2e-6, 1e-5])
def test_evidence_is_likelihood_averaged_over_prior(value):
    """For u well below the typical size: Laplace's approximation, within u^2 over its square."""
    typical, u = 2e-6, 1e-8

    def density(x):
        return stats.norm.pdf(value, x, u) * stats.cauchy.pdf(x, 0.0, typical)

    average, _ = integrate.quad(density, value - 10 * u, value + 10 * u)
    # A likelihood whose largest value is 1 has sqrt(2 pi) u for the normal density's 1.
    assert term_log_bayes_factor(typical, value, u) == pytest.approx(
        math.log(average * u), abs=1e-3
    )


def test_size_near_typical_size_is_more_likely():
    # 1 arcsec of the encoder looks like 12 um of imbalance, which is typically 1 um.
    encoder = term_log_bayes_factor(4.85e-6, 4.85e-6, 1e-9)
    imbalance = term_log_bayes_factor(1e-6, 12e-6, 12e-6 * 1e-9 / 4.85e-6)
    # ln(1/(2 pi)) and ln(12/(145 pi)), the same u over the value in both.
    assert encoder - imbalance == pytest.approx(math.log(0.5 * 145 / 12), rel=1e-9)


def test_mistake_has_scale_invariant_prior():
    def of_mistake(kind, value):
        return mistakes.log_bayes_factor(Alternative(kind, "Qx", "scale"), value, 1e-3 * value)

    assert of_mistake(mistakes.SCALE, 1e-5) == pytest.approx(of_mistake(mistakes.SCALE, 0.1))
    assert of_mistake(mistakes.JUMP, 0.1) < of_mistake(mistakes.SCALE, 0.1)


def test_stated_input_is_more_likely_wrong_than_default():
    # A radius of 10 cm off is no typical error, but a mistaken digit; nobody writes a clock down.
    radius = Alternative("input", "", "centrifuge.radius", default_sd=1e-5, stated=True)
    clock = Alternative("input", "", "records.clock", default_sd=2e-5)
    assert mistakes.log_bayes_factor(radius, 0.1, 1e-4) > mistakes.log_bayes_factor(
        clock, 0.005, 5e-6
    )


def test_undetermined_alternative_is_last():
    assert term_log_bayes_factor(1e-6, 1e-6, math.inf) == -math.inf
    assert term_log_bayes_factor(1e-6, 0.0, 1e-7) == -math.inf

"""Numbers for other packages have the same u, correlations and degrees of freedom."""

import math

import numpy as np
import pytest
import results as by_hand

from counterspin.calibration.result_parts import Correlation


def make_result(correlation, dof):
    """Return a result of K_F, K_I... with this correlation and these degrees of freedom."""
    qx_result = by_hand.make_qx_result()
    (name, accelerometer), *_ = qx_result.accelerometers.items()
    like = next(iter(accelerometer.coefficients.values()))
    symbols = ("K_F", "K_I", "K_II", "K_III")[: len(dof)]
    coefficients = {
        symbol: like.model_copy(update={"value": 1.0 + place, "u": 10.0**-place, "dof": freedom})
        for place, (symbol, freedom) in enumerate(zip(symbols, dof, strict=True))
    }
    changed_accelerometer = accelerometer.model_copy(update={"coefficients": coefficients})
    stated = Correlation(terms=[f"{name}.{s}" for s in symbols], matrix=correlation.tolist())
    return qx_result.model_copy(
        update={"accelerometers": {name: changed_accelerometer}, "correlation": stated}
    )


def make_correlation(r):
    return np.array([[1.0, r], [r, 1.0]])


@pytest.mark.parametrize(
    ("correlation", "dof"),
    [
        (make_correlation(0.3), (17.5, 1.55)),
        (make_correlation(-0.9), (8.0, 7.0)),
        (make_correlation(0.999), (5.0, 5.0)),
        (make_correlation(0.4), (3.0, None)),
        (np.eye(3), (1.0, 40.0, None)),
        (np.eye(2), (None, None)),
    ],
)
def test_gtc_numbers_have_separate_degrees_of_freedom(correlation, dof):
    package = pytest.importorskip("GTC")
    result = make_result(correlation, dof)
    numbers = result.to_gtc()
    for name, number in numbers.items():
        c = result.coefficient(name)
        assert (number.x, number.label) == (c.value, name)
        assert number.u == pytest.approx(c.u, rel=1e-12)
        if c.dof is None:
            # If correlated with a number that has few, the degrees of freedom are finite.
            assert number.df > 1e6 or correlation[0, 1]
        else:
            assert number.df == pytest.approx(c.dof, rel=1e-6)
    first, second, *_ = numbers.values()
    assert package.get_correlation(first, second) == pytest.approx(correlation[0, 1], abs=1e-12)


def test_degrees_of_freedom_of_gtc_numbers_are_bounded():
    pytest.importorskip("GTC")
    random = np.random.default_rng(7)
    for _ in range(20):
        loads = random.normal(size=(4, 4))
        covariance = loads @ loads.T
        scale = np.sqrt(np.diag(covariance))
        dof = tuple(float(d) for d in 10.0 ** random.uniform(-0.3, 4.0, 4))
        result = make_result(covariance / np.outer(scale, scale), dof)
        for name, number in result.to_gtc().items():
            c = result.coefficient(name)
            assert number.u == pytest.approx(c.u, rel=1e-9)
            assert number.df <= max(1.0, c.dof) * (1.0 + 1e-3)
            assert number.df >= 1.0 - 1e-9


def test_sum_keeps_equal_degrees_of_freedom():
    pytest.importorskip("GTC")
    numbers = make_result(make_correlation(0.6), (9.0, 9.0)).to_gtc()
    first, second = numbers.values()
    for sum_of_both in (first + second, 2.0 * first - 30.0 * second):
        assert sum_of_both.df == pytest.approx(9.0, rel=1e-6)
    assert (first + second).u == pytest.approx(math.sqrt(1.0 + 0.01 + 2.0 * 0.6 * 0.1), rel=1e-12)

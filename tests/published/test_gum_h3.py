"""GUM annex H.3: calibration of a thermometer, a straight line by least squares.

Source: JCGM 100:2008, Evaluation of measurement data - Guide to the expression of uncertainty in
measurement, annex H.3, table H.6 and clauses H.3.3 and H.3.4.
"""

import numpy as np
import pytest

from counterspin.inference.plain_fit import fit

READING = np.array(
    [21.521, 22.012, 22.512, 23.003, 23.507, 23.999, 24.513, 25.002, 25.503, 26.010, 26.511]
)
CORRECTION = -np.array(
    [0.171, 0.169, 0.166, 0.159, 0.164, 0.165, 0.156, 0.157, 0.159, 0.161, 0.160]
)


def test_curve_and_its_prediction():
    result = fit(np.column_stack([np.ones(11), READING - 20.0]), CORRECTION)
    correlation = result.covariance[0, 1] / np.prod(result.u)
    # Half a unit of the last digit printed.
    assert result.estimate[0] == pytest.approx(-0.1712, abs=0.5e-4)
    assert result.estimate[1] == pytest.approx(0.00218, abs=0.5e-5)
    assert result.u[0] == pytest.approx(0.0029, abs=0.5e-4)
    assert result.u[1] == pytest.approx(0.00067, abs=0.5e-5)
    assert correlation == pytest.approx(-0.930, abs=0.5e-3)
    assert result.sigma == pytest.approx(0.0035, abs=0.5e-4)
    assert result.sigma_from_residuals
    assert result.dof == 9

    at_30 = np.array([1.0, 10.0])
    assert at_30 @ result.estimate == pytest.approx(-0.1494, abs=0.5e-4)
    assert np.sqrt(at_30 @ result.covariance @ at_30) == pytest.approx(0.0041, abs=0.5e-4)

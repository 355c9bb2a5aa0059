"""GUM annex H.3: calibration of a thermometer, a straight line by least squares.

Source: JCGM 100:2008, Evaluation of measurement data - Guide to the expression of uncertainty in
measurement, annex H.3, table H.6 and clauses H.3.3 and H.3.4. Numbers and limits are those of the
validation's case.
"""

import numpy as np
import pytest

from counterspin.inference.least_squares import fit
from counterspin.validation.cases import case
from counterspin.validation.validate import check_case

CASE = case("GUM H.3")
READING = 20.0 + np.array(CASE.given["x"])
CORRECTION = np.array(CASE.given["y"])


def test_calibration_curve_and_prediction():
    result = fit(np.column_stack([np.ones(11), READING - 20.0]), CORRECTION)
    correlation = result.covariance[0, 1] / np.prod(result.u)
    # Half a unit of the last printed digit.
    assert check_case(CASE).state == "passed"
    assert correlation == pytest.approx(-0.930, abs=0.5e-3)
    assert result.sigma_from_residuals
    assert result.dof == 9

    at_30 = np.array([1.0, 10.0])
    assert at_30 @ result.estimate == pytest.approx(-0.1494, abs=0.5e-4)
    assert np.sqrt(at_30 @ result.covariance @ at_30) == pytest.approx(0.0041, abs=0.5e-4)

"""ISO/TS 28037:2010, straight-line calibration functions: the examples of clause 6.3.

Source: ISO/TS 28037:2010, Determination and use of straight-line calibration functions, clause 6.3
(uncertainties associated with the y_i only), the example with equal weights (p. 13) and the one
with unequal weights (p. 15). The printed figures are those that GTC (Measurement Standards
Laboratory of New Zealand, https://github.com/MSLNZ/GTC) keeps in its tests for these examples.
"""

import numpy as np
import pytest

from counterspin.inference.plain_fit import fit

DESIGN = np.column_stack([np.ones(6), np.arange(1.0, 7.0)])


def test_equal_weights():
    result = fit(DESIGN, [3.3, 5.6, 7.1, 9.3, 10.7, 12.1], sigma=0.5)
    np.testing.assert_allclose(result.estimate, [1.866667, 1.757143], atol=0.5e-6)
    np.testing.assert_allclose(result.u, [0.4654747, 0.1195229], atol=0.5e-7)
    assert result.covariance[0, 1] == pytest.approx(-0.050, abs=0.5e-3)
    assert result.chi2 == pytest.approx(1.665, abs=0.5e-3)
    assert result.dof == 4
    assert not result.sigma_from_residuals


def test_unequal_weights():
    sigma = [0.5, 0.5, 0.5, 1.0, 1.0, 1.0]
    result = fit(DESIGN, [3.2, 4.3, 7.6, 8.6, 11.7, 12.8], sigma)
    np.testing.assert_allclose(result.estimate, [0.8852, 2.0570], atol=0.5e-4)
    np.testing.assert_allclose(result.u, [0.5297081, 0.1778920], atol=0.5e-7)
    assert result.covariance[0, 1] == pytest.approx(-0.08227848, abs=0.5e-8)
    assert result.chi2 == pytest.approx(4.131, abs=0.5e-3)
    assert result.dof == 4

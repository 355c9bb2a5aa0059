"""ISO/TS 28037:2010, straight-line calibration functions: the examples of clause 6.3.

Source: ISO/TS 28037:2010, Determination and use of straight-line calibration functions, clause 6.3
(uncertainties associated with the y_i only), the example with equal weights (p. 13) and the one
with unequal weights (p. 15). The printed figures are those that GTC (Measurement Standards
Laboratory of New Zealand, https://github.com/MSLNZ/GTC) keeps in its tests for these examples.
Numbers and limits are those of the validation's cases.
"""

import pytest

from counterspin.inference.least_squares import fit
from counterspin.validation.cases import case
from counterspin.validation.validate import check_case


@pytest.mark.parametrize("weights", ["equal weights", "unequal weights"])
def test_weighted_line_example(weights):
    stated = case(f"ISO/TS 28037, {weights}")
    assert check_case(stated).state == "passed"
    design = [[1.0, x] for x in stated.given["x"]]
    result = fit(design, stated.given["y"], stated.given["sigma"])
    assert not result.sigma_from_residuals

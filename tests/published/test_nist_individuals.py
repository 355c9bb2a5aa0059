"""NIST/SEMATECH e-Handbook of Statistical Methods, 6.3.2.2: individuals control charts.

Source: https://www.itl.nist.gov/div898/handbook/pmc/section3/pmc322.htm, the example of the flow
rate of batches: centre 50.81, mean moving range 1.8778, limits 45.8159 and 55.8041, found with the
factor 1.128 of the moving range, which has more digits here.
"""

import pytest

from counterspin.histories.control import individuals

FLOW_RATE = [49.6, 47.6, 49.9, 51.3, 47.8, 51.2, 52.6, 52.4, 53.6, 52.1]


def test_flow_rate():
    found = individuals(FLOW_RATE)
    assert found.centre == pytest.approx(50.81, abs=0.5e-9)
    assert found.mean_range == pytest.approx(1.8778, abs=0.5e-4)
    low, high = found.limits()
    # 1.128 and 1.128379 differ by 3.4e-4 of the distance of 4.99 from the centre.
    assert (low, high) == pytest.approx((45.8159, 55.8041), abs=0.0018)
    assert (f"{low:.2f}", f"{high:.2f}") == ("45.82", "55.80")
    assert found.beyond == found.leaps == ()

"""NIST/SEMATECH e-Handbook of Statistical Methods, 6.3.2.2: individuals control charts.

Source: https://www.itl.nist.gov/div898/handbook/pmc/section3/pmc322.htm, the example of the flow
rate of batches: centre 50.81, mean moving range 1.8778, limits 45.8159 and 55.8041, found with the
factor 1.128 of the moving range, which has more digits here.
"""

from counterspin.histories.consistency import individuals_chart
from counterspin.validation.cases import case
from counterspin.validation.validate import check_case

CASE = case("individuals chart of a flow rate")


def test_flow_rate_example():
    # 1.128 and 1.128379 differ by 3.4e-4 of the distance of 4.99 from the centre.
    assert check_case(CASE).state == "passed"
    values = CASE.given["values"]
    chart = individuals_chart(values, [str(place) for place in range(len(values))])
    assert (f"{chart.action_low:.2f}", f"{chart.action_high:.2f}") == ("45.82", "55.80")
    assert chart.beyond == chart.leaps == []

"""Comparison of results of different models, methods and campaigns.

- `compare`: values, differences with their uncertainty, agreement, changes
- `estimates`: estimates of an accelerometer in two results, shared sources, and the covariance of
  the difference
- `rerun`: repeated calibration of a result; differences between several results
- `result`: the comparison and its JSON
- `consensus`: reference value and degrees of equivalence of several measurements
- `intercompare`: comparison of laboratories; `intercomparison_page`: its report
- `page`: the reports of a comparison and of a repeated calibration
"""

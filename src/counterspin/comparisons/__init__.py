"""Comparison of results of different models, methods and campaigns.

- `compare`: values, differences with their uncertainty, agreement, changes
- `estimates`: the estimates of an accelerometer in two results, their shared sources, and the
  covariance of their difference
- `rerun`: a result's calibration made again, and the differences between several results
- `result`: the comparison and its JSON
- `consensus`: reference value and degrees of equivalence of several measurements
- `intercompare`: comparison of laboratories; `intercomparison_page`: its report
- `page`: the printed reports of a comparison and of a calibration made again
"""

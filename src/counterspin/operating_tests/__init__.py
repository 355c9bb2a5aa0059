"""Operating tests of IEEE Std 1293: response of an accelerometer to known inputs.

- `model`: linearity, hysteresis, threshold, resolution, dead band and warm-up from a table
- `result`: the results of the tests, and their JSON
- `measure`: from a file to the results
- `page`: their report
"""

"""Results beside each other: other models, other methods, other campaigns.

- `compare`: values, differences with their uncertainty, whether they agree, what changed
- `estimates`: what each of two results says of an accelerometer, what both share, and how their
  difference varies
- `rerun`: a result's calibration made again, and what is not the same in several results
- `result`: the comparison and its JSON
- `page`: a comparison, and a calibration made again, as pages: what agrees, the differences, what
  changed
"""

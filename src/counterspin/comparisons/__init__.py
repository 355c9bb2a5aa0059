"""Results beside each other: other models, other methods, other campaigns.

- `compare`: values, differences with their uncertainty, whether they agree, what changed
- `estimates`: what a result says of one accelerometer, its uncertainty taken apart by source
- `relations`: which records, terms and weights two results have in common
- `common`: the covariance of a difference of two results, what they have in common being counted
- `changes`: what is not the same in the campaigns and the ways they were calibrated
- `result`: the comparison and its JSON
- `page`: a comparison as a person reads it, and its report
- `rerun`: a result's calibration made again; `rerun_page`: the same as a person reads it
"""

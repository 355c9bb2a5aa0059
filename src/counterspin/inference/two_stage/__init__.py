"""The paper's two-stage method: a parabola a run, then its curvature against the rate.

- `strobes`: the samples of a record at one angle of each revolution (Eq. 15)
- `request`: model, priors and noise of one accelerometer
- `first_stage`: a parabola through the strobes of one run (Eq. 16-18, 31)
- `curvatures`: a record as one row of a joint fit, its curvature
- `second_stage`: K_II from the curvatures of all runs (Eq. 19-27, 33-34)
"""

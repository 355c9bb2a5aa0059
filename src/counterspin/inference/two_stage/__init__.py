"""The paper's two-stage method: a parabola a run, then its curvature against the rate.

- `first_stage`: the samples of a record at one angle of each revolution, its strobes (Eq. 15), and
  a parabola through them (Eq. 16-18, 31)
- `model`: what is asked of one accelerometer, and its curvatures as rows of a joint fit
- `second_stage`: K_II from the curvatures of all runs (Eq. 19-27, 33-34)
"""

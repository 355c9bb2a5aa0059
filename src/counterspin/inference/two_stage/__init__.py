"""The paper's two-stage method: a parabola per run, then its curvature against the rate.

- `first_stage`: strobes of a record, one sample per revolution (Eq. 15), and a parabola through
  them (Eq. 16-18, 31)
- `model`: request for an accelerometer, and its curvatures as rows of a joint fit
- `second_stage`: K_II from the curvatures of all runs (Eq. 19-27, 33-34)
"""

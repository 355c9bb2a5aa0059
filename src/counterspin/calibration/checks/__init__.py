"""Checks of every result: they detect a misfit, and the diagnosis explains it.

- `residuals`: residuals against the noise, and remarks on the noise
- `readings`: readings and poses
- `unseen_faults`: single faults of typical size that few readings would not show
- `priors`: priors and inputs that the data contradict
- `methods`: each test method (at rest, poses, arm, double turntable) against the others
- `limits`: credible sizes of estimates
- `small_angles`: drifts and tilts within the first-order theory of the attitude
"""

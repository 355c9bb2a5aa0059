"""Three accelerometers of one sensor, and their poses at unknown attitudes.

Readings import this package by name for a campaign with a triad.

- `section`: [triad], and runs at unknown attitudes
- `static_intervals`: rest intervals of a three-axis sensor in one long record
- `record_poses`, `groups`: poses stated as readings or detected in records, grouped by noise
- `poses`: poses as data of a fit
- `determinability`: parameters that the directions of the poses do not determine
- `patterns`, `checks`: patterns of the residuals of poses, and tests of them
- `result`: the nine parameters, the matrix and the poses in a result
- `joint_data`: the triad as data of a calibration
"""

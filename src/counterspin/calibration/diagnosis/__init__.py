"""What is wrong, if something is.

- `search`: the likely causes of a misfit, each tried on the records
- `causes`: one finding for each cause, the others below it
- `stated_noise`: whether the stated noise is that of all runs, or of some
- `words`: what is said of a cause
- `mountings`: whether an accelerometer is mounted as it is stated
- `untested`: what a coefficient rests on that the data cannot check
- `credible`: estimates that no instrument has, whatever the fit
- `attitude_findings`: whether drift and tilts are small enough for the theory
- `reading_findings`: what speaks against readings
- `kinds`: each kind of test (at rest, poses, arm, double turntable) beside the others
- `pose_findings`: what speaks against poses at unknown attitudes
- `record_counts`: how many rows of a record were left out, and whether they are too many
"""

"""What is wrong, if something is.

- `search`: the likely causes of a misfit, each tried on the records; `words`: what is said of them
- `noise`: whether residuals are the noise, as stated or as found
- `reading_findings`: what speaks against readings and poses
- `agreement`: each test method (at rest, poses, arm, double turntable) beside the others
- `statements`: mountings and values that the data contradict, or cannot check
- `unseen_faults`: single faults that the residuals of readings would not show
"""

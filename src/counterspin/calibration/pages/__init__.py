"""A calibration's result as a person reads it: blocks for any face.

- `terminal`: a result in the terminal; `sections`: its blocks
- `full_report`: the whole report for paper and screen
- `verdict`, `accelerometer`, `triad`, `uncertainty`, `motions`, `kinds`, `conformity`,
  `basis`, `pictures`, `pose_pictures`: its chapters
- `batch`: many campaigns in one table
"""

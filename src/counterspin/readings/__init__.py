"""Readings: single values at rest, on an arm or on a double turntable, and means of records.

A calibration loads this room by name for a campaign with readings or with a triad.

- `entries`, `table`, `description`: readings in ``[[runs]]``, in a table, and in the description
- `similar_rows`: rows of a table that differ only in numbers, as columns
- `section`, `cells`: keys of `[readings]`, and cells of its table
- `groups`: readings of a campaign, grouped by accelerometer, motion and noise
- `linear`: readings and poses linearised at an estimate
- `known_attitudes`: readings of one accelerometer at known attitudes
- `fit`, `fitted`: the fit of readings and poses beside records, and the residuals of each group
- `patterns`: patterns of the residuals, such as a drift or a term that the model lacks
- `means`, `mean_records`: means of records, and readings from them with the rotation of the arm
- `joint_data`: readings and poses as data of a calibration
- `reading_groups`: groups of readings and poses of one accelerometer
- `checks`, `undetected_faults`: tests of the residuals, and single faults that they would not show
- `agreement`, `methods`: each test method compared with the others
"""

"""Readings: single values at rest, on an arm or on a double turntable, and means of records.

The calibration loads this package by name for a campaign with readings or a triad.

- `entries`, `table`, `description`: readings in ``[[runs]]``, in a table, and in the description
- `similar_rows`: vectorised conversion of table rows that differ only in numbers
- `section`, `cells`: keys of `[readings]`, and cells of its table
- `groups`: readings of a campaign, grouped by accelerometer, motion and noise
- `linear`: readings and poses linearised at an estimate
- `known_attitudes`: readings of one accelerometer at known attitudes
- `fit`, `fitted`: joint fit of readings, poses and records, and the residuals of each group
- `patterns`: patterns of the residuals, such as a drift or a missing term
- `means`, `mean_records`: means of records, and their conversion to readings
- `joint_data`: readings and poses as data of a calibration
- `reading_groups`: groups of readings and poses of one accelerometer
- `checks`, `undetected_faults`: tests of the residuals, and faults that they would not detect
- `agreement`, `methods`: comparison of the test methods
"""

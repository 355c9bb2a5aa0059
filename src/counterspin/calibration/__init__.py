"""Calibration: estimate coefficients and uncertainties from a campaign folder.

- `calibrate`: calibration of a campaign; `batch`: calibration of several campaigns
- `options`: options of a calibration
- `observed_runs`: records with the identified rotation and the recorded temperatures
- `input_location`: values of timing offset and frequency response for the derivatives of the fit
- `assembly`: assembly of a `Result` from observed runs
- `model`: selection of requested, nuisance, considered and fixed terms
- `joint_problem`: data and noise of the joint fit
- `accelerometer_view`: view of the fit for one accelerometer; interface of readings and poses
- `joint`: joint method
- `two_stage`: two-stage method
- `outcome`: conversion of an estimate to parts of a result
- `findings`: findings on a result, and its state
- `checks`: checks of every result
- `extensions`: functions that a calibration loads by name; `diagnosis`: causes of a misfit
- `conformity`: conformity of coefficients with their specifications
- `monte_carlo`: coverage intervals by JCGM 101; `linearity`: test of the linear sensitivities
- `result`, `result_parts`: result of a calibration, and its JSON
- `result_file`: results of earlier schemas, and validation of files
- `result_conversion`: coefficients as frames, and for uncertainties and GTC
- `si_estimates`: coefficients in SI units
- `pages`: report pages of a result
"""

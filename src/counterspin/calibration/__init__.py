"""The main job: from a campaign's folder to the coefficients and what may be said of them.

- `calibrate`: the whole way, from a folder to a `Result`; `batch`: many campaigns
- `options`: how a calibration is made
- `observed_runs`: records with the identified rotation and the recorded temperatures
- `input_location`: values of timing offset and frequency response at which the fit takes
  derivatives
- `assembly`: from observed runs to a `Result`, by either method
- `model`: what is asked for, held, stated and unstated; what is assumed to be perfect
- `joint_problem`: the joint fit's data and noise
- `accelerometer_view`: the fit as one accelerometer sees it, and data other than records in it
- `joint`: the outcome of the joint method
- `two_stage`: the two-stage method
- `outcome`: what a method has found, as the result states it
- `findings`: what speaks against a result, and its state
- `checks`: checks of every result
- `extensions`: the functions that a calibration calls by name; `diagnosis`: the causes of a misfit
- `conformity`: whether coefficients meet their specifications
- `monte_carlo`: intervals by JCGM 101; `linearity`: whether sensitivities are constant within ±2 u
- `result`, `result_parts`: what a calibration found, its JSON; what it is made of
- `result_file`: results of earlier schemas, and numbers that no result has
- `result_conversion`: coefficients as frames, for uncertainties and GTC
- `si_estimates`: coefficients in SI units
- `pages`: the result as a person reads it
"""

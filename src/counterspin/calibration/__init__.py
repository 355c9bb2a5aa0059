"""The main job: from a campaign's folder to the coefficients and what may be said of them.

- `calibrate`: the whole way, from a folder to a `Result`; `batch`: many campaigns
- `options`: how a calibration is made
- `observed`: records brought together with the rotation they were taken on, and with how warm it
  was; sensors at rest
- `assembly`: from observed runs to a `Result`, by either method
- `outcome`: what a method has found, as the result states it
- `model`: what is asked for, held, stated and unstated; what is assumed to be perfect
- `joint_problem`, `joint`: the joint fit's data and noise; its outcome
- `joint_view`: what the fit holds of one accelerometer
- `joint_parts`, `joint_checks`: its values and noise; its checks
- `two_stage_request`, `two_stage`, `two_stage_findings`: what is asked of the paper's method; its
  outcome; what its result must say beside
- `conformity`: whether coefficients meet their specifications
- `result`, `result_parts`: what a calibration found, its JSON; what it is made of
- `schema_1`: results of earlier versions
- `findings`: what speaks against a result, and its state
- `diagnosis`: the cause of a misfit
- `readings`: single values beside records, or alone
- `posed`: three accelerometers as one sensor, in poses at unknown attitudes
- `notebook`: what else a researcher asks of a result
- `pages`: the result as a person reads it
"""

"""The commands: what the command line and the Python interface both call.

- `init`: a commented campaign description to start from
- `simulate`: records of a campaign whose coefficients are known
- `calibrate`, `calibration`: the main job, from a campaign folder to observed runs, and from these
  to a `Result`
- `method`: how a calibration is made
- `two_stage`, `two_stage_findings`: its method of the paper; what its result must say beside
- `joint`, `joint_parts`, `joint_checks`: its method of full records; the result's parts; its checks
- `joint_traces`: its residuals, thinned for pictures
- `history`, `history_files`, `history_result`: results of one instrument over time; the files
  they come from; what was found
- `conformity`: whether a result's coefficients meet their specifications
- `demo`: the paper's plan from simulation to result, by every method
- `apply`, `apply_file`: corrects indicated specific force for a result; the same for a file
- `plan`: which runs to make within given limits; what a campaign will tell before it is recorded
- `plan_search`, `plan_determined`: its problem, solved; whether its goal can be had
- `plan_parts`, `plan_curves`: its result's parts; its figures' curves
- `batch`: many campaigns, one failure stopping no other
- `study`, `study_setup`, `study_work`, `study_result`: many trials of a campaign and its analyses;
  what its engine needs; its work shared out; the result
- `crew`: who does shared-out work, processes here or a cluster
"""

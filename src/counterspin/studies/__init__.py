"""Many simulated trials of a campaign and its analyses: bias, scatter, coverage.

- `study`: the public function, from a study's file to its result
- `description`: the keys of ``[study]`` and their checks
- `simulation_setup`: the simulated setup; `draws`: the true values and the noise of each trial
- `engine_selection`: the competing analyses, and the engine of each analysis
- `linear_engines`: trials of linear analyses by sufficient statistics, and the Cramer-Rao bound
- `full_simulation`: trials simulated sample by sample, and analysed as `calibrate` does
- `batch_runner`: the interface of an engine; the batches of a study on one core, on many cores
  or on a cluster
- `result`: statistics of the trials, a study's result, its JSON
- `folder`: the folder of the result and of the files that a resumption needs
- `page`: the printed report of a study, with its figures
"""

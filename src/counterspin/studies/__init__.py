"""Many simulated trials of a campaign and its analyses: bias, scatter, coverage.

- `study`: the whole way, from a study's file to its result
- `description`: the keys of ``[study]`` and their checks
- `world`: the simulated set-up; `draws`: the true values and the noise of each trial
- `choice`: the competing analyses, and the engine of each analysis
- `linear`: trials of linear analyses by sufficient statistics, and the Cramer-Rao bound
- `whole_trials`: trials simulated sample by sample, and analysed as `calibrate` does
- `work`: the interface of an engine; the trials of a study, batch by batch, on one core, on many,
  or on a cluster
- `result`: statistics of the trials, a study's result, its JSON
- `folder`: the folder of the result and of the files that a resumption needs
- `page`: the printed report of a study, with its figures
"""

"""Campaigns as files: quantities with units, the description, records, the result.

A campaign is a folder: ``campaign.toml`` beside its record files.

- `quantity`: text such as ``"2.5 ± 1e-5 m"`` to numbers in SI and g-units
- `settings`: what may stand in ``campaign.toml``, section by section
- `checking`: mistakes, collected and told in the user's words
- `terms`: which error terms a campaign asks for, and their priors
- `truth`: what a simulated campaign is made of; calibration never looks at it
- `specification`: limits that coefficients shall lie between, and the rule to judge it by
- `resolved`: the campaign as the calculation sees it, in SI
- `document`: files in TOML; `description`: `read_campaign`, from the file to the resolved campaign
- `records`: `read_record`, from a run's file to samples or block means, checked and cleaned
- `column_file`, `record_csv`, `record_files`: the files themselves, whatever their format
- `record_clock`, `clock_faults`, `spikes`, `reduction`, `record_amplitude`: the steps of reading,
  in the order in which a record passes them
- `working_array`: arrays for passes over many samples
- `record_report`: what was found on the way
- `checksums`: of a campaign's files
- `observed`: records brought together with the rotation they were taken on
- `problem`: the joint fit's unknowns, priors and noise, as a campaign asks for them
- `result`: what a calibration found, its JSON; `result_parts`: what it is made of
- `forecast`: what a calibration will say, before there are records
- `plan_settings`, `plan_description`: what may stand in ``PLAN.toml``; `read_plan`
- `plan_result`: what planning found, its JSON; `toml_text`: the campaign it writes
- `output`: files that appear whole or not at all
"""

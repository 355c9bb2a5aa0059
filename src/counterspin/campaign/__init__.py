"""Campaign descriptions: files with units in, a resolved campaign in SI out.

A campaign is a folder: ``campaign.toml`` beside its record files.

- `quantity`: text such as ``"2.5 ± 1e-5 m"`` to numbers in SI and g-units; directions, attitudes
- `field_types`: types of values: how each is read, and what its schema says
- `documents`: documents in TOML: read, patched and compared; the lines in which their keys stand
- `validation`: mistakes in the file, collected and reported with their keys
- `settings`: the keys of the sections that all campaigns have
- `columns`: columns of files, and how these are read
- `accelerometers`: the tables of the accelerometers: axes, columns, priors
- `runs`: runs with records: how each is read, and which are left out
- `reading`: readings, poses and the triad of a campaign
- `terms`: names of error terms: what each stands for, and where it acts
- `model`: what is asked for, held and known of terms
- `distribution`: priors with a distribution that is not normal
- `correlations`: correlations between priors
- `frequency_response`: stated frequency responses, with their tables
- `truth`, `simulated_truth`: the tables of [truth], and the truth of a simulated campaign as read
  from them; a calibration reads neither
- `specification`: tolerance limits of coefficients, and the decision rule
- `consistency_checks`: what several tables contradict in each other
- `resolution`: the sections of ``campaign.toml``, each with its class, and what they say together
- `description`: the `Campaign`, and how it comes from a file, or from mappings and arrays
- `memory`: campaigns from mappings and arrays; campaigns changed, and written as a folder
- `questions`: what a description says that may well be a slip
- `conditions`: when runs were made, and how warm it was
- `checksums`: of a campaign's files, and what else a calibration begins before all else is loaded
- `static_noise`: noise that is left to a record at rest
"""

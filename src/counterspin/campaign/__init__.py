"""Campaign descriptions: read from files with units, resolved to SI.

A campaign is a folder: ``campaign.toml`` beside its record files.

- `quantity`: text such as ``"2.5 ± 1e-5 m"`` to numbers in SI and g-units; directions, attitudes
- `field_types`: types of values, with their validators and JSON Schemas
- `documents`: TOML documents: read, patched and compared; line numbers of keys
- `validation`: mistakes in the file, collected and reported with their keys
- `settings`: keys of the common sections
- `columns`: columns and formats of record files
- `accelerometers`: the tables of the accelerometers: axes, columns, priors
- `runs`: runs with records, and excluded runs
- `reading`: readings, poses and the triad of a campaign
- `terms`: names of error terms, and the components that each name includes
- `model`: requested terms, considered terms and priors
- `distribution`: priors whose distribution is not normal
- `correlations`: correlations between priors
- `frequency_response`: stated frequency responses, with their tables
- `truth`, `simulated_truth`: the tables of [truth], and the truth of a simulated campaign; a
  calibration uses neither
- `specification`: tolerance limits of coefficients, and the decision rule
- `consistency_checks`: contradictions between tables
- `resolution`: the sections of ``campaign.toml`` with their classes, resolved together
- `description`: the `Campaign`, read from a file or resolved from a document in memory
- `memory`: campaigns made from mappings and arrays; changed campaigns; campaigns written as folders
- `questions`: valid statements of a description that are probably mistakes
- `conditions`: times and temperatures of runs
- `checksums`: checksums of a campaign's files, computed while the program is loaded
- `static_noise`: noise estimated from a record at rest
"""

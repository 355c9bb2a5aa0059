"""Reference cases with their sources, run on the installed package: a dossier for an assessor.

- `validate`: `counterspin validate`: the reference cases run on the installed package, and the
  comparison of its files with the delivered ones
- `cases`: the cases, data in `data/` with sources, expected values and limits; tests use the same
- `kernels`: the call of each function that a case names
- `files`: inputs from files, and outputs of a result: records, campaigns, forces, certificates
- `page`: the dossier, its JSON, and its printed report
"""

"""Reference cases with their sources, run on the installed package: a dossier for an assessor.

- `validate`: `counterspin validate`: run the reference cases on the installed package, and compare
  its files with the delivered files
- `cases`: the cases in `data/` with sources, expected values and tolerances, also used by tests
- `kernels`: the call of each function under test
- `files`: cases with files: records, campaigns, corrected forces and certificates
- `page`: the dossier, its JSON and its report
"""

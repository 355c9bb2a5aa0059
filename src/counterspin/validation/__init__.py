"""Reference cases with their sources, run on what is installed: a dossier for an assessor.

- `validate`: `counterspin validate`: the reference cases run on what is installed, and whether it
  is as delivered
- `cases`: the cases, data in `data/` with sources, expected values and limits; tests use the same
- `kernels`: how each function that a case names is asked
- `files`: what is read from files, and what is made of a result: records, campaigns, forces,
  certificates
- `page`: the dossier, its JSON, and the dossier as a person reads it
"""

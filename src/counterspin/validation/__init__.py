"""Reference cases with their sources, run on what is installed: a dossier for an assessor.

- `validate`: run all cases, and write the dossier as HTML, PDF and JSON
- `cases`: the cases, data in `data/` with sources, expected values and limits; tests use the same
- `kernels`: how each function that a case names is asked
- `files`: the same for what reads files: record formats, campaigns, certificates
- `stated`: the same for what is made of a result: corrected forces, a certificate's numbers
- `installed`: versions, environment, the package's files against the hashes of its installation
- `result`: the dossier and its JSON; `page`: the dossier as a person reads it
"""

"""The Digital Calibration Certificate: a result with a laboratory's name to it (DCC 3.3.0).

A certificate says nothing that the result or the laboratory has not said: a coefficient that the
records do not determine is named as such, and a gap in the laboratory's data stops it.

- `lab`: what the laboratory says, ``LAB.toml``
- `issuing`: the whole way from a result to the file, and back
- `build`: the document; `administrative`, `statements`, `measurement`: its parts
- `wording`: the sentences; `front`: the same for people, before the report
- `elements`, `units`, `coverage`: elements of DCC and D-SI, SI units, coverage factors
- `schema`, `signature`, `reading`: validating, signing, reading back
"""

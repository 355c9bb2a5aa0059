"""The Digital Calibration Certificate: a result in a laboratory's name (DCC 3.3.0).

A certificate contains only what the result and the laboratory state: a coefficient that the
records do not determine is named as such, and missing data of the laboratory is an error.

- `lab`: the laboratory's data, ``LAB.toml``
- `issuing`: from a result to the file, and back
- `build`: the document, set by the template `assets/certificate.xml.jinja`
- `statements`: its claims; `wording`: the sentences; `front`: the pages
- `elements`, `coverage`: words and numbers as the DCC has them, coverage factors
- `conversion`: coefficients in SI, with what the uncertainty of g does there; `capability`: no U is
  below what the laboratory can do
- `triad`: three accelerometers as one sensor
- `evidence`: what bounds the terms that were taken as perfect
- `amendment`: a certificate that another one replaces
- `ledger`, `entering`: what was found, certified and amended, in a file that is only added to
- `signers`: keys and commands that sign; `signature`: the XML; `pdf_signature`: the pages (PAdES)
- `schema`, `attached`, `reading`: validating and reading back, from a PDF too
"""

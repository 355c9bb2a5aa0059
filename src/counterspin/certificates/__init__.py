"""The Digital Calibration Certificate: a result in a laboratory's name (DCC 3.3.0).

A certificate contains only what the result and the laboratory state: a coefficient that the
records do not determine is named as such, and missing data of the laboratory is an error.

- `lab`: the laboratory's data, ``LAB.toml``
- `issuing`: from a result to the file, and back
- `build`: the document, set by the template `assets/certificate.xml.jinja`
- `statements`: its claims; `wording`: the sentences, and coverage factors; `front`: the pages
- `schema`: the words and numbers of its XML, and validation
- `conversion`: the numbers: in SI, with what the uncertainty of g does there, and no U below what
  the laboratory can do
- `evidence`: what bounds the terms that were taken as perfect
- `amendment`: a certificate that another one replaces
- `ledger`: the ledger of an instrument: what was found, certified and amended, one line each, only
  added to
- `signers`: keys and commands that sign; `signature`: of the XML and of the pages (PAdES)
- `reading`: a certificate read back, from a PDF too
"""

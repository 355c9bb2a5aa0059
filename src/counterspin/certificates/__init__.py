"""The Digital Calibration Certificate: a result in a laboratory's name (DCC 3.3.0).

A certificate contains only what the result and the laboratory state: a coefficient that the records
do not determine is named as such, and missing data of the laboratory is an error.

- `lab`: the laboratory's data, ``LAB.toml``
- `issuing`: write a result's certificate, and read its file
- `build`: the document, set by the template `assets/certificate.xml.jinja`
- `statements`: its claims; `wording`: the sentences, and coverage factors; `front`: the pages
- `schema`: the words and numbers of its XML, and validation
- `conversion`: the numbers in SI, with the remaining uncertainty of g, and no U below the
  laboratory's capability
- `evidence`: the bounds of terms that were assumed perfect
- `amendment`: a certificate that another one replaces
- `ledger`: the append-only ledger of an instrument: results, certificates and amendments, one line
  each
- `signers`: keys and commands that sign; `signature`: of the XML and of the pages (PAdES)
- `reading`: the numbers of a written certificate, XML or PDF
"""

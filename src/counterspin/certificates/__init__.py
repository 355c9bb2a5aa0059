"""The Digital Calibration Certificate: a result in a laboratory's name (DCC 3.3.0).

A certificate contains only what the result and the laboratory state: a coefficient that the records
do not determine is named as such, and missing data of the laboratory is an error.

- `lab`: the laboratory's data, ``LAB.toml``
- `issuing`: write a result's certificate, and read its file
- `issue_steps`: steps that these certificates and those of centrifuges share
- `build`: the document, set by the template `assets/certificate.xml.jinja`
- `statements`: its claims; `certificate_text`: the sentences, and coverage factors; `pdf_pages`:
  the pages of the PDF
- `schema`: the text and numbers of its XML, and validation
- `conversion`: the numbers in SI, with the remaining uncertainty of g, and no U below the
  laboratory's capability
- `completeness`: the data that a certificate lacks; with any it is a draft
- `logo`: the laboratory's logo, checked and read
- `codes`: codes of countries and languages in force
- `evidence`: the bounds of terms that were assumed perfect
- `amendment`: the replacement of an issued certificate
- `ledger`: the append-only ledger of an instrument: results, certificates and amendments, one line
  each
- `signers`: keys and commands that sign; `signature`: of the XML and of the pages (PAdES)
- `certificate_reader`: the numbers of a written certificate, XML or PDF
"""

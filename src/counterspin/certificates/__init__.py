"""Digital Calibration Certificate of a result, issued by a laboratory (DCC 3.3.0).

A certificate contains only data of the result and of the laboratory. It marks a coefficient that
the records do not determine, and missing laboratory data are an error.

- `lab`: laboratory data, ``LAB.toml``
- `issuing`: issue the certificate of a result, and check certificate files
- `issue_steps`: steps that are common to certificates of results and of centrifuges
- `build`: the document, from the template `assets/certificate.xml.jinja`
- `statements`: the statements; `certificate_text`: sentences and coverage factors; `pdf_pages`:
  pages of the PDF
- `schema`: text and numbers of the XML, and validation
- `conversion`: numbers in SI with the remaining uncertainty of g; U is at least the CMC
- `completeness`: missing data; a certificate with missing data is a draft
- `logo`: logo of the laboratory
- `codes`: codes of countries and languages in force
- `evidence`: evidence for terms that are fixed at nominal values
- `amendment`: replacement of an issued certificate
- `ledger`: append-only ledger of an instrument with results, certificates and amendments
- `signers`: keys and signing commands; `signature`: signatures of XML and pages (PAdES)
- `certificate_reader`: numbers of an existing certificate, XML or PDF
"""

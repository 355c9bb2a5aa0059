"""The example documents belong to the example result; `make pictures` makes them again."""

from pathlib import Path

import pytest

from counterspin.calibration.pages.document import full_report_blocks
from counterspin.calibration.result import Result
from counterspin.certificates.certificate_reader import read_certificate
from counterspin.reports.blocks import Paragraph, expand_cards

EXAMPLES = Path(__file__).parents[1] / "docs" / "examples" / "three-rate"
RESULT = Result.read(EXAMPLES / "result.json")


def test_report_contains_identifier_and_answers():
    page = (EXAMPLES / "report.html").read_text(encoding="utf-8")
    assert RESULT.identifier in page
    blocks = expand_cards(full_report_blocks(RESULT))
    answers = [b.text for b in blocks if isinstance(b, Paragraph) and b.style == "answer"]
    assert len(answers) == 2
    for answer in answers:
        value, unit = answer.split(" = ")[1].rsplit(" ", 1)
        assert f"<strong>{value}</strong> <span>{unit}</span>" in page


def test_pdf_contains_identifier():
    from pypdf import PdfReader

    pages = PdfReader(EXAMPLES / "report.pdf").pages
    for page in pages:
        assert RESULT.identifier in page.extract_text()


def test_pdf_certificate_has_xml_attachment():
    from pypdf import PdfReader

    ((_, (attached,)),) = PdfReader(EXAMPLES / "certificate.pdf").attachments.items()
    assert attached == (EXAMPLES / "certificate.xml").read_bytes()


def test_certificate_values_match_result():
    read = read_certificate((EXAMPLES / "certificate.xml").read_bytes(), "certificate.xml")
    for name, accelerometer in RESULT.accelerometers.items():
        certified = read.accelerometers[name].coefficients["K_II"]
        own = accelerometer.coefficients["K_II"]
        assert certified.value == pytest.approx(own.value, rel=1e-12)
        assert certified.u == pytest.approx(own.u, rel=1e-12)

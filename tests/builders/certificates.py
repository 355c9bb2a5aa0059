"""A laboratory's file for the tests of certificates, and certificates made with it."""

import os
import re
from datetime import UTC, datetime
from pathlib import Path

import pytest
from lxml import etree

from counterspin.certificates.build import build_document, serialize_document
from counterspin.certificates.lab import read_lab, write_example
from counterspin.certificates.schema import NAMESPACES
from counterspin.certificates.statements import Issue

LAB = """
schema = 1

[certificate]
language = "de"
begin = 2026-01-12
end = 2026-01-14
traceability = "Rückgeführt auf das SI."
remarks = ["Bemerkung."]

[laboratory]
name = "Kalibrierlabor"
city = "Braunschweig"
country = "DE"
code = "D-K-1"

[customer]
name = "Kunde"
street = "Weg"
number = "7"
post_code = "12345"
city = "Ort"
email = "kunde@example.org"

[item]
name = "Plattform"
manufacturer = "Werk"
model = "P-1"
serial_number = "0815"

[[persons]]
name = "A. Erste"
role = "Leitung"

[[persons]]
name = "B. Zweite"
role = "Vertretung"

[conditions]
temperature = "20.5 ± 0.25 degC"
"""

#: The published schema of DCC, where there is one: it is not part of the project.
DEFAULT_SCHEMA = Path(__file__).parents[3] / "shared" / "dcc"
SCHEMA = Path(os.environ.get("COUNTERSPIN_DCC_SCHEMA") or DEFAULT_SCHEMA)

needs_schema = pytest.mark.skipif(
    not SCHEMA.exists(),
    reason="the schema of DCC is not here: name its folder in COUNTERSPIN_DCC_SCHEMA",
)

ISSUE = Issue("CS-42", datetime(2026, 1, 20, tzinfo=UTC))


def write_lab(folder: Path, text: str = LAB) -> Path:
    """Write the laboratory's file."""
    path = folder / "LAB.toml"
    path.write_text(text, encoding="utf-8")
    return path


def read_lab_for(folder, result, text=LAB):
    """Write the laboratory's file and read it for a result."""
    return read_lab(write_lab(folder, text), result)[0]


def make_document(folder, result, *, text=LAB, verdicts=None, issue=ISSUE, pages=b"%PDF-1.7"):
    """Return a certificate as bytes."""
    lab = read_lab_for(folder, result, text)
    return serialize_document(build_document(result, lab, issue, verdicts or {}, pages))


def find_elements(document_bytes, path):
    """Return the elements that match an XPath."""
    return etree.fromstring(document_bytes).xpath(path, namespaces=NAMESPACES)


def write_filled_template(path, keep=()):
    """Write the filled-in template of a laboratory's file and return its path.

    The campaigns of the tests take what they do not state as perfect.

    keep: Words of the template; a line with one of them stays.
    """
    text = write_example(path).read_text(encoding="utf-8")
    replacements = {
        "(?i)xample": "wn",
        "2000-01-0": "2026-01-1",
        "AQ": "DE",
        "EX-1": "IP-3",
        "00000": "12345",
    }
    replacements |= {'"0"': '"12"'}

    def fill_line(line):
        for old, new in replacements.items():
            line = re.sub(old, new, line)
        return line

    lines = [
        line if any(word in line for word in keep) else fill_line(line)
        for line in text.splitlines()
    ]
    text = "\n".join(lines).replace("# temperature", "temperature")
    path.write_text(text + '\n\n[evidence]\nall = "Type test 4714."\n', encoding="utf-8")
    return path

"""The pages on results table every part of their JSON, and explain every finding."""

import re
from pathlib import Path

import key_tables
from counterspin.calibration import result
from counterspin.error_codes import CODES

DOCS = Path(__file__).parents[1] / "docs"
PAGE = (DOCS / "result.md").read_text(encoding="utf-8")
SCHEMA = result.Result.json_schema()
PARTS = SCHEMA["$defs"] | {"Result": SCHEMA}


def test_every_section_of_result_has_table():
    tables = {
        name
        for page in DOCS.glob("*.md")
        for name in re.findall(r"^<!-- fields: (\w+) -->$", page.read_text("utf-8"), re.MULTILINE)
    }
    assert tables == set(key_tables.RESULT_CLASSES)


def test_every_finding_code_is_explained():
    package = Path(result.__file__).parents[1]
    sources = (path.read_text(encoding="utf-8") for path in package.rglob("*.py"))
    codes = {code for source in sources for code in re.findall(r'\bcode="([\w-]+)"', source)}
    section = PAGE[PAGE.index("### Findings") : PAGE.index("### Coefficients")]
    rows = re.findall(r"^\| (`[a-z-]+`(?:, `[a-z-]+`)*) \|", section, re.MULTILINE)
    explained = {code for row in rows for code in re.findall(r"`([\w-]+)`", row)}
    fields = set(PARTS["Finding"]["properties"])
    assert explained - fields == codes - (set(CODES) - explained)


def test_internal_links_have_existing_headings():
    headings = re.findall(r"^#+ (.*)$", PAGE, re.MULTILINE)
    anchors = {re.sub(r"[^\w -]", "", heading).lower().replace(" ", "-") for heading in headings}
    assert set(re.findall(r"\]\(#([\w-]+)\)", PAGE)) <= anchors

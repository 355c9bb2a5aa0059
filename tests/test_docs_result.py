"""The page on the result file tables every part of the JSON, and explains every finding."""

import re
from pathlib import Path

from counterspin.calibration import result

PAGE = (Path(__file__).parents[1] / "docs" / "result.md").read_text(encoding="utf-8")
SCHEMA = result.Result.json_schema()
PARTS = SCHEMA["$defs"] | {"Result": SCHEMA}
TABLES = re.findall(r"^<!-- fields: (\w+) -->$", PAGE, re.MULTILINE)


def test_every_part_has_its_table():
    assert sorted(TABLES) == sorted(PARTS)


def test_every_code_of_a_finding_is_explained():
    package = Path(result.__file__).parents[1]
    sources = (path.read_text(encoding="utf-8") for path in package.rglob("*.py"))
    codes = {code for source in sources for code in re.findall(r'\bcode="([\w-]+)"', source)}
    section = PAGE[PAGE.index("### Findings") : PAGE.index("### Coefficients")]
    rows = re.findall(r"^\| (`[a-z-]+`(?:, `[a-z-]+`)*) \|", section, re.MULTILINE)
    explained = {code for row in rows for code in re.findall(r"`([\w-]+)`", row)}
    fields = set(PARTS["Finding"]["properties"])
    assert explained - fields == codes


def test_links_inside_the_page_lead_to_headings():
    headings = re.findall(r"^#+ (.*)$", PAGE, re.MULTILINE)
    anchors = {re.sub(r"[^\w -]", "", heading).lower().replace(" ", "-") for heading in headings}
    assert set(re.findall(r"\]\(#([\w-]+)\)", PAGE)) <= anchors

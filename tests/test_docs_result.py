"""The page on the result file has every key of the JSON, and no other."""

import re
from pathlib import Path

import pytest

from counterspin.calibration import result

PAGE = (Path(__file__).parents[1] / "docs" / "result.md").read_text(encoding="utf-8")
SCHEMA = result.Result.json_schema()
PARTS = SCHEMA["$defs"] | {"Result": SCHEMA}
TABLES = dict(re.findall(r"^<!-- fields: (\w+) -->\n((?:\|.*\n)+)", PAGE, re.MULTILINE))


def test_every_part_has_its_table():
    assert set(TABLES) == set(PARTS)


@pytest.mark.parametrize("name", TABLES)
def test_keys_are_those_of_the_code(name):
    listed = re.findall(r"^\| `(\w+)` \|", TABLES[name], re.MULTILINE)
    assert listed == list(PARTS[name]["properties"])


@pytest.mark.parametrize("name", TABLES)
def test_units_that_are_fixed_are_those_of_the_code(name):
    for key, field in PARTS[name]["properties"].items():
        if key.endswith("_unit"):
            assert f"| `{key}` | text | `{field['default']}` |" in TABLES[name]


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

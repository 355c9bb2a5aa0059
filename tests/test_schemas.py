"""The schemas describe every key, accept every example of the documentation, and see slips."""

import json
import re
import tomllib
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from json_schema import find_violations

import counterspin as cs
from counterspin.calibration.result import Result
from counterspin.cli import main
from counterspin.schemas import RESULT_CLASSES, SchemaName, make_schema, schema_text

ROOT = Path(__file__).parents[1]
PAGES = {
    page.name: page.read_text("utf-8")
    for page in [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]
}
NAMES = get_args(SchemaName)
#: Made when they are asked for: they take as long as a fifth of all that tests import.
made = cache(make_schema)

#: Blocks of TOML in the documentation, each with its page.
BLOCKS = [
    pytest.param(tomllib.loads(text), id=f"{name}-{place}")
    for name, page in PAGES.items()
    for place, text in enumerate(re.findall(r"^```toml\n(.*?)^```", page, re.MULTILINE | re.DOTALL))
]
STARTERS = [
    ("campaign", "ingest/starter.toml"),
    ("campaign", "ingest/starter_tumble.toml"),
    ("campaign", "ingest/starter_arm.toml"),
    ("campaign", "reproduction/paper.toml"),
    ("plan", "planning/starter.toml"),
    ("lab", "certificates/starter.toml"),
]

every_schema = pytest.mark.parametrize("name", NAMES)


def kind_of(document):
    """Return the kind of a document or fragment in the documentation."""
    if "goal" in document or "stations" in document:
        return "plan"
    return "lab" if {"certificate", "laboratory", "evidence", "cmc"} & set(document) else "campaign"


def keys(schema, path=""):
    """Yield path and schema of every key."""
    for word in ("properties", "$defs"):
        for key, inner in schema.get(word, {}).items():
            if word == "properties":
                yield f"{path}.{key}", inner
            yield from keys(inner, f"{path}.{key}")
    for branch in {"then", "else"} & set(schema):
        yield from keys(schema[branch], f"{path}.{branch}")


@pytest.mark.parametrize(
    ("schema", "right", "wrong"),
    [
        ({"type": "integer"}, 1, True),
        ({"type": "integer"}, 1, 1.5),
        ({"type": "string", "pattern": "^a"}, "ab", "ba"),
        ({"enum": ["a"]}, "a", "b"),
        ({"const": 1}, 1, True),
        ({"properties": {"a": {"type": "string"}}}, {"b": 1}, {"a": 1}),
        ({"properties": {"a": True}, "additionalProperties": False}, {"a": 1}, {"b": 1}),
        ({"required": ["a"]}, {"a": 1}, {}),
        ({"items": {"minimum": 2}, "minItems": 1}, [2], [1]),
        ({"minItems": 1, "maxItems": 1}, [1], []),
        ({"anyOf": [{"type": "string"}, {"type": "null"}]}, None, 1),
        ({"if": {"required": ["a"]}, "then": {"required": ["b"]}}, {"a": 1, "b": 1}, {"a": 1}),
        ({"$ref": "#/$defs/T", "$defs": {"T": {"maximum": 1}}}, 1, 2),
    ],
)
def test_validator_accepts_valid_and_rejects_invalid(schema, right, wrong):
    assert list(find_violations(schema, right)) == []
    assert list(find_violations(schema, wrong))


@every_schema
def test_every_key_has_description(name):
    described = dict(keys(made(name)))
    assert len(described) > 10
    for path, schema in described.items():
        if "description" not in schema and "$ref" in schema:
            schema = made(name)["$defs"][schema["$ref"].rpartition("/")[2]]  # noqa: PLW2901
        assert schema.get("description"), path
        assert not re.search(r"\]\(|\n", schema["description"]), path


@pytest.mark.slow
@every_schema
def test_schema_has_identifier_and_is_printed_unchanged(name, capsys):
    assert made(name)["$schema"] == "https://json-schema.org/draft/2020-12/schema"
    assert made(name)["$id"].startswith(f"urn:counterspin:schema:{name}:")
    assert made(name)["title"]
    assert main(["schema", name]) == 0
    assert capsys.readouterr().out == schema_text(name)
    assert json.loads(schema_text(name)) == made(name)


@pytest.mark.parametrize("name", [name for name in NAMES if name not in RESULT_CLASSES])
def test_every_key_has_valid_example(name):
    shown = 0
    for path, schema in keys(made(name)):
        for example in schema.get("examples", ()):
            shown += 1
            assert list(find_violations(schema, example, path, made(name))) == []
    assert shown > 3


def test_quantity_has_type_string():
    assert "Quantity" not in made("campaign")["$defs"]


def test_quantities_have_unit():
    site = made("campaign")["$defs"]["SiteSettings"]["properties"]
    assert site["latitude"]["x-unit"] == "rad"
    assert site["gravity"]["x-unit"] == "m/s^2"
    assert "pattern" in site["gravity"]["anyOf"][0]


@pytest.mark.parametrize("document", BLOCKS)
def test_documentation_examples_match_schema(document):
    schema = made(kind_of(document))
    if "schema" not in document:  # a part of a document
        branch = "then" if "stations" in document else "else"
        schema = {**schema, **schema.get(branch, {}), "required": []}
        schema = {word: said for word, said in schema.items() if word not in ("if", "then", "else")}
    assert list(find_violations(schema, document)) == []


@pytest.mark.parametrize(("name", "file"), STARTERS)
def test_starters_match_schema(name, file):
    text = (files("counterspin") / file).read_text("utf-8")
    assert list(find_violations(made(name), tomllib.loads(text))) == []


SLIPS = [
    ('gravity = "9.8066 ± 1e-5 m/s^2"', "gravity = 9.8066"),
    ('gravity = "9.8066 ± 1e-5 m/s^2"', 'gravity = "9.8066"'),
    ('gravity = "9.8066 ± 1e-5 m/s^2"', 'gravitiy = "9.8066 m/s^2"'),
    ("schema = 1", "schema = 2"),
    ('input_axis = "east"', 'input_axis = "eastward"'),
    ("[noise]", "[noize]"),
    ("revolutions = ", "revolution = "),
]


@pytest.mark.parametrize(("old", "new"), SLIPS)
def test_invalid_entry_is_detected(old, new):
    text = (files("counterspin") / "ingest/starter.toml").read_text("utf-8")
    assert old in text
    assert list(find_violations(made("campaign"), tomllib.loads(text.replace(old, new, 1))))


def test_result_matches_schema():
    file = ROOT / "docs" / "examples" / "three-rate" / "result.json"
    document = json.loads(Result.read(file).to_json())
    assert list(find_violations(made("result"), document)) == []
    assert list(find_violations(made("result"), document | {"method": 1}))


def test_noise_result_matches_schema():
    force = np.random.default_rng(7).normal(0.0, 1e-4, 2000)
    noise = cs.noise({"time_s": np.arange(2000) / 50.0, "f": force}, columns=["f"], unit="m/s^2")
    document = json.loads(noise.to_json())
    assert list(find_violations(made("noise"), document)) == []
    assert list(find_violations(made("noise"), document | {"signals": [{"name": "f"}]}))


def test_init_writes_schema_of_description(tmp_path):
    assert main(["init", str(tmp_path)]) == 0
    first = (tmp_path / "campaign.toml").read_text("utf-8").splitlines()[0]
    schema = tmp_path / first.removeprefix("#:schema ")
    assert schema.read_text("utf-8") == schema_text("campaign")


def test_site_contains_every_schema(monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(str(ROOT / "docs" / "extensions"))
    import published_schemas

    monkeypatch.setattr(published_schemas, "_SITE_FILES", tmp_path)
    folder = published_schemas.write_schemas() / "schemas"
    assert {file.stem for file in folder.iterdir()} == set(NAMES)
    assert (folder / "plan.json").read_text("utf-8") == schema_text("plan")

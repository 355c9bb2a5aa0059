"""Publish the schemas of all documents with the site: schemas/campaign.json and so on."""

from pathlib import Path
from typing import get_args

from counterspin.schemas import SchemaName, schema_text

_SITE_FILES = Path(__file__).parents[2] / "build" / "extra"


def write_schemas() -> Path:
    """Write the schemas; return the folder that contains schemas/."""
    folder = _SITE_FILES / "schemas"
    folder.mkdir(parents=True, exist_ok=True)
    for name in get_args(SchemaName):
        (folder / f"{name}.json").write_text(schema_text(name), encoding="utf-8")
    return _SITE_FILES

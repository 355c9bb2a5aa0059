"""The schemas of all documents as files of the site: schemas/campaign.json and so on."""

from pathlib import Path
from typing import get_args

from counterspin.schemas import SchemaName, schema_text

_BUILD = Path(__file__).parents[2] / "build" / "extra"


def published() -> Path:
    """Write the schemas, and return the folder that holds theirs."""
    folder = _BUILD / "schemas"
    folder.mkdir(parents=True, exist_ok=True)
    for name in get_args(SchemaName):
        (folder / f"{name}.json").write_text(schema_text(name), encoding="utf-8")
    return _BUILD

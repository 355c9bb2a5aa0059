"""`counterspin schema`: the JSON Schema of a document, by which editors explain and check it."""

from __future__ import annotations

from typing import Literal


def schema(document: Literal["campaign", "plan", "study", "lab", "result", "noise"], /) -> None:
    """Print the JSON Schema (draft 2020-12) of a document, for editors and other programs.

    Every key has its meaning, its unit and an example. A document names its schema in its first
    line, `#:schema campaign.schema.json`; editors with TOML support then explain keys, complete
    them and mark mistakes. Conditions that involve several keys are checked by counterspin only.

    Parameters
    ----------
    document
        campaign.toml, PLAN.toml, a study's own file, LAB.toml, or the result of `calibrate --json`
        or of `noise --json`.
    """
    from counterspin.schemas import schema_text

    print(schema_text(document), end="")

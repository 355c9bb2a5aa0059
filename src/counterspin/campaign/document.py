"""The sections of ``campaign.toml``: which there may be, and the class that each is read by."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field

from counterspin.campaign.accelerometers import AccelerometerKeys
from counterspin.campaign.checking import Section
from counterspin.campaign.columns import RecordsSettings
from counterspin.campaign.kinds import Schema, SettingsSection, described
from counterspin.campaign.readings_table import ReadingsSettings
from counterspin.campaign.runs import Run
from counterspin.campaign.settings import (
    CampaignSettings,
    CentrifugeSettings,
    FixtureSettings,
    ModelSettings,
    NoiseSettings,
    SiteSettings,
)
from counterspin.campaign.specification import SpecificationSettings
from counterspin.campaign.triads.declared import TriadSettings
from counterspin.campaign.truth_tables import Simulation, TruthSettings

#: Tables of accelerometers, by name.
Accelerometers = Annotated[
    dict[str, Any],
    Field(min_length=1),
    Section(dict[str, AccelerometerKeys]),  # type: ignore[valid-type]
]
Runs = Annotated[list[Any], Section(list[Run])]


class CampaignDocument(SettingsSection):
    """All tables; a key that is not here is a mistake."""

    schema_version: Schema = described("version of this format", 1, kind="number", alias="schema")
    campaign: Annotated[dict[str, Any], Section(CampaignSettings)] = described(
        "[what a report says](#campaign)", {}, {}
    )
    site: Annotated[dict[str, Any], Section(SiteSettings)] = described("[where](#site)", {})
    centrifuge: Annotated[dict[str, Any] | None, Section(CentrifugeSettings)] = described(
        "[its size](#centrifuge); required unless all is [read or recorded at rest](readings.md)",
        {},
        None,
    )
    fixture: Annotated[dict[str, Any] | None, Section(FixtureSettings)] = described(
        "[how well positions are set](#fixture)", {}, None
    )
    triad: Annotated[dict[str, Any] | None, Section(TriadSettings)] = described(
        "[three accelerometers of one sensor](triads.md)", {}, None
    )
    records: Annotated[dict[str, Any] | None, Section(RecordsSettings)] = described(
        "[how to read the files](#records); required where a run has a record", {}, None
    )
    accelerometers: Accelerometers = described(
        "[one for each accelerometer](#accelerometersname)",
        {"Qx": {"input_axis": "east", "pendulous_axis": "down"}},
        kind="tables",
    )
    noise: Annotated[dict[str, Any] | None, Section(NoiseSettings)] = described(
        "[noise of the records](#noise)", {}, None, absent="estimated"
    )
    model: Annotated[dict[str, Any] | None, Section(ModelSettings)] = described(
        "[what is asked for, and what is known](#model)", {}, None, absent="the paper's terms"
    )
    readings: Annotated[dict[str, Any] | None, Section(ReadingsSettings)] = described(
        "[a table of single values](readings.md)", {}, None
    )
    runs: Runs = described(
        "[one for each run](#runs), or [reading](readings.md)",
        [{"name": "run1", "rate": "0.25 rev/s", "record": "run1.csv"}],
        [],
        kind="list of tables",
    )
    specification: Annotated[dict[str, Any] | None, Section(SpecificationSettings)] = described(
        "[limits that coefficients shall meet](#specification)", {}, None
    )
    simulation: Annotated[dict[str, Any] | None, Section(Simulation)] = described(
        "[sampling, for `simulate`](#simulation)", {}, None
    )
    truth: Annotated[dict[str, Any] | None, Section(TruthSettings)] = described(
        "[true values, for `simulate`](#truth)", {}, None
    )
    study: dict[str, Any] | None = described(
        "[what varies and what competes, for `study`](study.md)", {}, None
    )

"""Sections of ``campaign.toml``, resolved together to the attributes of a campaign."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

from pydantic import BaseModel, Field

from counterspin.campaign.accelerometers import AccelerometerKeys, AccelerometersReader
from counterspin.campaign.columns import Recording, RecordsSettings
from counterspin.campaign.consistency_checks import run_checks
from counterspin.campaign.documents import KeyPath, list_of, table_of
from counterspin.campaign.field_types import Schema, SettingsSection, key_field
from counterspin.campaign.frequency_response import ResponseReader
from counterspin.campaign.model import MeasurementSetup, resolve_model
from counterspin.campaign.quantity import Quantity
from counterspin.campaign.reading import DescribedReadings, Reading
from counterspin.campaign.runs import (
    Run,
    included_runs,
    is_reading,
    recorders_of,
    resolve_runs,
    skipped_runs,
)
from counterspin.campaign.settings import (
    CampaignSettings,
    CentrifugeSettings,
    FixtureSettings,
    ModelSettings,
    NoiseSettings,
    SiteSettings,
)
from counterspin.campaign.validation import Problems, Section
from counterspin.loading import is_installed, load_name
from counterspin.physics.motion import Site
from counterspin.records.record import ColumnSpec

if TYPE_CHECKING:
    from counterspin.campaign.simulated_truth import Simulation
    from counterspin.campaign.specification import Specifications


#: Recording of a campaign without records.
NO_RECORDING: Final = Recording(ColumnSpec("", unit="s"), None)

#: Tables of accelerometers, by name.
Accelerometers = Annotated[
    dict[str, Any], Field(min_length=1), Section(dict[str, AccelerometerKeys])  # type: ignore[valid-type]
]
Runs = Annotated[list[Any], Section(list[Run])]


_READINGS: Final = "counterspin.readings.section:ReadingsSettings"
_READINGS_READER: Final = "counterspin.readings.description:read_readings"
_TRIAD_SECTION: Final = "counterspin.triads.section"
_TRIAD: Final = f"{_TRIAD_SECTION}:TriadSettings"
_SPECIFICATION: Final = "counterspin.campaign.specification:Specifications"
_TRUTH_READER: Final = "counterspin.campaign.simulated_truth"
_SIMULATION: Final = f"{_TRUTH_READER}:Simulation"
_TRUTH: Final = "counterspin.campaign.truth:TruthSettings"


class CampaignDocument(SettingsSection):
    """The top-level tables of ``campaign.toml``."""

    schema_version: Schema = key_field("version of this format", 1, kind="number", alias="schema")
    campaign: Annotated[dict[str, Any], Section(CampaignSettings)] = key_field(
        "[title and identification data for the reports](#campaign)", {}, {}
    )
    site: Annotated[dict[str, Any], Section(SiteSettings)] = key_field(
        "[location of the centrifuge](#site)", {}
    )
    centrifuge: Annotated[dict[str, Any] | None, Section(CentrifugeSettings)] = key_field(
        "[dimensions of the centrifuge](#centrifuge); required unless all runs are [readings or "
        "records at rest](readings.md)",
        {},
        None,
    )
    fixture: Annotated[dict[str, Any] | None, Section(FixtureSettings)] = key_field(
        "[uncertainty of positions at rest](#fixture)", {}, None
    )
    triad: Annotated[dict[str, Any] | None, Section(_TRIAD)] = key_field(
        "[three accelerometers of one sensor](triads.md)", {}, None
    )
    records: Annotated[dict[str, Any] | None, Section(RecordsSettings)] = key_field(
        "[format of the record files](#records); required if a run has a record", {}, None
    )
    accelerometers: Accelerometers = key_field(
        "[a table for each accelerometer](#accelerometersname)",
        {"Qx": {"input_axis": "east", "pendulous_axis": "down"}},
        kind="tables",
    )
    noise: Annotated[dict[str, Any] | None, Section(NoiseSettings)] = key_field(
        "[noise of the records](#noise)", {}, None, absent="estimated"
    )
    model: Annotated[dict[str, Any] | None, Section(ModelSettings)] = key_field(
        "[requested terms and prior information](#model)", {}, None, absent="the paper's terms"
    )
    readings: Annotated[dict[str, Any] | None, Section(_READINGS)] = key_field(
        "[table of readings](readings.md)", {}, None
    )
    runs: Runs = key_field(
        "[a table for each run](#runs) or [reading](readings.md)",
        [{"name": "run1", "rate": "0.25 rev/s", "record": "run1.csv"}],
        [],
        kind="list of tables",
    )
    specification: Annotated[dict[str, Any] | None, Section(_SPECIFICATION)] = key_field(
        "[limits for the coefficients](#specification)", {}, None
    )
    simulation: Annotated[dict[str, Any] | None, Section(_SIMULATION)] = key_field(
        "[sampling, for `simulate`](#simulation)", {}, None
    )
    truth: Annotated[dict[str, Any] | None, Section(_TRUTH)] = key_field(
        "[true values, for `simulate`](#truth)", {}, None
    )
    study: dict[str, Any] | None = key_field(
        "[varied quantities and compared analyses, for `study`](study.md)", {}, None
    )


class DescriptionReader:
    """Reads one document; each section is checked even where another one is wrong."""

    def __init__(self, raw: Mapping[str, Any], file: Path, problems: Problems) -> None:
        self.raw, self.file, self.problems = raw, file, problems
        problems.check(CampaignDocument, raw, ())
        runs = list_of(raw, "runs")
        indexed_runs, tables = included_runs(runs), table_of(raw, "accelerometers")
        #: Name -> valid section or resolved value; None for a missing table.
        self.sections: dict[str, Any] = {
            "document": raw,
            "indexed_runs": indexed_runs,
            "tables": tables,
        }
        for key, model in (
            ("campaign", CampaignSettings),
            ("site", SiteSettings),
            ("centrifuge", CentrifugeSettings),
            ("records", RecordsSettings),
            ("fixture", FixtureSettings),
        ):
            self._read_section(key, model)
        # A default gravity avoids consequential errors if the site is missing.
        site = self.sections.get("site")
        self.gravity = site.gravity.value if site else 9.80665
        self._read_section("noise", NoiseSettings, gravity=self.gravity)
        self.is_simulated = "simulation" in raw or "truth" in raw
        self.skipped_names = skipped_runs(runs)
        self.accelerometers = AccelerometersReader(
            self._complete_tables(tables), [run for _, run in indexed_runs], problems, self.gravity
        )

    def _read_section(self, key: str, model: type[BaseModel], **context: object) -> None:
        """Read a section; a missing required section has already been reported."""
        value = self.raw.get(key)
        if key not in self.raw:
            self.sections[key] = None
        elif isinstance(value, dict):
            section = self.problems.check(model, value, (key,), **context)
            if section is not None:
                self.sections[key] = section

    def resolve_attributes(self) -> dict[str, Any] | None:
        """Return the attributes of a `Campaign`, or None if there are problems."""
        problems, gravity, sections, raw = self.problems, self.gravity, self.sections, self.raw
        centrifuge, records = sections.get("centrifuge"), sections.get("records")
        fixture = sections.get("fixture") or FixtureSettings()
        observables = sections["observables"] = self.accelerometers.find_observables()
        settings = problems.check(ModelSettings, table_of(raw, "model"), ("model",))
        revolutions = self._read_sampling().revolutions if self.is_simulated else None
        folder = self.file.parent
        resolved_runs = sections["runs"] = resolve_runs(
            sections["indexed_runs"], folder, table_of(raw, "records"), revolutions, problems
        )
        recording = records.recording if records else NO_RECORDING
        own_priors = self.accelerometers.own_priors
        described_readings = self._read_readings(revolutions, has_records=bool(resolved_runs))
        readings = sections["valid_readings"] = described_readings.readings
        priors = own_priors
        # After a mistake that hides all readings, their terms must not be reported as unknown.
        is_complete = described_readings.is_complete and not (
            problems.lines and not readings and ("readings" in raw or not resolved_runs)
        )
        if settings is not None:
            setup = MeasurementSetup(
                self.accelerometers.mountings,
                self.accelerometers.grades,
                [run.attitude for run in resolved_runs.values()],
                readings,
                described_readings.triad.count if described_readings.triad else 0,
                centrifuge,
                fixture.position,
                is_complete,
            )
            sections["model"], priors = resolve_model(
                settings, own_priors, setup, problems, gravity
            )
            sections["recorded_temperatures"] = {
                run.name
                for run in resolved_runs.values()
                if (run.recording or recording).temperature
            }
        simulation = self._resolve_simulation(
            resolved_runs,
            readings if is_complete else None,
            described_readings.truths,
        )
        specifications = self._resolve_specifications()
        cutoff = records.cutoff_frequency if records else None
        responses = ResponseReader(folder, cutoff, problems)
        accelerometers = self.accelerometers.build_accelerometers(observables, priors, responses)
        sections["accelerometers"] = accelerometers
        run_checks(sections, problems)
        if problems.lines:
            return None
        # No problem noted: every section is there.
        site, campaign_section = sections["site"], sections["campaign"] or CampaignSettings()
        return dict(  # noqa: C408 -- as the arguments of a class
            title=campaign_section.title or folder.name,
            path=self.file,
            folder=folder,
            site=Site(
                site.gravity.value, site.latitude.value, removed_gravity=site.removed_gravity
            ),
            gravity=site.gravity,
            latitude=site.latitude,
            radius=centrifuge.radius if centrifuge else Quantity(0.0, 0.0, "m"),
            strapped=centrifuge is not None and centrifuge.strapped,
            time=recording.time,
            angle=recording.angle,
            dialect=recording.dialect,
            temperature=recording.temperature,
            skipped=self.skipped_names,
            timing_offset=records.timing_offset if records else None,
            clock=records.clock if records else None,
            rate_clock=centrifuge.clock if centrifuge else None,
            own_velocity=records is not None and records.reference == "own velocity",
            accelerometers=accelerometers,
            noise=sections["noise"],
            model=sections["model"],
            runs=tuple(resolved_runs.values()),
            simulation=simulation,
            details=campaign_section.model_dump(exclude={"title"}, exclude_none=True),
            specifications=specifications,
            readings=readings,
            reference_temperature=centrifuge.reference_temperature if centrifuge else None,
            tables=(*described_readings.files, *responses.checksums),
            table_checksums={**described_readings.checksums, **responses.checksums},
            triad=described_readings.triad,
        )

    def _read_readings(self, revolutions: float | None, *, has_records: bool) -> DescribedReadings:
        """Return the readings, poses and triad; empty if the document has none."""
        has_readings = any(is_reading(run) for _, run in self.sections["indexed_runs"])
        if not has_readings and not {"readings", "triad"} & self.raw.keys():
            return DescribedReadings()
        if not is_installed(_READINGS_READER):
            self.problems.add(
                ("runs",), "this installation cannot read tables of readings", "missing-package"
            )
            return DescribedReadings(is_complete=False)
        described_readings: DescribedReadings = load_name(_READINGS_READER)(
            self, revolutions, has_records=has_records
        )
        return described_readings

    def _complete_tables(self, tables: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return the accelerometer tables, with default axes for a triad that states none."""
        if "triad" not in self.raw or not is_installed(_TRIAD):
            return tables
        completed_tables: Mapping[str, Any] = load_name(f"{_TRIAD_SECTION}:apply_default_axes")(
            tables, self.raw["triad"]
        )
        return completed_tables

    def _resolve_simulation(
        self,
        runs: Mapping[int, Run],
        readings: Sequence[Reading] | None,
        truths: Mapping[str, tuple[Mapping[str, Any], KeyPath]],
    ) -> Simulation | None:
        """Return the settings of simulated records; parameters as in `DescribedRuns`."""
        if not self.is_simulated:
            return None
        reader_class = load_name(f"{_TRUTH_READER}:TruthReader")
        recorders = recorders_of(table_of(self.raw, "records"), list(runs.values()))
        names = list(self.accelerometers.raw)
        reader = reader_class(table_of(self.raw, "truth"), names, self.problems, self.gravity)
        noise, centrifuge = self.sections.get("noise"), self.sections.get("centrifuge")
        outputs = self.accelerometers.outputs
        described_runs = load_name(f"{_TRUTH_READER}:DescribedRuns")(runs, readings, truths)
        simulation: Simulation | None = reader.simulation(
            self._read_sampling(), outputs, noise, described_runs, centrifuge, recorders
        )
        return simulation

    def _read_sampling(self) -> Simulation:
        settings_class, raw = load_name(_SIMULATION), table_of(self.raw, "simulation")
        sampling: Simulation = (
            self.problems.check(settings_class, raw, ("simulation",)) or settings_class()
        )
        return sampling

    def _resolve_specifications(self) -> Specifications | None:
        if not isinstance(self.raw.get("specification"), dict):
            return None
        resolve_function = load_name("counterspin.campaign.specification:resolve_specifications")
        specifications: Specifications | None = resolve_function(
            self.raw["specification"],
            self.accelerometers.raw,
            problems=self.problems,
            gravity=self.gravity,
        )
        return specifications

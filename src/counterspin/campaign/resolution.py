"""The sections of ``campaign.toml``, and what they say together: all mistakes are noted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

from pydantic import BaseModel, Field

from counterspin.campaign.accelerometers import (
    AccelerometerKeys,
    AccelerometersReader,
)
from counterspin.campaign.columns import Recording, RecordsSettings
from counterspin.campaign.consistency_checks import run_checks
from counterspin.campaign.documents import (
    KeyPath,
    list_of,
    table_of,
)
from counterspin.campaign.field_types import Schema, SettingsSection, key_field
from counterspin.campaign.frequency_response import ResponseReader
from counterspin.campaign.model import (
    MeasurementSetup,
    resolve_model,
)
from counterspin.campaign.quantity import Quantity
from counterspin.campaign.reading import DescribedReadings, Reading
from counterspin.campaign.runs import (
    Run,
    is_reading,
    recorders_of,
    resolve_runs,
    skipped_runs,
    taken_runs,
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


#: Of a campaign without records.
NO_RECORDS: Final = Recording(ColumnSpec("", unit="s"), None)

#: Tables of accelerometers, by name.
Accelerometers = Annotated[
    dict[str, Any],
    Field(min_length=1),
    Section(dict[str, AccelerometerKeys]),  # type: ignore[valid-type]
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
    """All tables; a key that is not here is a mistake."""

    schema_version: Schema = key_field("version of this format", 1, kind="number", alias="schema")
    campaign: Annotated[dict[str, Any], Section(CampaignSettings)] = key_field(
        "[heading and identification of the report](#campaign)", {}, {}
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
        listed, tables = taken_runs(runs), table_of(raw, "accelerometers")
        #: Name -> a part of the description that is in order; None of a table that is not there.
        self.parts: dict[str, Any] = {"document": raw, "listed": listed, "tables": tables}
        for key, model in (
            ("campaign", CampaignSettings),
            ("site", SiteSettings),
            ("centrifuge", CentrifugeSettings),
            ("records", RecordsSettings),
            ("fixture", FixtureSettings),
        ):
            self._read(key, model)
        # With some gravity, a missing site is one mistake, and g against m/s^2 no second one.
        site = self.parts.get("site")
        self.gravity = site.gravity.value if site else 9.80665
        self._read("noise", NoiseSettings, gravity=self.gravity)
        self.simulated = "simulation" in raw or "truth" in raw
        self.skipped = skipped_runs(runs)
        self.accelerometers = AccelerometersReader(
            self._tables_with_axes(tables),
            [run for _, run in listed],
            problems,
            self.gravity,
        )

    def _read(self, key: str, model: type[BaseModel], **context: object) -> None:
        """Read a section; a missing required section has already been reported."""
        value = self.raw.get(key)
        if key not in self.raw:
            self.parts[key] = None
        elif isinstance(value, dict):
            made = self.problems.check(model, value, (key,), **context)
            if made is not None:
                self.parts[key] = made

    def attributes(self) -> dict[str, Any] | None:
        """Return the attributes of a `Campaign`, or None if there are problems."""
        problems, gravity, parts, raw = self.problems, self.gravity, self.parts, self.raw
        listed, centrifuge, records = parts["listed"], parts.get("centrifuge"), parts.get("records")
        fixture = parts.get("fixture") or FixtureSettings()
        observables = parts["observables"] = self.accelerometers.observables()
        settings = problems.check(ModelSettings, table_of(raw, "model"), ("model",))
        turns = self._sampling().revolutions if self.simulated else None
        folder = self.file.parent
        placed = parts["runs"] = resolve_runs(
            listed, folder, table_of(raw, "records"), turns, problems
        )
        common = records.recording if records else NO_RECORDS
        given = self.accelerometers.own_priors
        read = self._read_readings(turns, has_records=bool(placed))
        readings = parts["right_readings"] = read.readings
        priors = given
        if settings is not None:
            apparatus = MeasurementSetup(
                self.accelerometers.mountings,
                self.accelerometers.grades,
                [run.attitude for run in placed.values()],
                readings,
                read.triad.count if read.triad else 0,
                centrifuge,
                fixture.position,
                read.whole,
            )
            parts["model"], priors = resolve_model(settings, given, apparatus, problems, gravity)
            parts["recorded_temperatures"] = {
                run.name for run in placed.values() if (run.recording or common).temperature
            }
        simulation = self._simulation(placed, readings if read.whole else None, read.truths)
        specifications = self._specifications()
        cutoff = records.cutoff_frequency if records else None
        responses = ResponseReader(folder, cutoff, problems)
        accelerometers = self.accelerometers.accelerometers(observables, priors, responses)
        parts["accelerometers"] = accelerometers
        run_checks(parts, problems)
        if problems.lines:
            return None
        # No problem noted: every section is there.
        site, info = parts["site"], parts["campaign"] or CampaignSettings()
        return dict(  # noqa: C408 -- as the arguments of a class
            title=info.title or folder.name,
            path=self.file,
            folder=folder,
            site=Site(
                site.gravity.value, site.latitude.value, removed_gravity=site.removed_gravity
            ),
            gravity=site.gravity,
            latitude=site.latitude,
            radius=centrifuge.radius if centrifuge else Quantity(0.0, 0.0, "m"),
            strapped=centrifuge is not None and centrifuge.strapped,
            time=common.time,
            angle=common.angle,
            dialect=common.dialect,
            temperature=common.temperature,
            skipped=self.skipped,
            timing_offset=records.timing_offset if records else None,
            clock=records.clock if records else None,
            rate_clock=centrifuge.clock if centrifuge else None,
            own_velocity=records is not None and records.reference == "own velocity",
            accelerometers=accelerometers,
            noise=parts["noise"],
            model=parts["model"],
            runs=tuple(placed.values()),
            simulation=simulation,
            details=info.model_dump(exclude={"title"}, exclude_none=True),
            specifications=specifications,
            readings=readings,
            reference_temperature=centrifuge.reference_temperature if centrifuge else None,
            tables=(*read.files, *responses.checksums),
            table_checksums={**read.checksums, **responses.checksums},
            triad=read.triad,
        )

    def _read_readings(self, turns: float | None, *, has_records: bool) -> DescribedReadings:
        """Return the readings, poses and triad; none of a document without them."""
        listed = any(is_reading(run) for _, run in self.parts["listed"])
        if not listed and not {"readings", "triad"} & self.raw.keys():
            return DescribedReadings()
        if not is_installed(_READINGS_READER):
            self.problems.add(
                ("runs",), "this installation cannot read tables of readings", "missing-package"
            )
            return DescribedReadings(whole=False)
        read: DescribedReadings = load_name(_READINGS_READER)(self, turns, has_records=has_records)
        return read

    def _tables_with_axes(self, tables: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return the tables of accelerometers, with the usual axes of a triad that states none."""
        if "triad" not in self.raw or not is_installed(_TRIAD):
            return tables
        complete: Mapping[str, Any] = load_name(f"{_TRIAD_SECTION}:with_usual_axes")(
            tables, self.raw["triad"]
        )
        return complete

    def _simulation(
        self,
        runs: Mapping[int, Run],
        readings: Sequence[Reading] | None,
        truths: Mapping[str, tuple[Mapping[str, Any], KeyPath]],
    ) -> Simulation | None:
        """Return the settings of simulated records; parameters as in `DescribedRuns`."""
        if not self.simulated:
            return None
        truth_reader = load_name(f"{_TRUTH_READER}:TruthReader")
        recorders = recorders_of(table_of(self.raw, "records"), list(runs.values()))
        names = list(self.accelerometers.raw)
        truth = truth_reader(table_of(self.raw, "truth"), names, self.problems, self.gravity)
        noise, centrifuge = self.parts.get("noise"), self.parts.get("centrifuge")
        outputs = self.accelerometers.outputs
        described = load_name(f"{_TRUTH_READER}:DescribedRuns")(runs, readings, truths)
        simulation: Simulation | None = truth.simulation(
            self._sampling(), outputs, noise, described, centrifuge, recorders
        )
        return simulation

    def _sampling(self) -> Simulation:
        kind, raw = load_name(_SIMULATION), table_of(self.raw, "simulation")
        sampling: Simulation = self.problems.check(kind, raw, ("simulation",)) or kind()
        return sampling

    def _specifications(self) -> Specifications | None:
        if not isinstance(self.raw.get("specification"), dict):
            return None
        resolve = load_name("counterspin.campaign.specification:resolve_specifications")
        specifications: Specifications | None = resolve(
            self.raw["specification"],
            self.accelerometers.raw,
            problems=self.problems,
            gravity=self.gravity,
        )
        return specifications

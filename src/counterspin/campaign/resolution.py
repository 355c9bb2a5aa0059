"""The sections of ``campaign.toml``, and what they say together: all mistakes are noted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

from pydantic import Field

from counterspin.campaign.accelerometers import (
    AccelerometerKeys,
    AccelerometersReader,
)
from counterspin.campaign.checking import M, Problems, Section
from counterspin.campaign.columns import Recording, RecordsSettings
from counterspin.campaign.documents import (
    KeyPath,
    list_of,
    table_of,
)
from counterspin.campaign.kinds import Schema, SettingsSection, described
from counterspin.campaign.model import (
    Apparatus,
    check_conditions,
    refuse_encoder,
    resolve_model,
)
from counterspin.campaign.quantity import Quantity
from counterspin.campaign.readings import Reading, positioned, resolve_readings
from counterspin.campaign.readings_table import ReadingsSettings, read_table
from counterspin.campaign.runs import (
    Run,
    is_pose,
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
    Output,
    SiteSettings,
)
from counterspin.campaign.specification import (
    Specifications,
    SpecificationSettings,
    resolve_specifications,
)
from counterspin.campaign.triad import TriadSettings, resolve_triad, with_usual_axes
from counterspin.physics.motion import Site
from counterspin.records.record import ColumnSpec

if TYPE_CHECKING:
    from counterspin.campaign.truth import Simulation


#: Of a campaign without records.
NOT_RECORDED: Final = Recording(ColumnSpec("", unit="s"), None)

#: Tables of accelerometers, by name.
Accelerometers = Annotated[
    dict[str, Any],
    Field(min_length=1),
    Section(dict[str, AccelerometerKeys]),  # type: ignore[valid-type]
]
Runs = Annotated[list[Any], Section(list[Run])]


def _simulation() -> Any:
    from counterspin.campaign.truth import Simulation

    return Simulation


def _truth() -> Any:
    from counterspin.campaign.truth import TruthSettings

    return TruthSettings


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
    simulation: Annotated[dict[str, Any] | None, Section(_simulation)] = described(
        "[sampling, for `simulate`](#simulation)", {}, None
    )
    truth: Annotated[dict[str, Any] | None, Section(_truth)] = described(
        "[true values, for `simulate`](#truth)", {}, None
    )
    study: dict[str, Any] | None = described(
        "[what varies and what competes, for `study`](study.md)", {}, None
    )


class DescriptionReader:
    """Reads one document; each section is checked even where another one is wrong."""

    def __init__(self, raw: Mapping[str, Any], file: Path, problems: Problems) -> None:
        self.raw = raw
        self.file = file
        self.problems = problems
        problems.check(CampaignDocument, raw, ())
        self.site = self._required(SiteSettings, "site")
        # With some gravity, a missing site is one mistake, and g against m/s^2 no second one.
        self.gravity = self.site.gravity.value if self.site else 9.80665
        self.simulated = "simulation" in raw or "truth" in raw
        self.all_runs = list_of(raw, "runs")
        self.numbered_runs = taken_runs(self.all_runs)
        self.raw_runs = [run for _, run in self.numbered_runs]
        tables = with_usual_axes(table_of(raw, "accelerometers"), raw.get("triad"))
        self.accelerometers = AccelerometersReader(tables, self.raw_runs, problems, self.gravity)
        self.table_checksums: dict[Path, str] = {}

    def _required(self, model: type[M], key: str) -> M | None:
        """Check a section that must be there; that it is absent is noted already."""
        value = self.raw.get(key)
        return self.problems.check(model, value, (key,)) if isinstance(value, dict) else None

    def attributes(self) -> dict[str, Any] | None:
        """Return what a `Campaign` is made of, or None if there are problems."""
        problems, gravity = self.problems, self.gravity
        info = problems.check(CampaignSettings, table_of(self.raw, "campaign"), ("campaign",))
        centrifuge = self._required(CentrifugeSettings, "centrifuge")
        records = self._required(RecordsSettings, "records")
        fixture = self._required(FixtureSettings, "fixture") or FixtureSettings()
        noise = self._noise()
        right, tables = self.accelerometers.mountings, self.accelerometers.tables
        mountings = {name: right.get(name) for name in tables}
        self.accelerometers.check_names()
        observables = self.accelerometers.observables(noise)
        settings = problems.check(ModelSettings, table_of(self.raw, "model"), ("model",))
        turns = self._sampling().revolutions if self.simulated else None
        placed = resolve_runs(
            self.numbered_runs,
            self.file.parent,
            table_of(self.raw, "records"),
            turns,
            problems,
        )
        runs = tuple(placed.values())
        outputs = self.accelerometers.outputs
        before = len(problems.lines)
        numbered = self._numbered_readings(outputs)
        read = partial(
            resolve_readings,
            mountings=mountings,
            outputs=outputs,
            folder=self.file.parent,
            problems=problems,
            gravity=gravity,
            turns=turns,
        )
        readings = positioned(
            read([one for one in numbered if not is_pose(one[0])]), fixture.position
        )
        whole = len(problems.lines) == before
        self._check_sections(readings)
        if not self.raw_runs and "readings" not in self.raw:
            said = "must have at least one entry" if "runs" in self.raw else "is missing"
            said = "are all left out by skip = true" if self.all_runs else said
            problems.add(("runs",), said)
        given = self.accelerometers.own_priors
        triad = resolve_triad(
            self.raw.get("triad"),
            mountings,
            [one for one in numbered if is_pose(one[0])],
            self.file.parent,
            read,
            given=None if readings or runs else given,
            problems=problems,
        )
        reference = centrifuge.reference_temperature if centrifuge else None
        model, priors = None, given
        if settings is not None:
            apparatus = Apparatus(
                right,
                {name: table.grade for name, table in tables.items() if table is not None},
                [run.attitude for run in runs],
                readings,
                triad.count if triad else 0,
                centrifuge,
                fixture.position,
                whole,
            )
            model, priors = resolve_model(settings, given, apparatus, problems, gravity)
            if records is not None and records.angle is None:
                refuse_encoder(model, problems)
            common = records.recording if records else NOT_RECORDED
            recorded = {run.name for run in runs if (run.recording or common).temperature}
            check_conditions(model, placed, recorded, reference, problems)
        known = readings if whole else None
        simulation = self._simulation(outputs, noise, placed, known, centrifuge)
        specifications = self._specifications()
        accelerometers = self.accelerometers.accelerometers(observables, priors)
        if records is not None:
            self.accelerometers.check_columns(records, accelerometers)
        if problems.lines:
            return None
        # No problem noted: every section is there.
        assert info is not None
        assert self.site is not None
        assert model is not None
        site, recording = self.site, records.recording if records else NOT_RECORDED
        return dict(  # noqa: C408 -- as the arguments of a class
            title=info.title or self.file.parent.name,
            path=self.file,
            folder=self.file.parent,
            site=Site(
                site.gravity.value,
                site.latitude.value,
                removed_gravity=site.removed_gravity,
            ),
            gravity=site.gravity,
            latitude=site.latitude,
            radius=centrifuge.radius if centrifuge else Quantity(0.0, 0.0, "m"),
            time=recording.time,
            angle=recording.angle,
            dialect=recording.dialect,
            temperature=recording.temperature,
            skipped=skipped_runs(self.all_runs),
            timing_offset=records.timing_offset if records else None,
            clock=records.clock if records else None,
            own_velocity=records is not None and records.reference == "own velocity",
            accelerometers=accelerometers,
            noise=noise,
            model=model,
            runs=runs,
            simulation=simulation,
            details=info.model_dump(exclude={"title"}, exclude_none=True),
            specifications=specifications,
            readings=readings,
            reference_temperature=reference,
            tables=self._tables(),
            table_checksums=self.table_checksums,
            triad=triad,
        )

    def _check_sections(self, readings: Sequence[Reading]) -> None:
        """Note sections that are missing although what there is needs them."""
        recorded = any(not is_reading(raw) or "record" in raw for raw in self.raw_runs)
        turning = any(r.motion != "static" for r in readings) or any(
            not isinstance(raw, dict) or raw.get("motion") != "static" for raw in self.raw_runs
        )
        for key, needed in (("centrifuge", turning), ("records", recorded)):
            if (needed or not (self.raw_runs or "readings" in self.raw)) and key not in self.raw:
                self.problems.add((key,), "is missing")

    def _numbered_readings(self, outputs: Mapping[str, Output | None]) -> list[tuple[Any, KeyPath]]:
        """Return the runs that are readings, rows of the table too, with where each stands."""
        runs: list[tuple[Any, KeyPath]] = [
            (raw, ("runs", index)) for index, raw in self.numbered_runs if is_reading(raw)
        ]
        if "readings" in self.raw:
            folder, checksums = self.file.parent, self.table_checksums
            every = {name: outputs.get(name) for name in self.accelerometers.raw}
            runs += read_table(self.raw, folder, every, self.problems, checksums)
        return runs

    def _tables(self) -> tuple[Path, ...]:
        """Return the files of readings."""
        files = {
            self.file.parent / raw["record"]
            for raw in self.raw_runs
            if is_reading(raw) and "record" in raw
        }
        if "readings" in self.raw:
            files.add(self.file.parent / self.raw["readings"]["file"])
        return tuple(sorted(files))

    def _noise(self) -> NoiseSettings | None:
        if not isinstance(raw := self.raw.get("noise"), dict):
            return None
        noise = self.problems.check(NoiseSettings, raw, ("noise",), gravity=self.gravity)
        if noise is not None and noise.rest is not None:
            if all(map(is_reading, self.raw_runs)):
                self.problems.add(("noise", "from"), "no run has a record; noise is of records")
            named = [run.get("record") for run in self.raw_runs if isinstance(run, dict)]
            if noise.rest in named:
                self.problems.add(("noise", "from"), "is the record of a run; none is at rest")
        return noise

    def _simulation(
        self,
        outputs: Mapping[str, Output | None],
        noise: NoiseSettings | None,
        runs: Mapping[int, Run],
        readings: Sequence[Reading] | None,
        centrifuge: CentrifugeSettings | None,
    ) -> Simulation | None:
        """Return how records are simulated; parameters as of `TruthReader.simulation`."""
        if not self.simulated:
            return None
        from counterspin.campaign.truth import TruthReader

        recorders = recorders_of(table_of(self.raw, "records"), list(runs.values()))
        names = list(self.accelerometers.raw)
        truth = TruthReader(table_of(self.raw, "truth"), names, self.problems, self.gravity)
        return truth.simulation(
            self._sampling(), outputs, noise, runs, readings, centrifuge, recorders
        )

    def _sampling(self) -> Simulation:
        kind, raw = _simulation(), table_of(self.raw, "simulation")
        sampling: Simulation = self.problems.check(kind, raw, ("simulation",)) or kind()
        return sampling

    def _specifications(self) -> Specifications | None:
        if not isinstance(self.raw.get("specification"), dict):
            return None
        return resolve_specifications(
            self.raw["specification"],
            self.accelerometers.raw,
            problems=self.problems,
            gravity=self.gravity,
        )

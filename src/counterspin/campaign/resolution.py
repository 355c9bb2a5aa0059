"""The sections of ``campaign.toml``, and what they say together: all mistakes are noted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

from pydantic import BaseModel, Field

from counterspin.campaign.accelerometers import (
    AccelerometerKeys,
    AccelerometersReader,
)
from counterspin.campaign.checking import Problems, Section
from counterspin.campaign.checks import note_mistakes
from counterspin.campaign.columns import Recording, RecordsSettings
from counterspin.campaign.documents import (
    KeyPath,
    list_of,
    table_of,
)
from counterspin.campaign.kinds import Schema, SettingsSection, described
from counterspin.campaign.model import (
    Apparatus,
    resolve_model,
)
from counterspin.campaign.quantity import Quantity
from counterspin.campaign.readings import (
    Reading,
    positioned,
    resolve_readings,
    with_recorded_angles,
)
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
    SiteSettings,
)
from counterspin.campaign.triad import TriadSettings, resolve_triad, with_usual_axes
from counterspin.loading import load_name
from counterspin.physics.motion import Site
from counterspin.records.record import ColumnSpec

if TYPE_CHECKING:
    from counterspin.campaign.simulated_truth import Simulation
    from counterspin.campaign.specification import Specifications


#: Of a campaign without records.
NOT_RECORDED: Final = Recording(ColumnSpec("", unit="s"), None)

#: Tables of accelerometers, by name.
Accelerometers = Annotated[
    dict[str, Any],
    Field(min_length=1),
    Section(dict[str, AccelerometerKeys]),  # type: ignore[valid-type]
]
Runs = Annotated[list[Any], Section(list[Run])]


_READINGS: Final = "counterspin.campaign.readings_table:ReadingsSettings"
_SPECIFICATION: Final = "counterspin.campaign.specification:Specifications"
_TRUTH_READER: Final = "counterspin.campaign.simulated_truth"
_SIMULATION: Final = f"{_TRUTH_READER}:Simulation"
_TRUTH: Final = "counterspin.campaign.truth:TruthSettings"


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
    readings: Annotated[dict[str, Any] | None, Section(_READINGS)] = described(
        "[a table of single values](readings.md)", {}, None
    )
    runs: Runs = described(
        "[one for each run](#runs), or [reading](readings.md)",
        [{"name": "run1", "rate": "0.25 rev/s", "record": "run1.csv"}],
        [],
        kind="list of tables",
    )
    specification: Annotated[dict[str, Any] | None, Section(_SPECIFICATION)] = described(
        "[limits that coefficients shall meet](#specification)", {}, None
    )
    simulation: Annotated[dict[str, Any] | None, Section(_SIMULATION)] = described(
        "[sampling, for `simulate`](#simulation)", {}, None
    )
    truth: Annotated[dict[str, Any] | None, Section(_TRUTH)] = described(
        "[true values, for `simulate`](#truth)", {}, None
    )
    study: dict[str, Any] | None = described(
        "[what varies and what competes, for `study`](study.md)", {}, None
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
            with_usual_axes(tables, raw.get("triad")),
            [run for _, run in listed],
            problems,
            self.gravity,
        )
        self.table_checksums: dict[Path, str] = {}

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
        mountings = {n: self.accelerometers.mountings.get(n) for n in self.accelerometers.tables}
        before = len(problems.lines)
        numbered = self._numbered_readings()
        read = partial(
            resolve_readings,
            mountings=mountings,
            outputs=self.accelerometers.outputs,
            folder=folder,
            problems=problems,
            gravity=gravity,
            turns=turns,
        )
        known = [one for one in numbered if not is_pose(one[0])]
        readings = positioned(read(known), fixture.position)
        common = records.recording if records else NOT_RECORDED
        if common.angle is not None:
            readings = with_recorded_angles(readings)
        parts["right_readings"] = readings
        whole = len(problems.lines) == before
        given = self.accelerometers.own_priors
        triad = resolve_triad(
            raw.get("triad"),
            mountings,
            [one for one in numbered if is_pose(one[0])],
            folder,
            read,
            given=None if readings or placed else given,
            problems=problems,
        )
        priors = given
        if settings is not None:
            apparatus = Apparatus(
                self.accelerometers.mountings,
                self.accelerometers.grades,
                [run.attitude for run in placed.values()],
                readings,
                triad.count if triad else 0,
                centrifuge,
                fixture.position,
                whole,
            )
            parts["model"], priors = resolve_model(settings, given, apparatus, problems, gravity)
            parts["recorded_temperatures"] = {
                run.name for run in placed.values() if (run.recording or common).temperature
            }
        truths = {
            str(raw["name"]): (raw["truth"], (*path, "truth"))
            for raw, path in numbered
            if isinstance(raw, Mapping) and "name" in raw and isinstance(raw.get("truth"), Mapping)
        }
        simulation = self._simulation(placed, readings if whole else None, truths)
        specifications = self._specifications()
        accelerometers = self.accelerometers.accelerometers(observables, priors)
        parts["accelerometers"] = accelerometers
        note_mistakes(parts, problems)
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
            tables=self._tables(),
            table_checksums=self.table_checksums,
            triad=triad,
        )

    def _numbered_readings(self) -> list[tuple[Any, KeyPath]]:
        """Return the runs that are readings, including rows of the table, with their places."""
        runs: list[tuple[Any, KeyPath]] = [
            (raw, ("runs", index)) for index, raw in self.parts["listed"] if is_reading(raw)
        ]
        if "readings" in self.raw:
            from counterspin.campaign.readings_table import read_table

            outputs = self.accelerometers.outputs
            every = {name: outputs.get(name) for name in self.accelerometers.raw}
            folder, checksums = self.file.parent, self.table_checksums
            runs += read_table(self.raw, folder, every, self.problems, checksums)
        return runs

    def _tables(self) -> tuple[Path, ...]:
        """Return the files of readings."""
        named = [
            run["record"] for _, run in self.parts["listed"] if is_reading(run) and "record" in run
        ]
        if "readings" in self.raw:
            named.append(self.raw["readings"]["file"])
        return tuple(sorted({self.file.parent / name for name in named}))

    def _simulation(
        self,
        runs: Mapping[int, Run],
        readings: Sequence[Reading] | None,
        truths: Mapping[str, tuple[Mapping[str, Any], KeyPath]],
    ) -> Simulation | None:
        """Return the settings of simulated records; parameters as of `DescribedRuns`."""
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

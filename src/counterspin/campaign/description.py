"""From ``campaign.toml`` to a `Campaign`: every key checked, all mistakes reported together."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from counterspin.campaign.checking import M, Problems
from counterspin.campaign.conditions import check_conditions
from counterspin.campaign.machine import MachineModel, errors_of_the_path, resolve_machine
from counterspin.campaign.memory.source import Source, keep
from counterspin.campaign.quantity import Quantity, parse
from counterspin.campaign.reading_truth import of_records, resolve_reading_truth
from counterspin.campaign.readings import (
    Output,
    Reading,
    is_reading,
    read_temperature,
    resolve_reading,
)
from counterspin.campaign.readings_table import read_table
from counterspin.campaign.resolved import (
    Accelerometer,
    Campaign,
    Channel,
    Run,
    RunTruth,
    Simulation,
    StatedNoise,
)
from counterspin.campaign.runs import (
    RunDefaults,
    recording_of,
    resolve_runs,
    skipped_runs,
    taken_runs,
)
from counterspin.campaign.settings import (
    OBSERVABLES,
    AccelerometerSettings,
    AxesSettings,
    CampaignSettings,
    CentrifugeSettings,
    DocumentSettings,
    ModelSettings,
    NoiseSettings,
    RecordsSettings,
    SimulationSettings,
    SiteSettings,
    exact,
)
from counterspin.campaign.specification import Specifications, resolve_specifications
from counterspin.campaign.terms import (
    DEFAULT_TERMS,
    about_nominal,
    refuse_encoder,
    resolve_model,
    with_errors_of_the_path,
)
from counterspin.campaign.toml_file import (
    CAMPAIGN_ADVICE,
    DESCRIPTION_NAME,
    description_file,
    load_with_checksum,
)
from counterspin.campaign.truth import TRUTH_TABLES, resolve_simulation
from counterspin.errors import CampaignError
from counterspin.physics.accelerometer import Mounting
from counterspin.physics.motion import Site
from counterspin.physics.terms import COMMON_NAMES, TERMS
from counterspin.records.formats import RECORD_FORMATS
from counterspin.units import check_unit, unit_factor

__all__ = [
    "DEFAULT_TERMS",
    "Accelerometer",
    "Campaign",
    "Channel",
    "Run",
    "RunTruth",
    "Simulation",
    "read_campaign",
]

_ACCELEROMETER_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]*")


def read_campaign(path: Path | str) -> Campaign:
    """Read and check a campaign description.

    The record files are not opened, nor need they exist.

    Parameters
    ----------
    path
        The campaign's folder, or its description file.

    Raises
    ------
    CampaignError
        With every mistake found, each with the path of its key; or that the file is missing,
        is not UTF-8 or not TOML.
    """
    file = description_file(path)
    if file.suffix.lower() in RECORD_FORMATS:
        raise CampaignError(
            str(file), [f"a record, not a campaign; give the folder that holds {DESCRIPTION_NAME}"]
        )
    raw, checksum = load_with_checksum(file, CAMPAIGN_ADVICE, "campaign")
    problems = Problems(raw)
    campaign = resolve_campaign(raw, file, problems)
    if campaign is None:
        raise CampaignError(str(file), problems.lines)
    return keep(campaign, Source(raw, campaign.path, checksum, raw))


def resolve_campaign(raw: Mapping[str, Any], file: Path, problems: Problems) -> Campaign | None:
    """Return the campaign that a document describes, or None with its mistakes noted."""
    return _DescriptionReader(raw, file.absolute(), problems).campaign()


class _DescriptionReader:
    """Reads one document; each section is checked even where another one is wrong."""

    def __init__(self, raw: Mapping[str, Any], file: Path, problems: Problems) -> None:
        self.raw = raw
        self.file = file
        self.problems = problems
        problems.check(DocumentSettings, raw, ())
        self.site = self._required(SiteSettings, "site")
        # With some gravity, a missing site is one mistake, and g against m/s^2 no second one.
        self.gravity = self.site.gravity.value if self.site else 9.80665
        self.simulated = "simulation" in raw or "truth" in raw
        self.raw_accelerometers = self._table("accelerometers")
        runs = raw.get("runs")
        self.all_runs = runs if isinstance(runs, list) else []
        self.numbered_runs = taken_runs(self.all_runs)
        self.raw_runs = [run for _, run in self.numbered_runs]
        self.table_checksums: dict[Path, str] = {}

    def _table(self, key: str) -> Mapping[str, Any]:
        value = self.raw.get(key)
        return value if isinstance(value, dict) else {}

    def _required(self, model: type[M], key: str) -> M | None:
        """Check a section that must be there; that it is absent is noted already."""
        value = self.raw.get(key)
        return self.problems.check(model, value, (key,)) if isinstance(value, dict) else None

    def campaign(self) -> Campaign | None:
        """Return the campaign, or None if there are problems."""
        problems, gravity = self.problems, self.gravity
        info = problems.check(CampaignSettings, self._table("campaign"), ("campaign",))
        centrifuge = self._required(CentrifugeSettings, "centrifuge")
        records = self._required(RecordsSettings, "records")
        noise = self._noise()
        mountings = self._mountings()
        tables = {
            name: problems.check(
                AccelerometerSettings, table, ("accelerometers", name), gravity=gravity
            )
            for name, table in self.raw_accelerometers.items()
        }
        self._check_names()
        observables = self._observables(noise)
        settings = problems.check(ModelSettings, self._table("model"), ("model",))
        runs = self._runs()
        outputs = self._outputs(tables)
        readings = self._readings(mountings, outputs)
        self._check_sections(readings)
        if not self.raw_runs and "readings" not in self.raw:
            said = "must have at least one entry" if "runs" in self.raw else "is missing"
            said = "are all left out by skip = true" if self.all_runs else said
            problems.add(("runs",), said)
        given = {name: self._given_priors(name, table) for name, table in tables.items()}
        reference = problems.attempt(
            ("centrifuge", "reference_temperature"),
            read_temperature,
            centrifuge.reference_temperature if centrifuge else None,
        )
        model, priors, machine = None, given, MachineModel()
        if settings is not None:
            attitudes = [run.attitude for run in runs]
            if readings:
                settings, machine = resolve_machine(
                    settings, centrifuge, readings, problems, recorded=bool(runs)
                )
            model, priors = resolve_model(
                settings,
                mountings,
                attitudes,
                given,
                {name: table.grade for name, table in tables.items() if table is not None},
                problems=problems,
                gravity=gravity,
            )
            if not readings and centrifuge is not None:
                model = with_errors_of_the_path(model, errors_of_the_path(centrifuge), problems)
            if records is not None and records.angle is None:
                refuse_encoder(model, problems)
            also = (*machine.terms, *machine.considered)
            check_conditions(model, also, self._placed(runs), reference, problems)
        simulation = None
        if self.simulated:
            simulation = self._simulation(noise, readings, outputs, centrifuge)
        specifications = self._specifications()
        if problems.lines:
            return None
        # No problem noted: every section is there.
        assert info is not None
        assert self.site is not None
        assert model is not None
        accelerometers = {
            name: Accelerometer(
                name,
                mountings[name],
                observables[name],
                self._recorded(name, table, observables[name], outputs[name]),
                priors[name],
                table.serial_number,
                outputs[name],
                self._force(name, table, outputs[name]),
                table.grade,
            )
            for name, table in tables.items()
            if table is not None
        }
        if records is not None:
            self._check_columns(records, accelerometers)
        if problems.lines:
            return None
        site, recording = self.site, recording_of(records)
        return Campaign(
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
            skipped=skipped_runs(self.all_runs),
            timing_offset=records.timing_offset if records else None,
            clock=records.clock if records else None,
            own_velocity=records is not None and records.reference == "own velocity",
            accelerometers=accelerometers,
            noise=noise,
            model=model,
            runs=tuple(runs),
            simulation=simulation,
            details=info.model_dump(exclude={"title"}, exclude_none=True),
            specifications=specifications,
            readings=readings,
            machine=machine,
            reference_temperature=reference,
            tables=self._tables(),
            table_checksums=self.table_checksums,
        )

    def _check_sections(self, readings: Sequence[Reading]) -> None:
        """Note sections that are missing although what there is needs them."""
        recorded = any(not is_reading(raw) or "record" in raw for raw in self.raw_runs)
        asked = (raw.get("motion") for raw in self.raw_runs if isinstance(raw, dict))
        turning = recorded or "arm" in asked or any(r.motion != "static" for r in readings)
        for key, needed in (("centrifuge", turning), ("records", recorded)):
            if (needed or not (self.raw_runs or "readings" in self.raw)) and key not in self.raw:
                self.problems.add((key,), "is missing")

    def _outputs(self, tables: Mapping[str, Any]) -> dict[str, Output | None]:
        """Return what each accelerometer's readings are in."""
        outputs: dict[str, Output | None] = dict.fromkeys(tables)
        for name, table in tables.items():
            if table is None or table.output is None:
                continue
            path = ("accelerometers", name, "output")
            unit = self.problems.attempt((*path, "unit"), check_unit, table.output.unit)
            if unit is None:
                continue
            wanted = f"{unit}/g"
            sensitivity = self.problems.attempt(
                (*path, "sensitivity"), exact, table.output.sensitivity, wanted
            )
            if sensitivity == 0.0:
                self.problems.add((*path, "sensitivity"), "must not be zero")
            elif sensitivity is not None:
                outputs[name] = Output(unit, sensitivity)
        return outputs

    def _readings(
        self, mountings: Mapping[str, Mounting], outputs: Mapping[str, Output | None]
    ) -> tuple[Reading, ...]:
        runs: list[tuple[Any, tuple[str | int, ...]]] = [
            (raw, ("runs", index)) for index, raw in self.numbered_runs if is_reading(raw)
        ]
        if "readings" in self.raw:
            folder, checksums = self.file.parent, self.table_checksums
            runs += read_table(self.raw["readings"], folder, outputs, self.problems, checksums)
        readings: list[Reading] = []
        blank: list[tuple[str | int, ...]] = []
        for raw, path in runs:
            own = resolve_reading(
                raw,
                path,
                mountings,
                outputs,
                folder=self.file.parent,
                problems=self.problems,
                gravity=self.gravity,
            )
            if any(math.isnan(reading.value) for reading in own):
                blank.append((*path, "reading"))
            readings += [self._with_length(reading) for reading in own]
        if blank and not self.simulated:
            others = f", nor have {len(blank) - 1} others" if len(blank) > 1 else ""
            self.problems.add(
                blank[0],
                f"has no value yet{others}; write what was read, or [truth] to simulate it",
            )
        return tuple(readings)

    def _with_length(self, reading: Reading) -> Reading:
        """Return a reading with the length of its record, where it is simulated on a machine."""
        if reading.duration is not None or not reading.rate or not self.simulated:
            return reading
        turns = self._sampling().revolutions
        return replace(reading, duration=turns * 2.0 * math.pi / abs(reading.rate))

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

    def _recorded(self, name: str, table: Any, observable: str, output: Output | None) -> Channel:
        """Return the column of an accelerometer; an output such as a current as m/s^2."""
        settings = getattr(table, observable)
        path = ("accelerometers", name, observable, "unit")
        if settings is None or observable != "specific_force":
            return self._channel(settings, OBSERVABLES[observable])
        try:
            return self._channel(settings, "m/s^2")
        except ValueError as error:
            if output is None:
                self.problems.add(path, f"{error}; or say output = {{ unit, sensitivity }}")
                return Channel("", 1.0, "")
        factor = self.problems.attempt(path, unit_factor, settings.unit, output.unit) or 1.0
        return Channel(settings.column, factor / output.sensitivity * self.gravity, settings.unit)

    def _force(self, name: str, table: Any, output: Output | None) -> Channel | None:
        """Return the column that records on an arm or at rest are read from, if there are any."""
        if not any(is_reading(raw) and "record" in raw for raw in self.raw_runs):
            return None
        if table.specific_force is None:
            self.problems.add(
                ("accelerometers", name),
                "has no specific_force: the column of its records on an arm or at rest",
            )
            return None
        return self._recorded(name, table, "specific_force", output)

    def _channel(self, settings: Any, si_unit: str) -> Channel:
        if settings is None:
            return Channel("", 1.0, si_unit)
        factor = unit_factor(settings.unit, si_unit, gravity=self.gravity) if settings.unit else 1.0
        return Channel(settings.column, factor, settings.unit or "", si_unit=si_unit)

    def _noise(self) -> StatedNoise | None:
        if not isinstance(self.raw.get("noise"), dict):
            return None
        settings = self.problems.check(
            NoiseSettings, self.raw["noise"], ("noise",), gravity=self.gravity
        )
        return StatedNoise(**settings.model_dump()) if settings else None

    def _mountings(self) -> dict[str, Mounting]:
        mountings = {}
        for name, table in self.raw_accelerometers.items():
            path = ("accelerometers", name)
            if not isinstance(table, dict):
                continue
            axes = {key: table[key] for key in AxesSettings.model_fields if key in table}
            settings = self.problems.check(AxesSettings, axes, path)
            if settings is None:
                continue
            mounting = self.problems.attempt(
                path,
                Mounting.from_axes,
                settings.input_axis,
                settings.pendulous_axis,
                settings.output_axis,
            )
            if mounting is not None:
                mountings[name] = mounting
        return mountings

    def _check_names(self) -> None:
        for name in self.raw_accelerometers:
            if name in TRUTH_TABLES or not _ACCELEROMETER_NAME.fullmatch(name):
                self.problems.add(
                    ("accelerometers", name),
                    "cannot be an accelerometer's name; use letters, digits, - and _, "
                    f"and none of {', '.join(TRUTH_TABLES)}",
                )

    def _observables(self, noise: StatedNoise | None) -> dict[str, str]:
        observables = {}
        for name, table in self.raw_accelerometers.items():
            if not isinstance(table, dict):
                continue
            given = [key for key in OBSERVABLES if key in table]
            turned = any(not is_reading(raw) for raw in self.raw_runs)
            carried = any(is_reading(raw) and "record" in raw for raw in self.raw_runs)
            if not turned and (not given or carried):
                observables[name] = "specific_force"  # readings are all there is of it
            elif turned and carried and len(given) == 2 and given[-1] == "specific_force":
                observables[name] = given[0]  # the other one is of records on an arm or at rest
            elif len(given) == 1:
                observables[name] = given[0]
            else:
                has = f"has {' and '.join(given)}" if given else "has no observable"
                self.problems.add(
                    ("accelerometers", name), f"{has}; give one of {', '.join(OBSERVABLES)}"
                )
        for key in OBSERVABLES if noise and observables else ():
            if key not in observables.values() and getattr(noise, key) != 0.0:
                self.problems.add(("noise", key), f"no accelerometer records {key}")
        return observables

    def _given_priors(self, name: str, table: Any) -> dict[str, Quantity]:
        """Return the priors of an accelerometer's own table, by symbol."""
        if table is None:
            return {}
        priors = {symbol: getattr(table, symbol) for symbol in TERMS}
        if table.sensitivity_prior is not None:
            priors["K_I"] = self._sensitivity_prior(name, table)
        for key, symbol in ({symbol: symbol for symbol in TERMS} | COMMON_NAMES).items():
            if (prior := getattr(table, key)) is not None:
                path = ("accelerometers", name, key)
                self.problems.attempt(path, about_nominal, symbol, prior, table.grade)
        for key, symbol in COMMON_NAMES.items():
            value = getattr(table, key)
            if value is not None and priors[symbol] is not None:
                self.problems.add(
                    ("accelerometers", name, key),
                    f"is the prior of {symbol}, given too; keep one",
                )
            priors[symbol] = priors[symbol] if value is None else value
        return {symbol: prior for symbol, prior in priors.items() if prior is not None}

    def _sensitivity_prior(self, name: str, table: Any) -> Quantity | None:
        """Return what is known of the sensitivity as the prior of K_I."""
        path = ("accelerometers", name, "sensitivity_prior")
        if table.output is None:
            self.problems.add(path, "needs output = { unit = ..., sensitivity = ... } beside it")
            return None
        plain = self.problems.attempt(
            ("accelerometers", name, "output", "unit"), check_unit, table.output.unit
        )
        if plain is None:
            return None
        unit = f"{plain}/g"
        known = self.problems.attempt(path, parse, table.sensitivity_prior, unit)
        nominal = self.problems.attempt(path, parse, table.output.sensitivity, unit)
        if known is None or nominal is None or nominal.value == 0.0:
            return None
        return Quantity(known.value / nominal.value, known.u / abs(nominal.value), "g/g")

    def _runs(self) -> list[Run]:
        simulated = of_records(self._table("truth"), {}, self.problems)
        defaults = RunDefaults(
            self.file.parent,
            self._table("records"),
            simulated if self.simulated else None,
            self._sampling().revolutions,
        )
        return resolve_runs(self.numbered_runs, defaults, self.problems)

    def _placed(self, runs: Sequence[Run]) -> list[tuple[int, Run]]:
        """Return runs with their places in the description."""
        places = {
            raw.get("name"): place
            for place, raw in self.numbered_runs
            if isinstance(raw, dict) and isinstance(raw.get("name"), str)
        }
        return [(places[run.name], run) for run in runs]

    def _sampling(self) -> SimulationSettings:
        settings = self.problems.check(
            SimulationSettings, self._table("simulation"), ("simulation",)
        )
        return settings or SimulationSettings()

    def _simulation(
        self,
        noise: StatedNoise | None,
        readings: Sequence[Reading],
        outputs: Mapping[str, Output | None],
        centrifuge: CentrifugeSettings | None,
    ) -> Simulation:
        simulation = resolve_simulation(
            self._sampling(),
            of_records(self._table("truth"), outputs, self.problems),
            self.raw_accelerometers,
            noise,
            problems=self.problems,
            gravity=self.gravity,
        )
        machine, spread = resolve_reading_truth(
            self._table("truth"),
            readings,
            outputs,
            centrifuge,
            problems=self.problems,
            gravity=self.gravity,
        )
        truth = replace(simulation.truth, machine=machine, reading_noise=spread)
        return replace(simulation, truth=truth)

    def _specifications(self) -> Specifications | None:
        if not isinstance(self.raw.get("specification"), dict):
            return None
        return resolve_specifications(
            self.raw["specification"],
            self.raw_accelerometers,
            problems=self.problems,
            gravity=self.gravity,
        )

    def _check_columns(
        self, records: RecordsSettings, accelerometers: Mapping[str, Accelerometer]
    ) -> None:
        """Note columns that are used twice."""
        seen = {records.time.column or "": "records.time"}
        others = {"records.angle": records.angle.column} if records.angle else {}
        others |= {
            f"accelerometers.{a.name}.{a.observable}": a.channel.column
            for a in accelerometers.values()
        }
        for key, column in others.items():
            if column in seen:
                self.problems.add(
                    tuple(key.split(".")), f'column "{column}" is used by {seen[column]} already'
                )
            seen[column] = key

"""From ``campaign.toml`` to a `Campaign`: every key checked, all mistakes reported together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import field, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

from counterspin.campaign.accelerometers import Accelerometer, AccelerometersReader
from counterspin.campaign.checking import M, Problems
from counterspin.campaign.checking import Path as KeyPath
from counterspin.campaign.columns import Recording, RecordsSettings
from counterspin.campaign.document import CampaignDocument
from counterspin.campaign.memory.changes import change_campaign
from counterspin.campaign.memory.joining import join_campaigns
from counterspin.campaign.memory.source import Source, keep, source_of
from counterspin.campaign.memory.writing import write_campaign
from counterspin.campaign.model import (
    Apparatus,
    ErrorModel,
    check_conditions,
    refuse_encoder,
    resolve_model,
)
from counterspin.campaign.quantity import Quantity
from counterspin.campaign.readings import Reading, positioned, resolve_readings
from counterspin.campaign.readings_table import read_table
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
from counterspin.campaign.specification import Specifications, resolve_specifications
from counterspin.campaign.toml_file import (
    CAMPAIGN_ADVICE,
    DESCRIPTION_NAME,
    description_file,
    list_of,
    load_with_checksum,
    mistakes,
    table_of,
)
from counterspin.campaign.triads.declared import Triad, resolve_triad, with_usual_axes
from counterspin.campaign.truth import TruthReader
from counterspin.campaign.truth_tables import Simulation
from counterspin.errors import CampaignError
from counterspin.frozen import frozen
from counterspin.physics.grades import DEFAULT_GRADE, Size
from counterspin.physics.motion import Site
from counterspin.physics.terms import term
from counterspin.records.dialect import TO_BE_FOUND, Dialect
from counterspin.records.formats import RECORD_FORMATS
from counterspin.records.memory import MemoryTable
from counterspin.records.record import ColumnSpec

#: Of a campaign without records.
NOT_RECORDED: Final = Recording(ColumnSpec("", unit="s"), None)


@frozen
class Campaign:
    """A campaign description, checked and resolved.

    Attributes
    ----------
    title
        [campaign] title; the folder's name if there is none.
    path, folder
        The description's file and its folder, absolute.
    site
        Gravity and latitude as plain numbers, for the physics.
    gravity, latitude, radius
        The same with their uncertainties: m/s^2, rad, m.
    time
        Column of the time, in s.
    angle
        Column of the spindle's angle, in rad; None: the nominal rate is taken.
    timing_offset
        How much later than its displacement the angle of a row was sampled, s; None: not stated.
    clock
        By how much of itself the recorder's clock runs fast; None: not stated.
    own_velocity
        Whether the navigation computer takes its own velocity for the Coriolis acceleration, and
        not the platform's.
    accelerometers
        By name, in the file's order.
    noise
        None: to be estimated from the residuals.
    model
        Terms, priors and limits.
    runs
        In the file's order; names and records are unique.
    simulation
        None if the file has neither [simulation] nor [truth].
    details
        What else [campaign] states, such as `serial_number` and `date`; only what is there.
    specifications
        Tolerance limits of the coefficients; None if the file states none.
    tables, table_checksums
        Files of readings, and SHA-256 of those that were read with the description.
    frames
        Records that are in memory, by the files in whose place they are.
    temperature
        Column of the accelerometers' temperature in records; None without.
    dialect
        How record files are written, as far as that is said.
    skipped
        Names of the runs that are left out.
    triad
        Three accelerometers of one sensor, with their poses at unknown attitudes; None without.
    source
        The description that it was resolved from; None of a copy that `dataclasses.replace` made.
    """

    title: str
    path: Path
    folder: Path
    site: Site
    gravity: Quantity
    latitude: Quantity
    radius: Quantity
    time: ColumnSpec
    angle: ColumnSpec | None
    timing_offset: Quantity | None
    accelerometers: Mapping[str, Accelerometer]
    noise: NoiseSettings | None
    model: ErrorModel
    runs: tuple[Run, ...]
    simulation: Simulation | None
    details: Mapping[str, str]
    specifications: Specifications | None = None
    readings: tuple[Reading, ...] = ()
    reference_temperature: float | None = None
    tables: tuple[Path, ...] = ()
    table_checksums: Mapping[Path, str] = field(default_factory=dict)
    frames: Mapping[Path, MemoryTable] = field(default_factory=dict, repr=False)
    clock: Quantity | None = None
    own_velocity: bool = False
    dialect: Dialect = TO_BE_FOUND
    temperature: ColumnSpec | None = None
    skipped: tuple[str, ...] = ()
    triad: Triad | None = None
    source: Source | None = field(default=None, init=False, repr=False, compare=False)

    def __repr__(self) -> str:
        """Return title, accelerometers and what is recorded, in a line."""
        names, held = ", ".join(self.accelerometers), f"{len(self.runs)} runs"
        return f"<campaign {self.title!r}: {names}; {held}, {len(self.readings)} readings>"

    def limit_of(self, symbol: str, owner: str = "") -> float:
        """Return the largest credible size of a term: as stated, or by the owner's grade.

        Parameters
        ----------
        symbol
            Of the table of terms.
        owner
            The accelerometer, for a term of its own; else it is no matter.
        """
        return self.model.limits.get(symbol) or self._size(symbol, owner).limit

    def typical_of(self, symbol: str, owner: str = "") -> float:
        """Return the standard uncertainty to assume of a term; parameters as of `limit_of`."""
        return self.model.typical.get(symbol) or self._size(symbol, owner).typical

    def _size(self, symbol: str, owner: str) -> Size:
        accelerometer = self.accelerometers.get(owner)
        return term(symbol).sizes(DEFAULT_GRADE if accelerometer is None else accelerometer.grade)

    def recording_of(self, run: Run) -> Recording:
        """Return how the record of a run is read."""
        return run.recording or Recording(
            self.time, self.angle, self.dialect, self.temperature, clock=self.clock
        )

    def record_at(self, file: Path) -> Path | MemoryTable:
        """Return the record in memory that stands in the place of a file, or else the file."""
        return self.frames.get(file, file)

    def change(self, **changes: Any) -> Campaign:
        """Return the campaign with named changes, checked as its description was.

        Parameters
        ----------
        **changes
            ``title``, ``gravity``, ``latitude``, ``radius``, ``terms``, ``considered``,
            ``priors``, ``noise``, ``truth``, ``seed``, ``sampling_rate``, or another section of
            ``campaign.toml``: what to write there. A mapping changes the keys it has; None takes
            a key away. ``accelerometers`` and ``runs``: the names of those that stay, or a
            mapping from names to changes. ``records``: as of `make_campaign`. Any other key is
            named with dots, ``**{"records.time.column": "t"}``.

        Raises
        ------
        CampaignError
            With every mistake, as of a file.

        Notes
        -----
        A prior takes the place of one in the accelerometer's own table (``bias``). Where terms
        are changed, the priors of those that are left out go with them.
        """
        document, frames = change_campaign(self, changes)
        source = replace(source_of(self), document=document)
        return resolved_in_memory(source, {**self.frames, **frames}, self.folder)

    def join(self, *others: Campaign) -> Campaign:
        """Return one campaign with the runs of this one and of others, for one fit.

        Parameters
        ----------
        *others
            Of the same site, centrifuge, accelerometers, noise, model and columns.

        Returns
        -------
        Campaign
            A run whose name is taken has the campaign's number behind it, ``slow (2)``. The
            truth is kept where all have the same.

        Raises
        ------
        CampaignError
            With all that they do not have in common.
        """
        document, frames = join_campaigns([self, *others])
        return resolved_in_memory(Source(document), frames, self.folder)

    def write(self, folder: Path | str, *, overwrite: bool = False) -> Path:
        """Write ``campaign.toml`` and all records, from which the same result comes.

        Parameters
        ----------
        folder
            Made if it is not there.
        overwrite
            Whether files that are already there may be replaced.

        Returns
        -------
        Path
            The description.

        Raises
        ------
        CounterspinError
            If a file is in the way, cannot be written, or a record is not there.
        """
        return write_campaign(self, folder, overwrite=overwrite)

    @property
    def files(self) -> tuple[Path, ...]:
        """All record files, of runs and of readings."""
        read = (reading.record for reading in self.readings if reading.record is not None)
        posed = (one.record for one in self.triad.records) if self.triad else ()
        return (*(file for run in self.runs for file in run.files), *read, *posed)

    @property
    def rest(self) -> Path | None:
        """The record at rest that says the noise; None where [noise] names none."""
        return None if self.noise is None or not self.noise.rest else self.folder / self.noise.rest

    @property
    def posed(self) -> bool:
        """Whether there are poses of unknown attitude."""
        return self.triad is not None and self.triad.posed

    @property
    def all_readings(self) -> tuple[Reading, ...]:
        """All readings, those of poses at unknown attitudes behind the others."""
        posed = self.triad.poses if self.triad else ()
        return (*self.readings, *(reading for pose in posed for reading in pose))

    def require_records(self, what: str) -> None:
        """Raise CampaignError if there is no record, which `what` needs, or a reading beside."""
        if self.readings or self.posed:
            raise CampaignError(
                str(self.path),
                [f"runs: {what} takes records of a double turntable; this campaign has readings"],
            )


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
        raise mistakes(file, problems.lines)
    return keep(campaign, Source(raw, campaign.path, checksum, raw))


def resolve_campaign(raw: Mapping[str, Any], file: Path, problems: Problems) -> Campaign | None:
    """Return the campaign that a document describes, or None with its mistakes noted."""
    return _DescriptionReader(raw, file.absolute(), problems).campaign()


def resolved_in_memory(
    source: Source,
    frames: Mapping[Path, MemoryTable],
    folder: Path,
    noted: Problems | None = None,
) -> Campaign:
    """Return the campaign of a document and of records in memory.

    noted: Mistakes in the document that are known already.
    """
    problems = noted or Problems(source.document)
    campaign = resolve_campaign(source.document, folder / DESCRIPTION_NAME, problems)
    if campaign is None or problems.lines:
        raise CampaignError(source.label, problems.lines)
    info = source.document.get("campaign")
    titled = source.file is not None or (isinstance(info, Mapping) and "title" in info)
    named = {*campaign.files, campaign.rest}
    made = replace(
        campaign,
        path=Path(source.label),
        title=campaign.title if titled else "",
        frames={path: table for path, table in frames.items() if path in named},
    )
    return keep(made, source)


class _DescriptionReader:
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

    def campaign(self) -> Campaign | None:
        """Return the campaign, or None if there are problems."""
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
        recorders = recorders_of(table_of(self.raw, "records"), list(runs.values()))
        names = list(self.accelerometers.raw)
        truth = TruthReader(table_of(self.raw, "truth"), names, self.problems, self.gravity)
        return truth.simulation(
            self._sampling(), outputs, noise, runs, readings, centrifuge, recorders
        )

    def _sampling(self) -> Simulation:
        settings = self.problems.check(
            Simulation, table_of(self.raw, "simulation"), ("simulation",)
        )
        return settings or Simulation()

    def _specifications(self) -> Specifications | None:
        if not isinstance(self.raw.get("specification"), dict):
            return None
        return resolve_specifications(
            self.raw["specification"],
            self.accelerometers.raw,
            problems=self.problems,
            gravity=self.gravity,
        )

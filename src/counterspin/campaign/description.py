"""Resolve ``campaign.toml`` to a `Campaign`: check every key, report all mistakes together."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from counterspin.campaign.accelerometers import Accelerometer
from counterspin.campaign.columns import Recording
from counterspin.campaign.documents import (
    CAMPAIGN_ADVICE,
    DESCRIPTION_NAME,
    Source,
    campaign_error,
    description_file,
    load_with_checksum,
    require_source,
    set_source,
    table_of,
)
from counterspin.campaign.model import ErrorModel
from counterspin.campaign.quantity import Quantity
from counterspin.campaign.reading import Reading, Triad
from counterspin.campaign.resolution import DescriptionReader
from counterspin.campaign.runs import Run
from counterspin.campaign.settings import NoiseSettings
from counterspin.campaign.validation import Problems
from counterspin.errors import CampaignError
from counterspin.frozen import frozen
from counterspin.loading import load_name
from counterspin.physics.grades import DEFAULT_GRADE, Size
from counterspin.physics.motion import Site
from counterspin.physics.terms import shared_symbol, term
from counterspin.records.dialect import AUTODETECT, Dialect
from counterspin.records.format_registry import RECORD_FORMATS
from counterspin.records.memory import MemoryTable
from counterspin.records.record import ColumnSpec

if TYPE_CHECKING:
    from counterspin.campaign.simulated_truth import Simulation
    from counterspin.campaign.specification import Specifications

#: The functions that change a campaign and write it as a folder.
CHANGE_FUNCTION: Final = "counterspin.campaign.memory:change_campaign"
WRITE_FUNCTION: Final = "counterspin.campaign.memory:write_campaign"


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
        Gravity, latitude and radius with their uncertainties: m/s^2, rad, m.
    time
        Column of the time, in s.
    angle
        Column of the spindle angle, in rad; None: the nominal rate is used.
    timing_offset
        Sampling time of the angle minus that of the displacement in the same row, s; None: not
        stated.
    clock
        Relative rate error of the recorder's clock, positive if it runs fast; None: not stated.
    rate_clock
        Relative rate error of the clock that measures the rates of readings.
    own_velocity
        Whether the navigation computer computes the Coriolis acceleration from its own velocity
        instead of the platform's.
    accelerometers
        Accelerometers by name, in the order of the file.
    noise
        Stated noise; None: estimated from the residuals.
    model
        Terms, priors and limits.
    runs
        Runs in the order of the file; names and records are unique.
    simulation
        Settings of a simulation; None if the file has neither [simulation] nor [truth].
    details
        Other keys of [campaign] that are stated, such as `serial_number` and `date`.
    specifications
        Tolerance limits of the coefficients; None if the file states none.
    readings
        Readings with a stated attitude, in the order of the file.
    reference_temperature
        Stated reference of the temperature slopes, degC; None: the mean of all temperatures.
    tables, table_checksums
        Files of readings, and SHA-256 of those that were read with the description.
    frames
        Records in memory, by the file that each replaces.
    temperature
        Column of the accelerometer temperature in records; None: not recorded.
    dialect
        Stated format of the record files.
    strapped
        Whether the recorded accelerometers are strapped to the counter-rotating table.
    skipped
        Names of the excluded runs.
    triad
        Three accelerometers of one sensor, with their poses at unknown attitudes; or None.
    source
        Description from which the campaign was resolved; None for a copy made by
        `dataclasses.replace`.
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
    rate_clock: Quantity | None = None
    own_velocity: bool = False
    strapped: bool = False
    dialect: Dialect = AUTODETECT
    temperature: ColumnSpec | None = None
    skipped: tuple[str, ...] = ()
    triad: Triad | None = None
    source: Source | None = field(default=None, init=False, repr=False, compare=False)

    def __repr__(self) -> str:
        """Return title, accelerometers and numbers of runs and readings in one line."""
        names, run_text = ", ".join(self.accelerometers), f"{len(self.runs)} runs"
        return f"<campaign {self.title!r}: {names}; {run_text}, {len(self.readings)} readings>"

    @classmethod
    def of(
        cls,
        source: Source,
        folder: Path,
        frames: Mapping[Path, MemoryTable] | None = None,
        known_problems: Problems | None = None,
    ) -> Campaign:
        """Return the campaign of a document in memory.

        Parameters
        ----------
        source
            Document, with its file if it was read from one.
        folder
            Folder of the files that the document names.
        frames
            Records in memory, by the file that each replaces.
        known_problems
            Mistakes in the document that have already been found.

        Raises
        ------
        CampaignError
            With every mistake.
        """
        problems = known_problems or Problems(source.document)
        campaign = resolve_campaign(source.document, folder / DESCRIPTION_NAME, problems)
        if campaign is None or problems.lines:
            raise CampaignError(source.label, problems.lines)
        has_title = source.file is not None or "title" in table_of(source.document, "campaign")
        named_files = {*campaign.files, campaign.rest}
        resolved_campaign = replace(
            campaign,
            path=Path(source.label),
            title=campaign.title if has_title else "",
            frames={path: table for path, table in (frames or {}).items() if path in named_files},
        )
        return set_source(resolved_campaign, source)

    def limit_of(self, symbol: str, owner: str = "") -> float:
        """Return the largest credible magnitude of a term: as stated, or by the owner's grade.

        Parameters
        ----------
        symbol
            Symbol of the term.
        owner
            Accelerometer of an accelerometer term; ignored for other terms.
        """
        limits = self.model.limits
        stated_limit = limits.get(symbol) or limits.get(shared_symbol(symbol))
        return stated_limit or self._grade_size(symbol, owner).limit

    def typical_of(self, symbol: str, owner: str = "") -> float:
        """Return the default standard uncertainty of a term; parameters as in `limit_of`."""
        typical_sizes = self.model.typical
        stated_typical = typical_sizes.get(symbol) or typical_sizes.get(shared_symbol(symbol))
        return stated_typical or self._grade_size(symbol, owner).typical

    def _grade_size(self, symbol: str, owner: str) -> Size:
        accelerometer = self.accelerometers.get(owner)
        return term(symbol).sizes(DEFAULT_GRADE if accelerometer is None else accelerometer.grade)

    def recording_of(self, run: Run) -> Recording:
        """Return the recording of a run."""
        return run.recording or self.recording

    @property
    def recording(self) -> Recording:
        """The default recording of the runs."""
        return Recording(self.time, self.angle, self.dialect, self.temperature, clock=self.clock)

    def record_at(self, file: Path) -> Path | MemoryTable:
        """Return the record in memory that replaces a file, or else the file."""
        return self.frames.get(file, file)

    def change(
        self, patch: Mapping[str, Any], *, records: Mapping[str, Any] | None = None
    ) -> Campaign:
        """Return the campaign with a changed description, checked as a file is.

        Parameters
        ----------
        patch
            A merge patch (RFC 7396) of ``campaign.toml`` as nested mappings: a mapping changes
            the keys that it has, None removes a key, and anything else, such as the list of
            runs, replaces the value. Quantities are text, or a `Quantity`.
        records
            New records of runs, as in `make_campaign`.

        Raises
        ------
        CampaignError
            With every mistake, as for a file.
        """
        document, frames = load_name(CHANGE_FUNCTION)(self, patch, records or {})
        source = replace(require_source(self), document=document)
        return Campaign.of(source, self.folder, {**self.frames, **frames})

    def write(self, folder: Path | str, *, overwrite: bool = False) -> Path:
        """Write ``campaign.toml`` and all records to a folder, which gives the same result.

        Parameters
        ----------
        folder
            Target folder; created if it does not exist.
        overwrite
            Whether existing files may be replaced.

        Returns
        -------
        Path
            The description file.

        Raises
        ------
        CounterspinError
            If a file already exists or cannot be written, or a record is missing.
        """
        description_path: Path = load_name(WRITE_FUNCTION)(self, folder, overwrite=overwrite)
        return description_path

    @property
    def files(self) -> tuple[Path, ...]:
        """All record files, of runs and of readings."""
        reading_files = (reading.record for reading in self.readings if reading.record is not None)
        pose_files = (record.record for record in self.triad.records) if self.triad else ()
        return (*(file for run in self.runs for file in run.files), *reading_files, *pose_files)

    @property
    def rest(self) -> Path | None:
        """The record at rest from which the noise is estimated; None if [noise] names none."""
        return None if self.noise is None or not self.noise.rest else self.folder / self.noise.rest

    @property
    def posed(self) -> bool:
        """True if there are poses of unknown attitude."""
        return self.triad is not None and self.triad.has_poses

    @cached_property
    def all_readings(self) -> tuple[Reading, ...]:
        """All readings; those of poses at unknown attitudes come last."""
        poses = self.triad.poses if self.triad else ()
        return (*self.readings, *(reading for pose in poses for reading in pose))

    def require_records(self, what: str) -> None:
        """Raise CampaignError, for a method `what`, if the campaign has readings or poses."""
        if self.readings or self.posed:
            raise CampaignError(
                str(self.path),
                [
                    f"runs: {what} requires records of a double turntable; this campaign has "
                    "readings"
                ],
                code="method-not-applicable",
            )


def read_campaign(path: Path | str) -> Campaign:
    """Read and check a campaign description.

    The record files are not opened, nor need they exist.

    Parameters
    ----------
    path
        The campaign's folder, or its description file.

    Returns
    -------
    Campaign

    Raises
    ------
    CampaignError
        With every mistake and the path of its key; or if the file is missing, is not UTF-8 or is
        not TOML.
    """
    file = description_file(path)
    if file.suffix.lower() in RECORD_FORMATS and file.exists():
        raise CampaignError(
            str(file),
            [
                (
                    "this is a record, not a campaign; give the folder that contains "
                    f"{DESCRIPTION_NAME}"
                )
            ],
            code="wrong-document",
        )
    raw, checksum = load_with_checksum(file, CAMPAIGN_ADVICE, "campaign")
    problems = Problems(raw)
    campaign = resolve_campaign(raw, file, problems)
    if campaign is None:
        raise campaign_error(file, problems.lines)
    return set_source(campaign, Source(raw, campaign.path, checksum, raw))


def resolve_campaign(raw: Mapping[str, Any], file: Path, problems: Problems) -> Campaign | None:
    """Return the campaign of a document; None, with the mistakes reported, if it is invalid."""
    attributes = DescriptionReader(raw, file.absolute(), problems).resolve_attributes()
    return None if attributes is None else Campaign(**attributes)

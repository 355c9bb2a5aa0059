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
    table_of,
    with_source,
)
from counterspin.campaign.model import (
    ErrorModel,
)
from counterspin.campaign.quantity import Quantity
from counterspin.campaign.reading import Reading, Triad
from counterspin.campaign.resolution import DescriptionReader
from counterspin.campaign.runs import (
    Run,
)
from counterspin.campaign.settings import (
    NoiseSettings,
)
from counterspin.campaign.validation import Problems
from counterspin.errors import CampaignError
from counterspin.frozen import frozen
from counterspin.loading import load_name
from counterspin.physics.grades import DEFAULT_GRADE, Size
from counterspin.physics.motion import Site
from counterspin.physics.terms import same_for_all, term
from counterspin.records.dialect import AUTODETECT, Dialect
from counterspin.records.format_registry import RECORD_FORMATS
from counterspin.records.memory import MemoryTable
from counterspin.records.record import ColumnSpec

if TYPE_CHECKING:
    from counterspin.campaign.simulated_truth import Simulation
    from counterspin.campaign.specification import Specifications

#: The functions that change a campaign and write it as a folder.
CHANGE: Final = "counterspin.campaign.memory:change_campaign"
WRITE: Final = "counterspin.campaign.memory:write_campaign"


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
    rate_clock
        The same of the clock that measures the rates of readings.
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
    strapped
        Whether the accelerometers of records are strapped to the counter-rotating table.
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
    rate_clock: Quantity | None = None
    own_velocity: bool = False
    strapped: bool = False
    dialect: Dialect = AUTODETECT
    temperature: ColumnSpec | None = None
    skipped: tuple[str, ...] = ()
    triad: Triad | None = None
    source: Source | None = field(default=None, init=False, repr=False, compare=False)

    def __repr__(self) -> str:
        """Return title, accelerometers and what is recorded, in a line."""
        names, held = ", ".join(self.accelerometers), f"{len(self.runs)} runs"
        return f"<campaign {self.title!r}: {names}; {held}, {len(self.readings)} readings>"

    @classmethod
    def of(
        cls,
        source: Source,
        folder: Path,
        frames: Mapping[Path, MemoryTable] | None = None,
        noted: Problems | None = None,
    ) -> Campaign:
        """Return the campaign of a document that is in memory.

        Parameters
        ----------
        source
            The document, and the file from which it came, if from one.
        folder
            Of the files that it names.
        frames
            Records in memory, by the files in whose place they are.
        noted
            Mistakes in the document that are known already.

        Raises
        ------
        CampaignError
            With every mistake.
        """
        problems = noted or Problems(source.document)
        campaign = resolve_campaign(source.document, folder / DESCRIPTION_NAME, problems)
        if campaign is None or problems.lines:
            raise CampaignError(source.label, problems.lines)
        titled = source.file is not None or "title" in table_of(source.document, "campaign")
        named = {*campaign.files, campaign.rest}
        made = replace(
            campaign,
            path=Path(source.label),
            title=campaign.title if titled else "",
            frames={path: table for path, table in (frames or {}).items() if path in named},
        )
        return with_source(made, source)

    def limit_of(self, symbol: str, owner: str = "") -> float:
        """Return the largest credible size of a term: as stated, or by the owner's grade.

        Parameters
        ----------
        symbol
            Of the table of terms.
        owner
            The accelerometer, for a term of its own; else it is no matter.
        """
        limits = self.model.limits
        stated = limits.get(symbol) or limits.get(same_for_all(symbol))
        return stated or self._size(symbol, owner).limit

    def typical_of(self, symbol: str, owner: str = "") -> float:
        """Return the standard uncertainty to assume of a term; parameters as in `limit_of`."""
        typical = self.model.typical
        stated = typical.get(symbol) or typical.get(same_for_all(symbol))
        return stated or self._size(symbol, owner).typical

    def _size(self, symbol: str, owner: str) -> Size:
        accelerometer = self.accelerometers.get(owner)
        return term(symbol).sizes(DEFAULT_GRADE if accelerometer is None else accelerometer.grade)

    def recording_of(self, run: Run) -> Recording:
        """Return the recording of a run."""
        return run.recording or self.recording

    @property
    def recording(self) -> Recording:
        """The recording of runs that state no other."""
        return Recording(self.time, self.angle, self.dialect, self.temperature, clock=self.clock)

    def record_at(self, file: Path) -> Path | MemoryTable:
        """Return the record in memory that stands in the place of a file, or else the file."""
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
            As in `make_campaign`, of the runs that get another record.

        Raises
        ------
        CampaignError
            With every mistake, as for a file.
        """
        document, frames = load_name(CHANGE)(self, patch, records or {})
        source = replace(require_source(self), document=document)
        return Campaign.of(source, self.folder, {**self.frames, **frames})

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
        written: Path = load_name(WRITE)(self, folder, overwrite=overwrite)
        return written

    @property
    def files(self) -> tuple[Path, ...]:
        """All record files, of runs and of readings."""
        read = (reading.record for reading in self.readings if reading.record is not None)
        pose_files = (record.record for record in self.triad.records) if self.triad else ()
        return (*(file for run in self.runs for file in run.files), *read, *pose_files)

    @property
    def rest(self) -> Path | None:
        """The record at rest that says the noise; None where [noise] names none."""
        return None if self.noise is None or not self.noise.rest else self.folder / self.noise.rest

    @property
    def posed(self) -> bool:
        """True if there are poses of unknown attitude."""
        return self.triad is not None and self.triad.posed

    @cached_property
    def all_readings(self) -> tuple[Reading, ...]:
        """All readings, those of poses at unknown attitudes behind the others."""
        posed = self.triad.poses if self.triad else ()
        return (*self.readings, *(reading for pose in posed for reading in pose))

    def require_records(self, what: str) -> None:
        """Raise CampaignError if there is neither a record, which `what` needs, nor a reading."""
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

    Raises
    ------
    CampaignError
        With every mistake found, each with the path of its key; or that the file is missing,
        is not UTF-8 or not TOML.
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
    return with_source(campaign, Source(raw, campaign.path, checksum, raw))


def resolve_campaign(raw: Mapping[str, Any], file: Path, problems: Problems) -> Campaign | None:
    """Return the campaign that a document describes, or None with its mistakes noted."""
    made = DescriptionReader(raw, file.absolute(), problems).attributes()
    return None if made is None else Campaign(**made)

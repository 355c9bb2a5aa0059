"""[[runs]] with records: how each is read, which part of it, and which are left out."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Final

from pydantic import AfterValidator, PrivateAttr

from counterspin.campaign.attitude import attitude_rows
from counterspin.campaign.checking import Path as KeyPath
from counterspin.campaign.checking import Problems, Section
from counterspin.campaign.columns import Recording, RecordsSettings
from counterspin.campaign.kinds import (
    Attitude,
    PositiveRatio,
    RecordFile,
    Seconds,
    SettingsSection,
    Temperatures,
    Text,
    described,
    exact,
    read_exactly,
    turning,
)
from counterspin.campaign.memory.documents import patched
from counterspin.campaign.quantity import Quantity
from counterspin.campaign.readings import is_reading
from counterspin.campaign.truth_tables import RunTruthSettings
from counterspin.records.dialect import Dialect
from counterspin.records.formats import RECORD_FORMATS

#: Most rows, those of all accelerometers together, that are computed at once of records that exist
#: only on paper. A line of a description can state any length, and what is made from it takes
#: memory and time in proportion: at the bound, below 2 GB and about a minute. What is read from
#: files has no such bound.
MOST_ROWS: Final = 1_500_000

#: Most rows of a simulated run; runs are made one after the other, and written.
MOST_SIMULATED_ROWS: Final = 5_000_000

#: Keys of [records] that a run has of its own.
_OWN: Final = ("time", "angle", "temperature", "recorder", "clock", *Dialect.__dataclass_fields__)


def sample_count(duration: float, sampling_rate: float) -> int:
    """Return the samples of a record from t = 0 to the last one within its duration.

    duration, sampling_rate: s, Hz. A sample that falls on the end but for rounding is within.
    """
    return math.floor(duration * sampling_rate * (1.0 + 1e-12)) + 1


class Run(SettingsSection):
    """[[runs]]: one run with a record, at constant nominal rate."""

    name: Text = described("unique", "run1")
    rate: Annotated[float, read_exactly("rad/s"), AfterValidator(turning)] = described(
        "nominal rate; negative is the other sense", "0.25 rev/s"
    )
    record: RecordFile = described(
        f"file, from the campaign's folder: {', '.join(RECORD_FORMATS)}",
        "run1.csv",
    )
    attitude: Attitude = described(
        "of the platform in this run",
        "90 deg about east",
        absent="level",
        kind="attitude",
        default_factory=lambda: attitude_rows("level"),
    )
    duration: Seconds | None = described(
        "for `simulate`; a finding asks about a record shorter than nine tenths of that",
        "400 s",
        None,
        absent="by revolutions",
    )
    revolutions: PositiveRatio | None = described(
        "for `simulate`, in place of a duration", 100, None, absent="those of `[simulation]`"
    )
    temperature: Temperatures | None = described(
        "in this run, for slopes with temperature; or in K. Several count as taken at even times "
        "from its start to its end",
        "23.4 degC",
        None,
        absent="that of its record",
        kind="text, list of text",
    )
    time: Annotated[float, read_exactly("s")] | None = described(
        "when the run began, by any clock, for `K_F.trend`",
        "12 min",
        None,
        absent="after the run before",
    )
    continued_in: list[RecordFile] = described(
        "further files in which the record goes on, of the same kind",
        ["run1-2.csv", "run1-3.csv"],
        [],
        absent="none",
    )
    pulses: RecordFile | None = described(
        "file with the column of the times of pulses",
        "run1-index.csv",
        None,
        absent="in the record",
    )
    records: dict[str, Any] | None = described(
        "keys of `[records]` that differ in this run: `time`, `angle`, `temperature`, `recorder`, "
        "`clock` and how the file is written",
        {"decimal": "."},
        None,
        absent="as `[records]`",
    )
    skip: bool = described("leaves the run out, and the result says so", True, False)
    start: Annotated[float, read_exactly("s")] | None = described(
        "from when the record is used, in its own time", "12 s", None, absent="its first row"
    )
    stop: Annotated[float, read_exactly("s")] | None = described(
        "until when", "390 s", None, absent="its last row"
    )
    truth: Annotated[dict[str, Any] | None, Section(RunTruthSettings)] = described(
        "for `simulate`: [what differs in this run](#truth)",
        {"drift": "2e-6 1/s"},
        None,
        absent="that of `[truth]`",
    )

    _recording: Recording | None = PrivateAttr(None)

    # An attitude is an array, which has no single truth: a run equals itself alone.
    __eq__ = object.__eq__
    __hash__ = object.__hash__

    @property
    def recording(self) -> Recording | None:
        """How its record is read; None: as the campaign's others."""
        return self._recording

    @property
    def part(self) -> tuple[float, float]:
        """From where to where its record is used, s in its own time."""
        start = -math.inf if self.start is None else self.start
        return start, math.inf if self.stop is None else self.stop

    @property
    def files(self) -> tuple[Path, ...]:
        """All its files, the record first."""
        return (self.record, *self.continued_in, *([self.pulses] if self.pulses else []))


def taken_runs(runs: Sequence[Any]) -> list[tuple[int, Any]]:
    """Return the runs that are not left out, with their places in the description."""
    return [(place, run) for place, run in enumerate(runs) if not _is_skipped(run)]


def skipped_runs(runs: Sequence[Any]) -> tuple[str, ...]:
    """Return the names of the runs that are left out."""
    return tuple(str(run.get("name", "?")) for run in runs if _is_skipped(run))


def _is_skipped(run: Any) -> bool:
    return isinstance(run, Mapping) and run.get("skip") is True


def resolve_runs(
    runs: Sequence[tuple[int, Any]],
    folder: Path,
    records: Mapping[str, Any],
    turns: float | None,
    problems: Problems,
) -> dict[int, Run]:
    """Return the runs that have records, by their places, and note every mistake in them.

    folder: Of the record files.
    records: The section [records], as it stands.
    turns: Revolutions of a run that is simulated; None where nothing is.
    """
    resolved: dict[int, Run] = {}
    names: dict[str, int] = {}
    files: dict[str, int] = {}
    for index, raw in runs:
        path = ("runs", index)
        if isinstance(raw, dict):
            _once(raw.get("name"), names, (*path, "name"), problems)
            for key, file in _files(raw):
                if isinstance(file, str) and not _is_elsewhere(raw, file, runs, records):
                    _once(file, files, (*path, key), problems)
        if is_reading(raw):
            continue
        run = problems.check(Run, raw, path, folder=folder)
        if run is not None:
            _check(run, path, problems, simulated=turns is not None)
            resolved[index] = _completed(run, records, turns, path, problems)
    _check_clocks(list(resolved.values()), problems)
    return resolved


def _check(run: Run, path: KeyPath, problems: Problems, *, simulated: bool) -> None:
    """Note what contradicts itself in a run."""
    for place, file in enumerate(run.continued_in):
        if file.suffix.lower() != run.record.suffix.lower():
            words = f"must end in {run.record.suffix.lower()}, as the record does"
            problems.add((*path, "continued_in", place), words)
    if run.duration is not None and run.revolutions is not None:
        problems.add((*path, "duration"), "revolutions is given too; keep one")
    if run.truth is not None and not simulated:
        problems.add((*path, "truth"), "needs [simulation] or [truth]")
    start, stop = run.part
    if not start < stop:
        problems.add((*path, "stop"), "must come after start")


def _completed(
    run: Run, records: Mapping[str, Any], turns: float | None, path: KeyPath, problems: Problems
) -> Run:
    """Return a run with its length, where its revolutions tell it, and how its record is read."""
    turns = run.revolutions or turns
    if run.duration is None and turns is not None:
        run = run.model_copy(update={"duration": turns * 2.0 * math.pi / abs(run.rate)})
    if run.records is not None:
        own = _own_recording(run.records, records, (*path, "records"), problems)
        run = run.completed(recording=own)
    return run


def _files(raw: Mapping[str, Any]) -> list[tuple[str, Any]]:
    """Return the files that a run names, with their keys."""
    more = raw.get("continued_in")
    names = [("continued_in", name) for name in (more if isinstance(more, list) else [])]
    return [("record", raw.get("record")), *names, ("pulses", raw.get("pulses"))]


def _is_elsewhere(
    raw: Mapping[str, Any], file: Any, runs: Sequence[tuple[int, Any]], common: Mapping[str, Any]
) -> bool:
    """Return whether a run uses another part of a file than every other run that names it.

    common: The section [records].
    """
    sharing = [
        other
        for _, other in runs
        if other is not raw and isinstance(other, dict) and other.get("record") == file
    ]
    here = _table_in_file(raw, common)
    same = [one for one in sharing if not _are_two_tables(here, _table_in_file(one, common))]
    if not same:
        return bool(sharing)
    if "start" not in raw and "stop" not in raw:
        return False
    begin, end = _stated_part(raw)
    return all(end <= start or stop <= begin for start, stop in map(_stated_part, same))


def _table_in_file(raw: Mapping[str, Any], common: Mapping[str, Any]) -> list[Any]:
    """Return the sheet and the group that are read of a run's record; None: the only one."""
    own = raw.get("records")
    stated = {**common, **own} if isinstance(own, Mapping) else common
    return [stated.get("sheet"), stated.get("group")]


def _are_two_tables(one: Sequence[Any], other: Sequence[Any]) -> bool:
    return any(a is not None and b is not None and a != b for a, b in zip(one, other, strict=True))


def _stated_part(raw: Mapping[str, Any]) -> tuple[float, float]:
    """Return the part of its record that a run states; all of it if it states none that is one."""
    try:
        start = exact(raw["start"], "s") if "start" in raw else -math.inf
        stop = exact(raw["stop"], "s") if "stop" in raw else math.inf
    except ValueError:
        return -math.inf, math.inf
    return start, stop


def _once(value: Any, seen: dict[str, int], path: KeyPath, problems: Problems) -> None:
    index = path[1]
    assert isinstance(index, int)
    if isinstance(value, str) and seen.setdefault(value, index) != index:
        problems.add(path, f'"{value}" is already used by runs[{seen[value]}]')


def _own_recording(
    own: Mapping[str, Any], common: Mapping[str, Any], path: KeyPath, problems: Problems
) -> Recording | None:
    """Return how a run's record is read, where that differs from the others.

    own, common: The run's `records`, and the section.
    """
    for key in own:
        if key not in _OWN:
            problems.add((*path, key), f"cannot be set for one run; known: {', '.join(_OWN)}")
    if "angle" in own and "angle" not in common:
        problems.add((*path, "angle"), "state an angle in [records], for all runs")
    settings = problems.check(RecordsSettings, patched(common, own), path)
    if settings is None:
        return None
    recording = settings.recording
    if recording.recorder == (common.get("recorder") or ""):
        if "clock" in own:
            problems.add(
                (*path, "clock"), 'name the recorder to which it belongs, as in recorder = "B"'
            )
        return replace(recording, recorder="")
    return recording


def recorders_of(records: Mapping[str, Any], runs: Sequence[Run]) -> dict[str, str]:
    """Return name -> what the runs call it, of each recorder: nothing where it is that of them all.

    records: The section [records], as it stands.
    """
    own = {run.recording.recorder for run in runs if run.recording} - {""}
    return {str(records.get("recorder", "")): "", **{name: name for name in sorted(own)}}


def _check_clocks(runs: Sequence[Run], problems: Problems) -> None:
    """Note recorders of which two runs state two clocks."""
    clocks: dict[str, tuple[str, Quantity | None]] = {}
    for run in runs:
        if run.recording is not None and run.recording.recorder:
            own = run.name, run.recording.clock
            first, clock = clocks.setdefault(run.recording.recorder, own)
            if clock != run.recording.clock:
                problems.add(
                    ("runs",),
                    f'"{first}" and "{run.name}" state two clocks of the recorder '
                    f'"{run.recording.recorder}"; state one',
                )

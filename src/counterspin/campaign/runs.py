"""[[runs]]: records and readings, the part of a record to use, and excluded runs."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field, PrivateAttr

from counterspin.arrays import Array
from counterspin.campaign.columns import Recording, RecordsSettings
from counterspin.campaign.documents import KeyPath, merge_patch
from counterspin.campaign.field_types import (
    AttitudeField,
    Contradiction,
    ParsedQuantity,
    PositiveRatio,
    RecordFile,
    Seconds,
    SettingsSection,
    TableRatio,
    Temperatures,
    Text,
    check_normal,
    check_positive,
    exact_quantity,
    field_extra,
    key_field,
    require_units,
    uncertain_quantity,
)
from counterspin.campaign.quantity import (
    UNKNOWN_ATTITUDE,
    Quantity,
    check_platform_attitude,
    read_attitude,
)
from counterspin.campaign.validation import Problems, Section
from counterspin.errors import Problem, error_code
from counterspin.loading import load_name
from counterspin.physics.terms import MotionKind
from counterspin.records.dialect import Dialect
from counterspin.records.format_registry import RECORD_FORMATS

#: Runs to which a key applies, if it does not apply to all.
RECORDS: Final = "records"
READINGS: Final = "readings"

#: Largest total number of rows that are computed at once for records that do not exist. A stated
#: duration can be arbitrarily long, and memory and time are proportional to it: at the bound, less
#: than 2 GB and about a minute. Records in files have no such bound.
MAX_COMPUTED_ROWS: Final = 1_500_000

#: Largest number of rows of a simulated run; runs are simulated and written one by one.
MAX_SIMULATED_ROWS: Final = 5_000_000

#: Keys of [records] that a run can override.
_RUN_RECORD_KEYS: Final = (
    "time",
    "angle",
    "temperature",
    "recorder",
    "clock",
    *Dialect.__dataclass_fields__,
)


#: Matrix that rotates row vectors by a right angle about up.
_QUARTER_TURN: Final = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def sample_count(duration: float, sampling_rate: float) -> int:
    """Return the number of samples of a record from t = 0 to the end of its duration.

    duration, sampling_rate: s, Hz. A sample at the end counts in spite of rounding errors.
    """
    return math.floor(duration * sampling_rate * (1.0 + 1e-12)) + 1


#: The text of a reading, or a quantity from a table.
_WrittenValue = Text | ParsedQuantity
#: A reading, or repeats of one at the same setting.
WrittenReading = _WrittenValue | Annotated[list[_WrittenValue], Field(min_length=1)]
#: Reading of the only accelerometer, or of several accelerometers by name.
PerAccelerometer = Annotated[
    WrittenReading | dict[str, WrittenReading], BeforeValidator(require_units)
]


class ReadingAxes(SettingsSection):
    """``axes`` of a reading: directions of its axes in the frame of its motion."""

    input: Text | list[float] = key_field(
        "direction of the input axis in the frame of the motion", "inward", kind="direction"
    )
    pendulous: Text | list[float] = key_field(
        "direction of the pendulous axis in the frame of the motion", "up", kind="direction"
    )


class PosesSettings(SettingsSection):
    """``poses`` of a record at rest: settings of their detection."""

    rest: Seconds = key_field(
        "minimum duration of a rest interval that is used as a pose", "1.5 s", 1.5, absent="1.5 s"
    )
    threshold: Annotated[float, exact_quantity("m/s^2"), AfterValidator(check_positive)] | None = (
        key_field(
            "threshold of the scatter below which the sensor is assumed to be at rest",
            "0.05 m/s^2",
            None,
            absent="determined from the record",
        )
    )
    u: Annotated[float, exact_quantity("m/s^2"), AfterValidator(check_positive)] | None = key_field(
        "standard uncertainty of each axis in a pose, excluding the scatter at rest; required "
        "unless there are more poses than requested parameters (nine, or six without angles)",
        "0.01 m/s^2",
        None,
        absent="estimated from the poses",
    )


_TRUTH: Final = "counterspin.campaign.truth:RunTruthSettings"
_READING_CONTRADICTIONS: Final = "counterspin.readings.entries:find_contradictions"


class Run(SettingsSection):
    """[[runs]]: record or reading of a run at constant nominal rate or at rest."""

    name: Text = key_field("unique name of the run", "run1")
    skip: bool = key_field(
        "whether to exclude the run; the result lists excluded runs", True, False
    )
    motion: MotionKind = key_field(
        "motion of the instrument", "static", "counter-rotating", applies_to=READINGS
    )
    stated_rate: Annotated[Quantity, uncertain_quantity("rad/s"), AfterValidator(check_normal)] = (
        key_field(
            "nominal rate, negative for clockwise rotation seen from above; not used at rest. In "
            "a reading, or in an arm run without a recorded angle, `±` gives the standard "
            "uncertainty of the random rate error",
            "0.25 rev/s",
            Quantity(0.0, 0.0, "rad/s"),
            absent="none",
            alias="rate",
        )
    )
    amplitude: Annotated[
        Quantity | None,
        uncertain_quantity("m/s^2"),
        AfterValidator(check_positive),
        AfterValidator(check_normal),
    ] = key_field(
        "peak acceleration of a vibration along the input axis; `±` is the random standard "
        "uncertainty of this amplitude",
        "5 ± 0.01 g",
        None,
        absent="none",
        applies_to=READINGS,
    )
    bias_acceleration: Annotated[float, exact_quantity("m/s^2")] = key_field(
        "mean specific force along the input axis during a vibration, in addition to gravity",
        "10 g",
        0.0,
        absent="gravity only",
        applies_to=READINGS,
    )
    file: RecordFile | None = key_field(
        f"path of the record file, relative to the campaign folder ({', '.join(RECORD_FORMATS)}). "
        "On an arm, the reading is the mean over complete revolutions; at rest, it is the mean of "
        "the record. The uncertainty of the reading is computed from the noise",
        "run1.csv",
        None,
        absent="`reading`",
        alias="record",
    )
    reading: PerAccelerometer | None = key_field(
        "value with unit, in place of a `record`; `±` gives the standard uncertainty. A list "
        "contains repeated readings at one setting: counterspin uses their mean, and estimates "
        "the noise from their scatter",
        "1.082532 ± 2e-6 mA",
        None,
        absent="`record`",
        applies_to=READINGS,
    )
    stated_attitude: AttitudeField = key_field(
        "attitude of the platform in this run; at rest, either this key or `axes` is required. "
        "`±` gives the uncertainty of the dividing head in a reading, or of the table angle in a "
        "record with a `table_ratio`. `unknown` marks a pose of a triad",
        "90 deg about east",
        absent="level",
        kind="attitude",
        alias="attitude",
        default_factory=lambda: read_attitude("level"),
    )
    head: Annotated[float, exact_quantity("rad")] | None = key_field(
        "reading of the dividing head, if it differs from the angle of the attitude "
        "because of the way the instrument is mounted",
        "120 deg",
        None,
        absent="the angle of the attitude",
        applies_to=READINGS,
    )
    axes: ReadingAxes | None = key_field(
        "directions of the `input` and `pendulous` axes in the frame of the motion, in place of "
        "an attitude",
        {"input": "inward", "pendulous": "up"},
        None,
        absent="`attitude`",
        applies_to=READINGS,
    )
    poses: PosesSettings | None = key_field(
        "settings for the detection of [poses](triads.md) in a `record` whose attitude is "
        "`unknown`",
        {"rest": "1.5 s"},
        None,
        absent="rest intervals of 1.5 s",
        applies_to=READINGS,
    )
    mounting: str = key_field("name of the position on the fixture", "in", "", applies_to=READINGS)
    duration: Seconds | None = key_field(
        "duration of the record, for [simulate](readings.md#simulating-readings); a finding "
        "reports a record that is shorter than 90 % of this duration, and a remark a longer record",
        "400 s",
        None,
        absent="by revolutions",
    )
    revolutions: PositiveRatio | None = key_field(
        "number of revolutions, for `simulate`, instead of a duration",
        100,
        None,
        absent="as in `[simulation]`",
    )
    temperature: Temperatures | None = key_field(
        "temperature of the run in °C or K, needed for temperature slopes; a list contains values "
        "at equal intervals from the start to the end of the record",
        "23.4 degC",
        None,
        absent="the recorded temperature",
        kind="text or list of texts",
    )
    time: Annotated[float, exact_quantity("s")] | None = key_field(
        "start time of the run, or time of the reading, on any clock; used for `K_F.trend`",
        "12 min",
        None,
        absent="the end of the previous run",
    )
    table_ratio: TableRatio = key_field(
        "rotation angle of the table relative to the arm, divided by the spindle angle: a number "
        "or a fraction such as 1/2. A ratio other than -1 requires records of specific force with "
        "the spindle angle, and `strapped = true`",
        -2,
        -1.0,
        absent="-1 (constant attitude in space)",
        applies_to=RECORDS,
    )
    continued_in: list[RecordFile] = key_field(
        "further files of the same format in which the record continues",
        ["run1-2.csv", "run1-3.csv"],
        [],
        absent="none",
        applies_to=RECORDS,
    )
    pulses: RecordFile | None = key_field(
        "file that contains the column of pulse times",
        "run1-index.csv",
        None,
        absent="in the record",
        applies_to=RECORDS,
    )
    records: dict[str, Any] | None = key_field(
        "keys of `[records]` that differ in this run: `time`, `angle`, `temperature`, `recorder`, "
        "`clock` and the keys of the file format; for a record of poses, only the keys of the "
        "file format",
        {"decimal": "."},
        None,
        absent="as in `[records]`",
        applies_to=RECORDS,
    )
    start: Annotated[float, exact_quantity("s")] | None = key_field(
        "start of the part of the record to use, on the time scale of the record",
        "12 s",
        None,
        absent="first row",
        applies_to=RECORDS,
    )
    stop: Annotated[float, exact_quantity("s")] | None = key_field(
        "end of the part of the record to use, on the time scale of the record",
        "390 s",
        None,
        absent="last row",
        applies_to=RECORDS,
    )
    truth: Annotated[dict[str, Any] | None, Section(_TRUTH)] = key_field(
        "[true values that differ in this run](campaign.md#truth), for `simulate`",
        {"drift": "2e-6 1/s"},
        None,
        absent="as in `[truth]`",
    )

    _recording: Recording | None = PrivateAttr(None)

    # Arrays, such as the attitude, have no truth value: runs are compared by identity.
    __eq__ = object.__eq__
    __hash__ = object.__hash__

    @property
    def recording(self) -> Recording | None:
        """The recording of the run; None: that of the campaign."""
        return self._recording

    @property
    def record(self) -> Path:
        """The first file of the record."""
        assert self.file is not None
        return self.file

    @property
    def rate(self) -> float:
        """The nominal rate, rad/s."""
        return self.stated_rate.value

    @property
    def u_rate(self) -> float | None:
        """Random standard uncertainty of the rate, rad/s; None: not stated."""
        return self.stated_rate.u or None

    @property
    def turns_in_space(self) -> bool:
        """Whether the table with the instrument rotates in space."""
        return self.table_ratio != -1.0

    @property
    def attitude(self) -> Array:
        """Axes of the platform as rows, shape (3, 3)."""
        return self.stated_attitude.rows

    @property
    def table_angle_prior(self) -> Quantity | None:
        """Prior of the rotation about up, if the table angle has a stated uncertainty."""
        return Quantity(0.0, self.stated_attitude.u, "rad") if self.stated_attitude.u else None

    @property
    def attitude_keys(self) -> tuple[bytes, ...]:
        """Hashable keys of the attitudes by which errors act: the attitude, and a quarter turn."""
        turned_attitudes = [self.attitude @ _QUARTER_TURN] if self.turns_in_space else []
        return tuple(attitude.tobytes() for attitude in (self.attitude, *turned_attitudes))

    @property
    def length(self) -> float | None:
        """The stated length of the record, s; or None."""
        if self.revolutions is None or not self.rate:
            return self.duration
        return 2.0 * math.pi * self.revolutions / abs(self.rate)

    @property
    def time_range(self) -> tuple[float, float]:
        """Start and end of the used part of the record, s on its time scale."""
        start = -math.inf if self.start is None else self.start
        return start, math.inf if self.stop is None else self.stop

    @property
    def files(self) -> tuple[Path, ...]:
        """All files of the run, the record first."""
        return (self.record, *self.continued_in, *([self.pulses] if self.pulses else []))

    def contradictions(self) -> Iterator[Contradiction]:
        """Yield missing, superfluous and contradictory keys."""
        is_reading_run = self.motion != "counter-rotating" or self.reading is not None
        excluded_kind = RECORDS if is_reading_run else READINGS
        for name, field in type(self).model_fields.items():
            if name == "records" and self.stated_attitude.is_unknown and self.file is not None:
                continue  # A record of poses states the format of its file.
            if name in self.model_fields_set and field_extra(field).get("x-of") == excluded_kind:
                other_kind = "a record of a double turntable" if is_reading_run else "a reading"
                message = f"applies to a run with {other_kind}; omit it"
                if name == "records" and self.record is not None:
                    message += (
                        ". [records] applies to all records on the arm and at rest: all of them "
                        "must have the same columns and units"
                    )
                yield (field.alias or name,), message, "motion", "reading"
        if self.duration is not None and self.revolutions is not None:
            yield ("duration",), "revolutions is also given; keep only one of them"
        yield from (
            load_name(_READING_CONTRADICTIONS)(self)
            if is_reading_run
            else self._find_record_contradictions()
        )

    def _find_record_contradictions(self) -> Iterator[Contradiction]:
        if self.file is None:
            yield ("record",), Problem("is missing", "missing-key"), "motion", "reading"
        if self.rate == 0.0:
            has_rate = "stated_rate" in self.model_fields_set
            message = "is zero, but the centrifuge must rotate" if has_rate else "is missing"
            code = "value-out-of-range" if has_rate else "missing-key"
            yield ("rate",), Problem(message, code), "motion", "reading"
        # Only the angle of a table, about up, may be uncertain.
        has_table_angle = self.turns_in_space and abs(self.stated_attitude.head_axis[2]) == 1.0
        try:
            check_platform_attitude(
                replace(self.stated_attitude, u=0.0) if has_table_angle else self.stated_attitude
            )
        except ValueError as error:
            yield ("attitude",), Problem(str(error), error_code(error)), "motion", "reading"
        for index, file in enumerate(self.continued_in if self.file else ()):
            if file.suffix.lower() != self.record.suffix.lower():
                ending_message = f"must end in {self.record.suffix.lower()}, like the record"
                yield ("continued_in", index), Problem(ending_message, "wrong-file-ending")
        start, stop = self.time_range
        if not start < stop:
            yield ("stop",), Problem("must come after start", "value-out-of-range"), "start"


def is_reading(entry: object) -> bool:
    """Return whether an entry of ``[[runs]]`` is an included reading, and not a record."""
    if not isinstance(entry, Mapping) or _is_skipped(entry):
        return False
    return entry.get("motion", "counter-rotating") != "counter-rotating" or "reading" in entry


def is_pose(entry: Any) -> bool:
    """Return whether an entry of ``[[runs]]`` has an unknown attitude."""
    return isinstance(entry, Mapping) and entry.get("attitude") == UNKNOWN_ATTITUDE


def included_runs(runs: Sequence[Any]) -> list[tuple[int, Any]]:
    """Return the included runs with their indices in the description."""
    return [(index, run) for index, run in enumerate(runs) if not _is_skipped(run)]


def skipped_runs(runs: Sequence[Any]) -> tuple[str, ...]:
    """Return the names of the excluded runs."""
    return tuple(str(run.get("name", "?")) for run in runs if _is_skipped(run))


def _is_skipped(run: Any) -> bool:
    return isinstance(run, Mapping) and run.get("skip") is True


def resolve_runs(
    runs: Sequence[tuple[int, Any]],
    folder: Path,
    records: Mapping[str, Any],
    revolutions: float | None,
    problems: Problems,
) -> dict[int, Run]:
    """Return the runs with records by their indices; report mistakes in them.

    folder: Folder of the record files.
    records: Unchecked section [records].
    revolutions: Number of revolutions of a simulated run; None without a simulation.
    """
    run_by_index: dict[int, Run] = {}
    for index, raw in runs:
        path = ("runs", index)
        run = None if is_reading(raw) else problems.check(Run, raw, path, folder=folder)
        if run is not None and run.file is not None:
            run_by_index[index] = _complete_run(run, records, revolutions, path, problems)
    return run_by_index


def _complete_run(
    run: Run,
    records: Mapping[str, Any],
    revolutions: float | None,
    path: KeyPath,
    problems: Problems,
) -> Run:
    """Return a run with its duration, if its revolutions determine it, and its recording."""
    revolutions = run.revolutions or revolutions
    if run.duration is None and revolutions is not None and run.rate:
        run = run.model_copy(update={"duration": revolutions * 2.0 * math.pi / abs(run.rate)})
    if run.records is not None:
        recording = _resolve_recording(run.records, records, (*path, "records"), problems)
        run = run.replace_private(recording=recording)
    return run


def _resolve_recording(
    run_section: Mapping[str, Any],
    common_section: Mapping[str, Any],
    path: KeyPath,
    problems: Problems,
) -> Recording | None:
    """Return the recording of a run that differs from the default recording.

    run_section, common_section: Key `records` of the run, and the section [records].
    """
    for key in run_section:
        if key not in _RUN_RECORD_KEYS:
            problems.add(
                (*path, key),
                f"cannot be set for a single run; known keys: {', '.join(_RUN_RECORD_KEYS)}",
            )
    if "angle" in run_section and "angle" not in common_section:
        problems.add((*path, "angle"), "state an angle for all runs in [records]", "missing-key")
    settings = problems.check(RecordsSettings, merge_patch(common_section, run_section), path)
    if settings is None:
        return None
    recording = settings.recording
    if recording.recorder == (common_section.get("recorder") or ""):
        if "clock" in run_section:
            problems.add(
                (*path, "clock"),
                'name the recorder of this clock, such as recorder = "B"',
                "missing-key",
            )
        return replace(recording, recorder="")
    return recording


def recorders_of(records: Mapping[str, Any], runs: Sequence[Run]) -> dict[str, str]:
    """Return recorder -> its name in the runs, which is empty for the default recorder.

    records: Unchecked section [records].
    """
    recorders = {run.recording.recorder for run in runs if run.recording} - {""}
    return {str(records.get("recorder", "")): "", **{name: name for name in sorted(recorders)}}

"""The truth of a simulated campaign, read from [simulation], [truth] and each run's `truth`.

A calibration never uses it: only `counterspin simulate` reads `Campaign.simulation`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import field
from typing import Annotated, Any, Final

from pydantic import AfterValidator, Field, PrivateAttr

from counterspin.campaign.accelerometers import TRUTH_TABLES
from counterspin.campaign.documents import KeyPath, flatten_keys, table_of
from counterspin.campaign.field_types import (
    PositiveRatio,
    SettingsSection,
    check_positive,
    exact_quantity,
    key_field,
    parse_exact,
)
from counterspin.campaign.model import to_deviation
from counterspin.campaign.quantity import Quantity
from counterspin.campaign.reading import Reading
from counterspin.campaign.runs import Run
from counterspin.campaign.settings import CentrifugeSettings, Output, StatedNoise
from counterspin.campaign.terms import expand_name, shown_symbols
from counterspin.campaign.truth import (
    ALL_RECORDERS,
    TRUE_TABLES,
    AccelerometerTruthSettings,
    RippleSettings,
    RunTruthSettings,
)
from counterspin.campaign.validation import Problems, suggest_name
from counterspin.frozen import frozen
from counterspin.inference.joint.series import CLOCK
from counterspin.physics.frequency_response import CUTOFF
from counterspin.physics.spindle import Ripple, Spindle
from counterspin.physics.terms import ACCELEROMETER_TERMS, COMMON_NAMES, SHARED_TERMS, term

#: Tables of errors shared by all accelerometers.
_SHARED_TABLES: Final = ("platform", "centrifuge", "encoder", "table")

#: Key of the machine's table in [truth].
_MACHINE_KEY: Final = "machine"

#: Machine term that also affects records, and is therefore a key of [truth.centrifuge].
_STRETCH_SYMBOL: Final = "centrifuge.stretch"


@frozen
class RunTruth:
    """True spindle motion and platform errors of one simulated run."""

    spindle: Spindle  #: True motion of the spindle.
    #: Symbol of a shared term -> true value, SI; missing terms are zero.
    shared: Mapping[str, float]


@frozen
class SimulatedTruth:
    """The truth of a simulated campaign; no calibration reads it."""

    #: Accelerometer -> term symbol -> true value in g-units; terms not named are nominal.
    coefficients: Mapping[str, Mapping[str, float]]
    #: Accelerometer -> initial error of displacement (m) and velocity (m/s) in each run.
    start_offset: Mapping[str, float]
    start_velocity: Mapping[str, float]
    noise: StatedNoise  #: True noise of records; every component is a number.
    runs: Mapping[str, RunTruth]  #: Run -> truth.
    #: Name and stated rate (rad/s) of a rotating run whose mean is a reading -> truth.
    reading_runs: Mapping[tuple[str, float], RunTruth] = field(default_factory=dict)
    #: Recorder (for a clock, or else empty) and input -> true value, SI; missing inputs have the
    #: value that the description states.
    inputs: Mapping[tuple[str, str], float] = field(default_factory=dict)
    #: Machine term -> true value minus nominal, SI.
    machine: Mapping[str, float] = field(default_factory=dict)
    #: Accelerometer -> true noise of its readings, g; by default, the stated uncertainty of each
    #: reading.
    reading_noise: Mapping[str, float] = field(default_factory=dict)


class Simulation(SettingsSection):
    """[simulation]: sampling of simulated records."""

    sampling_rate: Annotated[float, exact_quantity("Hz"), AfterValidator(check_positive)] = (
        key_field("sampling rate", "100 Hz", 50.0, absent="50 Hz")
    )
    seed: Annotated[int, Field(ge=0)] = key_field(
        "seed of the random number generator; each run uses a separate stream", 7, 1
    )
    revolutions: PositiveRatio = key_field("number of revolutions in each run", 40, 100.0)
    poses: Annotated[int, Field(ge=1, le=10_000)] = key_field(
        "number of poses in a record of [poses](triads.md#poses-in-a-record)", 12, 24
    )

    _truth: SimulatedTruth = PrivateAttr()

    @property
    def truth(self) -> SimulatedTruth:
        """The truth from which the records are simulated."""
        return self._truth


# Reader of [truth]


@frozen
class DescribedRuns:
    """The described runs and readings to simulate."""

    runs: Mapping[int, Run]  #: Index in the description -> run with a record.
    #: None if some readings are invalid, so that the terms that affect them are unknown.
    readings: Sequence[Reading] | None
    #: Run whose mean is a reading -> its `truth` and key path.
    truths: Mapping[str, tuple[Mapping[str, Any], KeyPath]]

    def truth_of(self, reading: Reading) -> tuple[Mapping[str, Any], KeyPath]:
        """Return the `truth` of the run of a reading, and its key path."""
        return self.truths.get(reading.name, ({}, ("truth", "spindle")))


class TruthReader:
    """Reads [truth]; each table is checked once, even where another one is wrong.

    raw: Unchecked section.
    names: Names of the accelerometers.
    gravity: Gravity of the site, m/s^2.
    """

    def __init__(
        self, raw: Mapping[str, Any], names: Sequence[str], problems: Problems, gravity: float
    ) -> None:
        self.raw, self.names, self.problems, self.gravity = raw, names, problems, gravity
        #: Name -> validated table; None if it is invalid.
        self.tables: dict[str, Any] = {
            name: problems.check(model, raw[name], ("truth", name), gravity=gravity)
            if name in raw
            else model.model_construct()  # the defaults, without the cost of a validator
            for name, model in TRUE_TABLES.items()
        }
        self._move_stretch()

    def _machine_values(self) -> dict[str, Any]:
        """Return term -> text of its true value, from [truth.machine]."""
        if not isinstance(self.raw.get(_MACHINE_KEY, {}), Mapping):
            self.problems.add(("truth", _MACHINE_KEY), "must be a table", "wrong-type")
        return flatten_keys(table_of(self.raw, _MACHINE_KEY))

    def _move_stretch(self) -> None:
        """Move the stretch from [truth.machine] to [truth.centrifuge]: it also affects records."""
        path, centrifuge = ("truth", _MACHINE_KEY, _STRETCH_SYMBOL), self.tables["centrifuge"]
        if (text := self._machine_values().get(_STRETCH_SYMBOL)) is None or centrifuge is None:
            return
        if centrifuge.stretch is not None:
            self.problems.add(path, "is also in [truth.centrifuge]; keep only one of them")
            return
        stretch = self.problems.collect(path, parse_exact, text, term(_STRETCH_SYMBOL).unit)
        self.tables["centrifuge"] = centrifuge.model_copy(update={"stretch": stretch})

    def _resolve_run(
        self, rate: float, truth: Mapping[str, Any] | None, path: KeyPath
    ) -> RunTruth | None:
        """Return the true spindle and shared errors of a run; its own values take precedence.

        rate: Stated rate, rad/s.
        truth, path: `truth` of the run, and its key path.
        """
        common_spindle = self.tables["spindle"]
        run_settings: Any = (
            self.problems.check(RunTruthSettings, truth, path)
            if truth
            else RunTruthSettings.model_construct()
        )
        shared_tables = {family: self.tables[family] for family in _SHARED_TABLES}
        if common_spindle is None or None in shared_tables.values() or run_settings is None:
            return None

        def lookup(key: str, default: Any) -> Any:
            values = (getattr(run_settings, key), getattr(common_spindle, key), default)
            return next(value for value in values if value is not None)

        true_rate = rate * (1.0 + lookup("rate_error", 0.0))
        ripple_path: KeyPath = (
            (*path, "ripple") if run_settings.ripple is not None else ("truth", "spindle")
        )
        ripples = tuple(
            _resolve_ripple(entry, true_rate, ripple_path, self.problems)
            for entry in lookup("ripple", ())
        )
        spindle = Spindle(true_rate, lookup("drift", 0.0), ripples, lookup("start_angle", 0.0))
        values: dict[str, float] = {}
        for symbol, row in SHARED_TERMS.items():
            family, *keys = symbol.split(".")
            # `drift` of a run is that of the spindle; its only shared error is the tilt.
            own_value = _nested_value(run_settings, keys) if row.per_run else None
            value = _nested_value(shared_tables[family], keys) if own_value is None else own_value
            if value is not None:
                values[symbol] = value
        return RunTruth(spindle, values)

    def simulation(
        self,
        sampling: Simulation,
        outputs: Mapping[str, Output | None],
        noise: StatedNoise | None,
        described_runs: DescribedRuns,
        centrifuge: CentrifugeSettings | None,
        recorders: Mapping[str, str],
    ) -> Simulation:
        """Return the settings of simulated records and readings, and their truth.

        outputs: Accelerometer -> valid output; coefficients may be in its unit, as ``mA/g``.
        centrifuge: Settings of the centrifuge; a true radius may be stated as a value.
        recorders: Recorder -> its name in the runs, empty for the default recorder.
        """
        known_names = [*self.names, *TRUTH_TABLES]
        for name in [name for name in self.raw if self.names and name not in known_names]:
            text = "is neither an accelerometer nor a known table" + suggest_name(name, known_names)
            self.problems.add(("truth", name), text, "unknown-accelerometer")
        truths = {
            name: self._resolve_accelerometer(name, output) for name, output in outputs.items()
        }
        tables = {name: table for name, (table, _) in truths.items() if table is not None}
        truth_by_run = {
            run.name: self._resolve_run(run.rate, run.truth, ("runs", index, "truth"))
            for index, run in described_runs.runs.items()
        }
        truth_by_reading = {
            (reading.name, reading.rate): self._resolve_run(
                reading.rate, *described_runs.truth_of(reading)
            )
            for reading in described_runs.readings or ()
            if reading.rate
        }
        truth = SimulatedTruth(
            coefficients={name: truths[name][1] for name in tables},
            start_offset={name: table.start_offset for name, table in tables.items()},
            start_velocity={name: table.start_velocity for name, table in tables.items()},
            noise=self._resolve_record_noise(noise),
            runs={
                name: run_truth for name, run_truth in truth_by_run.items() if run_truth is not None
            },
            reading_runs={
                key: run_truth
                for key, run_truth in truth_by_reading.items()
                if run_truth is not None
            },
            inputs=true_inputs(self.tables, recorders, self.problems) | _true_responses(tables),
            machine=self._resolve_machine(described_runs.readings, centrifuge),
            reading_noise=self._resolve_reading_noise(outputs),
        )
        return sampling.replace_private(truth=truth)

    def _resolve_accelerometer(
        self, name: str, output: Output | None
    ) -> tuple[Any, dict[str, float]]:
        """Return the validated table of an accelerometer, and its coefficients by symbol."""
        path, raw = ("truth", name), self.raw.get(name, {})
        table: Any = self.problems.check(
            AccelerometerTruthSettings, raw, path, gravity=self.gravity, output=output
        )
        if table is None:
            return None, {}
        values = {symbol: getattr(table, symbol) for symbol in ACCELEROMETER_TERMS}
        for key, symbol in COMMON_NAMES.items():
            if None not in (getattr(table, key), values[symbol]):
                self.problems.add((*path, key), f"duplicates {symbol}; keep one of them")
            values[symbol] = getattr(table, key) if values[symbol] is None else values[symbol]
        return table, {symbol: value for symbol, value in values.items() if value is not None}

    def _resolve_machine(
        self, readings: Sequence[Reading] | None, centrifuge: CentrifugeSettings | None
    ) -> dict[str, float]:
        """Return machine term -> true value minus nominal, SI."""
        if readings is None:
            return {}
        known_symbols = [
            symbol for symbol in shown_symbols(readings) if symbol not in ACCELEROMETER_TERMS
        ]
        deviations: dict[str, float] = {}
        for key, text in self._machine_values().items():
            path = ("truth", _MACHINE_KEY, key)
            symbols = expand_name(key, known_symbols)
            if key in ACCELEROMETER_TERMS:
                message = "is a term of an accelerometer; write it in [truth.NAME]"
                self.problems.add(path, message)
            elif not symbols:
                self.problems.add(
                    path,
                    f'no reading depends on "{key}"' + suggest_name(key, known_symbols),
                    "term-without-effect",
                )
            for symbol in symbols:
                unit = term(symbol).unit
                value = self.problems.collect(path, parse_exact, text, unit)
                if value is not None:
                    deviation = to_deviation(symbol, Quantity(value, 0.0, unit), centrifuge)
                    deviations[symbol] = deviation.value
        for symbol in known_symbols:
            family, *keys = symbol.split(".")
            if symbol == _STRETCH_SYMBOL or family == "table":
                value = _nested_value(self.tables[family], keys)
                deviations |= {} if value is None else {symbol: value}
        return deviations

    def _resolve_record_noise(self, stated_noise: StatedNoise | None) -> StatedNoise:
        """Return the true noise of records, by default that of [noise]."""
        table = self.tables["noise"]
        noise = stated_noise if "noise" not in self.raw else table and table.record_noise
        return noise or StatedNoise()

    def _resolve_reading_noise(self, outputs: Mapping[str, Output | None]) -> dict[str, float]:
        """Return accelerometer -> true noise of its readings, g."""
        stated_noise = self.tables["noise"] and self.tables["noise"].reading
        if stated_noise is None:
            return {}
        path: KeyPath = ("truth", "noise", "reading")
        noise_by_accelerometer = {}
        for name, text in (
            stated_noise
            if isinstance(stated_noise, Mapping)
            else dict.fromkeys(outputs, stated_noise)
        ).items():
            if name not in outputs:
                if name not in self.names:
                    message = f'no accelerometer is named "{name}"' + suggest_name(name, self.names)
                    self.problems.add(path, message, "unknown-accelerometer")
                continue
            output = outputs[name]
            unit, sensitivity = ("g", 1.0) if output is None else (output.unit, output.sensitivity)
            gravity = self.gravity if output is None else None
            value = self.problems.collect(path, parse_exact, text, unit, gravity)
            if value is not None and value < 0.0:
                self.problems.add(
                    path, "a standard deviation cannot be negative", "value-out-of-range"
                )
            elif value is not None:
                noise_by_accelerometer[name] = value / abs(sensitivity)
        return noise_by_accelerometer


def _nested_value(table: Any, keys: Sequence[str]) -> float | None:
    """Return the value of nested tables at keys, or None."""
    for key in keys:
        table = None if table is None else getattr(table, key)
    value: float | None = table
    return value


def _resolve_ripple(
    entry: RippleSettings, rate: float, path: KeyPath, problems: Problems
) -> Ripple:
    if (entry.ratio is None) == (entry.amplitude is None):
        problems.add(path, "give each ripple either a ratio w_n/w0 or an amplitude in rad/s")
    amplitude = entry.ratio * rate if entry.ratio is not None else entry.amplitude or 0.0
    return Ripple(entry.harmonic, amplitude, entry.phase)


def true_inputs(
    tables: Mapping[str, Any], recorders: Mapping[str, str], problems: Problems
) -> dict[tuple[str, str], float]:
    """Return (recorder of a clock or empty, symbol) -> input that [truth] states, SI.

    tables: Validated tables of [truth]; None for invalid tables.
    recorders: As `counterspin.campaign.runs.recorders_of` returns them.
    """
    site, records, centrifuge = (tables[name] for name in ("site", "records", "centrifuge"))
    input_values = {
        ("", "site.gravity"): site and site.gravity,
        ("", "site.latitude"): site and site.latitude,
        ("", "centrifuge.radius"): centrifuge and centrifuge.radius,
        ("", "centrifuge.clock"): centrifuge and centrifuge.clock,
        ("", "records.timing_offset"): records and records.timing_offset,
        ("", CUTOFF): records and records.cutoff_frequency,
    }
    clocks = _resolve_clocks((records and records.clock) or {}, recorders, problems)
    return {key: value for key, value in input_values.items() if value is not None} | clocks


def _true_responses(tables: Mapping[str, Any]) -> dict[tuple[str, str], float]:
    """Return (accelerometer, symbol) -> input of a frequency response, SI."""
    return {
        (name, f"sensor.{key}"): value
        for name, table in tables.items()
        for key in ("natural_frequency", "damping")
        if (value := getattr(table, key)) is not None
    }


def _resolve_clocks(
    clock_errors: Mapping[str, float], recorders: Mapping[str, str], problems: Problems
) -> dict[tuple[str, str], float]:
    if ALL_RECORDERS in clock_errors:
        return {(owner, CLOCK): clock_errors[ALL_RECORDERS] for owner in recorders.values()}
    for name in sorted(clock_errors.keys() - recorders.keys()):
        path: KeyPath = ("truth", "records", "clock", name)
        problems.add(
            path,
            f'no run uses this recorder; write recorder = "{name}" in [records], or in the '
            "records of a run",
            "unknown-choice",
        )
    return {
        (recorders[name], CLOCK): clock_error
        for name, clock_error in clock_errors.items()
        if name in recorders
    }

"""The truth of a simulated campaign, read from [simulation], [truth] and each run's `truth`.

Nothing here reaches a calibration: `Campaign.simulation` is read by `counterspin simulate` only.
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
    exact,
    key_field,
    positive,
    read_exactly,
)
from counterspin.campaign.model import as_deviation
from counterspin.campaign.quantity import Quantity
from counterspin.campaign.reading import Reading
from counterspin.campaign.runs import Run
from counterspin.campaign.settings import CentrifugeSettings, Output, StatedNoise
from counterspin.campaign.terms import expand, symbols_shown
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

#: Tables of the errors that all accelerometers share.
_SHARED: Final = ("platform", "centrifuge", "encoder", "table")

#: The machine's table of [truth].
_MACHINE: Final = "machine"

#: Term that records show too, and its place in [truth.centrifuge].
_STRETCH: Final = "centrifuge.stretch"


@frozen
class RunTruth:
    """True spindle motion and platform errors of one simulated run."""

    spindle: Spindle  #: The true motion of the spindle.
    #: Symbol of a shared term -> true value, SI; those that are not there are zero.
    shared: Mapping[str, float]


@frozen
class SimulatedTruth:
    """The truth of a simulated campaign; no calibration reads it."""

    #: Accelerometer -> term symbol -> true value in g-units; terms not named are nominal.
    coefficients: Mapping[str, Mapping[str, float]]
    #: Accelerometer -> error of the displacement at the start of each run and of its rate of
    #: change: m, m/s.
    start_offset: Mapping[str, float]
    start_velocity: Mapping[str, float]
    noise: StatedNoise  #: True noise of records; every component a number.
    runs: Mapping[str, RunTruth]  #: Run -> what is true of its motion and of what all share.
    #: The same for runs that turn and whose mean is a reading, by name and stated rate, rad/s.
    read: Mapping[tuple[str, float], RunTruth] = field(default_factory=dict)
    #: Recorder (of its clock; else empty) and input -> true value, SI; those that are not there are
    #: what the description states.
    inputs: Mapping[tuple[str, str], float] = field(default_factory=dict)
    #: Term of the machine -> true value less nominal, SI.
    machine: Mapping[str, float] = field(default_factory=dict)
    #: Accelerometer -> true noise of its readings, g; of one that is not named, each reading has
    #: that which is stated with it.
    reading_noise: Mapping[str, float] = field(default_factory=dict)


class Simulation(SettingsSection):
    """[simulation]: sampling of simulated records."""

    sampling_rate: Annotated[float, read_exactly("Hz"), AfterValidator(positive)] = key_field(
        "sampling rate", "100 Hz", 50.0, absent="50 Hz"
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
        """The truth that the records are made from."""
        return self._truth


# Read


@frozen
class DescribedRuns:
    """The runs that a description has, for the simulation."""

    runs: Mapping[int, Run]  #: Those with records, by their places in the description.
    #: None where there are mistakes in them, so that it is not known what they depend on.
    readings: Sequence[Reading] | None
    #: Run whose mean is a reading -> its `truth`, and where that is.
    truths: Mapping[str, tuple[Mapping[str, Any], KeyPath]]

    def truth_of(self, reading: Reading) -> tuple[Mapping[str, Any], KeyPath]:
        """Return the deviations in the run of a reading, and their place."""
        return self.truths.get(reading.name, ({}, ("truth", "spindle")))


class TruthReader:
    """Reads [truth]; each table is checked once, even where another one is wrong.

    raw: The section, as it stands.
    names: Of the accelerometers that there are.
    gravity: The site's, m/s^2.
    """

    def __init__(
        self, raw: Mapping[str, Any], names: Sequence[str], problems: Problems, gravity: float
    ) -> None:
        self.raw, self.names, self.problems, self.gravity = raw, names, problems, gravity
        #: Table -> what it says; None with its mistakes noted.
        self.tables: dict[str, Any] = {
            name: problems.check(model, raw[name], ("truth", name), gravity=gravity)
            if name in raw
            else model.model_construct()  # the defaults, without the cost of a validator
            for name, model in TRUE_TABLES.items()
        }
        self._take_stretch()

    def _machine(self) -> dict[str, Any]:
        """Return the truth of the machine's terms that readings show."""
        if not isinstance(self.raw.get(_MACHINE, {}), Mapping):
            self.problems.add(("truth", _MACHINE), "must be a table", "wrong-type")
        return flatten_keys(table_of(self.raw, _MACHINE))

    def _take_stretch(self) -> None:
        """Count the stretch among what readings show as that of the centrifuge: records show it."""
        path, centrifuge = ("truth", _MACHINE, _STRETCH), self.tables["centrifuge"]
        if (text := self._machine().get(_STRETCH)) is None or centrifuge is None:
            return
        if centrifuge.stretch is not None:
            self.problems.add(path, "is also in [truth.centrifuge]; keep only one of them")
            return
        stretch = self.problems.collect(path, exact, text, term(_STRETCH).unit)
        self.tables["centrifuge"] = centrifuge.model_copy(update={"stretch": stretch})

    def _of_run(
        self, rate: float, truth: Mapping[str, Any] | None, path: KeyPath
    ) -> RunTruth | None:
        """Return the true spindle and machine of one run; its own values take precedence.

        rate: The stated rate, rad/s.
        truth, path: Its `truth`, and where that is.
        """
        common_settings = self.tables["spindle"]
        run_settings: Any = (
            self.problems.check(RunTruthSettings, truth, path)
            if truth
            else RunTruthSettings.model_construct()
        )
        shared = {family: self.tables[family] for family in _SHARED}
        if common_settings is None or None in shared.values() or run_settings is None:
            return None

        def first(key: str, default: Any) -> Any:
            values = (getattr(run_settings, key), getattr(common_settings, key), default)
            return next(value for value in values if value is not None)

        true_rate = rate * (1.0 + first("rate_error", 0.0))
        ripple_path: KeyPath = (
            (*path, "ripple") if run_settings.ripple is not None else ("truth", "spindle")
        )
        ripples = tuple(
            _ripple(entry, true_rate, ripple_path, self.problems) for entry in first("ripple", ())
        )
        spindle = Spindle(true_rate, first("drift", 0.0), ripples, first("start_angle", 0.0))
        values: dict[str, float] = {}
        for symbol, row in SHARED_TERMS.items():
            family, *keys = symbol.split(".")
            # A run's own `drift` is the spindle's; of the shared errors it has the tilt only.
            own_value = _stated(run_settings, keys) if row.per_run else None
            value = _stated(shared[family], keys) if own_value is None else own_value
            if value is not None:
                values[symbol] = value
        return RunTruth(spindle, values)

    def simulation(
        self,
        sampled: Simulation,
        outputs: Mapping[str, Output | None],
        noise: StatedNoise | None,
        described: DescribedRuns,
        centrifuge: CentrifugeSettings | None,
        recorders: Mapping[str, str],
    ) -> Simulation:
        """Return the settings of simulated records and readings, and their truth.

        outputs: Accelerometer -> unit of its readings, where it is valid; coefficients may be in
            its unit, as ``mA/g``.
        centrifuge: The machine; a true radius may be given as such.
        recorders: Name of a recorder -> its name in the runs: empty where it is that of all.
        """
        known = [*self.names, *TRUTH_TABLES]
        for name in [name for name in self.raw if self.names and name not in known]:
            message = "is neither an accelerometer nor a known table" + suggest_name(name, known)
            self.problems.add(("truth", name), message, "unknown-accelerometer")
        accelerometer_truths = {
            name: self._accelerometer(name, output) for name, output in outputs.items()
        }
        tables = {
            name: table for name, (table, _) in accelerometer_truths.items() if table is not None
        }
        turned = {
            run.name: self._of_run(run.rate, run.truth, ("runs", place, "truth"))
            for place, run in described.runs.items()
        }
        read = {
            (reading.name, reading.rate): self._of_run(reading.rate, *described.truth_of(reading))
            for reading in described.readings or ()
            if reading.rate
        }
        truth = SimulatedTruth(
            coefficients={name: accelerometer_truths[name][1] for name in tables},
            start_offset={name: table.start_offset for name, table in tables.items()},
            start_velocity={name: table.start_velocity for name, table in tables.items()},
            noise=self._of_records(noise),
            runs={name: of_run for name, of_run in turned.items() if of_run is not None},
            read={key: of_run for key, of_run in read.items() if of_run is not None},
            inputs=true_inputs(self.tables, recorders, self.problems) | _true_responses(tables),
            machine=self._of_machine(described.readings, centrifuge),
            reading_noise=self._of_readings(outputs),
        )
        return sampled.with_private(truth=truth)

    def _accelerometer(self, name: str, output: Output | None) -> tuple[Any, dict[str, float]]:
        """Return the table of an accelerometer, and its coefficients by symbol."""
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
        return table, {s: value for s, value in values.items() if value is not None}

    def _of_machine(
        self, readings: Sequence[Reading] | None, centrifuge: CentrifugeSettings | None
    ) -> dict[str, float]:
        """Return term of the machine -> true value minus nominal, SI."""
        if readings is None:
            return {}
        known = [symbol for symbol in symbols_shown(readings) if symbol not in ACCELEROMETER_TERMS]
        machine: dict[str, float] = {}
        for key, text in self._machine().items():
            path = ("truth", _MACHINE, key)
            symbols = expand(key, known)
            if key in ACCELEROMETER_TERMS:
                message = "is a term of an accelerometer; write it in [truth.NAME]"
                self.problems.add(path, message)
            elif not symbols:
                self.problems.add(
                    path,
                    f'no reading depends on "{key}"' + suggest_name(key, known),
                    "term-without-effect",
                )
            for symbol in symbols:
                unit = term(symbol).unit
                value = self.problems.collect(path, exact, text, unit)
                if value is not None:
                    given = as_deviation(symbol, Quantity(value, 0.0, unit), centrifuge)
                    machine[symbol] = given.value
        for symbol in known:
            family, *keys = symbol.split(".")
            if symbol == _STRETCH or family == "table":
                value = _stated(self.tables[family], keys)
                machine |= {} if value is None else {symbol: value}
        return machine

    def _of_records(self, stated: StatedNoise | None) -> StatedNoise:
        """Return the true noise of records: that of [noise] where nothing else is said."""
        noise_table = self.tables["noise"]
        noise = stated if "noise" not in self.raw else noise_table and noise_table.of_records
        return noise or StatedNoise()

    def _of_readings(self, outputs: Mapping[str, Output | None]) -> dict[str, float]:
        """Return the true noise of the readings of each accelerometer, g."""
        given = self.tables["noise"] and self.tables["noise"].reading
        if given is None:
            return {}
        path: KeyPath = ("truth", "noise", "reading")
        sizes = {}
        for name, text in (
            given if isinstance(given, Mapping) else dict.fromkeys(outputs, given)
        ).items():
            if name not in outputs:
                if name not in self.names:
                    message = f'no accelerometer is named "{name}"' + suggest_name(name, self.names)
                    self.problems.add(path, message, "unknown-accelerometer")
                continue
            output = outputs[name]
            unit, size = ("g", 1.0) if output is None else (output.unit, output.sensitivity)
            gravity = self.gravity if output is None else None
            value = self.problems.collect(path, exact, text, unit, gravity)
            if value is not None and value < 0.0:
                self.problems.add(
                    path, "a standard deviation cannot be negative", "value-out-of-range"
                )
            elif value is not None:
                sizes[name] = value / abs(size)
        return sizes


def _stated(table: Any, keys: Sequence[str]) -> float | None:
    """Return the value in nested tables, or None."""
    for key in keys:
        table = None if table is None else getattr(table, key)
    value: float | None = table
    return value


def _ripple(entry: RippleSettings, rate: float, path: KeyPath, problems: Problems) -> Ripple:
    if (entry.ratio is None) == (entry.amplitude is None):
        problems.add(path, "give each ripple either a ratio w_n/w0 or an amplitude in rad/s")
    amplitude = entry.ratio * rate if entry.ratio is not None else entry.amplitude or 0.0
    return Ripple(entry.harmonic, amplitude, entry.phase)


def true_inputs(
    tables: Mapping[str, Any], recorders: Mapping[str, str], problems: Problems
) -> dict[tuple[str, str], float]:
    """Return by recorder (of a clock; else empty) and symbol the inputs that [truth] states, SI.

    tables: Those of [truth], None where they have mistakes.
    recorders: As `counterspin.campaign.runs.recorders_of` returns them.
    """
    site, records, centrifuge = (tables[name] for name in ("site", "records", "centrifuge"))
    stated = {
        ("", "site.gravity"): site and site.gravity,
        ("", "site.latitude"): site and site.latitude,
        ("", "centrifuge.radius"): centrifuge and centrifuge.radius,
        ("", "centrifuge.clock"): centrifuge and centrifuge.clock,
        ("", "records.timing_offset"): records and records.timing_offset,
        ("", CUTOFF): records and records.cutoff_frequency,
    }
    clocks = _clock_by_recorder((records and records.clock) or {}, recorders, problems)
    return {key: value for key, value in stated.items() if value is not None} | clocks


def _true_responses(tables: Mapping[str, Any]) -> dict[tuple[str, str], float]:
    """Return by accelerometer and symbol the inputs of frequency responses, SI."""
    return {
        (name, f"sensor.{key}"): value
        for name, table in tables.items()
        for key in ("natural_frequency", "damping")
        if (value := getattr(table, key)) is not None
    }


def _clock_by_recorder(
    clocks: Mapping[str, float], recorders: Mapping[str, str], problems: Problems
) -> dict[tuple[str, str], float]:
    if ALL_RECORDERS in clocks:
        return {(owner, CLOCK): clocks[ALL_RECORDERS] for owner in recorders.values()}
    for name in sorted(clocks.keys() - recorders.keys()):
        path: KeyPath = ("truth", "records", "clock", name)
        problems.add(
            path,
            f'no run uses this recorder; write recorder = "{name}" in [records], or in the '
            "records of a run",
            "unknown-choice",
        )
    return {(recorders[name], CLOCK): part for name, part in clocks.items() if name in recorders}

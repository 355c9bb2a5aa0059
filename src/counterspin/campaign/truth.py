"""What is true of a simulated campaign: [simulation], [truth] and each run's `truth`.

Nothing here reaches a calibration: `Campaign.simulation` and `Run.truth` are read by
`counterspin simulate` only.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Final

from pydantic import AfterValidator, create_model

from counterspin.campaign.checking import Path, Problems, did_you_mean
from counterspin.campaign.kinds import (
    Ratio,
    SettingsSection,
    coefficient,
    described,
    exact,
    positive,
    read_exactly,
    small_rate_error,
)
from counterspin.campaign.model import less_nominal
from counterspin.campaign.quantity import Quantity
from counterspin.campaign.readings import Reading
from counterspin.campaign.resolved import RunTruth, SimulatedTruth, Simulation
from counterspin.campaign.settings import (
    CentrifugeSettings,
    Output,
    SimulationSettings,
    StatedNoise,
    term_keys,
)
from counterspin.campaign.simulated.truth_of_inputs import (
    RecordsTruthSettings,
    SiteTruthSettings,
    TrueRadius,
    true_inputs,
)
from counterspin.campaign.terms import expand, symbols_shown
from counterspin.campaign.toml_file import flat_keys
from counterspin.physics.spindle import Ripple, Spindle
from counterspin.physics.terms import (
    COMMON_NAMES,
    OWN_TERMS,
    SHARED_TERMS,
    term,
)

#: Tables of [truth] that are not accelerometers, and so no names for one.
TRUTH_TABLES: Final = (
    "spindle",
    "platform",
    "centrifuge",
    "encoder",
    "noise",
    "machine",
    "site",
    "records",
)

#: The machine's table of [truth], and the key of [truth.noise] that readings have.
_MACHINE: Final = "machine"
_READING: Final = "reading"

#: Term that records show too, and its place in [truth.centrifuge].
_STRETCH: Final = "centrifuge.stretch"


class RippleSettings(SettingsSection):
    """One entry of ``ripple``: a periodic fluctuation, by ratio w_n/w0 or by amplitude."""

    harmonic: Annotated[int, AfterValidator(positive)] = described("times a revolution", 2, 1)
    ratio: Ratio | None = described("w_n/w0", "0.5 ppm", None, kind="number, or in ppm")
    amplitude: Annotated[float, read_exactly("rad/s")] | None = described("w_n", "1e-6 rad/s", None)
    phase: Annotated[float, read_exactly("rad", "deg")] = described("at time zero", "30 deg", 0.0)


class SpindleTruthSettings(SettingsSection):
    """[truth.spindle]: how the spindle really turns."""

    drift: Annotated[float, read_exactly("1/s")] | None = described(
        "relative drift C of the rate", "1e-6 1/s", None
    )
    ripple: list[RippleSettings] | None = described(
        "fluctuations of the rate within a revolution",
        [{"ratio": "0.5 ppm"}],
        None,
        kind="list of tables",
    )
    start_angle: Annotated[float, read_exactly("rad", "deg")] | None = described(
        "at time zero", "30 deg", None, absent="0"
    )
    rate_error: Annotated[Ratio, AfterValidator(small_rate_error)] | None = described(
        "of the true rate, relative to the nominal one",
        "5 ppm",
        None,
        absent="0",
        kind="number, or in ppm",
    )


#: What a table of [truth] for a family of terms has: meaning, and an example.
_FAMILIES: Final[Mapping[str, tuple[str, Mapping[str, Any]]]] = {
    "platform.tilt": ("about `east`, `north`, `up`", {"north": "0.2 arcsec"}),
    "platform.drift": ("of the gyros about `east`, `north`, `up`", {"north": "0.001 deg/h"}),
    "platform.g_sensitivity": (
        "of gyro z to force along x, and so on",
        {"zx": "0.01 deg/h/g"},
    ),
    "platform.g2_sensitivity": (
        "of the gyros about `east`, `north`, `up` to the square of the force",
        {"north": "1e-4 deg/h/g^2"},
    ),
    "platform.compliance": ("turn about z by force along y, and so on", {"zy": "0.1 arcsec/g"}),
    "centrifuge.imbalance": (
        "change of the radius with the cosine or sine of 1 or 2 times the angle",
        {"1": {"cos": "1 um"}},
    ),
    "centrifuge.axis_tilt": (
        "tilt of the spindle's axis about `east` or `north`",
        {"east": "5 arcsec"},
    ),
    "encoder.harmonic": (
        "what the encoder records too much, with the cosine or sine of 1 to 4 times the angle",
        {"1": {"sin": "1 arcsec"}},
    ),
}


def _truth_table(
    name: str, family: str, base: type[SettingsSection] = SettingsSection
) -> type[SettingsSection]:
    """Return a table with a key for each term of a family; of a name with dots, tables in it."""
    within = {
        symbol.removeprefix(f"{family}."): row
        for symbol, row in SHARED_TERMS.items()
        if symbol.startswith(f"{family}.")
    }
    fields = term_keys({key: row for key, row in within.items() if "." not in key}, read_exactly)
    for inner in dict.fromkeys(key.partition(".")[0] for key in within if "." in key):
        words, example = _FAMILIES.get(f"{family}.{inner}", ("of this number", {}))
        table = _truth_table(f"{name}_{inner}", f"{family}.{inner}")
        fields[inner] = (table | None, described(words, example, None))
    words = f"[truth.{family}]: what is true of it."
    return create_model(name, __base__=base, __doc__=words, **fields)


#: [truth.platform]: ``tilt.north``, ``drift.up``, ``g_sensitivity.zx`` and so on.
PlatformTruthSettings = _truth_table("PlatformTruthSettings", "platform")
#: [truth.centrifuge]: ``radius``, ``stretch``, ``imbalance.1.cos`` and so on.
CentrifugeTruthSettings = _truth_table("CentrifugeTruthSettings", "centrifuge", TrueRadius)
#: [truth.encoder]: ``harmonic.1.cos`` and so on.
EncoderTruthSettings = _truth_table("EncoderTruthSettings", "encoder")

_TILT: Any = _truth_table("True_tilt", "platform.tilt") | None

#: ``truth`` of one run: what differs from [truth.spindle], and the run's own tilt.
RunTruthSettings = create_model(
    "RunTruthSettings",
    __base__=SpindleTruthSettings,
    tilt=(_TILT, described(*_FAMILIES["platform.tilt"], None, absent="`[truth.platform]`")),
)


class _AccelerometerTruthKeys(SettingsSection):
    start_offset: Annotated[float, read_exactly("m")] = described(
        "error of the displacement at the start of each run", "0.02 m", 0.0
    )
    start_velocity: Annotated[float, read_exactly("m/s")] = described(
        "error of the velocity there", "-1e-4 m/s", 0.0
    )
    bias: Annotated[float, coefficient("g")] | None = described("the same as K_F", "5 mg", None)
    scale_factor: Annotated[float, coefficient("g/g")] | None = described(
        "the same as K_I", "1.002 g/g", None
    )


#: [truth.NAME]: the true coefficients of one accelerometer.
AccelerometerTruthSettings = create_model(
    "AccelerometerTruthSettings",
    __base__=_AccelerometerTruthKeys,
    **term_keys(OWN_TERMS, coefficient),
)


#: Table of [truth] -> its keys, of the errors that all accelerometers share.
_SHARED_TABLES: Final[Mapping[str, type[SettingsSection]]] = {
    "platform": PlatformTruthSettings,
    "centrifuge": CentrifugeTruthSettings,
    "encoder": EncoderTruthSettings,
}

#: Tables of [truth] that are no accelerometer's -> their classes.
TRUE_TABLES: Final[Mapping[str, type[SettingsSection]]] = {
    "spindle": SpindleTruthSettings,
    **_SHARED_TABLES,
    "site": SiteTruthSettings,
    "records": RecordsTruthSettings,
    "noise": StatedNoise,
}


def resolve_simulation(
    settings: SimulationSettings,
    raw_truth: Mapping[str, Any],
    outputs: Mapping[str, Output | None],
    noise: StatedNoise | None,
    *,
    recorders: Mapping[str, str],
    problems: Problems,
    gravity: float | None,
) -> Simulation:
    """Resolve [simulation], and in [truth] the accelerometers' tables and the inputs.

    outputs: Accelerometer -> what its readings are in; coefficients may be in its unit, as
        ``mA/g``.
    recorders: Name of a recorder -> what the runs call it: nothing where it is that of them all.
    gravity: The site's gravity, m/s^2.
    """
    names = list(outputs)
    for name in raw_truth:
        if name not in names and name not in TRUTH_TABLES:
            problems.add(
                ("truth", name),
                "is neither an accelerometer nor a known table"
                + did_you_mean(name, [*names, *TRUTH_TABLES]),
            )
    coefficients, offsets, velocities = {}, {}, {}
    for name in names:
        path = ("truth", name)
        table: Any = problems.check(
            AccelerometerTruthSettings,
            raw_truth.get(name, {}),
            path,
            gravity=gravity,
            output=outputs[name],
        )
        if table is None:
            continue
        values = {symbol: getattr(table, symbol) for symbol in OWN_TERMS}
        for key, symbol in COMMON_NAMES.items():
            if None not in (getattr(table, key), values[symbol]):
                problems.add((*path, key), f"is {symbol}, given too; keep one")
            values[symbol] = getattr(table, key) if values[symbol] is None else values[symbol]
        coefficients[name] = {s: value for s, value in values.items() if value is not None}
        offsets[name], velocities[name] = table.start_offset, table.start_velocity
    true_noise = _true_noise(raw_truth, noise, problems, gravity)
    inputs = true_inputs(raw_truth, recorders, problems)
    truth = SimulatedTruth(coefficients, offsets, velocities, true_noise, inputs)
    return Simulation(settings.sampling_rate, settings.seed, truth, settings.poses)


def _true_noise(
    raw_truth: Mapping[str, Any],
    noise: StatedNoise | None,
    problems: Problems,
    gravity: float | None,
) -> StatedNoise:
    if "noise" not in raw_truth:
        return noise or StatedNoise()
    path = ("truth", "noise")
    found = problems.check(StatedNoise, raw_truth["noise"], path, gravity=gravity)
    return found or StatedNoise()


def resolve_run_truth(
    rate: float,
    raw_truth: Mapping[str, Any],
    raw_run_truth: Any,
    path: Path,
    problems: Problems,
) -> RunTruth | None:
    """Resolve the true spindle and machine of one run; the run's own values take precedence.

    rate: The run's nominal rate, rad/s.
    raw_truth, raw_run_truth: [truth] and the run's `truth` as read.
    path: Of the run's `truth`.
    """
    common = problems.check(
        SpindleTruthSettings, raw_truth.get("spindle", {}), ("truth", "spindle")
    )
    shared = {
        family: problems.check(model, raw_truth.get(family, {}), ("truth", family))
        for family, model in _SHARED_TABLES.items()
    }
    own: Any = problems.check(RunTruthSettings, raw_run_truth, path)
    if common is None or None in shared.values() or own is None:
        return None

    def first(key: str, default: Any) -> Any:
        values = (getattr(own, key), getattr(common, key), default)
        return next(value for value in values if value is not None)

    true_rate = rate * (1.0 + first("rate_error", 0.0))
    ripple_path: Path = (*path, "ripple") if own.ripple is not None else ("truth", "spindle")
    ripples = tuple(
        _ripple(entry, true_rate, ripple_path, problems) for entry in first("ripple", ())
    )
    spindle = Spindle(true_rate, first("drift", 0.0), ripples, first("start_angle", 0.0))
    values: dict[str, float] = {}
    for symbol, row in SHARED_TERMS.items():
        family, *keys = symbol.split(".")
        # A run's own `drift` is the spindle's; of the shared errors it has the tilt only.
        own_value = _stated(own, keys) if row.per_run else None
        value = _stated(shared[family], keys) if own_value is None else own_value
        if value is not None:
            values[symbol] = value
    return RunTruth(spindle, values)


def _stated(table: Any, keys: Sequence[str]) -> float | None:
    """Return what stands in nested tables, or None."""
    for key in keys:
        table = None if table is None else getattr(table, key)
    value: float | None = table
    return value


def _ripple(entry: RippleSettings, rate: float, path: Path, problems: Problems) -> Ripple:
    if (entry.ratio is None) == (entry.amplitude is None):
        problems.add(path, "each ripple has either a ratio w_n/w0 or an amplitude in rad/s")
    amplitude = entry.ratio * rate if entry.ratio is not None else entry.amplitude or 0.0
    return Ripple(entry.harmonic, amplitude, entry.phase)


# Of readings


def of_records(raw: Mapping[str, Any], problems: Problems) -> dict[str, Any]:
    """Return [truth] without what readings alone have."""
    if not isinstance(raw.get(_MACHINE, {}), Mapping):
        problems.add(("truth", _MACHINE), "must be a table")
    truth = {key: value for key, value in raw.items() if key != _MACHINE}
    noise = truth.get("noise")
    if isinstance(noise, Mapping) and _READING in noise:
        truth["noise"] = {key: value for key, value in noise.items() if key != _READING}
    stretch = flat_keys(_table(raw, _MACHINE)).get(_STRETCH)
    centrifuge = _table(raw, "centrifuge")
    if stretch is not None and "stretch" in centrifuge:
        problems.add(("truth", _MACHINE, _STRETCH), "is in [truth.centrifuge] too; keep one")
    elif stretch is not None:
        truth["centrifuge"] = {**centrifuge, "stretch": stretch}
    return truth


def _table(raw: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    value = raw.get(key)
    return value if isinstance(value, Mapping) else {}


def resolve_reading_truth(
    raw: Mapping[str, Any],
    readings: Sequence[Reading],
    outputs: Mapping[str, Output | None],
    centrifuge: CentrifugeSettings | None,
    *,
    problems: Problems,
    gravity: float,
) -> tuple[dict[str, float], dict[str, float]]:
    """Resolve [truth.machine] and the noise of readings.

    centrifuge: The machine; a true radius may be given as such.
    gravity: Of the site, m/s^2.
    """
    known = [symbol for symbol in symbols_shown(readings) if symbol not in OWN_TERMS]
    machine: dict[str, float] = {}
    for key, text in flat_keys(_table(raw, _MACHINE)).items():
        path = ("truth", _MACHINE, key)
        symbols = expand(key, known)
        if key in OWN_TERMS:
            problems.add(path, "is of an accelerometer; write it in its table, [truth.NAME]")
        elif not symbols:
            problems.add(path, f'no reading shows "{key}"' + did_you_mean(key, known))
        for symbol in symbols:
            unit = term(symbol).unit
            value = problems.attempt(path, exact, text, unit)
            if value is not None:
                given = less_nominal(symbol, Quantity(value, 0.0, unit), centrifuge)
                machine[symbol] = given.value
    stretch = _table(raw, "centrifuge").get("stretch")
    if stretch is not None and _STRETCH in known:
        value = problems.attempt(("truth", "centrifuge", "stretch"), exact, stretch, "s^2/m")
        machine[_STRETCH] = value or 0.0
    return machine, _noise(raw, outputs, problems, gravity)


def _noise(
    raw: Mapping[str, Any],
    outputs: Mapping[str, Output | None],
    problems: Problems,
    gravity: float,
) -> dict[str, float]:
    """Return the true noise of the readings of each accelerometer, g."""
    given = _table(raw, "noise").get(_READING)
    if given is None:
        return {}
    path: Path = ("truth", "noise", _READING)
    texts = given if isinstance(given, Mapping) else dict.fromkeys(outputs, given)
    sizes = {}
    for name, text in texts.items():
        if name not in outputs:
            problems.add(path, f'no accelerometer is called "{name}"' + did_you_mean(name, outputs))
            continue
        output = outputs[name]
        unit, size = ("g", 1.0) if output is None else (output.unit, output.sensitivity)
        value = problems.attempt(path, exact, text, unit, gravity if output is None else None)
        if value is not None and value < 0.0:
            problems.add(path, "a standard deviation is not negative")
        elif value is not None:
            sizes[name] = value / abs(size)
    return sizes

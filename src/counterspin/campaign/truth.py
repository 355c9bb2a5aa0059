"""The true values of a simulated campaign: [simulation], [truth] and each run's `truth`.

Nothing here reaches a calibration: `Campaign.simulation` and `Run.truth` are read by
`counterspin simulate` only.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

from counterspin.campaign.checking import Path, Problems, did_you_mean
from counterspin.campaign.resolved import RunTruth, SimulatedTruth, Simulation, StatedNoise
from counterspin.campaign.settings import (
    AccelerometerTruthSettings,
    CentrifugeTruthSettings,
    EncoderTruthSettings,
    NoiseSettings,
    PlatformTruthSettings,
    RippleSettings,
    RunTruthSettings,
    SettingsSection,
    SimulationSettings,
    SpindleTruthSettings,
)
from counterspin.physics.spindle import Ripple, Spindle
from counterspin.physics.terms import OWN_TERMS, SHARED_TERMS

#: Tables of [truth] that are not accelerometers, and so no names for one.
TRUTH_TABLES: Final = ("spindle", "platform", "centrifuge", "encoder", "noise", "machine")

#: Table of [truth] -> its keys, of the errors that all accelerometers share.
_SHARED_TABLES: Final[Mapping[str, type[SettingsSection]]] = {
    "platform": PlatformTruthSettings,
    "centrifuge": CentrifugeTruthSettings,
    "encoder": EncoderTruthSettings,
}


def resolve_simulation(
    settings: SimulationSettings,
    raw_truth: Mapping[str, Any],
    accelerometers: Iterable[str],
    noise: StatedNoise | None,
    *,
    problems: Problems,
    gravity: float | None,
) -> Simulation:
    """Resolve [simulation] and the accelerometers' tables of [truth].

    accelerometers: Names of the campaign's accelerometers.
    gravity: The site's gravity, m/s^2.
    """
    names = list(accelerometers)
    for name in raw_truth:
        if name not in names and name not in TRUTH_TABLES:
            problems.add(
                ("truth", name),
                "is neither an accelerometer nor a known table"
                + did_you_mean(name, [*names, *TRUTH_TABLES]),
            )
    coefficients, offsets, velocities = {}, {}, {}
    for name in names:
        table: Any = problems.check(
            AccelerometerTruthSettings, raw_truth.get(name, {}), ("truth", name), gravity=gravity
        )
        if table is None:
            continue
        values = {symbol: getattr(table, symbol) for symbol in OWN_TERMS}
        coefficients[name] = {s: value for s, value in values.items() if value is not None}
        offsets[name], velocities[name] = table.start_offset, table.start_velocity
    true_noise = _true_noise(raw_truth, noise, problems, gravity)
    truth = SimulatedTruth(coefficients, offsets, velocities, true_noise)
    return Simulation(settings.sampling_rate, settings.seed, truth)


def _true_noise(
    raw_truth: Mapping[str, Any],
    noise: StatedNoise | None,
    problems: Problems,
    gravity: float | None,
) -> StatedNoise:
    if "noise" not in raw_truth:
        return noise or StatedNoise()
    path = ("truth", "noise")
    settings = problems.check(NoiseSettings, raw_truth["noise"], path, gravity=gravity)
    return StatedNoise(**settings.model_dump()) if settings else StatedNoise()


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
        if value:
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

"""`counterspin noise`: noise of sensors from a record at rest."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.campaign.checksums import Checksums
from counterspin.campaign.description import Campaign, read_campaign
from counterspin.campaign.field_types import parse_exact
from counterspin.campaign.settings import NOISE_UNITS, OBSERVABLES
from counterspin.campaign.static_noise import static_signals
from counterspin.errors import CampaignError, RecordError, UsageError, error_code
from counterspin.inference.noise.components import (
    BIAS_COMPONENTS_BY_KEY,
    size_keys,
)
from counterspin.inference.noise.spectrum import SpectralLine, allan_values, spectrum
from counterspin.inference.noise.static_noise import (
    Band,
    StaticRecord,
    StaticSignal,
    analyse_static_record,
)
from counterspin.ingest.column_roles import FileGuess, explain_missing_time, guess_file
from counterspin.ingest.contents import FileColumn, FileContents, read_contents
from counterspin.monitoring.result import (
    NoiseResult,
    NoiseSize,
    SignalNoise,
    component_name,
    shown_unit,
)
from counterspin.physics import observation
from counterspin.records.column_file import format_names
from counterspin.records.memory import MemoryTable, memory_table
from counterspin.records.unit_notation import unit_in_name
from counterspin.reports.numbers import format_number
from counterspin.threads import single_blas_thread
from counterspin.units import STANDARD_GRAVITY, base_unit, is_convertible, unit_factor

#: Mains frequencies, Hz, and their relative tolerance.
_MAINS: Final = (50.0, 60.0)
_MAINS_TOLERANCE: Final = 2e-3

#: Largest harmonics of mains and spindle for naming a line.
_MAINS_HARMONICS: Final = 20
_SPINDLE_HARMONICS: Final = 8

#: Motion test: number of segments, their smallest number of samples, and the smallest ratio of a
#: segment's scatter to that of the quiet quarter. A bias walk reaches half that ratio.
_MOTION_SEGMENTS: Final = 32
_MIN_SEGMENT_SAMPLES: Final = 32
_MOTION_RATIO: Final = 8.0

#: p-value of a misfit of the spectrum, over all bands, below which it is reported.
_MISFIT_P: Final = 1e-3

#: Factor on either side above which an interval is reported as wide.
_WIDE_RATIO: Final = 2.0

#: Deviation of a time from a whole number of steps, above which a stated sampling rate counts rows.
_MAX_STEP_DEVIATION: Final = 0.3


def noise(
    record: object,
    *,
    campaign: Campaign | Path | str | None = None,
    columns: Sequence[str] = (),
    unit: str | None = None,
    sampling_rate: str | None = None,
    gravity: str | None = None,
    rate: str | None = None,
    select: str | None = None,
) -> NoiseResult:
    """Estimate the noise of a record at rest: spectrum, Allan deviation, components and lines.

    Parameters
    ----------
    record
        A file of any format that records have, or a frame as `make_campaign` takes it.
    campaign
        A campaign, its folder or its description, which describes the columns; None: the file and
        the names of its columns describe them.
    columns
        Selected columns; empty: all with a known unit.
    unit
        Unit of columns without a unit in the file, such as ``"g"`` or ``"m/s"``.
    sampling_rate
        Sampling rate of a file without a time column, such as ``"100 Hz"``.
    gravity
        Gravity that converts between g and m/s^2; None: the campaign's, or 9.80665 m/s^2.
    rate
        Rate of a nearby rotating spindle, such as ``"1 rev/s"``, whose lines are named.
    select
        Rows of one of several sensors in a file, such as ``"device=A"``.

    Returns
    -------
    NoiseResult

    Raises
    ------
    CampaignError
        If the arguments do not fit the record or the campaign.
    RecordError
        If the record cannot be used: too short, uneven, or without a unit.
    """
    file = Path(record).absolute() if isinstance(record, Path | str) else None
    if file is not None and not file.exists():
        raise RecordError(f"{record}: file not found", code="file-not-found")
    source = file if file is not None else memory_table("record in memory", record)
    g = _parse_quantity("gravity", gravity, "m/s^2") or STANDARD_GRAVITY
    turning = _parse_quantity("rate", rate, "rad/s")
    unused: list[str] = []
    with single_blas_thread():
        if campaign is not None:
            full_campaign = campaign if isinstance(campaign, Campaign) else read_campaign(campaign)
            if gravity is not None:
                raise CampaignError(
                    "noise",
                    ["`gravity`: already stated in the campaign; omit it"],
                    code="conflicting-keys",
                )
            if select is not None:
                raise CampaignError(
                    "noise",
                    ["`select`: already stated in [records] of the campaign; omit it"],
                    code="conflicting-keys",
                )
            g = full_campaign.gravity.value
            signals = _select_signals(static_signals(full_campaign, source), columns)
        else:
            signals, unused = _guess_signals(source, columns, unit, sampling_rate, g, select)
        rest_records = [analyse_static_record(source, signal) for signal in signals]
        parts = [_estimate_noise(rest_record, turning) for rest_record in rest_records]
    checksum = None
    if file is not None:
        with Checksums() as checksums:
            (checksum,) = checksums.checksums([file])
    return NoiseResult(
        record=str(record) if file is not None else str(source),
        checksum=checksum,
        gravity=g,
        signals=parts,
        unused=unused,
        table=noise_table(parts, g),
    )


def _parse_quantity(name: str, text: str | None, unit: str) -> float | None:
    if text is None:
        return None
    try:
        return abs(parse_exact(text, unit))
    except ValueError as error:
        raise CampaignError("noise", [f"`{name}`: {error}"], code=error_code(error)) from error


def _select_signals(signals: list[StaticSignal], columns: Sequence[str]) -> list[StaticSignal]:
    chosen = [s for s in signals if not columns or s.column in columns or s.name in columns]
    if not chosen:
        available = ", ".join(signal.column for signal in signals)
        raise CampaignError(
            "noise",
            [f"`columns`: the accelerometers of the campaign have {available}"],
            code="missing-column",
        )
    return chosen


def _guess_signals(
    source: Path | MemoryTable,
    columns: Sequence[str],
    unit: str | None,
    sampling_rate: str | None,
    gravity: float,
    select: str | None,
) -> tuple[list[StaticSignal], list[str]]:
    """Return the signals of a file by its column names and units, and the other columns' names."""
    answers = {} if sampling_rate is None else {"sampling_rate": sampling_rate}
    samples = _read_source(source, select)
    guess = guess_file(samples, answers)
    missing = [name for name in columns if name not in {c.name for c in samples.columns}]
    if missing:
        available = ", ".join(column.name for column in samples.columns)
        problem = f"`columns`: column {missing[0]!r} does not exist; the columns are {available}"
        if cell := next(iter(samples.first_text_cells.get(missing[0], ())), ""):
            problem = (
                f"`columns`: column {missing[0]!r} contains the text {cell[:40]!r}, not numbers"
            )
        problem += (
            f". The file was read as follows: {samples.format_description}"
            if samples.format_description
            else ""
        )
        problem += "".join(
            f". Not read: {reason.removesuffix('.')}" for reason in samples.unread_reasons
        )
        raise CampaignError("noise", [problem], code="missing-column")
    time = _row_times(
        source, guess, samples.columns, _parse_quantity("sampling_rate", sampling_rate, "Hz")
    )
    time_column = guess.time.column if guess.time else None
    rest = [c for c in samples.columns if c.name != time_column and not c.is_timestamp]
    used_columns: list[StaticSignal] = []
    unused: list[str] = []
    for column in rest:
        if columns and column.name not in columns:
            continue
        known = column.unit or unit_in_name(column.name) or unit
        observable = next(
            (name for name, si in OBSERVABLES.items() if known and is_convertible(known, si)), None
        )
        if known is None or observable is None or len(column.values) != time.size:
            if columns:
                reason = f"is in {known!r}" if known else "has no unit; give `unit`"
                requested = "a length, a velocity or a specific force is required"
                raise CampaignError(
                    "noise", [f"column {column.name!r} {reason}; {requested}"], code="wrong-unit"
                )
            unused.append(column.name)
            continue
        factor = unit_factor(known, OBSERVABLES[observable], gravity=gravity)
        in_g = base_unit(known)[1]["[gravity]"] != 0.0
        values = column.values * factor
        observable_order = observation.ORDERS[observable]
        used_columns.append(
            StaticSignal(column.name, column.name, observable_order, in_g, time, values)
        )
    if unit is not None and not any(is_convertible(unit, si) for si in OBSERVABLES.values()):
        requested = "a unit of length, velocity or specific force is required, such as m/s^2"
        raise CampaignError("noise", [f"`unit`: {unit!r}: {requested}"], code="wrong-unit")
    if not used_columns:
        raise RecordError(
            f"{source}: no column has a unit of length, velocity or specific force "
            f"({', '.join(unused) or 'only the time'}). Select the column with `columns`, and "
            "give its unit with `unit`.",
            code="missing-unit",
        )
    varying = [signal for signal in used_columns if np.unique(signal.values).size > 1]
    if varying and not columns:
        # Zeros of a residual, or of an axis that is not connected.
        used = {signal.column for signal in varying}
        unused += [signal.column for signal in used_columns if signal.column not in used]
        used_columns = varying
    return used_columns, unused


def _read_source(source: Path | MemoryTable, select: str | None) -> FileContents:
    """Return the contents of a record, of one sensor."""
    if select is not None and not (select.partition("=")[2] and isinstance(source, Path)):
        problem = (
            "`select`: write COLUMN=VALUE, such as device=A. `select` applies only to the rows "
            "of a file; filter a data frame before the call"
        )
        raise UsageError("noise", [problem])
    if isinstance(source, MemoryTable):
        file_columns = tuple(
            FileColumn(name, "", values) for name, values in source.columns.items()
        )
        return FileContents(Path(source.name), file_columns, source.others, "")
    contents = read_contents(source, sensor=select)
    if contents.is_mixed and contents.sensors is not None:
        key, sensors = contents.sensors
        raise RecordError(
            f"{source}: column '{key}' has {len(sensors)} different values "
            f"({format_names(sensors, 8)}), so the rows come from several sensors. Select the "
            f'rows of one sensor with `select`, such as "{key}={sensors[0]}".',
            code="several-sensors",
        )
    return contents


def _row_times(
    source: Path | MemoryTable,
    guess: FileGuess,
    columns: Sequence[FileColumn],
    rate: float | None,
) -> Array:
    """Return the time of each row, s.

    rate: Sampling rate that a person stated, Hz; rows are counted if their times do not show it.
    """
    rows = np.arange(max(len(column.values) for column in columns))
    if guess.time is not None:
        if guess.time.unit is None and rate is None:
            raise RecordError(
                f"{source}: column '{guess.time.column}' seems to be the time, but its unit "
                "is unknown; rename it, for example to 'time_s', or give `sampling_rate` or "
                "`campaign`.",
                code="missing-unit",
            )
        column = next(c for c in columns if c.name == guess.time.column)
        seconds = np.asarray(column.values * guess.time.factor)
        falls = np.flatnonzero(np.diff(seconds) < 0.0)
        if falls.size and rate is None:
            before, after = seconds[falls[0] : falls[0] + 2]
            raise RecordError(
                f"{source}: column '{column.name}': the time decreases in row {falls[0] + 2}, "
                f"from {before:.9g} s to {after:.9g} s. End the record before this row.",
                code="time-backwards",
            )
        places = np.diff(seconds[np.isfinite(seconds)]) * (rate or 0.0)
        deviation = np.abs(places - np.round(places))
        is_even = bool((deviation < _MAX_STEP_DEVIATION).all() and (places >= 0.0).all())
        return seconds if rate is None or (guess.time.unit and is_even) else rows / rate
    if guess.shared_times is not None and rate is None:
        return guess.shared_times.values
    if guess.sampling_rate is None:
        problem = (
            f"{source}: {explain_missing_time(guess.contents)}. Give the sampling rate as "
            "`sampling_rate`, such as"
        )
        problem += ' "100 Hz".'
        unread = [
            f"Not read: {reason}"
            for reason in guess.contents.unread_reasons
            if reason.rstrip(".") not in problem
        ]
        raise RecordError(" ".join([problem, *unread]), code="missing-column")
    return rows / guess.sampling_rate


def _estimate_noise(record: StaticRecord, turning: float | None) -> SignalNoise:
    """Return the noise of a column."""
    signal, stretches, analysis = record.signal, record.segments, record.analysis
    rest, kind, step = analysis.noise, analysis.kind, analysis.step
    observable = next(name for name, order in observation.ORDERS.items() if order == signal.order)
    keys = size_keys(observable if signal.order else "quantisation")
    units = NOISE_UNITS if signal.order else NOISE_UNITS | {"quantisation": "m/s"}
    sizes = {
        keys[name]: NoiseSize(
            value=math.sqrt(component.variance) if component.variance > 0.0 else None,
            low=math.sqrt(component.low),
            high=math.sqrt(component.high) if math.isfinite(component.high) else None,
            unit=units[keys[name]],
        )
        for name, component in rest.components.items()
    }
    _, longest = stretches.longest
    differences = kind.averaging_order
    force = np.diff(longest, n=differences) / stretches.step**differences
    seconds = stretches.step * sum(part.size for _, part in stretches.segments)
    lines = [replace(line, name=_line_name(line, 1.0 / step, turning)) for line in analysis.lines]
    stated = SignalNoise(
        name=signal.name,
        column=signal.column,
        observable=observable,  # type: ignore[arg-type]
        in_g=signal.in_g,
        rows=stretches.rows,
        sampling_rate=1.0 / stretches.sample_interval,
        seconds=seconds,
        outliers=stretches.outliers,
        filled=stretches.filled,
        gaps=stretches.gaps,
        resolution=stretches.resolution or None,
        components=sizes,
        drift=rest.drift,
        u_drift=rest.u_drift,
        lines=lines,
        allan=allan_values(analysis.velocity, step, kind, analysis.recorded),
        spectrum=spectrum(force, stretches.step, kind, analysis.recorded),
        remarks=[],
    )
    return stated.model_copy(update={"remarks": list(_remarks(stated, record))})


def _line_name(line: SpectralLine, sampling: float, turning: float | None) -> str | None:
    """Return the probable source of a line: mains or the spindle, possibly aliased."""
    close = 3.0 * line.u_frequency
    spindle = None if turning is None else turning / (2.0 * math.pi)
    for number in range(1, _SPINDLE_HARMONICS + 1) if spindle else ():
        assert spindle is not None
        if (
            abs(_alias_frequency(number * spindle, sampling) - line.frequency)
            <= close + 1e-4 * spindle
        ):
            return "spindle" if number == 1 else f"spindle, harmonic {number}"
    for number in range(1, _MAINS_HARMONICS + 1):
        for mains in _MAINS:
            seen = number * mains
            if (
                abs(_alias_frequency(seen, sampling) - line.frequency)
                <= close + _MAINS_TOLERANCE * seen
            ):
                name = f"{mains:g} Hz mains" + ("" if number == 1 else f", harmonic {number}")
                return name if seen <= 0.5 * sampling else f"{name}, aliased by the sampling"
    return None


def _alias_frequency(frequency: float, sampling: float) -> float:
    """Return the aliased frequency of a sampled sinusoid."""
    return abs(frequency - sampling * round(frequency / sampling))


def _remarks(stated: SignalNoise, record: StaticRecord) -> Iterator[str]:
    """Yield remarks on the validity of the figures."""
    for key, size in stated.components.items():
        name = component_name(key)
        if size.value is None:
            if key in BIAS_COMPONENTS_BY_KEY:
                scale = BIAS_COMPONENTS_BY_KEY[key].limit_scale
                yield (
                    f"The record does not reveal any {name}. The stated upper limit is "
                    f"approximately inversely proportional to {scale}, so a longer record (hours) "
                    "can reveal smaller values."
                )
            continue
        wide = (
            size.high is None
            or size.high > _WIDE_RATIO * size.value
            or size.low * _WIDE_RATIO < size.value
        )
        if wide and size.low == 0.0:
            yield (
                f"The interval for the {name} has no lower limit, because the record is too "
                "short to distinguish this component from zero."
            )
        elif wide:
            yield (
                f"The estimate of the {name} depends on the few slowest fluctuations in this "
                "record, so its interval is wide. Use a record several times longer than "
                f"{stated.seconds:.4g} s."
            )
    yield from _sampling_remarks(record)
    if stated.outliers:
        many = "1 sample" if stated.outliers == 1 else f"{stated.outliers} samples"
        yield f"Rejected as outliers: {many}."
    if stated.gaps:
        yield (
            f"The record is split at {stated.gaps} gap{'s' if stated.gaps > 1 else ''}. The "
            "spectrum and the Allan deviation use the longest part; the estimates of the noise "
            "components use all parts."
        )
    thin = round(record.analysis.step / record.segments.step)
    if thin > 1:
        yield (
            "The noise components, the spectral lines and the Allan deviation are computed from "
            f"velocities {thin} samples apart. The spectrum is computed from all samples."
        )
    if stated.resolution and stated.resolution**2 / 12.0 > 0.1 * _local_scatter(record) ** 2:
        yield (
            f"The samples are multiples of {stated.resolution:.3g} "
            f"{OBSERVABLES[stated.observable]}, so rounding error contributes much of this "
            "white noise. Rounding error is not white while the signal stays within one step."
        )
    yield from _motion_remarks(record)
    yield from _misfit_remarks(record.analysis.noise.bands)


def _sampling_remarks(record: StaticRecord) -> Iterator[str]:
    """Yield remarks on rows that are not samples of their own, and on missing samples."""
    stretches = record.segments
    if stretches.repeated:
        yield (
            f"{stretches.repeated} of {stretches.rows} rows repeat the previous value, which "
            "is typical of a logging rate above the output rate of the sensor. The analysis "
            f"uses only new values, at {1.0 / stretches.sample_interval:.4g} Hz."
        )
    if stretches.stuck:
        yield (
            f"{stretches.stuck} of {stretches.rows} rows belong to long sequences of identical "
            "values, which suggests that the sensor stopped. The analysis does not use these "
            "rows."
        )
    if stretches.restamped:
        yield (
            f"{stretches.restamped} of {stretches.rows} rows repeat the time of the previous "
            "row with a different value. counterspin calculates the time from the row count."
        )
    if stretches.filled and stretches.recorded_fraction < 1.0:
        part = 100.0 * (1.0 - stretches.recorded_fraction)
        yield (
            f"{stretches.filled} samples are missing ({part:.2g} %). The analysis treats the "
            "recorded samples as consecutive, so it resolves low-frequency noise poorly."
        )
        if record.signal.order == 0 and record.analysis.noise.components["white"].variance:
            yield (
                "With missing samples, quantisation noise of the velocity cannot be "
                "distinguished from white noise. Use a record without missing samples."
            )
    elif stretches.filled > stretches.outliers:
        yield f"{stretches.filled - stretches.outliers} missing samples were interpolated."


def _motion_remarks(record: StaticRecord) -> Iterator[str]:
    """Yield a remark on the segment whose scatter of specific force indicates motion."""
    start, values = record.segments.longest
    size = max(_MIN_SEGMENT_SAMPLES, values.size // _MOTION_SEGMENTS)
    segments = values[: values.size // size * size].reshape(-1, size)
    scatter = segments.std(axis=1)
    median_scatter, index = float(np.quantile(scatter, 0.25)), int(np.argmax(scatter))
    if (
        record.signal.order == 0
        and len(segments) >= _MOTION_SEGMENTS // 2
        and scatter[index] > _MOTION_RATIO * median_scatter
    ):
        start_time = start + index * size * record.segments.step
        yield (
            f"From {start_time:.4g} s to {start_time + size * record.segments.step:.4g} s, the "
            f"scatter is {scatter[index] / median_scatter:.2g} times that of the quiet parts "
            "of the record. The sensor moved during part of the record, so the results do not "
            "describe the noise of the sensor. Remove the part with motion."
        )


def _local_scatter(record: StaticRecord) -> float:
    """Return the standard deviation of samples relative to their neighbours."""
    _, longest = record.segments.longest
    second = longest[2:] - 2.0 * longest[1:-1] + longest[:-2]
    return float(np.std(second)) / math.sqrt(6.0)


def _misfit_remarks(bands: Sequence[Band]) -> Iterator[str]:
    """Yield a remark on the band where the spectrum deviates most from the components."""
    from scipy.stats import chi2

    worst: tuple[float, Band] | None = None
    for band in bands:
        power = band.ratio * band.count
        p = 2.0 * min(chi2.sf(power, band.count), chi2.cdf(power, band.count)) * len(bands)
        if p < _MISFIT_P and (worst is None or abs(math.log(band.ratio)) > worst[0]):
            worst = abs(math.log(band.ratio)), band
    if worst is not None:
        band = worst[1]
        yield (
            f"From {band.low:.3g} to {band.high:.3g} Hz, the record has {band.ratio:.3g} times "
            "the power of these noise components. The likely cause is a filter, a resonance or "
            "a disturbance, not sensor noise. The intervals do not include this effect. "
            "Inspect the spectrum."
        )


def noise_table(signals: Sequence[SignalNoise], gravity: float) -> str:
    """Return the [noise] table of the noisiest column, ready to be pasted."""
    largest: dict[str, tuple[float, bool]] = {}
    for signal in signals:
        for key, size in signal.components.items():
            if size.value is not None and key != "quantisation":
                existing = largest.get(key, (0.0, False))
                largest[key] = max(existing, (size.value, signal.in_g))
    lines = ["[noise]"]
    for key, (value, in_g) in largest.items():
        unit, factor = shown_unit(NOISE_UNITS[key], in_g, gravity)
        lines.append(f'{key} = "{format_number(value * factor)} {unit}"')
    return "\n".join(lines) + "\n"

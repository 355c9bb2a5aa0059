"""`counterspin noise`: noise of sensors from a static record."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from counterspin.campaign.checksums import Checksums
from counterspin.campaign.description import Campaign, read_campaign
from counterspin.campaign.field_types import check_gravity, check_positive, parse_exact
from counterspin.campaign.settings import NOISE_UNITS, OBSERVABLES
from counterspin.campaign.static_noise import static_signals
from counterspin.errors import CampaignError, RecordError, UsageError, error_code
from counterspin.inference.noise.components import BIAS_COMPONENTS_BY_KEY, component_keys
from counterspin.inference.noise.spectrum import SpectralLine, allan_values, spectrum
from counterspin.inference.noise.static_noise import (
    Band,
    StaticRecord,
    StaticSignal,
    analyse_static_record,
)
from counterspin.ingest.column_roles import guess_file
from counterspin.ingest.contents import FileColumn, FileContents, read_contents
from counterspin.monitoring.result import (
    NoiseResult,
    NoiseSize,
    SignalNoise,
    component_name,
    noise_display_unit,
)
from counterspin.monitoring.row_times import compute_row_times
from counterspin.physics import observation
from counterspin.records.column_file import format_names
from counterspin.records.memory import MemoryTable, make_memory_table
from counterspin.records.unit_notation import unit_in_name
from counterspin.reports.numbers import format_number
from counterspin.threads import single_blas_thread
from counterspin.units import STANDARD_GRAVITY, base_unit, is_convertible, unit_factor

#: Mains frequencies, Hz, and their relative tolerance.
_MAINS_FREQUENCIES: Final = (50.0, 60.0)
_MAINS_RELATIVE_TOLERANCE: Final = 2e-3

#: Largest harmonics of mains and spindle for naming a line.
_MAX_MAINS_HARMONIC: Final = 20
_MAX_SPINDLE_HARMONIC: Final = 8

#: Motion test: number of segments, their smallest number of samples, and the smallest ratio of a
#: segment's scatter to that of the quiet quarter. A bias walk reaches half that ratio.
_N_MOTION_SEGMENTS: Final = 32
_MIN_SEGMENT_SAMPLES: Final = 32
_MIN_SCATTER_RATIO: Final = 8.0

#: p-value of a misfit of the spectrum, over all bands, below which it is reported.
_MISFIT_SIGNIFICANCE: Final = 1e-3

#: Factor on either side above which an interval is reported as wide.
_MAX_INTERVAL_RATIO: Final = 2.0


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
    """Estimate the noise of a static record: spectrum, Allan deviation, components and lines.

    Parameters
    ----------
    record
        File in any record format, or a data frame as in `make_campaign`.
    campaign
        Campaign, its folder or its description, which describes the columns; None: the columns are
        identified from the file and their names.
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
    source = file if file is not None else make_memory_table("record in memory", record)
    gravity_value = _parse_quantity("gravity", gravity, "m/s^2", check_gravity) or STANDARD_GRAVITY
    spindle_rate = _parse_quantity("rate", rate, "rad/s")
    unused_columns: list[str] = []
    with single_blas_thread():
        if campaign is not None:
            full_campaign = campaign if isinstance(campaign, Campaign) else read_campaign(campaign)
            for argument_name, value, location in (
                ("gravity", gravity, "the campaign"),
                ("unit", unit, "the campaign"),
                ("sampling_rate", sampling_rate, "the campaign"),
                ("select", select, "[records] of the campaign"),
            ):
                if value is not None:
                    raise CampaignError(
                        "noise",
                        [f"`{argument_name}`: already stated in {location}; omit it"],
                        code="conflicting-keys",
                    )
            if not any(a.channel.name for a in full_campaign.accelerometers.values()):
                raise CampaignError(
                    "noise",
                    [
                        "`campaign`: this campaign contains only readings, so it does not "
                        "describe the columns of a record. Omit `campaign`, and give `columns` "
                        "and `unit`"
                    ],
                    code="missing-column",
                )
            gravity_value = full_campaign.gravity.value
            signals = _select_signals(static_signals(full_campaign, source), columns)
        else:
            signals, unused_columns = _guess_signals(
                source, columns, unit, sampling_rate, gravity_value, select
            )
        rest_records = [analyse_static_record(source, signal) for signal in signals]
        signal_noises = [_estimate_noise(rest_record, spindle_rate) for rest_record in rest_records]
    checksum = None
    if file is not None:
        with Checksums() as checksums:
            (checksum,) = checksums.checksums([file])
    return NoiseResult(
        record=str(record) if file is not None else str(source),
        checksum=checksum,
        gravity=gravity_value,
        signals=signal_noises,
        unused=unused_columns,
        table=format_noise_table(signal_noises, gravity_value),
    )


def _parse_quantity(
    argument_name: str, text: str | None, unit: str, check: Callable[[float], float] = abs
) -> float | None:
    if text is None:
        return None
    try:
        return abs(check(parse_exact(text, unit)))
    except ValueError as error:
        raise CampaignError(
            "noise", [f"`{argument_name}`: {error}"], code=error_code(error)
        ) from error


def _select_signals(signals: list[StaticSignal], columns: Sequence[str]) -> list[StaticSignal]:
    selection = [s for s in signals if not columns or s.column in columns or s.name in columns]
    if not selection:
        available_columns = ", ".join(signal.column for signal in signals)
        raise CampaignError(
            "noise",
            [f"`columns`: the accelerometers of the campaign have {available_columns}"],
            code="missing-column",
        )
    return selection


def _guess_signals(
    source: Path | MemoryTable,
    columns: Sequence[str],
    unit: str | None,
    sampling_rate: str | None,
    gravity: float,
    select: str | None,
) -> tuple[list[StaticSignal], list[str]]:
    """Return the signals identified by column names and units, and the names of other columns."""
    stated_rate = _parse_quantity("sampling_rate", sampling_rate, "Hz", check_positive)
    answers = {} if sampling_rate is None else {"sampling_rate": sampling_rate}
    contents = _read_source(source, select)
    file_guess = guess_file(contents, answers)
    missing = [name for name in columns if name not in {c.name for c in contents.columns}]
    if missing:
        available = ", ".join(column.name for column in contents.columns)
        problem = f"`columns`: column {missing[0]!r} does not exist; the columns are {available}"
        if first_cell := next(iter(contents.first_text_cells.get(missing[0], ())), ""):
            problem = (
                f"`columns`: column {missing[0]!r} contains the text {first_cell[:40]!r}, "
                "not numbers"
            )
        problem += (
            f". The file was read as follows: {contents.format_description}"
            if contents.format_description
            else ""
        )
        problem += "".join(
            f". Not read: {reason.removesuffix('.')}" for reason in contents.unread_reasons
        )
        raise CampaignError("noise", [problem], code="missing-column")
    row_times = compute_row_times(source, file_guess, contents.columns, stated_rate)
    time_column = file_guess.time.column if file_guess.time else None
    candidates = [c for c in contents.columns if c.name != time_column and not c.is_timestamp]
    signals: list[StaticSignal] = []
    unused_columns: list[str] = []
    for column in candidates:
        if columns and column.name not in columns:
            continue
        column_unit = column.unit or unit_in_name(column.name) or unit
        observable = next(
            (
                name
                for name, si in OBSERVABLES.items()
                if column_unit and is_convertible(column_unit, si)
            ),
            None,
        )
        if column_unit is None or observable is None or len(column.values) != row_times.size:
            if columns:
                reason = f"is in {column_unit!r}" if column_unit else "has no unit; give `unit`"
                requirement = "a length, a velocity or a specific force is required"
                raise CampaignError(
                    "noise", [f"column {column.name!r} {reason}; {requirement}"], code="wrong-unit"
                )
            unused_columns.append(column.name)
            continue
        factor = unit_factor(column_unit, OBSERVABLES[observable], gravity=gravity)
        is_in_g = base_unit(column_unit)[1]["[gravity]"] != 0.0
        values = column.values * factor
        observable_order = observation.ORDERS[observable]
        signals.append(
            StaticSignal(column.name, column.name, observable_order, is_in_g, row_times, values)
        )
    if unit is not None and not any(is_convertible(unit, si) for si in OBSERVABLES.values()):
        requirement = "a unit of length, velocity or specific force is required, such as m/s^2"
        raise CampaignError("noise", [f"`unit`: {unit!r}: {requirement}"], code="wrong-unit")
    if not signals:
        raise RecordError(
            f"{source}: no column has a unit of length, velocity or specific force "
            f"({', '.join(unused_columns) or 'only the time'}). Select the column with `columns`, "
            "and give its unit with `unit`.",
            code="missing-unit",
        )
    varying_signals = [signal for signal in signals if np.unique(signal.values).size > 1]
    if varying_signals and not columns:
        # Zeros of a residual, or of an axis that is not connected.
        varying_columns = {signal.column for signal in varying_signals}
        unused_columns += [s.column for s in signals if s.column not in varying_columns]
        signals = varying_signals
    return signals, unused_columns


def _read_source(source: Path | MemoryTable, select: str | None) -> FileContents:
    """Return the contents of a record, of one sensor."""
    if select is not None and not isinstance(source, Path):
        problem = "`select`: applies only to the rows of a file; filter the data frame instead"
        raise UsageError("noise", [problem])
    if select is not None and not select.partition("=")[2]:
        raise UsageError("noise", ["`select`: write COLUMN=VALUE, such as device=A"])
    if isinstance(source, MemoryTable):
        columns = tuple(FileColumn(name, "", values) for name, values in source.columns.items())
        return FileContents(Path(source.name), columns, source.non_numeric_names, "")
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


def _estimate_noise(record: StaticRecord, spindle_rate: float | None) -> SignalNoise:
    """Return the noise of a column."""
    signal, segments, analysis = record.signal, record.segments, record.analysis
    noise_estimate, observable_type, step = analysis.noise, analysis.kind, analysis.step
    observable = next(name for name, order in observation.ORDERS.items() if order == signal.order)
    size_keys_by_name = component_keys(observable if signal.order else "quantisation")
    units = NOISE_UNITS if signal.order else NOISE_UNITS | {"quantisation": "m/s"}
    sizes = {
        size_keys_by_name[name]: NoiseSize(
            value=math.sqrt(component.variance) if component.variance > 0.0 else None,
            low=math.sqrt(component.low),
            high=math.sqrt(component.high) if math.isfinite(component.high) else None,
            unit=units[size_keys_by_name[name]],
        )
        for name, component in noise_estimate.components.items()
    }
    _, longest_segment = segments.longest
    difference_order = observable_type.averaging_order
    specific_force = np.diff(longest_segment, n=difference_order) / segments.step**difference_order
    duration = segments.step * sum(segment.size for _, segment in segments.segments)
    lines = [
        replace(line, name=_identify_line(line, 1.0 / step, spindle_rate))
        for line in analysis.lines
    ]
    signal_noise = SignalNoise(
        name=signal.name,
        column=signal.column,
        observable=observable,  # type: ignore[arg-type]
        in_g=signal.in_g,
        rows=segments.rows,
        sampling_rate=1.0 / segments.sample_interval,
        seconds=duration,
        outliers=segments.outliers,
        filled=segments.filled,
        gaps=segments.gaps,
        resolution=segments.resolution or None,
        components=sizes,
        drift=noise_estimate.drift,
        u_drift=noise_estimate.u_drift,
        lines=lines,
        allan=allan_values(analysis.velocity, step, observable_type, analysis.recorded),
        spectrum=spectrum(specific_force, segments.step, observable_type, analysis.recorded),
        remarks=[],
    )
    return signal_noise.model_copy(update={"remarks": list(_noise_remarks(signal_noise, record))})


def _identify_line(
    line: SpectralLine, sampling_rate: float, spindle_rate: float | None
) -> str | None:
    """Return the probable source of a line: mains or the spindle, possibly aliased."""
    tolerance = 3.0 * line.u_frequency
    spindle_frequency = None if spindle_rate is None else spindle_rate / (2.0 * math.pi)
    for harmonic in range(1, _MAX_SPINDLE_HARMONIC + 1) if spindle_frequency else ():
        assert spindle_frequency is not None
        if (
            abs(_alias_frequency(harmonic * spindle_frequency, sampling_rate) - line.frequency)
            <= tolerance + 1e-4 * spindle_frequency
        ):
            return "spindle" if harmonic == 1 else f"spindle, harmonic {harmonic}"
    for harmonic in range(1, _MAX_MAINS_HARMONIC + 1):
        for mains_frequency in _MAINS_FREQUENCIES:
            frequency = harmonic * mains_frequency
            if (
                abs(_alias_frequency(frequency, sampling_rate) - line.frequency)
                <= tolerance + _MAINS_RELATIVE_TOLERANCE * frequency
            ):
                name = f"{mains_frequency:g} Hz mains" + (
                    "" if harmonic == 1 else f", harmonic {harmonic}"
                )
                return (
                    name if frequency <= 0.5 * sampling_rate else f"{name}, aliased by the sampling"
                )
    return None


def _alias_frequency(frequency: float, sampling_rate: float) -> float:
    """Return the aliased frequency of a sampled sinusoid."""
    return abs(frequency - sampling_rate * round(frequency / sampling_rate))


def _noise_remarks(signal_noise: SignalNoise, record: StaticRecord) -> Iterator[str]:
    """Yield remarks on the validity of the figures."""
    for key, noise_size in signal_noise.components.items():
        name = component_name(key)
        if noise_size.value is None:
            if key in BIAS_COMPONENTS_BY_KEY:
                scale = BIAS_COMPONENTS_BY_KEY[key].limit_scale
                yield (
                    f"The record does not reveal any {name}. The stated upper limit is "
                    f"approximately inversely proportional to {scale}, so a longer record (hours) "
                    "can reveal smaller values."
                )
            continue
        has_wide_interval = (
            noise_size.high is None
            or noise_size.high > _MAX_INTERVAL_RATIO * noise_size.value
            or noise_size.low * _MAX_INTERVAL_RATIO < noise_size.value
        )
        if has_wide_interval and noise_size.low == 0.0:
            yield (
                f"The interval for the {name} has no lower limit, because the record is too "
                "short to distinguish this component from zero."
            )
        elif has_wide_interval:
            yield (
                f"The estimate of the {name} depends on the few slowest fluctuations in this "
                "record, so its interval is wide. Use a record several times longer than "
                f"{signal_noise.seconds:.4g} s."
            )
    yield from _sampling_remarks(record)
    if signal_noise.outliers:
        count = "1 sample" if signal_noise.outliers == 1 else f"{signal_noise.outliers} samples"
        yield f"Rejected as outliers: {count}."
    if signal_noise.gaps:
        plural_suffix = "s" if signal_noise.gaps > 1 else ""
        yield (
            f"The record is split at {signal_noise.gaps} gap{plural_suffix}. The "
            "spectrum and the Allan deviation use the longest part; the estimates of the noise "
            "components use all parts."
        )
    thinning_factor = round(record.analysis.step / record.segments.step)
    if thinning_factor > 1:
        yield (
            "The noise components, the spectral lines and the Allan deviation are computed from "
            f"velocities {thinning_factor} samples apart. The spectrum is computed from all "
            "samples."
        )
    if (
        signal_noise.resolution
        and signal_noise.resolution**2 / 12.0 > 0.1 * _estimate_local_scatter(record) ** 2
    ):
        yield (
            f"The samples are multiples of {signal_noise.resolution:.3g} "
            f"{OBSERVABLES[signal_noise.observable]}, so rounding error contributes much of this "
            "white noise. Rounding error is not white while the signal stays within one step."
        )
    yield from _motion_remarks(record)
    yield from _misfit_remarks(record.analysis.noise.bands)


def _sampling_remarks(record: StaticRecord) -> Iterator[str]:
    """Yield remarks on repeated rows and missing samples."""
    segments = record.segments
    if segments.repeated:
        yield (
            f"{segments.repeated} of {segments.rows} rows repeat the previous value, which "
            "is typical of a logging rate above the output rate of the sensor. The analysis "
            f"uses only new values, at {1.0 / segments.sample_interval:.4g} Hz."
        )
    if segments.stuck:
        yield (
            f"{segments.stuck} of {segments.rows} rows belong to long sequences of identical "
            "values, which suggests that the sensor stopped. The analysis does not use these "
            "rows."
        )
    if segments.restamped:
        yield (
            f"{segments.restamped} of {segments.rows} rows have the same time as the previous "
            "row, but a different value. counterspin calculates the time from the row count."
        )
    if segments.filled and segments.recorded_fraction < 1.0:
        missing_percent = 100.0 * (1.0 - segments.recorded_fraction)
        yield (
            f"{segments.filled} samples are missing ({missing_percent:.2g} %). The analysis treats "
            "the recorded samples as consecutive, so it resolves low-frequency noise poorly."
        )
        if record.signal.order == 0 and record.analysis.noise.components["white"].variance:
            yield (
                "With missing samples, quantisation noise of the velocity cannot be "
                "distinguished from white noise. Use a record without missing samples."
            )
    elif segments.filled > segments.outliers:
        yield f"{segments.filled - segments.outliers} missing samples were interpolated."


def _motion_remarks(record: StaticRecord) -> Iterator[str]:
    """Yield a remark on the segment whose scatter of specific force indicates motion."""
    segment_start, values = record.segments.longest
    segment_length = max(_MIN_SEGMENT_SAMPLES, values.size // _N_MOTION_SEGMENTS)
    segments = values[: values.size // segment_length * segment_length].reshape(-1, segment_length)
    scatters = segments.std(axis=1)
    # If all values of a segment are equal, its scatter is that of the rounding.
    rounding = record.segments.resolution / math.sqrt(12.0)
    rest_scatter = max(float(np.quantile(scatters, 0.25)), rounding)
    index = int(np.argmax(scatters))
    if (
        record.signal.order == 0
        and len(segments) >= _N_MOTION_SEGMENTS // 2
        and scatters[index] > _MIN_SCATTER_RATIO * rest_scatter
    ):
        start_time = segment_start + index * segment_length * record.segments.step
        end_time = start_time + segment_length * record.segments.step
        yield (
            f"From {start_time:.4g} s to {end_time:.4g} s, the "
            f"scatter is {scatters[index] / rest_scatter:.2g} times that of the quiet parts "
            "of the record. The sensor moved during part of the record, so the results do not "
            "describe the noise of the sensor. Remove the part with motion."
        )


def _estimate_local_scatter(record: StaticRecord) -> float:
    """Return the standard deviation of samples relative to their neighbours."""
    _, longest_segment = record.segments.longest
    second_differences = longest_segment[2:] - 2.0 * longest_segment[1:-1] + longest_segment[:-2]
    return float(np.std(second_differences)) / math.sqrt(6.0)


def _misfit_remarks(bands: Sequence[Band]) -> Iterator[str]:
    """Yield a remark on the band where the spectrum deviates most from the components."""
    from scipy.stats import chi2

    worst_pair: tuple[float, Band] | None = None
    for band in bands:
        statistic = band.ratio * band.count
        p = 2.0 * min(chi2.sf(statistic, band.count), chi2.cdf(statistic, band.count)) * len(bands)
        if p < _MISFIT_SIGNIFICANCE and (
            worst_pair is None or abs(math.log(band.ratio)) > worst_pair[0]
        ):
            worst_pair = abs(math.log(band.ratio)), band
    if worst_pair is not None:
        band = worst_pair[1]
        yield (
            f"From {band.low:.3g} to {band.high:.3g} Hz, the record has {band.ratio:.3g} times "
            "the power of these noise components. The likely cause is a filter, a resonance or "
            "a disturbance, not sensor noise. The intervals do not include this effect. "
            "Inspect the spectrum."
        )


def format_noise_table(signals: Sequence[SignalNoise], gravity: float) -> str:
    """Return a [noise] table with the largest size of each component over all columns."""
    max_size_by_key: dict[str, tuple[float, bool]] = {}
    for signal in signals:
        for key, size in signal.components.items():
            if size.value is not None and key != "quantisation":
                previous_pair = max_size_by_key.get(key, (0.0, False))
                max_size_by_key[key] = max(previous_pair, (size.value, signal.in_g))
    lines = ["[noise]"]
    for key, (value, is_in_g) in max_size_by_key.items():
        unit, factor = noise_display_unit(NOISE_UNITS[key], is_in_g, gravity)
        lines.append(f'{key} = "{format_number(value * factor)} {unit}"')
    return "\n".join(lines) + "\n"

"""Methods of a result: tests and their agreement, equations, and command to repeat it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Final

from counterspin.calibration.findings import method_test_level
from counterspin.calibration.options import TwoStageOptions, acceptance_arguments, command_arguments
from counterspin.calibration.result import Result
from counterspin.calibration.result_parts import (
    AccelerometerResult,
    Coefficient,
    MethodAgreement,
    PoseResult,
    ReadingResult,
)
from counterspin.campaign.documents import DESCRIPTION_NAME
from counterspin.physics.effects import SpecificForceProduct
from counterspin.physics.terms import (
    MOTION_TERMS,
    PLATFORM_TERMS,
    SHARED_TERMS,
    TERMS,
    Term,
    affects_readings,
)
from counterspin.reports.blocks import Block, Column, Heading, Paragraph, Table
from counterspin.reports.numbers import (
    NOT_DETERMINED,
    find_display_unit,
    format_compact,
    format_number,
)
from counterspin.shell import join_command

_SIGNAL_EQUATIONS: Final = {
    "displacement": "S(t) = S₀ + V₀ t + ∬ (g a_ind − a_h) dt dt",
    "velocity": "V(t) = V₀ + ∫ (g a_ind − a_h) dt",
    "specific_force": "f(t) = g a_ind",
}

#: Motion of a test -> name and standard of the test.
_TEST_NAMES: Final = {
    "static": "multi-position, at rest (IEEE Std 1293)",
    "vibration": "vibration (IEEE Std 1293)",
    "arm": "arm centrifuge (IEEE Std 836)",
    "counter-rotating": "double turntable",
}

#: Motion of a test -> specific force along the axes of its frame.
_FORCE_EQUATIONS: Final = {
    "static": "At rest, along east, north and up: f = (0, 0, g)",
    "vibration": "During vibration: f = (0, 0, g) + (b + A sin φ) i, along the input axis i",
    "arm": "On the arm, outward, forward and up: f = (−R (w² + 2 w Ω sin L), 0, "
    "g + 2 R w Ω cos L sin θ)",
    "counter-rotating": "On the double turntable, east, north and up: f = (−R (w² + 2 w Ω sin L) "
    "cos θ, −R (w² + 2 w Ω sin L) sin θ, g + 2 R w Ω cos L sin θ)",
}


def model_blocks(result: Result) -> Iterator[Block]:
    """Yield the equations of the fit with its terms."""
    yield Heading("Model")
    yield Paragraph(
        "The indication of an accelerometer, in g, is the following function of the components "
        "a_I, a_P and a_O of the specific force along the input, pendulous and output axes:"
    )
    for name, accelerometer in result.accelerometers.items():
        # The fit does not contain terms without values.
        coefficients = {**accelerometer.known, **accelerometer.coefficients}
        symbols = {
            symbol for symbol, coefficient in coefficients.items() if coefficient.value is not None
        }
        terms = [TERMS[symbol] for symbol in TERMS if symbol in symbols]
        yield Paragraph(f"{name}: a_ind = {_format_equation(terms)}", "equation")
    shared_symbols = dict.fromkeys(
        [*result.platform, *(symbol for run in result.runs.values() for symbol in run.terms)]
    )
    if platform_symbols := [symbol for symbol in shared_symbols if symbol in PLATFORM_TERMS]:
        yield Paragraph(
            "The small attitude error ψ of the platform rotates the sensed specific force to f "
            "− ψ × f, where ψ = tilt + ∫ (drift + D f/g + E |f|²/g²) dt + C f/g. The fit "
            f"includes these attitude terms: {_join_symbols(platform_symbols)}."
        )
    if path_symbols := [symbol for symbol in shared_symbols if symbol in MOTION_TERMS]:
        yield Paragraph(
            "These path errors displace the platform from the position calculated from the "
            f"radius and the recorded angle: {_join_symbols(path_symbols)}."
        )
    yield from reading_blocks(result)
    if result.runs or not (group_readings(result) or unknown_poses(result)):
        yield from _recorded_signal_blocks(result)
    yield Paragraph(_method_sentence(result))


def _recorded_signal_blocks(result: Result) -> Iterator[Block]:
    """Yield the equations of the recorded signals of a double turntable."""
    observables = {
        accelerometer.observable or "displacement"
        for accelerometer in result.accelerometers.values()
    }
    yield Paragraph(
        "The recorded signal is the following integral. The navigation computer subtracts a_h, "
        "the sum of the gravitational, Coriolis and centrifugal accelerations:"
    )
    for observable in sorted(observables):
        yield Paragraph(_SIGNAL_EQUATIONS[observable], "equation")
    yield Paragraph(
        "θ(t) = θ₀ + ω (t + C t²/2) + rate ripple (harmonics of the rotation)", "equation"
    )


def _method_sentence(result: Result) -> str:
    if result.model == "as-printed":
        return (
            "The observation model uses the paper's equations as printed, which yield half the "
            "true K_II. Use this model only for comparison."
        )
    if result.method == "two-stage":
        return (
            "The two-stage method of the paper first fits a parabola to one sample per "
            "revolution, taken at zero reference displacement. It then fits a function of the "
            "rate to the curvatures."
        )
    reading_texts = ["all readings of all test methods"] if group_readings(result) else []
    pose_texts = ["all poses (two unknown angles each)"] if unknown_poses(result) else []
    if reading_texts or pose_texts:
        record_texts = ["all samples of the records"] if result.runs else []
        observation_text = " and ".join([*record_texts, *reading_texts, *pose_texts])
        return (
            f"Weighted least squares fits {observation_text} jointly. Priors enter as "
            "pseudo-observations. The fit does not adjust considered quantities. Their "
            "uncertainties are propagated through their sensitivity coefficients."
        )
    return (
        "Weighted least squares fits all samples of all runs and accelerometers jointly. Priors "
        "enter as pseudo-observations. The fit does not adjust considered quantities. Their "
        "uncertainties are propagated through their sensitivity coefficients. Each run has a "
        "separate initial offset and initial velocity."
    )


def _format_equation(terms: Iterable[Term[SpecificForceProduct]]) -> str:
    summands = []
    for term in terms:
        product = term.effect.text.replace("*", " ")
        sign = "−" if term.effect.weight < 0.0 else "+"
        summands.append(f"{sign} {term.symbol}" + ("" if product == "1" else f" {product}"))
    return " ".join(summands).removeprefix("+ ")


def _join_symbols(symbols: Iterable[str]) -> str:
    return ", ".join(symbols)


def origin_blocks(result: Result) -> Iterator[Block]:
    """Yield the inputs of the result, and the command that repeats the calibration."""
    yield Heading("Inputs and reproducibility")
    inputs = result.inputs
    latitude_text = format_number(math.degrees(inputs.latitude), 8)
    radius_text = f", radius {inputs.radius:.10g} m" if inputs.radius else ""
    yield Paragraph(
        f"Gravity {format_number(inputs.gravity, 9)} m/s^2, latitude {latitude_text} "
        f"deg{radius_text}."
    )
    yield Table(
        columns=(Column("File"), Column("SHA-256")),
        rows=tuple(
            (file, checksum.removeprefix("sha256:")) for file, checksum in result.provenance.shown
        ),
    )
    version_text = f"This report was made by counterspin {result.provenance.version}."
    if result.provenance.in_memory:
        inputs_text = "; ".join(
            f"{name} ({description})" for name, description in result.provenance.in_memory.items()
        )
        yield Paragraph(
            f"{version_text} No command can repeat the calibration, because some inputs are not "
            f"files: {inputs_text}. To make it repeatable, write a campaign folder with "
            "`Campaign.write`."
        )
        return
    yield Paragraph(
        f"{version_text} To repeat the calibration, run this command in the folder that "
        "contains these files:"
    )
    options = list(result.provenance.options)
    method_arguments = command_arguments(result.method, TwoStageOptions())
    # In earlier versions, the two-stage method was the default and had no argument.
    options = [*(argument for argument in method_arguments if argument not in options), *options]
    options += acceptance_arguments(result.accepted_misfit)
    description_name = next(iter(result.provenance.inputs), DESCRIPTION_NAME)
    path = "." if description_name == DESCRIPTION_NAME else description_name
    yield Paragraph(join_command(("counterspin", "calibrate", path, *options)), "command")


def group_readings(result: Result) -> dict[str, list[ReadingResult]]:
    """Return the readings of all accelerometers by motion."""
    readings_by_motion: dict[str, list[ReadingResult]] = {}
    for accelerometer in result.accelerometers.values():
        for reading in accelerometer.readings:
            readings_by_motion.setdefault(reading.motion, []).append(reading)
    return readings_by_motion


def unknown_poses(result: Result) -> list[PoseResult]:
    """Return the poses of unknown attitude."""
    return [] if result.triad is None else result.triad.poses


def describe_tests(result: Result) -> Iterator[str]:
    """Yield a sentence on each test of a campaign with readings or poses."""
    for motion, readings in group_readings(result).items():
        count_text = _format_count(len(readings), "reading")
        if motion == "static":
            position_text = _format_count(len(_distinct_positions(readings)), "position")
            yield (
                f"Readings at rest in {position_text}: {count_text} (multi-position test, IEEE Std "
                "1293)."
            )
            continue
        if motion == "vibration":
            amplitudes = _list_amplitudes(readings)
            yield (
                f"Readings during vibration at {_format_count(len(amplitudes), 'amplitude')}, "
                f"{_format_range(amplitudes)} m/s^2 (peak): {count_text}. Each reading is the mean "
                "over whole vibration cycles."
            )
            continue
        rates = sorted({abs(reading.rate) for reading in readings})
        rate_text = f"{_format_count(len(rates), 'rate')}, {_format_range(rates)} rad/s"
        sense_text = (
            "both senses of rotation"
            if len({reading.rate > 0.0 for reading in readings}) > 1
            else "one sense of rotation"
        )
        mountings = dict.fromkeys(reading.mounting for reading in readings if reading.mounting)
        mounting_names = ", ".join(mountings)
        mounting_text = (
            f", {_format_count(len(mountings), 'mounting')} ({mounting_names})" if mountings else ""
        )
        test_text = (
            "Readings on the arm of a centrifuge (IEEE Std 836)"
            if motion == "arm"
            else "Readings on a double turntable"
        )
        yield (
            f"{test_text} at {rate_text}, {sense_text}{mounting_text}: {count_text}. Each reading "
            "is the mean over whole revolutions."
        )
    if poses := unknown_poses(result):
        yield f"Readings at rest in {_format_count(len(poses), 'pose')} of unknown attitude."
    if result.runs:
        record_text = _format_count(len(result.runs), "record")
        yield f"Double-turntable centrifuge records at the stated rates: {record_text}."


def tabulate_tests(readings: Sequence[ReadingResult]) -> Table:
    """Return a table of positions, rates and readings by test type and mounting."""
    groups: dict[tuple[str, str], list[ReadingResult]] = {}
    for reading in readings:
        groups.setdefault((reading.motion, reading.mounting), []).append(reading)
    return Table(
        columns=(
            Column("Test", wraps=True),
            Column("Mounting"),
            Column("Positions", "right"),
            Column("Rates, rad/s", "right"),
            Column("Amplitudes, m/s^2", "right"),
            Column("Indication, g", "right"),
            Column("Readings", "right"),
        ),
        rows=tuple(
            (
                _TEST_NAMES[motion],
                mounting,
                str(len(_distinct_positions(group))),
                _format_range(rates)
                if any(rates := sorted({reading.rate for reading in group}))
                else "",
                _format_range(amplitudes) if (amplitudes := _list_amplitudes(group)) else "",
                _format_range(sorted(reading.value for reading in group)),
                str(len(group)),
            )
            for (motion, mounting), group in groups.items()
        ),
    ).without_empty_columns()


def _list_amplitudes(readings: Sequence[ReadingResult]) -> list[float]:
    return sorted({reading.amplitude for reading in readings if reading.amplitude is not None})


def reading_blocks(result: Result) -> Iterator[Block]:
    """Yield the definition of a reading, and the forces at its position."""
    if unknown_poses(result):
        yield Paragraph(
            "In a pose of unknown attitude, |f| = g. The direction of f is estimated together "
            "with the coefficients."
        )
    readings_by_motion = group_readings(result)
    if not readings_by_motion:
        return
    yield Paragraph(
        "A reading is the indication at rest, or the mean indication over whole revolutions. "
        "The specific force depends on radius R, rate w, Earth rate Ω and latitude L:"
    )
    for motion in readings_by_motion:
        yield Paragraph(_FORCE_EQUATIONS[motion], "equation")
    machine_symbols = [
        symbol
        for symbol in result.platform
        if symbol not in SHARED_TERMS and affects_readings(symbol)
    ]
    if machine_symbols:
        yield Paragraph(
            "The fit estimates these machine error terms together with the coefficients: "
            f"{', '.join(machine_symbols)}."
        )


def _distinct_positions(readings: Sequence[ReadingResult]) -> set[tuple[float, ...]]:
    # Directions contain rounding errors; + 0.0 turns -0.0 into 0.0.
    return {
        tuple(
            round(component, 6) + 0.0
            for component in (*reading.input_axis, *reading.pendulous_axis)
        )
        for reading in readings
    }


def _format_range(values: Sequence[float]) -> str:
    low, high = (format_number(value, 4) for value in (values[0], values[-1]))
    return low if low == high else f"{low} to {high}"


def _format_count(count: int, noun: str) -> str:
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def method_blocks(accelerometer: AccelerometerResult) -> Iterator[Block]:
    """Yield the coefficients by all tests and by each method, and their agreement."""
    methods = accelerometer.kinds
    if not methods:
        return
    symbols = [
        symbol
        for symbol, coefficient in accelerometer.coefficients.items()
        if coefficient.estimated or any(_has_value(method, symbol) for method in methods)
    ]
    yield Table(
        columns=(
            Column("Coefficient"),
            Column("Unit"),
            Column("All tests", "right"),
            *(
                Column(f"only {method.kind} ({method.count})", "right", wraps=True)
                for method in methods
            ),
        ),
        rows=tuple(
            (
                symbol,
                find_display_unit(accelerometer.coefficients[symbol].unit)[0],
                _estimate_cell(accelerometer.coefficients[symbol]),
                *(_estimate_cell(method.coefficients.get(symbol)) for method in methods),
            )
            for symbol in symbols
            if symbol in accelerometer.coefficients
        ),
    )
    test_level = method_test_level(methods)
    sentence = "; ".join(_agreement_text(method, test_level) for method in methods)
    yield Paragraph("Agreement between the test methods: " + sentence + ".")


def _has_value(method: MethodAgreement, symbol: str) -> bool:
    return symbol in method.coefficients and method.coefficients[symbol].estimated


def _estimate_cell(coefficient: Coefficient | None) -> str:
    if coefficient is None or not coefficient.estimated or coefficient.value is None:
        return NOT_DETERMINED
    _, factor = find_display_unit(coefficient.unit)
    return format_compact(coefficient.value * factor, (coefficient.u or 0.0) * factor)


def _agreement_text(method: MethodAgreement, level: float) -> str:
    if method.p is None:
        return f"{method.kind}, not predicted by the other methods"
    verdict_text = (
        "consistent with the others" if method.p >= level else "not consistent with the others"
    )
    text = (
        f"{method.kind}, {verdict_text} (chi-square/dof "
        f"{format_number(method.chi2 / method.dof, 3)}, p = {format_number(method.p, 2)}"
    )
    shifts = {symbol: abs(shift.z) for symbol, shift in method.without.items()}
    if shifts and math.isfinite(max_shift := max(shifts.values())):
        symbol = max(shifts, key=lambda name: shifts[name])
        text += (
            f"; omitting this method shifts {symbol} by {format_number(max_shift, 2)} times the u "
            "of the shift, more than any other coefficient"
        )
    return text + ")"

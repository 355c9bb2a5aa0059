"""Results of one accelerometer, as blocks of a report."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

from counterspin.calibration.findings import methods_agree
from counterspin.calibration.pages.methods import method_blocks, tabulate_tests
from counterspin.calibration.pages.uncertainty import source_label
from counterspin.calibration.result_parts import (
    AccelerometerResult,
    Coefficient,
    Comparison,
    NoiseLine,
    ReadingResult,
    RunResult,
)
from counterspin.inference.identifiability import ConfoundedTerms
from counterspin.inference.joint.summary import Jackknife
from counterspin.inference.noise.components import COMPONENTS_BY_KEY
from counterspin.physics.terms import describe_term, is_term, term
from counterspin.records.record import rejected_count
from counterspin.reports.blocks import MAX_TERMINAL_ROWS, Block, Column, Heading, Paragraph, Table
from counterspin.reports.numbers import (
    NOT_DETERMINED,
    find_display_unit,
    format_compact,
    format_count,
    format_estimate,
    format_number,
    format_share,
    round_to_uncertainty,
)

#: Magnitude of a correlation above which it is listed.
_MIN_LISTED_CORRELATION: Final = 0.9

#: Unknowns of the two-stage method that are not in the tables of terms:
#: symbol -> symbol in the paper, and description.
_SPINDLE_TERMS: Final = {
    "spindle.drift": ("C", "rate drift common to all runs"),
    "spindle.ripple": ("w_p", "rate ripple (Eq. 26) common to all runs"),
}

#: Key of the counts of a record -> noun in the singular and in the plural.
_COUNT_NOUNS: Final = {
    "rows": ("row", "rows"),
    "repeated": ("repeated row", "repeated rows"),
    "empty": ("empty cell", "empty cells"),
    "outliers": ("outlier", "outliers"),
    "gaps": ("gap", "gaps"),
    "block": ("sample per block", "samples per block"),
}


def accelerometer_blocks(
    name: str, accelerometer: AccelerometerResult, gravity: float, *, show_details: bool
) -> Iterator[Block]:
    """Yield the results of an accelerometer; gravity: m/s^2; details: as in a report."""
    yield Heading(f"Accelerometer {name}")
    yield coefficient_table({**accelerometer.coefficients, **accelerometer.second_unknown})
    for sentence in confounded_sentences(accelerometer):
        yield Paragraph(sentence)
    yield Paragraph(_residual_sentence(accelerometer))
    if accelerometer.noise:
        yield Paragraph(_noise_sentence(accelerometer.noise, gravity))
    if accelerometer.output:
        yield Paragraph(_output_units_text(accelerometer))
    yield from method_blocks(accelerometer)
    if accelerometer.readings:
        yield tabulate_tests(accelerometer.readings)
    yield from _reading_blocks(accelerometer.readings, show_details=show_details)
    if accelerometer.two_stage is not None:
        yield Paragraph(
            _comparison_sentence(accelerometer.two_stage, accelerometer.coefficients.get("K_II"))
        )
    if accelerometer.jackknife and "K_II" in accelerometer.coefficients:
        yield from _jackknife_table(accelerometer.jackknife, accelerometer.coefficients["K_II"])
    if show_details:
        yield from _correlation_blocks(accelerometer)


def _output_units_text(accelerometer: AccelerometerResult) -> str:
    estimate_texts = (
        f"{key.replace('_', ' ')} "
        f"{format_estimate(coefficient.value, coefficient.u, coefficient.unit)}"
        for key, coefficient in accelerometer.output.items()
    )
    nominal_clause = f" (nominal {accelerometer.nominal.words})" if accelerometer.nominal else ""
    return f"Coefficients in the unit of the readings: {', '.join(estimate_texts)}{nominal_clause}."


def _reading_blocks(readings: Sequence[ReadingResult], *, show_details: bool) -> Iterator[Block]:
    if not readings:
        return
    shown_readings = readings if show_details else readings[:MAX_TERMINAL_ROWS]
    yield Table(
        n_omitted=len(readings) - len(shown_readings),
        columns=(
            Column("Reading", wraps=True),
            Column("Motion"),
            Column("Rate, rad/s", "right"),
            Column("Indication, g", "right"),
            Column("Residual, ug", "right"),
            Column("Residual / u(residual)", "right"),
            Column("Samples used", "right"),
            Column("Samples rejected", "right"),
        ),
        rows=tuple(
            (
                reading.name,
                reading.motion,
                format_number(reading.rate, 6) if reading.rate else "",
                format_compact(reading.value, reading.u),
                f"{reading.residual * 1e6:.2f}",
                "-" if reading.z is None else f"{reading.z:.2f}",
                *_sample_cells(reading),
            )
            for reading in shown_readings
        ),
    ).without_empty_columns()
    for reading in (reading for reading in readings if reading.samples is not None):
        yield from note_blocks(reading.name, reading)
        if show_details:
            yield from count_blocks(reading.name, reading)


def _sample_cells(reading: ReadingResult) -> tuple[str, str]:
    """Return the cells of used and rejected samples; empty unless the reading is a mean."""
    return (
        ("", "")
        if reading.samples is None
        else (str(reading.samples), str(rejected_count(reading.counts)))
    )


def to_field_units(coefficient: Coefficient) -> tuple[float | None, float | None, str]:
    """Return value, standard uncertainty and unit in the usual unit of the field."""
    unit, factor = find_display_unit(coefficient.unit)
    value, u = coefficient.value, coefficient.u
    return None if value is None else value * factor, None if u is None else u * factor, unit


def coefficient_table(coefficients: dict[str, Coefficient]) -> Table:
    """Return a table with a row for each coefficient."""
    rows = [
        (*_symbol_and_description(symbol), *coefficient_cells(coefficient))
        for symbol, coefficient in coefficients.items()
    ]
    return Table(
        columns=(
            Column("Symbol"),
            Column("Coefficient", wraps=True),
            Column("Value", "right"),
            Column("u (k = 1)"),
            Column("Unit"),
            Column("Uncertainty contributions", wraps=True),
        ),
        rows=tuple(rows),
        quiet_rows=frozenset(
            i for i, coefficient in enumerate(coefficients.values()) if not coefficient.estimated
        ),
    )


def _symbol_and_description(symbol: str) -> tuple[str, str]:
    """Return symbol and description of a term, with the name of its run in brackets."""
    base_symbol, bracket, run = symbol.partition(" (")
    if not is_term(base_symbol):
        return _SPINDLE_TERMS.get(base_symbol, (symbol, ""))
    return symbol, describe_term(base_symbol) + bracket + run


def coefficient_cells(coefficient: Coefficient) -> tuple[str, str, str, str]:
    """Return value, uncertainty, unit, and the origin of the uncertainty."""
    return (*_value_cells(coefficient), _uncertainty_origin(coefficient))


def _value_cells(coefficient: Coefficient) -> tuple[str, str, str]:
    """Return value, uncertainty and unit; the unit carries the power of ten, if there is one."""
    value, u, unit = to_field_units(coefficient)
    if value is None:
        return "-", "", unit
    if u is None or u == 0.0:
        return format_number(value, 12), "exact" if u == 0.0 else "", unit
    rounded_estimate = round_to_uncertainty(value, u)
    if rounded_estimate is None:
        return format_number(value, 17), f"± {format_number(u, 2)}", unit
    return (
        rounded_estimate.value,
        f"± {rounded_estimate.u}",
        f"1e{rounded_estimate.exponent} {unit}" if rounded_estimate.exponent else unit,
    )


def _uncertainty_origin(coefficient: Coefficient) -> str:
    if coefficient.value is None:
        return NOT_DETERMINED
    if not coefficient.estimated:
        return "prior only"
    components = {
        "noise": coefficient.u_noise,
        "stated priors": coefficient.u_stated,
        "default priors": coefficient.u_unstated,
    }
    total_variance = sum(u * u for u in components.values() if u is not None)
    if total_variance == 0.0:
        return ""
    shares = {name: (u or 0.0) ** 2 / total_variance for name, u in components.items()}
    return ", ".join(
        f"{name} {format_share(share)}" for name, share in shares.items() if share >= 0.005
    )


def confounding_text(confounded_terms: ConfoundedTerms) -> str:
    """Return a clause on confounded terms and the degree of confounding."""
    names = ", ".join(confounded_terms.terms[:-1]) + " and " + confounded_terms.terms[-1]
    return f"{names} {'cannot' if confounded_terms.inseparable else 'can hardly'} be separated"


def _confounded_sentence(confounded_terms: ConfoundedTerms) -> str:
    text = (
        f"{confounding_text(confounded_terms)} with these records (correlation "
        f"{_format_correlation(confounded_terms.correlation)}); the records determine only "
        f"{confounded_terms.determined}"
    )
    if confounded_terms.value is None:
        return text + "."
    symbol = confounded_terms.terms[0].partition(" (")[0]
    unit, factor = find_display_unit(term(symbol).unit if is_term(symbol) else "")
    u = None if confounded_terms.u is None else confounded_terms.u * factor
    return f"{text} = {format_estimate(confounded_terms.value * factor, u, unit)}."


def confounded_sentences(accelerometer: AccelerometerResult) -> Iterator[str]:
    """Return a sentence for each set of terms that the records cannot separate."""
    return map(_confounded_sentence, accelerometer.confounded)


def _format_correlation(r: float) -> str:
    """Format a correlation; one that would round to 1 is written as 1 minus the difference."""
    if 0.0 < 1.0 - abs(r) < 5e-5:
        distance_from_unity = format_number(1.0 - abs(r), 1)
        return f"1 - {distance_from_unity}" if r > 0.0 else f"-1 + {distance_from_unity}"
    return f"{r:.4f}"


def _residual_sentence(accelerometer: AccelerometerResult) -> str:
    residual = accelerometer.residual
    text = (
        f"Residuals: rms {format_number(residual.rms)} {residual.unit}, "
        f"{format_count(residual.dof)} degrees of freedom"
    )
    if residual.chi2 is not None and residual.dof > 0.0:
        text += f"; chi-square/dof {format_number(residual.chi2 / residual.dof, 4)}"
    if residual.lack_of_fit_p is not None:
        # Estimated noise agrees in size, so only the pattern of the residuals is tested.
        statistic = "p" if residual.chi2 is not None else "p (pattern)"
        text += f"; {statistic} = {format_number(residual.lack_of_fit_p, 2)}"
    return text + "."


def _noise_sentence(noise: dict[str, NoiseLine], gravity: float) -> str:
    clauses = []
    for name, line in noise.items():
        value, u, unit = line.value, line.u, line.unit
        if name in COMPONENTS_BY_KEY:
            # In micro-g, as in the campaign file and in data sheets.
            scale = 1e6 / gravity
            value, u, unit = value * scale, None if u is None else u * scale, f"ug{unit[5:]}"
        elif name == "timing":
            value, unit = value * 1e6, "us"
        label = {"timing": "time stamps"}.get(name, name.replace("_", " "))
        if line.estimated and value == 0.0:
            clauses.append(f"{label} none detected")
            continue
        source_text = f"from {line.record}" if line.record else "as given"
        evaluation_text = "estimated from the residuals" if line.estimated else source_text
        is_approximate = line.estimated and u is None
        noise_text = (
            f"{format_number(value, 2)} {unit}"
            if is_approximate
            else format_estimate(value, u, unit)
        )
        run_texts = [f"{format_number(size, 2)} in {run}" for run, size in line.runs.items()]
        run_clause = f", by run {', '.join(run_texts)}" if run_texts else ""
        clauses.append(f"{label} {noise_text} ({evaluation_text}){run_clause}")
    return f"Noise: {'; '.join(clauses)}."


def _comparison_sentence(comparison: Comparison, coefficient: Coefficient | None) -> str:
    unit, factor = find_display_unit(coefficient.unit if coefficient else "")
    agreement_text = "consistent" if methods_agree(comparison) else "not consistent"
    value_text = format_estimate(comparison.value * factor, comparison.u * factor, unit)
    difference_text = format_estimate(
        comparison.difference * factor, comparison.u_difference * factor, unit
    )
    return (
        f"Two-stage method: K_II = {value_text}. Difference from the joint method: "
        f"{difference_text} (z = {format_number(comparison.z)}); {agreement_text}."
    )


def _jackknife_table(lines: Sequence[Jackknife], coefficient: Coefficient) -> Iterator[Block]:
    value, u, unit = to_field_units(coefficient)
    _, factor = find_display_unit(coefficient.unit)
    # All estimates have the decimal places of the result, for comparison.
    rounded_estimate = round_to_uncertainty(value, u) if value is not None and u else None
    if rounded_estimate is not None and rounded_estimate.exponent:
        unit = f"1e{rounded_estimate.exponent} {unit}"

    def format_value(value: float | None) -> str:
        if value is None:
            return NOT_DETERMINED
        scaled_value = value * factor
        return (
            rounded_estimate.format(scaled_value)
            if rounded_estimate is not None
            else format_number(scaled_value, 6)
        )

    yield Table(
        columns=(
            Column("Omitted run", wraps=True),
            Column(f"K_II, {unit}", "right"),
            Column(f"Shift, {unit}", "right"),
            Column("Shift / u(shift)", "right"),
        ),
        rows=tuple(
            (
                line.run,
                format_value(line.value),
                format_value(line.shift),
                "-" if line.z is None else f"{line.z:.2f}",
            )
            for line in lines
        ),
    )


def _correlation_blocks(accelerometer: AccelerometerResult) -> Iterator[Block]:
    if accelerometer.correlation is None:
        return
    terms, matrix = accelerometer.correlation.terms, accelerometer.correlation.matrix
    pairs = [
        (terms[i], terms[j], matrix[i][j])
        for i in range(len(terms))
        for j in range(i)
        if abs(matrix[i][j]) >= _MIN_LISTED_CORRELATION
    ]
    pairs.sort(key=lambda pair: -abs(pair[2]))
    if not pairs:
        yield Paragraph("No correlation between two estimates exceeds 0.9 in magnitude.")
        return
    yield Paragraph("Correlations with magnitude above 0.9:")
    yield Table(
        (Column("Estimate", wraps=True), Column("and", wraps=True), Column("Correlation", "right")),
        tuple(
            (source_label(second_term), source_label(first_term), _format_correlation(r))
            for first_term, second_term, r in pairs
        ),
    )


def note_blocks(name: str, result: RunResult | ReadingResult) -> Iterator[Block]:
    """Yield a paragraph for each note on reading the record."""
    for note in result.notes:
        yield Paragraph(note if note.startswith(name) else f"{name}: {note}")


def count_blocks(name: str, result: RunResult | ReadingResult) -> Iterator[Block]:
    """Yield the number of rows of each kind."""
    counts = [f"{count} {_COUNT_NOUNS[key][count != 1]}" for key, count in result.counts.items()]
    if counts:
        yield Paragraph(f"{name}: {', '.join(counts)}.")

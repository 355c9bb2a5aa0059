"""Effect of each model violation on a calibration, and its findings: `make violations`.

Each row of the table in violations.md is one campaign. Its simulation differs from its description
in one quantity, by a realistic amount. The records are calibrated twice: with all unstated terms
fixed at nominal, and with none fixed. Shifts are relative to the same campaign without the
violation. Nothing is linearised.
"""

import math
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from counterspin.calibration.calibrate import calibrate
from counterspin.calibration.result import Result
from counterspin.physics.terms import ACCELEROMETER_TERMS, SHARED_TERMS, term
from counterspin.reports.numbers import find_display_unit, format_number
from counterspin.simulation.simulate import simulate
from stored_table import (
    DOCS,
    UNITS,
    StoredTable,
    describe_channel,
    describe_runs,
    describe_site,
    format_table,
    run_study,
)

#: A larger shift without a finding is an error; in standard uncertainties.
SILENT_SHIFT_LIMIT: Final = 3.0

#: Smaller shifts are not shown; in standard uncertainties.
SHOWN_SHIFT_LIMIT: Final = 0.1

#: Observable -> noise of a sample.
NOISE: Final = {"displacement": "0.01 m", "velocity": "1e-3 m/s", "specific_force": "1e-4 m/s^2"}


@dataclass(frozen=True)
class Size:
    """Size of a campaign: sampling rate in Hz, and revolutions of each run."""

    sampling_rate: float
    revolutions: int


def describe_campaign(observable: str, size: Size) -> str:
    """Return the reference campaign: three rates, level, priors of bias and scale factor."""
    site = describe_site("9.8066 ± 1e-5 m/s^2", "45.75 ± 0.001 deg", "2.5 ± 1e-5 m")
    return f"""{site}
[accelerometers.Qx]
{describe_channel(observable, "east")}
bias = "0.00503 ± 2e-6 g"
scale_factor = "1.00197 ± 5e-6 g/g"

[noise]
{observable} = "{NOISE[observable]}"
{describe_runs()}
[simulation]
sampling_rate = "{size.sampling_rate} Hz"
seed = 2
revolutions = {size.revolutions}

[truth.Qx]
K_F = "0.0050312 g"
K_I = "1.0019732 g/g"
K_II = "2e-5 g/g^2"
K_III = "3e-6 g/g^3"

[truth.spindle]
ripple = [{{ harmonic = 1, ratio = 5e-7, phase = "30 deg" }}]
"""


#: Fixes all unstated terms at nominal.
FIX_UNSTATED: Final = {"[noise]\n": '[model]\nassume = "all"\n\n[noise]\n'}


def _add_temperatures(*temperatures: float) -> dict[str, str]:
    """Return the changes that add temperatures to the simulated runs, degC."""
    return {
        f'record = "run{run}.csv"': f'record = "run{run}.csv"\ntemperature = "{celsius} degC"'
        for run, celsius in enumerate(temperatures, 1)
    }


WARMING_RUNS: Final = _add_temperatures(22.5, 23.0, 23.5)
TEMPERATURE_CYCLE: Final = _add_temperatures(20.0, 23.0, 20.0)

FULL_SIZE: Final = Size(50.0, 100)

#: Delay of a sensor of 592 Hz with a damping ratio of 1.5, s.
DELAY: Final = 1.5 / (math.pi * 592.0)


@dataclass(frozen=True)
class Violation:
    """One difference between the simulation and the description.

    Attributes
    ----------
    name, size
        Texts for the table.
    simulation_changes
        Text of the reference campaign -> its replacement in the simulation.
    description_changes
        Text of the reference campaign -> its replacement in the description.
    truth
        Lines of [truth].
    symbol
        Term or input.
    true_changes
        Coefficient -> change of its true value, which is not an error.
    """

    name: str
    size: str
    symbol: str
    simulation_changes: Mapping[str, str] = field(default_factory=dict)
    description_changes: Mapping[str, str] = field(default_factory=dict)
    truth: str = ""
    true_changes: Mapping[str, float] = field(default_factory=dict)

    def describe(self, reference: str) -> tuple[str, str]:
        """Return the description and the simulated campaign, from the reference campaign."""
        return replace_texts(
            reference, self.description_changes
        ), f"{replace_texts(reference, self.simulation_changes)}\n{self.truth}"


def replace_texts(text: str, replacements: Mapping[str, str]) -> str:
    """Return a text with pieces replaced; raise ValueError if it lacks one of them."""
    for old, new in replacements.items():
        if old not in text:
            raise ValueError(f"the description does not have {old}")
        text = text.replace(old, new)
    return text


def _largest_shift(shifts: Mapping[str, float]) -> float:
    return max(map(abs, shifts.values()), default=0.0)


def is_shift_silent(shifts: Mapping[str, float], codes: Sequence[str]) -> bool:
    """Return whether a coefficient shifts by more than 3 u without a finding."""
    return not codes and _largest_shift(shifts) > SILENT_SHIFT_LIMIT


@dataclass(frozen=True)
class Row:
    """One line of the table.

    Attributes
    ----------
    name, size, observable
        The violation, and the recorded observable.
    shifts, state, codes
        With unstated terms fixed: coefficient -> shift in u, state of the result, finding codes.
    free_shifts, free_codes
        With no term fixed: coefficient -> shift in u, and finding codes.
    symbol
        Term or input that differs.
    named_causes
        With unstated terms fixed: the first two named causes; an equally good explanation of the
        first finding is the second.
    """

    name: str
    size: str
    observable: str
    shifts: dict[str, float]
    state: str
    codes: list[str]
    free_shifts: dict[str, float]
    free_codes: list[str]
    symbol: str = ""
    named_causes: list[str] = field(default_factory=list)

    def names_true_cause(self, n_causes: int) -> bool:
        """Return whether the true cause is among the first named causes."""
        return any(f".{name}".endswith(f".{self.symbol}") for name in self.named_causes[:n_causes])

    @property
    def is_silent(self) -> bool:
        """Whether, with no term fixed, a coefficient shifts by more than 3 u without a finding."""
        return is_shift_silent(self.free_shifts, self.free_codes)

    @property
    def largest_free_shift(self) -> float:
        """Largest shift with no term fixed, in u."""
        return _largest_shift(self.free_shifts)

    @property
    def most_shifted_symbol(self) -> str:
        """The coefficient with the largest shift in u."""
        return max(self.shifts, key=lambda symbol: abs(self.shifts[symbol]))

    @property
    def largest_shift(self) -> float:
        """Largest shift with unstated terms fixed, in u."""
        return abs(self.shifts[self.most_shifted_symbol])

    @property
    def findings_text(self) -> str:
        """The state and the finding codes, as text."""
        return f"{self.state} ({', '.join(self.codes)})" if self.codes else "no finding"

    @property
    def cell(self) -> str:
        """The text of the table cell."""
        free_text = (
            f"{_round_to_two_digits(self.largest_free_shift)} u"
            if self.largest_free_shift >= SHOWN_SHIFT_LIMIT
            else f"< {SHOWN_SHIFT_LIMIT} u"
        )
        free_text = ", ".join([free_text, *self.free_codes])
        if (
            max(self.largest_shift, self.largest_free_shift) < SHOWN_SHIFT_LIMIT
            and not self.free_codes
        ):
            return self.findings_text if self.codes else "-"
        shift_texts = [
            f"{symbol} {_round_to_two_digits(abs(self.shifts[symbol]))} u"
            for symbol in dict.fromkeys(("K_II", self.most_shifted_symbol))
            if abs(self.shifts[symbol]) >= SHOWN_SHIFT_LIMIT
        ]
        prefix = f"{', '.join(shift_texts)}: " if shift_texts else ""
        return f"{prefix}{self.findings_text}; {free_text}"


def _round_to_two_digits(value: float) -> str:
    """Return a value with two significant digits."""
    return f"{float(f'{value:.2g}'):.12g}"


def term_violations() -> list[Violation]:
    """Return one violation for each nuisance term, at its typical size."""
    violations = []
    for symbol in [*ACCELEROMETER_TERMS, *SHARED_TERMS]:
        # table.* acts on strapped-down instruments only; the reference campaign has a platform.
        if symbol in ("K_F", "K_I", "K_II", "K_III") or symbol.startswith("table."):
            continue
        properties = term(symbol)
        unit, factor = find_display_unit(properties.unit)
        size = f"{format_number(properties.typical * factor, 2)} {unit}"
        value = f'"{properties.typical!r} {properties.unit}"'
        if symbol in ACCELEROMETER_TERMS:
            simulation_changes = {"[truth.Qx]\n": f'[truth.Qx]\n"{symbol}" = {value}\n'}
            if ".temperature" in symbol:
                size += ", for an unrecorded change of 1 K"
                simulation_changes |= WARMING_RUNS
            elif symbol == "K_F.hysteresis":
                size += ", for an unrecorded cycle of 3 K"
                simulation_changes |= TEMPERATURE_CYCLE
            violations.append(Violation(symbol, size, symbol, simulation_changes))
        else:
            table, _, key = symbol.partition(".")
            violations.append(
                Violation(symbol, size, symbol, truth=f"[truth.{table}]\n{key} = {value}\n")
            )
    return violations


def input_violations() -> list[Violation]:
    """Return the violations of stated inputs."""
    radius, gravity = '"2.5 ± 1e-5 m"', '"9.8066 ± 1e-5 m/s^2"'
    return [
        Violation(
            "radius, stated as exact",
            "0.01 mm",
            "centrifuge.radius",
            {radius: '"2.50001 m"'},
            {radius: '"2.5 m"'},
        ),
        Violation(
            "radius, stated ± 0.01 mm",
            "0.25 mm",
            "centrifuge.radius",
            {radius: '"2.50025 m"'},
        ),
        Violation(
            "gravity, stated as exact",
            "1e-4 m/s^2",
            "site.gravity",
            {gravity: '"9.8067 m/s^2"'},
            {gravity: '"9.8066 m/s^2"'},
        ),
        Violation(
            "latitude, stated ± 0.001 deg",
            "0.01 deg",
            "site.latitude",
            {'"45.75 ± 0.001 deg"': '"45.76 deg"'},
        ),
        Violation(
            "angle delay, not stated",
            "10 us",
            "records.timing_offset",
            {"[accelerometers.Qx]": 'timing_offset = "1e-5 s"\n\n[accelerometers.Qx]'},
        ),
        Violation(
            "clock error of the recorder, not stated",
            "20 ppm",
            "records.clock",
            truth='[truth.records]\nclock = "20 ppm"\n',
        ),
        # The angle is as late as the force, so that the gain remains.
        Violation(
            "sensor gain, not stated",
            "gain 1e-5 lower at 1 Hz",
            "Qx",
            {
                "[accelerometers.Qx]": f'timing_offset = "{-DELAY!r} s"\n\n[accelerometers.Qx]',
                "[truth.Qx]\n": '[truth.Qx]\nnatural_frequency = "592 Hz"\ndamping = 1.5\n',
            },
        ),
        Violation(
            "bias, stated as exact",
            "9 ug",
            "K_F",
            {'K_F = "0.0050312 g"': 'K_F = "0.005039 g"'},
            {"0.00503 ± 2e-6 g": "0.00503 g"},
            true_changes={"K_F": 0.005039 - 0.0050312},
        ),
        Violation(
            "scale factor, stated ± 5 ppm",
            "50 ppm",
            "K_I",
            {'K_I = "1.0019732 g/g"': 'K_I = "1.00202 g/g"'},
            true_changes={"K_I": 1.00202 - 1.0019732},
        ),
    ]


def calibrate_simulation(simulation: str, *descriptions: str) -> list[Result]:
    """Return the calibration of the simulated records with each description."""
    with tempfile.TemporaryDirectory() as folder:
        campaign = Path(folder) / "simulated.toml"
        campaign.write_text(simulation, encoding="utf-8")
        simulate(campaign, folder, overwrite=True)
        results = []
        for description in descriptions:
            (Path(folder) / "campaign.toml").write_text(description, encoding="utf-8")
            results.append(calibrate(folder))
    return results


def fixed_and_free(description: str) -> tuple[str, str]:
    """Return the description with unstated terms fixed at nominal, and the original."""
    return replace_texts(description, FIX_UNSTATED), description


def normalised_shifts(violation: Violation, clean: Result, result: Result) -> dict[str, float]:
    """Return coefficient -> shift in u, for the estimated coefficients."""
    clean_coefficients, coefficients = (
        r.accelerometers["Qx"].coefficients for r in (clean, result)
    )
    return {
        symbol: (
            coefficient.value
            - clean_coefficients[symbol].value
            - violation.true_changes.get(symbol, 0.0)
        )
        / coefficient.u
        for symbol, coefficient in coefficients.items()
        if coefficient.estimated
        and clean_coefficients[symbol].estimated
        and coefficient.u  # otherwise it equals its stated value
    }


def calibrate_violation(
    violation: Violation, observable: str, clean: Sequence[Result], size: Size
) -> Row:
    """Calibrate a campaign with a violation; return its row.

    Parameters
    ----------
    violation
        The violation.
    observable
        The recorded observable.
    clean
        The results without the violation.
    size
        Size of the campaign.
    """
    description, simulation = violation.describe(describe_campaign(observable, size))
    return compare_results(
        violation, observable, clean, calibrate_simulation(simulation, *fixed_and_free(description))
    )


def compare_results(
    violation: Violation, observable: str, clean: Sequence[Result], violated: Sequence[Result]
) -> Row:
    """Return the row that compares the two results without and with a violation."""
    fixed, estimated = violated
    return Row(
        name=violation.name,
        size=violation.size,
        observable=observable,
        shifts=normalised_shifts(violation, clean[0], fixed),
        state=str(fixed.state),
        codes=sorted({finding.code for finding in fixed.findings}),
        free_shifts=normalised_shifts(violation, clean[1], estimated),
        free_codes=sorted({finding.code for finding in estimated.findings}),
        symbol=violation.symbol,
        named_causes=[name for f in fixed.findings for name in (f.subject, *f.as_well)][:2],
    )


def calibrate_violations(
    violations: Sequence[Violation], observable: str, size: Size
) -> Iterator[Row]:
    """Yield the rows of violations with one observable."""
    reference = describe_campaign(observable, size)
    clean = calibrate_simulation(reference, *fixed_and_free(reference))
    for violation in violations:
        yield calibrate_violation(violation, observable, clean, size)


def format_rows(table: Sequence[Row]) -> str:
    """Return the table as Markdown, one line for each violation."""
    lines: dict[tuple[str, str], list[str]] = {}
    for row in table:
        lines.setdefault((row.name, row.size), [row.name, row.size]).append(row.cell)
    observables = dict.fromkeys(row.observable.replace("_", " ") for row in table)
    head = ["violation", "size", *observables]
    return format_table(dict.fromkeys(head, "---"), list(lines.values()))


def render(table: Sequence[Row]) -> str:
    """Return the table and the number of correctly named causes."""
    reported = [row for row in table if row.codes]
    n_second, n_first = (
        sum(row.names_true_cause(n_causes) for row in reported) for n_causes in (2, 1)
    )
    return (
        f"{format_rows(table)}\n"
        f"If every term is fixed at its nominal value, findings report {len(reported)} of these "
        f"{len(table)} violations.\n"
        f"In {n_second} of these {len(reported)} cases, one of the first two named causes "
        "is correct. "
        f"In {n_first} cases, the first named cause is correct.\n"
    )


TABLE: Final = StoredTable("violations", DOCS / "violations.md", Row, render)


def main() -> None:
    """Recompute the table."""
    violations = [*term_violations(), *input_violations()]
    table = [row for name in UNITS for row in calibrate_violations(violations, name, FULL_SIZE)]
    TABLE.store(table)
    for row in table:
        if row.is_silent:
            print(f"silent: {row.name} ({row.observable}): {row.largest_free_shift:.2g} u")


if __name__ == "__main__":
    run_study(__doc__.splitlines()[0], main)

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
from kept_table import (
    DOCS,
    UNITS,
    KeptTable,
    describe_channel,
    describe_runs,
    describe_site,
    format_table,
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

#: Adds rising temperatures to the simulated runs.
WARMING_RUNS: Final = {
    f'record = "run{run}.csv"': f'record = "run{run}.csv"\ntemperature = "{kelvin} degC"'
    for run, kelvin in ((1, 22.5), (2, 23.0), (3, 23.5))
}


#: Adds a temperature cycle to the simulated runs.
TEMPERATURE_CYCLE: Final = {
    f'record = "run{run}.csv"': f'record = "run{run}.csv"\ntemperature = "{celsius} degC"'
    for run, celsius in ((1, 20.0), (2, 23.0), (3, 20.0))
}


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
    world
        Text of the reference campaign -> its replacement in the simulation.
    stated
        Text of the reference campaign -> its replacement in the description.
    truth
        Lines of [truth].
    symbol
        Term or input.
    changes
        Coefficient -> change of its true value, which is not an error.
    """

    name: str
    size: str
    symbol: str
    world: Mapping[str, str] = field(default_factory=dict)
    stated: Mapping[str, str] = field(default_factory=dict)
    truth: str = ""
    changes: Mapping[str, float] = field(default_factory=dict)

    def of(self, usual: str) -> tuple[str, str]:
        """Return the description and the simulated campaign, from the reference campaign."""
        return replace_pieces(
            usual, self.stated
        ), f"{replace_pieces(usual, self.world)}\n{self.truth}"


def replace_pieces(text: str, pieces: Mapping[str, str]) -> str:
    """Return a text with pieces replaced; raise ValueError if it lacks one of them."""
    for old, new in pieces.items():
        if old not in text:
            raise ValueError(f"the description does not have {old}")
        text = text.replace(old, new)
    return text


def _largest_shift(shifts: Mapping[str, float]) -> float:
    return max(map(abs, shifts.values()), default=0.0)


def is_silent(shifts: Mapping[str, float], codes: Sequence[str]) -> bool:
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
    weighed, said_weighed
        With no term fixed: coefficient -> shift in u, and finding codes.
    symbol
        Term or input that differs.
    named
        With unstated terms fixed: the first two named causes; an equally good explanation of the
        first finding is the second.
    """

    name: str
    size: str
    observable: str
    shifts: dict[str, float]
    state: str
    codes: list[str]
    weighed: dict[str, float]
    said_weighed: list[str]
    symbol: str = ""
    named: list[str] = field(default_factory=list)

    def right(self, among: int) -> bool:
        """Return whether the true cause is among the first named causes."""
        return any(f".{name}".endswith(f".{self.symbol}") for name in self.named[:among])

    @property
    def silent(self) -> bool:
        """Whether, with no term fixed, a coefficient shifts by more than 3 u without a finding."""
        return is_silent(self.weighed, self.said_weighed)

    @property
    def held(self) -> float:
        """Largest shift with no term fixed, in u."""
        return _largest_shift(self.weighed)

    @property
    def most_moved(self) -> str:
        """The coefficient with the largest shift in u."""
        return max(self.shifts, key=lambda symbol: abs(self.shifts[symbol]))

    @property
    def largest(self) -> float:
        """Largest shift with unstated terms fixed, in u."""
        return abs(self.shifts[self.most_moved])

    @property
    def said(self) -> str:
        """The state and the finding codes, as text."""
        return f"{self.state} ({', '.join(self.codes)})" if self.codes else "no finding"

    @property
    def cell(self) -> str:
        """The text of the table cell."""
        held = (
            f"{_round_to_two_digits(self.held)} u"
            if self.held >= SHOWN_SHIFT_LIMIT
            else f"< {SHOWN_SHIFT_LIMIT} u"
        )
        held = ", ".join([held, *self.said_weighed])
        if max(self.largest, self.held) < SHOWN_SHIFT_LIMIT and not self.said_weighed:
            return self.said if self.codes else "-"
        moved = [
            f"{symbol} {_round_to_two_digits(abs(self.shifts[symbol]))} u"
            for symbol in dict.fromkeys(("K_II", self.most_moved))
            if abs(self.shifts[symbol]) >= SHOWN_SHIFT_LIMIT
        ]
        return f"{': '.join([*([', '.join(moved)] if moved else []), self.said])}; {held}"


def _round_to_two_digits(value: float) -> str:
    """Return a value with two significant digits."""
    return f"{float(f'{value:.2g}'):.12g}"


def term_violations() -> list[Violation]:
    """Return one violation for each nuisance term, at its typical size."""
    rows = []
    for symbol in [*ACCELEROMETER_TERMS, *SHARED_TERMS]:
        # table.* acts on strapped-down instruments only; the reference campaign has a platform.
        if symbol in ("K_F", "K_I", "K_II", "K_III") or symbol.startswith("table."):
            continue
        row = term(symbol)
        unit, factor = find_display_unit(row.unit)
        size = f"{format_number(row.typical * factor, 2)} {unit}"
        value = f'"{row.typical!r} {row.unit}"'
        if symbol in ACCELEROMETER_TERMS:
            world = {"[truth.Qx]\n": f'[truth.Qx]\n"{symbol}" = {value}\n'}
            if ".temperature" in symbol:
                size += ", for an unrecorded change of 1 K"
                world |= WARMING_RUNS
            elif symbol == "K_F.hysteresis":
                size += ", for an unrecorded cycle of 3 K"
                world |= TEMPERATURE_CYCLE
            rows.append(Violation(symbol, size, symbol, world))
        else:
            table, _, key = symbol.partition(".")
            rows.append(
                Violation(symbol, size, symbol, truth=f"[truth.{table}]\n{key} = {value}\n")
            )
    return rows


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
            changes={"K_F": 0.005039 - 0.0050312},
        ),
        Violation(
            "scale factor, stated ± 5 ppm",
            "50 ppm",
            "K_I",
            {'K_I = "1.0019732 g/g"': 'K_I = "1.00202 g/g"'},
            changes={"K_I": 1.00202 - 1.0019732},
        ),
    ]


def calibrate_world(world: str, *descriptions: str) -> list[Result]:
    """Return the calibration of the simulated records with each description."""
    with tempfile.TemporaryDirectory() as folder:
        campaign = Path(folder) / "world.toml"
        campaign.write_text(world, encoding="utf-8")
        simulate(campaign, folder, overwrite=True)
        results = []
        for text in descriptions:
            (Path(folder) / "campaign.toml").write_text(text, encoding="utf-8")
            results.append(calibrate(folder))
    return results


def variants(stated: str) -> tuple[str, str]:
    """Return the description with unstated terms fixed at nominal, and the original."""
    return replace_pieces(stated, FIX_UNSTATED), stated


def normalised_shifts(violation: Violation, clean: Result, result: Result) -> dict[str, float]:
    """Return coefficient -> shift in u, for the estimated coefficients."""
    clean_coefficients, coefficients = (
        r.accelerometers["Qx"].coefficients for r in (clean, result)
    )
    return {
        symbol: (c.value - clean_coefficients[symbol].value - violation.changes.get(symbol, 0.0))
        / c.u
        for symbol, c in coefficients.items()
        if c.estimated
        and clean_coefficients[symbol].estimated
        and c.u  # otherwise it equals its stated value
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
    stated, world = violation.of(describe_campaign(observable, size))
    return compare_results(violation, observable, clean, calibrate_world(world, *variants(stated)))


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
        weighed=normalised_shifts(violation, clean[1], estimated),
        said_weighed=sorted({finding.code for finding in estimated.findings}),
        symbol=violation.symbol,
        named=[name for f in fixed.findings for name in (f.subject, *f.as_well)][:2],
    )


def calibrate_violations(
    violations: Sequence[Violation], observable: str, size: Size
) -> Iterator[Row]:
    """Yield the rows of violations with one observable."""
    stated = describe_campaign(observable, size)
    clean = calibrate_world(stated, *variants(stated))
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
    n_second, n_first = (sum(row.right(among) for row in reported) for among in (2, 1))
    return (
        f"{format_rows(table)}\n"
        f"If every term is fixed at its nominal value, findings report {len(reported)} of these "
        f"{len(table)} violations.\n"
        f"In {n_second} of these {len(reported)} cases, one of the first two named causes "
        "is correct. "
        f"In {n_first} cases, the first named cause is correct.\n"
    )


TABLE: Final = KeptTable("violations", DOCS / "violations.md", Row, render)


def main() -> None:
    """Recompute the table."""
    violations = [*term_violations(), *input_violations()]
    table = [row for name in UNITS for row in calibrate_violations(violations, name, FULL_SIZE)]
    TABLE.keep(table)
    for row in table:
        if row.silent:
            print(f"silent: {row.name} ({row.observable}): {row.held:.2g} u")


if __name__ == "__main__":
    main()

"""What each violation of the model does to a calibration, and what is said: `make violations`.

Each row of the table in violations.md is one campaign: records are simulated in a world that
differs from the description in one thing, at a realistic size, and are calibrated by the
description twice: with everything assumed to be perfect that it does not state, and with nothing
assumed. The same campaign without it is the measure. Nothing is linearised.
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
from kept_table import DOCS, UNITS, KeptTable, channel, frame, runs, table_of

#: Beyond this many standard uncertainties a shift must not go unsaid.
SILENT_UP_TO: Final = 3.0

#: Shifts below this many standard uncertainties are not shown.
SHOWN_FROM: Final = 0.1

#: Noise of a sample of what is recorded.
NOISE: Final = {"displacement": "0.01 m", "velocity": "1e-3 m/s", "specific_force": "1e-4 m/s^2"}


@dataclass(frozen=True)
class Size:
    """How large a campaign is: samples a second, and revolutions of each run."""

    sampling_rate: float
    revolutions: int


def description(observable: str, size: Size) -> str:
    """Return the usual campaign: three rates, level, priors of bias and scale factor."""
    place = frame("9.8066 ± 1e-5 m/s^2", "45.75 ± 0.001 deg", "2.5 ± 1e-5 m")
    return f"""{place}
[accelerometers.Qx]
{channel(observable, "east")}
bias = "0.00503 ± 2e-6 g"
scale_factor = "1.00197 ± 5e-6 g/g"

[noise]
{observable} = "{NOISE[observable]}"
{runs()}
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


#: What takes everything as perfect that a description does not state.
ASSUMING: Final = {"[noise]\n": '[model]\nassume = "all"\n\n[noise]\n'}

#: Temperatures of the runs in a world in which it becomes warmer.
WARMING: Final = {
    f'record = "run{run}.csv"': f'record = "run{run}.csv"\ntemperature = "{kelvin} degC"'
    for run, kelvin in ((1, 22.5), (2, 23.0), (3, 23.5))
}


#: The same in one in which it becomes warmer and then colder.
UP_AND_DOWN: Final = {
    f'record = "run{run}.csv"': f'record = "run{run}.csv"\ntemperature = "{celsius} degC"'
    for run, celsius in ((1, 20.0), (2, 23.0), (3, 20.0))
}


FULL: Final = Size(50.0, 100)

#: Delay of a sensor of 592 Hz with a damping ratio of 1.5, s.
DELAY: Final = 1.5 / (math.pi * 592.0)


@dataclass(frozen=True)
class Violation:
    """One thing in which the world differs from the description.

    Attributes
    ----------
    name, size
        What is shown of it.
    world
        Pieces of the usual description, and what stands there in the world.
    stated
        Likewise, what the description says in their place.
    truth
        Lines of [truth].
    symbol
        Of the term or input.
    changes
        By how much it changes coefficients themselves, which is no error.
    """

    name: str
    size: str
    symbol: str
    world: Mapping[str, str] = field(default_factory=dict)
    stated: Mapping[str, str] = field(default_factory=dict)
    truth: str = ""
    changes: Mapping[str, float] = field(default_factory=dict)

    def of(self, usual: str) -> tuple[str, str]:
        """Return what is stated and what is true, from the usual description."""
        return replaced(usual, self.stated), f"{replaced(usual, self.world)}\n{self.truth}"


def replaced(text: str, pieces: Mapping[str, str]) -> str:
    """Return a text with pieces replaced, each of which must be there."""
    for old, new in pieces.items():
        if old not in text:
            raise ValueError(f"the description does not have {old}")
        text = text.replace(old, new)
    return text


def _largest(shifts: Mapping[str, float]) -> float:
    return max(map(abs, shifts.values()), default=0.0)


def is_silent(shifts: Mapping[str, float], said: Sequence[str]) -> bool:
    """Return whether coefficients move by so many of their u, and nothing is said."""
    return not said and _largest(shifts) > SILENT_UP_TO


@dataclass(frozen=True)
class Row:
    """One line of the table.

    Attributes
    ----------
    name, size, observable
        What violates what, and what is recorded.
    shifts, state, codes
        With everything assumed to be perfect: shifts by coefficient in u, and what is said.
    weighed, said_weighed
        With nothing assumed: shifts likewise, and the codes of what is found.
    symbol
        What is otherwise.
    named
        With everything assumed: the first two causes that are named, what explains as much as the
        first being the second.
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
        """Return whether what is otherwise is among the first causes that are named."""
        return any(f".{name}".endswith(f".{self.symbol}") for name in self.named[:among])

    @property
    def silent(self) -> bool:
        """Whether with nothing assumed a coefficient moves by more than 3 u and nothing is said."""
        return is_silent(self.weighed, self.said_weighed)

    @property
    def held(self) -> float:
        """By how many of its u the coefficient moves most that moves with nothing assumed."""
        return _largest(self.weighed)

    @property
    def most_moved(self) -> str:
        """The coefficient that moves by most of its u."""
        return max(self.shifts, key=lambda symbol: abs(self.shifts[symbol]))

    @property
    def largest(self) -> float:
        """By how many of its u that one moves."""
        return abs(self.shifts[self.most_moved])

    @property
    def said(self) -> str:
        """What the result says of it."""
        return f"{self.state} ({', '.join(self.codes)})" if self.codes else "no finding"

    @property
    def cell(self) -> str:
        """The row in a few words."""
        held = f"{_rounded(self.held)} u" if self.held >= SHOWN_FROM else f"< {SHOWN_FROM} u"
        held = ", ".join([held, *self.said_weighed])
        if max(self.largest, self.held) < SHOWN_FROM and not self.said_weighed:
            return self.said if self.codes else "-"
        moved = [
            f"{symbol} {_rounded(abs(self.shifts[symbol]))} u"
            for symbol in dict.fromkeys(("K_II", self.most_moved))
            if abs(self.shifts[symbol]) >= SHOWN_FROM
        ]
        return f"{': '.join([*([', '.join(moved)] if moved else []), self.said])}; {held}"


def _rounded(size: float) -> str:
    """Return a size with two digits."""
    return f"{float(f'{size:.2g}'):.12g}"


def of_table() -> list[Violation]:
    """Return one violation for each term that is not asked for, at its typical size."""
    rows = []
    for symbol in [*ACCELEROMETER_TERMS, *SHARED_TERMS]:
        # The table errs under a strapped instrument only, and the usual campaign has a platform.
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
                world |= WARMING
            elif symbol == "K_F.hysteresis":
                size += ", for an unrecorded cycle of 3 K"
                world |= UP_AND_DOWN
            rows.append(Violation(symbol, size, symbol, world))
        else:
            table, _, key = symbol.partition(".")
            rows.append(
                Violation(symbol, size, symbol, truth=f"[truth.{table}]\n{key} = {value}\n")
            )
    return rows


def of_inputs() -> list[Violation]:
    """Return the violations of what the description states: it is another in the world."""
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


def calibrated(world: str, *stated: str) -> list[Result]:
    """Return the calibrations of a world's records by these descriptions."""
    with tempfile.TemporaryDirectory() as folder:
        campaign = Path(folder) / "world.toml"
        campaign.write_text(world, encoding="utf-8")
        simulate(campaign, folder, overwrite=True)
        results = []
        for text in stated:
            (Path(folder) / "campaign.toml").write_text(text, encoding="utf-8")
            results.append(calibrate(folder))
    return results


def ways(stated: str) -> tuple[str, str]:
    """Return the description that assumes all that it does not state, and that as it is."""
    return replaced(stated, ASSUMING), stated


def shifts_of(violation: Violation, clean: Result, result: Result) -> dict[str, float]:
    """Return by how many of its u each coefficient moves that is determined."""
    one, other = (r.accelerometers["Qx"].coefficients for r in (clean, result))
    return {
        symbol: (c.value - one[symbol].value - violation.changes.get(symbol, 0.0)) / c.u
        for symbol, c in other.items()
        if c.estimated and one[symbol].estimated and c.u  # else it is what was stated
    }


def row_of(violation: Violation, observable: str, clean: Sequence[Result], size: Size) -> Row:
    """Return what a violation does.

    Parameters
    ----------
    violation
        The violation.
    observable
        What is recorded.
    clean
        The results without it.
    size
        Of the campaign.
    """
    stated, world = violation.of(description(observable, size))
    return row_between(violation, observable, clean, calibrated(world, *ways(stated)))


def row_between(
    violation: Violation, observable: str, clean: Sequence[Result], found: Sequence[Result]
) -> Row:
    """Return what lies between the two results without a violation and those with it."""
    assuming, weighing = found
    return Row(
        name=violation.name,
        size=violation.size,
        observable=observable,
        shifts=shifts_of(violation, clean[0], assuming),
        state=str(assuming.state),
        codes=sorted({finding.code for finding in assuming.findings}),
        weighed=shifts_of(violation, clean[1], weighing),
        said_weighed=sorted({finding.code for finding in weighing.findings}),
        symbol=violation.symbol,
        named=[name for f in assuming.findings for name in (f.subject, *f.as_well)][:2],
    )


def rows(violations: Sequence[Violation], observable: str, size: Size) -> Iterator[Row]:
    """Yield the rows of some violations with one observable."""
    stated = description(observable, size)
    clean = calibrated(stated, *ways(stated))
    for violation in violations:
        yield row_of(violation, observable, clean, size)


def lines_of(table: Sequence[Row]) -> str:
    """Return the table as Markdown, one line for each violation."""
    lines: dict[tuple[str, str], list[str]] = {}
    for row in table:
        lines.setdefault((row.name, row.size), [row.name, row.size]).append(row.cell)
    shown = dict.fromkeys(row.observable.replace("_", " ") for row in table)
    head = ["violation", "size", *shown]
    return table_of(dict.fromkeys(head, "---"), list(lines.values()))


def render(table: Sequence[Row]) -> str:
    """Return the table with how often the right cause is named."""
    found = [row for row in table if row.codes]
    right, first = (sum(row.right(among) for row in found) for among in (2, 1))
    return (
        f"{lines_of(table)}\n"
        f"If every term is fixed at its nominal value, findings report {len(found)} of these "
        f"{len(table)} violations.\n"
        f"In {right} of these {len(found)} cases, one of the first two named causes is correct. "
        f"In {first} cases, the first named cause is correct.\n"
    )


TABLE: Final = KeptTable("violations", DOCS / "violations.md", Row, render)


def main() -> None:
    """Make the table again."""
    everything = [*of_table(), *of_inputs()]
    table = [row for name in UNITS for row in rows(everything, name, FULL)]
    TABLE.keep(table)
    for row in table:
        if row.silent:
            print(f"silent: {row.name} ({row.observable}): {row.held:.2g} u")


if __name__ == "__main__":
    main()

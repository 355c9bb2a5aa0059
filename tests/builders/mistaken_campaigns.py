"""A small valid campaign, and variants with deliberate mistakes."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from campaigns import PLACE, format_runs, replace_parts, write_description

from counterspin.simulation.simulate import simulate

NOISE = '\n[noise]\ndisplacement = "0.01 m"\n'
CORRECT_DESCRIPTION = f"""{PLACE}
[accelerometers.Qx]
input_axis = "east"
pendulous_axis = "down"
bias = "0.0050321 ± 2e-6 g"
scale_factor = "1.0019743 ± 5e-6 g/g"
displacement = {{ column = "east_m", unit = "m" }}

[accelerometers.Qy]
input_axis = "north"
pendulous_axis = "down"
bias = "-0.003 ± 2e-6 g"
scale_factor = "0.999 ± 5e-6 g/g"
displacement = {{ column = "north_m", unit = "m" }}
{NOISE}
[model]
assume = "all"
terms = ["K_F", "K_I", "K_II", "platform.tilt"]

[model.priors]
"platform.tilt" = "0 ± 0.5 arcsec"

{format_runs("slow", "middle", "fast")}
[simulation]
sampling_rate = "32 Hz"
seed = 3
revolutions = 24

[truth.Qx]
K_F = "0.0050321 g"
K_I = "1.0019743 g/g"
K_II = "2.7e-5 g/g^2"
start_offset = "0.02 m"
start_velocity = "-1e-3 m/s"

[truth.Qy]
K_F = "-0.003 g"
K_I = "0.999 g/g"
K_II = "-3.2e-5 g/g^2"

[truth.spindle]
drift = "1e-6 1/s"

[truth.noise]
displacement = "0.01 m"
angle = "1e-6 rad"
"""
TIME, ANGLE, EAST, NORTH = range(4)
RUNS = ("slow", "middle", "fast")

Records = dict[str, np.ndarray]


@dataclass(frozen=True)
class Mistake:
    """A mistake in the description, in the records, or in the truth of the simulation.

    Attributes
    ----------
    words
        As the documentation calls it.
    says
        Code and subject of the first finding; or a piece of the error with which it is refused.
    description, truth
        Pieces of the campaign's text and what stands there by mistake; of the text that the
        records are made from.
    records
        What is done to the records.
    estimated
        Whether the noise is to be estimated.
    state
        Of the result; empty where it is refused.
    """

    words: str
    says: str
    description: tuple[tuple[str, str], ...] = ()
    truth: tuple[tuple[str, str], ...] = ()
    records: Callable[[Records], None] | None = None
    estimated: bool = False
    state: str = "contradicted"


def make_records(folder: Path, *truth: tuple[str, str]) -> Records:
    """Simulate the correct campaign or a campaign with another truth; return its records."""
    simulate(
        write_description(folder, replace_parts(CORRECT_DESCRIPTION, *truth), "plan.toml"),
        folder / "made",
    )
    return {
        run: np.loadtxt(folder / "made" / f"{run}.csv", delimiter=",", skiprows=1) for run in RUNS
    }


def make_mistaken_campaign(folder: Path, mistake: Mistake, correct_records: Records) -> Path:
    """Write the campaign with its mistake and return its folder."""
    mistaken_records = {run: rows.copy() for run, rows in correct_records.items()}
    if mistake.records is not None:
        mistake.records(mistaken_records)
    text = replace_parts(CORRECT_DESCRIPTION, *mistake.description)
    if mistake.estimated:
        text = replace_parts(text, (NOISE, ""))
    path = write_description(folder, text)
    for run, rows in mistaken_records.items():
        np.savetxt(
            folder / f"{run}.csv",
            rows,
            delimiter=",",
            header="time_s,angle_rad,east_m,north_m",
            comments="",
            fmt="%.12g",
        )
    return path.parent


# What may happen to records


def add_values(
    run: str | None, column: int, function: Callable[[np.ndarray], np.ndarray | float]
) -> Callable[[Records], None]:
    """Return a function that adds a function of time to a column of a run or of all runs."""

    def apply(records: Records) -> None:
        for name in RUNS if run is None else (run,):
            rows = records[name]
            rows[:, column] += function(rows[:, TIME])

    return apply


def multiply_column(run: str | None, column: int, factor: float) -> Callable[[Records], None]:
    """Return a function that multiplies a column of a run or of all runs."""

    def apply(records: Records) -> None:
        for name in RUNS if run is None else (run,):
            records[name][:, column] *= factor

    return apply


def detrend_column(column: int) -> Callable[[Records], None]:
    """Return a function that subtracts the best-fit parabola from a column of all runs."""

    def apply(records: Records) -> None:
        for rows in records.values():
            powers = np.vander(rows[:, TIME] / rows[-1, TIME], 3)
            rows[:, column] -= powers @ np.linalg.lstsq(powers, rows[:, column], rcond=None)[0]

    return apply


def delay_angle(delay: float, *names: str) -> Callable[[Records], None]:
    """Return a function that delays the angle relative to the displacement, s."""

    def apply(records: Records) -> None:
        for name in names or RUNS:
            rows = records[name]
            rows[:, ANGLE] = np.interp(rows[:, TIME] + delay, rows[:, TIME], rows[:, ANGLE])
            records[name] = rows[rows[:, TIME] + delay <= rows[-1, TIME]]

    return apply


def exchange_records(first: str, second: str) -> Callable[[Records], None]:
    """Return a function that exchanges the records of two runs."""

    def apply(records: Records) -> None:
        records[first], records[second] = records[second], records[first]

    return apply


def swap_columns(records: Records) -> None:
    """Exchange the displacements of the accelerometers."""
    for rows in records.values():
        rows[:, [EAST, NORTH]] = rows[:, [NORTH, EAST]]


def make_step(size: float, part: float) -> Callable[[np.ndarray], np.ndarray]:
    """Return a step function of time; its step follows a fraction of the record."""
    return lambda t: size * (t > part * t[-1])

"""Findings for implausible values that fit the measurements.

`make violations` recomputes the table in violations.md. Each row is one mistake, in static
readings, in readings on an arm, and in records with both methods. Readings are computed in closed
form; records are simulated.
"""

import math
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np

from counterspin.calibration.calibrate import calibrate
from counterspin.calibration.result import Result
from counterspin.errors import RecordError
from counterspin.simulation.simulate import simulate
from stored_table import DOCS, StoredTable, format_table, run_study
from violations import Size, describe_campaign, replace_texts

#: Type of measurement -> column.
COLUMN_BY_MEASUREMENT: Final = {
    "tumble": "tumble",
    "arm": "readings on an arm",
    "force": "specific force",
    "two-stage": "displacement, two-stage method",
}

#: Local gravity, m/s^2.
GRAVITY: Final = 9.80665

#: Standard uncertainty of a reading, g.
READING_U: Final = 2e-6

#: True coefficients of the accelerometer, in g-units.
TRUTH: Final = {"K_F": 2e-3, "K_I": 1.0005, "K_II": 1.5e-5, "delta_O": 1e-3}

CAMPAIGN_SIZE: Final = Size(10.0, 20)


@dataclass(frozen=True)
class Mistake:
    """A mistake, and its form in each type of measurement.

    Attributes
    ----------
    name
        Text for the table.
    truth
        True coefficients that differ from `TRUTH`.
    transform
        Function applied to each reading, or None if only the attitudes are wrong.
    sense, zero_error, is_axis_up
        Stated attitudes of the tumble test: sense, zero error in deg, and whether the input axis
        points up (or east) at zero.
    stated_values
        Stated values of the accelerometer in the tumble test.
    simulation_changes, record_changes
        Text of the description -> its replacement in the simulation and in the description.
        record_changes None: no records are simulated.
    """

    name: str
    truth: Mapping[str, float] = field(default_factory=dict)
    transform: Callable[[float], float] | None = None
    sense: int = 1
    zero_error: float = 0.0
    is_axis_up: bool = True
    stated_values: str = ""
    simulation_changes: Mapping[str, str] = field(default_factory=dict)
    record_changes: Mapping[str, str] | None = None

    @property
    def measurements(self) -> list[str]:
        """Types of measurement in which the mistake can occur."""
        measurements = ["tumble", *(["arm"] if self.transform or self.truth else [])]
        return (
            measurements if self.record_changes is None else [*measurements, "force", "two-stage"]
        )


#: Limits that allow the simulation of implausible coefficients.
LIMITS: Final = """[model]
limits = { K_F = "1 g", K_I = "10 g/g", K_II = "1e-2 g/g^2" }

[noise]
"""


def _replace_truth(old: str, new: str) -> dict[str, str]:
    return {old: new, "[noise]\n": LIMITS}


MISTAKES: Final = (
    Mistake(
        "wrong sign of all readings",
        transform=lambda value: -value,
        record_changes={'input_axis = "east"': 'input_axis = "west"'},
    ),
    Mistake(
        "K_I = 1.3 g/g",
        {"K_I": 1.3},
        simulation_changes=_replace_truth('K_I = "1.0019732 g/g"', 'K_I = "1.3 g/g"'),
        record_changes={},
    ),
    Mistake(
        "K_F = 0.3 g",
        {"K_F": 0.3},
        simulation_changes=_replace_truth('K_F = "0.0050312 g"', 'K_F = "0.3 g"'),
        record_changes={},
    ),
    Mistake(
        "K_II = 500 ug/g^2",
        {"K_II": 5e-4},
        simulation_changes=_replace_truth('K_II = "2e-5 g/g^2"', 'K_II = "5e-4 g/g^2"'),
        record_changes={},
    ),
    Mistake(
        "m/s^2 instead of g",
        transform=lambda value: GRAVITY * value,
        record_changes={'unit = "m/s^2"': 'unit = "g"', 'unit = "m"': 'unit = "mm"'},
    ),
    Mistake("head zero wrong by 1 deg", zero_error=1.0),
    Mistake(
        "attitude angles in the opposite sense, input axis east at angle zero",
        sense=-1,
        is_axis_up=False,
    ),
    Mistake(
        "attitude angles in the opposite sense, delta_O stated",
        sense=-1,
        stated_values='delta_O = "1e-3 ± 1e-6 rad"\n',
    ),
)


def describe_readings(mistake: Mistake, measurement: str) -> str:
    """Return a campaign of static or arm readings: closed-form values plus noise."""
    coefficients = {**TRUTH, **mistake.truth}
    rng = np.random.default_rng(1)
    transform = mistake.transform or float

    def format_reading(along_input: float, across_input: float) -> str:
        value = (
            coefficients["K_F"]
            + coefficients["K_I"] * along_input
            + coefficients["K_II"] * along_input**2
            + coefficients["delta_O"] * across_input
            + rng.normal(0.0, READING_U)
        )
        return f"{transform(float(value))!r} ± {abs(transform(READING_U))} g"

    sections = [
        f'schema = 1\nsite = {{ gravity = "{GRAVITY} m/s^2", latitude = "45.75 deg" }}\n'
        '[centrifuge]\nradius = "1 ± 1e-6 m"\n'
    ]
    if measurement == "tumble":
        axes = ("up", "west") if mistake.is_axis_up else ("east", "up")
        sections.append(_describe_accelerometer(*axes, mistake.stated_values))
        for angle in range(0, 360, 15):
            # From up, about north: the input axis turns to the east, the pendulous one up.
            angle_rad = math.radians(angle if mistake.is_axis_up else angle + 90.0)
            reading = format_reading(math.cos(angle_rad), math.sin(angle_rad))
            attitude = f"{mistake.sense * angle + mistake.zero_error!r} deg about north"
            sections.append(
                f'[[runs]]\nname = "{angle} deg"\nmotion = "static"\nattitude = "{attitude}"\n'
                f'reading = "{reading}"\n'
            )
        return "".join(sections)
    # Readings on an arm do not determine a misalignment about the output axis.
    sections.append(_describe_accelerometer("up", "west", "").replace(', "delta_O"', ""))
    for side, sign in (("inward", 1.0), ("outward", -1.0)):
        for acceleration in (1.0, 2.0, 5.0, 10.0, 15.0, 20.0):
            rate = math.sqrt(acceleration * GRAVITY)
            sections.append(
                f'[[runs]]\nname = "{side} {acceleration:g} g"\nmotion = "arm"\n'
                f'rate = "{rate!r} rad/s"\n'
                f'axes = {{ input = "{side}", pendulous = "forward" }}\n'
                f'reading = "{format_reading(sign * acceleration, 0.0)}"\n'
            )
    return "".join(sections)


def _describe_accelerometer(axis: str, pendulous: str, stated: str) -> str:
    return (
        f'[accelerometers.A]\ninput_axis = "{axis}"\npendulous_axis = "{pendulous}"\n'
        f'output = {{ unit = "g" }}\n{stated}'
        '[model]\nterms = ["K_F", "K_I", "K_II", "delta_O"]\nassume = ["platform.*"]\n'
    )


def calibrate_mistake(mistake: Mistake, measurement: str) -> Result:
    """Return the calibration with a mistake, for one type of measurement."""
    with tempfile.TemporaryDirectory() as folder:
        campaign = Path(folder) / "campaign.toml"
        if measurement in ("tumble", "arm"):
            campaign.write_text(describe_readings(mistake, measurement), encoding="utf-8")
            return calibrate(folder)
        reference_description = describe_campaign(
            "specific_force" if measurement == "force" else "displacement", CAMPAIGN_SIZE
        )
        simulation = Path(folder) / "simulated.toml"
        simulation.write_text(
            replace_texts(reference_description, mistake.simulation_changes), encoding="utf-8"
        )
        simulate(simulation, folder, overwrite=True)
        description = reference_description
        for old, new in (mistake.record_changes or {}).items():
            description = description.replace(old, new)
        if measurement == "force":  # the records determine both
            description = replace_texts(
                description,
                {'bias = "0.00503 ± 2e-6 g"\n': "", 'scale_factor = "1.00197 ± 5e-6 g/g"\n': ""},
            )
        campaign.write_text(description, encoding="utf-8")
        return calibrate(folder, method="two-stage" if measurement == "two-stage" else "joint")


@dataclass(frozen=True)
class Row:
    """State and first finding for a mistake in one type of measurement."""

    name: str
    measurement: str
    state: str
    code: str
    subject: str
    text: str

    @property
    def cell(self) -> str:
        """The text of the table cell."""
        if not self.text:
            return "no finding"
        return f"{self.state} ({self.code}: {self.subject})" if self.code else self.state


def check_mistake(mistake: Mistake, measurement: str) -> Row:
    """Return the row of a mistake in one type of measurement."""
    try:
        result = calibrate_mistake(mistake, measurement)
    except RecordError as error:
        return Row(mistake.name, measurement, "refused", "", "", str(error).partition(": ")[2])
    first_finding = result.findings[0] if result.findings else None
    return Row(
        mistake.name,
        measurement,
        str(result.state),
        first_finding.code if first_finding else "",
        first_finding.subject if first_finding else "",
        first_finding.text if first_finding else "",
    )


def check_mistakes() -> Iterator[Row]:
    """Yield the rows of the table."""
    for mistake in MISTAKES:
        for measurement in mistake.measurements:
            yield check_mistake(mistake, measurement)


def render(table: Sequence[Row]) -> str:
    """Return the table as Markdown, one line for each mistake."""
    lines = []
    for name in dict.fromkeys(row.name for row in table):
        cells = {row.measurement: row.cell for row in table if row.name == name}
        lines.append([name, *(cells.get(measurement, "") for measurement in COLUMN_BY_MEASUREMENT)])
    return format_table(dict.fromkeys(["mistake", *COLUMN_BY_MEASUREMENT.values()], "---"), lines)


TABLE: Final = StoredTable("incredible", DOCS / "violations.md", Row, render)


def main() -> None:
    """Recompute the table."""
    TABLE.store(list(check_mistakes()))


if __name__ == "__main__":
    run_study(__doc__.splitlines()[0], main)

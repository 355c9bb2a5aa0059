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
from kept_table import DOCS, KeptTable, format_table
from violations import Size, describe_campaign, replace_pieces

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
NOISE: Final = 2e-6

#: True coefficients of the accelerometer, in g-units.
TRUTH: Final = {"K_F": 2e-3, "K_I": 1.0005, "K_II": 1.5e-5, "delta_O": 1e-3}

SIZE: Final = Size(10.0, 20)


@dataclass(frozen=True)
class Mistake:
    """A mistake, and its form in each type of measurement.

    Attributes
    ----------
    name
        Text for the table.
    truth
        True coefficients that differ from `TRUTH`.
    change
        Function applied to each reading, or None if only the attitudes are wrong.
    sense, zero, upright
        Stated attitudes of the tumble test: sense, zero error in deg, and whether the input axis
        points up (or east) at zero.
    stated
        Stated values of the accelerometer in the tumble test.
    world, records
        Text of the description -> its replacement in the simulation and in the description.
        records None: no records are simulated.
    """

    name: str
    truth: Mapping[str, float] = field(default_factory=dict)
    change: Callable[[float], float] | None = None
    sense: int = 1
    zero: float = 0.0
    upright: bool = True
    stated: str = ""
    world: Mapping[str, str] = field(default_factory=dict)
    records: Mapping[str, str] | None = None

    @property
    def ways(self) -> list[str]:
        """Types of measurement in which the mistake can occur."""
        ways = ["tumble", *(["arm"] if self.change or self.truth else [])]
        return ways if self.records is None else [*ways, "force", "two-stage"]


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
        change=lambda value: -value,
        records={'input_axis = "east"': 'input_axis = "west"'},
    ),
    Mistake(
        "K_I = 1.3 g/g",
        {"K_I": 1.3},
        world=_replace_truth('K_I = "1.0019732 g/g"', 'K_I = "1.3 g/g"'),
        records={},
    ),
    Mistake(
        "K_F = 0.3 g",
        {"K_F": 0.3},
        world=_replace_truth('K_F = "0.0050312 g"', 'K_F = "0.3 g"'),
        records={},
    ),
    Mistake(
        "K_II = 500 ug/g^2",
        {"K_II": 5e-4},
        world=_replace_truth('K_II = "2e-5 g/g^2"', 'K_II = "5e-4 g/g^2"'),
        records={},
    ),
    Mistake(
        "m/s^2 instead of g",
        change=lambda value: GRAVITY * value,
        records={'unit = "m/s^2"': 'unit = "g"', 'unit = "m"': 'unit = "mm"'},
    ),
    Mistake("head zero wrong by 1 deg", zero=1.0),
    Mistake(
        "attitude angles in the opposite sense, input axis east at angle zero",
        sense=-1,
        upright=False,
    ),
    Mistake(
        "attitude angles in the opposite sense, delta_O stated",
        sense=-1,
        stated='delta_O = "1e-3 ± 1e-6 rad"\n',
    ),
)


def describe_readings(mistake: Mistake, measurement: str) -> str:
    """Return a campaign of static or arm readings: closed-form values plus noise."""
    true = {**TRUTH, **mistake.truth}
    rng = np.random.default_rng(1)
    change = mistake.change or float

    def format_reading(along: float, across: float) -> str:
        value = (
            true["K_F"]
            + true["K_I"] * along
            + true["K_II"] * along**2
            + true["delta_O"] * across
            + rng.normal(0.0, NOISE)
        )
        return f"{change(float(value))!r} ± {abs(change(NOISE))} g"

    pieces = [
        f'schema = 1\nsite = {{ gravity = "{GRAVITY} m/s^2", latitude = "45.75 deg" }}\n'
        '[centrifuge]\nradius = "1 ± 1e-6 m"\n'
    ]
    if measurement == "tumble":
        axes = ("up", "west") if mistake.upright else ("east", "up")
        pieces.append(_describe_accelerometer(*axes, mistake.stated))
        for angle in range(0, 360, 15):
            # From up, about north: the input axis turns to the east, the pendulous one up.
            angle_rad = math.radians(angle if mistake.upright else angle + 90.0)
            reading = format_reading(math.cos(angle_rad), math.sin(angle_rad))
            attitude = f"{mistake.sense * angle + mistake.zero!r} deg about north"
            pieces.append(
                f'[[runs]]\nname = "{angle} deg"\nmotion = "static"\nattitude = "{attitude}"\n'
                f'reading = "{reading}"\n'
            )
        return "".join(pieces)
    # Readings on an arm do not determine a misalignment about the output axis.
    pieces.append(_describe_accelerometer("up", "west", "").replace(', "delta_O"', ""))
    for side, sign in (("inward", 1.0), ("outward", -1.0)):
        for acceleration in (1.0, 2.0, 5.0, 10.0, 15.0, 20.0):
            rate = math.sqrt(acceleration * GRAVITY)
            pieces.append(
                f'[[runs]]\nname = "{side} {acceleration:g} g"\nmotion = "arm"\n'
                f'rate = "{rate!r} rad/s"\n'
                f'axes = {{ input = "{side}", pendulous = "forward" }}\n'
                f'reading = "{format_reading(sign * acceleration, 0.0)}"\n'
            )
    return "".join(pieces)


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
        reference = describe_campaign(
            "specific_force" if measurement == "force" else "displacement", SIZE
        )
        world = Path(folder) / "world.toml"
        world.write_text(replace_pieces(reference, mistake.world), encoding="utf-8")
        simulate(world, folder, overwrite=True)
        stated = reference
        for old, new in (mistake.records or {}).items():
            stated = stated.replace(old, new)
        if measurement == "force":  # the records determine both
            stated = replace_pieces(
                stated,
                {'bias = "0.00503 ± 2e-6 g"\n': "", 'scale_factor = "1.00197 ± 5e-6 g/g"\n': ""},
            )
        campaign.write_text(stated, encoding="utf-8")
        return calibrate(folder, method="two-stage" if measurement == "two-stage" else "joint")


@dataclass(frozen=True)
class Row:
    """State and first finding for a mistake in one type of measurement."""

    name: str
    way: str
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
        for measurement in mistake.ways:
            yield check_mistake(mistake, measurement)


def render(table: Sequence[Row]) -> str:
    """Return the table as Markdown, one line for each mistake."""
    lines = []
    for name in dict.fromkeys(row.name for row in table):
        cells = {row.way: row.cell for row in table if row.name == name}
        lines.append([name, *(cells.get(measurement, "") for measurement in COLUMN_BY_MEASUREMENT)])
    return format_table(dict.fromkeys(["mistake", *COLUMN_BY_MEASUREMENT.values()], "---"), lines)


TABLE: Final = KeptTable("incredible", DOCS / "violations.md", Row, render)


if __name__ == "__main__":
    TABLE.keep(list(check_mistakes()))

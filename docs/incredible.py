"""What is said of values that no instrument has, though all that was measured fits.

`make violations` makes the table again. Each row of it, the second one in violations.md, is one
mistake: in what was read at rest, on an arm, and in records by both methods. Readings follow their
closed form here, records are simulated.
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
from kept_table import DOCS, KeptTable, table_of
from violations import Size, description, replaced

#: What is measured: its column.
WAYS: Final = {
    "tumble": "tumble",
    "arm": "readings on an arm",
    "force": "specific force",
    "two-stage": "displacement, two-stage method",
}

#: g.
GRAVITY: Final = 9.80665

#: Standard uncertainty of a reading, g.
NOISE: Final = 2e-6

#: What is true of the accelerometer that is read, in g-units.
TRUTH: Final = {"K_F": 2e-3, "K_I": 1.0005, "K_II": 1.5e-5, "delta_O": 1e-3}

SIZE: Final = Size(10.0, 20)


@dataclass(frozen=True)
class Mistake:
    """A mistake, and how it is made in each of the ways.

    Attributes
    ----------
    name
        What is shown of it.
    truth
        What is true instead of `TRUTH`.
    change
        What becomes of a reading, or None: it is made in the attitudes alone.
    sense, zero, upright
        Of the tumble's attitudes as they are stated: their sense, what their zero is off by, deg,
        and whether the input axis points up there or else east.
    stated
        Of the tumble: what is stated of the accelerometer.
    world, records
        Pieces of the description of records, and what stands there in the world, and as stated;
        None: such records are not made.
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
        """In which ways it is made."""
        ways = ["tumble", *(["arm"] if self.change or self.truth else [])]
        return ways if self.records is None else [*ways, "force", "two-stage"]


#: An accelerometer that differs from nominal by more than is credible, in the world.
LIMITS: Final = """[model]
limits = { K_F = "1 g", K_I = "10 g/g", K_II = "1e-2 g/g^2" }

[noise]
"""


def _in_world(old: str, new: str) -> dict[str, str]:
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
        world=_in_world('K_I = "1.0019732 g/g"', 'K_I = "1.3 g/g"'),
        records={},
    ),
    Mistake(
        "K_F = 0.3 g",
        {"K_F": 0.3},
        world=_in_world('K_F = "0.0050312 g"', 'K_F = "0.3 g"'),
        records={},
    ),
    Mistake(
        "K_II = 500 ug/g^2",
        {"K_II": 5e-4},
        world=_in_world('K_II = "2e-5 g/g^2"', 'K_II = "5e-4 g/g^2"'),
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


def of_readings(mistake: Mistake, way: str) -> str:
    """Return a campaign of readings at rest or on an arm: values of the closed form and noise."""
    true = {**TRUTH, **mistake.truth}
    rng = np.random.default_rng(1)
    change = mistake.change or float

    def read(along: float, across: float) -> str:
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
    if way == "tumble":
        axes = ("up", "west") if mistake.upright else ("east", "up")
        pieces.append(_read_accelerometer(*axes, mistake.stated))
        for angle in range(0, 360, 15):
            # From up, about north: the input axis turns to the east, the pendulous one up.
            turn = math.radians(angle if mistake.upright else angle + 90.0)
            reading = read(math.cos(turn), math.sin(turn))
            attitude = f"{mistake.sense * angle + mistake.zero!r} deg about north"
            pieces.append(
                f'[[runs]]\nname = "{angle} deg"\nmotion = "static"\nattitude = "{attitude}"\n'
                f'reading = "{reading}"\n'
            )
        return "".join(pieces)
    # Readings on an arm do not determine a misalignment about the output axis.
    pieces.append(_read_accelerometer("up", "west", "").replace(', "delta_O"', ""))
    for side, sign in (("inward", 1.0), ("outward", -1.0)):
        for size in (1.0, 2.0, 5.0, 10.0, 15.0, 20.0):
            rate = math.sqrt(size * GRAVITY)
            pieces.append(
                f'[[runs]]\nname = "{side} {size:g} g"\nmotion = "arm"\nrate = "{rate!r} rad/s"\n'
                f'axes = {{ input = "{side}", pendulous = "forward" }}\n'
                f'reading = "{read(sign * size, 0.0)}"\n'
            )
    return "".join(pieces)


def _read_accelerometer(axis: str, pendulous: str, stated: str) -> str:
    return (
        f'[accelerometers.A]\ninput_axis = "{axis}"\npendulous_axis = "{pendulous}"\n'
        f'output = {{ unit = "g" }}\n{stated}'
        '[model]\nterms = ["K_F", "K_I", "K_II", "delta_O"]\nassume = ["platform.*"]\n'
    )


def calibrated(mistake: Mistake, way: str) -> Result:
    """Return the calibration with a mistake, in one of the ways."""
    with tempfile.TemporaryDirectory() as folder:
        campaign = Path(folder) / "campaign.toml"
        if way in ("tumble", "arm"):
            campaign.write_text(of_readings(mistake, way), encoding="utf-8")
            return calibrate(folder)
        usual = description("specific_force" if way == "force" else "displacement", SIZE)
        world = Path(folder) / "world.toml"
        world.write_text(replaced(usual, mistake.world), encoding="utf-8")
        simulate(world, folder, overwrite=True)
        stated = usual
        for old, new in (mistake.records or {}).items():
            stated = stated.replace(old, new)
        if way == "force":  # which determines both by itself
            stated = replaced(
                stated,
                {'bias = "0.00503 ± 2e-6 g"\n': "", 'scale_factor = "1.00197 ± 5e-6 g/g"\n': ""},
            )
        campaign.write_text(stated, encoding="utf-8")
        return calibrate(folder, method="two-stage" if way == "two-stage" else "joint")


@dataclass(frozen=True)
class Row:
    """What is said of a mistake in one of the ways: the state, and the first of the findings."""

    name: str
    way: str
    state: str
    code: str
    subject: str
    text: str

    @property
    def cell(self) -> str:
        """The row in a few words."""
        if not self.text:
            return "no finding"
        return f"{self.state} ({self.code}: {self.subject})" if self.code else self.state


def row_of(mistake: Mistake, way: str) -> Row:
    """Return what is said of a mistake in one of the ways."""
    try:
        result = calibrated(mistake, way)
    except RecordError as error:
        return Row(mistake.name, way, "refused", "", "", str(error).partition(": ")[2])
    first = result.findings[0] if result.findings else None
    return Row(
        mistake.name,
        way,
        str(result.state),
        first.code if first else "",
        first.subject if first else "",
        first.text if first else "",
    )


def rows() -> Iterator[Row]:
    """Yield the rows of the table."""
    for mistake in MISTAKES:
        for way in mistake.ways:
            yield row_of(mistake, way)


def render(table: Sequence[Row]) -> str:
    """Return the table as Markdown, one line for each mistake."""
    lines = []
    for name in dict.fromkeys(row.name for row in table):
        cells = {row.way: row.cell for row in table if row.name == name}
        lines.append([name, *(cells.get(way, "") for way in WAYS)])
    return table_of(dict.fromkeys(["mistake", *WAYS.values()], "---"), lines)


TABLE: Final = KeptTable("incredible", DOCS / "violations.md", Row, render)


if __name__ == "__main__":
    TABLE.keep(list(rows()))

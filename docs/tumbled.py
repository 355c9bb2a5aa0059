"""What each violation of the model does to a tumble, and what is said: `make violations`.

Each row of the table, the second one in violations.md, is one campaign of readings at rest, made
and calibrated as those of `violations.py` are.
"""

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from counterspin.calibration.calibrate import calibrate
from counterspin.calibration.result import Result
from counterspin.physics.terms import READING_TERMS, TERMS
from counterspin.reports.numbers import find_display_unit, format_number
from counterspin.simulation.simulate import simulate
from kept_table import DOCS, KeptTable
from violations import Row, Violation, lines_of, replaced, row_between

#: Tumbles: how many angles a turn has, and how far on the accelerometer is mounted in each turn.
WAYS: Final = {
    "12 positions": (12, (0,)),
    "24 positions": (24, (0,)),
    "12 positions in two mountings": (12, (0, 90)),
}

ASKED: Final = ("K_F", "K_I", "K_II", "delta_O")

_ASSUMING: Final = {"[model]\n": '[model]\nassume = "all"\n'}


def description(positions: int, mounted: tuple[int, ...]) -> str:
    """Return a usual tumble: input axis up at 0, each reading known to 2 ug.

    mounted: How far on the accelerometer is mounted on the head in each turn, deg.
    """
    pieces = [
        f"""schema = 1

[site]
gravity = "9.8066 ± 1e-5 m/s^2"
latitude = "45.75 deg"

[accelerometers.Qx]
input_axis = "up"
pendulous_axis = "west"
output = {{ unit = "g" }}
K_PP = "0 ± 2 ug/g^2"
K_OO = "0 ± 2 ug/g^2"

[model]
terms = [{", ".join(f'"{symbol}"' for symbol in ASKED)}]

[truth.Qx]
K_F = "0.002 g"
K_I = "1.0005 g/g"
K_II = "1.5e-5 g/g^2"
delta_O = "1e-4 rad"

[simulation]
seed = 4
"""
    ]
    for on in mounted:
        for n in range(positions):
            shown = 360.0 * n / positions
            pieces.append(
                f"""
[[runs]]
name = "{shown:g} deg{f", mounted {on} deg on" if on else ""}"
motion = "static"
attitude = "{shown + on:g} deg about north"
head = "{shown:g} deg"
reading = "0 ± 2e-6 g"
"""
            )
    return "".join(pieces)


def violations() -> list[Violation]:
    """Return one for each term that is not asked for and acts at rest, at its typical size."""
    rows = []
    machine = [row for row in READING_TERMS.values() if row.scope == "machine"]
    for row in (*TERMS.values(), *machine):
        if row.symbol in ASKED or (row.motions and "static" not in row.motions):
            continue
        unit, factor = find_display_unit(row.unit)
        size = f"{format_number(row.typical * factor, 2)} {unit}"
        of = "machine" if row.motions else "Qx"
        line = f'"{row.symbol}" = "{row.typical!r} {row.unit}"\n'
        rows.append(Violation(row.symbol, size, row.symbol, truth=f"[truth.{of}]\n{line}"))
    return rows


def world_of(violation: Violation | None, usual: str) -> str:
    """Return the description of a world with a violation, or with none."""
    if violation is None:
        return usual
    table, _, line = violation.truth.partition("\n")
    if table in usual:
        return replaced(usual, {f"{table}\n": f"{table}\n{line}"})
    return f"{usual}\n{violation.truth}"


def calibrated(world: str) -> Iterator[Result]:
    """Yield the calibrations of a tumble, with all assumed that is not stated, and nothing."""
    with tempfile.TemporaryDirectory() as folder:
        campaign = Path(folder) / "campaign.toml"
        (Path(folder) / "world.toml").write_text(world, encoding="utf-8")
        simulate(Path(folder) / "world.toml", folder, overwrite=True)
        stated = campaign.read_text(encoding="utf-8")
        for text in (replaced(stated, _ASSUMING), stated):
            campaign.write_text(text, encoding="utf-8")
            yield calibrate(folder)


def rows(way: str) -> Iterator[Row]:
    """Yield the rows of one of the ways to take a tumble."""
    usual = description(*WAYS[way])
    clean = list(calibrated(usual))
    for violation in violations():
        found = list(calibrated(world_of(violation, usual)))
        yield row_between(violation, way, clean, found)


TABLE: Final = KeptTable("tumbled", DOCS / "violations.md", Row, lines_of)


def main() -> None:
    """Make the table again."""
    table = [row for way in WAYS for row in rows(way)]
    TABLE.keep(table)
    for row in table:
        if row.silent:
            print(f"silent: {row.name} ({row.observable}): {row.held:.2g} u")


if __name__ == "__main__":
    main()

"""Effect of each model violation on a tumble test, and its findings: `make violations`.

Each row of the second table in violations.md is one campaign of static readings, simulated and
calibrated as in `violations.py`.
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
from stored_table import DOCS, StoredTable, run_study
from violations import Row, Violation, compare_results, format_rows, replace_texts

#: Tumble test -> positions per turn, and mounting angle of each turn, deg.
TUMBLE_TESTS: Final = {
    "12 positions": (12, (0,)),
    "24 positions": (24, (0,)),
    "12 positions in two mountings": (12, (0, 90)),
}

TERMS_OF_INTEREST: Final = ("K_F", "K_I", "K_II", "delta_O")

_FIX_UNSTATED: Final = {"[model]\n": '[model]\nassume = "all"\n'}


def describe_tumble(positions: int, mounting_angles: tuple[int, ...]) -> str:
    """Return the reference tumble test: input axis up at 0, reading uncertainty 2 ug.

    mounting_angles: Mounting angle of the accelerometer on the head in each turn, deg.
    """
    sections = [
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
terms = [{", ".join(f'"{symbol}"' for symbol in TERMS_OF_INTEREST)}]

[truth.Qx]
K_F = "0.002 g"
K_I = "1.0005 g/g"
K_II = "1.5e-5 g/g^2"
delta_O = "1e-4 rad"

[simulation]
seed = 4
"""
    ]
    for mounting_angle in mounting_angles:
        for n in range(positions):
            head_angle = 360.0 * n / positions
            sections.append(
                f"""
[[runs]]
name = "{head_angle:g} deg{f", mounted {mounting_angle} deg on" if mounting_angle else ""}"
motion = "static"
attitude = "{head_angle + mounting_angle:g} deg about north"
head = "{head_angle:g} deg"
reading = "0 ± 2e-6 g"
"""
            )
    return "".join(sections)


def list_violations() -> list[Violation]:
    """Return one violation for each nuisance term that acts at rest, at its typical size."""
    violations = []
    machine_terms = [term for term in READING_TERMS.values() if term.scope == "machine"]
    for term in (*TERMS.values(), *machine_terms):
        if term.symbol in TERMS_OF_INTEREST or (term.motions and "static" not in term.motions):
            continue
        unit, factor = find_display_unit(term.unit)
        size = f"{format_number(term.typical * factor, 2)} {unit}"
        owner = "machine" if term.motions else "Qx"
        line = f'"{term.symbol}" = "{term.typical!r} {term.unit}"\n'
        violations.append(
            Violation(term.symbol, size, term.symbol, truth=f"[truth.{owner}]\n{line}")
        )
    return violations


def describe_simulation(violation: Violation | None, reference: str) -> str:
    """Return the simulated campaign with a violation, or without one."""
    if violation is None:
        return reference
    table, _, line = violation.truth.partition("\n")
    if table in reference:
        return replace_texts(reference, {f"{table}\n": f"{table}\n{line}"})
    return f"{reference}\n{violation.truth}"


def calibrate_simulation(simulation: str) -> Iterator[Result]:
    """Yield the calibrations of a tumble test with unstated terms fixed, and with none fixed."""
    with tempfile.TemporaryDirectory() as folder:
        campaign = Path(folder) / "campaign.toml"
        (Path(folder) / "simulated.toml").write_text(simulation, encoding="utf-8")
        simulate(Path(folder) / "simulated.toml", folder, overwrite=True)
        description = campaign.read_text(encoding="utf-8")
        for variant in (replace_texts(description, _FIX_UNSTATED), description):
            campaign.write_text(variant, encoding="utf-8")
            yield calibrate(folder)


def calibrate_violations(tumble: str) -> Iterator[Row]:
    """Yield the rows of one tumble test."""
    reference = describe_tumble(*TUMBLE_TESTS[tumble])
    clean = list(calibrate_simulation(reference))
    for violation in list_violations():
        violated = list(calibrate_simulation(describe_simulation(violation, reference)))
        yield compare_results(violation, tumble, clean, violated)


TABLE: Final = StoredTable("tumbled", DOCS / "violations.md", Row, format_rows)


def main() -> None:
    """Recompute the table."""
    table = [row for tumble in TUMBLE_TESTS for row in calibrate_violations(tumble)]
    TABLE.store(table)
    for row in table:
        if row.is_silent:
            print(f"silent: {row.name} ({row.observable}): {row.largest_free_shift:.2g} u")


if __name__ == "__main__":
    run_study(__doc__.splitlines()[0], main)

"""Whether uncertainties and intervals hold, by observable and noise: `make coverage`.

Each row of the table in methods.md is many trials of a small campaign: records are simulated with
their noise, read and fitted as a calibration does, and the errors are compared with the
uncertainties claimed.
"""

import json
import math
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

import numpy as np
from scipy.special import stdtrit

from counterspin.calibration.calibrate import calibrate
from counterspin.calibration.joint_problem import model_of, noise_of, series_of
from counterspin.calibration.observed import observe
from counterspin.campaign.description import read_campaign
from counterspin.campaign.resolved import Campaign
from counterspin.campaign.simulation import simulate
from counterspin.inference.joint.estimation import estimate
from counterspin.physics.accelerometer import TERMS

DOCS: Final = Path(__file__).parent
PAGE: Final = DOCS / "methods.md"
KEPT: Final = DOCS / "coverage.json"

#: Trials where the noise is stated, and where it is found, which takes much longer.
TRIALS: Final = 150
TRIALS_WITHOUT: Final = 40

#: Column of the record and its unit.
UNITS: Final = {"displacement": "m", "velocity": "m/s", "specific_force": "m/s^2"}

TEMPLATE: Final = """
schema = 1
site = {{ gravity = "9.8066 m/s^2", latitude = "45.75 deg" }}
centrifuge = {{ radius = "2.5 m" }}

[records]
time = {{ column = "time_s", unit = "s" }}
angle = {{ column = "angle_rad", unit = "rad" }}

[accelerometers.Qx]
input_axis = "east"
pendulous_axis = "down"
{observable} = {{ column = "east", unit = "{unit}" }}

[accelerometers.Qy]
input_axis = "north"
pendulous_axis = "down"
{observable} = {{ column = "north", unit = "{unit}" }}

{stated}
[model]
terms = [{terms}]

[[runs]]
name = "run1"
rate = "0.25 rev/s"
record = "run1.csv"

[[runs]]
name = "run2"
rate = "0.5 rev/s"
record = "run2.csv"

[[runs]]
name = "run3"
rate = "1 rev/s"
record = "run3.csv"

[simulation]
sampling_rate = "8 Hz"
revolutions = 20
seed = {seed}

[truth.Qx]
K_F = "0.005 g"
K_I = "1.0019732 g/g"
K_II = "2e-5 g/g^2"
K_III = "3e-6 g/g^3"

[truth.Qy]
K_F = "-0.003 g"
K_I = "0.999 g/g"
K_II = "-3e-5 g/g^2"

[truth.noise]
{true}
angle = "1e-6 rad"
"""


@dataclass(frozen=True)
class Case:
    """What is recorded, with which noise, what is said of it, and how it is analysed."""

    method: str
    observable: str
    words: str
    true: dict[str, str]
    stated: dict[str, str]

    def description(self, seed: int) -> str:
        """Return the campaign of one trial."""
        symbols = ["K_F", "K_I", "K_II", "K_III"] if self.method == "joint" else ["K_F", "K_II"]
        noise = _lines(self.stated)
        return TEMPLATE.format(
            observable=self.observable,
            unit=UNITS[self.observable],
            stated=f"[noise]\n{noise}\n" if noise else "",
            terms=", ".join(f'"{symbol}"' for symbol in symbols),
            true=_lines(self.true),
            seed=seed,
        )


def _lines(table: dict[str, str]) -> str:
    return "\n".join(f'{key} = "{value}"' for key, value in table.items())


_WHITE: Final = {"displacement": "0.01 m", "velocity": "1e-3 m/s", "specific_force": "1e-3 m/s^2"}
_WALK: Final = {"acceleration": "3e-5 g/Hz^0.5"}


def _cases() -> Iterator[Case]:
    for observable, size in _WHITE.items():
        white = {observable: size}
        yield Case("joint", observable, "white, stated", white, white)
        yield Case("joint", observable, "white, not stated", white, {})
        if observable == "specific_force":
            continue  # the accelerometer's noise is that of the record there
        both = {**white, **_WALK}
        yield Case("joint", observable, "white and walk, stated", both, both)
        yield Case("joint", observable, "white and walk, not stated", both, {})
    white, both = {"displacement": "0.01 m"}, {"displacement": "0.01 m", **_WALK}
    for words, true, stated in (
        ("white, stated", white, white),
        ("white and walk, stated", both, both),
        ("white and walk, not stated", both, {}),
    ):
        yield Case("two-stage", "displacement", words, true, stated)


CASES: Final = tuple(_cases())


@dataclass(frozen=True)
class Row:
    """What came out, by coefficient: rms of the errors over their u; how often 95 % covers."""

    method: str
    observable: str
    words: str
    trials: int
    z_rms: dict[str, float]
    covered: dict[str, float]

    @property
    def se(self) -> float:
        """Standard error of the rms of one coefficient, were its z normal."""
        return 1.0 / math.sqrt(2.0 * self.values)

    @property
    def values(self) -> int:
        """Errors for each coefficient: both accelerometers have theirs."""
        return 2 * self.trials

    @property
    def rms(self) -> float:
        """The rms of all coefficients together."""
        return math.sqrt(sum(z * z for z in self.z_rms.values()) / len(self.z_rms))

    @property
    def coverage(self) -> float:
        """How often 95 % intervals of all coefficients cover."""
        return sum(self.covered.values()) / len(self.covered)


def _errors(case: Case, campaign: Campaign) -> Iterator[tuple[str, float, float]]:
    """Yield symbol, error over u, and Student's factor for 95 %, of every coefficient."""
    assert campaign.simulation is not None
    truth = campaign.simulation.truth.coefficients
    if case.method == "two-stage":
        for name, found in calibrate(campaign, method="two-stage").accelerometers.items():
            for symbol, c in found.coefficients.items():
                if c.estimated and c.value is not None and c.u:
                    factor = float(stdtrit(c.dof or math.inf, 0.975))
                    yield symbol, (c.value - truth[name][symbol]) / c.u, factor
        return
    observed = tuple(observe(campaign))
    found = estimate(series_of(campaign, observed), model_of(campaign), noise_of(campaign))
    solution = found.fit.solution
    for i, unknown in enumerate(found.fit.model.unknowns):
        if unknown.symbol not in TERMS:
            continue  # what the encoder leaves open of a run's rotation
        true = truth[unknown.owner].get(unknown.symbol, TERMS[unknown.symbol].nominal)
        error = float(solution.estimate[i]) + unknown.nominal - true
        yield (
            unknown.symbol,
            error / float(solution.u[i]),
            float(stdtrit(min(float(found.dof[i]), 1e9), 0.975)),
        )


def row_of(case: Case, trials: int) -> Row:
    """Return the result of a case."""
    gathered: dict[str, list[tuple[float, float]]] = {}
    for trial in range(trials):
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "campaign.toml"
            file.write_text(case.description(trial), encoding="utf-8")
            simulate(file, folder)
            for symbol, z, factor in _errors(case, read_campaign(folder)):
                gathered.setdefault(symbol, []).append((z, factor))
    z_rms, covered = {}, {}
    for symbol, pairs in gathered.items():
        z, factor = np.array(pairs).T
        z_rms[symbol] = float(np.sqrt(np.mean(z**2)))
        covered[symbol] = float(np.mean(np.abs(z) < factor))
    return Row(case.method, case.observable, case.words, trials, z_rms, covered)


def render(table: Sequence[Row]) -> str:
    """Return the table as Markdown."""
    head = ["method", "record", "noise", "z rms", "95 % covers", "z rms of K_F", "of K_II"]
    lines = [f"| {' | '.join(head)} |", "|---|---|---|---:|---:|---:|---:|"]
    for row in table:
        cells = (
            row.method,
            row.observable.replace("_", " "),
            row.words,
            f"{row.rms:.3f}",
            f"{100.0 * row.coverage:.1f} %",
            f"{row.z_rms['K_F']:.3f}",
            f"{row.z_rms['K_II']:.3f}",
        )
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def insert(table: Sequence[Row], page: str) -> str:
    """Return the page with the table in its place."""
    before, begun, rest = page.partition("<!-- coverage -->\n")
    _, ended, after = rest.partition("<!-- /coverage -->")
    if not begun or not ended:
        raise ValueError("the page has no place for the table")
    return f"{before}{begun}{render(table)}{ended}{after}"


def load() -> list[Row]:
    """Return the rows that are kept."""
    return [Row(**row) for row in json.loads(KEPT.read_text(encoding="utf-8"))]


def main() -> None:
    """Make the table again."""
    table = [row_of(case, TRIALS if case.stated else TRIALS_WITHOUT) for case in CASES]
    KEPT.write_text(json.dumps([asdict(row) for row in table], indent=1) + "\n", encoding="utf-8")
    PAGE.write_text(insert(table, PAGE.read_text(encoding="utf-8")), encoding="utf-8")


if __name__ == "__main__":
    main()

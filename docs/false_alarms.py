"""How often something is found against good campaigns: `make alarms`.

Each row of the table in diagnosis.md is many campaigns that are just as they are described: what is
known beforehand is off by draws from its own uncertainty, each run's platform has another tilt,
and the noise is as it is stated, or as it will be found. Each is calibrated with all its checks.
"""

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np
from scipy.special import betaincinv

from counterspin.calibration.calibrate import calibrate
from counterspin.calibration.result_parts import Finding
from counterspin.simulation.simulate import simulate
from kept_table import DOCS, RATES, KeptTable, channel, frame, runs, table_of

#: Rates of a campaign with more runs, rev/s; the other sense for half of them.
MANY: Final = ("0.25", "-0.25", "0.5", "-0.5", "0.8", "-0.8", "1", "-1")

_TRUE: Final = {"Qx": (0.0050321, 1.0019743, 2.7e-5), "Qy": (-0.003, 0.999, -3.2e-5)}
_U: Final = (2e-6, 5e-6)  #: of bias and scale factor
_TILT: Final = 0.5  #: arcsec

_WALK: Final = 'acceleration = "3e-5 g/Hz^0.5"'


@dataclass(frozen=True)
class Case:
    """The noise of a kind of good campaign, what is said of it, and how many runs there are."""

    words: str
    trials: int
    rates: Sequence[str] = RATES
    walk: str = ""
    stated: bool = True

    def description(self, seed: int) -> str:
        """Return the campaign of one trial."""
        rng = np.random.default_rng([seed, len(self.rates)])
        white = 'displacement = "0.01 m"\n'
        tilts = rng.normal(scale=_TILT, size=(len(self.rates), 2)).tolist()
        parts = [frame()]
        for name, axis in (("Qx", "east"), ("Qy", "north")):
            bias, scale, k_ii = _TRUE[name]
            known = rng.normal((bias, scale), _U).tolist()
            parts.append(
                f"""
[accelerometers.{name}]
{channel("displacement", axis)}
bias = "{known[0]!r} ± {_U[0]} g"
scale_factor = "{known[1]!r} ± {_U[1]} g/g"

[truth.{name}]
K_F = "{bias} g"
K_I = "{scale} g/g"
K_II = "{k_ii} g/g^2"
"""
            )
        parts.append(
            f"""
[noise]
{white + self.walk if self.stated else ""}
[model]
terms = ["K_F", "K_I", "K_II", "platform.tilt"]
assume = "all"

[model.priors]
"platform.tilt" = "0 ± {_TILT} arcsec"

[simulation]
sampling_rate = "8 Hz"
seed = {seed}
revolutions = 20

[truth.noise]
{white}{self.walk}
angle = "1e-6 rad"
"""
        )
        for run, (east, north) in zip(runs(self.rates).strip().split("\n\n"), tilts, strict=True):
            tilt = f'{{ east = "{east!r} arcsec", north = "{north!r} arcsec" }}'
            parts.append(f"\n{run}\ntruth.tilt = {tilt}\n")
        return "".join(parts)


CASES: Final = (
    Case("white noise, stated", 300),
    Case("white noise, stated", 100, MANY),
    Case("white noise and random walk, not stated", 100, walk=_WALK, stated=False),
)


#: What is counted, and the codes of findings that it is; every other one names a cause.
COUNTED: Final = {
    "`run-disagrees`": ("run-disagrees",),
    "`methods-disagree`": ("methods-disagree",),
    "`noise-differs`": ("noise-differs",),
    "`lack-of-fit`": ("lack-of-fit",),
}


@dataclass(frozen=True)
class Row:
    """What was found against the campaigns of a case.

    Attributes
    ----------
    words, runs, trials
        Of the case.
    counts
        In how many campaigns: by column of the table.
    codes
        By code of a finding, those below a cause included.
    """

    words: str
    runs: int
    trials: int
    counts: dict[str, int] = field(default_factory=dict)
    codes: dict[str, int] = field(default_factory=dict)


def _codes(findings: Sequence[Finding]) -> Iterator[str]:
    for finding in findings:
        yield finding.code
        yield from _codes(finding.explains)


def row_of(case: Case, trials: int) -> Row:
    """Return the result of a case."""
    checks = {code for codes in COUNTED.values() for code in codes}
    counts = dict.fromkeys(["anything", *COUNTED, "a cause", "contradicted"], 0)
    every: dict[str, int] = {}
    for trial in range(trials):
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "campaign.toml"
            file.write_text(case.description(trial), encoding="utf-8")
            simulate(file, folder)
            result = calibrate(folder)
        found = set(_codes(result.findings))
        for code in found:
            every[code] = every.get(code, 0) + 1
        counts["anything"] += bool(found)
        for name, codes in COUNTED.items():
            counts[name] += not found.isdisjoint(codes)
        counts["a cause"] += bool(found - checks)
        counts["contradicted"] += result.state == "contradicted"
    return Row(case.words, len(case.rates), trials, counts, dict(sorted(every.items())))


def bounds(count: int, trials: int) -> tuple[float, float]:
    """Return the 95 % interval of a share that was found (Clopper and Pearson)."""
    low = float(betaincinv(count, trials - count + 1, 0.025)) if count else 0.0
    high = float(betaincinv(count + 1, trials - count, 0.975)) if count < trials else 1.0
    return low, high


def _share(count: int, trials: int) -> str:
    low, high = bounds(count, trials)
    return f"{100.0 * count / trials:.1f} % ({100.0 * low:.1f} to {100.0 * high:.1f})"


def render(table: Sequence[Row]) -> str:
    """Return the table as Markdown."""
    head = ["noise", "runs", "campaigns", *table[0].counts]
    lines = [
        [
            *(row.words, f"{row.runs}", f"{row.trials}"),
            *(_share(count, row.trials) for count in row.counts.values()),
        ]
        for row in table
    ]
    return table_of(dict.fromkeys(head, "---"), lines)


TABLE: Final = KeptTable("false_alarms", DOCS / "diagnosis.md", Row, render)


def main() -> None:
    """Make the table again."""
    TABLE.keep([row_of(case, case.trials) for case in CASES])


if __name__ == "__main__":
    main()

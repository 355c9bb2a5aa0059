"""Rate of findings in good campaigns: `make alarms`.

Each row of the table in diagnosis.md summarises many campaigns that agree with their descriptions:
priors deviate by draws from their uncertainties, the platform tilt differs between runs, and the
noise is stated correctly or estimated. Each is calibrated with all checks.
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
from stored_table import (
    DEFAULT_RATES,
    DOCS,
    StoredTable,
    describe_channel,
    describe_runs,
    describe_site,
    format_table,
    run_study,
)

#: Rates of a campaign with eight runs, half of them in the opposite sense, rev/s.
EIGHT_RATES: Final = ("0.25", "-0.25", "0.5", "-0.5", "0.8", "-0.8", "1", "-1")

_TRUE_COEFFICIENTS: Final = {"Qx": (0.0050321, 1.0019743, 2.7e-5), "Qy": (-0.003, 0.999, -3.2e-5)}
_PRIOR_U: Final = (2e-6, 5e-6)  #: of bias and scale factor
_TILT_SD: Final = 0.5  #: arcsec

_RANDOM_WALK: Final = 'acceleration = "3e-5 g/Hz^0.5"'


@dataclass(frozen=True)
class Case:
    """True and stated noise of a type of good campaign, and the rates of its runs."""

    label: str
    trials: int
    rates: Sequence[str] = DEFAULT_RATES
    random_walk: str = ""
    is_noise_stated: bool = True

    def description(self, seed: int) -> str:
        """Return the campaign of one trial."""
        rng = np.random.default_rng([seed, len(self.rates)])
        white_noise = 'displacement = "0.01 m"\n'
        tilts = rng.normal(scale=_TILT_SD, size=(len(self.rates), 2)).tolist()
        sections = [describe_site()]
        for name, axis in (("Qx", "east"), ("Qy", "north")):
            bias, scale_factor, k_ii = _TRUE_COEFFICIENTS[name]
            prior_values = rng.normal((bias, scale_factor), _PRIOR_U).tolist()
            sections.append(
                f"""
[accelerometers.{name}]
{describe_channel("displacement", axis)}
bias = "{prior_values[0]!r} ± {_PRIOR_U[0]} g"
scale_factor = "{prior_values[1]!r} ± {_PRIOR_U[1]} g/g"

[truth.{name}]
K_F = "{bias} g"
K_I = "{scale_factor} g/g"
K_II = "{k_ii} g/g^2"
"""
            )
        sections.append(
            f"""
[noise]
{white_noise + self.random_walk if self.is_noise_stated else ""}
[model]
terms = ["K_F", "K_I", "K_II", "platform.tilt"]
assume = "all"

[model.priors]
"platform.tilt" = "0 ± {_TILT_SD} arcsec"

[simulation]
sampling_rate = "8 Hz"
seed = {seed}
revolutions = 20

[truth.noise]
{white_noise}{self.random_walk}
angle = "1e-6 rad"
"""
        )
        for run, (east, north) in zip(
            describe_runs(self.rates).strip().split("\n\n"), tilts, strict=True
        ):
            tilt = f'{{ east = "{east!r} arcsec", north = "{north!r} arcsec" }}'
            sections.append(f"\n{run}\ntruth.tilt = {tilt}\n")
        return "".join(sections)


CASES: Final = (
    Case("white noise, stated", 300),
    Case("white noise, stated", 100, EIGHT_RATES),
    Case(
        "white noise and random walk, not stated",
        100,
        random_walk=_RANDOM_WALK,
        is_noise_stated=False,
    ),
)


#: Column -> finding codes that it counts; all other codes name a cause.
CODES_BY_COLUMN: Final = {
    "`run-disagrees`": ("run-disagrees",),
    "`methods-disagree`": ("methods-disagree",),
    "`noise-differs`": ("noise-differs",),
    "`lack-of-fit`": ("lack-of-fit",),
}


@dataclass(frozen=True)
class Row:
    """Findings in the campaigns of a case.

    Attributes
    ----------
    label, runs, trials
        Label of the case, number of runs, and number of campaigns.
    counts
        Number of campaigns by column of the table.
    codes
        Number of campaigns by finding code, including findings below a cause.
    """

    label: str
    runs: int
    trials: int
    counts: dict[str, int] = field(default_factory=dict)
    codes: dict[str, int] = field(default_factory=dict)


def _list_codes(findings: Sequence[Finding]) -> Iterator[str]:
    for finding in findings:
        yield finding.code
        yield from _list_codes(finding.explains)


def run_trials(case: Case, trials: int) -> Row:
    """Return the result of a case."""
    checks = {code for codes in CODES_BY_COLUMN.values() for code in codes}
    counts = dict.fromkeys(["anything", *CODES_BY_COLUMN, "a cause", "contradicted"], 0)
    n_by_code: dict[str, int] = {}
    for trial in range(trials):
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "campaign.toml"
            file.write_text(case.description(trial), encoding="utf-8")
            simulate(file, folder)
            result = calibrate(folder)
        found_codes = set(_list_codes(result.findings))
        for code in found_codes:
            n_by_code[code] = n_by_code.get(code, 0) + 1
        counts["anything"] += bool(found_codes)
        for name, codes in CODES_BY_COLUMN.items():
            counts[name] += not found_codes.isdisjoint(codes)
        counts["a cause"] += bool(found_codes - checks)
        counts["contradicted"] += result.state == "contradicted"
    return Row(case.label, len(case.rates), trials, counts, dict(sorted(n_by_code.items())))


def proportion_interval(count: int, trials: int) -> tuple[float, float]:
    """Return the 95 % Clopper-Pearson interval of a proportion."""
    low = float(betaincinv(count, trials - count + 1, 0.025)) if count else 0.0
    high = float(betaincinv(count + 1, trials - count, 0.975)) if count < trials else 1.0
    return low, high


def _format_share(count: int, trials: int) -> str:
    low, high = proportion_interval(count, trials)
    return f"{100.0 * count / trials:.1f} % ({100.0 * low:.1f} to {100.0 * high:.1f})"


def render(table: Sequence[Row]) -> str:
    """Return the table as Markdown."""
    headings = ["noise", "runs", "campaigns", *table[0].counts]
    lines = [
        [
            *(row.label, f"{row.runs}", f"{row.trials}"),
            *(_format_share(count, row.trials) for count in row.counts.values()),
        ]
        for row in table
    ]
    return format_table(dict.fromkeys(headings, "---"), lines)


TABLE: Final = StoredTable("false_alarms", DOCS / "diagnosis.md", Row, render)


def main() -> None:
    """Recompute the table."""
    TABLE.store([run_trials(case, case.trials) for case in CASES])


if __name__ == "__main__":
    run_study(__doc__.splitlines()[0], main)

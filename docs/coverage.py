"""Whether uncertainties and intervals hold, by observable and noise: `make coverage`.

Each row of the table in methods.md is many trials of a small campaign: records are simulated with
their noise, read and fitted as a calibration does, and the errors are compared with the
uncertainties claimed.
"""

import math
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from scipy.special import ndtri, stdtr, stdtrit

from counterspin.calibration.calibrate import calibrate
from counterspin.calibration.joint_problem import make_noise, make_series
from counterspin.calibration.model import make_unknowns
from counterspin.calibration.observed_runs import observe_runs
from counterspin.campaign.description import Campaign, read_campaign
from counterspin.inference.joint.estimation import estimate
from counterspin.physics.terms import TERMS
from counterspin.simulation.simulate import simulate
from kept_table import DOCS, KeptTable, channel, frame, runs, table_of

#: Trials of a case: usually, where one takes long, and where the noise of displacement is found or
#: a walk is hidden.
TRIALS: Final = 200
TRIALS_WITHOUT: Final = 120
TRIALS_MOST: Final = 400

#: Trials of a case with time stamps that scatter, and their standard deviation.
TRIALS_OF_STAMPS: Final = 60
TIMING: Final = "2e-4 s"

#: Seed of the first trial.
FIRST: Final = 1000

#: Half the width of a 95 % band, in standard errors.
BAND: Final = 1.96

#: What makes the noise larger than the records show is in u, whether it is there or not.
HIDDEN: Final = ("white noise, not stated", "white noise and hidden random walk, not stated")


@dataclass(frozen=True)
class Case:
    """What is recorded, with which noise, what is said of it, and how it is analysed."""

    method: str
    observable: str
    words: str
    true: dict[str, str]
    stated: dict[str, str]

    @property
    def trials(self) -> int:
        """How many there are of it in the table."""
        if "time-stamp jitter" in self.words:
            return TRIALS_OF_STAMPS
        if self.words == HIDDEN[1]:
            return TRIALS_MOST
        if self.method == "two-stage":
            return TRIALS_WITHOUT
        if not self.words.endswith(", not stated"):
            return TRIALS
        return TRIALS_MOST if self.observable == "displacement" else TRIALS_WITHOUT

    def description(self, seed: int) -> str:
        """Return the campaign of one trial."""
        symbols = ["K_F", "K_I", "K_II", "K_III"] if self.method == "joint" else ["K_F", "K_II"]
        return f"""{frame()}
[accelerometers.Qx]
{channel(self.observable, "east")}
[accelerometers.Qy]
{channel(self.observable, "north")}
[noise]
{_lines(self.stated)}
[model]
terms = [{", ".join(f'"{symbol}"' for symbol in symbols)}]
assume = "all"
{runs()}
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
{_lines(self.true)}
angle = "1e-6 rad"
"""


def _lines(table: dict[str, str]) -> str:
    return "\n".join(f'{key} = "{value}"' for key, value in table.items())


_WHITE: Final = {"displacement": "0.01 m", "velocity": "1e-3 m/s", "specific_force": "1e-3 m/s^2"}
_WALK: Final = {"acceleration": "3e-5 g/Hz^0.5"}
_NO_WALK: Final = {"acceleration": "0 g/Hz^0.5"}

#: A walk that the records show in half of the trials.
_HARDLY: Final = {"displacement": "8e-6 g/Hz^0.5", "velocity": "6e-6 g/Hz^0.5"}


def _cases() -> Iterator[Case]:
    for observable, size in _WHITE.items():
        white = {observable: size}
        yield Case("joint", observable, "white noise, stated", white, white)
        if observable == "specific_force":
            # The accelerometer's noise is that of the record there.
            yield Case("joint", observable, "white noise, estimated", white, {})
            continue
        found = {observable: "estimate", **_NO_WALK}
        yield Case(
            "joint", observable, "white noise estimated, random walk stated as zero", white, found
        )
        yield Case("joint", observable, "white noise, not stated", white, {})
        both = {**white, **_WALK}
        yield Case("joint", observable, "white noise and random walk, stated", both, both)
        yield Case("joint", observable, "white noise and random walk, not stated", both, {})
    for observable, size in _HARDLY.items():
        both = {observable: _WHITE[observable], "acceleration": size}
        yield Case("joint", observable, HIDDEN[1], both, {})
    white = {"displacement": "0.01 m"}
    both = {**white, **_WALK}
    for words, true, stated in (
        ("white noise, stated", white, white),
        ("white noise and random walk, stated", both, both),
        ("white noise and random walk, not stated", both, {}),
    ):
        yield Case("two-stage", "displacement", words, true, stated)
    for method, observable in (*(("joint", one) for one in _WHITE), ("two-stage", "displacement")):
        white = {observable: _WHITE[observable]}
        true = {**white, "timing": TIMING}
        yield Case(method, observable, "stated white noise and time-stamp jitter", true, true)
        yield Case(
            method, observable, "stated white noise, estimated time-stamp jitter", true, white
        )


CASES: Final = tuple(_cases())


@dataclass(frozen=True)
class Row:
    """What came out of a case.

    Attributes
    ----------
    method, observable, words, trials
        Of the case; each trial has an error of each coefficient of two accelerometers.
    z_rms, normal_rms, covered
        By coefficient: rms of the errors over their u, rms of their normal equivalents, and how
        often 95 % intervals cover.
    normal_band, covered_band
        Half the width of the 95 % bands of `normal` and `coverage`, by the scatter of the trials.
    """

    method: str
    observable: str
    words: str
    trials: int
    z_rms: dict[str, float]
    normal_rms: dict[str, float]
    covered: dict[str, float]
    normal_band: float
    covered_band: float

    @property
    def values(self) -> int:
        """Errors of each coefficient."""
        return 2 * self.trials

    @property
    def se(self) -> float:
        """Standard error of the normal equivalents' rms of one coefficient."""
        return 1.0 / math.sqrt(2.0 * self.values)

    @property
    def rms(self) -> float:
        """The rms of all coefficients together."""
        return _rms_of(self.z_rms)

    @property
    def normal(self) -> float:
        """The rms of the normal equivalents of all coefficients together."""
        return _rms_of(self.normal_rms)

    @property
    def coverage(self) -> float:
        """How often 95 % intervals of all coefficients cover."""
        return sum(self.covered.values()) / len(self.covered)

    @property
    def hidden(self) -> bool:
        """Whether u has noise that the records do not show."""
        return self.words in HIDDEN


def _rms_of(parts: dict[str, float]) -> float:
    return math.sqrt(sum(part * part for part in parts.values()) / len(parts))


def _errors(case: Case, campaign: Campaign) -> Iterator[tuple[str, float, float]]:
    """Yield symbol, error over u, and degrees of freedom, of every coefficient."""
    assert campaign.simulation is not None
    truth = campaign.simulation.truth.coefficients
    if case.method == "two-stage":
        for name, found in calibrate(campaign, method="two-stage").accelerometers.items():
            for symbol, c in found.coefficients.items():
                if c.estimated and c.value is not None and c.u:
                    yield symbol, (c.value - truth[name][symbol]) / c.u, c.dof or math.inf
        return
    observed = tuple(observe_runs(campaign))
    found = estimate(make_series(campaign, observed), make_unknowns(campaign), make_noise(campaign))
    solution = found.fit.solution
    for i, unknown in enumerate(found.fit.model.unknowns):
        if unknown.symbol not in TERMS:
            continue  # what the encoder leaves open of a run's rotation
        true = truth[unknown.owner].get(unknown.symbol, TERMS[unknown.symbol].nominal)
        error = float(solution.estimate[i]) + unknown.nominal - true
        yield unknown.symbol, error / float(solution.u[i]), float(found.dof[i])


def row_of(case: Case, trials: int) -> Row:
    """Return the result of a case."""
    gathered: dict[str, list[tuple[float, float]]] = {}
    for trial in range(trials):
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "campaign.toml"
            file.write_text(case.description(FIRST + trial), encoding="utf-8")
            simulate(file, folder)
            for symbol, z, dof in _errors(case, read_campaign(folder)):
                gathered.setdefault(symbol, []).append((z, min(dof, 1e9)))
    return counted(case, gathered)


def counted(case: Case, gathered: dict[str, list[tuple[float, float]]]) -> Row:
    """Return the result of errors over their u, and their degrees of freedom, by coefficient."""
    # Coefficient, trial, accelerometer
    pairs = np.array([np.reshape(part, (-1, 2, 2)) for part in gathered.values()])
    z, dof = np.moveaxis(pairs, -1, 0)
    trials = z.shape[1]
    normal = normal_equivalent(z, dof)
    covered = (np.abs(z) < stdtrit(dof, 0.975)).astype(float)

    def by_symbol(parts: np.ndarray) -> dict[str, float]:
        return dict(zip(gathered, parts.mean(axis=(1, 2)).tolist(), strict=True))

    def band(parts: np.ndarray) -> float:
        return float(BAND * parts.mean(axis=(0, 2)).std(ddof=1) / math.sqrt(trials))

    return Row(
        case.method,
        case.observable,
        case.words,
        trials,
        z_rms={symbol: math.sqrt(part) for symbol, part in by_symbol(z**2).items()},
        normal_rms={symbol: math.sqrt(part) for symbol, part in by_symbol(normal**2).items()},
        covered=by_symbol(covered),
        normal_band=band(normal**2) / (2.0 * math.sqrt(float(np.mean(normal**2)))),
        covered_band=band(covered),
    )


def normal_equivalent(z: np.ndarray, dof: np.ndarray) -> np.ndarray:
    """Return normal variables that are as improbable as Student's."""
    return np.asarray(np.sign(z) * -ndtri(stdtr(dof, -np.abs(z))))


#: Columns, and how they are aligned.
HEAD: Final = dict.fromkeys(["method", "record", "noise"], "---") | dict.fromkeys(
    [
        "trials",
        "95 % covers",
        "normal z rms",
        "of K_F",
        "of K_I",
        "of K_II",
        "of K_III",
        "z rms, unadjusted",
        "of K_F, unadjusted",
    ],
    "---:",
)


def render(table: Sequence[Row]) -> str:
    """Return the table as Markdown."""
    return table_of(
        HEAD,
        [
            (
                row.method,
                row.observable.replace("_", " "),
                row.words,
                f"{row.trials}",
                f"{100.0 * row.coverage:.1f} ± {100.0 * row.covered_band:.1f}",
                f"{row.normal:.3f} ± {row.normal_band:.3f}",
                *(
                    f"{row.normal_rms[symbol]:.2f}" if symbol in row.normal_rms else ""
                    for symbol in ("K_F", "K_I", "K_II", "K_III")
                ),
                f"{row.rms:.3f}",
                f"{row.z_rms['K_F']:.2f}",
            )
            for row in table
        ],
    )


TABLE: Final = KeptTable("coverage", DOCS / "methods.md", Row, render)


def main() -> None:
    """Make the table again."""
    TABLE.keep([row_of(case, case.trials) for case in CASES])


if __name__ == "__main__":
    main()

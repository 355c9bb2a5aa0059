"""Coverage of uncertainties and intervals, by observable and noise: `make coverage`.

Each row of the table in methods.md summarises many trials of a small campaign: simulated records
are read and fitted as in a calibration, and the errors are compared with the claimed uncertainties.
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
from stored_table import (
    DOCS,
    StoredTable,
    describe_channel,
    describe_runs,
    describe_site,
    format_table,
    run_study,
)

#: Trials of a case: default, for slow cases, and for estimated displacement noise or a hidden
#: random walk.
TRIALS: Final = 200
SLOW_CASE_TRIALS: Final = 120
ESTIMATED_NOISE_TRIALS: Final = 400

#: Trials of a case with time-stamp jitter, and its standard deviation.
JITTER_TRIALS: Final = 60
JITTER: Final = "2e-4 s"

#: Seed of the first trial.
FIRST_SEED: Final = 1000

#: Half-width of a 95 % band, in standard errors.
BAND_FACTOR: Final = 1.96

#: Cases in which u includes noise that the records do not show.
HIDDEN_NOISE_CASES: Final = (
    "white noise, not stated",
    "unstated noise: white noise with a hidden random walk",
)


@dataclass(frozen=True)
class Case:
    """Observable, true noise, stated noise, and method of analysis."""

    method: str
    observable: str
    label: str
    true_noise: dict[str, str]
    stated_noise: dict[str, str]

    @property
    def trials(self) -> int:
        """Number of trials for the table."""
        if "time-stamp jitter" in self.label:
            return JITTER_TRIALS
        if self.label == HIDDEN_NOISE_CASES[1]:
            return ESTIMATED_NOISE_TRIALS
        if self.method == "two-stage":
            return SLOW_CASE_TRIALS
        if not self.label.endswith(", not stated"):
            return TRIALS
        return ESTIMATED_NOISE_TRIALS if self.observable == "displacement" else SLOW_CASE_TRIALS

    def description(self, seed: int) -> str:
        """Return the campaign of one trial."""
        symbols = ["K_F", "K_I", "K_II", "K_III"] if self.method == "joint" else ["K_F", "K_II"]
        return f"""{describe_site()}
[accelerometers.Qx]
{describe_channel(self.observable, "east")}
[accelerometers.Qy]
{describe_channel(self.observable, "north")}
[noise]
{_format_lines(self.stated_noise)}
[model]
terms = [{", ".join(f'"{symbol}"' for symbol in symbols)}]
assume = "all"
{describe_runs()}
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
{_format_lines(self.true_noise)}
angle = "1e-6 rad"
"""


def _format_lines(table: dict[str, str]) -> str:
    return "\n".join(f'{key} = "{value}"' for key, value in table.items())


_WHITE_NOISE: Final = {
    "displacement": "0.01 m",
    "velocity": "1e-3 m/s",
    "specific_force": "1e-3 m/s^2",
}
_RANDOM_WALK: Final = {"acceleration": "3e-5 g/Hz^0.5"}
_NO_RANDOM_WALK: Final = {"acceleration": "0 g/Hz^0.5"}

#: A random walk that is detected in half of the trials.
_WEAK_RANDOM_WALK: Final = {"displacement": "8e-6 g/Hz^0.5", "velocity": "6e-6 g/Hz^0.5"}


def _list_cases() -> Iterator[Case]:
    for observable, noise in _WHITE_NOISE.items():
        white = {observable: noise}
        yield Case("joint", observable, "white noise, stated", white, white)
        if observable == "specific_force":
            # The noise of the accelerometer is the noise of the record.
            yield Case("joint", observable, "white noise, estimated", white, {})
            continue
        estimated = {observable: "estimate", **_NO_RANDOM_WALK}
        yield Case(
            "joint",
            observable,
            "white noise estimated, random walk stated as zero",
            white,
            estimated,
        )
        yield Case("joint", observable, "white noise, not stated", white, {})
        white_and_walk = {**white, **_RANDOM_WALK}
        yield Case(
            "joint",
            observable,
            "white noise and random walk, stated",
            white_and_walk,
            white_and_walk,
        )
        yield Case(
            "joint", observable, "white noise and random walk, not stated", white_and_walk, {}
        )
    for observable, noise in _WEAK_RANDOM_WALK.items():
        white_and_walk = {observable: _WHITE_NOISE[observable], "acceleration": noise}
        yield Case("joint", observable, HIDDEN_NOISE_CASES[1], white_and_walk, {})
    white = {"displacement": "0.01 m"}
    white_and_walk = {**white, **_RANDOM_WALK}
    for label, true_noise, stated_noise in (
        ("white noise, stated", white, white),
        ("white noise and random walk, stated", white_and_walk, white_and_walk),
        ("white noise and random walk, not stated", white_and_walk, {}),
    ):
        yield Case("two-stage", "displacement", label, true_noise, stated_noise)
    for method, observable in (
        *(("joint", observable) for observable in _WHITE_NOISE),
        ("two-stage", "displacement"),
    ):
        white = {observable: _WHITE_NOISE[observable]}
        true_noise = {**white, "timing": JITTER}
        yield Case(
            method, observable, "stated white noise and time-stamp jitter", true_noise, true_noise
        )
        yield Case(
            method, observable, "stated white noise, estimated time-stamp jitter", true_noise, white
        )


CASES: Final = tuple(_list_cases())


@dataclass(frozen=True)
class Row:
    """Results of a case.

    Attributes
    ----------
    method, observable, label, trials
        The case; each trial has one error per coefficient for each of two accelerometers.
    z_rms, normal_rms, covered
        By coefficient: rms of the errors over u, rms of their normal equivalents, and coverage
        of the 95 % intervals.
    normal_band, covered_band
        Half-width of the 95 % bands of `normal` and `coverage`, from the scatter of the trials.
    """

    method: str
    observable: str
    label: str
    trials: int
    z_rms: dict[str, float]
    normal_rms: dict[str, float]
    covered: dict[str, float]
    normal_band: float
    covered_band: float

    @property
    def n_errors(self) -> int:
        """Number of errors of each coefficient."""
        return 2 * self.trials

    @property
    def se(self) -> float:
        """Standard error of the normal equivalents' rms of one coefficient."""
        return 1.0 / math.sqrt(2.0 * self.n_errors)

    @property
    def rms(self) -> float:
        """The rms of all coefficients together."""
        return _pooled_rms(self.z_rms)

    @property
    def normal(self) -> float:
        """The rms of the normal equivalents of all coefficients together."""
        return _pooled_rms(self.normal_rms)

    @property
    def coverage(self) -> float:
        """Mean coverage of the 95 % intervals of all coefficients."""
        return sum(self.covered.values()) / len(self.covered)

    @property
    def has_hidden_noise(self) -> bool:
        """Whether u includes noise that the records do not show."""
        return self.label in HIDDEN_NOISE_CASES


def _pooled_rms(rms_by_symbol: dict[str, float]) -> float:
    return math.sqrt(sum(rms * rms for rms in rms_by_symbol.values()) / len(rms_by_symbol))


def _normalised_errors(case: Case, campaign: Campaign) -> Iterator[tuple[str, float, float]]:
    """Yield symbol, error over u, and degrees of freedom, of every coefficient."""
    assert campaign.simulation is not None
    truth = campaign.simulation.truth.coefficients
    if case.method == "two-stage":
        for name, joint_result in calibrate(campaign, method="two-stage").accelerometers.items():
            for symbol, coefficient in joint_result.coefficients.items():
                if coefficient.estimated and coefficient.value is not None and coefficient.u:
                    yield (
                        symbol,
                        (coefficient.value - truth[name][symbol]) / coefficient.u,
                        coefficient.dof or math.inf,
                    )
        return
    observed = tuple(observe_runs(campaign))
    joint_result = estimate(
        make_series(campaign, observed), make_unknowns(campaign), make_noise(campaign)
    )
    solution = joint_result.fit.solution
    for i, unknown in enumerate(joint_result.fit.model.unknowns):
        if unknown.symbol not in TERMS:
            continue  # rotation parameter of a run
        true_value = truth[unknown.owner].get(unknown.symbol, TERMS[unknown.symbol].nominal)
        error = float(solution.estimate[i]) + unknown.nominal - true_value
        yield unknown.symbol, error / float(solution.u[i]), float(joint_result.dof[i])


def run_trials(case: Case, trials: int) -> Row:
    """Run the trials of a case; return its row."""
    errors: dict[str, list[tuple[float, float]]] = {}
    for trial in range(trials):
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "campaign.toml"
            file.write_text(case.description(FIRST_SEED + trial), encoding="utf-8")
            simulate(file, folder)
            for symbol, normalised_error, dof in _normalised_errors(case, read_campaign(folder)):
                errors.setdefault(symbol, []).append((normalised_error, min(dof, 1e9)))
    return summarise_errors(case, errors)


def summarise_errors(case: Case, errors: dict[str, list[tuple[float, float]]]) -> Row:
    """Return the row of a case from coefficient -> pairs of error over u and dof."""
    # Coefficient, trial, accelerometer
    pairs = np.array(
        [np.reshape(pairs_of_symbol, (-1, 2, 2)) for pairs_of_symbol in errors.values()]
    )
    z, dof = np.moveaxis(pairs, -1, 0)
    trials = z.shape[1]
    normal = normal_equivalent(z, dof)
    is_covered = (np.abs(z) < stdtrit(dof, 0.975)).astype(float)

    def by_symbol(values: np.ndarray) -> dict[str, float]:
        return dict(zip(errors, values.mean(axis=(1, 2)).tolist(), strict=True))

    def band(trial_values: np.ndarray) -> float:
        return float(BAND_FACTOR * trial_values.mean(axis=(0, 2)).std(ddof=1) / math.sqrt(trials))

    return Row(
        case.method,
        case.observable,
        case.label,
        trials,
        z_rms={symbol: math.sqrt(mean_square) for symbol, mean_square in by_symbol(z**2).items()},
        normal_rms={
            symbol: math.sqrt(mean_square) for symbol, mean_square in by_symbol(normal**2).items()
        },
        covered=by_symbol(is_covered),
        normal_band=band(normal**2) / (2.0 * math.sqrt(float(np.mean(normal**2)))),
        covered_band=band(is_covered),
    )


def normal_equivalent(z: np.ndarray, dof: np.ndarray) -> np.ndarray:
    """Return normal quantiles with the tail probabilities of Student's t values."""
    return np.asarray(np.sign(z) * -ndtri(stdtr(dof, -np.abs(z))))


#: Column -> alignment.
COLUMN_ALIGNMENTS: Final = dict.fromkeys(["method", "record", "noise"], "---") | dict.fromkeys(
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
    return format_table(
        COLUMN_ALIGNMENTS,
        [
            (
                row.method,
                row.observable.replace("_", " "),
                row.label,
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


TABLE: Final = StoredTable("coverage", DOCS / "methods.md", Row, render)


def main() -> None:
    """Recompute the table."""
    TABLE.store([run_trials(case, case.trials) for case in CASES])


if __name__ == "__main__":
    run_study(__doc__.splitlines()[0], main)

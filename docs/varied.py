"""Coverage of intervals in random good campaigns: `make coverage`.

Each trial draws a campaign: one or two accelerometers, the observable, senses of rotation, stated
or unstated noise, gaps, priors, and every error that the description does not state, at its typical
size. The campaign is simulated, described and calibrated as a user would do it.
"""

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.special import ndtri, stdtr

from counterspin.calibration.calibrate import calibrate
from counterspin.calibration.model import make_unknowns
from counterspin.campaign.description import Campaign, read_campaign
from counterspin.physics.terms import ACCELEROMETER_TERMS, term
from counterspin.simulation.simulate import simulate
from stored_table import DOCS, UNITS, StoredTable, describe_site, format_table, run_study

#: Number of campaigns of each kind.
TRIALS: Final = 300

#: Terms of interest.
TERMS: Final = ("K_F", "K_I", "K_II", "K_III")

#: Standard deviations of the true coefficients.
COEFFICIENT_SD: Final = {"K_F": 5e-3, "K_I": 2e-3, "K_II": 3e-5, "K_III": 3e-6}

#: White noise of each observable, and a walk, in the units of [noise].
WHITE_NOISE: Final = {"displacement": 0.01, "velocity": 1e-3, "specific_force": 1e-3}
RANDOM_WALK: Final = 3e-4

#: Stated values of site and centrifuge, SI.
STATED_INPUTS: Final = {
    "site.gravity": 9.8066,
    "site.latitude": float(np.radians(45.75)),
    "centrifuge.radius": 2.5,
}


@dataclass(frozen=True)
class Row:
    """Results of one kind of campaign.

    Attributes
    ----------
    label, n_campaigns
        Label of the kind, and number of campaigns.
    n_errors
        By coefficient, the number of errors.
    z_rms
        By coefficient, rms of the errors over u, as normal equivalents.
    coverage
        Fraction of the 95 % intervals of all coefficients that contain the true value.
    not_good_share
        Fraction of the campaigns with a state other than good.
    """

    label: str
    n_campaigns: int
    n_errors: dict[str, int]
    z_rms: dict[str, float]
    coverage: float
    not_good_share: float


@dataclass(frozen=True)
class DrawnCampaign:
    """One campaign: its description without truth, and the true coefficients."""

    description: str
    simulation: str
    truth: dict[str, dict[str, float]]
    n_gaps: int


@dataclass(frozen=True)
class Kind:
    """Fixed properties of a kind of campaign.

    Attributes
    ----------
    has_unstated_errors
        Whether it has unstated errors; otherwise all unstated terms are fixed at nominal.
    noise
        Noise in the description: "stated", "found" (omitted) or "estimate"; None: drawn from the
        first two.
    first_seed
        Seed of the first campaign.
    """

    has_unstated_errors: bool
    noise: str | None = None
    first_seed: int = 7000


def draw_campaign(rng: np.random.Generator, kind: Kind) -> DrawnCampaign:
    """Draw a campaign of a kind."""
    has_unstated = kind.has_unstated_errors
    observable = str(rng.choice([*WHITE_NOISE], p=[0.6, 0.2, 0.2]))
    axes = ["east", "north"] if rng.random() < 0.7 else [str(rng.choice(["east", "north"]))]
    if rng.random() < 0.5:
        axes.reverse()
    white = WHITE_NOISE[observable] * 10.0 ** rng.uniform(-1.0, 0.5)
    walk = RANDOM_WALK if rng.random() < 0.3 and observable != "specific_force" else 0.0
    noise = [f'{observable} = "{white!r} {UNITS[observable]}"']
    noise += [f'acceleration = "{walk!r} m/s^2/Hz^0.5"'] if walk else []
    noise_modes = kind.noise, "stated" if rng.random() < 0.5 else "found"
    stated_noise = {
        "stated": noise,
        "found": [],
        "estimate": [f'{line.partition(" ")[0]} = "estimate"' for line in noise],
    }[noise_modes[0] or noise_modes[1]]
    truth: dict[str, dict[str, float]] = {}
    accelerometer_tables = []
    for axis in axes:
        coefficients = {
            s: term(s).nominal + size * _draw_plausible_z(rng, s)
            for s, size in COEFFICIENT_SD.items()
        }
        truth[f"Q{axis}"] = coefficients
        priors = []
        for symbol, u, key in (("K_F", 2e-6, "bias"), ("K_I", 5e-6, "scale_factor")):
            if rng.random() < 0.5:
                value = coefficients[symbol] + u * rng.standard_normal()
                priors.append(f'{key} = "{value!r} ± {u} {term(symbol).unit}"')
        pendulous = "down" if axis != "up" else "north"
        column = f'{observable} = {{ column = "{axis}", unit = "{UNITS[observable]}" }}'
        lines = [f'input_axis = "{axis}"', f'pendulous_axis = "{pendulous}"', *priors, column]
        accelerometer_tables.append(f"[accelerometers.Q{axis}]\n" + "\n".join(lines))
    rates = sorted({round(float(rate), 3) for rate in rng.uniform(0.25, 1.2, rng.integers(3, 6))})
    senses = rng.choice([-1.0, 1.0], len(rates)) if rng.random() < 0.4 else np.ones(len(rates))
    run_tables = [
        f'[[runs]]\nname = "run{i}"\nrate = "{float(sense) * rate!r} rev/s"\nrecord = "run{i}.csv"'
        for i, (rate, sense) in enumerate(zip(rates, senses, strict=True), start=1)
    ]
    quoted_terms = ", ".join(f'"{symbol}"' for symbol in TERMS)
    assume = "" if has_unstated else 'assume = "all"\n'
    model = f"[model]\nterms = [{quoted_terms}]\n{assume}"
    site = describe_site(
        *(
            f"{STATED_INPUTS[symbol]!r} {term(symbol).unit}"
            for symbol in ("site.gravity", "site.latitude", "centrifuge.radius")
        )
    )
    noise_table = "[noise]\n" + "\n".join(stated_noise) if stated_noise else ""
    description = "\n\n".join([site, *accelerometer_tables, noise_table, model, *run_tables]) + "\n"
    unstated_errors = _draw_unstated(description, rng) if has_unstated else {}
    for name in truth:
        truth[name] |= unstated_errors.get(name, {})
    simulation_table = (
        f'[simulation]\nsampling_rate = "16 Hz"\nrevolutions = {int(rng.integers(15, 40))}\n'
        f"seed = {int(rng.integers(1 << 30))}\n"
    )
    true_tables = [
        f"[truth.{name}]\n"
        + "\n".join(f'"{s}" = "{v!r} {term(s).unit}"' for s, v in values.items())
        for name, values in truth.items()
    ]
    true_tables += list(_format_shared_truth(unstated_errors))
    simulated_runs = [
        run + _format_tilts(unstated_errors.get(f"run{i}", {}))
        for i, run in enumerate(run_tables, start=1)
    ]
    true_noise = "[truth.noise]\n" + "\n".join([*noise, 'angle = "1e-6 rad"'])
    simulation = "\n\n".join(
        [
            site,
            *accelerometer_tables,
            model,
            *simulated_runs,
            simulation_table,
            *true_tables,
            true_noise,
        ]
    )
    return DrawnCampaign(description, simulation + "\n", truth, int(rng.integers(0, 3)))


def _draw_plausible_z(rng: np.random.Generator, symbol: str) -> float:
    """Return a standard normal draw that keeps the coefficient within its plausible limit."""
    while True:
        drawn = float(rng.standard_normal())
        if abs(drawn) * COEFFICIENT_SD[symbol] < term(symbol).limit:
            return drawn


def _draw_unstated(description: str, rng: np.random.Generator) -> dict[str, dict[str, float]]:
    """Draw all unstated errors of a campaign: owner -> symbol -> value."""
    with tempfile.TemporaryDirectory() as folder:
        campaign = _write_campaign(Path(folder), description)
        unknowns = make_unknowns(campaign).unknowns
    errors: dict[str, dict[str, float]] = {}
    for unknown in unknowns:
        if unknown.has_default_prior:
            value, u = unknown.prior
            value += STATED_INPUTS.get(unknown.symbol, 0.0)
            errors.setdefault(unknown.owner, {})[unknown.symbol] = value + u * rng.standard_normal()
    return errors


def _format_shared_truth(errors: dict[str, dict[str, float]]) -> Iterator[str]:
    families: dict[str, list[str]] = {}
    for symbol, value in errors.get("", {}).items():
        if symbol not in ACCELEROMETER_TERMS:
            family, _, key = symbol.partition(".")
            families.setdefault(family, []).append(f'{key} = "{value!r} {term(symbol).unit}"')
    for family, lines in families.items():
        yield f"[truth.{family}]\n" + "\n".join(lines)


def _format_tilts(tilts: dict[str, float]) -> str:
    if not tilts:
        return ""
    keys = (f'{s.removeprefix("platform.")} = "{v!r} rad"' for s, v in tilts.items())
    return f"\ntruth = {{ {', '.join(keys)} }}"


def _write_campaign(folder: Path, text: str) -> Campaign:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "campaign.toml").write_text(text, encoding="utf-8")
    return read_campaign(folder)


def _add_gaps(folder: Path, rng: np.random.Generator, n_gaps: int) -> None:
    """Remove rows from each record."""
    for file in sorted(folder.glob("run*.csv")):
        head, *rows = file.read_text(encoding="utf-8").splitlines()
        for _ in range(n_gaps):
            start = int(rng.integers(10, len(rows) - 40))
            del rows[start : start + int(rng.integers(1, 20))]
        file.write_text("\n".join([head, *rows]) + "\n", encoding="utf-8")


def run_trial(seed: int, kind: Kind) -> tuple[list[tuple[str, float, bool]], Any]:
    """Return (symbol, normal equivalent of the error, is covered) tuples, and the result."""
    rng = np.random.default_rng(seed)
    campaign = draw_campaign(rng, kind)
    with tempfile.TemporaryDirectory() as parent:
        folder = Path(parent) / "records"
        simulate(_write_campaign(Path(parent) / "true", campaign.simulation), folder)
        (folder / "campaign.toml").unlink()
        _add_gaps(folder, rng, campaign.n_gaps)
        result = calibrate(_write_campaign(folder, campaign.description))
    errors = []
    for name, accelerometer in result.accelerometers.items():
        for symbol, coefficient in accelerometer.coefficients.items():
            if coefficient.estimated and coefficient.value is not None and coefficient.u:
                z = (coefficient.value - campaign.truth[name][symbol]) / coefficient.u
                low, high = coefficient.interval()
                normal = float(ndtri(stdtr(min(coefficient.dof or 1e9, 1e9), -abs(z)))) * -np.sign(
                    z
                )
                errors.append((symbol, normal, low <= campaign.truth[name][symbol] <= high))
    return errors, result


def run_trials(label: str, kind: Kind, trials: int) -> Row:
    """Simulate and calibrate campaigns of a kind; return their row."""
    by_symbol: dict[str, list[float]] = {}
    coverage_flags, n_not_good = [], 0
    for trial in range(trials):
        errors, result = run_trial(kind.first_seed + trial, kind)
        n_not_good += result.state != "good"
        for symbol, z, is_covered in errors:
            by_symbol.setdefault(symbol, []).append(z)
            coverage_flags.append(is_covered)
    return Row(
        label,
        trials,
        {symbol: len(z) for symbol, z in by_symbol.items()},
        {symbol: float(np.sqrt(np.mean(np.square(z)))) for symbol, z in by_symbol.items()},
        float(np.mean(coverage_flags)),
        n_not_good / trials,
    )


def render(rows: Sequence[Row]) -> str:
    """Return the table as Markdown."""
    alignments = {"Campaigns": "---", "Number": "---:"}
    alignments |= {f"z rms of {symbol}": "---:" for symbol in TERMS}
    alignments |= {
        "95 % intervals that contain the true value": "---:",
        "state other than good": "---:",
    }
    return format_table(
        alignments,
        [
            [
                row.label,
                str(row.n_campaigns),
                *(
                    f"{row.z_rms[s]:.2f} ± {1.0 / np.sqrt(2.0 * row.n_errors[s]):.2f}"
                    for s in TERMS
                ),
                f"{row.coverage:.1%}".replace("%", " %"),
                f"{row.not_good_share:.1%}".replace("%", " %"),
            ]
            for row in rows
        ],
    )


TABLE: Final = StoredTable("varied", DOCS / "trust.md", Row, render)

KINDS: Final = {
    "no term fixed, all unstated errors drawn from their defaults": Kind(True),
    'perfect machines, `assume = "all"`, stated noise': Kind(False, "stated", 110_000),
    'perfect machines, `assume = "all"`, noise not stated': Kind(False, "found", 110_000),
    'perfect machines, `assume = "all"`, noise = "estimate"': Kind(False, "estimate", 110_000),
}


def main() -> None:
    """Recompute the table."""
    TABLE.store([run_trials(label, kind, TRIALS) for label, kind in KINDS.items()])


if __name__ == "__main__":
    run_study(__doc__.splitlines()[0], main)

"""Is the fit good? Tests of whitened residuals, run by run.

If the model and the noise are right, whitened residuals are independent with unit variance. Three
things can show that they are not:

- their size: chi-square against the degrees of freedom (only where the noise was given: estimated
  noise makes it fit by construction);
- their signs: too few changes of sign mean something slow was left out (Wald and Wolfowitz, Annals
  of Mathematical Statistics 11 (1940) 147);
- their spectrum: one frequency that stands out means something periodic was left out (Fisher, Proc.
  Royal Society A 125 (1929) 54).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import field
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from counterspin.arrays import Array, median
from counterspin.frozen import frozen
from counterspin.inference.distributions import (
    chi_square_tail,
    log_binomial,
    normal_cdf,
    normal_quantile,
    student_cdf,
)

#: Two estimates agree where their difference is up to this many of its standard uncertainties; good
#: campaigns exceed it in 0.3 %.
AGREEMENT: Final = 3.0

#: Share of good campaigns in which one of many differences between runs is said to be too large.
FALSE_ALARMS: Final = 0.002

#: Below this probability a departure is called one. It is shared among all tests of a fit.
SIGNIFICANCE: Final = 0.005

#: Part of a column, squared, that the fit must leave of it for anything to be tested.
MIN_RESIDUAL_FRACTION: Final = 1e-9

#: The share of it that is each side's of the whole fit's chi-square; the runs have the other half.
CHI_SQUARE_SIGNIFICANCE: Final = SIGNIFICANCE / 4.0


@frozen
class RunDiagnostics:
    """Tests of one run's whitened residuals."""

    rows: int  #: How many residuals.
    #: Sum of squares, and this run's share of the degrees of freedom.
    chi2: float
    dof: float
    chi2_p: float  #: Probability of a larger sum, the noise being as stated.
    #: Number of stretches of one sign: its distance from what independence gives, in standard
    #: deviations (negative: too few); two-sided probability.
    sign_z: float
    sign_p: float
    peak_frequency: float  #: Hz where times were given, else cycles per row.
    #: Fisher's g, the peak's share of the periodogram, and the probability of a larger one.
    peak_share: float
    peak_p: float
    #: As `periodogram` gives it, for pictures.
    periodogram: Array = field(repr=False, compare=False)


@frozen
class Diagnostics:
    """Tests of a whole fit."""

    #: Sum of squares of all whitened residuals and the degrees of freedom.
    chi2: float
    dof: float
    #: Small means that the model or the noise is wrong. With given noise the probability of a
    #: larger chi2; with estimated noise the smallest probability of the sign and peak tests, times
    #: their number (Bonferroni), for chi2 then equals dof whatever the model.
    lack_of_fit_p: float
    noise_given: bool  #: Which of the two it is.
    runs: dict[str, RunDiagnostics]  #: Tests of each run.
    findings: tuple[str, ...]  #: What stands out, one sentence each; empty where nothing does.

    @property
    def verdict(self) -> str:
        """One or more sentences for the report."""
        if self.findings:
            return " ".join(self.findings)
        magnitude = (
            f"chi-square {self.chi2:.6g} on {self.dof:.6g} degrees of freedom"
            if self.noise_given
            else "noise estimated from the residuals"
        )
        return (
            f"The residuals are consistent with independent noise ({magnitude}; p = "
            f"{self.lack_of_fit_p:.2g})."
        )


def diagnose(
    residuals: Mapping[str, ArrayLike],
    dof: float | Mapping[str, float],
    *,
    noise_given: bool,
    noise_dof: float = math.inf,
    times: Mapping[str, ArrayLike] | None = None,
    fits: int = 1,
) -> Diagnostics:
    """Test the whitened residuals of a fit.

    noise_dof: Degrees of freedom of a noise that was given, infinite where it is exact: then chi2
        over both is Fisher's F.
    residuals: By run, (n,) whitened residuals in the order of time; n >= 3.
    times: By run, the rows' times, s (any offset), for the frequency of a peak.
    fits: Of how many such fits, those of a campaign's accelerometers, this is one: the significance
        is shared among them.
    """
    values = {name: np.asarray(rows, float) for name, rows in residuals.items()}
    total = sum(len(rows) for rows in values.values())
    if not values or min(len(rows) for rows in values.values()) < 3:
        raise ValueError("a test requires at least three residuals in every run")
    shares = (
        dof
        if isinstance(dof, Mapping)
        else {name: dof * len(rows) / total for name, rows in values.items()}
    )
    total_dof = float(sum(shares[name] for name in values))
    if not min(shares[name] for name in values) > 0:
        raise ValueError(f"the fit has {total_dof} degrees of freedom, so nothing can be tested")
    runs = {}
    for name, rows in values.items():
        interval = 1.0 if times is None else median(np.diff(np.asarray(times[name])))
        runs[name] = _diagnose_run(rows, shares[name], interval, noise_dof)

    chi2 = float(sum(run.chi2 for run in runs.values()))
    if noise_given:
        fit_p = _tail(total_dof, chi2, noise_dof)
    else:
        smallest = min(min(run.sign_p, run.peak_p) for run in runs.values())
        fit_p = min(1.0, 2 * len(runs) * smallest)
    unit = "Hz" if times else "cycles per row"
    findings = _findings(runs, (chi2, total_dof, fit_p), unit, noise_given=noise_given, fits=fits)
    return Diagnostics(chi2, total_dof, fit_p, noise_given, runs, findings)


def _tail(dof: float, chi2: float, noise_dof: float) -> float:
    """Return the probability of a larger chi2, against a noise that was given."""
    if math.isinf(noise_dof):
        return chi_square_tail(dof, chi2)
    from scipy.special import fdtrc

    return float(fdtrc(dof, noise_dof, chi2 / dof))


def _diagnose_run(rows: Array, dof: float, interval: float, noise_dof: float) -> RunDiagnostics:
    chi2 = float(rows @ rows)
    _, z, sign_p = runs_test(rows)
    power = periodogram(rows)
    frequency, share, peak_p = periodogram_peak(power, len(rows))
    return RunDiagnostics(
        rows=len(rows),
        chi2=chi2,
        dof=dof,
        chi2_p=_tail(dof, chi2, noise_dof),
        sign_z=z,
        sign_p=sign_p,
        peak_frequency=frequency / interval,
        peak_share=share,
        peak_p=peak_p,
        periodogram=power,
    )


#: Share of the residuals' variance above which a wave is named first, and the fewest periods in a
#: run that are no bend of it.
_LARGE: Final = 0.1
_PERIODS: Final = 8


def _findings(
    runs: Mapping[str, RunDiagnostics],
    fit_test: tuple[float, float, float],
    unit: str,
    *,
    noise_given: bool,
    fits: int,
) -> tuple[str, ...]:
    """Sentences on what is too unlikely, all tests of all fits together at `SIGNIFICANCE`."""
    chi2, dof, p = fit_test
    tests = fits * len(runs) * (6 if noise_given else 2)
    limit, chi2_limit = SIGNIFICANCE / tests, CHI_SQUARE_SIGNIFICANCE / fits
    sentences = []
    if noise_given and p < chi2_limit:
        sentences.append(
            f"The residuals are {math.sqrt(chi2 / dof):.3g} times as large as expected from "
            "the stated noise. Either the stated noise is too small, or the model lacks a term."
        )
    elif noise_given and p > 1 - chi2_limit:
        sentences.append(
            f"The residuals are only {math.sqrt(chi2 / dof):.3g} times as large as expected "
            "from the stated noise. The stated noise is too large."
        )
    # A wave that is most of what is wrong says more than what it does to the signs.
    waves = [name for name, run in runs.items() if run.peak_p < limit and _is_large(run)]
    waves.sort(key=lambda name: -runs[name].peak_share)
    for name in [*waves, *(name for name in runs if name not in waves)]:
        run = runs[name]
        if noise_given and run.chi2_p < limit and len(runs) > 1:
            sentences.append(
                f"{name}: the residuals are {math.sqrt(run.chi2 / run.dof):.3g} times as large "
                "as expected from the stated noise."
            )
        signs = (
            f"{name}: successive residuals change sign too "
            f"{'seldom' if run.sign_z < 0 else 'often'} ({run.sign_z:+.1f} standard "
            "deviations), so the residuals are not independent."
        )
        wave = (
            f"{name}: a spectral peak at {run.peak_frequency:.4g} {unit} contains "
            f"{run.peak_share:.2%} of the residual variance. The residuals therefore contain a "
            f"periodic effect{', such as a vibration' if _is_large(run) else ''}."
        )
        tested_statistics = [(run.sign_p, signs), (run.peak_p, wave)]
        tested_statistics = tested_statistics[::-1] if _is_large(run) else tested_statistics
        sentences += [sentence for p, sentence in tested_statistics if p < limit]
    return tuple(sentences)


def _is_large(run: RunDiagnostics) -> bool:
    return run.peak_share > _LARGE and int(np.argmax(run.periodogram)) >= _PERIODS


def agreement_limit(differences: int) -> float:
    """Return up to how many standard uncertainties each of several differences may go.

    All of them stay below in 99.8 % of good campaigns (Sidak, Journal of the American Statistical
    Association 62 (1967) 626: at least that, however they depend on each other).
    """
    probability = -math.expm1(math.log1p(-FALSE_ALARMS) / max(differences, 1))
    return max(AGREEMENT, -normal_quantile(0.5 * probability))


def normal_equivalent(z: float, dof: float | None) -> float:
    """Return the size of a normal variable that is as rare as |z| of Student's distribution.

    dof: Degrees of freedom of that; None: infinite.
    """
    magnitude = abs(z)
    # Below 1e-300 there is no probability to compare any more.
    return magnitude if dof is None else -normal_quantile(max(student_cdf(dof, -magnitude), 1e-300))


def runs_test(rows: ArrayLike) -> tuple[int, float, float]:
    """Run Wald and Wolfowitz's test of the signs' order, by its normal approximation."""
    values = np.asarray(rows, float)
    positive = values[values != 0] > 0
    up = int(positive.sum())
    n, down = len(positive), len(positive) - up
    if up == 0 or down == 0:
        return min(n, 1), 0.0, 1.0
    count = 1 + int(np.count_nonzero(positive[1:] != positive[:-1]))
    mean = 1 + 2 * up * down / n
    variance = (mean - 1) * (mean - 2) / (n - 1)
    if variance <= 0:
        return count, 0.0, 1.0
    z = (count - mean) / math.sqrt(variance)
    # A count is a whole number: its tail begins half a step nearer the mean.
    tail = max(abs(count - mean) - 0.5, 0.0) / math.sqrt(variance)
    return count, z, 2 * normal_cdf(-tail)


def periodogram(rows: ArrayLike) -> Array:
    """Return |sum x exp(-i w t)|^2 / n at the lines between zero and Nyquist's frequency.

    Its expectation is 1 for independent residuals of unit variance.

    rows: (n,) evenly spaced residuals, n >= 3.
    Returns: shape ((n - 1) // 2,), from 1/n cycles per row.
    """
    values = np.asarray(rows, float)
    n = len(values)
    power: Array = np.abs(np.fft.rfft(values)[1 : (n - 1) // 2 + 1]) ** 2 / n
    return power


def periodogram_peak(power: Array, n: int) -> tuple[float, float, float]:
    """Largest line of the periodogram of n rows, with Fisher's exact test."""
    total_power = float(power.sum())
    if total_power == 0:
        return 0.0, 0.0, 1.0
    peak = int(np.argmax(power))
    share = float(power[peak]) / total_power
    return (peak + 1) / n, share, fisher_g_p(share, power.size)


def fisher_g_p(share: float, lines: int) -> float:
    """Probability that the largest of `lines` exponential shares exceeds `share`.

    sum_j (-1)^(j-1) C(m, j) (1 - j g)^(m-1) over j g < 1 (Fisher 1929).
    """
    if share >= 1:
        return 1.0 if lines == 1 else 0.0
    first_term = lines * (1 - share) ** (lines - 1)
    if first_term > 20:  # then p > 1 - 3e-9, and the alternating sum would only lose digits
        return 1.0
    p = 0.0
    for j in range(1, min(lines, math.ceil(1 / share) - 1, 200) + 1):
        magnitude = math.exp(log_binomial(lines, j) + (lines - 1) * math.log1p(-j * share))
        p += magnitude if j % 2 else -magnitude
    return min(max(p, 0.0), 1.0)

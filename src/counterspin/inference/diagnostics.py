"""Goodness of fit: tests of the whitened residuals of each run.

If the model and the noise are right, whitened residuals are independent with unit variance. Three
tests can reject this:

- size: chi-square against the degrees of freedom (only if the noise was given; estimated noise
  fits by construction);
- signs: too few changes of sign indicate an omitted slow effect (Wald and Wolfowitz, Annals of
  Mathematical Statistics 11 (1940) 147);
- spectrum: a significant peak indicates an omitted periodic effect (Fisher, Proc. Royal Society A
  125 (1929) 54).
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
AGREEMENT_FACTOR: Final = 3.0

#: Fraction of good campaigns in which one of many differences between runs exceeds the limit.
FALSE_ALARM_RATE: Final = 0.002

#: Significance level, divided among all tests of a fit.
SIGNIFICANCE: Final = 0.005

#: Smallest squared fraction of a column that must be outside the fit for a test.
MIN_RESIDUAL_FRACTION: Final = 1e-9

#: Significance level of each side of the chi-square test of the fit; the runs share the other half.
CHI_SQUARE_SIGNIFICANCE: Final = SIGNIFICANCE / 4.0


@frozen
class RunDiagnostics:
    """Tests of the whitened residuals of a run."""

    rows: int  #: Number of residuals.
    chi2: float  #: Sum of squares.
    dof: float  #: Share of the run in the degrees of freedom of the fit.
    chi2_p: float  #: Probability of a larger chi2 with the stated noise.
    #: Wald-Wolfowitz statistic, in standard deviations (negative: too few changes of sign), and its
    #: two-sided probability.
    sign_z: float
    sign_p: float
    peak_frequency: float  #: Hz if times were given, else cycles per row.
    #: Fisher's g, the share of the peak in the periodogram, and the probability of a larger g.
    peak_share: float
    peak_p: float
    periodogram: Array = field(repr=False, compare=False)  #: From `periodogram`, for figures.


@frozen
class Diagnostics:
    """Tests of a whole fit."""

    #: Sum of squares of all whitened residuals and the degrees of freedom.
    chi2: float
    dof: float
    #: With given noise, the probability of a larger chi2. With estimated noise, the smallest
    #: probability of the sign and peak tests times their number (Bonferroni), because chi2 then
    #: equals dof for every model. A small value indicates a wrong model or wrong noise.
    lack_of_fit_p: float
    noise_given: bool  #: True if the noise was given, False if it was estimated.
    runs: dict[str, RunDiagnostics]  #: Tests of each run.
    findings: tuple[str, ...]  #: A sentence for each significant test; empty if there is none.

    @property
    def verdict(self) -> str:
        """Findings as text for the report, or a sentence that there is none."""
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
    n_fits: int = 1,
) -> Diagnostics:
    """Test the whitened residuals of a fit.

    residuals: Run -> whitened residuals in time order, shape (n,), n >= 3.
    noise_dof: Degrees of freedom of given noise; infinite: exact. If finite, the test of chi2 is
        Fisher's F test.
    times: Run -> times of the rows, s (any offset), for the frequency of a peak.
    n_fits: Number of fits, such as those of the accelerometers of a campaign, that share the
        significance level.
    """
    values = {name: np.asarray(rows, float) for name, rows in residuals.items()}
    n_residuals = sum(len(rows) for rows in values.values())
    if not values or min(len(rows) for rows in values.values()) < 3:
        raise ValueError("a test requires at least three residuals in every run")
    dof_by_run = (
        dof
        if isinstance(dof, Mapping)
        else {name: dof * len(rows) / n_residuals for name, rows in values.items()}
    )
    total_dof = float(sum(dof_by_run[name] for name in values))
    if not min(dof_by_run[name] for name in values) > 0:
        raise ValueError(f"the fit has {total_dof} degrees of freedom, so nothing can be tested")
    runs = {}
    for name, rows in values.items():
        interval = 1.0 if times is None else median(np.diff(np.asarray(times[name])))
        runs[name] = _diagnose_run(rows, dof_by_run[name], interval, noise_dof)

    chi2 = float(sum(run.chi2 for run in runs.values()))
    if noise_given:
        fit_p = _chi_square_p(total_dof, chi2, noise_dof)
    else:
        min_p = min(min(run.sign_p, run.peak_p) for run in runs.values())
        fit_p = min(1.0, 2 * len(runs) * min_p)
    frequency_unit = "Hz" if times else "cycles per row"
    findings = _write_findings(
        runs, (chi2, total_dof, fit_p), frequency_unit, noise_given=noise_given, n_fits=n_fits
    )
    return Diagnostics(chi2, total_dof, fit_p, noise_given, runs, findings)


def _chi_square_p(dof: float, chi2: float, noise_dof: float) -> float:
    """Return the probability of a larger chi2 with given noise."""
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
        chi2_p=_chi_square_p(dof, chi2, noise_dof),
        sign_z=z,
        sign_p=sign_p,
        peak_frequency=frequency / interval,
        peak_share=share,
        peak_p=peak_p,
        periodogram=power,
    )


#: Share of the residual variance above which a peak is reported first, and the fewest periods in a
#: run that distinguish a periodic effect from a slow misfit.
_LARGE_PEAK_SHARE: Final = 0.1
_MIN_PERIODS: Final = 8


def _write_findings(
    runs: Mapping[str, RunDiagnostics],
    fit_test: tuple[float, float, float],
    frequency_unit: str,
    *,
    noise_given: bool,
    n_fits: int,
) -> tuple[str, ...]:
    """Return a sentence for each significant test; all tests of all fits share `SIGNIFICANCE`."""
    chi2, dof, p = fit_test
    n_tests = n_fits * len(runs) * (6 if noise_given else 2)
    p_limit, chi2_limit = SIGNIFICANCE / n_tests, CHI_SQUARE_SIGNIFICANCE / n_fits
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
    # A dominant peak is more specific than its effect on the signs.
    runs_with_peak = [
        name for name, run in runs.items() if run.peak_p < p_limit and _has_large_peak(run)
    ]
    runs_with_peak.sort(key=lambda name: -runs[name].peak_share)
    for name in [*runs_with_peak, *(name for name in runs if name not in runs_with_peak)]:
        run = runs[name]
        if noise_given and run.chi2_p < p_limit and len(runs) > 1:
            sentences.append(
                f"{name}: the residuals are {math.sqrt(run.chi2 / run.dof):.3g} times as large "
                "as expected from the stated noise."
            )
        sign_sentence = (
            f"{name}: successive residuals change sign too "
            f"{'seldom' if run.sign_z < 0 else 'often'} ({run.sign_z:+.1f} standard "
            "deviations), so the residuals are not independent."
        )
        peak_sentence = (
            f"{name}: a spectral peak at {run.peak_frequency:.4g} {frequency_unit} contains "
            f"{100 * run.peak_share:.2f} % of the residual variance. The residuals therefore "
            f"contain a periodic effect{', such as a vibration' if _has_large_peak(run) else ''}."
        )
        sign_and_peak = [(run.sign_p, sign_sentence), (run.peak_p, peak_sentence)]
        sign_and_peak = sign_and_peak[::-1] if _has_large_peak(run) else sign_and_peak
        sentences += [sentence for p, sentence in sign_and_peak if p < p_limit]
    return tuple(sentences)


def _has_large_peak(run: RunDiagnostics) -> bool:
    return run.peak_share > _LARGE_PEAK_SHARE and int(np.argmax(run.periodogram)) >= _MIN_PERIODS


def agreement_limit(n_differences: int) -> float:
    """Return the limit of each of several differences, in standard uncertainties.

    In at least 99.8 % of good campaigns, no difference exceeds this limit (Sidak, Journal of the
    American Statistical Association 62 (1967) 626; for any dependence between the differences).
    """
    probability = -math.expm1(math.log1p(-FALSE_ALARM_RATE) / max(n_differences, 1))
    return max(AGREEMENT_FACTOR, -normal_quantile(0.5 * probability))


def normal_equivalent(z: float, dof: float | None) -> float:
    """Return the magnitude of a normal variable that is as improbable as |z| of Student's t.

    dof: Degrees of freedom of Student's t; None: infinite.
    """
    magnitude = abs(z)
    # Smaller probabilities would underflow.
    return magnitude if dof is None else -normal_quantile(max(student_cdf(dof, -magnitude), 1e-300))


def runs_test(rows: ArrayLike) -> tuple[int, float, float]:
    """Return the number of runs of equal signs, its z and two-sided p (Wald and Wolfowitz).

    The test uses the normal approximation with a continuity correction.
    """
    values = np.asarray(rows, float)
    is_positive = values[values != 0] > 0
    n_positive = int(is_positive.sum())
    n, n_negative = len(is_positive), len(is_positive) - n_positive
    if n_positive == 0 or n_negative == 0:
        return min(n, 1), 0.0, 1.0
    n_runs = 1 + int(np.count_nonzero(is_positive[1:] != is_positive[:-1]))
    expected_runs = 1 + 2 * n_positive * n_negative / n
    variance = (expected_runs - 1) * (expected_runs - 2) / (n - 1)
    if variance <= 0:
        return n_runs, 0.0, 1.0
    z = (n_runs - expected_runs) / math.sqrt(variance)
    # Continuity correction.
    abs_z = max(abs(n_runs - expected_runs) - 0.5, 0.0) / math.sqrt(variance)
    return n_runs, z, 2 * normal_cdf(-abs_z)


def periodogram(rows: ArrayLike) -> Array:
    """Return |sum x exp(-i w t)|^2 / n at the frequencies between zero and Nyquist's.

    The expectation is 1 for independent residuals of unit variance.

    rows: Evenly spaced residuals, shape (n,), n >= 3.
    Returns: shape ((n - 1) // 2,), from 1/n cycles per row.
    """
    values = np.asarray(rows, float)
    n = len(values)
    power: Array = np.abs(np.fft.rfft(values)[1 : (n - 1) // 2 + 1]) ** 2 / n
    return power


def periodogram_peak(power: Array, n: int) -> tuple[float, float, float]:
    """Return frequency (cycles per row), share and p of the largest peak, by Fisher's exact test.

    n: Number of rows of the periodogram.
    """
    total_power = float(power.sum())
    if total_power == 0:
        return 0.0, 0.0, 1.0
    peak = int(np.argmax(power))
    share = float(power[peak]) / total_power
    return (peak + 1) / n, share, fisher_g_p(share, power.size)


def fisher_g_p(share: float, n_lines: int) -> float:
    """Return the probability that the largest of `n_lines` exponential shares exceeds `share`.

    sum_j (-1)^(j-1) C(m, j) (1 - j g)^(m-1) over j g < 1 (Fisher 1929).
    """
    if share >= 1:
        return 1.0 if n_lines == 1 else 0.0
    first_term = n_lines * (1 - share) ** (n_lines - 1)
    if first_term > 20:  # then p > 1 - 3e-9, and the alternating sum would only lose digits
        return 1.0
    p = 0.0
    for j in range(1, min(n_lines, math.ceil(1 / share) - 1, 200) + 1):
        magnitude = math.exp(log_binomial(n_lines, j) + (n_lines - 1) * math.log1p(-j * share))
        p += magnitude if j % 2 else -magnitude
    return min(max(p, 0.0), 1.0)

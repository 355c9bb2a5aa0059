"""Result of a study: statistics of the trials, a verdict, JSON.

The statistics are bias, standard deviation, stated uncertainty and coverage of each coefficient.
The sums of each batch have a fixed shape and are combined in the order of the batches, so that the
result does not depend on the worker of a batch.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from typing import Any, ClassVar, Final

import numpy as np

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.loading import load_name
from counterspin.results import ReportableResult, ResultPart, draw_pictures

CONFIDENCE_LEVELS: Final = (0.68, 0.95, 0.99)  #: levels of the intervals

#: Histogram of z = error/u: bins of 0.2 from -6 to 6, and a bin beyond each end.
Z_EDGE: Final = 6.0
N_Z_BINS: Final = 60

#: Number of bins of a bias covariate.
N_COVARIATE_BINS: Final = 10

#: Number of steps of the table of Student's t over 1/dof.
_N_TABLE_STEPS: Final = 4000

_N_MOMENTS: Final = 5  # n, mean and squares of the error, sums of truth and u
_COVERAGE_COLUMNS: Final = slice(_N_MOMENTS, _N_MOMENTS + len(CONFIDENCE_LEVELS))
_HISTOGRAM_COLUMNS: Final = slice(
    _N_MOMENTS + len(CONFIDENCE_LEVELS), _N_MOMENTS + len(CONFIDENCE_LEVELS) + N_Z_BINS + 2
)
_FIRST_COVARIATE_COLUMN: Final = _HISTOGRAM_COLUMNS.stop


@frozen
class BiasCovariate:
    """A varied quantity, to show the dependence of the bias on it."""

    symbol: str  #: Symbol of the quantity.
    low: float  #: Lower limit of the bins.
    high: float  #: Upper limit of the bins.


@frozen
class TrialAccumulator:
    """Accumulation of sums over the trials of each coefficient."""

    covariates: tuple[BiasCovariate, ...]  #: Covariates of the bias.

    @property
    def width(self) -> int:
        """Number of sums for a coefficient and a batch."""
        return _FIRST_COVARIATE_COLUMN + 3 * N_COVARIATE_BINS * len(self.covariates)

    def accumulate(
        self, estimate: Array, truth: Array, u: Array, dof: Array, covariate_values: Sequence[Array]
    ) -> Array:
        """Return the sums of a coefficient over a batch of n trials.

        estimate, truth, u, dof: Shape (n,).
        covariate_values: Values of the covariates, each of shape (n,).
        Returns: shape (width,).
        """
        sums = np.zeros(self.width)
        error = estimate - truth
        mean = error.mean()
        sums[0] = error.size
        sums[1] = mean
        sums[2] = np.sum((error - mean) ** 2)
        sums[3] = truth.sum()
        sums[4] = u.sum()
        z = error / u
        abs_z = np.abs(z)
        # Only few trials are between the smallest and the largest factor.
        dof_range = np.array([dof.max(), dof.min()])
        for column, level in enumerate(CONFIDENCE_LEVELS, _COVERAGE_COLUMNS.start):
            low, high = coverage_factor(dof_range, level)
            sums[column] = np.count_nonzero(abs_z <= low)
            if low < high:
                borderline_indices = np.flatnonzero((abs_z > low) & (abs_z <= high))
                factors = coverage_factor(dof[borderline_indices], level)
                sums[column] += np.count_nonzero(abs_z[borderline_indices] <= factors)
        bin_positions = (z + Z_EDGE) * (N_Z_BINS / (2.0 * Z_EDGE)) + 1.0
        z_bins = np.clip(bin_positions, 0.0, N_Z_BINS + 1.0).astype(np.intp)
        sums[_HISTOGRAM_COLUMNS] = np.bincount(z_bins, minlength=N_Z_BINS + 2)
        first_column = _FIRST_COVARIATE_COLUMN
        for covariate, values in zip(self.covariates, covariate_values, strict=True):
            bin_positions = (values - covariate.low) * (
                N_COVARIATE_BINS / (covariate.high - covariate.low)
            )
            bin_indices = np.clip(bin_positions, 0, N_COVARIATE_BINS - 1).astype(np.intp)
            for weights in (np.ones_like(error), error, error**2):
                sums[first_column : first_column + N_COVARIATE_BINS] = np.bincount(
                    bin_indices, weights=weights, minlength=N_COVARIATE_BINS
                )
                first_column += N_COVARIATE_BINS
        return sums


@lru_cache(maxsize=8)
def _tabulate_quantiles(level: float) -> tuple[Array, Array]:
    from scipy.special import stdtrit

    inverse_dof = np.arange(_N_TABLE_STEPS + 1) / _N_TABLE_STEPS
    with np.errstate(divide="ignore"):
        dof = np.where(inverse_dof > 0.0, 1.0 / np.maximum(inverse_dof, 1e-12), 1e12)
    quantile: Array = np.asarray(stdtrit(dof, 0.5 * (1.0 + level)), dtype=np.float64)
    return quantile, np.append(np.diff(quantile), 0.0)


def coverage_factor(dof: Array, level: float) -> Array:
    """Return Student's t for a two-sided level and at least one degree of freedom."""
    quantile, slope = _tabulate_quantiles(level)
    # The table has equal steps, so that no search is needed.
    position = _N_TABLE_STEPS / np.maximum(dof, 1.0)
    index = position.astype(np.intp)
    return np.asarray(quantile[index] + (position - index) * slope[index])


#: Accepted range of the coverage of 95 % intervals.
_ACCEPTED_COVERAGE: Final = (0.94, 0.96)

#: Minimum number of trials for a verdict on the coverage.
MIN_TRIALS: Final = 200

#: A bias below this fraction of the stated u leaves the coverage within 0.4 % of 95 %.
_MAX_BIAS_RATIO: Final = 0.2


class BiasAgainst(ResultPart):
    """Bias against a varied quantity in bins; null for a bin without trials."""

    value: list[float]  #: Centre values of the bins.
    trials: list[float]  #: Number of trials in each bin.
    bias: list[float | None]  #: Mean of estimate minus truth.
    se_bias: list[float | None]  #: Standard error of the bias.


class CoefficientResult(ResultPart):
    """Statistics of the trials of one coefficient of one analysis."""

    trials: int  #: Number of trials.
    truth: float  #: Mean of the true values.
    bias: float  #: Mean of estimate minus truth.
    se_bias: float  #: Standard error of the bias.
    sd: float  #: Standard deviation of estimate minus truth.
    mse: float  #: Mean square of estimate minus truth.
    u: float  #: Mean of the stated standard uncertainty.
    #: Share of trials whose interval contains the truth, for each level.
    covered: tuple[float, ...]
    intervals: tuple[tuple[float, float], ...]  #: Binomial 95 % interval of each share.
    #: Number of trials in each bin of z; the first and last bins contain all values beyond.
    histogram: list[int]
    against: dict[str, BiasAgainst]  #: Bias against each varied quantity.
    unit: str  #: Unit of the coefficient.
    bound: float | None  #: Cramer-Rao bound of the standard uncertainty, or None.
    #: Variance of the bound divided by the mean square error; None without a bound.
    efficiency: float | None
    #: True if the intervals have their nominal coverage; None with too few trials.
    trustworthy: bool | None
    finding: str  #: Verdict on the coverage, in words.


class AnalysisResult(ResultPart):
    """One of the competing analyses."""

    engine: str  #: Engine used, in words.
    trustworthy: bool | None  #: True if all coefficients are trustworthy; None: too few trials.
    coefficients: dict[str, CoefficientResult]  #: Reported coefficients, by owner and symbol.
    undetermined: list[str]  #: Coefficients that the records do not determine.


class StudyResult(ReportableResult):
    """A study."""

    BLOCKS: ClassVar[str] = "counterspin.studies.page:study_blocks"
    REPORT_BLOCKS: ClassVar[str] = "counterspin.studies.page:report_blocks"
    KIND: ClassVar[str] = "study's result"

    title: str  #: Title of the campaign.
    trials: int  #: Number of trials done.
    trials_asked: int  #: Number of trials requested.
    complete: bool  #: True if all trials were done.
    seed: int  #: Seed of the random number generator.
    varying: list[str]  #: Varied quantities, in words.
    levels: tuple[float, ...] = CONFIDENCE_LEVELS  #: Levels of the intervals.
    analyses: dict[str, AnalysisResult]  #: Compared analyses, by name.
    verdict: list[str]  #: Trustworthy analyses, and the faults of the others.
    provenance: dict[str, str]  #: ``version`` of the program.

    def plot(self, *, axes: Any = None) -> list[Any]:
        """Draw the distribution of error / stated u of each coefficient."""
        return draw_pictures(load_name("counterspin.studies.page:z_plots")(self), axes)


def summarise(
    accumulator: TrialAccumulator,
    batch_sums: Array,
    name: str = "",
    unit: str = "",
    bound: float | None = None,
) -> CoefficientResult:
    """Combine the batches of one coefficient.

    batch_sums: Shape (batches, width), in the order of the batches.
    name: Name of the coefficient in its finding, such as "K_II of Qx".
    bound: Cramer-Rao bound of the standard uncertainty, if it exists.
    """
    counts = batch_sums[:, 0]
    n = float(counts.sum())
    mean = float(counts @ batch_sums[:, 1] / n)
    sum_of_squares = float(batch_sums[:, 2].sum() + counts @ (batch_sums[:, 1] - mean) ** 2)
    sd = math.sqrt(sum_of_squares / (n - 1.0)) if n > 1.0 else math.nan
    totals = batch_sums.sum(axis=0)
    coverage = tuple(float(value) / n for value in totals[_COVERAGE_COLUMNS])
    bias_tables = {}
    for index, covariate in enumerate(accumulator.covariates):
        first_column = _FIRST_COVARIATE_COLUMN + 3 * N_COVARIATE_BINS * index
        trials_in_bin, sums, sums_of_squares = totals[
            first_column : first_column + 3 * N_COVARIATE_BINS
        ].reshape(3, -1)
        edges = np.linspace(covariate.low, covariate.high, N_COVARIATE_BINS + 1)
        with np.errstate(divide="ignore", invalid="ignore"):
            bias = sums / trials_in_bin
            standard_errors = np.sqrt(
                np.maximum(sums_of_squares / trials_in_bin - bias**2, 0.0) / trials_in_bin
            )
        bias_tables[covariate.symbol] = BiasAgainst(
            value=(0.5 * (edges[1:] + edges[:-1])).tolist(),
            trials=trials_in_bin.tolist(),
            bias=_null_if_not_finite(bias),
            se_bias=_null_if_not_finite(standard_errors),
        )
    mse = sum_of_squares / n + mean**2
    coefficient = CoefficientResult(
        trials=int(n),
        truth=float(totals[3]) / n,
        bias=mean,
        se_bias=sd / math.sqrt(n),
        sd=sd,
        mse=mse,
        u=float(totals[4]) / n,
        covered=coverage,
        intervals=tuple(binomial_interval(share * n, n) for share in coverage),
        histogram=totals[_HISTOGRAM_COLUMNS].astype(np.int64).tolist(),
        against=bias_tables,
        unit=unit,
        bound=bound,
        efficiency=None if bound is None or mse == 0.0 else bound**2 / mse,
        trustworthy=None,
        finding="",
    )
    trustworthy, finding = judge_coverage(name, coefficient)
    return coefficient.model_copy(update={"trustworthy": trustworthy, "finding": finding})


def _null_if_not_finite(values: Array) -> list[float | None]:
    """Replace non-finite numbers by None for JSON: a bin without trials has no bias."""
    return [value if math.isfinite(value) else None for value in values.tolist()]


def binomial_interval(successes: float, trials: float) -> tuple[float, float]:
    """Return the 95 % Clopper-Pearson interval of a share (Biometrika 26, 404, 1934)."""
    from scipy.special import betaincinv

    tail = 0.025
    successes = round(successes)
    low = 0.0 if successes == 0 else float(betaincinv(successes, trials - successes + 1.0, tail))
    high = (
        1.0
        if successes >= trials
        else float(betaincinv(successes + 1.0, trials - successes, 1.0 - tail))
    )
    return low, high


def judge_coverage(name: str, coefficient: CoefficientResult) -> tuple[bool | None, str]:
    """Return the verdict on the uncertainty of a coefficient with its reason.

    The verdict is None with too few trials.
    """
    share, (low, high) = coefficient.covered[1], coefficient.intervals[1]
    is_biased = (
        abs(coefficient.bias) > 3.0 * coefficient.se_bias
        and abs(coefficient.bias) > _MAX_BIAS_RATIO * coefficient.u
    )
    coverage_text = f"{100.0 * share:.4g} % of the 95 % intervals contain the true value"
    if coefficient.trials < MIN_TRIALS:
        return None, f"{name}: {coverage_text}"
    if low <= _ACCEPTED_COVERAGE[1] and high >= _ACCEPTED_COVERAGE[0] and not is_biased:
        return True, f"{name} is unbiased; {coverage_text}"
    if is_biased:
        factor = coefficient.truth and 1.0 + coefficient.bias / coefficient.truth
        ratio_text = (
            (f"; the mean estimate is {factor:.3g} times the true value")
            if abs(factor - 1.0) > 0.05
            else ""
        )
        return False, (
            f"{name} is biased by {abs(coefficient.bias) / coefficient.u:.3g} standard "
            f"uncertainties{ratio_text}; {coverage_text}"
        )
    ratio = coefficient.sd / coefficient.u
    if high < _ACCEPTED_COVERAGE[0]:
        return False, (
            f"The estimates of {name} scatter by {ratio:.3g} times the stated uncertainty; "
            f"{coverage_text}"
        )
    return True, (
        f"The stated uncertainty of {name} is {1.0 / ratio:.3g} times the scatter of the "
        f"estimates (conservative); {coverage_text}"
    )


def summarise_analyses(analyses: Mapping[str, AnalysisResult]) -> list[str]:
    """Return a line for each analysis: the best, other trustworthy ones, then faulty ones."""
    if any(analysis.trustworthy is None for analysis in analyses.values()):
        return _summarise_few_trials(analyses)
    good_analyses = {name: analysis for name, analysis in analyses.items() if analysis.trustworthy}
    lines = []
    if not good_analyses:
        lines.append("Every analysis has at least one fault.")
    else:
        best_name = min(good_analyses, key=lambda name: _mean_square_error(good_analyses[name]))
        lines.append(
            f"{best_name}: no fault found"
            + (", and the smallest errors" if len(good_analyses) > 1 else "")
            + ". "
            + _join_findings(good_analyses[best_name].coefficients.values())
        )
        lines += [f"{name}: no fault found either." for name in good_analyses if name != best_name]
    for name, analysis in analyses.items():
        if not analysis.trustworthy:
            faulty_coefficients = [
                coefficient
                for coefficient in analysis.coefficients.values()
                if not coefficient.trustworthy
            ]
            lines.append(f"{name}: do not use this analysis. {_join_findings(faulty_coefficients)}")
    return lines


def _join_findings(coefficients: Iterable[CoefficientResult]) -> str:
    return "; ".join(coefficient.finding for coefficient in coefficients) + "."


def _summarise_few_trials(analyses: Mapping[str, AnalysisResult]) -> list[str]:
    """Return the findings of a study with too few trials for a verdict."""
    trials = min(
        coefficient.trials
        for analysis in analyses.values()
        for coefficient in analysis.coefficients.values()
    )
    return [
        (
            f"{trials} trials are too few for a verdict. Use at least {MIN_TRIALS} trials, "
            "preferably 1000."
        ),
        *(
            f"{name}. {_join_findings(analysis.coefficients.values())}"
            for name, analysis in analyses.items()
        ),
    ]


def _mean_square_error(analysis: AnalysisResult) -> float:
    """Return the mean square error of K_II, or of all coefficients if K_II is not reported."""
    coefficients = analysis.coefficients
    k_ii_coefficients = [
        coefficient
        for name, coefficient in coefficients.items()
        if name.rpartition(".")[2] == "K_II"
    ]
    k_ii_coefficients = k_ii_coefficients or list(coefficients.values())
    return sum(coefficient.mse for coefficient in k_ii_coefficients) / len(k_ii_coefficients)

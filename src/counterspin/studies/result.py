"""The result of a study: statistics of many trials, a verdict, JSON.

Bias, spread, stated uncertainty and coverage of each coefficient. The sums of each
batch are arrays of fixed shape, which are combined in the order of the batches. So the result
does not depend on the worker of a batch.
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

LEVELS: Final = (0.68, 0.95, 0.99)  #: of the intervals whose coverage is counted

#: The histogram of z = error/u: bins of 0.2 from -6 to 6, and a bin beyond each end.
Z_EDGE: Final = 6.0
Z_BINS: Final = 60

#: Bins of a quantity against which the bias is shown.
COVARIATE_BINS: Final = 10

#: Entries of the table of Student's t over 1/dof.
_TABLE_STEPS: Final = 4000

_MOMENTS: Final = 5  # n, mean and squares of the error, sums of truth and u
_COVERAGE_COLUMNS: Final = slice(_MOMENTS, _MOMENTS + len(LEVELS))
_HISTOGRAM_COLUMNS: Final = slice(_MOMENTS + len(LEVELS), _MOMENTS + len(LEVELS) + Z_BINS + 2)
_FIRST_COVARIATE: Final = _HISTOGRAM_COLUMNS.stop


@frozen
class BiasCovariate:
    """A varying quantity against which the bias is shown."""

    symbol: str  #: Symbol of the quantity.
    low: float  #: Lower limit of the bins.
    high: float


@frozen
class TrialAccumulator:
    """The sums of each coefficient over its trials."""

    covariates: tuple[BiasCovariate, ...]  #: Quantities against which the bias is shown.

    @property
    def width(self) -> int:
        """Number of sums for a coefficient and a batch."""
        return _FIRST_COVARIATE + 3 * COVARIATE_BINS * len(self.covariates)

    def accumulate(
        self, estimate: Array, truth: Array, u: Array, dof: Array, covariate_values: Sequence[Array]
    ) -> Array:
        """Return the sums of one coefficient over a batch of n trials.

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
        magnitude = np.abs(z)
        # Only a few trials lie between the smallest and the largest factor.
        dof_range = np.array([dof.max(), dof.min()])
        for column, level in enumerate(LEVELS, _COVERAGE_COLUMNS.start):
            low, high = coverage_factor(dof_range, level)
            sums[column] = np.count_nonzero(magnitude <= low)
            if low < high:
                undecided = np.flatnonzero((magnitude > low) & (magnitude <= high))
                factor = coverage_factor(dof[undecided], level)
                sums[column] += np.count_nonzero(magnitude[undecided] <= factor)
        scaled = (z + Z_EDGE) * (Z_BINS / (2.0 * Z_EDGE)) + 1.0
        bins = np.clip(scaled, 0.0, Z_BINS + 1.0).astype(np.intp)
        sums[_HISTOGRAM_COLUMNS] = np.bincount(bins, minlength=Z_BINS + 2)
        start = _FIRST_COVARIATE
        for covariate, values in zip(self.covariates, covariate_values, strict=True):
            scaled = (values - covariate.low) * (COVARIATE_BINS / (covariate.high - covariate.low))
            bin_indices = np.clip(scaled, 0, COVARIATE_BINS - 1).astype(np.intp)
            for weights in (np.ones_like(error), error, error**2):
                sums[start : start + COVARIATE_BINS] = np.bincount(
                    bin_indices, weights=weights, minlength=COVARIATE_BINS
                )
                start += COVARIATE_BINS
        return sums


@lru_cache(maxsize=8)
def _tabulate_quantiles(level: float) -> tuple[Array, Array]:
    from scipy.special import stdtrit

    inverse = np.arange(_TABLE_STEPS + 1) / _TABLE_STEPS
    with np.errstate(divide="ignore"):
        dof = np.where(inverse > 0.0, 1.0 / np.maximum(inverse, 1e-12), 1e12)
    quantile: Array = np.asarray(stdtrit(dof, 0.5 * (1.0 + level)), dtype=np.float64)
    return quantile, np.append(np.diff(quantile), 0.0)


def coverage_factor(dof: Array, level: float) -> Array:
    """Return Student's t for a two-sided level and at least one degree of freedom."""
    quantile, slope = _tabulate_quantiles(level)
    # The table is even, so that no search is needed.
    position = _TABLE_STEPS / np.maximum(dof, 1.0)
    index = position.astype(np.intp)
    return np.asarray(quantile[index] + (position - index) * slope[index])


#: Accepted range of the coverage of 95 % intervals.
_ACCEPTED_COVERAGE: Final = (0.94, 0.96)

#: With fewer trials the coverage is too uncertain for a verdict.
MIN_TRIALS: Final = 200

#: A bias below this fraction of the stated u leaves the coverage within 0.4 % of 95 %.
_MAX_BIAS_RATIO: Final = 0.2


class BiasAgainst(ResultPart):
    """Bias against a quantity that varied, bin by bin; null where a bin has no trials."""

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
    #: Number of trials in each bin of z; the first and last bins hold those beyond the ends.
    histogram: list[int]
    against: dict[str, BiasAgainst]  #: Bias against each varied quantity.
    unit: str  #: Unit of the coefficient.
    bound: float | None  #: Cramer-Rao bound of the standard uncertainty, or None.
    #: Variance of the bound divided by the mean square error; None without a bound.
    efficiency: float | None
    #: Whether the intervals have their nominal coverage; None with too few trials.
    trustworthy: bool | None
    finding: str  #: Verdict on the coverage, in words.


class AnalysisResult(ResultPart):
    """One of the competing analyses."""

    engine: str  #: Engine used, in words.
    trustworthy: bool | None  #: Whether all coefficients are trustworthy; None with too few trials.
    coefficients: dict[str, CoefficientResult]  #: Reported coefficients, by owner and symbol.
    undetermined: list[str]  #: Coefficients that the records do not determine.


class StudyResult(ReportableResult):
    """A study."""

    BLOCKS: ClassVar[str] = "counterspin.studies.page:study_blocks"
    REPORT_BLOCKS: ClassVar[str] = "counterspin.studies.page:report_blocks"
    DOCUMENT_TYPE: ClassVar[str] = "study's result"

    title: str  #: Title of the campaign.
    trials: int  #: Number of trials done.
    trials_asked: int  #: Number of trials requested.
    complete: bool  #: Whether all trials were done.
    seed: int  #: Seed of the random number generator.
    varying: list[str]  #: Varied quantities, in words.
    levels: tuple[float, ...] = LEVELS  #: Levels of the intervals.
    analyses: dict[str, AnalysisResult]  #: Compared analyses, by name.
    verdict: list[str]  #: Trustworthy analyses, and the faults of the others.
    provenance: dict[str, str]  #: ``version`` of the program.

    def plot(self, *, axes: Any = None) -> list[Any]:
        """Draw how each coefficient's error over its u is distributed."""
        return draw_pictures(load_name("counterspin.studies.page:z_plots")(self), axes)


def summarise(
    accumulator: TrialAccumulator,
    batches: Array,
    name: str = "",
    unit: str = "",
    bound: float | None = None,
) -> CoefficientResult:
    """Combine the batches of one coefficient.

    batches: Shape (batches, width), in the order of the batches.
    name: Name of the coefficient in its finding, such as "K_II of Qx".
    bound: The Cramer-Rao bound of its standard uncertainty, if it exists.
    """
    counts = batches[:, 0]
    n = float(counts.sum())
    mean = float(counts @ batches[:, 1] / n)
    squares = float(batches[:, 2].sum() + counts @ (batches[:, 1] - mean) ** 2)
    sd = math.sqrt(squares / (n - 1.0)) if n > 1.0 else math.nan
    totals = batches.sum(axis=0)
    covered = tuple(float(value) / n for value in totals[_COVERAGE_COLUMNS])
    against = {}
    for index, covariate in enumerate(accumulator.covariates):
        start = _FIRST_COVARIATE + 3 * COVARIATE_BINS * index
        trials_in_bin, sums, sums_of_squares = totals[start : start + 3 * COVARIATE_BINS].reshape(
            3, -1
        )
        edges = np.linspace(covariate.low, covariate.high, COVARIATE_BINS + 1)
        with np.errstate(divide="ignore", invalid="ignore"):
            bias = sums / trials_in_bin
            standard_errors = np.sqrt(
                np.maximum(sums_of_squares / trials_in_bin - bias**2, 0.0) / trials_in_bin
            )
        against[covariate.symbol] = BiasAgainst(
            value=(0.5 * (edges[1:] + edges[:-1])).tolist(),
            trials=trials_in_bin.tolist(),
            bias=_null_if_not_finite(bias),
            se_bias=_null_if_not_finite(standard_errors),
        )
    mse = squares / n + mean**2
    coefficient = CoefficientResult(
        trials=int(n),
        truth=float(totals[3]) / n,
        bias=mean,
        se_bias=sd / math.sqrt(n),
        sd=sd,
        mse=mse,
        u=float(totals[4]) / n,
        covered=covered,
        intervals=tuple(binomial_interval(share * n, n) for share in covered),
        histogram=totals[_HISTOGRAM_COLUMNS].astype(np.int64).tolist(),
        against=against,
        unit=unit,
        bound=bound,
        efficiency=None if bound is None or mse == 0.0 else bound**2 / mse,
        trustworthy=None,
        finding="",
    )
    trustworthy, finding = judge_coverage(name, coefficient)
    return coefficient.model_copy(update={"trustworthy": trustworthy, "finding": finding})


def _null_if_not_finite(values: Array) -> list[float | None]:
    """Replace numbers that JSON cannot hold by None: a bin without trials has no bias."""
    return [value if math.isfinite(value) else None for value in values.tolist()]


def binomial_interval(hits: float, trials: float) -> tuple[float, float]:
    """Return the 95 % Clopper-Pearson interval of a share (Biometrika 26, 404, 1934)."""
    from scipy.special import betaincinv

    tail = 0.025
    hits = round(hits)
    low = 0.0 if hits == 0 else float(betaincinv(hits, trials - hits + 1.0, tail))
    high = 1.0 if hits >= trials else float(betaincinv(hits + 1.0, trials - hits, 1.0 - tail))
    return low, high


def judge_coverage(name: str, summary: CoefficientResult) -> tuple[bool | None, str]:
    """Return the verdict on a coefficient's uncertainty with its reason; None: too few trials."""
    share, (low, high) = summary.covered[1], summary.intervals[1]
    biased = (
        abs(summary.bias) > 3.0 * summary.se_bias
        and abs(summary.bias) > _MAX_BIAS_RATIO * summary.u
    )
    coverage_text = f"{100.0 * share:.4g} % of the 95 % intervals contain the true value"
    if summary.trials < MIN_TRIALS:
        return None, f"{name}: {coverage_text}"
    if low <= _ACCEPTED_COVERAGE[1] and high >= _ACCEPTED_COVERAGE[0] and not biased:
        return True, f"{name} is unbiased; {coverage_text}"
    if biased:
        factor = summary.truth and 1.0 + summary.bias / summary.truth
        ratio_text = (
            (f"; the mean estimate is {factor:.3g} times the true value")
            if abs(factor - 1.0) > 0.05
            else ""
        )
        return False, (
            f"{name} is biased by {abs(summary.bias) / summary.u:.3g} standard "
            f"uncertainties{ratio_text}; {coverage_text}"
        )
    ratio = summary.sd / summary.u
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
    """Return a line for each analysis: the best, other trustworthy ones, then the rest."""
    if any(analysis.trustworthy is None for analysis in analyses.values()):
        return _summarise_few_trials(analyses)
    trustworthy = {name: analysis for name, analysis in analyses.items() if analysis.trustworthy}
    lines = []
    if not trustworthy:
        lines.append("Every analysis has at least one fault.")
    else:
        best = min(trustworthy, key=lambda name: _mean_square_error(trustworthy[name]))
        lines.append(
            f"{best}: no fault found"
            + (", and the smallest errors" if len(trustworthy) > 1 else "")
            + ". "
            + _findings(trustworthy[best].coefficients.values())
        )
        lines += [f"{name}: no fault found either." for name in trustworthy if name != best]
    for name, analysis in analyses.items():
        if not analysis.trustworthy:
            faulty = [c for c in analysis.coefficients.values() if not c.trustworthy]
            lines.append(f"{name}: do not use this analysis. {_findings(faulty)}")
    return lines


def _findings(coefficients: Iterable[CoefficientResult]) -> str:
    return "; ".join(c.finding for c in coefficients) + "."


def _summarise_few_trials(analyses: Mapping[str, AnalysisResult]) -> list[str]:
    """Return the findings of a study with too few trials for a verdict."""
    trials = min(c.trials for analysis in analyses.values() for c in analysis.coefficients.values())
    return [
        (
            f"{trials} trials are too few for a verdict. Use at least {MIN_TRIALS} trials, "
            "preferably 1000."
        ),
        *(
            f"{name}. {_findings(analysis.coefficients.values())}"
            for name, analysis in analyses.items()
        ),
    ]


def _mean_square_error(analysis: AnalysisResult) -> float:
    """Return the mean square error of K_II, or of all coefficients where it is not reported."""
    coefficients = analysis.coefficients
    selected = [c for name, c in coefficients.items() if name.rpartition(".")[2] == "K_II"]
    selected = selected or list(coefficients.values())
    return sum(c.mse for c in selected) / len(selected)

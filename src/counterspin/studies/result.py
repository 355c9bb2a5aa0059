"""The result of a study: figures for each analysis and coefficient, a verdict, JSON."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, ClassVar, Final

from counterspin.reports.publication import ShownResult, load_function, on_axes
from counterspin.results import ResultPart
from counterspin.studies.tally import LEVELS, Summary
from counterspin.studies.work import ReportedCoefficient

#: A coverage of 95 % intervals between these is as good as it gets in practice.
_GOOD_COVERAGE: Final = (0.94, 0.96)

#: With fewer trials the share of intervals that contain the truth is known too badly to judge.
FEWEST_TRIALS: Final = 200

#: A bias below this part of the stated u leaves the coverage within 0.4 % of 95 %.
_LARGEST_BIAS: Final = 0.2


class CoefficientResult(Summary):
    """One coefficient of one analysis."""

    unit: str  #: Of the coefficient.
    bound: float | None  #: The Cramer-Rao bound of the standard uncertainty, or None.
    #: The bound's variance over the mean square error; None without a bound.
    efficiency: float | None
    #: Whether its intervals contain the truth as often as they should; None with too few trials.
    trustworthy: bool | None
    finding: str  #: The same in words.


class AnalysisResult(ResultPart):
    """One competitor."""

    engine: str  #: The engine used, in words.
    trustworthy: bool | None  #: Whether all its coefficients are; None with too few trials.
    coefficients: dict[str, CoefficientResult]  #: What it reports, by owner and symbol.
    undetermined: list[str]  #: What the records do not determine.


class StudyResult(ShownResult):
    """A study."""

    BLOCKS: ClassVar[str] = "counterspin.studies.page:study_blocks"
    REPORT_BLOCKS: ClassVar[str] = "counterspin.studies.page:report_blocks"
    KIND: ClassVar[str] = "study's result"

    title: str  #: Of the campaign.
    trials: int  #: How many were done.
    trials_asked: int  #: How many were asked for.
    complete: bool  #: Whether all trials were done.
    seed: int  #: Of the random numbers.
    varying: list[str]  #: What varied, in words.
    levels: tuple[float, ...] = LEVELS  #: Of the intervals whose coverage is given.
    analyses: dict[str, AnalysisResult]  #: The competitors, by name.
    verdict: list[str]  #: Which of them to trust, and why not the others.
    provenance: dict[str, str]  #: ``version`` of the program.

    def plot(self, *, axes: Any = None) -> list[Any]:
        """Draw how each coefficient's error over its u is distributed."""
        return on_axes(list(load_function("counterspin.studies.page:z_plots")(self)), axes)


def coefficient_result(
    reported: ReportedCoefficient, unit: str, summary: Summary
) -> CoefficientResult:
    """Return the figures of one coefficient."""
    trustworthy, finding = trust_in(reported, summary)
    bound = reported.bound
    return CoefficientResult(
        **vars(summary),
        unit=unit,
        bound=bound,
        efficiency=None if bound is None or summary.mse == 0.0 else bound**2 / summary.mse,
        trustworthy=trustworthy,
        finding=finding,
    )


def trust_in(reported: ReportedCoefficient, summary: Summary) -> tuple[bool | None, str]:
    """Return whether a coefficient's uncertainty holds, and why; None: too few trials."""
    share, (low, high) = summary.covered[1], summary.intervals[1]
    biased = (
        abs(summary.bias) > 3.0 * summary.se_bias and abs(summary.bias) > _LARGEST_BIAS * summary.u
    )
    covered = f"its 95 % intervals contain the truth in {100.0 * share:.4g} % of the trials"
    if summary.trials < FEWEST_TRIALS:
        return None, f"{reported.symbol}: {covered}"
    if low <= _GOOD_COVERAGE[1] and high >= _GOOD_COVERAGE[0] and not biased:
        return True, f"{reported.symbol} is unbiased, and {covered}"
    if biased:
        factor = summary.truth and 1.0 + summary.bias / summary.truth
        times = f": it is {factor:.3g} times the truth" if abs(factor - 1.0) > 0.05 else ""
        return False, (
            f"{reported.symbol} is biased by {abs(summary.bias) / summary.u:.3g} standard "
            f"uncertainties{times}, and {covered}"
        )
    ratio = summary.sd / summary.u
    if high < _GOOD_COVERAGE[0]:
        return False, (
            f"{reported.symbol}: the scatter is {ratio:.3g} times the stated uncertainty, and "
            f"{covered}"
        )
    return True, (
        f"{reported.symbol}: the stated uncertainty is {1.0 / ratio:.3g} times the scatter "
        f"(conservative), and {covered}"
    )


def verdict_of(analyses: Mapping[str, AnalysisResult]) -> list[str]:
    """Return a line for each analysis: the best first, then others without fault, the rest."""
    if any(analysis.trustworthy is None for analysis in analyses.values()):
        return _unjudged(analyses)
    good = {name: analysis for name, analysis in analyses.items() if analysis.trustworthy}
    lines = []
    if not good:
        lines.append("Every analysis has a fault.")
    else:
        best = min(good, key=lambda name: _mean_square_error(good[name]))
        lines.append(
            f"{best}: no fault found"
            + (", and the smallest errors" if len(good) > 1 else "")
            + ". "
            + _findings(good[best].coefficients.values())
        )
        lines += [f"{name}: no fault found either." for name in good if name != best]
    for name, analysis in analyses.items():
        if not analysis.trustworthy:
            faulty = [c for c in analysis.coefficients.values() if not c.trustworthy]
            lines.append(f"{name}: do not use. {_findings(faulty)}")
    return lines


def _findings(coefficients: Iterable[CoefficientResult]) -> str:
    return "; ".join(c.finding for c in coefficients) + "."


def _unjudged(analyses: Mapping[str, AnalysisResult]) -> list[str]:
    """Return what too few trials gave."""
    trials = min(c.trials for one in analyses.values() for c in one.coefficients.values())
    return [
        f"{trials} trials are too few for a verdict: use at least {FEWEST_TRIALS}, preferably "
        f"1000.",
        *(
            f"{name}. {_findings(analysis.coefficients.values())}"
            for name, analysis in analyses.items()
        ),
    ]


def _mean_square_error(analysis: AnalysisResult) -> float:
    """Return the mean square error of K_II, or of all coefficients where it is not reported."""
    coefficients = analysis.coefficients
    chosen = [c for name, c in coefficients.items() if name.rpartition(".")[2] == "K_II"]
    chosen = chosen or list(coefficients.values())
    return sum(c.mse for c in chosen) / len(chosen)

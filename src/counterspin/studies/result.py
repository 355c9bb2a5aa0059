"""The result of a study: figures for each analysis and coefficient, a verdict, JSON.

- `StudyResult`, `AnalysisResult`, `CoefficientResult`: the figures
- `judge`: whether a coefficient's claims hold, in words
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any, Final

from counterspin.studies.engine import Reported
from counterspin.studies.tally import LEVELS, Summary

#: A coverage of 95 % intervals between these is as good as it gets in practice.
_GOOD: Final = (0.94, 0.96)

#: A bias below this part of the claimed u leaves the coverage within 0.4 % of 95 %.
_SLIGHT: Final = 0.2


@dataclass(frozen=True)
class CoefficientResult:
    """One coefficient of one analysis.

    Attributes
    ----------
    owner, symbol, unit
        Which; the owner of a platform term is empty.
    summary
        Bias, spread, claimed u, coverage.
    bound
        The Cramer-Rao bound of the standard uncertainty, or None.
    trustworthy
        Whether its intervals hold the truth as often as they say.
    finding
        The same in words.
    """

    owner: str
    symbol: str
    unit: str
    summary: Summary
    bound: float | None
    trustworthy: bool
    finding: str

    @property
    def name(self) -> str:
        """Owner and symbol in one word."""
        return f"{self.owner}.{self.symbol}" if self.owner else self.symbol

    @property
    def efficiency(self) -> float | None:
        """The bound's variance over the mean square error; None without a bound."""
        if self.bound is None or self.summary.mse == 0.0:
            return None
        return self.bound**2 / self.summary.mse


@dataclass(frozen=True)
class AnalysisResult:
    """One competitor.

    Attributes
    ----------
    name, engine
        The study's name for it, and the engine used.
    coefficients
        What it reports.
    lost
        What the records do not determine.
    """

    name: str
    engine: str
    coefficients: tuple[CoefficientResult, ...]
    lost: tuple[str, ...]

    @property
    def trustworthy(self) -> bool:
        """Whether all its coefficients are."""
        return all(one.trustworthy for one in self.coefficients)


@dataclass(frozen=True)
class StudyResult:
    """A study.

    Attributes
    ----------
    title
        Of the campaign.
    asked, seed
        Trials asked for, and the random numbers' seed.
    complete
        Whether all trials were done.
    seconds
        What they took, preparation left out; of a resumed study its last part.
    varying
        What varied, in words.
    drivers
        Quantities against which the bias is given in each summary.
    analyses
        The competitors.
    verdict
        Which of them to trust, and why not the others.
    version
        Of the program.
    """

    title: str
    asked: int
    seed: int
    complete: bool
    seconds: float
    varying: tuple[str, ...]
    drivers: tuple[str, ...]
    analyses: tuple[AnalysisResult, ...]
    verdict: tuple[str, ...]
    version: str

    @property
    def trials(self) -> int:
        """Trials done."""
        return self.analyses[0].coefficients[0].summary.trials

    def to_dict(self) -> dict[str, Any]:
        """Return what the JSON holds."""
        return {
            "schema": 1,
            "title": self.title,
            "trials": self.trials,
            "trials_asked": self.asked,
            "complete": self.complete,
            "seed": self.seed,
            "varying": list(self.varying),
            "levels": list(LEVELS),
            "analyses": {
                one.name: {
                    "engine": one.engine,
                    "trustworthy": one.trustworthy,
                    "coefficients": {c.name: _figures(c, self.drivers) for c in one.coefficients},
                    "undetermined": list(one.lost),
                }
                for one in self.analyses
            },
            "verdict": list(self.verdict),
            "provenance": {"version": self.version},
        }


def _figures(one: CoefficientResult, drivers: tuple[str, ...]) -> dict[str, Any]:
    summary = asdict(one.summary)
    summary["histogram"] = summary["histogram"].tolist()
    found = {
        name: dict(zip(("value", "trials", "bias", "se_bias"), map(_numbers, parts), strict=True))
        for name, parts in zip(drivers, summary.pop("drivers"), strict=True)
    }
    return {
        "unit": one.unit,
        **summary,
        "bound": one.bound,
        "efficiency": one.efficiency,
        "trustworthy": one.trustworthy,
        "finding": one.finding,
        "against": found,
    }


def _numbers(values: Any) -> list[float | None]:
    """Return numbers that JSON can hold: a bin without trials has no bias."""
    return [float(value) if math.isfinite(value) else None for value in values]


def judge(one: Reported, summary: Summary) -> tuple[bool, str]:
    """Return whether a coefficient's claims hold, and why or why not.

    Parameters
    ----------
    one
        Which coefficient.
    summary
        What its trials amount to.
    """
    share, (low, high) = summary.covered[1], summary.intervals[1]
    biased = abs(summary.bias) > 3.0 * summary.se_bias and abs(summary.bias) > _SLIGHT * summary.u
    claimed = f"the 95 % intervals hold the truth in {100.0 * share:.4g} % of the trials"
    if low <= _GOOD[1] and high >= _GOOD[0] and not biased:
        return True, f"{one.symbol} is unbiased and {claimed}"
    if biased:
        factor = summary.truth and 1.0 + summary.bias / summary.truth
        times = f": it is {factor:.3g} times the truth" if abs(factor - 1.0) > 0.05 else ""
        return False, (
            f"{one.symbol} is biased by {abs(summary.bias) / summary.u:.3g} of its standard "
            f"uncertainties{times}, and {claimed}"
        )
    ratio = summary.sd / summary.u
    if high < _GOOD[0]:
        return False, (
            f"{one.symbol} claims too little: it scatters {ratio:.3g} times as much as its "
            f"standard uncertainty says, and {claimed}"
        )
    return True, (
        f"{one.symbol} claims more uncertainty than it has, {1.0 / ratio:.3g} times its scatter, "
        f"and {claimed}: safe"
    )


def verdict_of(analyses: tuple[AnalysisResult, ...]) -> tuple[str, ...]:
    """Say which analyses are trustworthy, the best of them first, and why not the others."""
    good = [one for one in analyses if one.trustworthy]
    lines = []
    if not good:
        lines.append("No analysis is trustworthy here.")
    else:
        best = min(good, key=_error)
        lines.append(
            f"{best.name} is trustworthy here"
            + (" and has the smallest errors" if len(good) > 1 else "")
            + ": "
            + "; ".join(c.finding for c in best.coefficients)
            + "."
        )
        lines += [f"{one.name} is trustworthy too." for one in good if one is not best]
    for one in analyses:
        if not one.trustworthy:
            reasons = "; ".join(c.finding for c in one.coefficients if not c.trustworthy)
            lines.append(f"{one.name} is not: {reasons}.")
    return tuple(lines)


def _error(one: AnalysisResult) -> float:
    """Return the root mean square error of K_II, or of the first coefficient there is."""
    chosen = [c for c in one.coefficients if c.symbol == "K_II"] or list(one.coefficients)
    return sum(c.summary.mse for c in chosen) / len(chosen)

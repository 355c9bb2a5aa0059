"""The best explanation of a misfit, and those that explain the records equally well."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from counterspin.frozen import frozen
from counterspin.inference.diagnostics import SIGNIFICANCE
from counterspin.inference.joint import mistakes
from counterspin.inference.joint.alternatives import Alternative, ScoreTests, run_score_tests
from counterspin.inference.joint.estimation import Estimate

#: Share of good campaigns in which a prior, or another alternative, is blamed all the same.
FALSE_ALARMS: Final = 0.5 * SIGNIFICANCE

#: Chi-square by which an explanation must be better than another to exclude it.
_DECISIVE_CHI2: Final = 6.0

#: And the part of it, for what an alternative does is known to first order.
_DECISIVE_FRACTION: Final = 0.003

#: How many times its largest credible size a term may have where nothing credible explains as much.
_MAX_OUTSIZE: Final = 10.0

#: Steps that are tried in each record, and again about the best of them.
STEPS: Final = 24

_PRIOR_KINDS: Final = ("prior", "priors")

#: What comes first where the records cannot tell: what is stated is checked at no cost, and the
#: velocity of the Coriolis acceleration, all or nothing, is seldom as large by chance.
_FIRST_KINDS: Final = (mistakes.CORIOLIS, *_PRIOR_KINDS)

_TIMED_KINDS: Final = (mistakes.JUMP, mistakes.SLOPE, mistakes.BIAS_STEP)  # in a record


@frozen
class BestExplanation:
    """The best explanation, and those that are as good, each with the estimate of its parameter."""

    alternative: Alternative
    value: float
    u: float
    size: float
    rivals: tuple[tuple[Alternative, float], ...]
    tests: int
    dof: float | None
    outsized: bool


def find_best(
    estimate: Estimate,
    priors: Sequence[Alternative],
    alternatives: Sequence[Alternative],
    noise_known: bool,
) -> BestExplanation | None:
    """Return the best explanation; None if no explanation is significant."""
    candidates = (*priors, *alternatives)
    tests = run_score_tests(estimate.fit, candidates, noise_given=noise_known)
    index = _best_index(tests)
    if tests.alternatives[index].kind in _TIMED_KINDS:
        # Now that it is known where about it is, where exactly?
        approximate = tests.alternatives[index]
        (record_index,) = approximate.columns
        time = estimate.fit.design_blocks[record_index].series.time
        cell = float(time[-1] - time[0]) / STEPS
        candidates = (
            *candidates,
            *mistakes.changepoints(estimate.fit, 2 * STEPS, approximate, cell),
        )
        tests = run_score_tests(estimate.fit, candidates, noise_given=noise_known)
        index = _best_index(tests)
    if not _is_significant(tests, index):
        # The priors have fewer tests, and so a lower threshold.
        index = _best_index(tests, _PRIOR_KINDS)
        if not _is_significant(tests, index):
            return None
    return _rank_rivals(tests, _prefer_too_large(tests, index), noise_known)


def _prefer_too_large(tests: ScoreTests, index: int) -> int:
    """Return the index of a term that is too large to be credible but fits better, or `index`.

    The caller has found `index` significant, so this choice causes no further false alarms.
    """
    scores = [score if _is_too_large(tests, i) else 0.0 for i, score in enumerate(tests.z.tolist())]
    largest = int(np.argmax(scores))
    return largest if min_equal_gain(scores[largest] ** 2) > tests.z[index] ** 2 else index


def _is_too_large(tests: ScoreTests, index: int) -> bool:
    alternative = tests.alternatives[index]
    magnitude = abs(float(tests.value[index]))
    return (
        alternative.kind == "term"
        and alternative.credible_range[1]
        < magnitude
        <= _MAX_OUTSIZE * alternative.credible_range[1]
    )


def min_equal_gain(best: float) -> float:
    """Return the least gain in chi-square that is as good as the best one."""
    return max(best * (1.0 - _DECISIVE_FRACTION) - _DECISIVE_CHI2, 0.0)


def _best_index(tests: ScoreTests, kinds: Sequence[str] = ()) -> int:
    """Return the credible alternative, of some kinds or of any, that explains most."""
    scores = [
        score if (not kinds or alternative.kind in kinds) and _is_credible(tests, i) else -1.0
        for i, (alternative, score) in enumerate(
            zip(tests.alternatives, tests.z.tolist(), strict=True)
        )
    ]
    return int(np.argmax(scores))


def _is_significant(tests: ScoreTests, index: int) -> bool:
    return tests.p(index) * _test_count(tests, index) < FALSE_ALARMS


def _test_count(score_tests: ScoreTests, index: int) -> int:
    """Return the number of alternatives that share the significance of one of them."""
    is_prior = score_tests.alternatives[index].kind in _PRIOR_KINDS
    tests = sum(
        1
        for alternative, u in zip(score_tests.alternatives, score_tests.u.tolist(), strict=True)
        if math.isfinite(u) and (alternative.kind in _PRIOR_KINDS) == is_prior
    )
    return max(tests, 1)


def _rank_rivals(tests: ScoreTests, index: int, noise_known: bool) -> BestExplanation:
    alternatives = tests.alternatives
    min_gain = min_equal_gain(float(tests.z[index]) ** 2)
    equal = [
        k
        for k in range(len(alternatives))
        if tests.z[k] ** 2 > min_gain and (_is_credible(tests, k) or _is_too_large(tests, k))
    ]
    # Steps differ by where they are only: the best one stands for those of its record.
    equal = [k for k in equal if k == index or alternatives[k].kind not in _TIMED_KINDS] or [index]

    slack = float(tests.z[index]) ** 2 - min_gain

    def plausible(k: int) -> tuple[bool, bool, bool, float, bool, int]:
        # What is short of the best by all that is allowed is short of it by a decisive chi-square.
        shortfall = _DECISIVE_CHI2 * (float(tests.z[index]) ** 2 - float(tests.z[k]) ** 2) / slack
        evidence = (
            mistakes.log_bayes_factor(alternatives[k], float(tests.value[k]), float(tests.u[k]))
            - 0.5 * shortfall
        )
        # Of what rounding alone tells apart, what the whole campaign has comes first.
        weight, has_owner = round(-evidence, 6), bool(alternatives[k].owner)
        doubtful = alternatives[k].is_implausible(float(tests.value[k]))
        return (
            _is_too_large(tests, k),
            doubtful,
            alternatives[k].kind not in _FIRST_KINDS,
            weight,
            has_owner,
            k,
        )

    leader, *rivals = sorted(equal, key=plausible)
    return BestExplanation(
        alternatives[leader],
        float(tests.value[leader]),
        float(tests.u[leader]),
        float(tests.z[leader]),
        tuple((alternatives[k], float(tests.value[k])) for k in rivals),
        _test_count(tests, leader),
        None if noise_known else tests.dof,
        _is_too_large(tests, leader),
    )


def _is_credible(tests: ScoreTests, index: int) -> bool:
    """Return whether an alternative would be no larger than it may credibly be."""
    return tests.alternatives[index].is_credible(float(tests.value[index]))

"""Find the best explanation of a misfit and the explanations that fit equally well."""

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

#: False-alarm probability of the priors, and of the other alternatives.
FALSE_ALARM_RATE: Final = 0.5 * SIGNIFICANCE

#: Difference in chi-square from which the better explanation excludes the other one.
_DECISIVE_CHI2: Final = 6.0

#: Further difference relative to chi-square, because effects are computed to first order.
_DECISIVE_FRACTION: Final = 0.003

#: Largest ratio of a term to its credible limit, for a term without a credible rival.
_MAX_LIMIT_RATIO: Final = 10.0

#: Number of step times tested in each record, and again around the best one.
STEP_COUNT: Final = 24

_PRIOR_KINDS: Final = ("prior", "priors")

#: Kinds that rank first among equal explanations: stated values are easy to check, and the Coriolis
#: alternative has no free size.
_PREFERRED_KINDS: Final = (mistakes.CORIOLIS, *_PRIOR_KINDS)

_TIMED_KINDS: Final = (mistakes.JUMP, mistakes.SLOPE, mistakes.BIAS_STEP)  # in a record


@frozen
class BestExplanation:
    """The best explanation, and its rivals, which fit equally well."""

    alternative: Alternative
    value: float  #: Estimate of the parameter of the alternative.
    u: float  #: Standard uncertainty of the estimate.
    z: float  #: Score statistic of the alternative, in standard deviations.
    rivals: tuple[tuple[Alternative, float], ...]  #: Each with the estimate of its parameter.
    n_tests: int  #: Number of tests that share the significance level.
    dof: float | None  #: Degrees of freedom of the noise; None: stated noise.
    is_too_large: bool  #: Whether the estimate exceeds the credible limit.


def find_best(
    estimate: Estimate,
    priors: Sequence[Alternative],
    alternatives: Sequence[Alternative],
    is_noise_known: bool,
) -> BestExplanation | None:
    """Return the best explanation; None if no explanation is significant."""
    candidates = (*priors, *alternatives)
    tests = run_score_tests(estimate.fit, candidates, noise_given=is_noise_known)
    index = _best_index(tests)
    if tests.alternatives[index].kind in _TIMED_KINDS:
        # Refine the time of the step.
        coarse_step = tests.alternatives[index]
        (record_index,) = coarse_step.columns
        time = estimate.fit.design_blocks[record_index].series.time
        step_interval = float(time[-1] - time[0]) / STEP_COUNT
        candidates = (
            *candidates,
            *mistakes.changepoints(estimate.fit, 2 * STEP_COUNT, coarse_step, step_interval),
        )
        tests = run_score_tests(estimate.fit, candidates, noise_given=is_noise_known)
        index = _best_index(tests)
    if not _is_significant(tests, index):
        # The priors have fewer tests, and so a lower threshold.
        index = _best_index(tests, _PRIOR_KINDS)
        if not _is_significant(tests, index):
            return None
    return _rank_rivals(tests, _prefer_too_large(tests, index), is_noise_known)


def _prefer_too_large(tests: ScoreTests, index: int) -> int:
    """Return the index of a term that is too large to be credible but fits better, or `index`.

    The caller has found `index` significant, so this choice causes no further false alarms.
    """
    scores = [score if _is_too_large(tests, i) else 0.0 for i, score in enumerate(tests.z.tolist())]
    max_index = int(np.argmax(scores))
    return max_index if min_equivalent_gain(scores[max_index] ** 2) > tests.z[index] ** 2 else index


def _is_too_large(tests: ScoreTests, index: int) -> bool:
    alternative = tests.alternatives[index]
    magnitude = abs(float(tests.value[index]))
    return (
        alternative.kind == "term"
        and alternative.credible_range[1]
        < magnitude
        <= _MAX_LIMIT_RATIO * alternative.credible_range[1]
    )


def min_equivalent_gain(best_gain: float) -> float:
    """Return the smallest gain in chi-square that counts as equal to the best gain."""
    return max(best_gain * (1.0 - _DECISIVE_FRACTION) - _DECISIVE_CHI2, 0.0)


def _best_index(tests: ScoreTests, kinds: Sequence[str] = ()) -> int:
    """Return the index of the credible alternative with the highest score; kinds: empty for any."""
    scores = [
        score if (not kinds or alternative.kind in kinds) and _is_credible(tests, i) else -1.0
        for i, (alternative, score) in enumerate(
            zip(tests.alternatives, tests.z.tolist(), strict=True)
        )
    ]
    return int(np.argmax(scores))


def _is_significant(tests: ScoreTests, index: int) -> bool:
    return tests.p(index) * _test_count(tests, index) < FALSE_ALARM_RATE


def _test_count(score_tests: ScoreTests, index: int) -> int:
    """Return the number of alternatives that share the significance level with this one."""
    is_prior = score_tests.alternatives[index].kind in _PRIOR_KINDS
    count = sum(
        1
        for alternative, u in zip(score_tests.alternatives, score_tests.u.tolist(), strict=True)
        if math.isfinite(u) and (alternative.kind in _PRIOR_KINDS) == is_prior
    )
    return max(count, 1)


def _rank_rivals(tests: ScoreTests, index: int, is_noise_known: bool) -> BestExplanation:
    alternatives = tests.alternatives
    min_gain = min_equivalent_gain(float(tests.z[index]) ** 2)
    equivalent_indices = [
        k
        for k in range(len(alternatives))
        if tests.z[k] ** 2 > min_gain and (_is_credible(tests, k) or _is_too_large(tests, k))
    ]
    # Steps in a record differ only in their time, so only the best one counts.
    equivalent_indices = [
        k for k in equivalent_indices if k == index or alternatives[k].kind not in _TIMED_KINDS
    ] or [index]

    slack = float(tests.z[index]) ** 2 - min_gain

    def rank_key(k: int) -> tuple[bool, bool, bool, float, bool, int]:
        # A candidate at the limit of equivalence has a shortfall of _DECISIVE_CHI2.
        shortfall = _DECISIVE_CHI2 * (float(tests.z[index]) ** 2 - float(tests.z[k]) ** 2) / slack
        evidence = (
            mistakes.log_bayes_factor(alternatives[k], float(tests.value[k]), float(tests.u[k]))
            - 0.5 * shortfall
        )
        # Among equal evidence, an alternative for the whole campaign ranks first.
        negative_evidence, has_owner = round(-evidence, 6), bool(alternatives[k].owner)
        is_implausible = alternatives[k].is_implausible(float(tests.value[k]))
        return (
            _is_too_large(tests, k),
            is_implausible,
            alternatives[k].kind not in _PREFERRED_KINDS,
            negative_evidence,
            has_owner,
            k,
        )

    best_index, *rival_indices = sorted(equivalent_indices, key=rank_key)
    return BestExplanation(
        alternatives[best_index],
        float(tests.value[best_index]),
        float(tests.u[best_index]),
        float(tests.z[best_index]),
        tuple((alternatives[k], float(tests.value[k])) for k in rival_indices),
        _test_count(tests, best_index),
        None if is_noise_known else tests.dof,
        _is_too_large(tests, best_index),
    )


def _is_credible(tests: ScoreTests, index: int) -> bool:
    """Return whether the estimate of an alternative is within its credible range."""
    return tests.alternatives[index].is_credible(float(tests.value[index]))

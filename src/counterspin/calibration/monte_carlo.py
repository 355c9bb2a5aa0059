"""Coverage intervals by Monte Carlo (JCGM 101), beside those of the GUM.

Each trial adds to a coefficient the errors of all lines of its budget, each drawn from its
distribution: noise whose size is estimated from Student's t, priors and inputs from the
distributions that the description states, all others from the normal one. The sensitivities are
those at the estimate, except where a test finds that the fit is not linear (`linearity`).
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING, Final

import numpy as np

from counterspin.arrays import Array
from counterspin.calibration.linearity import Response, assess_linearity
from counterspin.calibration.model import stated_inputs
from counterspin.calibration.result_parts import Coefficient, MonteCarloInterval
from counterspin.campaign.distribution import draw_standardized
from counterspin.campaign.quantity import NORMAL, InputDistribution
from counterspin.errors import UsageError
from counterspin.inference.distributions import COVERAGE, numerical_tolerance
from counterspin.inference.joint.summary import BudgetLine
from counterspin.inference.mixture_distribution import estimated_part_dof

if TYPE_CHECKING:
    from counterspin.calibration.observed_runs import ObservedRun
    from counterspin.calibration.result import Result
    from counterspin.campaign.description import Campaign

#: Fewest and most trials: JCGM 101, 7.2 wants 10^4 times 1 / (1 - p) as a rule of thumb.
MIN_TRIALS: Final = 10_000
MAX_TRIALS: Final = 10_000_000

_SEED: Final = 101

#: A smaller share of noise in u^2 is drawn as normal: its tails do not show in the interval.
_MIN_NOISE_SHARE: Final = 1e-3

#: Parts of the trials that are compared with each other (JCGM 101, 7.9).
_BATCHES: Final = 10

#: Intervals whose lengths are within this ratio count as equally short.
_SAME_LENGTH: Final = 1.01


def check_trials(trials: int, method: str) -> None:
    """Refuse a number of trials that is too small for an interval, or too large for the memory."""
    if method != "joint":
        raise UsageError("calibrate", ["`monte_carlo`: requires the joint method"])
    if not MIN_TRIALS <= trials <= MAX_TRIALS:
        raise UsageError(
            "calibrate",
            [f"`monte_carlo`: specify {MIN_TRIALS} to {MAX_TRIALS} trials, not {trials}"],
        )


def add_intervals(
    result: Result, campaign: Campaign, observed_runs: Sequence[ObservedRun], trials: int
) -> Result:
    """Return a result with the intervals of its estimated coefficients by Monte Carlo.

    Parameters
    ----------
    result
        Of the joint method.
    campaign
        The distributions of its priors and inputs.
    observed
        The runs of the campaign.
    trials
        Number of trials.
    """
    accelerometers, runs = {}, set(result.runs)
    distributions = stated_distributions(campaign)
    linearity = assess_linearity(result, campaign, observed_runs)
    for accelerometer_index, (name, accelerometer) in enumerate(result.accelerometers.items()):
        intervals = {}
        for index, (symbol, coefficient) in enumerate(accelerometer.coefficients.items()):
            lines = accelerometer.budget.get(symbol)
            if lines and coefficient.estimated and coefficient.u:
                generator = np.random.default_rng((_SEED, accelerometer_index, index))
                responses = linearity.second_order(name, symbol, coefficient.u)
                sources = [*(line.source for line in lines), *responses]
                shapes = _by_source(distributions, sources, name, runs)
                errors = draw_errors(lines, coefficient, shapes, trials, generator, responses)
                fields = linearity.describe(name, symbol, coefficient.u)
                interval = interval_of(errors, coefficient)
                intervals[symbol] = interval.model_copy(update=fields)
        accelerometers[name] = accelerometer.model_copy(update={"monte_carlo": intervals})
    return result.model_copy(update={"accelerometers": accelerometers})


def stated_distributions(campaign: Campaign) -> dict[str, InputDistribution]:
    """Return name of a term or input -> its stated distribution, where that is not normal."""
    stated_quantities = stated_inputs(campaign) | dict(campaign.model.priors)
    for name, accelerometer in campaign.accelerometers.items():
        stated_quantities |= {
            f"{name}.{symbol}": prior for symbol, prior in accelerometer.priors.items()
        }
    return {
        name: quantity.distribution
        for name, quantity in stated_quantities.items()
        if quantity.distribution.shape != "normal"
    }


def _by_source(
    distributions: Mapping[str, InputDistribution],
    sources: Sequence[str],
    owner: str,
    runs: Collection[str],
) -> dict[str, InputDistribution]:
    """Return the distributions of the sources of a budget.

    A budget names the terms of its owner without it, and those of a run with the run.
    """
    shapes: dict[str, InputDistribution] = {}
    for source in sources:
        run, _, symbol = source.partition(".")
        for name in (f"{owner}.{source}", source, symbol if run in runs else source):
            if name in distributions:
                shapes[source] = distributions[name]
    return shapes


def draw_errors(
    lines: list[BudgetLine],
    coefficient: Coefficient,
    distributions: Mapping[str, InputDistribution],
    trials: int,
    generator: np.random.Generator,
    responses: Mapping[str, Response],
) -> Array:
    """Return the error of a coefficient in each trial, in its unit, shape (trials,).

    Lines with a normal distribution are drawn together.

    responses: Source -> response beyond the linear one, where that matters.
    """
    errors = np.zeros(trials)
    normal_variance = 0.0
    noise_variance = sum(line.contribution**2 for line in lines if line.kind == "noise")
    noise_dof = _noise_dof(coefficient, noise_variance)
    slopes = {line.source: (line.sensitivity or 0.0) * (line.u or 0.0) for line in lines}
    for source, response in responses.items():
        draws = draw_standardized(distributions.get(source, NORMAL), trials, generator)
        errors += slopes.get(source, 0.0) * draws + response.excess(draws)
    for line in lines:
        distribution = distributions.get(line.source)
        if line.source in responses:
            continue
        if line.kind in ("stated", "held") and distribution is not None:
            errors += line.contribution * draw_standardized(distribution, trials, generator)
        elif line.kind != "noise" or math.isinf(noise_dof):
            normal_variance += line.contribution**2
    if not math.isinf(noise_dof):
        errors += math.sqrt(noise_variance) * generator.standard_t(noise_dof, trials)
    errors += math.sqrt(normal_variance) * generator.standard_normal(trials)
    return errors


def _noise_dof(coefficient: Coefficient, noise_variance: float) -> float:
    """Return the degrees of freedom of the noise, of which those of u come (GUM G.4)."""
    if coefficient.dof is None or coefficient.u is None or noise_variance <= 0.0:
        return math.inf
    share = min(noise_variance / coefficient.u**2, 1.0)
    return estimated_part_dof(share, coefficient.dof) if share > _MIN_NOISE_SHARE else math.inf


def interval_of(errors: Array, coefficient: Coefficient) -> MonteCarloInterval:
    """Return the shortest coverage interval of drawn errors, and whether it validates the GUM's.

    The symmetric interval is compared with the GUM's: its ends scatter less than the shortest's.

    errors: About the estimate, in the coefficient's unit, shape (trials,).
    References: JCGM 101, 7.7 (intervals), 7.9 (scatter of their ends), 8 (validation).
    """
    assert coefficient.value is not None
    assert coefficient.u is not None
    low, high = shortest_interval(errors)
    tails = (0.5 * (1.0 - COVERAGE), 0.5 * (1.0 + COVERAGE))
    batches = [np.quantile(batch, tails) for batch in np.array_split(errors, _BATCHES)]
    scatter = 2.0 * np.std(batches, axis=0, ddof=1) / math.sqrt(_BATCHES)
    tolerance = numerical_tolerance(coefficient.u)
    gum = np.array(coefficient.interval(COVERAGE)) - coefficient.value
    difference = np.abs(np.quantile(errors, tails) - gum)
    is_validated: bool | None = None
    if (difference + scatter <= tolerance).all():
        is_validated = True
    elif (difference - scatter > tolerance).any():
        is_validated = False
    return MonteCarloInterval(
        trials=errors.size,
        u=float(errors.std(ddof=1)),
        low=coefficient.value + low,
        high=coefficient.value + high,
        tolerance=tolerance,
        gum_validated=is_validated,
    )


def shortest_interval(errors: Array) -> tuple[float, float]:
    """Return the ends of the shortest interval that covers 95 % of draws (JCGM 101, 7.7.2).

    Where the symmetric interval is longer by less than 1 %, it is returned: the place of the
    shortest is then a matter of chance, and of a rectangular distribution it is not unique.
    """
    sorted_errors = np.sort(errors)
    covered_count = math.ceil(COVERAGE * errors.size)
    lengths = sorted_errors[covered_count:] - sorted_errors[: errors.size - covered_count]
    start = int(np.argmin(lengths))
    symmetric = (errors.size - covered_count) // 2
    if lengths[symmetric] < _SAME_LENGTH * lengths[start]:
        start = symmetric
    return float(sorted_errors[start]), float(sorted_errors[start + covered_count])

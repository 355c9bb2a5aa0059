"""Coverage intervals by Monte Carlo (JCGM 101).

Each trial adds the errors of all lines of the budget to a coefficient. Estimated noise is drawn
from Student's t, priors and inputs from their stated distributions, all others from the normal
distribution. The sensitivities are those at the estimate, unless a test detects a non-linear fit
(`linearity`).
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

#: Limits of the number of trials: JCGM 101, 7.2 recommends 10^4 times 1 / (1 - p).
MIN_TRIALS: Final = 10_000
MAX_TRIALS: Final = 10_000_000

_SEED: Final = 101

#: Share of noise in u^2 below which it is drawn from the normal distribution.
_MIN_NOISE_SHARE: Final = 1e-3

#: Number of batches of trials for the scatter of the interval (JCGM 101, 7.9).
_BATCH_COUNT: Final = 10

#: Ratio of lengths up to which intervals count as equally short.
_MAX_LENGTH_RATIO: Final = 1.01


def check_trials(n_trials: int, method: str) -> None:
    """Raise UsageError if the number of trials is too small or too large."""
    if method != "joint":
        raise UsageError("calibrate", ["`monte_carlo`: requires the joint method"])
    if not MIN_TRIALS <= n_trials <= MAX_TRIALS:
        raise UsageError(
            "calibrate",
            [f"`monte_carlo`: specify {MIN_TRIALS} to {MAX_TRIALS} trials, not {n_trials}"],
        )


def add_intervals(
    result: Result, campaign: Campaign, observed_runs: Sequence[ObservedRun], n_trials: int
) -> Result:
    """Return a result with the intervals of its estimated coefficients by Monte Carlo.

    Parameters
    ----------
    result
        Result of the joint method.
    campaign
        Campaign with the distributions of priors and inputs.
    observed_runs
        Runs of the campaign.
    n_trials
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
                source_distributions = _distributions_by_source(distributions, sources, name, runs)
                errors = draw_errors(
                    lines, coefficient, source_distributions, n_trials, generator, responses
                )
                linearity_fields = linearity.describe(name, symbol, coefficient.u)
                interval = make_interval(errors, coefficient)
                intervals[symbol] = interval.model_copy(update=linearity_fields)
        accelerometers[name] = accelerometer.model_copy(update={"monte_carlo": intervals})
    return result.model_copy(update={"accelerometers": accelerometers})


def stated_distributions(campaign: Campaign) -> dict[str, InputDistribution]:
    """Return name of a term or input -> its stated distribution, if not normal."""
    quantities = stated_inputs(campaign) | dict(campaign.model.priors)
    for name, accelerometer in campaign.accelerometers.items():
        quantities |= {f"{name}.{symbol}": prior for symbol, prior in accelerometer.priors.items()}
    return {
        name: quantity.distribution
        for name, quantity in quantities.items()
        if quantity.distribution.shape != "normal"
    }


def _distributions_by_source(
    distributions: Mapping[str, InputDistribution],
    sources: Sequence[str],
    owner: str,
    runs: Collection[str],
) -> dict[str, InputDistribution]:
    """Return the distributions of the sources of a budget.

    A budget omits the name of its owner, and includes the names of runs.
    """
    source_distributions: dict[str, InputDistribution] = {}
    for source in sources:
        run, _, symbol = source.partition(".")
        for name in (f"{owner}.{source}", source, symbol if run in runs else source):
            if name in distributions:
                source_distributions[source] = distributions[name]
    return source_distributions


def draw_errors(
    lines: list[BudgetLine],
    coefficient: Coefficient,
    distributions: Mapping[str, InputDistribution],
    n_trials: int,
    generator: np.random.Generator,
    responses: Mapping[str, Response],
) -> Array:
    """Return the error of a coefficient in each trial, in its unit, shape (trials,).

    Lines with a normal distribution are drawn together.

    responses: Source -> significant non-linear response.
    """
    errors = np.zeros(n_trials)
    normal_variance = 0.0
    noise_variance = sum(line.contribution**2 for line in lines if line.kind == "noise")
    noise_dof = _noise_dof(coefficient, noise_variance)
    contributions = {line.source: (line.sensitivity or 0.0) * (line.u or 0.0) for line in lines}
    for source, response in responses.items():
        draws = draw_standardized(distributions.get(source, NORMAL), n_trials, generator)
        errors += contributions.get(source, 0.0) * draws + response.parabola(draws)
    for line in lines:
        distribution = distributions.get(line.source)
        if line.source in responses:
            continue
        if line.kind in ("stated", "held") and distribution is not None:
            errors += line.contribution * draw_standardized(distribution, n_trials, generator)
        elif line.kind != "noise" or math.isinf(noise_dof):
            normal_variance += line.contribution**2
    if not math.isinf(noise_dof):
        errors += math.sqrt(noise_variance) * generator.standard_t(noise_dof, n_trials)
    errors += math.sqrt(normal_variance) * generator.standard_normal(n_trials)
    return errors


def _noise_dof(coefficient: Coefficient, noise_variance: float) -> float:
    """Return the degrees of freedom of the noise from those of u (GUM G.4)."""
    if coefficient.dof is None or coefficient.u is None or noise_variance <= 0.0:
        return math.inf
    share = min(noise_variance / coefficient.u**2, 1.0)
    return estimated_part_dof(share, coefficient.dof) if share > _MIN_NOISE_SHARE else math.inf


def make_interval(errors: Array, coefficient: Coefficient) -> MonteCarloInterval:
    """Return the shortest coverage interval of drawn errors, and validate the GUM interval.

    The GUM interval is compared with the probabilistically symmetric interval, whose ends scatter
    less than those of the shortest one.

    errors: Errors of the estimate, in the unit of the coefficient, shape (trials,).
    References: JCGM 101, 7.7 (intervals), 7.9 (scatter of their ends), 8 (validation).
    """
    assert coefficient.value is not None
    assert coefficient.u is not None
    low, high = shortest_interval(errors)
    probabilities = (0.5 * (1.0 - COVERAGE), 0.5 * (1.0 + COVERAGE))
    batches = [np.quantile(batch, probabilities) for batch in np.array_split(errors, _BATCH_COUNT)]
    endpoint_u = 2.0 * np.std(batches, axis=0, ddof=1) / math.sqrt(_BATCH_COUNT)
    tolerance = numerical_tolerance(coefficient.u)
    gum_interval = np.array(coefficient.interval(COVERAGE)) - coefficient.value
    endpoint_difference = np.abs(np.quantile(errors, probabilities) - gum_interval)
    is_validated: bool | None = None
    if (endpoint_difference + endpoint_u <= tolerance).all():
        is_validated = True
    elif (endpoint_difference - endpoint_u > tolerance).any():
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

    If the symmetric interval is less than 1 % longer, it is returned, because the position of the
    shortest interval is then random.
    """
    sorted_errors = np.sort(errors)
    n_covered = math.ceil(COVERAGE * errors.size)
    lengths = sorted_errors[n_covered:] - sorted_errors[: errors.size - n_covered]
    start_index = int(np.argmin(lengths))
    symmetric_start = (errors.size - n_covered) // 2
    if lengths[symmetric_start] < _MAX_LENGTH_RATIO * lengths[start_index]:
        start_index = symmetric_start
    return float(sorted_errors[start_index]), float(sorted_errors[start_index + n_covered])

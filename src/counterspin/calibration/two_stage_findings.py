"""What a two-stage result must say beside its numbers: what they stand for, what they leave out.

- `unmodelled`, `asked_only`: terms of which nothing is known
- `confounded`: what is estimated in their place
- `findings`: what speaks against it
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Final

import numpy as np

from counterspin.calibration.diagnosis.credible import incredible
from counterspin.calibration.diagnosis.words import conflict
from counterspin.calibration.findings import (
    CONTRADICTION_SIGMAS,
    equivalent_deviations,
    hidden_noise,
    not_determined,
)
from counterspin.calibration.joint_parts import unit_of
from counterspin.calibration.joint_problem import exact_terms, left_out_of
from counterspin.calibration.result_parts import (
    Coefficient,
    ConfoundedTerms,
    Finding,
)
from counterspin.campaign.resolved import Accelerometer, Campaign
from counterspin.inference.diagnostics import agreement_of, normal_equivalent
from counterspin.inference.distributions import chi_square_tail
from counterspin.inference.identifiability import assess, write_combination
from counterspin.inference.two_stage.held_priors import HeldPrior, held_priors
from counterspin.inference.two_stage.second_stage import SecondStage, StrobedRun
from counterspin.physics.terms import OWN_TERMS, TERMS, term
from counterspin.reports.numbers import field_unit, format_number

#: Below this probability a misfit is no accident.
_SMALLEST_P: Final = 0.001


def asked_only(campaign: Campaign, accelerometer: Accelerometer) -> tuple[str, ...]:
    """Return the terms that the model asks for and that nothing is known of beforehand."""
    known = {*accelerometer.priors, *campaign.model.priors}
    return tuple(symbol for symbol in campaign.model.terms if symbol not in known)


def unmodelled(campaign: Campaign, accelerometer: Accelerometer) -> tuple[str, ...]:
    """Return the terms that nothing is known of beforehand, asked for or not."""
    exact = exact_terms(campaign, accelerometer.name)
    everything = left_out_of(campaign, accelerometer.name)
    others = [other.symbol for other in everything if other.symbol not in exact]
    return tuple(dict.fromkeys([*asked_only(campaign, accelerometer), *others]))


def confounded(second: SecondStage, estimates: Mapping[str, Coefficient]) -> list[ConfoundedTerms]:
    """Return what the estimates really are of: sums with terms that act exactly alike.

    Parameters
    ----------
    second
        The second stage.
    estimates
        Of its unknowns.
    """
    sets = [
        ConfoundedTerms(
            terms=list(item.terms),
            correlation=item.correlation,
            determined=item.determined,
            weights=list(item.named_weights),
            value=item.value,
            u=item.u,
        )
        for item in assess(second.solution, second.symbols).confounded
    ]
    for symbol in second.symbols:
        if alike := second.alike(symbol):
            u = estimates[symbol].u or 0.0
            weights = {symbol: 1.0, **alike}
            sizes = [_largest_size(other, second) for other in weights]
            sets.append(
                ConfoundedTerms(
                    terms=[symbol, *alike],
                    # Estimates of terms that act the same way work against each other.
                    correlation=-1.0 if next(iter(alike.values())) > 0.0 else 1.0,
                    determined=write_combination(
                        list(weights), list(weights.values()), [0.1 * u / size for size in sizes]
                    ),
                    weights=list(weights.values()),
                    value=estimates[symbol].value,
                    u=estimates[symbol].u,
                )
            )
    return sets


def _largest_size(symbol: str, second: SecondStage) -> float:
    """Return how large a term may credibly be, what it is ideally included."""
    return second.request.limit_of(symbol) + (TERMS[symbol].nominal if symbol in TERMS else 0.0)


def findings(
    campaign: Campaign,
    name: str,
    runs: Sequence[StrobedRun],
    second: SecondStage,
    coefficients: Mapping[str, Coefficient],
    model: str,
) -> list[Finding]:
    """Return what speaks against the result of one accelerometer.

    Parameters
    ----------
    campaign, name, runs, second
        What was asked, of which accelerometer, and what was found.
    coefficients
        As the result shows them.
    model
        ``exact`` or ``as-printed``.
    """
    gathered = []
    if model == "as-printed":
        text = (
            "The equations are used as printed: their K_II term is twice the exact one, so K_II "
            "is half of what the accelerometer has. Use the exact model for a calibration."
        )
        gathered.append(Finding(code="as-printed", subject=name, text=text))
    else:
        gathered += _undetermined(name, second, coefficients)
        gathered += _unknown(campaign, name, second)
    for a, b, r in second.near_collinear:
        text = f"The columns of {a} and {b} are nearly collinear at these rates"
        text += f" (correlation {r:.4f})."
        gathered.append(Finding(code="collinear", subject=f"{name}.{a}", text=text, size=abs(r)))
    misfit = _misfit(name, runs, second)
    if model == "exact":
        wrong = list(_wrong_priors(name, second))
        # The misfit is what a wrong prior makes, unless there is more than one mistake.
        gathered += [wrong[0].model_copy(update={"explains": misfit}), *wrong[1:]] if wrong else []
        misfit = [] if wrong else misfit
    gathered += misfit
    gathered += incredible(campaign, name, coefficients)
    unseen = second.solution.covariance_unseen
    if unseen is not None:
        gathered += hidden_noise(name, float(unseen[0, 0] / second.solution.u[0] ** 2))
    lost = sum(run.parabola.strobes.lost for run in runs)
    if lost:
        text = f"{lost} strobes fell into gaps of the record and were left out."
        gathered.append(Finding(code="strobes-lost", subject=name, text=text))
    return gathered


def _undetermined(
    name: str, second: SecondStage, coefficients: Mapping[str, Coefficient]
) -> list[Finding]:
    return [
        not_determined(f"{name}.{symbol}", symbol, "runs")
        for symbol in second.symbols
        if coefficients[symbol].value is None
    ]


def _unknown(campaign: Campaign, name: str, second: SecondStage) -> list[Finding]:
    """Name the accelerometer's terms, and what else was asked for, that could spoil K_II."""
    alike = {other for symbol in second.symbols for other in second.alike(symbol)}
    _, u = second.estimate("K_II")
    unknown = []
    for symbol in second.ignored:
        if symbol in alike or (symbol not in TERMS and symbol not in campaign.model.terms):
            continue
        typical = campaign.typical_of(symbol, name)
        shift = abs(float(second.shift(symbol)[0])) * typical
        if shift > u:
            (unit, factor), (moved, to_moved) = map(field_unit, (term(symbol).unit, "g/g^2"))
            text = (
                f"{symbol} is neither estimated nor known beforehand; at a typical size, "
                f"{format_number(typical * factor)} {unit}, it moves K_II by "
                f"{format_number(shift * to_moved, 2)} {moved}, "
                "more than its uncertainty. Give it a prior, or use the joint method."
            )
            subject = f"{name}.{symbol}"
            unknown.append(Finding(code="term-unknown", subject=subject, text=text, size=shift / u))
    return unknown


def _wrong_priors(name: str, second: SecondStage) -> Iterator[Finding]:
    """Yield the prior that the runs contradict most, if one is further off than chance allows."""
    held = held_priors(second)
    least = float(np.min(second.dof))
    dof = least if math.isfinite(least) else None

    def size_of(prior: HeldPrior) -> float:
        return normal_equivalent(prior.excess / prior.u, dof)

    worst = max(held, key=size_of, default=None)
    if worst is None or (size := size_of(worst)) <= agreement_of(len(held)):
        return
    owner = worst.run or (name if worst.symbol in OWN_TERMS else "")
    subject = f"{owner}.{worst.symbol}" if owner else worst.symbol
    alike = not worst.run and term(worst.symbol).per_run
    nominal = TERMS[worst.symbol].nominal if worst.symbol in TERMS else 0.0
    stated = worst.stated + nominal
    own = math.sqrt(max(worst.u**2 - (0.0 if alike else worst.spread**2), 0.0)) or worst.u
    yield Finding(
        code="prior-conflict",
        subject=subject,
        text=conflict(
            f"{subject} of all runs" if alike else subject,
            (stated, worst.spread),
            (stated - worst.excess, own),
            abs(worst.excess) / worst.u,
            unit_of(worst.symbol),
        ),
        size=size,
        contradicts=size > CONTRADICTION_SIGMAS,
    )


def _misfit(name: str, runs: Sequence[StrobedRun], second: SecondStage) -> list[Finding]:
    solution = second.solution
    dof = len(runs) - int(np.sum(np.isinf(solution.prior_sd)))
    # Without weights the sum of squares is not distributed like chi-square.
    if dof < 1 or not second.request.weighted or solution.chi2 <= 0.0:
        return []
    probability = chi_square_tail(dof, solution.chi2)
    if probability > _SMALLEST_P:
        return []
    worst = runs[int(np.argmax(np.abs(second.misfit)))].name
    size = equivalent_deviations(probability)
    text = (
        f"The runs do not agree with the model (chi-square {solution.chi2:.1f} with {dof} "
        f"degrees of freedom, p = {probability:.1g}; {worst} is farthest off): a term is missing, "
        "a prior is wrong, or the noise is larger than stated."
    )
    return [
        Finding(
            code="lack-of-fit",
            subject=name,
            text=text,
            size=size,
            contradicts=size > CONTRADICTION_SIGMAS,
        )
    ]

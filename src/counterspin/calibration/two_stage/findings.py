"""What a two-stage result must say beside its numbers: what they stand for, what they leave out."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Final

import numpy as np

from counterspin.calibration.checks.priors import contradicted_prior
from counterspin.calibration.findings import (
    CONTRADICTION_SIGMAS,
    equivalent_deviations,
    not_determined,
)
from counterspin.calibration.model import is_requested
from counterspin.calibration.result_parts import Coefficient, Finding, Residual
from counterspin.calibration.view import AccelerometerView
from counterspin.campaign.description import Campaign
from counterspin.inference.diagnostics import (
    CHI_SQUARE_SIGNIFICANCE,
)
from counterspin.inference.distributions import chi_square_tail
from counterspin.inference.identifiability import ConfoundedTerms, write_combination
from counterspin.inference.two_stage.second_stage import SecondStage
from counterspin.physics.terms import INPUTS
from counterspin.reports.numbers import format_number

#: Below this probability a misfit is no accident.
_SMALLEST_P: Final = 0.001

#: Chi-square of strobes without any noise.
_LEAST_SQUARES: Final = 1e-12


def nothing_known(campaign: Campaign, name: str, second: SecondStage) -> tuple[str, ...]:
    """Return the held terms, asked for or assumed to be perfect, of which nothing is stated."""
    stated = {*campaign.accelerometers[name].priors, *campaign.model.priors}
    held = [
        c.symbol
        for c in second.fit.model.considered
        if c.symbol not in stated
        and c.symbol not in INPUTS
        and (c.prior[1] == 0.0 or c.symbol in campaign.model.terms)
    ]
    return tuple(dict.fromkeys(held))


def sums_of_alike(
    view: AccelerometerView, second: SecondStage, coefficients: Mapping[str, Coefficient]
) -> list[ConfoundedTerms]:
    """Return what the estimates really are of: sums with terms that act exactly alike."""
    sets = []
    for symbol in second.symbols:
        alike = second.alike(symbol, nothing_known(view.campaign, view.name, second))
        if not alike:
            continue
        c = coefficients[symbol]
        value, u = second.estimate(symbol)
        if c.estimated and c.value is not None and c.u is not None:
            value, u = c.value, c.u
        weights = {symbol: 1.0, **alike}
        model = second.fit.model
        every = {o.symbol: o for o in (*model.considered, *model.unknowns)}
        sizes = [every[other].limit + every[other].nominal for other in weights]
        sets.append(
            ConfoundedTerms(
                terms=list(weights),
                # Estimates of terms that act the same way work against each other.
                correlation=-1.0 if next(iter(alike.values())) > 0.0 else 1.0,
                determined=write_combination(
                    list(weights), list(weights.values()), [0.1 * u / size for size in sizes]
                ),
                weights=list(weights.values()),
                value=value,
                u=u,
            )
        )
    return sets


def findings(
    view: AccelerometerView,
    second: SecondStage,
    coefficients: Mapping[str, Coefficient],
    model: str,
) -> list[Finding]:
    """Return what speaks against the coefficients of one accelerometer by one of the models."""
    gathered, name = [], view.name
    if model == "as-printed":
        text = (
            "The equations are used as printed: their K_II term is twice the exact "
            "one, so the result is half the true K_II. Use the exact model for a calibration."
        )
        gathered.append(Finding(code="as-printed", subject=name, text=text))
    else:
        gathered += [
            not_determined(
                f"{name}.{symbol}",
                symbol,
                "runs",
                requested=is_requested(view.campaign, symbol, name),
            )
            for symbol in second.symbols
            if coefficients[symbol].value is None
        ]
    for a, b, r in second.near_collinear:
        text = f"The columns of {a} and {b} are nearly collinear at these rates"
        text += f" (correlation {r:.4f})."
        gathered.append(Finding(code="collinear", subject=f"{name}.{a}", text=text, size=abs(r)))
    misfit = _misfit(name, second)
    if model == "exact":
        wrong = list(contradicted_prior(view))
        # The misfit is what a wrong prior makes, unless there is more than one mistake.
        gathered += [finding.model_copy(update={"explains": misfit}) for finding in wrong]
        misfit = [] if wrong else misfit
    gathered += misfit
    lost = sum(parabola.strobes.lost for parabola in second.parabolas)
    if lost:
        text = f"{lost} strobes fell into gaps of the record and were left out."
        gathered.append(Finding(code="strobes-lost", subject=name, text=text))
    return gathered


def overstated_noise(
    view: AccelerometerView, residual: Residual, sigma: float
) -> Iterator[Finding]:
    """Yield the finding that strobes scatter by less than the stated noise of a sample, in m."""
    p, level = residual.lack_of_fit_p, CHI_SQUARE_SIGNIFICANCE / len(view.campaign.accelerometers)
    if p is None or residual.chi2 is None or p <= 1.0 - level:
        return
    times = math.sqrt(max(residual.chi2, _LEAST_SQUARES) / residual.dof)
    text = (
        f"The strobes scatter by only {format_number(times, 2)} times the stated noise: by "
        f"{format_number(times * sigma, 2)} m instead of {format_number(sigma, 2)} m. u is too "
        "large. Check the stated noise, or have it estimated."
    )
    yield Finding(code="wrong-noise", subject=view.name, text=text, size=1.0 / times)


def _misfit(name: str, second: SecondStage) -> list[Finding]:
    fit = second.fit
    dof = len(fit.blocks) - int(np.sum(np.isinf(fit.solution.prior_sd)))
    # What is held may be off by as much as is stated of it, or is typical.
    chi2 = fit.relaxed.chi2 - sum(block.rss for block in fit.blocks)
    # Without weights the sum of squares is not distributed like chi-square.
    if dof < 1 or not second.weighted or chi2 <= 0.0:
        return []
    probability = chi_square_tail(dof, chi2)
    if probability > _SMALLEST_P:
        return []
    worst = fit.prepared[int(np.argmax(np.abs(second.misfit)))].run
    size = equivalent_deviations(probability)
    text = (
        f"The runs do not agree with the model (chi-square {chi2:.1f} with {dof} "
        f"degrees of freedom, p = {probability:.1g}; {worst} deviates most): a term is missing, "
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

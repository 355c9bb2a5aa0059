"""Findings of a two-stage result: the meaning of its numbers and their omissions."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Final

import numpy as np

from counterspin.calibration.accelerometer_view import AccelerometerView
from counterspin.calibration.checks.priors import find_prior_conflict
from counterspin.calibration.findings import (
    CONTRADICTION_SIGMAS,
    equivalent_deviations,
    not_determined_finding,
)
from counterspin.calibration.model import is_requested
from counterspin.calibration.result_parts import Coefficient, Finding, Residual
from counterspin.campaign.description import Campaign
from counterspin.inference.diagnostics import (
    CHI_SQUARE_SIGNIFICANCE,
)
from counterspin.inference.distributions import chi_square_tail
from counterspin.inference.identifiability import ConfoundedTerms, format_combination
from counterspin.inference.two_stage.second_stage import SecondStage
from counterspin.physics.terms import INPUTS
from counterspin.reports.numbers import format_number

#: Below this probability a misfit is no accident.
_SMALLEST_P: Final = 0.001

#: Chi-square of strobes without any noise.
_LEAST_SQUARES: Final = 1e-12


def unstated_considered(campaign: Campaign, name: str, second: SecondStage) -> tuple[str, ...]:
    """Return the held terms, asked for or assumed to be perfect, of which nothing is stated."""
    stated = {*campaign.accelerometers[name].priors, *campaign.model.priors}
    symbols = [
        considered.symbol
        for considered in second.fit.model.considered
        if considered.symbol not in stated
        and considered.symbol not in INPUTS
        and (considered.prior[1] == 0.0 or considered.symbol in campaign.model.terms)
    ]
    return tuple(dict.fromkeys(symbols))


def inseparable_sums(
    view: AccelerometerView, second: SecondStage, coefficients: Mapping[str, Coefficient]
) -> list[ConfoundedTerms]:
    """Return the sums of collinear terms that the estimates really determine."""
    sets = []
    for symbol in second.symbols:
        inseparable = second.alike(symbol, unstated_considered(view.campaign, view.name, second))
        if not inseparable:
            continue
        coefficient = coefficients[symbol]
        value, u = second.estimate(symbol)
        if coefficient.estimated and coefficient.value is not None and coefficient.u is not None:
            value, u = coefficient.value, coefficient.u
        weights = {symbol: 1.0, **inseparable}
        model = second.fit.model
        parameters = {
            parameter.symbol: parameter for parameter in (*model.considered, *model.unknowns)
        }
        sizes = [parameters[name].limit + parameters[name].nominal for name in weights]
        sets.append(
            ConfoundedTerms(
                terms=list(weights),
                # Estimates of terms that act the same way work against each other.
                correlation=-1.0 if next(iter(inseparable.values())) > 0.0 else 1.0,
                determined=format_combination(
                    list(weights), list(weights.values()), [0.1 * u / size for size in sizes]
                ),
                weights=list(weights.values()),
                value=value,
                u=u,
            )
        )
    return sets


def check_two_stage(
    view: AccelerometerView,
    second: SecondStage,
    coefficients: Mapping[str, Coefficient],
    model: str,
) -> list[Finding]:
    """Return the findings against one accelerometer's coefficients by one of the models."""
    all_findings, name = [], view.name
    if model == "as-printed":
        text = (
            "This result uses the equations as printed in the paper. Their K_II term is twice the "
            "exact one, so the estimate is half the true K_II. Use the exact model for a "
            "calibration."
        )
        all_findings.append(Finding(code="as-printed", subject=name, text=text))
    else:
        all_findings += [
            not_determined_finding(
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
        all_findings.append(
            Finding(code="collinear", subject=f"{name}.{a}", text=text, size=abs(r))
        )
    misfit = _check_run_agreement(name, second)
    if model == "exact":
        conflicts = list(find_prior_conflict(view))
        # The misfit is what a wrong prior makes, unless there is more than one mistake.
        all_findings += [finding.model_copy(update={"explains": misfit}) for finding in conflicts]
        misfit = [] if conflicts else misfit
    all_findings += misfit
    lost_strobes = sum(parabola.strobes.lost for parabola in second.parabolas)
    if lost_strobes:
        text = f"{lost_strobes} strobes coincided with gaps in the record and were omitted."
        all_findings.append(Finding(code="strobes-lost", subject=name, text=text))
    return all_findings


def check_strobe_noise(
    view: AccelerometerView, residual: Residual, sigma: float
) -> Iterator[Finding]:
    """Yield the finding that strobes scatter by less than the stated noise of a sample, in m."""
    p, level = residual.lack_of_fit_p, CHI_SQUARE_SIGNIFICANCE / len(view.campaign.accelerometers)
    if p is None or residual.chi2 is None or p <= 1.0 - level:
        return
    ratio = math.sqrt(max(residual.chi2, _LEAST_SQUARES) / residual.dof)
    text = (
        f"The scatter of the strobes is only {format_number(ratio, 2)} times the stated noise: "
        f"{format_number(ratio * sigma, 2)} m instead of {format_number(sigma, 2)} m. "
        "The value of u is therefore too large. Check the stated noise, or let counterspin "
        "estimate the noise."
    )
    yield Finding(code="wrong-noise", subject=view.name, text=text, size=1.0 / ratio)


def _check_run_agreement(name: str, second: SecondStage) -> list[Finding]:
    fit = second.fit
    dof = len(fit.blocks) - int(np.sum(np.isinf(fit.solution.prior_sd)))
    # What is held may be off by as much as is stated of it, or is typical.
    chi2 = fit.solution_with_considered.chi2 - sum(block.rss for block in fit.blocks)
    # Without weights the sum of squares is not distributed like chi-square.
    if dof < 1 or not second.weighted or chi2 <= 0.0:
        return []
    probability = chi_square_tail(dof, chi2)
    if probability > _SMALLEST_P:
        return []
    worst = fit.design_blocks[int(np.argmax(np.abs(second.misfit)))].run
    size = equivalent_deviations(probability)
    text = (
        f"The runs are not consistent with the model (chi-square {chi2:.1f} with {dof} degrees "
        f"of freedom, p = {probability:.1g}; {worst} deviates most). Either a term is missing, "
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

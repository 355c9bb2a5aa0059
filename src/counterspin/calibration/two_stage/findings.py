"""Findings on a two-stage result."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Final

import numpy as np

from counterspin.calibration.accelerometer_view import AccelerometerView
from counterspin.calibration.checks.priors import find_prior_conflict
from counterspin.calibration.findings import (
    CONTRADICTION_SIGMAS,
    not_determined_finding,
    two_sided_z,
)
from counterspin.calibration.model import is_requested
from counterspin.calibration.result_parts import Coefficient, Finding, Residual
from counterspin.campaign.description import Campaign
from counterspin.inference.diagnostics import CHI_SQUARE_SIGNIFICANCE
from counterspin.inference.distributions import chi_square_tail
from counterspin.inference.identifiability import ConfoundedTerms, format_combination
from counterspin.inference.two_stage.second_stage import SecondStage
from counterspin.physics.terms import INPUTS
from counterspin.reports.numbers import format_number

#: p-value below which the runs are not consistent.
_MIN_P: Final = 0.001

#: Lower limit of chi-square, for strobes without noise.
_MIN_CHI2: Final = 1e-12


def unstated_considered_symbols(
    campaign: Campaign, name: str, second_stage: SecondStage
) -> tuple[str, ...]:
    """Return the considered terms without stated priors that are requested or assumed perfect."""
    stated_symbols = {*campaign.accelerometers[name].priors, *campaign.model.priors}
    symbols = [
        considered_term.symbol
        for considered_term in second_stage.fit.model.considered
        if considered_term.symbol not in stated_symbols
        and considered_term.symbol not in INPUTS
        and (considered_term.prior[1] == 0.0 or considered_term.symbol in campaign.model.terms)
    ]
    return tuple(dict.fromkeys(symbols))


def inseparable_sums(
    view: AccelerometerView, second_stage: SecondStage, coefficients: Mapping[str, Coefficient]
) -> list[ConfoundedTerms]:
    """Return the combinations of collinear terms that the estimates determine."""
    confounded_sets = []
    for symbol in second_stage.symbols:
        inseparable_weights = second_stage.alike(
            symbol, unstated_considered_symbols(view.campaign, view.name, second_stage)
        )
        if not inseparable_weights:
            continue
        coefficient = coefficients[symbol]
        value, u = second_stage.estimate(symbol)
        if coefficient.estimated and coefficient.value is not None and coefficient.u is not None:
            value, u = coefficient.value, coefficient.u
        weights = {symbol: 1.0, **inseparable_weights}
        model = second_stage.fit.model
        parameters = {
            parameter.symbol: parameter for parameter in (*model.considered, *model.unknowns)
        }
        limits = [parameters[name].limit + parameters[name].nominal for name in weights]
        confounded_sets.append(
            ConfoundedTerms(
                terms=list(weights),
                # Terms with the same effect have negatively correlated estimates.
                correlation=-1.0 if next(iter(inseparable_weights.values())) > 0.0 else 1.0,
                determined=format_combination(
                    list(weights), list(weights.values()), [0.1 * u / limit for limit in limits]
                ),
                weights=list(weights.values()),
                value=value,
                u=u,
            )
        )
    return confounded_sets


def check_two_stage(
    view: AccelerometerView,
    second_stage: SecondStage,
    coefficients: Mapping[str, Coefficient],
    model: str,
) -> list[Finding]:
    """Return the findings on one accelerometer's coefficients."""
    findings, name = [], view.name
    if model == "as-printed":
        text = (
            "This result uses the equations as printed in the paper. Their K_II term is twice the "
            "exact one, so the estimate is half the true K_II. Use the exact model for a "
            "calibration."
        )
        findings.append(Finding(code="as-printed", subject=name, text=text))
    else:
        findings += [
            not_determined_finding(
                f"{name}.{symbol}",
                symbol,
                "runs",
                is_requested=is_requested(view.campaign, symbol, name),
            )
            for symbol in second_stage.symbols
            if coefficients[symbol].value is None
        ]
    for first_symbol, second_symbol, r in second_stage.near_collinear:
        text = (
            f"The columns of {first_symbol} and {second_symbol} are nearly collinear at these "
            f"rates (correlation {r:.4f})."
        )
        findings.append(
            Finding(code="collinear", subject=f"{name}.{first_symbol}", text=text, size=abs(r))
        )
    misfits = _check_run_agreement(name, second_stage)
    if model == "exact":
        conflicts = list(find_prior_conflict(view))
        # A wrong prior causes the misfit, unless there is more than one mistake.
        findings += [finding.model_copy(update={"explains": misfits}) for finding in conflicts]
        misfits = [] if conflicts else misfits
    findings += misfits
    lost_strobes = sum(parabola.strobes.lost for parabola in second_stage.parabolas)
    if lost_strobes:
        text = f"{lost_strobes} strobes coincided with gaps in the record and were omitted."
        findings.append(Finding(code="strobes-lost", subject=name, text=text))
    return findings


def check_strobes(view: AccelerometerView, residual: Residual, sigma: float) -> Iterator[Finding]:
    """Yield a finding if the scatter of the strobes is below the stated noise; sigma: m."""
    p, alpha = residual.lack_of_fit_p, CHI_SQUARE_SIGNIFICANCE / len(view.campaign.accelerometers)
    if p is None or residual.chi2 is None or p <= 1.0 - alpha:
        return
    noise_ratio = math.sqrt(max(residual.chi2, _MIN_CHI2) / residual.dof)
    text = (
        f"The scatter of the strobes is only {format_number(noise_ratio, 2)} times the stated "
        f"noise: {format_number(noise_ratio * sigma, 2)} m instead of {format_number(sigma, 2)} m. "
        "The value of u is therefore too large. Check the stated noise, or let counterspin "
        "estimate the noise."
    )
    yield Finding(code="wrong-noise", subject=view.name, text=text, size=1.0 / noise_ratio)


def _check_run_agreement(name: str, second_stage: SecondStage) -> list[Finding]:
    fit = second_stage.fit
    dof = len(fit.blocks) - int(np.sum(np.isinf(fit.solution.prior_sd)))
    # Considered terms may deviate by their prior uncertainty.
    chi2 = fit.solution_with_considered.chi2 - sum(block.rss for block in fit.blocks)
    # An unweighted sum of squares does not have a chi-square distribution.
    if dof < 1 or not second_stage.weighted or chi2 <= 0.0:
        return []
    p = chi_square_tail(dof, chi2)
    if p > _MIN_P:
        return []
    worst_run = fit.design_blocks[int(np.argmax(np.abs(second_stage.misfit)))].run
    z = two_sided_z(p)
    text = (
        f"The runs are not consistent with the model (chi-square {chi2:.1f} with {dof} degrees "
        f"of freedom, p = {p:.1g}; {worst_run} deviates most). Either a term is missing, "
        "a prior is wrong, or the noise is larger than stated."
    )
    return [
        Finding(
            code="lack-of-fit",
            subject=name,
            text=text,
            size=z,
            contradicts=z > CONTRADICTION_SIGMAS,
        )
    ]

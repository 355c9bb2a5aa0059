"""Comparison of the test methods of an accelerometer: at rest, arm, double turntable."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from counterspin.calibration.accelerometer_view import AccelerometerView
from counterspin.calibration.findings import (
    CONTRADICTION_SIGMAS,
    RESIDUAL_RATIO_LIMIT,
    method_test_level,
    two_sided_z,
)
from counterspin.calibration.model import SQUARE_TERMS
from counterspin.calibration.outcome import summarize_group_residuals
from counterspin.calibration.result_parts import Coefficient, Finding, MethodAgreement, Shift
from counterspin.frozen import frozen
from counterspin.inference.distributions import chi_square_tail, normal_cdf
from counterspin.inference.identifiability import assess
from counterspin.inference.joint.unknowns import unit_of
from counterspin.inference.least_squares import Solution
from counterspin.readings.agreement import MethodFit, compare_motions
from counterspin.readings.reading_groups import groups_of_view
from counterspin.reports.numbers import find_display_unit, format_number

#: Motion -> name of the test method.
_NAMES: Final[Mapping[str, str]] = {
    "counter-rotating": "double turntable",
    "arm": "arm",
    "static": "at rest",
    "vibration": "vibration",
    "poses": "poses",
}


@frozen
class MethodComparison:
    """Comparison of the test methods of an accelerometer."""

    #: Estimate of each method alone, and its agreement with the others; empty for a single method.
    results: list[MethodAgreement]
    findings: list[Finding]  #: A finding if the methods do not agree.
    #: View for tests of the residuals: if the methods disagree, with the fit of each method alone,
    #: because the disagreement has a finding of its own.
    residual_view: AccelerometerView


def compare_methods(views: Sequence[AccelerometerView]) -> dict[str, MethodComparison]:
    """Return accelerometer -> comparison of its test methods."""
    method_fits = compare_motions(views[0].fit)
    methods = {}
    for view in views:
        counts = _count_by_motion(view)
        if len(counts) < 2:
            methods[view.name] = MethodComparison([], [], view)
            continue
        results = [
            _method_agreement(view, motion, count, method_fits[motion])
            for motion, count in counts.items()
        ]
        separate_view = view.select_groups(
            [
                group.evaluate(method_fits[group.readings.motion].own_fit)
                for group in groups_of_view(view)
            ]
        )
        findings = _disagreement_findings(view, results, _residual_ratio(separate_view))
        methods[view.name] = MethodComparison(
            results, findings, _select_record_fit(separate_view, method_fits) if findings else view
        )
    return methods


def _select_record_fit(
    view: AccelerometerView, method_fits: Mapping[str, MethodFit]
) -> AccelerometerView:
    """Return a view with the fit of the records alone."""
    if not view.fit.design_blocks:
        return view
    record_fit = method_fits["counter-rotating"].own_fit
    return replace(view, estimate=replace(view.estimate, fit=record_fit))


def _count_by_motion(view: AccelerometerView) -> dict[str, int]:
    """Return motion -> number of records and readings of an accelerometer."""
    counts: dict[str, int] = {}
    if view.has_records:
        counts["counter-rotating"] = sum(1 for _ in view.records())
    for group in groups_of_view(view):
        motion = group.readings.motion
        counts[motion] = counts.get(motion, 0) + group.readings.size
    return counts


def _method_agreement(
    view: AccelerometerView, motion: str, count: int, method_fit: MethodFit
) -> MethodAgreement:
    is_determined_alone, is_determined_without = (
        _find_determined(view, solution)
        for solution in (method_fit.own_fit.solution, method_fit.other_solution)
    )
    if motion == "static" and not _has_square_terms(view):
        # At rest, the squared components add up to g^2, so K_II includes K_PP and K_OO.
        is_determined_alone["K_II"] = False
    return MethodAgreement(
        kind=_NAMES[motion],
        count=count,
        coefficients={
            symbol: _coefficient(
                view, method_fit.own_fit.solution, symbol, is_determined_alone[symbol]
            )
            for symbol in view.indices
        },
        without={
            symbol: _method_shift(method_fit, index)
            for symbol, index in view.indices.items()
            if is_determined_without[symbol] and math.isfinite(method_fit.u_shift[index])
        },
        chi2=method_fit.chi2,
        dof=method_fit.dof,
        p=chi_square_tail(method_fit.dof, method_fit.chi2) if method_fit.dof else None,
    )


def _find_determined(view: AccelerometerView, solution: Solution) -> dict[str, bool]:
    """Return symbol of an accelerometer's own term -> whether a solution determines it."""
    unknowns = view.fit.model.unknowns
    names = [unknown.name for unknown in view.fit.model.of_interest]
    is_determined = assess(solution, names).determined
    return {symbol: is_determined[unknowns[index].name] for symbol, index in view.indices.items()}


def _has_square_terms(view: AccelerometerView) -> bool:
    """Return whether the model has the square terms that 1 g cannot separate from K_II."""
    model = view.fit.model
    terms = {
        parameter.symbol
        for parameter in (*model.unknowns, *model.considered)
        if parameter.owner == view.name
    }
    return terms >= {*SQUARE_TERMS}


def _coefficient(
    view: AccelerometerView, solution: Solution, symbol: str, is_determined: bool
) -> Coefficient:
    index = view.indices[symbol]
    unknown = view.fit.model.unknowns[index]
    return Coefficient(
        value=float(solution.estimate[index]) + unknown.nominal if is_determined else None,
        u=float(solution.u[index]) if is_determined else None,
        unit=unit_of(symbol),
        estimated=is_determined,
    )


def _method_shift(method_fit: MethodFit, index: int) -> Shift:
    shift, u = float(method_fit.shift[index]), float(method_fit.u_shift[index])
    return Shift(shift=shift, u=u, z=shift / u)


def _disagreement_findings(
    view: AccelerometerView, methods: Sequence[MethodAgreement], residual_ratio: float
) -> list[Finding]:
    """Return a finding if the test methods do not agree; it names the most deviating method.

    All tests of all methods share the significance level. If the residuals far exceed the stated
    noise, which has a finding of its own, the differences are divided by the same ratio.
    """
    deviations = [
        abs(shift.z) / residual_ratio for method in methods for shift in method.without.values()
    ]
    deviations += [
        two_sided_z(chi_square_tail(method.dof, method.chi2 / residual_ratio**2))
        for method in methods
        if method.p is not None
    ]
    max_deviation = max(deviations, default=0.0)
    if 2.0 * normal_cdf(-max_deviation) >= method_test_level(methods):
        return []
    # Omitting the method with the largest chi-square reduces the disagreement most.
    worst_method = max(methods, key=lambda method: method.chi2)
    symbol_of_shift = max(
        worst_method.without, key=lambda symbol: abs(worst_method.without[symbol].z), default=""
    )
    other_kinds = " and ".join(
        alternative.kind for alternative in methods if alternative is not worst_method
    )
    text = f"The test methods are not consistent: {worst_method.kind} compared with {other_kinds}"
    if symbol_of_shift:
        unit, factor = find_display_unit(unit_of(symbol_of_shift))
        shift = worst_method.without[symbol_of_shift]
        text += (
            f". Omitting {worst_method.kind} shifts {symbol_of_shift} by "
            f"{format_number(shift.shift * factor, 2)} {unit}, "
            f"{format_number(abs(shift.z), 2)} times the standard uncertainty of the shift"
        )
    return [
        Finding(
            code="kinds-disagree",
            subject=f"{view.name}.{symbol_of_shift}" if symbol_of_shift else view.name,
            text=f"{text}. Look for an effect in one of the test methods that is missing from "
            "the model.",
            size=max_deviation,
            contradicts=max_deviation > CONTRADICTION_SIGMAS,
        )
    ]


def _residual_ratio(view: AccelerometerView) -> float:
    """Return the ratio of residuals to stated noise if it is large, else 1."""
    ratios = [1.0]
    for group in groups_of_view(view):
        residual = summarize_group_residuals([group])
        if residual.chi2 is not None and residual.dof > 0.0:
            ratios.append(math.sqrt(residual.chi2 / residual.dof))
    if view.has_records and view.diagnostics.noise_given:
        ratios.append(math.sqrt(view.diagnostics.chi2 / view.diagnostics.dof))
    max_ratio = float(np.max(ratios))
    return max_ratio if max_ratio > RESIDUAL_RATIO_LIMIT else 1.0

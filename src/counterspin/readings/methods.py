"""The test methods of one accelerometer beside each other: at rest, arm, double turntable."""

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

#: What the methods are called, by motion.
_NAMES: Final[Mapping[str, str]] = {
    "counter-rotating": "double turntable",
    "arm": "arm",
    "static": "at rest",
    "vibration": "vibration",
    "poses": "poses",
}


@frozen
class MethodComparison:
    """The test methods of one accelerometer."""

    #: What each says alone, and how far it agrees with the others; empty where there is one only.
    results: list[MethodAgreement]
    findings: list[Finding]  #: One where they do not agree.
    #: The accelerometer as its residuals are to be tested: where the methods disagree, by the fit
    #: of each method alone, since the disagreement is a finding of its own.
    residual_view: AccelerometerView


def compare_methods(views: Sequence[AccelerometerView]) -> dict[str, MethodComparison]:
    """Return by accelerometer what each test method says."""
    compared = compare_motions(views[0].fit)
    methods = {}
    for view in views:
        counts = _count_by_motion(view)
        if len(counts) < 2:
            methods[view.name] = MethodComparison([], [], view)
            continue
        results = [
            _method_agreement(view, motion, count, compared[motion])
            for motion, count in counts.items()
        ]
        separate = view.select_groups(
            [
                group.evaluate(compared[group.readings.motion].alone)
                for group in groups_of_view(view)
            ]
        )
        findings = _disagreement_findings(view, results, _residual_ratio(separate))
        methods[view.name] = MethodComparison(
            results, findings, _with_record_fit(separate, compared) if findings else view
        )
    return methods


def _with_record_fit(
    view: AccelerometerView, compared: Mapping[str, MethodFit]
) -> AccelerometerView:
    """Return a view, whose readings are fitted apart, in which records are too."""
    if not view.fit.design_blocks:
        return view
    recorded = compared["counter-rotating"].alone
    return replace(view, estimate=replace(view.estimate, fit=recorded))


def _count_by_motion(view: AccelerometerView) -> dict[str, int]:
    """Return by motion how many records and readings an accelerometer has."""
    counts: dict[str, int] = {}
    if view.has_records:
        counts["counter-rotating"] = sum(1 for _ in view.records())
    for part in groups_of_view(view):
        motion = part.readings.motion
        counts[motion] = counts.get(motion, 0) + part.readings.size
    return counts


def _method_agreement(
    view: AccelerometerView, motion: str, count: int, compared: MethodFit
) -> MethodAgreement:
    alone, without = (
        _determined(view, solution) for solution in (compared.alone.solution, compared.without)
    )
    if motion == "static" and not _has_square_terms(view):
        # At rest the squares' sum is that of gravity: what K_II seems to be is K_PP and K_OO too.
        alone["K_II"] = False
    return MethodAgreement(
        kind=_NAMES[motion],
        count=count,
        coefficients={
            symbol: _coefficient(view, compared.alone.solution, symbol, alone[symbol])
            for symbol in view.indices
        },
        without={
            symbol: _method_shift(compared, index)
            for symbol, index in view.indices.items()
            if without[symbol] and math.isfinite(compared.u_shift[index])
        },
        chi2=compared.chi2,
        dof=compared.dof,
        p=chi_square_tail(compared.dof, compared.chi2) if compared.dof else None,
    )


def _determined(view: AccelerometerView, solution: Solution) -> dict[str, bool]:
    """Return which of an accelerometer's own terms a solution determines."""
    unknowns = view.fit.model.unknowns
    names = [unknown.name for unknown in view.fit.model.of_interest]
    flags = assess(solution, names).determined
    return {symbol: flags[unknowns[index].name] for symbol, index in view.indices.items()}


def _has_square_terms(view: AccelerometerView) -> bool:
    """Return whether the model says something of the squares that 1 g cannot tell from K_II."""
    model = view.fit.model
    terms = {
        parameter.symbol
        for parameter in (*model.unknowns, *model.considered)
        if parameter.owner == view.name
    }
    return terms >= {*SQUARE_TERMS}


def _coefficient(
    view: AccelerometerView, alone: Solution, symbol: str, determined: bool
) -> Coefficient:
    index = view.indices[symbol]
    unknown = view.fit.model.unknowns[index]
    return Coefficient(
        value=float(alone.estimate[index]) + unknown.nominal if determined else None,
        u=float(alone.u[index]) if determined else None,
        unit=unit_of(symbol),
        estimated=determined,
    )


def _method_shift(compared: MethodFit, index: int) -> Shift:
    shift, u = float(compared.shift[index]), float(compared.u_shift[index])
    return Shift(shift=shift, u=u, z=shift / u)


def _disagreement_findings(
    view: AccelerometerView, methods: Sequence[MethodAgreement], excess: float
) -> list[Finding]:
    """Return a finding where the test methods do not agree; it names the one that is odd.

    All tests of all methods share the significance. Where residuals are far beyond the stated
    noise, which is a finding of its own, the differences are taken to be too large by as much.
    """
    sizes = [abs(shift.z) / excess for method in methods for shift in method.without.values()]
    sizes += [
        two_sided_z(chi_square_tail(method.dof, method.chi2 / excess**2))
        for method in methods
        if method.p is not None
    ]
    size = max(sizes, default=0.0)
    if 2.0 * normal_cdf(-size) >= method_test_level(methods):
        return []
    # Without the one of the largest chi-square the others are least at odds among themselves.
    method = max(methods, key=lambda method: method.chi2)
    symbol_of_shift = max(
        method.without, key=lambda symbol: abs(method.without[symbol].z), default=""
    )
    other_kinds = " and ".join(
        alternative.kind for alternative in methods if alternative is not method
    )
    text = f"The test methods are not consistent: {method.kind} compared with {other_kinds}"
    if symbol_of_shift:
        unit, factor = find_display_unit(unit_of(symbol_of_shift))
        shift = method.without[symbol_of_shift]
        text += (
            f". Omitting {method.kind} shifts {symbol_of_shift} by "
            f"{format_number(shift.shift * factor, 2)} {unit}, "
            f"{format_number(abs(shift.z), 2)} times the standard uncertainty of the shift"
        )
    return [
        Finding(
            code="kinds-disagree",
            subject=f"{view.name}.{symbol_of_shift}" if symbol_of_shift else view.name,
            text=f"{text}. Look for an effect in one of the test methods that is missing from "
            "the model.",
            size=size,
            contradicts=size > CONTRADICTION_SIGMAS,
        )
    ]


def _residual_ratio(view: AccelerometerView) -> float:
    """Return how many times as large as the stated noise the residuals are, where that is much."""
    ratios = [1.0]
    for group in groups_of_view(view):
        residual = summarize_group_residuals([group])
        if residual.chi2 is not None and residual.dof > 0.0:
            ratios.append(math.sqrt(residual.chi2 / residual.dof))
    if view.has_records and view.diagnostics.noise_given:
        ratios.append(math.sqrt(view.diagnostics.chi2 / view.diagnostics.dof))
    largest = float(np.max(ratios))
    return largest if largest > RESIDUAL_RATIO_LIMIT else 1.0

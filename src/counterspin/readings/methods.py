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
    equivalent_deviations,
    method_test_level,
)
from counterspin.calibration.model import SQUARES
from counterspin.calibration.outcome import residual_of
from counterspin.calibration.result_parts import Coefficient, Finding, MethodAgreement, Shift
from counterspin.frozen import frozen
from counterspin.inference.distributions import chi_square_tail, normal_cdf
from counterspin.inference.identifiability import assess
from counterspin.inference.joint.unknowns import unit_of
from counterspin.inference.least_squares import Solution
from counterspin.readings.agreement import OneMethod, agreements
from counterspin.readings.parts import parts_of
from counterspin.reports.numbers import field_unit, format_number

#: What the methods are called, by motion.
_NAMES: Final[Mapping[str, str]] = {
    "counter-rotating": "double turntable",
    "arm": "arm",
    "static": "at rest",
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
    compared = agreements(views[0].fit)
    methods = {}
    for view in views:
        own = _counts(view)
        if len(own) < 2:
            methods[view.name] = MethodComparison([], [], view)
            continue
        results = [_method(view, motion, count, compared[motion]) for motion, count in own.items()]
        apart = view.with_groups(
            [part.evaluate(compared[part.readings.motion].alone) for part in parts_of(view)]
        )
        findings = _disagreement(view, results, _excess(apart))
        methods[view.name] = MethodComparison(
            results, findings, _apart(apart, compared) if findings else view
        )
    return methods


def _apart(view: AccelerometerView, compared: Mapping[str, OneMethod]) -> AccelerometerView:
    """Return a view, whose readings are fitted apart, in which records are too."""
    if not view.fit.prepared:
        return view
    recorded = compared["counter-rotating"].alone
    return replace(view, estimate=replace(view.estimate, fit=recorded))


def _counts(view: AccelerometerView) -> dict[str, int]:
    """Return by motion how many records and readings an accelerometer has."""
    counts: dict[str, int] = {}
    if view.has_records:
        counts["counter-rotating"] = sum(1 for _ in view.records())
    for part in parts_of(view):
        motion = part.readings.motion
        counts[motion] = counts.get(motion, 0) + part.readings.size
    return counts


def _method(
    view: AccelerometerView, motion: str, count: int, compared: OneMethod
) -> MethodAgreement:
    alone, without = (_determined(view, s) for s in (compared.alone.solution, compared.without))
    if motion == "static" and not _squares_known(view):
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
            symbol: _shift(compared, place)
            for symbol, place in view.indices.items()
            if without[symbol] and math.isfinite(compared.u_shift[place])
        },
        chi2=compared.chi2,
        dof=compared.dof,
        p=chi_square_tail(compared.dof, compared.chi2) if compared.dof else None,
    )


def _determined(view: AccelerometerView, solution: Solution) -> dict[str, bool]:
    """Return which of an accelerometer's own terms a solution determines."""
    unknowns = view.fit.model.unknowns
    asked = [unknown.name for unknown in view.fit.model.asked]
    determined = assess(solution, asked).determined
    return {symbol: determined[unknowns[place].name] for symbol, place in view.indices.items()}


def _squares_known(view: AccelerometerView) -> bool:
    """Return whether the model says something of the squares that 1 g cannot tell from K_II."""
    model = view.fit.model
    terms = {t.symbol for t in (*model.unknowns, *model.considered) if t.owner == view.name}
    return terms >= {*SQUARES}


def _coefficient(
    view: AccelerometerView, alone: Solution, symbol: str, determined: bool
) -> Coefficient:
    place = view.indices[symbol]
    unknown = view.fit.model.unknowns[place]
    return Coefficient(
        value=float(alone.estimate[place]) + unknown.nominal if determined else None,
        u=float(alone.u[place]) if determined else None,
        unit=unit_of(symbol),
        estimated=determined,
    )


def _shift(compared: OneMethod, place: int) -> Shift:
    shift, u = float(compared.shift[place]), float(compared.u_shift[place])
    return Shift(shift=shift, u=u, z=shift / u)


def _disagreement(
    view: AccelerometerView, methods: Sequence[MethodAgreement], excess: float
) -> list[Finding]:
    """Return a finding where the test methods do not agree; it names the one that is odd.

    All tests of all methods share the significance. Where residuals are far beyond the stated
    noise, which is a finding of its own, the differences are taken to be too large by as much.
    """
    sizes = [abs(shift.z) / excess for method in methods for shift in method.without.values()]
    sizes += [
        equivalent_deviations(chi_square_tail(method.dof, method.chi2 / excess**2))
        for method in methods
        if method.p is not None
    ]
    size = max(sizes, default=0.0)
    if 2.0 * normal_cdf(-size) >= method_test_level(methods):
        return []
    # Without the one of the largest chi-square the others are least at odds among themselves.
    method = max(methods, key=lambda method: method.chi2)
    moved = max(method.without, key=lambda symbol: abs(method.without[symbol].z), default="")
    others = " and ".join(other.kind for other in methods if other is not method)
    text = f"The test methods do not agree: {method.kind} against {others}"
    if moved:
        unit, factor = field_unit(unit_of(moved))
        shift = method.without[moved]
        text += (
            f". Without {method.kind}, {moved} moves by {format_number(shift.shift * factor, 2)} "
            f"{unit}, {format_number(abs(shift.z), 2)} times the standard uncertainty of the shift"
        )
    return [
        Finding(
            code="kinds-disagree",
            subject=f"{view.name}.{moved}" if moved else view.name,
            text=f"{text}. Look for an effect in one test method that the model lacks.",
            size=size,
            contradicts=size > CONTRADICTION_SIGMAS,
        )
    ]


def _excess(view: AccelerometerView) -> float:
    """Return how many times as large as the stated noise the residuals are, where that is much."""
    ratios = [1.0]
    for part in parts_of(view):
        residual = residual_of([part])
        if residual.chi2 is not None and residual.dof > 0.0:
            ratios.append(math.sqrt(residual.chi2 / residual.dof))
    if view.has_records and view.diagnostics.noise_given:
        ratios.append(math.sqrt(view.diagnostics.chi2 / view.diagnostics.dof))
    worst = float(np.max(ratios))
    return worst if worst > RESIDUAL_RATIO_LIMIT else 1.0

"""Checks that drifts and tilts of the platform stay within the first-order theory."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.calibration.result_parts import AccelerometerResult, Coefficient, Finding
from counterspin.campaign.description import Campaign
from counterspin.inference.joint.unknowns import Unknown
from counterspin.physics.terms import ARCSEC, DEGREE_PER_HOUR, PLATFORM_TERMS, TERMS
from counterspin.reports.numbers import find_display_unit, format_number

#: Drift (deg/h) times time squared (s^2) at which the first-order attitude model errs by 0.01 m.
_FIRST_ORDER_LIMIT: Final = 0.2 * 400.0**2


def check_drifts(coefficients: Mapping[Unknown, Coefficient], duration: float) -> list[Finding]:
    """Return the findings on drifts of the platform; duration: of the longest run, s."""
    findings = []
    for unknown, coefficient in coefficients.items():
        if unknown.symbol in TERMS:
            continue
        if unknown.symbol.startswith("platform.drift") and coefficient.value is not None:
            findings += _drift_finding(unknown.symbol, coefficient, duration)
    return findings


def _drift_finding(symbol: str, drift: Coefficient, duration: float) -> list[Finding]:
    """Return a finding if a drift plus 2 u exceeds the limit of the first-order model."""
    rate, u = (abs(value or 0.0) / DEGREE_PER_HOUR for value in (drift.value, drift.u))
    limit = _FIRST_ORDER_LIMIT / duration**2
    if rate + 2.0 * u <= limit:
        return []
    clause = f"is {rate:.2g} deg/h" if rate > limit else f"may reach {rate + 2.0 * u:.2g} deg/h"
    text = (
        f"{symbol} {clause} (u {u:.1g} deg/h). In runs of {duration:.0f} s, the first-order "
        f"model of the platform attitude is valid only for drifts up to about {limit:.2g} "
        "deg/h."
    )
    return [Finding(code="large-drift", subject=symbol, text=text, size=(rate + 2.0 * u) / limit)]


def check_tilts(
    campaign: Campaign,
    coefficients_by_run: Mapping[str, Mapping[str, Coefficient]],
    accelerometers: Mapping[str, AccelerometerResult],
) -> list[Finding]:
    """Return the findings on tilts whose second-order effect may exceed u.

    With the tilt psi, the platform senses f - psi x f + psi x (psi x f)/2 + ... The design columns
    contain neither the third term nor the effect of the second one on a_I^2. Along the input axis,
    these effects resemble a scale factor, (psi_I^2 - psi^2)/2 and 2 K_II (psi x g)_I/g, and a bias,
    psi_I psi_up/2.
    """
    worst_findings: dict[str, Finding] = {}
    for run in campaign.runs:
        tilt = _largest_tilt(campaign, coefficients_by_run.get(run.name, {}))
        if not tilt.any():
            continue
        for name, accelerometer in accelerometers.items():
            axis = campaign.accelerometers[name].mounting.turned(run.attitude).input_axis
            k_ii = accelerometer.coefficients.get("K_II")
            abs_k_ii = abs(k_ii.value or 0.0) if k_ii is not None else 0.0
            for symbol, shift in _second_order_shifts(tilt, np.abs(axis), abs_k_ii).items():
                coefficient = accelerometer.coefficients.get(symbol)
                if (
                    coefficient is None
                    or not coefficient.estimated
                    or not coefficient.u
                    or shift <= coefficient.u
                ):
                    continue
                finding = _tilt_finding(run.name, tilt, f"{name}.{symbol}", shift, coefficient)
                previous_finding = worst_findings.get(finding.subject)
                if previous_finding is None or (previous_finding.size or 0.0) < (
                    finding.size or 0.0
                ):
                    worst_findings[finding.subject] = finding
    return list(worst_findings.values())


def _largest_tilt(campaign: Campaign, coefficients: Mapping[str, Coefficient]) -> Array:
    """Return the largest likely tilt about each axis, |value| + 2 u, rad, shape (3,)."""
    tilt = np.zeros(3)
    for symbol, row in PLATFORM_TERMS.items():
        if row.effect.kind != "tilt":
            continue
        coefficient = coefficients.get(symbol)
        if symbol in campaign.model.considered:
            prior = campaign.model.priors[symbol]
            tilt[row.effect.axis] = abs(prior.value) + 2.0 * prior.u
        elif coefficient is not None and coefficient.value is not None:
            tilt[row.effect.axis] = abs(coefficient.value) + 2.0 * (coefficient.u or 0.0)
    return tilt


def _second_order_shifts(tilt: Array, axis: Array, abs_k_ii: float) -> dict[str, float]:
    """Return the second-order shift of K_I and of K_F for magnitudes of tilt and input axis."""
    projection = float(tilt @ axis)
    cross_term = float(tilt[0] * axis[1] + tilt[1] * axis[0])  # of (psi x g)/g
    return {
        "K_I": 0.5 * max(float(tilt @ tilt) - projection**2, 0.0) + 2.0 * abs_k_ii * cross_term,
        "K_F": 0.5 * projection * float(tilt[2]),
    }


def _tilt_finding(
    run: str, tilt_vector: Array, subject: str, shift: float, coefficient: Coefficient
) -> Finding:
    assert coefficient.u
    ratio = shift / coefficient.u
    arcsec = float(np.linalg.norm(tilt_vector)) / ARCSEC
    unit, factor = find_display_unit(coefficient.unit)
    text = (
        f"The tilt in {run} may reach {arcsec:.3g} arcsec (estimate plus 2 u). The second-order "
        f"effect of this tilt shifts {subject} by up to {format_number(shift * factor, 2)} "
        f"{unit}, or {format_number(ratio, 2)} u({subject}). The first-order model is valid "
        f"only for tilts up to about {arcsec / math.sqrt(ratio):.2g} arcsec."
    )
    return Finding(code="large-tilt", subject=subject, text=text, size=ratio)

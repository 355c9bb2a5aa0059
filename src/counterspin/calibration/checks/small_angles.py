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

#: Drift (deg/h) times time squared (s^2) at which first order in the attitude errs by 0.01 m.
_FIRST_ORDER_LIMIT: Final = 0.2 * 400.0**2


def check_drifts(coefficients: Mapping[Unknown, Coefficient], longest: float) -> list[Finding]:
    """Return the findings on drifts of the platform; `longest` run in s."""
    findings = []
    for unknown, c in coefficients.items():
        if unknown.symbol in TERMS:
            continue
        if unknown.symbol.startswith("platform.drift") and c.value is not None:
            findings += _drift_finding(unknown.symbol, c, longest)
    return findings


def _drift_finding(symbol: str, drift: Coefficient, longest: float) -> list[Finding]:
    """Return a finding where a drift is, or with its uncertainty may be, too large."""
    rate, u = (abs(rate_value or 0.0) / DEGREE_PER_HOUR for rate_value in (drift.value, drift.u))
    limit = _FIRST_ORDER_LIMIT / longest**2
    if rate + 2.0 * u <= limit:
        return []
    clause = f"is {rate:.2g} deg/h" if rate > limit else f"may reach {rate + 2.0 * u:.2g} deg/h"
    text = (
        f"{symbol} {clause} (u {u:.1g} deg/h). In runs of {longest:.0f} s, the first-order "
        f"model of the platform attitude is valid only for drifts up to about {limit:.2g} "
        "deg/h."
    )
    return [Finding(code="large-drift", subject=symbol, text=text, size=(rate + 2.0 * u) / limit)]


def check_tilts(
    campaign: Campaign,
    runs: Mapping[str, Mapping[str, Coefficient]],
    accelerometers: Mapping[str, AccelerometerResult],
) -> list[Finding]:
    """Return a finding where a tilt is, or with its uncertainty may be, too large.

    With the tilt psi the platform senses f - psi x f + psi x (psi x f)/2 + ... The last of these
    is not in the columns, nor is what the second moves of a_I^2. Along the input axis they look
    like a scale factor, (psi_I^2 - psi^2)/2 and 2 K_II (psi x g)_I/g, and like a bias,
    psi_I psi_up/2.
    """
    worst_findings: dict[str, Finding] = {}
    for run in campaign.runs:
        tilt = _largest_tilt(campaign, runs.get(run.name, {}))
        if not tilt.any():
            continue
        for name, accelerometer in accelerometers.items():
            axis = campaign.accelerometers[name].mounting.turned(run.attitude).input_axis
            k_ii = accelerometer.coefficients.get("K_II")
            square = abs(k_ii.value or 0.0) if k_ii is not None else 0.0
            for symbol, shift in _second_order_shifts(tilt, np.abs(axis), square).items():
                c = accelerometer.coefficients.get(symbol)
                if c is None or not c.estimated or not c.u or shift <= c.u:
                    continue
                finding = _tilt_finding(run.name, tilt, f"{name}.{symbol}", shift, c)
                previous = worst_findings.get(finding.subject)
                if previous is None or (previous.size or 0.0) < (finding.size or 0.0):
                    worst_findings[finding.subject] = finding
    return list(worst_findings.values())


def _largest_tilt(campaign: Campaign, estimated: Mapping[str, Coefficient]) -> Array:
    """Return the largest likely tilt about each axis, |value| + 2 u, rad, shape (3,)."""
    tilt = np.zeros(3)
    for symbol, row in PLATFORM_TERMS.items():
        if row.effect.kind != "tilt":
            continue
        coefficient = estimated.get(symbol)
        if symbol in campaign.model.considered:
            prior = campaign.model.priors[symbol]
            tilt[row.effect.axis] = abs(prior.value) + 2.0 * prior.u
        elif coefficient is not None and coefficient.value is not None:
            tilt[row.effect.axis] = abs(coefficient.value) + 2.0 * (coefficient.u or 0.0)
    return tilt


def _second_order_shifts(tilt: Array, axis: Array, square: float) -> dict[str, float]:
    """Return by coefficient what the second order moves it by, for sizes along all axes."""
    projection = float(tilt @ axis)
    cross_term = float(tilt[0] * axis[1] + tilt[1] * axis[0])  # of (psi x g)/g
    return {
        "K_I": 0.5 * max(float(tilt @ tilt) - projection**2, 0.0) + 2.0 * square * cross_term,
        "K_F": 0.5 * projection * float(tilt[2]),
    }


def _tilt_finding(
    run: str, size: Array, subject: str, shift: float, coefficient: Coefficient
) -> Finding:
    assert coefficient.u
    ratio = shift / coefficient.u
    tilt = float(np.linalg.norm(size)) / ARCSEC
    unit, factor = find_display_unit(coefficient.unit)
    text = (
        f"The tilt in {run} may reach {tilt:.3g} arcsec (estimate plus 2 u). The second-order "
        f"effect of this tilt shifts {subject} by up to {format_number(shift * factor, 2)} "
        f"{unit}, or {format_number(ratio, 2)} u({subject}). The first-order model is valid "
        f"only for tilts up to about {tilt / math.sqrt(ratio):.2g} arcsec."
    )
    return Finding(code="large-tilt", subject=subject, text=text, size=ratio)

"""Conversion of the coefficients of a result: frames, uncertainties, GTC, and short text.

The packages are optional; a function raises MissingPackageError if its package is missing.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from counterspin.arrays import Array
from counterspin.characters import escape_controls
from counterspin.errors import MissingPackageError
from counterspin.reports.numbers import find_display_unit
from counterspin.reports.publication import MAX_CELL_LINES
from counterspin.results import make_frame

if TYPE_CHECKING:
    import polars as pl

    from counterspin.calibration.result import Result
    from counterspin.calibration.result_parts import Coefficient


#: Largest number of characters of a finding in a line.
_LINE_CHARACTERS: Final = 100


def coefficient_frame(result: Result, library: str = "polars") -> Any:
    """Return the coefficients as a frame, in the units of the field."""
    return rows_frame(result.rows(), library)


def residual_frame(tables: Sequence[Mapping[str, Any]]) -> pl.DataFrame:
    """Return the residuals of all records as a frame; columns as in `Result.residuals`."""
    import polars as pl

    residuals = pl.concat([pl.DataFrame(table) for table in tables])
    return residuals.with_columns(pl.col("whitened").fill_nan(None))


def rows_frame(rows: Iterable[tuple[str, str, Coefficient]], library: str) -> Any:
    """Return owners, symbols and coefficients as a frame, in the units of the field."""
    columns: dict[str, list[Any]] = {
        name: []
        for name in (
            *("owner", "term", "value", "u", "unit"),
            *("low", "high", "u_unstated", "dof", "estimated"),
        )
    }
    for owner, symbol, coefficient in rows:
        unit, factor = find_display_unit(coefficient.unit)
        is_determined = (
            coefficient.estimated and coefficient.value is not None and coefficient.u is not None
        )
        low, high = coefficient.interval() if is_determined else (None, None)
        numbers = (coefficient.value, coefficient.u, low, high, coefficient.u_unstated)
        value, u, low, high, u_unstated = (
            None if number is None else number * factor for number in numbers
        )
        row = (
            owner,
            symbol,
            value,
            u,
            unit,
            low,
            high,
            u_unstated,
            coefficient.dof,
            coefficient.estimated,
        )
        for column, cell in zip(columns.values(), row, strict=True):
            column.append(cell)
    return make_frame(columns, ("value", "u", "low", "high", "u_unstated", "dof"), library)


def summarize(result: Result) -> str:
    """Return title, state, coefficients and the most severe finding in at most 20 lines."""
    heading = (
        f"{result.title or 'Calibration'}: {result.method} method, {result.state or 'not judged'}"
    )
    named_coefficients = [
        (f"{owner}.{symbol}" if owner else symbol, str(coefficient))
        for owner, symbol, coefficient in result.rows()
    ]
    width = max((len(name) for name, _ in named_coefficients), default=0)
    lines = [f"{name.ljust(width)}  {text}" for name, text in named_coefficients]
    findings = [f"{finding.subject}: {finding.text}" for finding in result.findings]
    remarks = [escape_controls(text[:_LINE_CHARACTERS]) for text in findings[:1]]
    if len(findings) > 1:
        noun = "finding" if len(findings) == 2 else "findings"
        remarks.append(f"... {len(findings) - 1} more {noun}")
    max_lines = MAX_CELL_LINES - 1 - len(remarks)
    if len(lines) > max_lines:
        lines[max_lines - 1 :] = [
            f"... {len(lines) - max_lines + 1} more coefficients; .table() returns all of them"
        ]
    return "\n".join([escape_controls(heading), *map(escape_controls, lines), *remarks])


def _import_package(name: str, distribution: str) -> Any:
    try:
        return import_module(name)
    except ModuleNotFoundError as error:
        raise MissingPackageError(
            f"{distribution} is not installed: `pip install {distribution}`"
        ) from error


def to_uncertainties(result: Result) -> dict[str, Any]:
    """Return the determined coefficients as ``uncertainties`` variables, by name (``Qx.K_II``)."""
    package = _import_package("uncertainties", "uncertainties")
    covariance = result.stated_covariance()
    values = [result.coefficient(name).value for name in covariance.terms]
    numbers = package.correlated_values(values, covariance.matrix, tags=covariance.terms)
    return dict(zip(covariance.terms, numbers, strict=True))


def to_gtc(result: Result) -> dict[str, Any]:
    """Return the determined coefficients as GTC's uncertain numbers, by name (``Qx.K_II``).

    In GTC, correlated numbers with finite degrees of freedom must have the same number of them.
    Therefore, each coefficient is a sum of independent components, which the coefficients share.
    Each component is the sum of two: one with one degree of freedom, and one with infinitely many.
    Their shares are such that the Welch-Satterthwaite formula of GTC returns the degrees of freedom
    of each coefficient. If the correlations do not allow this, GTC returns fewer degrees of
    freedom, never more, and at least 1. The degrees of freedom of a function of several
    coefficients are an approximation.
    """
    package = _import_package("GTC", "GTC")
    covariance = result.stated_covariance()
    coefficients = [result.coefficient(name) for name in covariance.terms]
    u = np.sqrt(np.diag(covariance.matrix))
    dof = np.array(
        [
            math.inf if coefficient.dof is None else max(1.0, coefficient.dof)
            for coefficient in coefficients
        ]
    )
    correlation_root = _correlation_root(covariance.matrix / np.outer(u, u), dof)
    finite_shares = _finite_dof_shares(correlation_root, dof)
    finite_indices = np.flatnonzero(finite_shares)
    finite_components = package.multiple_ureal(
        [0.0] * finite_indices.size, np.sqrt(finite_shares[finite_indices]).tolist(), 1.0
    )
    numbers = {}
    for name, coefficient, row in zip(
        covariance.terms, coefficients, u[:, None] * correlation_root, strict=True
    ):
        number = package.constant(coefficient.value)
        for index, component in zip(finite_indices, finite_components, strict=True):
            number += float(row[index]) * component
        numbers[name] = number
    for index in np.flatnonzero(finite_shares < 1.0):
        component = package.ureal(0.0, math.sqrt(1.0 - finite_shares[index]))
        for name, weight in zip(covariance.terms, u * correlation_root[:, index], strict=True):
            numbers[name] += float(weight) * component
    return {name: package.result(number, label=name) for name, number in numbers.items()}


def _correlation_root(correlation: Array, dof: Array) -> Array:
    """Return a square root L of the correlation, L L^T, with a row for each coefficient.

    L is triangular if the coefficients are in descending order of degrees of freedom, so that a
    coefficient with few degrees of freedom has a component that the others do not have.
    """
    dof_order = np.argsort(-dof)
    eigenvalues, eigenvectors = np.linalg.eigh(correlation[np.ix_(dof_order, dof_order)])
    half_matrix = eigenvectors * np.sqrt(np.maximum(eigenvalues, 0.0))
    root = np.empty_like(half_matrix)
    _, upper_triangle = np.linalg.qr(half_matrix.T)
    root[dof_order] = upper_triangle.T
    # Normalise the rows, because of rounding and clipped negative eigenvalues.
    rows: Array = root / np.linalg.norm(root, axis=1)[:, None]
    return rows


def _finite_dof_shares(correlation_root: Array, dof: Array) -> Array:
    """Return the variance share of each component with one degree of freedom, from 0 to 1.

    If the share s of the variance of a coefficient has one degree of freedom and the remainder
    infinitely many, it has 1/s^2 by the Welch-Satterthwaite formula. s is linear in the shares.
    """
    from scipy.optimize import linprog

    required_shares = 1.0 / np.sqrt(dof)
    squares = correlation_root**2
    weights = 1.0 / np.maximum(required_shares, 1e-6)
    solution = linprog(weights @ squares, A_ub=-squares, b_ub=-required_shares, bounds=(0.0, 1.0))
    shares: Array = np.where(solution.x > 1e-12, np.minimum(solution.x, 1.0), 0.0)
    return shares

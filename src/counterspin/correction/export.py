"""`counterspin export`: write the coefficients of a result for other programs."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from counterspin.arrays import Array
from counterspin.calibration.findings import judge_result, refusal_reason
from counterspin.calibration.result import Result
from counterspin.calibration.result_parts import TriadResult
from counterspin.characters import escape_controls
from counterspin.correction.instrument import add_unstated_terms, applicable_terms, make_instrument
from counterspin.correction.related import cross_covariances
from counterspin.correction.workbook import Cell, make_workbook
from counterspin.errors import CampaignError, RecordError, UsageError
from counterspin.frozen import frozen
from counterspin.inference.distributions import finite_dof
from counterspin.output import (
    FileType,
    check_writable,
    contains_bytes,
    file_mark,
    marked_file_type,
    write_atomically,
)
from counterspin.physics.terms import TABLE, TERMS

Normalisation = Literal["none", "ieee"]
Form = Literal["coefficients", "psins", "kalibr", "ros"]

_COLUMN_NAMES: Final = ("accelerometer", "coefficient", "value", "u", "unit", "dof", "origin")

_FILE_DESCRIPTION: Final = "an export of a result"

_FILE_TYPE: Final = FileType(
    f"{_FILE_DESCRIPTION} written by counterspin",
    lambda path: (
        marked_file_type(_FILE_DESCRIPTION).recognises(path)
        or contains_bytes(",".join(_COLUMN_NAMES).encode())(path)
    ),
)

#: Factors of all products and conditions, so that every default prior is part of the table.
_ALL_FACTORS: Final = ("I", "|I|", "sign_I", "P", "O", "temperature")


@frozen(eq=False)
class CoefficientTable:
    """Coefficients of all accelerometers with their covariance, n of them."""

    accelerometers: tuple[str, ...]
    symbols: tuple[str, ...]
    values: Array  # (n,)
    covariance: Array  # (n, n)
    units: tuple[str, ...]
    dof: tuple[float | None, ...]  #: Effective degrees of freedom; None: infinite.
    origins: tuple[str, ...]  #: ``estimated`` or ``prior``.

    @property
    def names(self) -> list[str]:
        """Names such as ``Qx.K_II``."""
        return [
            f"{accelerometer}.{symbol}"
            for accelerometer, symbol in zip(self.accelerometers, self.symbols, strict=True)
        ]

    def rows(self) -> Iterator[list[Cell]]:
        """Yield a row for each coefficient, with the columns of the header."""
        u = np.sqrt(np.diag(self.covariance))
        for i, accelerometer in enumerate(self.accelerometers):
            values = self.symbols[i], float(self.values[i]), float(u[i]), self.units[i]
            yield [accelerometer, *values, self.dof[i], self.origins[i]]


def export(
    result: Result,
    output: Path | str,
    *,
    normalisation: Normalisation = "none",
    form: Form = "coefficients",
    noise: tuple[float, float] | None = None,
    overwrite: bool = False,
) -> None:
    """Write the coefficients of a result in the form of another program.

    Parameters
    ----------
    result
        Result of a calibration.
    output
        File to write: .csv, .xlsx or .mat for ``coefficients``, .mat for ``psins``, .yaml for
        ``kalibr`` and ``ros``.
    normalisation
        ``ieee``: coefficients of IEEE Std 1293, normalised by K_I (K2 = K_II/K_I).
    form
        ``coefficients``: all coefficients with covariance. Other forms require a triad.
    noise
        Noise density, m/s^2/Hz^0.5, and random walk of the bias, m/s^2/s^0.5, for ``kalibr``.
    overwrite
        Whether to replace an earlier export; other files are never replaced.

    Raises
    ------
    CampaignError
        If ending, form and normalisation do not match, or the result has no triad.
    RecordError
        If the records contradict the result, or do not determine the matrix of the triad.
    CounterspinError
        If the output cannot be written.
    """
    output = Path(output)
    suffix = output.suffix.lower()
    suffixes = {"coefficients": _COEFFICIENT_FILES, "psins": (".mat",)}.get(form, (".yaml", ".yml"))
    if suffix not in suffixes:
        raise CampaignError(
            str(output),
            [f"must end in {'one of ' if len(suffixes) > 1 else ''}{', '.join(suffixes)}"],
            code="wrong-file-ending",
        )
    if normalisation == "ieee" and form != "coefficients":
        raise UsageError("export", [f"`normalisation` does not apply to the format {form}"])
    if (noise is not None) != (form == "kalibr"):
        raise UsageError(
            "export",
            [
                (
                    "`noise` is required for the format kalibr, and cannot be used with any "
                    "other format"
                )
            ],
        )
    if result.model == "as-printed":
        raise CampaignError(
            "export",
            [
                "the result was computed with the equations as printed, which yield half the "
                "true K_II; calibrate again with the exact model"
            ],
            code="as-printed",
        )
    if (reason := refusal_reason(judge_result(result), result.accelerometers)) is not None:
        raise RecordError(reason, code="contradicted")
    check_writable(output, lambda: _FILE_TYPE, overwrite=overwrite)
    if form == "coefficients":
        table = coefficient_table(result)
        if normalisation == "ieee":
            table = normalise(table, result)
        content = _COEFFICIENT_FILES[suffix](table, result)
    else:
        content = _triad_content(form, _determined_triad(result), result.inputs.gravity, noise)
    write_atomically(
        output, lambda path: path.write_bytes(content), lambda: _FILE_TYPE, overwrite=overwrite
    )


def coefficient_table(result: Result) -> CoefficientTable:
    """Return all coefficients that have a value: estimates, stated priors, default priors."""
    full_result, _ = add_unstated_terms(result, _ALL_FACTORS)
    instruments = [make_instrument(full_result, name) for name in full_result.accelerometers]
    terms = list(map(applicable_terms, full_result.accelerometers.values()))
    offsets = np.cumsum([0, *(len(instrument.coefficients) for instrument in instruments)])
    covariance = np.zeros((offsets[-1], offsets[-1]))
    blocks = {(i, i): instrument.covariance for i, instrument in enumerate(instruments)}
    for (i, j), block in (blocks | cross_covariances(full_result, instruments)).items():
        rows, columns = slice(offsets[i], offsets[i + 1]), slice(offsets[j], offsets[j + 1])
        covariance[rows, columns] = block
        covariance[columns, rows] = block.T
    covariance = 0.5 * (covariance + covariance.T)
    entries = [
        (i, symbol, value, terms[i][symbol])
        for i, instrument in enumerate(instruments)
        for symbol, value in instrument.coefficients.items()
    ]
    symbol_ranks = {symbol: k for k, symbol in enumerate(TABLE)}
    order = sorted(range(len(entries)), key=lambda k: (entries[k][0], symbol_ranks[entries[k][1]]))
    entries = [entries[k] for k in order]
    return CoefficientTable(
        accelerometers=tuple(instruments[i].name for i, _, _, _ in entries),
        symbols=tuple(symbol for _, symbol, _, _ in entries),
        values=np.array([value for _, _, value, _ in entries]),
        covariance=covariance[np.ix_(order, order)],
        units=tuple(coefficient.unit for _, _, _, coefficient in entries),
        dof=tuple(coefficient.dof for _, _, _, coefficient in entries),
        origins=tuple(
            "estimated" if coefficient.estimated else "prior" for _, _, _, coefficient in entries
        ),
    )


def normalise(table: CoefficientTable, result: Result) -> CoefficientTable:
    """Return the coefficients of IEEE Std 1293: K1 = K_I, all others divided by K_I.

    Temperature slopes are omitted. If the result states a nominal sensitivity, K1 is in units
    of the output per g.
    """
    indices = {name: i for i, name in enumerate(table.names)}
    kept_indices = [i for i, symbol in enumerate(table.symbols) if symbol in TERMS]
    jacobian = np.zeros((len(kept_indices), len(indices)))
    values = table.values[kept_indices].copy()
    units = [table.units[i] for i in kept_indices]
    for row, i in enumerate(kept_indices):
        accelerometer = table.accelerometers[i]
        nominal = result.accelerometers[accelerometer].nominal
        k_i_index = indices.get(f"{accelerometer}.K_I")
        scale = 1.0 if k_i_index is None else float(table.values[k_i_index])
        if i == k_i_index:
            factor = 1.0 if nominal is None else nominal.sensitivity
            units[row] = units[row] if nominal is None else f"{nominal.unit}/g"
        else:
            factor = 1.0 / scale
            if k_i_index is not None:
                jacobian[row, k_i_index] = -values[row] / scale**2
        jacobian[row, i] = factor
        values[row] *= factor
    # Welch-Satterthwaite: sum of u^4 over degrees of freedom (GUM G.4.1).
    u4_per_dof = [
        0.0 if dof is None else variance**2 / dof
        for variance, dof in zip(np.diag(table.covariance), table.dof, strict=True)
    ]
    product_covariance = jacobian @ table.covariance @ jacobian.T
    covariance = 0.5 * (product_covariance + product_covariance.T)
    u4_sums = jacobian**4 @ np.array(u4_per_dof)
    return replace(
        table,
        accelerometers=tuple(table.accelerometers[i] for i in kept_indices),
        symbols=tuple(TERMS[table.symbols[i]].effect.ieee_symbol for i in kept_indices),
        values=values,
        covariance=covariance,
        units=tuple(units),
        dof=tuple(
            finite_dof(variance**2 / u4_sum) if u4_sum else None
            for variance, u4_sum in zip(np.diag(covariance).tolist(), u4_sums.tolist(), strict=True)
        ),
        origins=tuple(table.origins[i] for i in kept_indices),
    )


# Files of coefficients


def _csv_content(table: CoefficientTable, _: Result) -> bytes:
    """Return a CSV file whose last columns are the covariance."""
    import polars as pl

    columns: dict[str, list[Any]] = {
        name: list(column)
        for name, column in zip(_COLUMN_NAMES, zip(*table.rows(), strict=True), strict=True)
    }
    covariance = zip(table.names, table.covariance.tolist(), strict=True)
    return (
        pl.DataFrame(columns | {f"cov {name}": column for name, column in covariance})
        .write_csv()
        .encode()
    )


def _xlsx_content(table: CoefficientTable, result: Result) -> bytes:
    names = table.names
    sheets: dict[str, list[Sequence[Cell]]] = {
        "coefficients": [_COLUMN_NAMES, *table.rows()],
        "covariance": [
            ("", *names),
            *((name, *row) for name, row in zip(names, table.covariance.tolist(), strict=True)),
        ],
        "result": [*_result_metadata(result).items()],
    }
    triad = result.triad
    if triad is not None and triad.matrix is not None and triad.bias is not None:
        names = triad.accelerometers
        sheets["triad"] = [("accelerometer", "bias", *(f"matrix {name}" for name in names))]
        for name, bias, row in zip(names, triad.bias, triad.matrix, strict=True):
            sheets["triad"].append((name, bias, *row))
    return make_workbook(sheets, file_mark(_FILE_DESCRIPTION))


def _mat_content(table: CoefficientTable, result: Result) -> bytes:
    """Return a MAT file with a structure; columns of text are cell arrays."""
    rows = [np.array(column, dtype=object)[:, None] for column in zip(*table.rows(), strict=True)]
    structure: dict[str, Any] = dict(zip(_COLUMN_NAMES, rows, strict=True))
    structure |= {
        name: np.array(
            [np.inf if value is None else value for value in structure[name][:, 0]], float
        )[:, None]
        for name in ("value", "u", "dof")
    }
    structure |= {"covariance": table.covariance, "result": _result_metadata(result)}
    if result.triad is not None and result.triad.matrix is not None:
        triad = result.triad
        structure["triad"] = {
            "accelerometers": np.array(triad.accelerometers, dtype=object)[:, None],
            "matrix": np.array(triad.matrix),
            "u_matrix": np.array(triad.u_matrix),
            "bias": np.array(triad.bias)[:, None],
        }
    return _mat_file_content({"counterspin": structure})


def _mat_file_content(variables: dict[str, Any]) -> bytes:
    from scipy.io import savemat

    stream = io.BytesIO()
    savemat(stream, variables | {"written_by": file_mark(_FILE_DESCRIPTION)})
    # The header contains the time of writing.
    return b"MATLAB 5.0 MAT-file".ljust(116) + stream.getvalue()[116:]


def _result_metadata(result: Result) -> dict[str, Cell]:
    return {
        "title": escape_controls(result.title),
        "version": result.provenance.version,
        "method": result.method,
        "state": result.state or "",
        "gravity": result.inputs.gravity,
    }


_COEFFICIENT_FILES: Final[dict[str, Callable[[CoefficientTable, Result], bytes]]] = {
    ".csv": _csv_content,
    ".xlsx": _xlsx_content,
    ".mat": _mat_content,
}

# Triads: f = matrix (y - bias)


def _determined_triad(result: Result) -> TriadResult:
    triad = result.triad
    if triad is None:
        raise CampaignError(
            "export",
            ["this format requires a triad, but the result has none"],
            code="missing-in-result",
        )
    if triad.matrix is None or triad.bias is None:
        reason = triad.why_no_matrix or "The result contains no correction matrix."
        raise RecordError(f"the triad has no matrix: {reason}", code="missing-in-result")
    return triad


def _triad_content(
    form: Form, triad: TriadResult, gravity: float, noise: tuple[float, float] | None
) -> bytes:
    """Return a file with the linear correction of a triad for another program.

    Forces are in m/s^2 in the file, and in g in the result.
    """
    matrix, bias = np.array(triad.matrix), np.array(triad.bias)
    offset = matrix @ bias * gravity
    if form == "psins":
        return _mat_file_content({"clbt": {"Ka": matrix, "db": offset[:, None]}})
    lines = [
        f"# {file_mark(_FILE_DESCRIPTION)}",
        f"# accelerometers: {json.dumps(triad.accelerometers)}",
    ]
    if form == "ros":
        lines += [
            "# corrected = SM*raw - bias, m/s^2",
            f"SM: {_format_yaml(matrix.ravel().tolist())}",
            f"bias: {_format_yaml(offset.tolist())}",
        ]
    else:
        assert noise is not None
        lines += [
            "# raw = M*force + bias; Kalibr estimates the bias",
            f"accelerometer_noise_density: {_format_yaml(noise[0])}",
            f"accelerometer_random_walk: {_format_yaml(noise[1])}",
            f"accelerometers: {{M: {_format_yaml(np.linalg.inv(matrix).tolist())}}}",
            "# add: gyroscope_noise_density, gyroscope_random_walk, rostopic, update_rate",
        ]
    return ("\n".join(lines) + "\n").encode()


def _format_yaml(value: Any) -> str:
    """Return numbers as YAML 1.1, in which a number with an exponent has a decimal point."""
    if isinstance(value, list):
        return f"[{', '.join(map(_format_yaml, value))}]"
    mantissa, exponent_mark, exponent = repr(float(value)).partition("e")
    return f"{mantissa}{'' if '.' in mantissa else '.0'}{exponent_mark}{exponent}"

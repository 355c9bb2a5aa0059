"""`counterspin export`: the coefficients of a result, for other programs."""

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
from counterspin.correction.instrument import instrument_of, terms_of, with_unstated
from counterspin.correction.related import cross_covariances
from counterspin.correction.workbook import Cell, workbook
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

_HEADER: Final = ("accelerometer", "coefficient", "value", "u", "unit", "dof", "origin")

_WORDS: Final = "an export of a result"

_KIND: Final = FileType(
    f"{_WORDS} written by counterspin",
    lambda path: (
        marked_file_type(_WORDS).recognises(path)
        or contains_bytes(",".join(_HEADER).encode())(path)
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
        return [f"{a}.{s}" for a, s in zip(self.accelerometers, self.symbols, strict=True)]

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
        A calibration's result.
    output
        File to write: .csv, .xlsx or .mat for ``coefficients``, .mat for ``psins``, .yaml for
        ``kalibr`` and ``ros``.
    normalisation
        ``ieee``: coefficients of IEEE Std 1293, which are divided by K_I (K2 = K_II/K_I).
    form
        ``coefficients``: all coefficients with covariance. The others need a triad.
    noise
        Noise density, m/s^2/Hz^0.5, and random walk of the bias, m/s^2/s^0.5, for ``kalibr``.
    overwrite
        Whether an earlier export may be replaced; nothing else is.

    Raises
    ------
    CampaignError
        If ending, form and normalisation do not fit, or the result has no triad.
    RecordError
        If the records contradict the result, or do not determine the triad's matrix.
    CounterspinError
        If the output cannot be written.
    """
    output = Path(output)
    suffix = output.suffix.lower()
    endings = {"coefficients": _COEFFICIENT_FILES, "psins": (".mat",)}.get(form, (".yaml", ".yml"))
    if suffix not in endings:
        raise CampaignError(
            str(output), [f"must end in one of {', '.join(endings)}"], code="wrong-file-ending"
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
    check_writable(output, lambda: _KIND, overwrite=overwrite)
    if form == "coefficients":
        table = coefficient_table(result)
        if normalisation == "ieee":
            table = normalise(table, result)
        content = _COEFFICIENT_FILES[suffix](table, result)
    else:
        content = _triad_content(form, _determined_triad(result), result.inputs.gravity, noise)
    write_atomically(
        output, lambda part: part.write_bytes(content), lambda: _KIND, overwrite=overwrite
    )


def coefficient_table(result: Result) -> CoefficientTable:
    """Return all coefficients that have a value: estimates, stated priors, default priors."""
    completed, _ = with_unstated(result, _ALL_FACTORS)
    instruments = [instrument_of(completed, name) for name in completed.accelerometers]
    terms = [terms_of(accelerometer) for accelerometer in completed.accelerometers.values()]
    starts = np.cumsum([0, *(len(instrument.coefficients) for instrument in instruments)])
    covariance = np.zeros((starts[-1], starts[-1]))
    blocks = {(i, i): instrument.covariance for i, instrument in enumerate(instruments)}
    for (i, j), block in (blocks | cross_covariances(completed, instruments)).items():
        rows, columns = slice(starts[i], starts[i + 1]), slice(starts[j], starts[j + 1])
        covariance[rows, columns] = block
        covariance[columns, rows] = block.T
    covariance = 0.5 * (covariance + covariance.T)
    listed = [
        (i, symbol, value, terms[i][symbol])
        for i, instrument in enumerate(instruments)
        for symbol, value in instrument.coefficients.items()
    ]
    rank = {symbol: k for k, symbol in enumerate(TABLE)}
    order = sorted(range(len(listed)), key=lambda k: (listed[k][0], rank[listed[k][1]]))
    listed = [listed[k] for k in order]
    return CoefficientTable(
        accelerometers=tuple(instruments[i].name for i, _, _, _ in listed),
        symbols=tuple(symbol for _, symbol, _, _ in listed),
        values=np.array([value for _, _, value, _ in listed]),
        covariance=covariance[np.ix_(order, order)],
        units=tuple(c.unit for _, _, _, c in listed),
        dof=tuple(c.dof for _, _, _, c in listed),
        origins=tuple("estimated" if c.estimated else "prior" for _, _, _, c in listed),
    )


def normalise(table: CoefficientTable, result: Result) -> CoefficientTable:
    """Return the coefficients of IEEE Std 1293: K1 = K_I, all others divided by K_I.

    Slopes with temperature are left out. If the result states a nominal sensitivity, K1 is in units
    of the output per g.
    """
    indices = {name: i for i, name in enumerate(table.names)}
    kept = [i for i, symbol in enumerate(table.symbols) if symbol in TERMS]
    jacobian, values = np.zeros((len(kept), len(indices))), table.values[kept].copy()
    units = [table.units[i] for i in kept]
    for row, i in enumerate(kept):
        accelerometer = table.accelerometers[i]
        nominal = result.accelerometers[accelerometer].nominal
        k_i = indices.get(f"{accelerometer}.K_I")
        scale = 1.0 if k_i is None else float(table.values[k_i])
        if i == k_i:
            factor = 1.0 if nominal is None else nominal.sensitivity
            units[row] = units[row] if nominal is None else f"{nominal.unit}/g"
        else:
            factor = 1.0 / scale
            if k_i is not None:
                jacobian[row, k_i] = -values[row] / scale**2
        jacobian[row, i] = factor
        values[row] *= factor
    # Each independent noise has the fourth power of its u over its degrees of freedom (GUM G.4.1).
    u4_per_dof = [
        0.0 if dof is None else variance**2 / dof
        for variance, dof in zip(np.diag(table.covariance), table.dof, strict=True)
    ]
    product = jacobian @ table.covariance @ jacobian.T
    covariance = 0.5 * (product + product.T)
    sums = jacobian**4 @ np.array(u4_per_dof)
    return replace(
        table,
        accelerometers=tuple(table.accelerometers[i] for i in kept),
        symbols=tuple(TERMS[table.symbols[i]].effect.ieee_symbol for i in kept),
        values=values,
        covariance=covariance,
        units=tuple(units),
        dof=tuple(
            finite_dof(variance**2 / total) if total else None
            for variance, total in zip(np.diag(covariance).tolist(), sums.tolist(), strict=True)
        ),
        origins=tuple(table.origins[i] for i in kept),
    )


# Files of coefficients


def _csv(table: CoefficientTable, _: Result) -> bytes:
    """Return a table; its last columns are the covariance."""
    import polars as pl

    columns: dict[str, list[Any]] = {
        name: list(column)
        for name, column in zip(_HEADER, zip(*table.rows(), strict=True), strict=True)
    }
    covariance = zip(table.names, table.covariance.tolist(), strict=True)
    return pl.DataFrame(columns | {f"cov {n}": c for n, c in covariance}).write_csv().encode()


def _xlsx(table: CoefficientTable, result: Result) -> bytes:
    names = table.names
    sheets: dict[str, list[Sequence[Cell]]] = {
        "coefficients": [_HEADER, *table.rows()],
        "covariance": [
            ("", *names),
            *((name, *row) for name, row in zip(names, table.covariance.tolist(), strict=True)),
        ],
        "result": [*_about(result).items()],
    }
    triad = result.triad
    if triad is not None and triad.matrix is not None and triad.bias is not None:
        names = triad.accelerometers
        sheets["triad"] = [("accelerometer", "bias", *(f"matrix {name}" for name in names))]
        for name, bias, row in zip(names, triad.bias, triad.matrix, strict=True):
            sheets["triad"].append((name, bias, *row))
    return workbook(sheets, file_mark(_WORDS))


def _mat(table: CoefficientTable, result: Result) -> bytes:
    """Return a structure with columns of text as cell arrays."""
    rows = [np.array(column, dtype=object)[:, None] for column in zip(*table.rows(), strict=True)]
    structure: dict[str, Any] = dict(zip(_HEADER, rows, strict=True))
    structure |= {
        name: np.array([np.inf if v is None else v for v in structure[name][:, 0]], float)[:, None]
        for name in ("value", "u", "dof")
    }
    structure |= {"covariance": table.covariance, "result": _about(result)}
    if result.triad is not None and result.triad.matrix is not None:
        triad = result.triad
        structure["triad"] = {
            "accelerometers": np.array(triad.accelerometers, dtype=object)[:, None],
            "matrix": np.array(triad.matrix),
            "u_matrix": np.array(triad.u_matrix),
            "bias": np.array(triad.bias)[:, None],
        }
    return _mat_file({"counterspin": structure})


def _mat_file(variables: dict[str, Any]) -> bytes:
    from scipy.io import savemat

    stream = io.BytesIO()
    savemat(stream, variables | {"written_by": file_mark(_WORDS)})
    # The header contains the time of writing.
    return b"MATLAB 5.0 MAT-file".ljust(116) + stream.getvalue()[116:]


def _about(result: Result) -> dict[str, Cell]:
    return {
        "title": escape_controls(result.title),
        "version": result.provenance.version,
        "method": result.method,
        "state": result.state or "",
        "gravity": result.inputs.gravity,
    }


_COEFFICIENT_FILES: Final[dict[str, Callable[[CoefficientTable, Result], bytes]]] = {
    ".csv": _csv,
    ".xlsx": _xlsx,
    ".mat": _mat,
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
        why = triad.why_no_matrix or "The result contains no correction matrix."
        raise RecordError(f"the triad has no matrix: {why}", code="missing-in-result")
    return triad


def _triad_content(
    form: Form, triad: TriadResult, gravity: float, noise: tuple[float, float] | None
) -> bytes:
    """Return the linear correction of a triad in the form of another program.

    Forces are in m/s^2 there, and in g in the result.
    """
    matrix, bias = np.array(triad.matrix), np.array(triad.bias)
    offset = matrix @ bias * gravity
    if form == "psins":
        return _mat_file({"clbt": {"Ka": matrix, "db": offset[:, None]}})
    lines = [f"# {file_mark(_WORDS)}", f"# accelerometers: {json.dumps(triad.accelerometers)}"]
    if form == "ros":
        lines += [
            "# corrected = SM*raw - bias, m/s^2",
            f"SM: {_yaml(matrix.ravel().tolist())}",
            f"bias: {_yaml(offset.tolist())}",
        ]
    else:
        assert noise is not None
        lines += [
            "# raw = M*force + bias; Kalibr estimates the bias",
            f"accelerometer_noise_density: {_yaml(noise[0])}",
            f"accelerometer_random_walk: {_yaml(noise[1])}",
            f"accelerometers: {{M: {_yaml(np.linalg.inv(matrix).tolist())}}}",
            "# add: gyroscope_noise_density, gyroscope_random_walk, rostopic, update_rate",
        ]
    return ("\n".join(lines) + "\n").encode()


def _yaml(value: Any) -> str:
    """Return numbers as YAML 1.1, in which a number with an exponent has a decimal point."""
    if isinstance(value, list):
        return f"[{', '.join(map(_yaml, value))}]"
    mantissa, exponent, power = repr(float(value)).partition("e")
    return f"{mantissa}{'' if '.' in mantissa else '.0'}{exponent}{power}"

"""Stated frequency responses: natural frequency and damping, or a table; cutoff of the recorder."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from counterspin.campaign.quantity import Quantity
from counterspin.campaign.validation import Problems
from counterspin.errors import InputError, OutOfRangeError
from counterspin.loading import load_name
from counterspin.physics.frequency_response import (
    CUTOFF,
    RESPONSE_INPUTS,
    FrequencyResponse,
    ResponseTable,
)

#: Columns of a table of the frequency response; the last two may be missing.
_COLUMNS: Final = ("frequency_Hz", "gain", "phase_deg")
_UNCERTAINTY_COLUMNS: Final = ("u_gain", "u_phase_deg")

#: The largest gain relative to the static gain that is plausible within the table.
_MAX_GAIN: Final = 100.0

#: Smallest ratio of a stated frequency to the highest rotation rate: the response must be smooth
#: over the harmonics of the force.
MIN_FREQUENCY_RATIO: Final = 20.0


class ResponseReader:
    """Reads the frequency responses of a description.

    folder: Folder of the response tables.
    cutoff: Stated cutoff frequency of the recorder, Hz; None: no filter.
    """

    def __init__(self, folder: Path, cutoff: Quantity | None, problems: Problems) -> None:
        self.folder, self.cutoff, self.problems = folder, cutoff, problems
        #: File -> SHA-256 of each table.
        self.checksums: dict[Path, str] = {}

    def read(self, name: str, accelerometer: Any) -> dict[str, Any]:
        """Return the private attributes of an accelerometer; none if no response is stated.

        accelerometer: Validated table of the accelerometer.
        """
        inputs: dict[str, Quantity] = {}
        response = None
        if accelerometer.frequency_response is not None:
            path = ("accelerometers", name, "frequency_response")
            file = self.folder / accelerometer.frequency_response
            table = self.problems.collect(path, self._load, file)
            if table is None:
                return {}
            response = FrequencyResponse(table=table)
            for symbol, u in (("sensor.gain", table.u_gain), ("sensor.phase", table.u_phase)):
                inputs |= {symbol: Quantity(0.0, 1.0, "1")} if u else {}
        elif accelerometer.natural_frequency is not None and accelerometer.damping is not None:
            inputs["sensor.natural_frequency"] = accelerometer.natural_frequency
            inputs["sensor.damping"] = accelerometer.damping
        if self.cutoff is not None:
            inputs[CUTOFF] = self.cutoff
        input_values = {symbol: quantity.value for symbol, quantity in inputs.items()}
        return {"response": replace_inputs(response, input_values), "response_inputs": inputs}

    def _load(self, file: Path) -> ResponseTable:
        """Load a response table from a file; ValueError if it is not a frequency response."""
        load_table = load_name("counterspin.records.formats:read_small_table")
        table, row_labels, self.checksums[file] = load_table(file)
        frame = table.frame
        if missing_columns := [column for column in _COLUMNS if column not in frame.columns]:
            raise InputError(
                f"{file.name} has no column {', '.join(missing_columns)}; a frequency response "
                f"requires the columns {', '.join(_COLUMNS)} and may have the column "
                f"{', '.join(_UNCERTAINTY_COLUMNS)}",
                "missing-column",
            )
        columns = {}
        for column in (*_COLUMNS, *_UNCERTAINTY_COLUMNS):
            if column not in frame.columns:
                continue
            values = frame[column].cast(float, strict=False).to_numpy()
            if not np.isfinite(values).all():
                row = row_labels[int(np.flatnonzero(~np.isfinite(values))[0])]
                raise InputError(f"{file.name}, {row}: {column} is not a number", "not-numeric")
            columns[column] = values
        frequency, gain = columns["frequency_Hz"], columns["gain"]
        if not frequency.size or frequency[0] <= 0.0 or np.any(np.diff(frequency) <= 0.0):
            raise OutOfRangeError(f"{file.name}: frequency_Hz must be positive and must increase")
        if np.any(gain <= 0.0) or np.any(gain > _MAX_GAIN):
            raise OutOfRangeError(
                f"{file.name}: gain must be a positive ratio to the static gain (not dB)"
            )
        if any(np.any(columns[name] < 0.0) for name in _UNCERTAINTY_COLUMNS if name in columns):
            raise OutOfRangeError(f"{file.name}: a standard uncertainty must not be negative")
        unit_factors = {name: math.radians(1.0) for name in columns if name.endswith("_deg")}
        si_columns = {
            name: tuple((unit_factors.get(name, 1.0) * values).tolist())
            for name, values in columns.items()
        }
        return ResponseTable(
            si_columns["frequency_Hz"],
            si_columns["gain"],
            si_columns["phase_deg"],
            *(si_columns.get(name, ()) for name in _UNCERTAINTY_COLUMNS),
        )


def replace_inputs(
    response: FrequencyResponse | None, input_values: Mapping[str, float]
) -> FrequencyResponse | None:
    """Return a response with new values of its inputs; None without a response and values."""
    if not input_values:
        return response
    attributes: dict[str, Any] = {
        RESPONSE_INPUTS[symbol]: value for symbol, value in input_values.items()
    }
    return replace(response or FrequencyResponse(), **attributes)


def response_problems(response: FrequencyResponse, rate: float) -> Iterator[tuple[str, str, str]]:
    """Yield section, key and message for each frequency that is too low for a rotation.

    rate: Largest rate, rad/s.
    """
    rotation_rate = abs(rate) / (2.0 * math.pi)  # rev/s
    for section, key in (("accelerometers", "natural_frequency"), ("records", "cutoff_frequency")):
        if (frequency := getattr(response, key)) < MIN_FREQUENCY_RATIO * rotation_rate:
            message = (
                f"{frequency:.4g} Hz is below {MIN_FREQUENCY_RATIO:g} times the highest rotation "
                f"rate, {rotation_rate:.3g} rev/s; the harmonics of the force would be too close "
                "to this frequency"
            )
            yield section, key, message
    if response.table is not None and response.table.frequency[-1] < rotation_rate:
        message = (
            f"ends at {response.table.frequency[-1]:.4g} Hz, which is below the highest rotation "
            f"rate, {rotation_rate:.3g} rev/s"
        )
        yield "accelerometers", "frequency_response", message

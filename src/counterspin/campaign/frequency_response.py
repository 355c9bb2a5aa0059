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
_UNCERTAINTIES: Final = ("u_gain", "u_phase_deg")

#: The largest gain relative to the static gain that is plausible within the table.
_MAX_GAIN: Final = 100.0

#: A stated frequency is at least so many times that of the fastest rotation: the response must be
#: smooth over the harmonics of the force.
MIN_RATIO: Final = 20.0


class ResponseReader:
    """Reads the frequency responses of a description.

    folder: Of the tables.
    cutoff: Stated cutoff frequency of the recorder, Hz; None: no filter.
    """

    def __init__(self, folder: Path, cutoff: Quantity | None, problems: Problems) -> None:
        self.folder, self.cutoff, self.problems = folder, cutoff, problems
        #: File -> SHA-256 of each table.
        self.checksums: dict[Path, str] = {}

    def read(self, name: str, accelerometer: Any) -> dict[str, Any]:
        """Return the private attributes of an accelerometer; none if no response is stated.

        accelerometer: Its table.
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
        stated = {symbol: known.value for symbol, known in inputs.items()}
        return {"response": with_values(response, stated), "response_inputs": inputs}

    def _load(self, file: Path) -> ResponseTable:
        """Return the table of a file; ValueError if it is not a frequency response."""
        load_table = load_name("counterspin.records.formats:read_small_table")
        table, places, self.checksums[file] = load_table(file)
        frame = table.frame
        if missing := [column for column in _COLUMNS if column not in frame.columns]:
            raise InputError(
                f"{file.name} has no column {', '.join(missing)}; a frequency response requires "
                f"the columns {', '.join(_COLUMNS)} and may have the column "
                f"{', '.join(_UNCERTAINTIES)}",
                "missing-column",
            )
        columns = {}
        for column in (*_COLUMNS, *_UNCERTAINTIES):
            if column not in frame.columns:
                continue
            values = frame[column].cast(float, strict=False).to_numpy()
            if not np.isfinite(values).all():
                row = places[int(np.flatnonzero(~np.isfinite(values))[0])]
                raise InputError(f"{file.name}, {row}: {column} is not a number", "not-numeric")
            columns[column] = values
        frequency, gain = columns["frequency_Hz"], columns["gain"]
        if not frequency.size or frequency[0] <= 0.0 or np.any(np.diff(frequency) <= 0.0):
            raise OutOfRangeError(f"{file.name}: frequency_Hz must be positive and must increase")
        if np.any(gain <= 0.0) or np.any(gain > _MAX_GAIN):
            raise OutOfRangeError(
                f"{file.name}: gain must be a positive ratio to the static gain (not dB)"
            )
        if any(np.any(columns[name] < 0.0) for name in _UNCERTAINTIES if name in columns):
            raise OutOfRangeError(f"{file.name}: a standard uncertainty must not be negative")
        scale = {name: math.radians(1.0) for name in columns if name.endswith("_deg")}
        values_of = {
            name: tuple((scale.get(name, 1.0) * values).tolist())
            for name, values in columns.items()
        }
        return ResponseTable(
            values_of["frequency_Hz"],
            values_of["gain"],
            values_of["phase_deg"],
            *(values_of.get(name, ()) for name in _UNCERTAINTIES),
        )


def with_values(
    response: FrequencyResponse | None, values: Mapping[str, float]
) -> FrequencyResponse | None:
    """Return a response with other values of its inputs; None stays without values."""
    if not values:
        return response
    attributes: dict[str, Any] = {RESPONSE_INPUTS[s]: value for s, value in values.items()}
    return replace(response or FrequencyResponse(), **attributes)


def response_problems(response: FrequencyResponse, rate: float) -> Iterator[tuple[str, str, str]]:
    """Yield section and key of each frequency that is too low for a rotation, and why.

    rate: Largest rate, rad/s.
    """
    turns = abs(rate) / (2.0 * math.pi)
    for section, key in (("accelerometers", "natural_frequency"), ("records", "cutoff_frequency")):
        if (frequency := getattr(response, key)) < MIN_RATIO * turns:
            message = (
                f"{frequency:.4g} Hz is below {MIN_RATIO:g} times the highest rotation rate, "
                f"{turns:.3g} rev/s; the harmonics of the force would be too close to this "
                "frequency"
            )
            yield section, key, message
    if response.table is not None and (last := response.table.frequency[-1]) < turns:
        message = (
            f"ends at {last:.4g} Hz, which is below the highest rotation rate, {turns:.3g} rev/s"
        )
        yield "accelerometers", "frequency_response", message

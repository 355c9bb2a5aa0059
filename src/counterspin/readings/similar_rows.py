"""Vectorised conversion of table rows that differ from a validated row only in numbers.

The model of a run validates the first row with the same keys, units and texts. The numbers of the
other rows are converted and validated as columns. A row with a number outside the limits is passed
to the model of a run, which writes the error message.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np

from counterspin.arrays import Array
from counterspin.campaign import quantity
from counterspin.campaign.quantity import HeadTurn, Quantity
from counterspin.campaign.reading import Reading
from counterspin.campaign.settings import Output
from counterspin.frozen import copy_with
from counterspin.physics.accelerometer import Mounting
from counterspin.units import OPERATING_TEMPERATURES, TEMPERATURE_SCALES, unit_factor

#: Keys whose quantities may differ among similar rows.
_NUMERIC_KEYS: Final = {"rate", "temperature", "time"}


def row_pattern(row: Mapping[str, Any]) -> Hashable:
    """Return the key that similar rows share; None for a row with non-numeric readings."""
    readings = row.get("reading")
    if not isinstance(readings, dict) or not row.get("name"):
        return None
    if not all(isinstance(reading, Quantity) for reading in readings.values()):
        return None
    cells = ((key, _cell_pattern(key, value)) for key, value in row.items() if key != "name")
    return tuple(cells)


def _cell_pattern(key: str, value: Any) -> Hashable:
    if key == "reading":
        return tuple((name, _cell_pattern("time", number)) for name, number in value.items())
    if isinstance(value, Quantity) and key in _NUMERIC_KEYS:
        return value.unit, value.value == 0.0, value.u > 0.0, value.distribution
    if isinstance(value, HeadTurn):
        return value.angle.unit, value.angle.u, value.about
    return repr(value)


def convert_rows(
    rows: Sequence[Mapping[str, Any]],
    reference_readings: Sequence[Reading],
    mountings: Mapping[str, Mounting | None],
    outputs: Mapping[str, Output | None],
    gravity: float,
) -> Iterator[tuple[Reading, ...] | None]:
    """Yield the readings of similar rows; None for a row with a number outside the limits.

    reference_readings: Readings of a similar row that was validated.
    mountings, outputs, gravity: See `resolve_readings`.
    """
    columns = _RowColumns(rows)
    common_fields = columns.common_fields()
    readings = []
    for reading in reference_readings:
        name = reading.accelerometer
        fields = dict(common_fields)
        if name in outputs:
            fields |= columns.value_fields(name, outputs[name], gravity)
        fields |= columns.axes_fields(reading, mountings[name])
        changes = (
            dict(zip(fields, row, strict=True)) for row in zip(*fields.values(), strict=True)
        )
        readings.append([copy_with(reading, change) for change in changes])
    for is_valid, row_readings in zip(columns.valid, zip(*readings, strict=True), strict=True):
        yield row_readings if is_valid else None


def attitude_keys(mounting: str, attitudes: Array) -> list[str]:
    """Return keys that readings with the same attitude and mounting share.

    attitudes: Shape (n, 3, 3).
    """
    # Adding zero makes -0 the same as 0.
    return [f"{mounting}: {rows}" for rows in (np.round(attitudes, 9) + 0.0).tolist()]


class _RowColumns:
    """Columns of n similar rows, as fields of readings."""

    def __init__(self, rows: Sequence[Mapping[str, Any]]) -> None:
        self._rows = rows
        self.valid = np.ones(len(rows), dtype=bool)  #: True for rows within the limits.

    def common_fields(self) -> dict[str, list[Any]]:
        """Return the fields that all accelerometers share."""
        first_row, fields = self._rows[0], {"name": [row["name"] for row in self._rows]}
        for key, unit in (("rate", "rad/s"), ("time", "s")):
            if isinstance(first_row.get(key), Quantity):
                value, u = self._convert([row[key] for row in self._rows], unit)
                fields |= {key: value.tolist()} | ({f"u_{key}": u.tolist()} if u[0] > 0.0 else {})
        if isinstance(first_row.get("temperature"), Quantity):
            temperatures = np.array([row["temperature"].value for row in self._rows])
            temperatures += TEMPERATURE_SCALES[first_row["temperature"].unit]
            min_temperature, max_temperature = OPERATING_TEMPERATURES
            self.valid &= (temperatures >= min_temperature) & (temperatures <= max_temperature)
            fields["temperature"] = [(temperature,) for temperature in temperatures.tolist()]
        return fields

    def value_fields(
        self, name: str, output: Output | None, gravity: float
    ) -> dict[str, list[Any]]:
        """Return the fields of the readings of an accelerometer, in g."""
        unit, zero, sensitivity = "g", 0.0, 1.0
        if output is not None:
            unit, zero, sensitivity = output.unit, output.zero, output.sensitivity
        gravity_in_unit = gravity if output is None else None
        numbers = [row["reading"][name] for row in self._rows]
        value, u = self._convert(numbers, unit, gravity_in_unit)
        fields = {"value": ((value - zero) / sensitivity).tolist()}
        if u[0] > 0.0:
            return fields | {"u": (u / abs(sensitivity)).tolist()}
        steps = (float(quantity.last_digit_step(repr(number.value))) for number in numbers)
        digits = [Quantity(step, 0.0, n.unit) for step, n in zip(steps, numbers, strict=True)]
        resolution, _ = self._convert(digits, unit, gravity_in_unit)
        return fields | {"resolution": (resolution / abs(sensitivity)).tolist()}

    def axes_fields(
        self, reference_reading: Reading, mounting: Mounting | None
    ) -> dict[str, list[Any]]:
        """Return the fields that depend on the angle of the dividing head; none without a head."""
        first_row = self._rows[0]
        if mounting is None or not isinstance(turn := first_row.get("attitude"), HeadTurn):
            return {}
        angles, _ = self._convert([row["attitude"].angle for row in self._rows], "rad")
        axis = np.array(quantity.read_direction(turn.about))
        attitudes = quantity.rotate_axes(np.where(self.valid, angles, 0.0), axis)
        axes = (mounting.matrix @ attitudes).tolist()
        fields: dict[str, list[Any]] = {
            "axes": [Mounting(tuple(map(tuple, rows)), mounting.response) for rows in axes]
        }
        if "head" not in first_row:
            fields["head_angle"] = angles.tolist()
        if reference_reading.position:
            fields["position"] = attitude_keys(first_row.get("mounting", ""), attitudes)
        return fields

    def _convert(
        self, numbers: Sequence[Quantity], unit: str, gravity: float | None = None
    ) -> tuple[Array, Array]:
        """Return values and standard uncertainties in a unit; mark rows outside the limits."""
        factor = unit_factor(numbers[0].unit, unit, gravity=gravity)
        value, u = factor * np.array([(number.value, number.u) for number in numbers]).T
        is_within = quantity.is_plausible
        self.valid &= is_within(value, unit) & is_within(u, unit) & (u >= 0.0)
        return value, u

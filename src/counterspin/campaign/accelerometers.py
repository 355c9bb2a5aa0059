"""[accelerometers.NAME]: axes, columns, priors and unit of readings."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cached_property
from typing import Annotated, Any, Final, Literal

from pydantic import (
    AfterValidator,
    ConfigDict,
    PlainValidator,
    PrivateAttr,
    ValidationInfo,
    create_model,
)

from counterspin.campaign.columns import (
    DisplacementChannel,
    ForceChannel,
    VelocityChannel,
    make_column_spec,
)
from counterspin.campaign.distribution import parse_prior
from counterspin.campaign.field_types import (
    Contradiction,
    Direction,
    Fraction,
    SettingsSection,
    Text,
    check_file_name,
    check_positive,
    key_field,
    uncertain_quantity,
)
from counterspin.campaign.frequency_response import ResponseReader, replace_inputs
from counterspin.campaign.model import check_near_nominal
from counterspin.campaign.quantity import Quantity
from counterspin.campaign.runs import is_reading
from counterspin.campaign.settings import OBSERVABLES, Output, term_keys
from counterspin.campaign.validation import Problems
from counterspin.errors import InputError, Problem, error_code
from counterspin.physics.accelerometer import Mounting
from counterspin.physics.frequency_response import RESPONSE_INPUTS, FrequencyResponse
from counterspin.physics.terms import COMMON_NAMES, TERMS
from counterspin.records.record import ColumnSpec
from counterspin.units import unit_factor

#: Keys of an accelerometer's axes on the level platform.
_AXIS_KEYS: Final = ("input_axis", "pendulous_axis", "output_axis")

#: Tables of [truth] for other objects; an accelerometer cannot have these names.
TRUTH_TABLES: Final = (
    "spindle",
    "platform",
    "centrifuge",
    "encoder",
    "table",
    "noise",
    "machine",
    "site",
    "records",
)


def _parse_sensitivity_prior(raw: object, info: ValidationInfo) -> Quantity:
    """Convert a stated sensitivity to the prior of K_I."""
    output = info.data.get("output")
    if output is None:
        if "output" in info.data:
            raise InputError(
                "also requires output = { unit = ..., sensitivity = ... }", "missing-key"
            )
        return Quantity(math.nan, 0.0, "g/g")  # the output has already been reported
    prior = parse_prior(raw, f"{output.unit}/g", gravity=None)
    u = prior.u / abs(output.sensitivity)
    return Quantity(prior.value / output.sensitivity, u, "g/g", prior.distribution)


class Accelerometer(SettingsSection):
    """One accelerometer under calibration; `AccelerometerKeys` adds a key for each term."""

    # A triad may omit the axes, which are required otherwise.
    model_config = ConfigDict(json_schema_extra=lambda schema: schema.pop("required", None))

    input_axis: Direction = key_field(
        "direction of the input axis on the level platform; may be omitted for a "
        "[triad](triads.md)",
        "east",
        kind="direction",
    )
    pendulous_axis: Direction = key_field(
        "direction of the pendulous axis, perpendicular to the input axis",
        [0, 0, -1],
        kind="direction",
    )
    output_axis: Direction | None = key_field(
        "direction of the output axis; used only to check the other two axes",
        "north",
        None,
        absent="input × pendulous",
        kind="direction",
    )
    natural_frequency: (
        Annotated[Quantity, uncertain_quantity("Hz"), AfterValidator(check_positive)] | None
    ) = key_field(
        "undamped natural frequency of the accelerometer; see "
        "[frequency response](#frequency-response)",
        "400 ± 20 Hz",
        None,
        absent="no dynamics",
    )
    damping: Fraction | None = key_field(
        "damping ratio, required with `natural_frequency`",
        "0.7 ± 0.1",
        None,
        absent="no dynamics",
        kind="number ±",
    )
    frequency_response: Annotated[Text, AfterValidator(check_file_name)] | None = key_field(
        "file with a measured [frequency response](#frequency-response), instead of "
        "`natural_frequency` and `damping`",
        "response.csv",
        None,
        absent="no dynamics",
    )
    serial_number: Text | None = key_field("serial number of the accelerometer", "Q-104", None)
    grade: Literal["navigation", "tactical", "consumer"] = key_field(
        "grade of the accelerometer; sets the limits and the default standard uncertainties "
        "of its terms ([sizes by grade](physics.md#sources-of-the-typical-sizes))",
        "tactical",
        "navigation",
        kind='`"navigation"`, `"tactical"` or `"consumer"`',
    )
    output: Output | None = key_field(
        "unit, nominal sensitivity and zero of the [readings](readings.md)",
        {"unit": "mA", "sensitivity": "1.25 mA/g"},
        None,
        absent="g",
    )
    sensitivity_prior: (
        Annotated[Quantity, PlainValidator(_parse_sensitivity_prior, Text)] | None
    ) = key_field(
        "prior of K_I in the unit of the readings",
        "1.25 ± 0.01 mA/g",
        None,
        absent="unknown",
        kind="text",
    )
    bias: Annotated[Quantity, uncertain_quantity("g")] | None = key_field(
        "prior of K_F", "0.00503 ± 2e-6 g", None, absent="unknown"
    )
    scale_factor: Annotated[Quantity, uncertain_quantity("g/g")] | None = key_field(
        "prior of K_I; the nominal value is 1, so an error of +1000 ppm is written `1.001 g/g`",
        "1.00197 ± 5e-6 g/g",
        None,
        absent="unknown",
    )
    displacement: DisplacementChannel | None = key_field(
        "recorded displacement along the input axis",
        {"column": "east_m", "unit": "m"},
        None,
        absent="exactly one recorded quantity is required",
        kind="column in m",
    )
    velocity: VelocityChannel | None = key_field(
        "recorded velocity along the input axis",
        {"column": "v", "unit": "m/s"},
        None,
        absent="exactly one recorded quantity is required",
        kind="column in m/s",
    )
    specific_force: ForceChannel | None = key_field(
        "recorded specific force along the input axis",
        {"column": "f", "unit": "g"},
        None,
        absent="exactly one recorded quantity is required",
        kind="column in m/s^2, g or the unit of `output`",
    )

    _name: str = PrivateAttr()
    _observable: str = PrivateAttr()
    _channel: ColumnSpec = PrivateAttr()
    _force: ColumnSpec | None = PrivateAttr()
    _priors: Mapping[str, Quantity] = PrivateAttr()
    _response: FrequencyResponse | None = PrivateAttr(default=None)
    _response_inputs: Mapping[str, Quantity] = PrivateAttr(default_factory=dict)

    @property
    def mounting(self) -> Mounting:
        """Axes on the level platform; `Mounting.turned` rotates them to an attitude."""
        level_mounting = self._level_mounting
        return (
            level_mounting
            if self._response is None
            else replace(level_mounting, response=self._response)
        )

    @cached_property
    def _level_mounting(self) -> Mounting:
        return Mounting.from_axes(self.input_axis, self.pendulous_axis, self.output_axis)

    @property
    def response(self) -> FrequencyResponse | None:
        """Frequency response of accelerometer and recorder; None: 1 at all frequencies."""
        return self._response

    @property
    def response_inputs(self) -> Mapping[str, Quantity]:
        """Input of the frequency response -> stated value."""
        return self._response_inputs

    @property
    def name(self) -> str:
        """Name in the campaign."""
        return self._name

    @property
    def observable(self) -> str:
        """The recorded quantity: ``displacement``, ``velocity`` or ``specific_force``."""
        return self._observable

    @property
    def channel(self) -> ColumnSpec:
        """The column of the recorded quantity."""
        return self._channel

    @property
    def force(self) -> ColumnSpec | None:
        """The column of specific force in records on an arm or at rest; None if there are none."""
        return self._force

    @property
    def priors(self) -> Mapping[str, Quantity]:
        """Term symbol -> prior in g-units, from this table or from [model.priors].

        `bias` is K_F, `scale_factor` is K_I. u = 0 means that the value is exact.
        """
        return self._priors

    @property
    def own_priors(self) -> dict[str, Quantity]:
        """Term symbol -> prior in g-units from the accelerometer's own table."""
        values = {symbol: getattr(self, symbol) for symbol in TERMS}
        values["K_I"] = self.sensitivity_prior or values["K_I"]
        values |= {
            symbol_of_key: prior_of_key
            for key, symbol_of_key in COMMON_NAMES.items()
            if (prior_of_key := getattr(self, key))
        }
        return {symbol: prior for symbol, prior in values.items() if prior is not None}

    def contradictions(self) -> Iterator[Contradiction]:
        """Yield invalid axes, and priors that are implausible or stated twice."""
        try:
            assert self.mounting
        except ValueError as error:
            yield (), Problem(str(error), "invalid-axes"), *_AXIS_KEYS
        if (self.natural_frequency is None) != (self.damping is None):
            key, missing_key = "natural_frequency", "damping"
            if self.natural_frequency is None:
                key, missing_key = missing_key, key
            yield (key,), Problem(f"requires {missing_key} as well", "missing-key"), missing_key
        elif self.damping is not None and not self.damping.value >= 0.0:
            yield ("damping",), Problem("must not be negative", "value-out-of-range")
        if self.frequency_response is not None and self.natural_frequency is not None:
            yield (
                ("frequency_response",),
                "cannot be combined with natural_frequency; keep one of them",
            )
        for key, symbol in ({symbol: symbol for symbol in TERMS} | COMMON_NAMES).items():
            if (prior := getattr(self, key)) is not None:
                try:
                    check_near_nominal(symbol, prior, self.grade)
                except ValueError as error:
                    yield (key,), Problem(str(error), error_code(error)), "grade"
        for key, symbol in COMMON_NAMES.items():
            alternative = getattr(self, symbol)
            if symbol == "K_I":
                alternative = self.sensitivity_prior or alternative
            if None not in (getattr(self, key), alternative):
                yield (key,), f"duplicates the prior of {symbol}; keep one of them"


AccelerometerKeys = create_model(
    "AccelerometerKeys",
    __base__=Accelerometer,
    __doc__="[accelerometers.NAME]: axes, column and priors by term.",
    **term_keys(TERMS, uncertain_quantity),
)


def update_responses(
    accelerometers: Mapping[str, Accelerometer], input_values: Mapping[tuple[str, str], float]
) -> dict[str, Accelerometer]:
    """Return accelerometers with new input values of their frequency responses.

    input_values: (accelerometer, input) -> value; the cutoff of the recorder has the owner "".
    """
    updated_by_name = {}
    for name, accelerometer in accelerometers.items():
        own_values = {
            symbol: value
            for (owner, symbol), value in input_values.items()
            if symbol in RESPONSE_INPUTS and owner in ("", name)
        }
        response = replace_inputs(accelerometer.response, own_values)
        updated_by_name[name] = accelerometer.replace_private(response=response)
    return updated_by_name


class AccelerometersReader:
    """Reads the tables of accelerometers; each key is checked even where another one is wrong.

    raw: Accelerometer -> unchecked table.
    runs: Entries of ``[[runs]]`` that are not excluded.
    gravity: Gravity of the site, m/s^2.
    """

    def __init__(
        self, raw: Mapping[str, Any], runs: Sequence[Any], problems: Problems, gravity: float
    ) -> None:
        self.raw, self.runs = raw, runs
        self.problems, self.gravity = problems, gravity
        are_readings = [is_reading(run) for run in runs]
        #: Whether there are records of a double turntable, and records on an arm or at rest.
        self.has_turntable_records = not all(are_readings)
        self.has_reading_records = any(
            is_reading_run and "record" in run
            for run, is_reading_run in zip(runs, are_readings, strict=True)
        )
        #: Accelerometer -> validated table and its invalid keys.
        self._read: dict[str, tuple[Any, set[str]]] = {
            name: problems.validate_partial(
                AccelerometerKeys, table, ("accelerometers", name), gravity=gravity
            )
            for name, table in raw.items()
        }
        #: Accelerometer -> axes, if they are valid.
        self.mountings: dict[str, Mounting] = {}
        for name, (table, invalid_keys) in self._read.items():
            if table is not None and not invalid_keys & set(_AXIS_KEYS):
                with suppress(ValueError):
                    self.mountings[name] = table.mounting
        #: Accelerometer -> output (None: in g), if it is valid.
        self.outputs: dict[str, Output | None] = {
            name: table.output
            for name, (table, invalid_keys) in self._read.items()
            if table is not None and "output" not in invalid_keys
        }
        #: Accelerometer -> grade, if its table is valid.
        self.grades: dict[str, str] = {
            name: table.grade
            for name, (table, invalid_keys) in self._read.items()
            if table and not invalid_keys
        }
        #: Accelerometer -> validated table; None if it is invalid.
        self.tables: dict[str, Any] = {
            name: None if invalid_keys else table
            for name, (table, invalid_keys) in self._read.items()
        }

    def build_accelerometers(
        self,
        observables: Mapping[str, str],
        priors: Mapping[str, Mapping[str, Quantity]],
        responses: ResponseReader,
    ) -> dict[str, Accelerometer]:
        """Return the accelerometers with valid tables, after a check of their columns."""
        return {
            name: table.replace_private(
                name=name,
                observable=observables[name],
                channel=self._resolve_channel(name, table, observables[name]),
                force=self._resolve_force_channel(name, table),
                priors=priors[name],
                **responses.read(name, table),
            )
            for name, table in self.tables.items()
            if table is not None and name in self.mountings and name in observables
        }

    @property
    def own_priors(self) -> dict[str, dict[str, Quantity]]:
        """Accelerometer -> term symbol -> prior from the accelerometer's own table."""
        return {name: table.own_priors if table else {} for name, table in self.tables.items()}

    def find_observables(self) -> dict[str, str]:
        """Return the recorded quantity of each accelerometer."""
        observables = {}
        for name, table in self.raw.items():
            if not isinstance(table, dict):
                continue
            recorded_keys = [key for key in OBSERVABLES if key in table]
            if not self.has_turntable_records and (not recorded_keys or self.has_reading_records):
                observables[name] = "specific_force"  # the accelerometer has only readings
            elif (
                self.has_turntable_records
                and self.has_reading_records
                and recorded_keys[1:] == ["specific_force"]
            ):
                # The second column belongs to records on an arm or at rest.
                observables[name] = recorded_keys[0]
            elif len(recorded_keys) == 1:
                observables[name] = recorded_keys[0]
            else:
                description = (
                    f"has {' and '.join(recorded_keys)}"
                    if recorded_keys
                    else "has no recorded signal"
                )
                self.problems.add(
                    ("accelerometers", name), f"{description}; give one of {', '.join(OBSERVABLES)}"
                )
        return observables

    def _resolve_channel(self, name: str, table: Any, observable: str) -> ColumnSpec:
        """Return the column of an accelerometer; an output such as a current is scaled to m/s^2."""
        column, output = getattr(table, observable), table.output
        if column is None:
            return ColumnSpec("", target_unit=OBSERVABLES[observable])
        if observable != "specific_force":
            return make_column_spec(column, OBSERVABLES[observable])
        try:
            column_spec = make_column_spec(column, "m/s^2", self.gravity)
        except ValueError as error:
            path = ("accelerometers", name, observable, "unit")
            if output is None:
                self.problems.add(
                    path, f"{error}; or give output = {{ unit, sensitivity }}", error_code(error)
                )
                return ColumnSpec("")
            factor = self.problems.collect(path, unit_factor, column.unit, output.unit) or 1.0
            factor *= self.gravity / output.sensitivity
            column_spec = ColumnSpec(column.column, factor, 0.0, column.unit, "", self.gravity)
        if output is not None and output.zero != 0.0:
            # A zero in another unit does not apply to a column in m/s^2.
            with suppress(ValueError):
                unit_factor(column.unit, output.unit, gravity=self.gravity)
                column_spec = replace(column_spec, offset=self.gravity * output.to_g(0.0))
        return column_spec

    def _resolve_force_channel(self, name: str, table: Any) -> ColumnSpec | None:
        """Return the column of specific force in records on an arm or at rest, if there are any."""
        if not self.has_reading_records:
            return None
        if table.specific_force is None:
            self.problems.add(
                ("accelerometers", name),
                "has no specific_force; this key is required for records on an arm or at rest",
                "missing-key",
            )
            return None
        return self._resolve_channel(name, table, "specific_force")

"""The keys of ``campaign.toml``, section by section, as strict pydantic models.

A key that is not here is a mistake. Quantities are converted to SI and g-units here; what needs
several sections (axes, priors, attitudes) is resolved in `description`.

The keys that name coefficients are not written here: they are made from the term tables.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Annotated, Any, Final, Literal, Self

from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    PlainValidator,
    create_model,
    model_validator,
)

from counterspin.campaign.attitude import attitude_rows
from counterspin.campaign.kinds import (
    Attitude,
    DateOrText,
    Direction,
    Part,
    PositiveRatio,
    Schema,
    Seconds,
    SettingsSection,
    Text,
    ZeroDirection,
    a_latitude,
    an_encoding,
    angle_unit,
    described,
    force_or_output,
    is_unit,
    known,
    noise_size,
    of_earth,
    positive,
    read_exactly,
    record_file,
    several,
    time_unit,
    turning,
    unit_of,
)
from counterspin.campaign.quantity import Quantity
from counterspin.physics.terms import TERMS, Term
from counterspin.records.dialect import Dialect

#: What an accelerometer's record may hold -> its SI unit.
OBSERVABLES: Final = {"displacement": "m", "velocity": "m/s", "specific_force": "m/s^2"}


class DocumentSettings(SettingsSection):
    """The sections that there may be; each is checked by its own model afterwards."""

    schema_version: Schema = Field(alias="schema")
    campaign: dict[str, Any] = {}
    site: dict[str, Any]
    centrifuge: dict[str, Any] | None = None
    records: dict[str, Any] | None = None
    readings: dict[str, Any] | None = None
    accelerometers: dict[str, Any] = Field(min_length=1)
    noise: dict[str, Any] | None = None
    model: dict[str, Any] | None = None
    specification: dict[str, Any] | None = None
    runs: list[Any] = []
    simulation: dict[str, Any] | None = None
    truth: dict[str, Any] | None = None
    study: dict[str, Any] | None = None


class CampaignSettings(SettingsSection):
    """[campaign]: what a report says about the campaign; all free text, all optional."""

    title: Text | None = None
    serial_number: Text | None = None
    date: DateOrText | None = None
    laboratory: Text | None = None
    operator: Text | None = None
    comment: Text | None = None


class SiteSettings(SettingsSection):
    """[site]: where the centrifuge stands."""

    gravity: Annotated[Quantity, known("m/s^2"), AfterValidator(of_earth)]
    latitude: Annotated[Quantity, known("rad", "deg"), AfterValidator(a_latitude)]
    removed_gravity: Annotated[float, read_exactly("m/s^2"), AfterValidator(of_earth)] | None = None


class CentrifugeSettings(SettingsSection):
    """[centrifuge]: its size."""

    radius: Annotated[Quantity, known("m"), AfterValidator(positive)]
    stretch: Annotated[Quantity, known("s^2/m")] | None = None
    droop: Annotated[Quantity, known("rad s^2")] | None = None
    axis_tilt: Annotated[Quantity, known("rad", "arcsec")] | None = None
    reference_temperature: Text | None = None


class _Channel(SettingsSection):
    column: Text


class TimeChannel(SettingsSection):
    """The column that holds the time, or how many rows there are a second."""

    column: Text | None = None
    unit: Annotated[str, AfterValidator(time_unit)] | None = None
    sampling_rate: Annotated[float, read_exactly("Hz"), AfterValidator(positive)] | None = None

    @model_validator(mode="after")
    def _one_of_two(self) -> Self:
        if (self.column is None) == (self.sampling_rate is None):
            raise ValueError("give a column, or a sampling_rate")
        if self.unit is not None and self.column is None:
            raise ValueError("a unit belongs to a column; with sampling_rate there is none")
        return self


class AngleChannel(_Channel):
    """The column that holds the spindle's angle, or the times of its pulses."""

    pulses: bool = False
    unit: Annotated[str, AfterValidator(angle_unit)] | None = None
    sense: Literal["counterclockwise", "clockwise"] = "counterclockwise"
    zero: ZeroDirection = 0.0
    per_revolution: PositiveRatio | None = None

    @model_validator(mode="after")
    def _counts(self) -> Self:
        counted = self.unit is not None and is_unit(self.unit, "count")
        if counted and self.per_revolution is None:
            raise ValueError("counts need per_revolution: how many make one revolution")
        if self.per_revolution is not None and not (counted or self.pulses):
            raise ValueError('per_revolution belongs to pulses, or to unit = "count"')
        return self


class TableDialect(SettingsSection):
    """How a table is written, as far as a person says it: of records and of readings alike."""

    skip_lines: Annotated[int, Field(ge=0)] | None = None
    delimiter: Literal[",", ";", "\t"] | None = None
    decimal: Literal[".", ","] | None = None
    encoding: Annotated[str, AfterValidator(an_encoding)] | None = None
    units_row: bool | None = None
    sheet: Text | None = None

    @property
    def dialect(self) -> Dialect:
        """The same, as files are read."""
        keys = Dialect.__dataclass_fields__
        return Dialect(**{key: getattr(self, key) for key in keys if hasattr(self, key)})


class _TimeAndAngle(SettingsSection):
    time: TimeChannel
    angle: AngleChannel | None = None


# The fields of the last base come first.
class RecordsSettings(TableDialect, _TimeAndAngle):
    """[records]: how to read every run's file."""

    group: Text | None = None
    timing_offset: Annotated[Quantity, known("s")] | None = None
    clock: Part | None = None
    reference: Literal["platform", "own velocity"] = "platform"


class DisplacementChannel(_Channel):
    """The column that holds the displacement along the input axis."""

    unit: Annotated[str, unit_of("m")] | None = None


class VelocityChannel(_Channel):
    """The column that holds the velocity along the input axis."""

    unit: Annotated[str, unit_of("m/s")] | None = None


class ForceChannel(_Channel):
    """The column that holds the indicated specific force, or an output such as a current."""

    unit: Annotated[str, AfterValidator(force_or_output)]


class AxesSettings(SettingsSection):
    """The axes of an accelerometer; checked by themselves too, whatever else is wrong."""

    input_axis: Direction
    pendulous_axis: Direction
    output_axis: Direction | None = None


class OutputSettings(SettingsSection):
    """``output``: what an accelerometer's readings are in, and its nominal sensitivity."""

    unit: Text
    sensitivity: Text | None = None


class _AccelerometerKeys(AxesSettings):
    serial_number: Text | None = None
    grade: Literal["navigation", "tactical", "consumer"] = "navigation"
    output: OutputSettings | None = None
    sensitivity_prior: Text | None = None
    bias: Annotated[Quantity, known("g")] | None = None
    scale_factor: Annotated[Quantity, known("g/g")] | None = None
    displacement: DisplacementChannel | None = None
    velocity: VelocityChannel | None = None
    specific_force: ForceChannel | None = None


def term_keys(
    rows: Mapping[str, Term[Any]], reader: Callable[[str], PlainValidator]
) -> dict[str, Any]:
    """Return optional fields, one for each name of a term, that read a quantity in its unit."""
    return {
        name: (
            Annotated[Quantity | float, reader(row.unit)] | None,
            described(row.words, _example(row, reader), None),
        )
        for name, row in rows.items()
    }


def _example(row: Term[Any], reader: Callable[[str], PlainValidator]) -> str:
    """Return how a term is written: what is known of it, or its true value."""
    if reader is known:
        return f"{row.nominal:g} ± {row.typical:g} {row.unit}"
    return f"{row.nominal + row.typical:.9g} {row.unit}"


#: [accelerometers.NAME]: its axes, its column and, by term symbol, the priors.
AccelerometerSettings = create_model(
    "AccelerometerSettings", __base__=_AccelerometerKeys, **term_keys(TERMS, known)
)


class NoiseSettings(SettingsSection):
    """[noise] and [truth.noise]: standard deviations a sample, SI."""

    displacement: Annotated[float | str, noise_size("m")] = 0.0
    velocity: Annotated[float | str, noise_size("m/s")] = 0.0
    specific_force: Annotated[float | str, noise_size("m/s^2")] = 0.0
    acceleration: Annotated[float | str, noise_size("m/s^2/Hz^0.5")] = 0.0
    flicker: Annotated[float | str, noise_size("m/s^2")] = 0.0
    bias_walk: Annotated[float | str, noise_size("m/s^2/s^0.5")] = 0.0
    quantisation: Annotated[float | str, noise_size("m")] = 0.0
    angle: Annotated[float | str, noise_size("rad")] = 0.0
    timing: Annotated[float | str, noise_size("s")] = 0.0


class ModelSettings(SettingsSection):
    """[model]; names and values are resolved in `terms`."""

    terms: list[Text] | None = None
    assume: Annotated[list[Text], BeforeValidator(several)] = []
    hold: list[Text] = []
    considered: list[Text] = []
    priors: dict[str, Any] = {}
    limits: dict[str, Any] = {}
    typical: dict[str, Any] = {}

    @property
    def held(self) -> tuple[str, list[str]]:
        """The key that names what is known but not adjusted, new or old, and the names."""
        return ("considered", self.considered) if self.considered else ("hold", self.hold)


class SimulationSettings(SettingsSection):
    """[simulation]: how `counterspin simulate` samples."""

    sampling_rate: Annotated[float, read_exactly("Hz"), AfterValidator(positive)] = 50.0
    seed: Annotated[int, Field(ge=0)] = 1
    revolutions: PositiveRatio = 100.0


class RunSettings(SettingsSection):
    """[[runs]]: one run."""

    name: Text
    rate: Annotated[float, read_exactly("rad/s"), AfterValidator(turning)]
    record: Annotated[Text, AfterValidator(record_file)]
    attitude: Attitude = Field(default_factory=lambda: attitude_rows("level"))
    duration: Seconds | None = None
    revolutions: PositiveRatio | None = None
    temperature: Text | None = None
    time: Annotated[float, read_exactly("s")] | None = None
    continued_in: list[Annotated[Text, AfterValidator(record_file)]] = []
    pulses: Annotated[Text, AfterValidator(record_file)] | None = None
    records: dict[str, Any] | None = None
    skip: bool = False
    start: Annotated[float, read_exactly("s")] | None = None
    stop: Annotated[float, read_exactly("s")] | None = None
    truth: dict[str, Any] | None = None

"""The tables of [truth] and of a run's `truth`: true values of a simulated campaign.

Only `counterspin.campaign.simulated_truth` reads them; a calibration does not.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Final

from pydantic import AfterValidator, ConfigDict, Field, PlainValidator, create_model

from counterspin.campaign.field_types import (
    Ratio,
    SettingsSection,
    check_gravity,
    check_latitude,
    check_positive,
    check_rate_error,
    exact_quantity,
    key_field,
    parse_ratio,
    true_coefficient,
)
from counterspin.campaign.settings import StatedNoise, term_keys
from counterspin.campaign.validation import Section, nested_models
from counterspin.errors import OutOfRangeError
from counterspin.physics.terms import ACCELEROMETER_TERMS, SHARED_TERMS

#: Key for all recorders; largest relative rate error of a clock.
ALL_RECORDERS: Final = "*"
_MAX_CLOCK_ERROR: Final = 0.01

_AS_STATED: Final = "as stated"


def _parse_clock_errors(value: object) -> dict[str, float]:
    """Return recorder -> relative rate error of its clock; ``*`` stands for all recorders."""
    error_by_recorder = value if isinstance(value, Mapping) else {ALL_RECORDERS: value}
    clock_errors = {str(name): parse_ratio(error) for name, error in error_by_recorder.items()}
    if any(abs(error) > _MAX_CLOCK_ERROR for error in clock_errors.values()):
        raise OutOfRangeError("a clock error above 1 % is implausible")
    return clock_errors


class SiteTruthSettings(SettingsSection):
    """[truth.site]: true gravity and latitude."""

    gravity: Annotated[float, exact_quantity("m/s^2"), AfterValidator(check_gravity)] | None = (
        key_field(
            "true local gravity (magnitude along the plumb line)",
            "9.80663 m/s^2",
            None,
            absent=_AS_STATED,
        )
    )
    latitude: (
        Annotated[float, exact_quantity("rad", "deg"), AfterValidator(check_latitude)] | None
    ) = key_field(
        "true latitude, used for the components of the Earth's rotation",
        "45.7502 deg",
        None,
        absent=_AS_STATED,
    )


class CentrifugeDimensions(SettingsSection):
    """[truth.centrifuge]: true dimensions of the centrifuge."""

    radius: Annotated[float, exact_quantity("m"), AfterValidator(check_positive)] | None = (
        key_field(
            "true radius from the spindle axis to the centre of the platform",
            "2.50001 m",
            None,
            absent=_AS_STATED,
        )
    )
    clock: Ratio | None = key_field(
        "true relative rate error of the clock that measures the rates of readings; positive if "
        "the clock runs fast",
        "20 ppm",
        None,
        absent=_AS_STATED,
        kind="number or value in ppm",
    )


class RecordsTruthSettings(SettingsSection):
    """[truth.records]: true timing of the rows."""

    timing_offset: Annotated[float, exact_quantity("s")] | None = key_field(
        "true angle delay: sampling time of the angle minus sampling time of the "
        "displacement in the same row",
        "2e-5 s",
        None,
        absent=_AS_STATED,
    )
    cutoff_frequency: (
        Annotated[float, exact_quantity("Hz"), AfterValidator(check_positive)] | None
    ) = key_field(
        "true cutoff frequency of the recorder's low-pass filter", "98 Hz", None, absent=_AS_STATED
    )
    clock: (
        Annotated[
            dict[str, float],
            PlainValidator(_parse_clock_errors, float | str | dict[str, float | str]),
        ]
        | None
    ) = key_field(
        "true relative rate error of all recorder clocks, or a table keyed by recorder; positive "
        "if the clock runs fast",
        {"A": "20 ppm", "B": "-5 ppm"},
        None,
        absent=_AS_STATED,
        kind="number, or table",
    )


class RippleSettings(SettingsSection):
    """``ripple``: a periodic fluctuation of the rate, by ratio w_n/w0 or by amplitude."""

    harmonic: Annotated[int, AfterValidator(check_positive)] = key_field(
        "frequency, in cycles per revolution", 2, 1
    )
    ratio: Ratio | None = key_field(
        "amplitude of the fluctuation divided by the rate, w_n/w0",
        "0.5 ppm",
        None,
        kind="number or value in ppm",
    )
    amplitude: Annotated[float, exact_quantity("rad/s")] | None = key_field(
        "amplitude of the fluctuation, w_n", "1e-6 rad/s", None
    )
    phase: Annotated[float, exact_quantity("rad", "deg")] = key_field(
        "phase at time zero", "30 deg", 0.0
    )


class SpindleTruthSettings(SettingsSection):
    """[truth.spindle]: true rotation of the spindle."""

    drift: Annotated[float, exact_quantity("1/s")] | None = key_field(
        "relative drift C of the rate", "1e-6 1/s", None
    )
    ripple: list[RippleSettings] | None = key_field(
        "fluctuations of the rate within a revolution",
        [{"ratio": "0.5 ppm"}],
        None,
        kind="list of tables",
    )
    start_angle: Annotated[float, exact_quantity("rad", "deg")] | None = key_field(
        "angle at time zero", "30 deg", None, absent="0"
    )
    rate_error: Annotated[Ratio, AfterValidator(check_rate_error)] | None = key_field(
        "relative difference between the true rate and the nominal rate",
        "5 ppm",
        None,
        absent="0",
        kind="number or value in ppm",
    )


#: Family of terms -> description and example of its table in [truth].
_FAMILY_FIELDS: Final[Mapping[str, tuple[str, Mapping[str, Any]]]] = {
    "platform.tilt": ("tilt about `east`, `north` and `up`", {"north": "0.2 arcsec"}),
    "platform.drift": (
        "drift of the gyros about `east`, `north` and `up`",
        {"north": "0.001 deg/h"},
    ),
    "platform.g_sensitivity": (
        "g-sensitivity of gyro z to specific force along x (`zx`), and so on",
        {"zx": "0.01 deg/h/g"},
    ),
    "platform.g2_sensitivity": (
        "g²-sensitivity of the gyros about `east`, `north` and `up`",
        {"north": "1e-4 deg/h/g^2"},
    ),
    "platform.compliance": (
        "rotation about z due to force along y (`zy`), and so on",
        {"zy": "0.1 arcsec/g"},
    ),
    "centrifuge.imbalance": (
        "change in the radius, proportional to the cosine or sine of 1 or 2 times the angle",
        {"1": {"cos": "1 um"}},
    ),
    "centrifuge.axis_tilt": (
        "tilt of the spindle axis about `east` or `north`",
        {"east": "5 arcsec"},
    ),
    "table.harmonic": (
        "rotation of the counter-rotating table about up, proportional to the cosine or sine of 1 "
        "or 2 times the angle",
        {"1": {"sin": "1 arcsec"}},
    ),
    "table.axis_tilt": (
        "tilt of the table axis about `outward` (along the arm) or about `forward`",
        {"forward": "5 arcsec"},
    ),
    "encoder.harmonic": (
        "error of the recorded angle, proportional to the cosine or sine of 1 to 4 times the angle",
        {"1": {"sin": "1 arcsec"}},
    ),
}


def _make_truth_table(
    name: str, family: str, base_class: type[SettingsSection] = SettingsSection
) -> type[SettingsSection]:
    """Create a table with a key for each term of a family; nested tables for names with dots."""
    row_by_key = {
        symbol.removeprefix(f"{family}."): row
        for symbol, row in SHARED_TERMS.items()
        if symbol.startswith(f"{family}.")
    }
    fields = term_keys(
        {key: row for key, row in row_by_key.items() if "." not in key}, exact_quantity
    )
    for nested_key in dict.fromkeys(key.partition(".")[0] for key in row_by_key if "." in key):
        description, example = _FAMILY_FIELDS.get(f"{family}.{nested_key}", ("of this number", {}))
        table = _make_truth_table(f"{name}_{nested_key}", f"{family}.{nested_key}")
        fields[nested_key] = (table | None, key_field(description, example, None))
    description = f"[truth.{family}]: true values of the terms."
    return create_model(name, __base__=base_class, __doc__=description, **fields)


#: [truth.platform]: ``tilt.north``, ``drift.up``, ``g_sensitivity.zx`` and so on.
PlatformTruthSettings = _make_truth_table("PlatformTruthSettings", "platform")
#: [truth.centrifuge]: ``radius``, ``stretch``, ``imbalance.1.cos`` and so on.
CentrifugeTruthSettings = _make_truth_table(
    "CentrifugeTruthSettings", "centrifuge", CentrifugeDimensions
)
#: [truth.encoder]: ``harmonic.1.cos`` and so on.
EncoderTruthSettings = _make_truth_table("EncoderTruthSettings", "encoder")
#: [truth.table]: ``harmonic.1.cos`` and so on.
TableTruthSettings = _make_truth_table("TableTruthSettings", "table")

_OptionalTilt: Any = _make_truth_table("True_tilt", "platform.tilt") | None

RunTruthSettings = create_model(
    "RunTruthSettings",
    __base__=SpindleTruthSettings,
    __doc__="``truth``: true rotation and tilt of one run, where they differ from [truth].",
    tilt=(
        _OptionalTilt,
        key_field(*_FAMILY_FIELDS["platform.tilt"], None, absent="`[truth.platform]`"),
    ),
)


class _AccelerometerTruthKeys(SettingsSection):
    natural_frequency: (
        Annotated[float, exact_quantity("Hz"), AfterValidator(check_positive)] | None
    ) = key_field("true natural frequency of the accelerometer", "410 Hz", None, absent=_AS_STATED)
    damping: Ratio | None = key_field(
        "true damping ratio of the accelerometer", 0.72, None, absent=_AS_STATED, kind="number"
    )
    start_offset: Annotated[float, exact_quantity("m")] = key_field(
        "initial displacement error in each run", "0.02 m", 0.0
    )
    start_velocity: Annotated[float, exact_quantity("m/s")] = key_field(
        "initial velocity error in each run", "-1e-4 m/s", 0.0
    )
    bias: Annotated[float, true_coefficient("g")] | None = key_field("alias of K_F", "5 mg", None)
    scale_factor: Annotated[float, true_coefficient("g/g")] | None = key_field(
        "alias of K_I", "1.002 g/g", None
    )


AccelerometerTruthSettings = create_model(
    "AccelerometerTruthSettings",
    __base__=_AccelerometerTruthKeys,
    __doc__="[truth.NAME]: true coefficients of an accelerometer.",
    **term_keys(ACCELEROMETER_TERMS, true_coefficient),
)


class TrueNoise(StatedNoise):
    """[truth.noise]: true noise of records and readings."""

    reading: Any = key_field(
        (
            "noise of the readings, in g or in the unit of their `output`, or a table by "
            "accelerometer"
        ),
        "2e-6 mA",
        None,
        absent="the uncertainty of each reading",
        kind="quantity, or table",
    )

    @property
    def record_noise(self) -> StatedNoise:
        """True noise of the records."""
        return StatedNoise.model_construct(**self.model_dump(exclude={"reading"}))


class TruthSettings(SettingsSection):
    """[truth]: true values for a simulation, with a table for each accelerometer."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, AccelerometerTruthSettings] = Field(init=False)  # type: ignore[valid-type]

    spindle: Annotated[dict[str, Any], Section(SpindleTruthSettings)] = key_field(
        "rotation of the spindle: drift and fluctuations of the rate", {"drift": "1e-6 1/s"}, {}
    )
    platform: Annotated[dict[str, Any], Section(PlatformTruthSettings)] = key_field(
        "errors of the platform", {"tilt": {"north": "0.2 arcsec"}}, {}
    )
    centrifuge: Annotated[dict[str, Any], Section(CentrifugeTruthSettings)] = key_field(
        "true radius of the centrifuge, and path errors", {"radius": "2.50001 m"}, {}
    )
    encoder: Annotated[dict[str, Any], Section(EncoderTruthSettings)] = key_field(
        "errors of the recorded angle", {"harmonic": {"1": {"sin": "1 arcsec"}}}, {}
    )
    table: Annotated[dict[str, Any], Section(TableTruthSettings)] = key_field(
        "errors of the counter-rotating table to which the instruments are strapped",
        {"harmonic": {"1": {"sin": "1 arcsec"}}},
        {},
    )
    noise: Annotated[dict[str, Any], Section(TrueNoise)] = key_field(
        "noise of records and of readings", {"displacement": "0.01 m"}, {}, absent="as in `[noise]`"
    )
    machine: dict[str, Any] = key_field(
        "machine terms that affect readings", {"centrifuge.radius.in": "1.00001 m"}, {}
    )
    site: Annotated[dict[str, Any], Section(SiteTruthSettings)] = key_field(
        "true gravity and latitude of the site", {"latitude": "45.7502 deg"}, {}, absent=_AS_STATED
    )
    records: Annotated[dict[str, Any], Section(RecordsTruthSettings)] = key_field(
        "true timing of the rows", {"timing_offset": "2e-5 s"}, {}, absent=_AS_STATED
    )


#: Table of [truth] -> its class.
TRUE_TABLES: Final[Mapping[str, type[SettingsSection]]] = nested_models(TruthSettings)

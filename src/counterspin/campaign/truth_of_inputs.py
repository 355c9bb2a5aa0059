"""What is true of the uncertain inputs of a simulated campaign: radius, site, delay and clocks."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Final

from pydantic import AfterValidator, PlainValidator

from counterspin.campaign.checking import Path, Problems
from counterspin.campaign.kinds import (
    SettingsSection,
    a_latitude,
    a_ratio,
    described,
    of_earth,
    positive,
    read_exactly,
)
from counterspin.inference.joint.inputs import CLOCK

#: Of all recorders, and the largest error of a clock.
_ALL: Final = "*"
_MOST_OF_A_CLOCK: Final = 0.01

_STATED: Final = "as stated"


def _clocks(value: object) -> dict[str, float]:
    """Return by how much of itself each recorder's clock is fast; of all of them under ``*``."""
    named = value if isinstance(value, Mapping) else {_ALL: value}
    clocks = {str(name): a_ratio(part) for name, part in named.items()}
    if any(abs(part) > _MOST_OF_A_CLOCK for part in clocks.values()):
        raise ValueError("a clock error above 1 % is not plausible")
    return clocks


class SiteTruthSettings(SettingsSection):
    """[truth.site]: where the centrifuge really stands."""

    gravity: Annotated[float, read_exactly("m/s^2"), AfterValidator(of_earth)] | None = described(
        "plumb-line gravity", "9.80663 m/s^2", None, absent=_STATED
    )
    latitude: Annotated[float, read_exactly("rad", "deg"), AfterValidator(a_latitude)] | None = (
        described("for the Earth's rate", "45.7502 deg", None, absent=_STATED)
    )


class TrueRadius(SettingsSection):
    """[truth.centrifuge]: its true size."""

    radius: Annotated[float, read_exactly("m"), AfterValidator(positive)] | None = described(
        "from the spindle axis to the platform's centre", "2.50001 m", None, absent=_STATED
    )


class RecordsTruthSettings(SettingsSection):
    """[truth.records]: when the rows were really taken."""

    timing_offset: Annotated[float, read_exactly("s")] | None = described(
        "how much later than its displacement an angle is sampled", "2e-5 s", None, absent=_STATED
    )
    clock: (
        Annotated[dict[str, float], PlainValidator(_clocks, float | str | dict[str, float | str])]
        | None
    ) = described(
        "by how much of itself the clock of every recorder runs fast; or a table of the recorders",
        {"A": "20 ppm", "B": "-5 ppm"},
        None,
        absent=_STATED,
        kind="part, or table",
    )


def true_inputs(
    tables: Mapping[str, Any], recorders: Mapping[str, str], problems: Problems
) -> dict[tuple[str, str], float]:
    """Return by recorder (of a clock; else empty) and symbol the inputs that [truth] states, SI.

    tables: Those of [truth], None where they have mistakes.
    recorders: As `counterspin.campaign.runs.recorders_of` returns them.
    """
    site, records, centrifuge = (tables[name] for name in ("site", "records", "centrifuge"))
    stated = {
        ("", "site.gravity"): site and site.gravity,
        ("", "site.latitude"): site and site.latitude,
        ("", "centrifuge.radius"): centrifuge and centrifuge.radius,
        ("", "records.timing_offset"): records and records.timing_offset,
    }
    clocks = _by_recorder((records and records.clock) or {}, recorders, problems)
    return {key: value for key, value in stated.items() if value is not None} | clocks


def _by_recorder(
    clocks: Mapping[str, float], recorders: Mapping[str, str], problems: Problems
) -> dict[tuple[str, str], float]:
    if _ALL in clocks:
        return {(owner, CLOCK): clocks[_ALL] for owner in recorders.values()}
    for name in sorted(clocks.keys() - recorders.keys()):
        path: Path = ("truth", "records", "clock", name)
        problems.add(
            path,
            f'no run names this recorder; in [records] or in a run\'s own: recorder = "{name}"',
        )
    return {(recorders[name], CLOCK): part for name, part in clocks.items() if name in recorders}

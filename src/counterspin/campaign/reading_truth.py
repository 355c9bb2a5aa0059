"""The true values of simulated readings: [truth.machine], their noise, coefficients in own units.

Nothing here reaches a calibration.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

from counterspin.campaign.checking import Path, Problems, did_you_mean
from counterspin.campaign.machine import expand, less_nominal, symbols_shown
from counterspin.campaign.quantity import Quantity
from counterspin.campaign.readings import Output, Reading
from counterspin.campaign.settings import CentrifugeSettings, exact
from counterspin.campaign.toml_file import flat_keys
from counterspin.physics.terms import COMMON_NAMES, OWN_TERMS, term

#: The machine's table of [truth], and the key of [truth.noise] that readings have.
_MACHINE: Final = "machine"
_READING: Final = "reading"

#: Term that records show too, and its place in [truth.centrifuge].
_STRETCH: Final = "centrifuge.stretch"


def of_records(
    raw: Mapping[str, Any], outputs: Mapping[str, Output | None], problems: Problems
) -> dict[str, Any]:
    """Return [truth] with coefficients in g-units and without what readings alone have.

    outputs: Accelerometer -> what its readings are in; coefficients may be in its unit, as
        ``mA/g``.
    """
    if not isinstance(raw.get(_MACHINE, {}), Mapping):
        problems.add(("truth", _MACHINE), "must be a table")
    truth = {key: value for key, value in raw.items() if key != _MACHINE}
    noise = truth.get("noise")
    if isinstance(noise, Mapping) and _READING in noise:
        truth["noise"] = {key: value for key, value in noise.items() if key != _READING}
    stretch = flat_keys(_table(raw, _MACHINE)).get(_STRETCH)
    centrifuge = _table(raw, "centrifuge")
    if stretch is not None and "stretch" in centrifuge:
        problems.add(("truth", _MACHINE, _STRETCH), "is in [truth.centrifuge] too; keep one")
    elif stretch is not None:
        truth["centrifuge"] = {**centrifuge, "stretch": stretch}
    for name, output in outputs.items():
        if isinstance(truth.get(name), Mapping):
            truth[name] = _in_g_units(truth[name], output, ("truth", name), problems)
    return truth


def _table(raw: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    value = raw.get(key)
    return value if isinstance(value, Mapping) else {}


def _in_g_units(
    table: Mapping[str, Any], output: Output | None, path: Path, problems: Problems
) -> dict[str, Any]:
    """Return an accelerometer's truth with the terms' own names and units."""
    own: dict[str, Any] = {}
    for key, text in table.items():
        symbol = COMMON_NAMES.get(key, key)
        if symbol in own or (symbol != key and symbol in table):
            problems.add((*path, key), f"is {symbol}, given too; keep one")
        own[symbol] = text
        if symbol in OWN_TERMS and output is not None and isinstance(text, str):
            own[symbol] = _text_in_g(text, OWN_TERMS[symbol].unit, output)
    return own


def _text_in_g(text: str, unit: str, output: Output) -> str:
    """Return a coefficient in g-units where it is in the output's; else as it is."""
    if not unit.startswith("g"):
        return text
    try:
        in_output = exact(text, output.unit + unit.removeprefix("g"))
    except ValueError:
        return text
    return f"{in_output / output.sensitivity!r} {unit}"


def resolve_reading_truth(
    raw: Mapping[str, Any],
    readings: Sequence[Reading],
    outputs: Mapping[str, Output | None],
    centrifuge: CentrifugeSettings | None,
    *,
    problems: Problems,
    gravity: float,
) -> tuple[dict[str, float], dict[str, float]]:
    """Resolve [truth.machine] and the noise of readings.

    centrifuge: The machine; a true radius may be given as such.
    gravity: Of the site, m/s^2.
    """
    known = [symbol for symbol in symbols_shown(readings) if symbol not in OWN_TERMS]
    machine: dict[str, float] = {}
    for key, text in flat_keys(_table(raw, _MACHINE)).items():
        path = ("truth", _MACHINE, key)
        symbols = expand(key, known)
        if key in OWN_TERMS:
            problems.add(path, "is of an accelerometer; write it in its table, [truth.NAME]")
        elif not symbols:
            problems.add(path, f'no reading shows "{key}"' + did_you_mean(key, known))
        for symbol in symbols:
            unit = term(symbol).unit
            value = problems.attempt(path, exact, text, unit)
            if value is not None:
                given = less_nominal(symbol, Quantity(value, 0.0, unit), centrifuge)
                machine[symbol] = given.value
    stretch = _table(raw, "centrifuge").get("stretch")
    if stretch is not None and _STRETCH in known:
        value = problems.attempt(("truth", "centrifuge", "stretch"), exact, stretch, "s^2/m")
        machine[_STRETCH] = value or 0.0
    return machine, _noise(raw, outputs, problems, gravity)


def _noise(
    raw: Mapping[str, Any],
    outputs: Mapping[str, Output | None],
    problems: Problems,
    gravity: float,
) -> dict[str, float]:
    """Return the true noise of the readings of each accelerometer, g."""
    given = _table(raw, "noise").get(_READING)
    if given is None:
        return {}
    path: Path = ("truth", "noise", _READING)
    texts = given if isinstance(given, Mapping) else dict.fromkeys(outputs, given)
    sizes = {}
    for name, text in texts.items():
        if name not in outputs:
            problems.add(path, f'no accelerometer is called "{name}"' + did_you_mean(name, outputs))
            continue
        output = outputs[name]
        unit, size = ("g", 1.0) if output is None else (output.unit, output.sensitivity)
        value = problems.attempt(path, exact, text, unit, gravity if output is None else None)
        if value is not None and value < 0.0:
            problems.add(path, "a standard deviation is not negative")
        elif value is not None:
            sizes[name] = value / abs(size)
    return sizes

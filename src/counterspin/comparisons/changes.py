"""What is not the same in several results: their campaigns, and how they were calibrated."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Final

from counterspin.calibration.result import Result
from counterspin.comparisons.result import Change
from counterspin.physics.terms import symbol_of
from counterspin.reports.numbers import field_unit, format_estimate, format_number

#: Characters of a checksum by which two files are told apart.
_DIGITS: Final = 12

_NOTHING: Final = "-"


def changes(results: Sequence[Result]) -> list[Change]:
    """Return what differs between results: method and options, terms, noise, inputs, files."""
    rows = [dict(_description(result)) for result in results]
    subjects = dict.fromkeys(subject for row in rows for subject in row)
    found = []
    for subject in subjects:
        values = [row.get(subject, _NOTHING) for row in rows]
        if len(set(values)) > 1:
            found.append(Change(subject=subject, values=values))
    return found


def terms_of(result: Result) -> set[str]:
    """Return the names of all terms of a result's model: ``Qx.K_II``, ``platform.drift.north``."""
    terms = set(result.platform)
    for owner, accelerometer in result.accelerometers.items():
        terms.update(f"{owner}.{symbol}" for symbol in accelerometer.coefficients)
    for owner, run in result.runs.items():
        terms.update(f"{owner}.{symbol}" for symbol in run.terms)
    return terms


def _description(result: Result) -> Iterator[tuple[str, str]]:
    provenance, inputs = result.provenance, result.inputs
    yield "version", provenance.version
    yield from provenance.environment.items()
    yield "method", result.method
    yield "equations", result.model
    yield "options", " ".join(provenance.options) or _NOTHING
    yield "accepted misfit", result.accepted_misfit or _NOTHING
    for subject, value, u, unit in (
        ("gravity", inputs.gravity, inputs.u_gravity, "m/s^2"),
        ("latitude", inputs.latitude, inputs.u_latitude, "rad"),
        ("radius", inputs.radius, inputs.u_radius, "m"),
    ):
        yield subject, _quantity(value, u, unit)
    yield from _model(result)
    yield from result.details.items()
    for file, checksum in provenance.inputs.items():
        where = ", in memory" if file in provenance.in_memory else ""
        yield file, checksum.removeprefix("sha256:")[:_DIGITS] + where


def _model(result: Result) -> Iterator[tuple[str, str]]:
    for name, accelerometer in result.accelerometers.items():
        yield f"terms of {name}", ", ".join(accelerometer.coefficients)
        for symbol, known in accelerometer.known.items():
            yield f"{name}.{symbol}, known", _quantity(known.value, known.u, known.unit)
        held, priors = _known(result, name)
        yield f"held of {name}", ", ".join(held) or _NOTHING
        for source, text in priors.items():
            yield f"{name}: {source}", text
        for part, line in accelerometer.noise.items():
            size = _quantity(line.value, 0.0, line.unit)
            yield f"noise of {name}, {part}", "estimated" if line.estimated else size
    yield "assumed", ", ".join(result.assumed) or _NOTHING
    yield "not stated", ", ".join(_unstated(result)) or _NOTHING
    yield "terms of the platform", ", ".join(result.platform) or _NOTHING
    own = dict.fromkeys(symbol for run in result.runs.values() for symbol in run.terms)
    yield "terms of runs", ", ".join(own) or _NOTHING
    yield "runs", ", ".join(result.runs)


def _known(result: Result, name: str) -> tuple[list[str], Mapping[str, str]]:
    """Return what is held, and the size of what is stated of the unknowns."""
    held, priors = dict[str, None](), dict[str, str]()
    for lines in result.accelerometers[name].budget.values():
        for line in lines:
            if line.kind == "held":
                held[line.source] = None
            elif line.kind == "stated" and line.u is not None:
                priors[f"u of the prior of {line.source}"] = _quantity(line.u, 0.0, line.unit)
    return sorted(held), priors


def _unstated(result: Result) -> list[str]:
    """Return what nobody states with its typical size, of all runs and accelerometers once."""
    sizes = (
        f"{symbol_of(known.name)} ± {_quantity(known.u, 0.0, known.unit)}"
        for known in result.rests_on
        if known.kind == "unstated"
    )
    return list(dict.fromkeys(sizes))


def _quantity(value: float | None, u: float | None, unit: str) -> str:
    if value is None:
        return _NOTHING
    shown, factor = field_unit(unit)
    if not u:
        return f"{format_number(value * factor, 12)} {shown}"
    return format_estimate(value * factor, u * factor, shown)

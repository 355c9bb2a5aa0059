"""The machine's terms in a campaign with readings: those of [model], [centrifuge] and [fixture]."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import field
from typing import Annotated, Any, Final

from pydantic import AfterValidator

from counterspin.campaign.checking import Path, Problems, did_you_mean
from counterspin.campaign.kinds import SettingsSection, an_error, described, known
from counterspin.campaign.quantity import Quantity, parse
from counterspin.campaign.readings import Reading
from counterspin.campaign.settings import CentrifugeSettings, ModelSettings
from counterspin.campaign.toml_file import flat_keys
from counterspin.frozen import frozen
from counterspin.inference.least_squares import NO_PRIOR
from counterspin.physics.terms import (
    CONDITION_TERMS,
    READING_TERMS,
    SHARED_TERMS,
    shown_by_readings,
    term,
)

#: What a name of the machine's terms begins with.
_FAMILIES: Final = ("centrifuge.", "fixture.", "head.")

#: A radius that is given below this part of the machine's is a deviation from it.
_DEVIATION_PART: Final = 0.5

#: Axes about which a fixture may be turned, by motion: the names of the frame.
_AXES: Final = {
    "arm": ("outward", "forward", "up"),
    "static": ("east", "north", "up"),
    "counter-rotating": ("east", "north", "up"),
}

#: What the setting errors of all positions begin with.
POSITION: Final = "fixture.position"

#: What the errors of a dividing head begin with that go with its angle.
HEAD_WAVES: Final = "head.harmonic."

#: What is estimated of readings where [model] names no terms: at rest, and on a machine.
_TERMS_AT_REST: Final = ["K_F", "K_I"]
_TERMS_ON_A_MACHINE: Final = [*_TERMS_AT_REST, "K_II"]

#: Fewest poses by which angles between axes are asked for: they are three of nine unknowns.
_POSES_FOR_ANGLES: Final = 9


class FixtureSettings(SettingsSection):
    """[fixture]: how well positions at rest are set."""

    position: Annotated[Quantity, known("rad"), AfterValidator(an_error)] | None = described(
        "error of setting a [position at rest](readings.md#positions-that-are-set-by-hand), about"
        " east and about north each; one for all readings of it",
        "0 ± 0.5 deg",
        None,
    )


@frozen
class MachineModel:
    """What is estimated and considered of the machine."""

    #: Symbols of `counterspin.physics.terms.READING_TERMS`, with the mountings' names.
    terms: tuple[str, ...] = ()
    considered: tuple[str, ...] = ()
    #: Symbol -> what is known of it, less nominal; SI.
    priors: Mapping[str, Quantity] = field(default_factory=dict)
    #: Error of setting a position at rest, where one is stated.
    setting: Quantity | None = None

    def prior(self, symbol: str) -> tuple[float, float]:
        """Return value and standard uncertainty; infinite where nothing is known."""
        known = self.priors.get(symbol)
        return (known.value, known.u) if known else NO_PRIOR


def resolve_machine(
    settings: ModelSettings,
    centrifuge: CentrifugeSettings | None,
    readings: Sequence[Reading],
    problems: Problems,
    *,
    setting: Quantity | None = None,
    recorded: bool = False,
    poses: int = 0,
) -> tuple[ModelSettings, MachineModel]:
    """Take the machine's terms out of [model].

    centrifuge: The machine, if there is one; its stretch, droop and tilt are priors.
    setting: Error of setting a position, where one is stated.
    recorded: Whether there are records of a double turntable beside the readings.
    poses: How many there are at unknown attitudes, as far as that is known.
    """
    known = symbols_shown(readings, recorded=recorded)
    terms = _expanded(settings.terms or (), "terms", known, problems)
    for index, name in enumerate(settings.terms or ()):
        if name in CONDITION_TERMS and CONDITION_TERMS[name].effect.condition == "force":
            problems.add(
                ("model", "terms", index),
                f'"{name}" cannot be told from K_II; state what is known of it in [model.priors]',
            )
    key, names = settings.held
    held = _expanded(names, key, known, problems)
    # The centrifuge's radius is known of a mounting whose own is asked for or held.
    own = [s for s in known if s in (*terms, *held) or not s.startswith("centrifuge.radius.")]
    priors = _of_centrifuge(centrifuge, own) | _given(settings.priors, known, centrifuge, problems)
    if setting is not None:
        priors = dict.fromkeys(expand(POSITION, known), setting) | priors
    for index, symbol in enumerate(held):
        if symbol not in priors:
            problems.add(
                ("model", key, index),
                f'"{symbol}" is held, but there is no prior for it; add it to [model.priors]',
            )
    left = settings.model_copy(
        update={
            "terms": _own_terms(settings, readings, recorded, poses),
            key: [name for name in names if not _is_machine(name)],
            "priors": {k: v for k, v in flat_keys(settings.priors).items() if not _is_machine(k)},
        }
    )
    return left, MachineModel(terms, held, priors, setting)


def _own_terms(
    settings: ModelSettings, readings: Sequence[Reading], recorded: bool, poses: int
) -> list[str] | None:
    """Return the accelerometer's and platform's terms to estimate; None: the usual ones."""
    if settings.terms is not None:
        return [name for name in settings.terms if not _is_machine(name)]
    motions = {reading.motion for reading in readings}
    if "counter-rotating" in motions or recorded:
        return None
    terms = _TERMS_AT_REST if motions <= {"static"} else _TERMS_ON_A_MACHINE
    if poses >= _POSES_FOR_ANGLES:
        return [*terms, "delta_O", "delta_P"]
    return [*terms, *_misalignments(readings, len(terms))]


def _misalignments(readings: Sequence[Reading], beside: int) -> list[str]:
    """Return the misalignments that positions at rest show, as far as there are readings for them.

    An instrument is never on its fixture without any: left out they would be a lack of fit.
    """
    shown: list[str] = []
    for symbol, axis in (("delta_O", 1), ("delta_P", 2)):
        along = {round(r.axes.matrix[axis][2], 6) for r in readings if r.motion == "static"}
        if len(along) > 1 and len(readings) > beside + len(shown) + 1:
            shown.append(symbol)
    return shown


def errors_of_the_path(centrifuge: CentrifugeSettings) -> dict[str, Quantity]:
    """Return the priors that [centrifuge] gives to terms that records show too."""
    priors = {} if centrifuge.stretch is None else {"centrifuge.stretch": centrifuge.stretch}
    if centrifuge.axis_tilt is not None:
        axes = ("centrifuge.axis_tilt.east", "centrifuge.axis_tilt.north")
        priors |= dict.fromkeys(axes, centrifuge.axis_tilt)
    return priors


def _of_centrifuge(
    centrifuge: CentrifugeSettings | None, known: Iterable[str]
) -> dict[str, Quantity]:
    """Return what [centrifuge] says of the machine's terms, as deviations."""
    if centrifuge is None:
        return {}
    priors = errors_of_the_path(centrifuge)
    if centrifuge.droop is not None:
        priors["centrifuge.droop"] = centrifuge.droop
    radius = Quantity(0.0, centrifuge.radius.u, "m")
    radii = (symbol for symbol in known if symbol.startswith("centrifuge.radius."))
    return priors | (dict.fromkeys(radii, radius) if radius.u else {})


def _given(
    raw: Mapping[str, Any],
    known: Sequence[str],
    centrifuge: CentrifugeSettings | None,
    problems: Problems,
) -> dict[str, Quantity]:
    """Return what [model.priors] says of the machine's terms, as deviations."""
    priors: dict[str, Quantity] = {}
    for key, text in flat_keys(raw).items():
        if not _is_machine(key):
            continue
        path = ("model", "priors", key)
        symbols = expand(key, known)
        if not symbols:
            problems.add(path, f'no reading shows "{key}"' + did_you_mean(key, known))
        for symbol in symbols:
            prior = problems.attempt(path, parse, text, term(symbol).unit)
            if prior is not None:
                priors[symbol] = less_nominal(symbol, prior, centrifuge)
    return priors


def less_nominal(symbol: str, prior: Quantity, centrifuge: CentrifugeSettings | None) -> Quantity:
    """Return a prior as a deviation: a radius may be given as such, or as its deviation."""
    if not symbol.startswith("centrifuge.radius.") or centrifuge is None:
        return prior
    radius = centrifuge.radius.value
    value = prior.value - radius if prior.value > _DEVIATION_PART * radius else prior.value
    return Quantity(value, prior.u, prior.unit)


def symbols_shown(readings: Sequence[Reading], *, recorded: bool = False) -> tuple[str, ...]:
    """Return every term of the machine that these readings can show, and records beside them."""
    motions = {str(reading.motion) for reading in readings}
    motions |= {"counter-rotating"} if recorded else set()
    mountings = dict.fromkeys((r.mounting, r.motion) for r in readings if r.mounting)
    shown = {round(r.head_angle, 9) for r in readings if any(r.head) and r.motion == "static"}
    symbols: dict[str, None] = {}
    for row in READING_TERMS.values():
        if not motions & set(row.motions):
            continue
        if row.symbol.startswith(HEAD_WAVES) and len(shown) < 2:
            continue
        if row.scope == "position":
            positions = dict.fromkeys(r.position for r in readings if r.position)
            symbols |= {row.symbol.replace("POSITION", name): None for name in positions}
            continue
        if not row.per_mounting:
            symbols[row.symbol] = None
            continue
        for name, motion in mountings:
            axis = row.symbol.rpartition(".")[2]
            if motion in row.motions and axis in ("MOUNTING", *_AXES[motion]):
                symbols[row.symbol.replace("MOUNTING", name)] = None
    return tuple(symbols)


def _is_machine(name: str) -> bool:
    whole = "." in name and any(symbol.startswith(f"{name}.") for symbol in READING_TERMS)
    if whole or shown_by_readings(name):
        return True
    shown_by_records = any(f"{symbol}.".startswith(f"{name}.") for symbol in SHARED_TERMS)
    return name.startswith(_FAMILIES) and not shown_by_records


def expand(name: str, known: Iterable[str]) -> tuple[str, ...]:
    """Return the terms that a name stands for: itself, or all that begin with it.

    The slope of a coefficient is one term, whatever goes with a power of the same condition.
    """
    if name in CONDITION_TERMS:
        return tuple(s for s in known if s == name)
    return tuple(s for s in known if s == name or s.startswith(f"{name}."))


def _expanded(
    names: Iterable[str], key: str, known: Sequence[str], problems: Problems
) -> tuple[str, ...]:
    symbols: dict[str, None] = {}
    for index, name in enumerate(names):
        if not _is_machine(name):
            continue
        found = expand(name, known)
        if not found:
            path: Path = ("model", key, index)
            problems.add(path, f'no reading shows "{name}"' + did_you_mean(name, known))
        symbols |= dict.fromkeys(found)
    return tuple(symbols)

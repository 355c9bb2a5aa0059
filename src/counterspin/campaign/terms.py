"""The error terms of a campaign's model: [model] against the term tables.

A bare platform name means the components that act on the campaign's accelerometers to first
order, in any of the runs' attitudes, with the paper's start angle of zero:

- tilt, drift or g^2-sensitivity about the axis e: where (e x up) has a part along the input axis,
  so that gravity leaks in;
- g-sensitivity: that of the azimuth gyro to force along a horizontal input axis, and that of a
  gyro whose drift acts to force along the velocity at the start, which stays behind as a tilt;
- compliance: in azimuth, to level force at right angles to the input axis.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import product
from typing import Any, Final

import numpy as np

from counterspin.arrays import Array
from counterspin.campaign.checking import Path, Problems, did_you_mean
from counterspin.campaign.kinds import exact
from counterspin.campaign.quantity import Quantity, parse
from counterspin.campaign.resolved import EVERYTHING, ErrorModel, Run
from counterspin.campaign.settings import ModelSettings
from counterspin.campaign.toml_file import flat_keys
from counterspin.physics.accelerometer import Mounting
from counterspin.physics.effects import PathError, Turn
from counterspin.physics.grades import DEFAULT_GRADE, GRADES
from counterspin.physics.terms import (
    CONDITION_TERMS,
    INPUTS,
    OWN_TERMS,
    SHARED_TERMS,
    TABLE,
    TERMS,
    Term,
    is_term,
    term,
)

#: The model of a campaign without [model] terms: the paper's.
DEFAULT_TERMS: Final = ("K_F", "K_I", "K_II", "K_III")


def _bare_names() -> dict[str, tuple[Term[Turn | PathError], ...]]:
    names: dict[str, list[Term[Turn | PathError]]] = {}
    for symbol, row in SHARED_TERMS.items():
        parts = symbol.split(".")
        for length in range(2, len(parts)):
            names.setdefault(".".join(parts[:length]), []).append(row)
    return {name: tuple(rows) for name, rows in names.items()}


#: Bare name, such as ``platform.tilt`` or ``encoder.harmonic.1`` -> the rows it stands for.
BARE_NAMES: Final[Mapping[str, tuple[Term[Turn | PathError], ...]]] = _bare_names()

_NORTH: Final = np.array([0.0, 1.0, 0.0])
_UP: Final = np.array([0.0, 0.0, 1.0])
_ROUNDING: Final = 1e-9  #: of a unit vector; above roundoff, below any angle of a mounting


def acts(row: Term[Turn | PathError], mounting: Mounting, attitude: Array) -> bool:
    """Return whether a shared term reaches an accelerometer to first order in some run.

    mounting: The accelerometer's axes while the platform is level.
    attitude: Rows: where the platform's axes point in the run, shape (3, 3).
    """
    input_axis = mounting.turned(attitude).input_axis
    effect = row.effect
    if isinstance(effect, PathError):
        # A tilted axis lifts the platform; all else moves it in the level plane.
        moved = input_axis[2:] if effect.kind == "axis_tilt" else input_axis[:2]
        return float(np.linalg.norm(moved)) > _ROUNDING
    if effect.kind == "compliance":
        return float(np.linalg.norm(np.cross(attitude[effect.axis], input_axis))) > _ROUNDING
    along = effect.force_axis
    steady = along is not None and abs(float(attitude[along] @ _UP)) > _ROUNDING
    if steady and _leans(effect, input_axis, attitude):
        return True  # as a drift
    return _leaves_a_mean(effect, input_axis, attitude, None)


def shows(row: Term[Turn | PathError], mounting: Mounting, attitude: Array) -> bool:
    """Return whether a shared term shows in an accelerometer's output at all, in waves as well.

    In displacement these are nothing beside what `acts` leaves; in velocity and specific force they
    stand where K_II does. Parameters as of `acts`.
    """
    if not isinstance(row.effect, Turn):
        return acts(row, mounting, attitude)
    axis = np.eye(3)[row.effect.axis] if row.effect.kind == "tilt" else attitude[row.effect.axis]
    turned = np.cross(axis, mounting.turned(attitude).input_axis)
    return float(np.linalg.norm(turned)) > _ROUNDING


def _leans(turn: Turn, input_axis: Array, attitude: Array) -> bool:
    """Return whether gravity leaks into the input axis as the platform turns by a term."""
    axis = np.eye(3)[turn.axis] if turn.kind == "tilt" else attitude[turn.axis]
    return abs(float(np.cross(axis, input_axis) @ _UP)) > _ROUNDING


def rows_of(
    name: str, mountings: Iterable[Mounting], attitudes: Iterable[Array]
) -> tuple[Term[Turn | PathError], ...]:
    """Return what a bare name stands for.

    Of the platform these are the components that leave an acceleration, in any run that starts at
    angle zero, in any accelerometer: one that does not average out and that depends on the run.

    mountings, attitudes: Of the campaign's accelerometers and runs.
    """
    pairs = list(product(mountings, attitudes))

    def meant(row: Term[Turn | PathError], mounting: Mounting, attitude: Array) -> bool:
        if isinstance(row.effect, PathError):
            return acts(row, mounting, attitude)
        return _leaves_a_mean(row.effect, mounting.turned(attitude).input_axis, attitude, _NORTH)

    return tuple(row for row in BARE_NAMES[name] if any(meant(row, *pair) for pair in pairs))


def _leaves_a_mean(turn: Turn, input_axis: Array, attitude: Array, start: Array | None) -> bool:
    """Return whether a term leaves an acceleration over whole revolutions.

    input_axis: In the run's attitude, shape (3,).
    start: Direction in which the platform moves at t = 0, shape (3,); None: any level direction.
    """
    # Tilts are about geographic axes, the others about the platform's own.
    axis = np.eye(3)[turn.axis] if turn.kind == "tilt" else attitude[turn.axis]
    turned = np.cross(axis, input_axis)  # gravity leaks in by its vertical part
    leaning = abs(float(turned @ _UP))
    if turn.force_axis is None:
        return leaning > _ROUNDING
    # The vertical force is steady: a sensitivity to it is a drift or a tilt, the same in all runs.
    force = attitude[turn.force_axis] * (1.0 - _UP)
    if turn.kind == "compliance":
        return abs(float(turned @ force)) > _ROUNDING
    # The force's integral is the velocity, a quarter turn behind it.
    across = abs(float(np.cross(_UP, force) @ turned))
    moving = float(np.linalg.norm(force)) if start is None else abs(float(force @ start))
    return max(across, min(leaning, moving)) > _ROUNDING


def resolve_model(
    settings: ModelSettings,
    mountings: Mapping[str, Mounting],
    attitudes: Sequence[Array],
    given: Mapping[str, Mapping[str, Quantity]],
    grades: Mapping[str, str],
    *,
    problems: Problems,
    gravity: float | None,
) -> tuple[ErrorModel, dict[str, dict[str, Quantity]]]:
    """Resolve names, priors and sizes of [model].

    attitudes: Of all runs, each of shape (3, 3).
    given: Accelerometer -> term symbol -> prior from the accelerometer's own table.
    grades: Accelerometer -> grade.
    gravity: The site's gravity, m/s^2.
    """

    def expand(names: Iterable[str], key: str) -> tuple[str, ...]:
        symbols: dict[str, None] = {}
        for index, name in enumerate(names):
            expanded = _expand(name, ("model", key, index), mountings, attitudes, problems)
            if expanded and set(expanded) <= set(symbols):
                problems.add(("model", key, index), f'"{name}" is listed twice')
            symbols.update(dict.fromkeys(expanded))
        return tuple(symbols)

    terms = expand(DEFAULT_TERMS if settings.terms is None else settings.terms, "terms")
    key, names = settings.held
    if settings.hold and settings.considered:
        problems.add(("model", "considered"), "is the old name of hold; keep hold alone")
    held = expand(names, key)
    for symbol in held:
        if symbol in terms:
            problems.add(("model", key), f'"{symbol}" is in model.terms too; keep one')
    if not any(symbol in TERMS for symbol in terms):
        problems.add(("model", "terms"), "names no accelerometer term to estimate")
    platform, accelerometers = _resolve_priors(settings.priors, given, problems, gravity, grades)
    _require_priors(key, held, platform, accelerometers, problems)
    limits = _resolve_sizes("limits", settings.limits, problems, gravity)
    typical = _resolve_sizes("typical", settings.typical, problems, gravity)
    assume = _assumed(settings.assume, problems)
    model = ErrorModel(terms, held, platform, limits, typical, assume)
    for place, name in enumerate(assume):
        if name in (*names, *held):
            problems.add(("model", "assume", place), f'"{name}" is in model.{key} too; keep one')
    return model, accelerometers


def _assumed(names: Sequence[str], problems: Problems) -> tuple[str, ...]:
    """Return what is taken as perfect; each name stands for a term or for a family of them."""
    families = {".".join(s.split(".")[:n]) for s in TABLE for n in range(1, s.count(".") + 2)}
    for place, name in enumerate(names):
        bare = name.removesuffix("*").removesuffix(".")
        if bare not in ("", EVERYTHING) and bare not in families and not is_term(bare):
            known = [EVERYTHING, *TABLE, *families]
            message = f'no term is called "{name}"' + did_you_mean(bare, known)
            problems.add(("model", "assume", place), message)
    return tuple(names)


def with_errors_of_the_path(
    model: ErrorModel, priors: Mapping[str, Quantity], problems: Problems
) -> ErrorModel:
    """Return a model with what [centrifuge] says of the path."""
    for symbol, prior in priors.items():
        if symbol in model.priors:
            problems.add(("model", "priors", symbol), "is given in [centrifuge] too; keep one")
        model = replace(model, priors={**model.priors, symbol: prior})
    return model


def refuse_encoder(model: ErrorModel, problems: Problems) -> None:
    """Note terms of an encoder that records nothing."""
    for key, symbols in (("terms", model.terms), ("hold", model.considered)):
        if any(symbol.startswith("encoder.") for symbol in symbols):
            problems.add(("model", key), "has errors of the encoder, but no angle is recorded")


def _expand(
    name: str,
    path: Path,
    mountings: Mapping[str, Mounting],
    attitudes: Sequence[Array],
    problems: Problems,
) -> tuple[str, ...]:
    if name in OWN_TERMS or name in SHARED_TERMS or (name in INPUTS and path[1] != "terms"):
        return (name,)
    if name not in BARE_NAMES:
        _unknown(name, path, problems)
        return ()
    symbols = tuple(row.symbol for row in rows_of(name, mountings.values(), attitudes))
    if not symbols and mountings and attitudes:
        problems.add(
            path,
            f'no component of "{name}" acts on these accelerometers to first order; '
            f"leave it out, or name one, such as {BARE_NAMES[name][0].symbol}",
        )
    return symbols


def _unknown(name: str, path: Path, problems: Problems) -> None:
    known = [*OWN_TERMS, *BARE_NAMES, *SHARED_TERMS]
    hint = did_you_mean(name, known)
    if "known:" in hint:
        hint = f"; known: {', '.join([*OWN_TERMS, *BARE_NAMES])}"
    problems.add(path, f'no term is called "{name}"' + hint)


def _widest_first(names: Iterable[str]) -> list[str]:
    """Return names in an order in which narrower ones overwrite wider ones."""
    return sorted(names, key=lambda name: -len(BARE_NAMES.get(name, ())))


def _resolve_priors(
    raw: Mapping[str, Any],
    given: Mapping[str, Mapping[str, Quantity]],
    problems: Problems,
    gravity: float | None,
    grades: Mapping[str, str],
) -> tuple[dict[str, Quantity], dict[str, dict[str, Quantity]]]:
    """Return platform priors, and each accelerometer's; a narrower name overrides a wider."""
    platform: dict[str, Quantity] = {}
    merged = {name: dict(priors) for name, priors in given.items()}
    flat = flat_keys(raw)
    for key in _widest_first(flat):
        path = ("model", "priors", key)
        owner, _, last = key.partition(".")
        if owner in given and last in OWN_TERMS:
            symbols, owners = {last}, [owner]
        elif key in OWN_TERMS:
            symbols, owners = {key}, [name for name in given if f"{name}.{key}" not in flat]
            last = key
        elif key in SHARED_TERMS:
            symbols, owners = {key}, []
        elif key in BARE_NAMES:
            symbols, owners = {row.symbol for row in BARE_NAMES[key]}, []
        else:
            _unknown(key, path, problems)
            continue
        unit = term(min(symbols)).unit
        prior = problems.attempt(path, parse, flat[key], unit, gravity=gravity)
        if prior is not None:
            of_owners = (grades.get(name, DEFAULT_GRADE) for name in owners)
            worst = max(of_owners, key=GRADES.index, default=DEFAULT_GRADE)
            problems.attempt(path, about_nominal, min(symbols), prior, worst)
        if prior is None:
            continue
        if symbols <= set(SHARED_TERMS):
            platform |= dict.fromkeys(sorted(symbols), prior)
        for name in owners:
            if last in given[name]:
                problems.add(
                    path, f"a prior of {last} is given in accelerometers.{name} too; keep one"
                )
            merged[name][last] = prior
    return platform, merged


def about_nominal(symbol: str, prior: Quantity, grade: str = DEFAULT_GRADE) -> Quantity:
    """Return a prior that is credible: a scale factor is given as its value, about 1."""
    row = term(symbol)
    if row.nominal and abs(prior.value - row.nominal) > row.sizes(grade).limit:
        raise ValueError(
            f"{prior.value:.6g} {row.unit} is too far from {row.nominal:g}, the nominal {symbol}; "
            f"an error of 1000 ppm is written {1.001 * row.nominal:g} {row.unit}"
        )
    return prior


def _require_priors(
    key: str,
    held: Iterable[str],
    platform: Mapping[str, Quantity],
    accelerometers: Mapping[str, Mapping[str, Quantity]],
    problems: Problems,
) -> None:
    for symbol in (symbol for symbol in held if symbol not in INPUTS):
        lacking = (
            [name for name, priors in accelerometers.items() if symbol not in priors]
            if symbol in OWN_TERMS
            else []
            if symbol in platform
            else ["the machine"]
        )
        if lacking:
            problems.add(
                ("model", key),
                f'"{symbol}" is held, but there is no prior for {", ".join(lacking)}; '
                f'add "{symbol}" = "VALUE ± U {term(symbol).unit}" to [model.priors]',
            )


def _resolve_sizes(
    kind: str, raw: Mapping[str, Any], problems: Problems, gravity: float | None
) -> dict[str, float]:
    """Return the largest credible sizes (``limits``) or ``typical`` ones that are stated."""
    sizes: dict[str, float] = {}
    flat = flat_keys(raw)
    for key in _widest_first(flat):
        path = ("model", kind, key)
        symbols = [row.symbol for row in BARE_NAMES.get(key, ())] or [key]
        if not is_term(symbols[0]):
            _unknown(key, path, problems)
            continue
        size = problems.attempt(path, exact, flat[key], term(symbols[0]).unit, gravity)
        if size is not None and size <= 0.0:
            problems.add(path, "must be greater than zero")
        elif size is not None:
            sizes |= dict.fromkeys(symbols, size)
    return sizes


def check_conditions(
    model: ErrorModel,
    also: Iterable[str],
    runs: Sequence[tuple[int, Run]],
    reference: float | None,
    problems: Problems,
) -> None:
    """Note what is missing for the slopes of a model, and slopes that nothing determines.

    reference: The reference temperature, K, if there is one.
    """
    for symbol, row in CONDITION_TERMS.items():
        if row.effect.condition == "force" and symbol in model.terms:
            problems.add(
                ("model", "terms"),
                f'"{symbol}" cannot be told from K_II; state what is known of it in [model.priors]',
            )
    used = [row for s, row in CONDITION_TERMS.items() if s in {*model.terms, *model.considered}]
    used += [row for s, row in CONDITION_TERMS.items() if s in set(also)]
    for key in ("temperature", "time"):
        conditions = (key, "direction") if key == "temperature" else (key,)
        asking = next((row.symbol for row in used if row.effect.condition in conditions), None)
        stated = [getattr(run, key) is not None for _, run in runs]
        if asking is None and (key == "temperature" or not any(stated)):
            continue
        why = f"{asking} is in the model" if asking else "other runs state theirs"
        for (place, _), there in zip(runs, stated, strict=True):
            if not there:
                example = '"23.4 degC"' if key == "temperature" else '"12 min"'
                problems.add(
                    ("runs", place, key), f"is missing: {why}; write {key} = {example}, or the like"
                )
        if asking and key == "temperature" and reference is None and runs and all(stated):
            temperatures = {run.temperature for _, run in runs}
            if len(temperatures) == 1:
                problems.add(
                    ("centrifuge", "reference_temperature"),
                    f"is missing: {asking} is in the model, and all runs are at one temperature",
                )

"""[model], with what [centrifuge] and [fixture] say of terms: what is asked for, held and known."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cached_property
from typing import Any, Final

from counterspin.arrays import Array
from counterspin.campaign.checking import Problems, did_you_mean
from counterspin.campaign.documents import KeyPath, flat_keys
from counterspin.campaign.kinds import exact
from counterspin.campaign.quantity import Quantity, parse
from counterspin.campaign.reading import Reading
from counterspin.campaign.settings import CentrifugeSettings, ModelSettings
from counterspin.campaign.terms import (
    BARE_NAMES,
    POSITION,
    expand,
    of_readings,
    rows_of,
    symbols_shown,
)
from counterspin.frozen import frozen
from counterspin.physics.accelerometer import Mounting
from counterspin.physics.grades import DEFAULT_GRADE, GRADES
from counterspin.physics.terms import (
    ACCELEROMETER_TERMS,
    CONDITION_TERMS,
    INPUTS,
    SHARED_TERMS,
    TABLE,
    TERMS,
    accelerometer_of,
    is_term,
    same_for_all,
    term,
)

#: What is asked for where [model] names no terms: of records, the paper's; of readings at rest, and
#: on a machine.
DEFAULT_TERMS: Final = ("K_F", "K_I", "K_II", "K_III")
_TERMS_AT_REST: Final = ("K_F", "K_I")
TERMS_ON_A_MACHINE: Final = (*_TERMS_AT_REST, "K_II")

#: In ``assume``: whatever is not stated.
EVERYTHING: Final = "all"

#: Fewest poses by which angles between axes are asked for: they are three of nine unknowns.
_POSES_FOR_ANGLES: Final = 9

#: A radius that is given below this part of the machine's is a deviation from it.
_DEVIATION_PART: Final = 0.5


@frozen
class ErrorModel:
    """The terms of a campaign: requested, held, and taken as perfect.

    All other effects are nuisance parameters.
    """

    #: Symbols asked for, those of mountings with their names; bare names are resolved to the
    #: components that act.
    terms: tuple[str, ...]
    #: Symbols that are held: known but not adjusted, their prior's u is carried.
    considered: tuple[str, ...]
    #: Symbol of a shared term -> prior, less nominal, SI (tilt: one of each run). Those of
    #: accelerometer terms are in `Accelerometer.priors`.
    priors: Mapping[str, Quantity]
    #: Symbol -> largest credible size, and standard uncertainty to assume where none is stated, in
    #: the table's unit: where the campaign states them. `Campaign.limit_of` and
    #: `Campaign.typical_of` know all.
    limits: Mapping[str, float]
    typical: Mapping[str, float]
    #: What is taken as perfect where nothing is stated: names, ``platform.*``, ``all``.
    assume: tuple[str, ...] = ()
    setting: Quantity | None = None  #: Error of setting a position at rest, where one is stated.
    named: bool = False  #: Whether the description names the terms, and not the usual ones count.

    def assumes(self, symbol: str) -> bool:
        """Return whether a term, or an input, is taken as perfect unless it is stated."""
        names = (name.removesuffix("*").removesuffix(".") for name in self.assume)
        symbols = (symbol, same_for_all(symbol))
        return any(
            name in ("", EVERYTHING, *symbols) or symbol.startswith(f"{name}.") for name in names
        )


@frozen(eq=False)
class Apparatus:
    """The recorded or read apparatus of a campaign, on which its terms act."""

    mountings: Mapping[str, Mounting]  #: Accelerometer -> its axes while the platform is level.
    grades: Mapping[str, str]  #: Accelerometer -> grade.
    attitudes: Sequence[Array]  #: Of the runs with records, each of shape (3, 3).
    readings: Sequence[Reading]  #: At known attitudes.
    poses: int  #: How many there are at unknown ones, as far as that is known.
    #: The machine, if there is one; its stretch, droop and tilt are priors.
    centrifuge: CentrifugeSettings | None
    setting: Quantity | None  #: Error of setting a position, where one is stated.
    whole: bool = True  #: Whether there are no other readings, with mistakes in them.

    @property
    def read(self) -> bool:
        """True if there are readings, at known attitudes or unknown ones."""
        return bool(self.readings or self.poses or not self.whole)

    @cached_property
    def shown(self) -> tuple[str, ...]:
        """Terms of the machine and slopes that the readings show; none without readings."""
        shown = symbols_shown(self.readings, recorded=bool(self.attitudes)) if self.read else ()
        if not self.poses:
            return shown
        # Of a pose only what its accelerometers themselves do is seen.
        slopes = (s for s, row in CONDITION_TERMS.items() if row.effect.condition != "force")
        return tuple(dict.fromkeys([*shown, *slopes]))

    @property
    def usual_terms(self) -> tuple[str, ...]:
        """The requested terms if [model] names none."""
        motions = {reading.motion for reading in self.readings}
        if not self.read or self.attitudes or "counter-rotating" in motions:
            return DEFAULT_TERMS
        terms = _TERMS_AT_REST if motions <= {"static"} else TERMS_ON_A_MACHINE
        if self.poses >= _POSES_FOR_ANGLES:
            return (*terms, "delta_O", "delta_P")
        return (*terms, *self._misalignments(len(terms)))

    def _misalignments(self, beside: int) -> list[str]:
        """Return the misalignments that positions at rest show, if there are readings for them.

        An instrument is never on its fixture without any: left out they would be a lack of fit.
        """
        shown: list[str] = []
        for symbol, axis in (("delta_O", 1), ("delta_P", 2)):
            at_rest = (r for r in self.readings if r.motion == "static")
            along = {round(reading.axes.matrix[axis][2], 6) for reading in at_rest}
            if len(along) > 1 and len(self.readings) > beside + len(shown) + 1:
                shown.append(symbol)
        return shown

    def stated(self, asked: Iterable[str]) -> dict[str, Quantity]:
        """Return the terms that [fixture] and [centrifuge] state, as deviations, SI.

        asked: Symbols that are requested or held: the prior of a mounting's own radius includes the
            centrifuge's.
        """
        known = dict.fromkeys(expand(POSITION, self.shown), self.setting) if self.setting else {}
        machine = self.centrifuge
        if machine is None:
            return known
        known |= {} if machine.stretch is None else {"centrifuge.stretch": machine.stretch}
        if machine.axis_tilt is not None:
            axes = ("centrifuge.axis_tilt.east", "centrifuge.axis_tilt.north")
            known |= dict.fromkeys(axes, machine.axis_tilt)
        if machine.droop is not None and self.read:
            known["centrifuge.droop"] = machine.droop
        if u := machine.radius.u:
            own = [s for s in self.shown if s.startswith("centrifuge.radius.") and s in set(asked)]
            known |= dict.fromkeys(own, Quantity(0.0, u, "m"))
        return known


def resolve_model(
    settings: ModelSettings,
    given: Mapping[str, Mapping[str, Quantity]],
    on: Apparatus,
    problems: Problems,
    gravity: float | None,
) -> tuple[ErrorModel, dict[str, dict[str, Quantity]]]:
    """Resolve names, priors and sizes of [model]; return it, and each accelerometer's priors.

    given: Accelerometer -> term symbol -> prior from the accelerometer's own table.
    gravity: The site's gravity, m/s^2.
    """
    asked = on.usual_terms if settings.terms is None else settings.terms
    terms = _listed(asked, "terms", on, problems)
    key, names = settings.held
    if settings.hold and settings.considered:
        problems.add(("model", "considered"), "is the old name of hold; keep hold alone")
    held = _listed(names, key, on, problems)
    for symbol in held:
        if symbol in terms:
            problems.add(("model", key), f'"{symbol}" is in model.terms too; keep one')
    if not any(symbol in TERMS for symbol in terms):
        problems.add(("model", "terms"), "contains no accelerometer term to estimate")
    shared, own = _resolve_priors(settings.priors, given, on, problems, gravity)
    of_machine = on.stated((*terms, *held))
    for symbol in shared.keys() & of_machine.keys() if not on.read else ():
        problems.add(("model", "priors", symbol), "is given in [centrifuge] too; keep one")
    shared = of_machine | shared
    for symbol, lacking in _without_prior(held, shared, own):
        problems.add(
            ("model", key),
            f'"{symbol}" is held, but there is no prior for {lacking}; '
            f'add "{symbol}" = "VALUE ± U {term(symbol).unit}" to [model.priors]',
        )
    for symbol in (*terms, *held, *shared):
        if accelerometer_of(symbol) and same_for_all(symbol) in {*terms, *held, *shared}:
            said = f'"{same_for_all(symbol)}" is for all accelerometers; "{symbol}" is given too'
            problems.add(("model",), f"{said}; keep one")
            break
    limits = _resolve_sizes("limits", settings.limits, problems, gravity)
    typical = _resolve_sizes("typical", settings.typical, problems, gravity)
    assume = _assumed(settings.assume, problems)
    for place, name in enumerate(assume):
        if name in (*names, *held):
            problems.add(("model", "assume", place), f'"{name}" is in model.{key} too; keep one')
    named = settings.terms is not None
    return ErrorModel(terms, held, shared, limits, typical, assume, on.setting, named), own


def _assumed(names: Sequence[str], problems: Problems) -> tuple[str, ...]:
    """Return the terms taken as perfect; each name is a term or a family of terms."""
    parts = (s.split(".")[:n] for s in TABLE for n in range(1, s.count(".") + 2))
    families = dict.fromkeys(".".join(part) for part in parts)
    for place, name in enumerate(names):
        bare = name.removesuffix("*").removesuffix(".")
        if bare not in ("", EVERYTHING) and bare not in families and not is_term(bare):
            known = [EVERYTHING, *TABLE, *families]
            message = f'unknown term "{name}"' + did_you_mean(bare, known)
            problems.add(("model", "assume", place), message)
    return tuple(names)


def _listed(names: Iterable[str], key: str, on: Apparatus, problems: Problems) -> tuple[str, ...]:
    """Return the symbols of a list of names."""
    symbols: dict[str, None] = {}
    for index, name in enumerate(names):
        path = ("model", key, index)
        found = _symbols(name, path, on, problems)
        if found and set(found) <= set(symbols):
            problems.add(path, f'"{name}" is listed twice')
        row = CONDITION_TERMS.get(name)
        if key == "terms" and row is not None and row.effect.condition == "force":
            problems.add(
                path,
                f'"{name}" cannot be separated from K_II; state what is known of it in '
                f"[model.priors]",
            )
        symbols |= dict.fromkeys(found)
    return tuple(symbols)


def _symbols(name: str, path: KeyPath, on: Apparatus, problems: Problems) -> tuple[str, ...]:
    """Return the symbols of a name in a list."""
    if on.read and of_readings(name):
        return _read(name, path, on, problems)
    if (
        name in ACCELEROMETER_TERMS
        or name in SHARED_TERMS
        or (name in INPUTS and path[1] != "terms")
    ):
        return (name,)
    if name not in BARE_NAMES:
        _unknown(name, path, problems)
        return ()
    symbols = tuple(row.symbol for row in rows_of(name, on.mountings.values(), on.attitudes))
    if not symbols and on.mountings and on.attitudes:
        problems.add(
            path,
            f'no component of "{name}" acts on these accelerometers to first order; '
            f"leave it out, or name one, such as {BARE_NAMES[name][0].symbol}",
        )
    return symbols


def _read(name: str, path: KeyPath, on: Apparatus, problems: Problems) -> tuple[str, ...]:
    """Expand a name of the machine, or of a slope, to the terms that readings show."""
    found = expand(name, on.shown)
    if not found and on.whole:
        problems.add(path, f'no reading depends on "{name}"' + did_you_mean(name, on.shown))
    return found if name in found else _without_doubles(found)


def _without_doubles(symbols: Sequence[str]) -> tuple[str, ...]:
    """Return the terms of a family with one radius for each mounting and accelerometer.

    With several accelerometers each has a radius; with one, the mounting has it.
    """
    several = len({owner for symbol in symbols if (owner := accelerometer_of(symbol))}) > 1
    doubled = {same_for_all(symbol) for symbol in symbols if accelerometer_of(symbol)}
    return tuple(s for s in symbols if not (s in doubled if several else accelerometer_of(s)))


def _unknown(name: str, path: KeyPath, problems: Problems) -> None:
    known = [*ACCELEROMETER_TERMS, *BARE_NAMES, *SHARED_TERMS]
    hint = did_you_mean(name, known)
    if "known:" in hint:
        hint = f"; known: {', '.join([*ACCELEROMETER_TERMS, *BARE_NAMES])}"
    problems.add(path, f'unknown term "{name}"' + hint)


def _widest_first(names: Iterable[str]) -> list[str]:
    """Return names in an order in which narrower ones overwrite wider ones."""
    return sorted(names, key=lambda name: name.count("."))


def _resolve_priors(
    raw: Mapping[str, Any],
    given: Mapping[str, Mapping[str, Quantity]],
    on: Apparatus,
    problems: Problems,
    gravity: float | None,
) -> tuple[dict[str, Quantity], dict[str, dict[str, Quantity]]]:
    """Return priors that all share, and each accelerometer's; a narrower name overrides a wider."""
    shared: dict[str, Quantity] = {}
    merged = {name: dict(priors) for name, priors in given.items()}
    flat = flat_keys(raw)
    for key in _widest_first(flat):
        path = ("model", "priors", key)
        owner, _, last = key.partition(".")
        owners: Sequence[str] = ()
        symbols: Sequence[str] = (key,)
        if read := on.read and of_readings(key):
            symbols = _read(key, path, on, problems)
        elif owner in given and last in ACCELEROMETER_TERMS:
            symbols, owners = (last,), (owner,)
        elif key in ACCELEROMETER_TERMS:
            last, owners = key, [name for name in given if f"{name}.{key}" not in flat]
        elif key in BARE_NAMES:
            symbols = [row.symbol for row in BARE_NAMES[key]]
        elif key not in SHARED_TERMS:
            _unknown(key, path, problems)
            continue
        if not symbols:
            continue
        prior = problems.attempt(path, parse, flat[key], term(symbols[0]).unit, gravity=gravity)
        if prior is None:
            continue
        of_owners = (on.grades.get(name, DEFAULT_GRADE) for name in owners)
        worst = max(of_owners, key=GRADES.index, default=DEFAULT_GRADE)
        problems.attempt(path, about_nominal, symbols[0], prior, worst)
        if read or symbols[0] not in ACCELEROMETER_TERMS:
            shared |= {symbol: less_nominal(symbol, prior, on.centrifuge) for symbol in symbols}
        for name in owners:
            if last in given[name]:
                problems.add(
                    path, f"a prior of {last} is given in accelerometers.{name} too; keep one"
                )
            merged[name][last] = prior
    return shared, merged


def less_nominal(symbol: str, prior: Quantity, centrifuge: CentrifugeSettings | None) -> Quantity:
    """Return a prior as a deviation: a radius may be given as such, or as its deviation."""
    if not symbol.startswith("centrifuge.radius.") or centrifuge is None:
        return prior
    radius = centrifuge.radius.value
    value = prior.value - radius if prior.value > _DEVIATION_PART * radius else prior.value
    return Quantity(value, prior.u, prior.unit)


def about_nominal(symbol: str, prior: Quantity, grade: str = DEFAULT_GRADE) -> Quantity:
    """Return a prior that is credible: a scale factor is given as its value, about 1."""
    row = term(symbol)
    if row.nominal and abs(prior.value - row.nominal) > row.sizes(grade).limit:
        raise ValueError(
            f"{prior.value:.6g} {row.unit} is too far from {row.nominal:g}, the nominal {symbol}; "
            f"an error of 1000 ppm is written {1.001 * row.nominal:g} {row.unit}"
        )
    return prior


def _without_prior(
    held: Iterable[str],
    shared: Mapping[str, Quantity],
    own: Mapping[str, Mapping[str, Quantity]],
) -> Iterator[tuple[str, str]]:
    """Yield symbols of which nothing is known, and of whom."""
    for symbol in held:
        if symbol in INPUTS or symbol in shared:
            continue
        lacking = [name for name, priors in own.items() if symbol not in priors]
        if symbol not in ACCELEROMETER_TERMS or lacking:
            yield symbol, ", ".join(lacking) if symbol in ACCELEROMETER_TERMS else "the machine"


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

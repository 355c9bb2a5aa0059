"""[model], and the terms in [centrifuge] and [fixture]: requested terms, fixed terms and priors."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import field, replace
from functools import cached_property
from typing import Any, Final

from counterspin.arrays import Array
from counterspin.campaign.correlations import CORRELATION, read_correlations
from counterspin.campaign.distribution import is_prior_table, parse_prior
from counterspin.campaign.documents import KeyPath, flatten_keys
from counterspin.campaign.field_types import exact
from counterspin.campaign.quantity import Quantity
from counterspin.campaign.reading import Reading
from counterspin.campaign.settings import CentrifugeSettings, ModelSettings
from counterspin.campaign.terms import (
    BARE_NAMES,
    POSITION,
    expand,
    is_reading_term,
    rows_of,
    symbols_shown,
)
from counterspin.campaign.validation import Problems, suggest_name
from counterspin.errors import OutOfRangeError
from counterspin.frozen import frozen
from counterspin.physics.accelerometer import Mounting
from counterspin.physics.grades import DEFAULT_GRADE, GRADES
from counterspin.physics.terms import (
    ACCELEROMETER_TERMS,
    INPUTS,
    SHARED_TERMS,
    TABLE,
    TERMS,
    accelerometer_name,
    condition_of,
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
ALL_TERMS: Final = "all"

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
    #: Full name of a term -> stated correlation of its prior with those of other terms.
    correlations: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    setting: Quantity | None = None  #: Error of setting a position at rest, where one is stated.
    named: bool = False  #: Whether the description names the terms, and not the usual ones count.

    def assumes(self, symbol: str) -> bool:
        """Return whether a term, or an input, is taken as perfect unless it is stated."""
        names = (name.removesuffix("*").removesuffix(".") for name in self.assume)
        symbols = (symbol, same_for_all(symbol))
        return any(
            name in ("", ALL_TERMS, *symbols) or symbol.startswith(f"{name}.") for name in names
        )


@frozen(eq=False)
class MeasurementSetup:
    """The recorded or read apparatus of a campaign, on which its terms act."""

    mountings: Mapping[str, Mounting]  #: Accelerometer -> its axes while the platform is level.
    grades: Mapping[str, str]  #: Accelerometer -> grade.
    attitudes: Sequence[Array]  #: Of the runs with records, each of shape (3, 3).
    readings: Sequence[Reading]  #: At known attitudes.
    poses: int  #: How many there are at unknown ones, as far as that is known.
    #: The machine, if there is one; its stretch, droop and tilt are priors.
    centrifuge: CentrifugeSettings | None
    setting: Quantity | None  #: Error of setting a position, where one is stated.
    is_complete: bool = True  #: Whether there are no other readings, with mistakes in them.

    @property
    def has_readings(self) -> bool:
        """True if there are readings, at known attitudes or unknown ones."""
        return bool(self.readings or self.poses or not self.is_complete)

    @cached_property
    def observable_terms(self) -> tuple[str, ...]:
        """Terms of the machine and slopes that the readings show; none without readings."""
        terms = (
            symbols_shown(self.readings, recorded=bool(self.attitudes)) if self.has_readings else ()
        )
        if not self.poses:
            return terms
        # Of a pose only what its accelerometers themselves do is seen.
        slopes = (
            symbol for symbol in ACCELEROMETER_TERMS if condition_of(symbol) not in ("", "force")
        )
        return tuple(dict.fromkeys([*terms, *slopes]))

    @property
    def usual_terms(self) -> tuple[str, ...]:
        """The requested terms if [model] names none."""
        motions = {reading.motion for reading in self.readings}
        if not self.has_readings or self.attitudes or "counter-rotating" in motions:
            return DEFAULT_TERMS
        terms = _TERMS_AT_REST if motions <= {"static"} else TERMS_ON_A_MACHINE
        if self.poses >= _POSES_FOR_ANGLES:
            return (*terms, "delta_O", "delta_P")
        return (*terms, *self._misalignments(len(terms)))

    def _misalignments(self, term_count: int) -> list[str]:
        """Return the misalignments that positions at rest show, if there are readings for them.

        An instrument is never on its fixture without any: left out they would be a lack of fit.
        """
        symbols: list[str] = []
        for symbol, axis in (("delta_O", 1), ("delta_P", 2)):
            at_rest = (r for r in self.readings if r.motion == "static")
            axis_components = {round(reading.axes.matrix[axis][2], 6) for reading in at_rest}
            if len(axis_components) > 1 and len(self.readings) > term_count + len(symbols) + 1:
                symbols.append(symbol)
        return symbols

    def setup_priors(self, requested: Iterable[str]) -> dict[str, Quantity]:
        """Return the terms that [fixture] and [centrifuge] state, as deviations, SI.

        requested: Symbols that are requested or held: the prior of a mounting's own radius includes
            the centrifuge's.
        """
        priors = (
            dict.fromkeys(expand(POSITION, self.observable_terms), self.setting)
            if self.setting
            else {}
        )
        machine = self.centrifuge
        if machine is None:
            return priors
        priors |= {} if machine.stretch is None else {"centrifuge.stretch": machine.stretch}
        if machine.axis_tilt is not None:
            axes = ("centrifuge.axis_tilt.east", "centrifuge.axis_tilt.north")
            priors |= dict.fromkeys(axes, machine.axis_tilt)
        if machine.droop is not None and self.has_readings:
            priors["centrifuge.droop"] = machine.droop
        if machine.radius.u:
            radius_symbols = [
                symbol
                for symbol in self.observable_terms
                if symbol.startswith("centrifuge.radius.") and symbol in set(requested)
            ]
            deviation = replace(machine.radius, value=0.0)
            priors |= dict.fromkeys(radius_symbols, deviation)
        return priors


def resolve_model(
    settings: ModelSettings,
    stated_priors: Mapping[str, Mapping[str, Quantity]],
    setup: MeasurementSetup,
    problems: Problems,
    gravity: float | None,
) -> tuple[ErrorModel, dict[str, dict[str, Quantity]]]:
    """Resolve names, priors and sizes of [model]; return it, and each accelerometer's priors.

    stated_priors: Accelerometer -> term symbol -> prior from the accelerometer's own table.
    gravity: The site's gravity, m/s^2.
    """
    names_of_terms = setup.usual_terms if settings.terms is None else settings.terms
    terms = _resolve_names(names_of_terms, "terms", setup, problems)
    key, names = settings.held
    if settings.hold and settings.considered:
        problems.add(("model", "considered"), "this key is the former name of hold; keep only hold")
    considered = _resolve_names(names, key, setup, problems)
    for symbol in considered:
        if symbol in terms:
            problems.add(
                ("model", key), f'"{symbol}" is also in model.terms; keep only one of them'
            )
    if not any(symbol in TERMS for symbol in terms):
        problems.add(
            ("model", "terms"), "contains no accelerometer term to estimate", "missing-value"
        )
    shared, accelerometer_priors = _resolve_priors(
        settings.priors, stated_priors, setup, problems, gravity
    )
    setup_priors = setup.setup_priors((*terms, *considered))
    for symbol in shared.keys() & setup_priors.keys() if not setup.has_readings else ():
        problems.add(
            ("model", "priors", symbol), "is also given in [centrifuge]; keep only one of them"
        )
    shared = setup_priors | shared
    for symbol, missing in _missing_priors(considered, shared, accelerometer_priors):
        problems.add(
            ("model", key),
            f'"{symbol}" is held, but no prior is stated for {missing}; '
            f'add "{symbol}" = "VALUE ± U {term(symbol).unit}" to [model.priors]',
            "missing-prior",
        )
    for symbol in (*terms, *considered, *shared):
        if accelerometer_name(symbol) and same_for_all(symbol) in {*terms, *considered, *shared}:
            general = same_for_all(symbol)
            message = f'"{general}" applies to all accelerometers, but "{symbol}" is given too'
            problems.add(("model",), f"{message}; keep one")
            break
    correlations = read_correlations(
        settings.priors.get(CORRELATION, []),
        accelerometer_priors,
        considered,
        problems,
    )
    limits = _resolve_sizes("limits", settings.limits, problems, gravity)
    typical = _resolve_sizes("typical", settings.typical, problems, gravity)
    assume = _resolve_assumed(settings.assume, problems)
    for place, name in enumerate(assume):
        if name in (*names, *considered):
            problems.add(
                ("model", "assume", place),
                f'"{name}" is also in model.{key}; keep only one of them',
            )
    named = settings.terms is not None
    return ErrorModel(
        terms,
        considered,
        shared,
        limits,
        typical,
        assume,
        correlations,
        setup.setting,
        named,
    ), accelerometer_priors


def _resolve_assumed(names: Sequence[str], problems: Problems) -> tuple[str, ...]:
    """Return the terms taken as perfect; each name is a term or a family of terms."""
    prefixes = (symbol.split(".")[:n] for symbol in TABLE for n in range(1, symbol.count(".") + 2))
    families = dict.fromkeys(".".join(prefix) for prefix in prefixes)
    for place, name in enumerate(names):
        bare = name.removesuffix("*").removesuffix(".")
        if bare not in ("", ALL_TERMS) and bare not in families and not is_term(bare):
            known = [ALL_TERMS, *TABLE, *families]
            message = f'unknown term "{name}"' + suggest_name(bare, known)
            problems.add(("model", "assume", place), message, "unknown-term")
    return tuple(names)


def _resolve_names(
    names: Iterable[str], key: str, setup: MeasurementSetup, problems: Problems
) -> tuple[str, ...]:
    """Return the symbols of a list of names."""
    symbols: dict[str, None] = {}
    for index, name in enumerate(names):
        path = ("model", key, index)
        resolved = _resolve_symbols(name, path, setup, problems)
        if resolved and set(resolved) <= set(symbols):
            problems.add(path, f'"{name}" is listed twice', "duplicate-entry")
        if key == "terms" and condition_of(name) == "force":
            problems.add(
                path,
                f'"{name}" cannot be separated from K_II; state a prior for it in [model.priors]',
                "missing-prior",
            )
        symbols |= dict.fromkeys(resolved)
    return tuple(symbols)


def _resolve_symbols(
    name: str, path: KeyPath, setup: MeasurementSetup, problems: Problems
) -> tuple[str, ...]:
    """Return the symbols of a name in a list."""
    if setup.has_readings and is_reading_term(name):
        return _observable_symbols(name, path, setup, problems)
    if (
        name in ACCELEROMETER_TERMS
        or name in SHARED_TERMS
        or (name in INPUTS and path[1] != "terms")
    ):
        return (name,)
    if name not in BARE_NAMES:
        _report_unknown(name, path, problems)
        return ()
    symbols = tuple(row.symbol for row in rows_of(name, setup.mountings.values(), setup.attitudes))
    if not symbols and setup.mountings and setup.attitudes:
        problems.add(
            path,
            f'no component of "{name}" affects these accelerometers to first order; omit it, or '
            f"name a single component, such as {BARE_NAMES[name][0].symbol}",
            "term-without-effect",
        )
    return symbols


def _observable_symbols(
    name: str, path: KeyPath, setup: MeasurementSetup, problems: Problems
) -> tuple[str, ...]:
    """Expand a name of the machine, or of a slope, to the terms that readings show."""
    expanded = expand(name, setup.observable_terms)
    if not expanded and setup.is_complete:
        problems.add(
            path,
            f'no reading depends on "{name}"' + suggest_name(name, setup.observable_terms),
            "term-without-effect",
        )
    return expanded if name in expanded else _remove_duplicates(expanded)


def _remove_duplicates(symbols: Sequence[str]) -> tuple[str, ...]:
    """Return the terms of a family with one radius for each mounting and accelerometer.

    With several accelerometers each has a radius; with one, the mounting has it.
    """
    has_several = len({owner for symbol in symbols if (owner := accelerometer_name(symbol))}) > 1
    common = {same_for_all(symbol) for symbol in symbols if accelerometer_name(symbol)}
    return tuple(s for s in symbols if not (s in common if has_several else accelerometer_name(s)))


def _report_unknown(name: str, path: KeyPath, problems: Problems) -> None:
    known = [*ACCELEROMETER_TERMS, *BARE_NAMES, *SHARED_TERMS]
    hint = suggest_name(name, known)
    if "known:" in hint:
        hint = f"; known: {', '.join([*ACCELEROMETER_TERMS, *BARE_NAMES])}"
    problems.add(path, f'unknown term "{name}"' + hint, "unknown-term")


def _widest_first(names: Iterable[str]) -> list[str]:
    """Return names in an order in which narrower ones overwrite wider ones."""
    return sorted(names, key=lambda name: name.count("."))


def _resolve_priors(
    raw: Mapping[str, Any],
    stated_priors: Mapping[str, Mapping[str, Quantity]],
    setup: MeasurementSetup,
    problems: Problems,
    gravity: float | None,
) -> tuple[dict[str, Quantity], dict[str, dict[str, Quantity]]]:
    """Return priors that all share, and each accelerometer's; a narrower name overrides a wider."""
    shared: dict[str, Quantity] = {}
    merged = {name: dict(priors) for name, priors in stated_priors.items()}
    flat = flatten_keys(raw, is_value=is_prior_table)
    for key in _widest_first(key for key in flat if key != CORRELATION):
        path = ("model", "priors", key)
        owner, _, symbol_part = key.partition(".")
        owners: Sequence[str] = ()
        symbols: Sequence[str] = (key,)
        if read := setup.has_readings and is_reading_term(key):
            symbols = _observable_symbols(key, path, setup, problems)
        elif owner in stated_priors and symbol_part in ACCELEROMETER_TERMS:
            symbols, owners = (symbol_part,), (owner,)
        elif key in ACCELEROMETER_TERMS:
            symbol_part, owners = (
                key,
                [name for name in stated_priors if f"{name}.{key}" not in flat],
            )
        elif key in BARE_NAMES:
            symbols = [row.symbol for row in BARE_NAMES[key]]
        elif key not in SHARED_TERMS:
            _report_unknown(key, path, problems)
            continue
        if not symbols:
            continue
        unit = term(symbols[0]).unit
        prior = problems.collect(path, parse_prior, flat[key], unit, gravity=gravity)
        if prior is None:
            continue
        grades = (setup.grades.get(name, DEFAULT_GRADE) for name in owners)
        widest_grade = max(grades, key=GRADES.index, default=DEFAULT_GRADE)
        problems.collect(path, check_near_nominal, symbols[0], prior, widest_grade)
        if read or symbols[0] not in ACCELEROMETER_TERMS:
            shared |= {symbol: as_deviation(symbol, prior, setup.centrifuge) for symbol in symbols}
        for name in owners:
            if symbol_part in stated_priors[name]:
                problems.add(
                    path,
                    f"a prior for {symbol_part} is also given in accelerometers.{name}; keep only "
                    "one of them",
                )
            merged[name][symbol_part] = prior
    return shared, merged


def as_deviation(symbol: str, prior: Quantity, centrifuge: CentrifugeSettings | None) -> Quantity:
    """Return a prior as a deviation: a radius may be given as such, or as its deviation."""
    if not symbol.startswith("centrifuge.radius.") or centrifuge is None:
        return prior
    radius = centrifuge.radius.value
    value = prior.value - radius if prior.value > _DEVIATION_PART * radius else prior.value
    return replace(prior, value=value)


def check_near_nominal(symbol: str, prior: Quantity, grade: str = DEFAULT_GRADE) -> Quantity:
    """Return a prior that is credible: a scale factor is given as its value, about 1."""
    row = term(symbol)
    if row.nominal and abs(prior.value - row.nominal) > row.sizes(grade).limit:
        raise OutOfRangeError(
            f"{prior.value:.6g} {row.unit} is too far from the nominal {symbol}, "
            f"{row.nominal:g}; write an error of 1000 ppm as {1.001 * row.nominal:g} {row.unit}"
        )
    return prior


def _missing_priors(
    considered: Iterable[str],
    shared: Mapping[str, Quantity],
    accelerometer_priors: Mapping[str, Mapping[str, Quantity]],
) -> Iterator[tuple[str, str]]:
    """Yield symbols of which nothing is known, and of whom."""
    for symbol in considered:
        if symbol in INPUTS or symbol in shared:
            continue
        missing = [name for name, priors in accelerometer_priors.items() if symbol not in priors]
        if symbol not in ACCELEROMETER_TERMS or missing:
            yield symbol, ", ".join(missing) if symbol in ACCELEROMETER_TERMS else "the machine"


def _resolve_sizes(
    kind: str, raw: Mapping[str, Any], problems: Problems, gravity: float | None
) -> dict[str, float]:
    """Return the largest credible sizes (``limits``) or ``typical`` ones that are stated."""
    sizes: dict[str, float] = {}
    flat = flatten_keys(raw)
    for key in _widest_first(flat):
        path = ("model", kind, key)
        symbols = [row.symbol for row in BARE_NAMES.get(key, ())] or [key]
        if not is_term(symbols[0]):
            _report_unknown(key, path, problems)
            continue
        size = problems.collect(path, exact, flat[key], term(symbols[0]).unit, gravity)
        if size is not None and size <= 0.0:
            problems.add(path, "must be greater than zero", "value-out-of-range")
        elif size is not None:
            sizes |= dict.fromkeys(symbols, size)
    return sizes

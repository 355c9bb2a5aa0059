"""[model], and the terms in [centrifuge] and [fixture]: requested terms, fixed terms and priors."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import field, replace
from functools import cached_property
from typing import Any, Final

from counterspin.arrays import Array
from counterspin.campaign.correlations import CORRELATION_KEY, read_correlations
from counterspin.campaign.distribution import is_prior_table, parse_prior
from counterspin.campaign.documents import KeyPath, flatten_keys
from counterspin.campaign.field_types import parse_exact
from counterspin.campaign.quantity import Quantity
from counterspin.campaign.reading import Reading
from counterspin.campaign.settings import CentrifugeSettings, ModelSettings
from counterspin.campaign.terms import (
    BARE_NAMES,
    POSITION_SYMBOL,
    acting_rows,
    expand_name,
    is_reading_term,
    shown_symbols,
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
    shared_symbol,
    term,
)

#: Requested terms if [model] names none: for records (those of the paper), for readings at rest,
#: and for readings on a machine.
DEFAULT_TERMS: Final = ("K_F", "K_I", "K_II", "K_III")
_TERMS_AT_REST: Final = ("K_F", "K_I")
MACHINE_TERMS: Final = (*_TERMS_AT_REST, "K_II")

#: Value of ``assume`` for all terms without a stated prior.
ALL_TERMS: Final = "all"

#: Smallest number of poses to estimate angles between axes, which are three of nine unknowns.
_MIN_POSES_FOR_ANGLES: Final = 9

#: A radius below this fraction of the centrifuge's radius is a deviation from it.
_DEVIATION_FRACTION: Final = 0.5


@frozen
class ErrorModel:
    """The terms of a campaign: requested, considered, and assumed to be perfect.

    All other effects are nuisance parameters.
    """

    #: Symbols of the requested terms, with the names of mountings; bare names are resolved to
    #: their components.
    terms: tuple[str, ...]
    #: Symbols of the considered terms: not adjusted, but their prior's u is propagated.
    considered: tuple[str, ...]
    #: Symbol of a shared term -> prior minus nominal, SI (tilt: one per run). Priors of
    #: accelerometer terms are in `Accelerometer.priors`.
    priors: Mapping[str, Quantity]
    #: Symbol -> largest credible magnitude, and default standard uncertainty, in the unit of the
    #: term, as far as the campaign states them; see `Campaign.limit_of`, `Campaign.typical_of`.
    limits: Mapping[str, float]
    typical: Mapping[str, float]
    #: Terms assumed to be perfect unless stated: names, ``platform.*``, ``all``.
    assume: tuple[str, ...] = ()
    #: Full name of a term -> stated correlation of its prior with those of other terms.
    correlations: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    #: Angular error of a position at rest; None: not stated.
    positioning_error: Quantity | None = None
    has_named_terms: bool = False  #: Whether the description names the requested terms.

    def assumes(self, symbol: str) -> bool:
        """Return whether a term or an input is assumed to be perfect unless it is stated."""
        prefixes = (prefix.removesuffix("*").removesuffix(".") for prefix in self.assume)
        symbols = (symbol, shared_symbol(symbol))
        return any(
            prefix in ("", ALL_TERMS, *symbols) or symbol.startswith(f"{prefix}.")
            for prefix in prefixes
        )


@frozen(eq=False)
class MeasurementSetup:
    """Accelerometers, attitudes, readings and centrifuge on which the terms act."""

    mountings: Mapping[str, Mounting]  #: Accelerometer -> axes on the level platform.
    grades: Mapping[str, str]  #: Accelerometer -> grade.
    attitudes: Sequence[Array]  #: Attitudes of the runs with records, shape (3, 3) each.
    readings: Sequence[Reading]  #: Readings at known attitudes.
    n_poses: int  #: Number of poses at unknown attitudes.
    #: The centrifuge, if there is one; its stretch, droop and tilt are priors.
    centrifuge: CentrifugeSettings | None
    positioning_error: Quantity | None  #: Angular error of a position at rest; None: not stated.
    is_complete: bool = True  #: Whether all readings of the description are valid.

    @property
    def has_readings(self) -> bool:
        """True if there are readings, at known or unknown attitudes."""
        return bool(self.readings or self.n_poses or not self.is_complete)

    @cached_property
    def observable_terms(self) -> tuple[str, ...]:
        """Machine terms and slopes that affect the readings; none without readings."""
        terms = (
            shown_symbols(self.readings, has_records=bool(self.attitudes))
            if self.has_readings
            else ()
        )
        if not self.n_poses:
            return terms
        # A pose shows only errors of the accelerometers themselves.
        slopes = (
            symbol for symbol in ACCELEROMETER_TERMS if condition_of(symbol) not in ("", "force")
        )
        return tuple(dict.fromkeys([*terms, *slopes]))

    @property
    def default_terms(self) -> tuple[str, ...]:
        """The requested terms if [model] names none."""
        motions = {reading.motion for reading in self.readings}
        if not self.has_readings or self.attitudes or "counter-rotating" in motions:
            return DEFAULT_TERMS
        terms = _TERMS_AT_REST if motions <= {"static"} else MACHINE_TERMS
        if self.n_poses >= _MIN_POSES_FOR_ANGLES:
            return (*terms, "delta_O", "delta_P")
        return (*terms, *self._misalignments(len(terms)))

    def _misalignments(self, n_terms: int) -> list[str]:
        """Return the misalignments that the positions at rest can determine.

        An instrument on a fixture is always misaligned; without these terms the fit would be poor.
        """
        symbols: list[str] = []
        for symbol, axis in (("delta_O", 1), ("delta_P", 2)):
            rest_readings = (reading for reading in self.readings if reading.motion == "static")
            z_components = {round(reading.axes.matrix[axis][2], 6) for reading in rest_readings}
            if len(z_components) > 1 and len(self.readings) > n_terms + len(symbols) + 1:
                symbols.append(symbol)
        return symbols

    def setup_priors(self, requested: Iterable[str]) -> dict[str, Quantity]:
        """Return the priors that [fixture] and [centrifuge] state, as deviations, SI.

        requested: Symbols of requested and considered terms: the prior of a mounting's own radius
            includes that of the centrifuge.
        """
        priors = (
            dict.fromkeys(
                expand_name(POSITION_SYMBOL, self.observable_terms), self.positioning_error
            )
            if self.positioning_error
            else {}
        )
        centrifuge = self.centrifuge
        if centrifuge is None:
            return priors
        priors |= {} if centrifuge.stretch is None else {"centrifuge.stretch": centrifuge.stretch}
        if centrifuge.axis_tilt is not None:
            axes = ("centrifuge.axis_tilt.east", "centrifuge.axis_tilt.north")
            priors |= dict.fromkeys(axes, centrifuge.axis_tilt)
        if centrifuge.droop is not None and self.has_readings:
            priors["centrifuge.droop"] = centrifuge.droop
        if centrifuge.radius.u:
            radius_symbols = [
                symbol
                for symbol in self.observable_terms
                if symbol.startswith("centrifuge.radius.") and symbol in set(requested)
            ]
            radius_deviation = replace(centrifuge.radius, value=0.0)
            priors |= dict.fromkeys(radius_symbols, radius_deviation)
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
    term_names = setup.default_terms if settings.terms is None else settings.terms
    terms = _resolve_names(term_names, "terms", setup, problems)
    key, considered_names = settings.held_terms
    if settings.hold and settings.considered:
        problems.add(("model", "considered"), "this key is the former name of hold; keep only hold")
    considered = _resolve_names(considered_names, key, setup, problems)
    for symbol in considered:
        if symbol in terms:
            problems.add(
                ("model", key), f'"{symbol}" is also in model.terms; keep only one of them'
            )
    if not any(symbol in TERMS for symbol in terms):
        problems.add(
            ("model", "terms"), "contains no accelerometer term to estimate", "missing-value"
        )
    shared_priors, accelerometer_priors = _resolve_priors(
        settings.priors, stated_priors, setup, problems, gravity
    )
    setup_priors = setup.setup_priors((*terms, *considered))
    for symbol in shared_priors.keys() & setup_priors.keys() if not setup.has_readings else ():
        problems.add(
            ("model", "priors", symbol), "is also given in [centrifuge]; keep only one of them"
        )
    shared_priors = setup_priors | shared_priors
    for symbol, missing_names in _missing_priors(considered, shared_priors, accelerometer_priors):
        problems.add(
            ("model", key),
            f'"{symbol}" is held, but no prior is stated for {missing_names}; '
            f'add "{symbol}" = "VALUE ± U {term(symbol).unit}" to [model.priors]',
            "missing-prior",
        )
    for symbol in (*terms, *considered, *shared_priors):
        if accelerometer_name(symbol) and shared_symbol(symbol) in {
            *terms,
            *considered,
            *shared_priors,
        }:
            bare_symbol = shared_symbol(symbol)
            message = f'"{bare_symbol}" applies to all accelerometers, but "{symbol}" is given too'
            problems.add(("model",), f"{message}; keep one")
            break
    correlations = read_correlations(
        settings.priors.get(CORRELATION_KEY, []), accelerometer_priors, considered, problems
    )
    limits = _resolve_sizes("limits", settings.limits, problems, gravity)
    typical = _resolve_sizes("typical", settings.typical, problems, gravity)
    assume = _resolve_assumed(settings.assume, problems)
    for index, name in enumerate(assume):
        if name in (*considered_names, *considered):
            problems.add(
                ("model", "assume", index),
                f'"{name}" is also in model.{key}; keep only one of them',
            )
    has_named_terms = settings.terms is not None
    return ErrorModel(
        terms,
        considered,
        shared_priors,
        limits,
        typical,
        assume,
        correlations,
        setup.positioning_error,
        has_named_terms,
    ), accelerometer_priors


def _resolve_assumed(names: Sequence[str], problems: Problems) -> tuple[str, ...]:
    """Return the terms assumed to be perfect; each name is a term or a family of terms."""
    prefixes = (symbol.split(".")[:n] for symbol in TABLE for n in range(1, symbol.count(".") + 2))
    families = dict.fromkeys(".".join(prefix) for prefix in prefixes)
    for index, name in enumerate(names):
        prefix_name = name.removesuffix("*").removesuffix(".")
        if (
            prefix_name not in ("", ALL_TERMS)
            and prefix_name not in families
            and not is_term(prefix_name)
        ):
            known_names = [ALL_TERMS, *TABLE, *families]
            message = f'unknown term "{name}"' + suggest_name(prefix_name, known_names)
            problems.add(("model", "assume", index), message, "unknown-term")
    return tuple(names)


def _resolve_names(
    names: Iterable[str], key: str, setup: MeasurementSetup, problems: Problems
) -> tuple[str, ...]:
    """Return the symbols of a list of names."""
    symbols: dict[str, None] = {}
    for index, name in enumerate(names):
        path = ("model", key, index)
        resolved_symbols = _resolve_symbols(name, path, setup, problems)
        if resolved_symbols and set(resolved_symbols) <= set(symbols):
            problems.add(path, f'"{name}" is listed twice', "duplicate-entry")
        if key == "terms" and condition_of(name) == "force":
            problems.add(
                path,
                f'"{name}" cannot be separated from K_II; state a prior for it in [model.priors]',
                "missing-prior",
            )
        symbols |= dict.fromkeys(resolved_symbols)
    return tuple(symbols)


def _resolve_symbols(
    name: str, path: KeyPath, setup: MeasurementSetup, problems: Problems
) -> tuple[str, ...]:
    """Return the symbols of a name in a list of terms."""
    if setup.has_readings and is_reading_term(name):
        return _observable_symbols(name, path, setup, problems)
    if (
        name in ACCELEROMETER_TERMS
        or name in SHARED_TERMS
        or (name in INPUTS and path[1] != "terms")
    ):
        return (name,)
    if name not in BARE_NAMES:
        _report_unknown_term(name, path, problems)
        return ()
    symbols = tuple(
        row.symbol for row in acting_rows(name, setup.mountings.values(), setup.attitudes)
    )
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
    """Expand a name of machine terms or slopes to the terms that affect the readings."""
    expanded_symbols = expand_name(name, setup.observable_terms)
    if not expanded_symbols and setup.is_complete:
        problems.add(
            path,
            f'no reading depends on "{name}"' + suggest_name(name, setup.observable_terms),
            "term-without-effect",
        )
    return expanded_symbols if name in expanded_symbols else _remove_duplicates(expanded_symbols)


def _remove_duplicates(symbols: Sequence[str]) -> tuple[str, ...]:
    """Return the terms of a family with one radius for each mounting and accelerometer.

    With several accelerometers each has a radius; with one, the mounting has it.
    """
    owners = {owner for symbol in symbols if (owner := accelerometer_name(symbol))}
    bare_symbols = {shared_symbol(symbol) for symbol in symbols if accelerometer_name(symbol)}
    return tuple(
        symbol
        for symbol in symbols
        if not (symbol in bare_symbols if len(owners) > 1 else accelerometer_name(symbol))
    )


def _report_unknown_term(name: str, path: KeyPath, problems: Problems) -> None:
    known_names = [*ACCELEROMETER_TERMS, *BARE_NAMES, *SHARED_TERMS]
    hint = suggest_name(name, known_names)
    if "known:" in hint:
        hint = f"; known: {', '.join([*ACCELEROMETER_TERMS, *BARE_NAMES])}"
    problems.add(path, f'unknown term "{name}"' + hint, "unknown-term")


def _sort_general_first(names: Iterable[str]) -> list[str]:
    """Sort names from general to specific, so that specific ones take precedence."""
    return sorted(names, key=lambda name: name.count("."))


def _resolve_priors(
    raw: Mapping[str, Any],
    stated_priors: Mapping[str, Mapping[str, Quantity]],
    setup: MeasurementSetup,
    problems: Problems,
    gravity: float | None,
) -> tuple[dict[str, Quantity], dict[str, dict[str, Quantity]]]:
    """Return shared priors, and those of each accelerometer; a specific name takes precedence."""
    shared_priors: dict[str, Quantity] = {}
    own_priors = {name: dict(priors) for name, priors in stated_priors.items()}
    prior_by_key = flatten_keys(raw, is_value=is_prior_table)
    for key in _sort_general_first(key for key in prior_by_key if key != CORRELATION_KEY):
        path = ("model", "priors", key)
        owner, _, own_symbol = key.partition(".")
        owners: Sequence[str] = ()
        symbols: Sequence[str] = (key,)
        if is_from_readings := setup.has_readings and is_reading_term(key):
            symbols = _observable_symbols(key, path, setup, problems)
        elif owner in stated_priors and own_symbol in ACCELEROMETER_TERMS:
            symbols, owners = (own_symbol,), (owner,)
        elif key in ACCELEROMETER_TERMS:
            own_symbol = key
            owners = [name for name in stated_priors if f"{name}.{key}" not in prior_by_key]
        elif key in BARE_NAMES:
            symbols = [row.symbol for row in BARE_NAMES[key]]
        elif key not in SHARED_TERMS:
            _report_unknown_term(key, path, problems)
            continue
        if not symbols:
            continue
        unit = term(symbols[0]).unit
        prior = problems.collect(path, parse_prior, prior_by_key[key], unit, gravity=gravity)
        if prior is None:
            continue
        grades = (setup.grades.get(name, DEFAULT_GRADE) for name in owners)
        widest_grade = max(grades, key=GRADES.index, default=DEFAULT_GRADE)
        problems.collect(path, check_near_nominal, symbols[0], prior, widest_grade)
        if is_from_readings or symbols[0] not in ACCELEROMETER_TERMS:
            shared_priors |= {
                symbol: to_deviation(symbol, prior, setup.centrifuge) for symbol in symbols
            }
        for name in owners:
            if own_symbol in stated_priors[name]:
                problems.add(
                    path,
                    f"a prior for {own_symbol} is also given in accelerometers.{name}; keep only "
                    "one of them",
                )
            own_priors[name][own_symbol] = prior
    return shared_priors, own_priors


def to_deviation(symbol: str, prior: Quantity, centrifuge: CentrifugeSettings | None) -> Quantity:
    """Return a prior as a deviation: a radius may be stated as a value or as a deviation."""
    if not symbol.startswith("centrifuge.radius.") or centrifuge is None:
        return prior
    radius = centrifuge.radius.value
    value = prior.value - radius if prior.value > _DEVIATION_FRACTION * radius else prior.value
    return replace(prior, value=value)


def check_near_nominal(symbol: str, prior: Quantity, grade: str = DEFAULT_GRADE) -> Quantity:
    """Return a prior if it is near the nominal value, which is about 1 for a scale factor."""
    row = term(symbol)
    if row.nominal and abs(prior.value - row.nominal) > row.sizes(grade).limit:
        raise OutOfRangeError(
            f"{prior.value:.6g} {row.unit} is too far from the nominal {symbol}, "
            f"{row.nominal:g}; write an error of 1000 ppm as {1.001 * row.nominal:g} {row.unit}"
        )
    return prior


def _missing_priors(
    considered: Iterable[str],
    shared_priors: Mapping[str, Quantity],
    accelerometer_priors: Mapping[str, Mapping[str, Quantity]],
) -> Iterator[tuple[str, str]]:
    """Yield considered symbols without a prior, and the accelerometers that lack it."""
    for symbol in considered:
        if symbol in INPUTS or symbol in shared_priors:
            continue
        owners = [name for name, priors in accelerometer_priors.items() if symbol not in priors]
        if symbol not in ACCELEROMETER_TERMS or owners:
            yield symbol, ", ".join(owners) if symbol in ACCELEROMETER_TERMS else "the machine"


def _resolve_sizes(
    section_key: str, raw: Mapping[str, Any], problems: Problems, gravity: float | None
) -> dict[str, float]:
    """Return the stated largest credible magnitudes (``limits``) or ``typical`` ones."""
    sizes: dict[str, float] = {}
    raw_values = flatten_keys(raw)
    for key in _sort_general_first(raw_values):
        path = ("model", section_key, key)
        symbols = [row.symbol for row in BARE_NAMES.get(key, ())] or [key]
        if not is_term(symbols[0]):
            _report_unknown_term(key, path, problems)
            continue
        size = problems.collect(path, parse_exact, raw_values[key], term(symbols[0]).unit, gravity)
        if size is not None and size <= 0.0:
            problems.add(path, "must be greater than zero", "value-out-of-range")
        elif size is not None:
            sizes |= dict.fromkeys(symbols, size)
    return sizes

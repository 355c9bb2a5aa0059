"""Table of all error terms and uncertain inputs.

Simulation, design matrices, planning, budgets, reports and documentation use this table; there is
no other list of coefficients. A row states the owner, the possible size and the effect of a term.

Accelerometer coefficients are in g-units (g, g/g, g/g^2, ...), g being the site's own gravity.
Eq. 7 does not divide by the scale factor K_I; IEEE Std 1293 factors it out, so that the paper's
K_II is K1 x K2 there, and likewise for the other terms. All else is in SI units.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any, Final, Generic, Literal, TypeVar

from counterspin.frozen import frozen
from counterspin.physics.effects import (
    AttitudeError,
    Effect,
    Input,
    SetupError,
    Slope,
    SpecificForceProduct,
    TrajectoryError,
)
from counterspin.physics.grades import DEFAULT_GRADE, SIZES, Size

DEGREE_PER_HOUR: Final = math.radians(1.0) / 3600.0  #: rad/s
ARCSEC: Final = math.pi / 648000.0  #: rad

#: Motion of the instrument during a reading.
MotionKind = Literal["counter-rotating", "arm", "static", "vibration"]

#: Symbol of the distance of a proof mass from the axis of a table that turns in space.
LEVER_ARM: Final = "table.lever_arm"

#: Prefix of the symbols of dividing-head errors that depend on its angle.
HEAD_HARMONICS: Final = "head.harmonic."

EffectT = TypeVar("EffectT", bound=Effect)
EffectT_co = TypeVar("EffectT_co", bound=Effect, covariant=True)


@frozen
class Term(Generic[EffectT_co]):
    """A row of the table: a quantity that may differ from its assumed value."""

    #: Symbol of the paper for a coefficient, else words with dots. The placeholders ``MOUNTING``,
    #: ``ACCELEROMETER.MOUNTING`` and ``POSITION`` stand for names.
    symbol: str
    effect: EffectT_co  #: Effect on an output.
    words: str  #: Description for readers.
    unit: str  #: g-units for coefficients of an accelerometer, else SI.
    #: Largest credible size. The data do not determine a term if its standard uncertainty is not
    #: below this size. For accelerometers: navigation grade, see `sizes`.
    limit: float
    #: Default standard uncertainty; for accelerometers: navigation grade.
    typical: float
    source: str  #: Source of `typical`, or the remark that it is an order of magnitude.
    #: Owner of a separate value: ``accelerometer``, ``run``, ``mounting`` or ``position``; or a
    #: common value of the ``platform``, the ``machine`` or the ``input``.
    scope: str
    nominal: float = 0.0  #: Value of a perfect system.
    #: Motions in which a machine term or a slope affects a reading.
    motions: tuple[str, ...] = ()

    def sizes(self, grade: str = DEFAULT_GRADE) -> Size:
        """Return the size of the term for a grade; only accelerometer terms depend on it.

        grade: One of `counterspin.physics.grades.GRADES`.
        """
        if self.symbol in SIZES:
            return SIZES[self.symbol][grade]
        return Size(self.limit, self.typical, self.source)

    @property
    def per_run(self) -> bool:
        """True if every run has its own value (the tilt, set again at each alignment)."""
        return self.scope == "run"

    @property
    def per_mounting(self) -> bool:
        """True if every mounting has its own value."""
        return self.scope == "mounting"

    @property
    def family(self) -> str:
        """The symbol without the quadrature of a harmonic."""
        effect: Effect = self.effect
        wave = (
            effect.quadrature
            if isinstance(effect, TrajectoryError | SetupError | AttitudeError)
            else ""
        )
        return self.symbol.removesuffix(f".{wave}") if wave else self.symbol

    @property
    def words_of_family(self) -> str:
        """Common description of both quadratures of a harmonic."""
        return self.words.partition(" (")[0]


_AXIS_NAMES: Final = ("east", "north", "up")
_ROTATING_MOTIONS: Final = ("arm", "counter-rotating")
_ALL_MOTIONS: Final = (*_ROTATING_MOTIONS, "static", "vibration")


def _accelerometer_term(
    symbol: str,
    effect: EffectT,
    description: str,
    unit: str,
    nominal: float = 0.0,
    motions: tuple[str, ...] = (),
) -> Term[EffectT]:
    """Return the row of a term with a separate value for each accelerometer."""
    size = SIZES[symbol][DEFAULT_GRADE]
    size_fields = (size.limit, size.typical, size.source)
    return Term(symbol, effect, description, unit, *size_fields, "accelerometer", nominal, motions)


#: IEEE Std 1293 halves the asymmetries: K0' is the bias at positive minus that at negative input.
_PRODUCT_WEIGHTS: Final = {"delta_P": -1.0, "K_0_asym": 0.5, "K_I_asym": 0.5}

#: Units that are not g over a power of g.
_SPECIAL_UNITS: Final = {
    **{"delta_O": "rad", "delta_P": "rad"},
    **{"K_spin": "g s^2/rad^2", "K_ang": "g s^2/rad"},
}


def _product_rows() -> Iterator[Term[SpecificForceProduct]]:
    template = "{} asymmetry, positive minus negative input"
    for symbol, factors, ieee_symbol, description in (
        ("K_F", "", "K0", "bias"),
        ("K_I", "I", "K1", "scale factor"),
        ("K_II", "I I", "K2", "second-order coefficient"),
        ("K_III", "I I I", "K3", "third-order coefficient"),
        ("K_4", "I I I I", "K4", "fourth-order coefficient"),
        ("K_5", "I I I I I", "K5", "fifth-order coefficient"),
        ("K_IP", "I P", "Kip", "cross-coupling of input and pendulous axes"),
        ("K_IO", "I O", "Kio", "cross-coupling of input and output axes"),
        ("K_PO", "P O", "Kpo", "cross-coupling of pendulous and output axes"),
        ("K_PP", "P P", "Kpp", "second-order pendulous-axis coefficient"),
        ("K_OO", "O O", "Koo", "second-order output-axis coefficient"),
        ("K_OQ", "I |I|", "Koq", "odd quadratic coefficient"),
        ("K_0_asym", "sign_I", "K0'", template.format("bias")),
        ("K_I_asym", "|I|", "K1'", template.format("scale factor")),
        ("K_spin", "w_I w_P", "Kspin", "spin coefficient of input and pendulous axes"),
        ("K_ang", "dw_O/dt", "Kang", "output-axis angular acceleration coefficient"),
        ("delta_O", "P", "delta_o", "misalignment about the output axis"),
        ("delta_P", "O", "delta_p", "misalignment about the pendulous axis"),
    ):
        product = SpecificForceProduct(
            tuple(factors.split()), ieee_symbol, _PRODUCT_WEIGHTS.get(symbol, 1.0)
        )
        degree = product.degree
        unit = "g" if degree == 0 else "g/g" if degree == 1 else f"g/g^{degree}"
        unit = _SPECIAL_UNITS.get(symbol, unit)
        nominal = 1.0 if symbol == "K_I" else 0.0
        yield _accelerometer_term(symbol, product, description, unit, nominal)


def _slope_rows() -> Iterator[Term[Slope]]:
    heating_text = "increase in K_F proportional to the square of the centripetal force"
    temperature_text = "change in {} with {}temperature"
    powers = ((1, ""), (2, "the square of "), (3, "the cube of "))
    for symbol, condition, unit, description in (
        *(
            (
                f"{coefficient}.temperature{f'.{n}' if n > 1 else ''}",
                "temperature",
                f"{unit}/K{f'^{n}' if n > 1 else ''}",
                temperature_text.format(coefficient, power),
            )
            for coefficient, unit, degree in (
                ("K_F", "g", 3),
                ("K_I", "g/g", 3),
                ("K_II", "g/g^2", 1),
            )
            for n, power in powers[:degree]
        ),
        ("K_F.hysteresis", "direction", "g", "difference in K_F between warming and cooling"),
        ("K_F.trend", "time", "g/s", "change in K_F with time"),
        ("K_F.heating", "force", "g/g^2", heating_text),
    ):
        motions = _ROTATING_MOTIONS if condition == "force" else _ALL_MOTIONS
        power = symbol.rpartition(".")[2]
        slope = Slope(symbol.partition(".")[0], condition, int(power) if power.isdigit() else 1)
        yield _accelerometer_term(symbol, slope, description, unit, motions=motions)


_NO_SOURCE: Final = "order-of-magnitude estimate, no source"


def _attitude_rows() -> Iterator[Term[AttitudeError]]:
    level_size = f"{_NO_SOURCE}: 0.5 arcsec, for a good level or autocollimator", 0.5 * ARCSEC
    azimuth_size = f"{_NO_SOURCE}: 10 arcsec, because azimuth is harder to determine", 10.0 * ARCSEC
    for axis, name in enumerate(_AXIS_NAMES):
        source, typical = azimuth_size if name == "up" else level_size
        effect, words = AttitudeError("tilt", axis), f"tilt about {name}"
        yield Term(f"platform.tilt.{name}", effect, words, "rad", 1e-2, typical, source, "run")
    drift_source = (
        "one nautical mile per hour, as for K_F: a drift of 0.01 deg/h corresponds to 0.6 "
        "nautical miles per hour"
    )
    compliance_source = f"{_NO_SOURCE}: 0.1 arcsec/g, or 0.5 µm/g over a length of 1 m"
    g_template = "g-sensitivity of the {} gyro to force along {}"
    compliance_template = "platform rotation about {} due to force along {}"
    rate = DEGREE_PER_HOUR
    # kind, unit, description, largest credible and typical size, source, whether it is crossed
    for error_kind, unit, template, limit, typical, source, is_crossed in (
        ("drift", "rad/s", "gyro drift about {}", 10 * rate, 0.01 * rate, drift_source, False),
        (
            *("g_sensitivity", "rad/s/g", g_template),
            *(10 * rate, 0.01 * rate, "same effect as the drift, at 1 g", True),
        ),
        (
            *("g2_sensitivity", "rad/s/g^2", "g²-sensitivity of the gyro about {}"),
            *(rate, 1e-4 * rate, _NO_SOURCE, False),
        ),
        ("compliance", "rad/g", compliance_template, 1e-4, 0.1 * ARCSEC, compliance_source, True),
    ):
        for i, name in enumerate(_AXIS_NAMES):
            for j in range(3) if is_crossed else (None,):
                suffix = name if j is None else "xyz"[i] + "xyz"[j]
                description = template.format(*([name] if j is None else suffix))
                effect = AttitudeError(error_kind, i, j)
                symbol = f"platform.{error_kind}.{suffix}"
                sizes = limit, typical, source
                yield Term(symbol, effect, description, unit, *sizes, "platform")
    for n, quadrature, description in _harmonic_terms(
        (1, 2), "counter-rotating table error, {} per revolution"
    ):
        yield Term(
            f"table.harmonic.{n}.{quadrature}",
            AttitudeError("table", 2, harmonic=n, quadrature=quadrature),
            description,
            "rad",
            1e-3,
            ARCSEC,
            f"{_NO_SOURCE}: 1 arcsec, for a good angle encoder in the servo loop of the table",
            "machine",
            motions=("counter-rotating",),
        )
    for axis, name in enumerate(("outward", "forward")):
        tilt = AttitudeError("table_axis", axis)
        description = f"tilt of the table axis about the {name} axis"
        source = f"{_NO_SOURCE}: 10 arcsec, for bearings machined in one setup"
        sizes = 1e-2, 10.0 * ARCSEC, source
        yield Term(f"table.axis_tilt.{name}", tilt, description, "rad", *sizes, "machine")


def _trajectory_rows() -> Iterator[Term[TrajectoryError]]:
    yield Term(
        "centrifuge.stretch",
        TrajectoryError("stretch"),
        "stretch of the arm",
        "s^2/m",
        1e-5,
        4.6e-9,
        f"{_NO_SOURCE}: 0.1 µm at a radius of 2.5 m and 1 g",
        "machine",
        motions=_ROTATING_MOTIONS,
    )
    yield from _harmonic_rows(
        "centrifuge.imbalance",
        (1, 2),
        ("m", 1e-3, 1e-6, f"{_NO_SOURCE}: run-out of a good spindle"),
        "imbalance, radius variation {} per revolution",
    )
    for axis in ("east", "north"):
        yield Term(
            f"centrifuge.axis_tilt.{axis}",
            TrajectoryError("axis_tilt", axis=axis),
            f"tilt of the spindle axis about {axis}",
            "rad",
            1e-2,
            10.0 * ARCSEC,
            f"{_NO_SOURCE}: 10 arcsec, for a spindle levelled with a machinist's level",
            "machine",
            motions=_ROTATING_MOTIONS,
        )
    yield from _harmonic_rows(
        "encoder.harmonic",
        (1, 2, 3, 4),
        ("rad", 1e-3, ARCSEC, "Lu et al.: 1 arcsec for the best angle encoders, properly mounted"),
        "encoder error, {} per revolution",
    )
    yield Term(
        LEVER_ARM,
        TrajectoryError("lever_arm"),
        "distance from the table axis to the proof mass, along the input axis",
        "m",
        0.1,
        1e-3,
        "fixture drawing",
        "accelerometer",
    )


def _harmonic_rows(
    name: str, orders: tuple[int, ...], unit_and_sizes: tuple[str, float, float, str], template: str
) -> Iterator[Term[TrajectoryError]]:
    """Yield both quadratures of harmonics.

    unit_and_sizes: Unit, largest credible size, default standard uncertainty, source.
    """
    error_kind = "encoder" if name.startswith("encoder") else "imbalance"
    for n, quadrature, description in _harmonic_terms(orders, template):
        effect = TrajectoryError(error_kind, n, quadrature)
        yield Term(f"{name}.{n}.{quadrature}", effect, description, *unit_and_sizes, "machine")


def _harmonic_terms(orders: tuple[int, ...], template: str) -> Iterator[tuple[int, str, str]]:
    """Yield order, quadrature and description of both quadratures of harmonics."""
    frequencies = ("once", "twice", "three times", "four times")
    for n in orders:
        for quadrature, quadrature_name in (("cos", "cosine"), ("sin", "sine")):
            yield n, quadrature, f"{template.format(frequencies[n - 1])} ({quadrature_name})"


def _setup_rows() -> Iterator[Term[SetupError]]:
    drawing = "fixture drawing; measured radii have relative uncertainties of 1e-7 to 4e-6"
    proof_mass = "centrifuge.radius.ACCELEROMETER.MOUNTING"
    head_source = f"{_NO_SOURCE}: 5 arcsec"
    rate_source = f"{_NO_SOURCE}: typical mean rate error of a precision centrifuge"
    iso = "ISO 16063-21: 1 % (k = 2) for transducers calibrated by comparison"
    for symbol, description, unit, limit, typical, source, motions in (
        ("centrifuge.radius.MOUNTING", "radius of the mounting", "m", 0.1, 1e-3, drawing, ("arm",)),
        (proof_mass, "radius to the proof mass", "m", 0.1, 1e-3, drawing, ("arm",)),
        ("centrifuge.rate", "random error of the rate", "1", 1e-2, 1e-7, rate_source, ()),
        ("centrifuge.droop", "droop of the arm", "rad s^2", 1e-3, 1e-8, _NO_SOURCE, ("arm",)),
        *(
            (
                f"fixture.misalignment.MOUNTING.{axis}",
                f"mounting misalignment about {axis}",
                "rad",
                1e-2,
                5e-5,
                f"{_NO_SOURCE}: 10 arcsec",
                _ALL_MOTIONS,
            )
            for axis in ("east", "north", "outward", "forward", "up")
        ),
        *(
            (
                f"fixture.position.POSITION.{axis}",
                f"positioning error about {axis}",
                "rad",
                0.2,
                2.5e-5,
                f"{_NO_SOURCE}: 5 arcsec",
                ("static",),
            )
            for axis in ("east", "north")
        ),
        ("vibration.amplitude", "common amplitude error", "1", 0.1, 5e-3, iso, ("vibration",)),
        ("head.zero", "zero of the dividing head", "rad", 1e-2, 2.5e-5, head_source, ("static",)),
    ):
        scope = next((s for s in ("mounting", "position") if s.upper() in symbol), "machine")
        scope = "reading" if symbol == "centrifuge.rate" else scope
        quantity, axis_name = symbol.split(".")[1], symbol.rpartition(".")[2]
        is_misalignment = symbol.startswith("fixture.")
        effect = SetupError("misalignment", axis_name) if is_misalignment else SetupError(quantity)
        yield Term(
            symbol, effect, description, unit, limit, typical, source, scope, motions=motions
        )
    harmonic_source = (
        "order-of-magnitude estimate: mounting errors of arcseconds (Lu et al.), ±5 arcsec "
        "distributed over the harmonics"
    )
    sizes = 1e-3, 1e-5, harmonic_source
    for n, quadrature, description in _harmonic_terms(
        (1, 2, 3, 4), "dividing head error, {} per revolution"
    ):
        effect = SetupError("wave", "", n, quadrature)
        symbol = f"{HEAD_HARMONICS}{n}.{quadrature}"
        yield Term(symbol, effect, description, "rad", *sizes, "machine", motions=("static",))


def _input_rows() -> Iterator[Term[Input]]:
    radii = "largest relative uncertainty of measured radii (4e-6), at a radius of 2.5 m"
    # An absolute gravimeter is better by a factor of 1000.
    map_source = f"{_NO_SOURCE}: uncertainty of a value from a gravity map, corrected for height"
    delay, cutoff = "delay of the recorded angle", "low-pass cutoff frequency of the recorder"
    frequency_source, cutoff_source = f"{_NO_SOURCE}: 5 % of 400 Hz", f"{_NO_SOURCE}: 5 % of 100 Hz"
    table_source, multiples = "standard uncertainty in the response table", (-100.0, 100.0)
    poles, latitude_source = (-0.5 * math.pi, 0.5 * math.pi), "position error of 30 m on the ground"
    clock_source = "a free-running quartz oscillator"
    # symbol, description, unit, possible range, largest credible and default error, source
    for symbol, description, unit, bounds, limit, typical, source in (
        ("centrifuge.radius", "radius of the centrifuge", "m", (0.01, 100.0), 0.1, 1e-5, radii),
        # On Earth, from Huascaran to the Arctic Ocean.
        ("site.gravity", "gravity of the site", "m/s^2", (9.76, 9.84), 0.08, 1e-4, map_source),
        ("site.latitude", "latitude of the site", "rad", poles, math.pi, 5e-6, latitude_source),
        ("records.timing_offset", delay, "s", (-1.0, 1.0), 10.0, 1e-5, "one sample at 100 kHz"),
        ("records.clock", "recorder clock error", "1", (-1e-2, 1e-2), 1e-2, 2e-5, clock_source),
        (
            "centrifuge.clock",
            "rate counter clock error",
            "1",
            (-1e-2, 1e-2),
            1e-2,
            2e-5,
            clock_source,
        ),
        (
            "sensor.natural_frequency",
            "natural frequency",
            "Hz",
            (1e-2, 1e6),
            1e4,
            20.0,
            frequency_source,
        ),
        ("sensor.damping", "damping ratio", "1", (0.0, 100.0), 10.0, 0.1, f"{_NO_SOURCE}: 0.1"),
        ("sensor.gain", "gain error, as a multiple of u", "1", multiples, 100.0, 1.0, table_source),
        (
            "sensor.phase",
            "phase error, as a multiple of u",
            "1",
            multiples,
            100.0,
            1.0,
            table_source,
        ),
        ("records.cutoff_frequency", cutoff, "Hz", (1e-2, 1e6), 1e4, 5.0, cutoff_source),
    ):
        effect = Input(symbol.partition(".")[2], bounds)
        yield Term(symbol, effect, description, unit, limit, typical, source, "input")


def _index_by_symbol(rows: Iterator[Term[EffectT]]) -> Mapping[str, Term[EffectT]]:
    return {row.symbol: row for row in rows}


TERMS: Final = _index_by_symbol(_product_rows())
CONDITION_TERMS: Final = _index_by_symbol(_slope_rows())
PLATFORM_TERMS: Final = _index_by_symbol(_attitude_rows())
MOTION_TERMS: Final = _index_by_symbol(_trajectory_rows())
INPUTS: Final = _index_by_symbol(_input_rows())

ACCELEROMETER_TERMS: Final[Mapping[str, Term[SpecificForceProduct | Slope]]] = {
    **TERMS,
    **CONDITION_TERMS,
}
SHARED_TERMS: Final[Mapping[str, Term[AttitudeError | TrajectoryError]]] = {
    **PLATFORM_TERMS,
    **MOTION_TERMS,
}

#: Every row, by symbol.
TABLE: Final[Mapping[str, Term[Effect]]] = {
    **ACCELEROMETER_TERMS,
    **SHARED_TERMS,
    **_index_by_symbol(_setup_rows()),
    **INPUTS,
}

#: Terms that affect readings: machine terms and slopes of coefficients.
READING_TERMS: Final = {symbol: row for symbol, row in TABLE.items() if row.motions}

#: Terms of the sensitivity vector of an accelerometer -> index of the axis I, P or O, and sign.
SENSITIVITY_TERMS: Final = {
    symbol: ("IPO".index(row.effect.factors[0]), row.effect.weight)
    for symbol, row in TERMS.items()
    if row.effect.is_linear
}

#: Common name of a term in files -> symbol.
COMMON_NAMES: Final = {"bias": "K_F", "scale_factor": "K_I"}

#: Placeholders for a name in a symbol, the longest first.
_PLACEHOLDERS: Final = ("ACCELEROMETER.MOUNTING", "MOUNTING", "POSITION")

#: Rows with a placeholder in their symbols, and the placeholder.
_PLACEHOLDER_ROWS: Final = [
    (row, word)
    for row in TABLE.values()
    for word in [next((word for word in _PLACEHOLDERS if word in row.symbol), "")]
    if word
]


def _find_row(symbol: str) -> tuple[Term[Effect] | None, str]:
    """Return the row of a symbol, if any, and the name in the symbol."""
    if symbol in TABLE:
        return TABLE[symbol], ""
    for row, placeholder in _PLACEHOLDER_ROWS:
        prefix, _, suffix = row.symbol.partition(placeholder)
        name = symbol.removeprefix(prefix).removesuffix(suffix)
        owner, dot, final_name = name.rpartition(".")
        is_complete = (
            bool(owner and final_name) if "." in placeholder else bool(final_name and not dot)
        )
        if is_complete and symbol == f"{prefix}{name}{suffix}":
            return row, name
    return None, ""


def is_term(symbol: str) -> bool:
    """Return True if the table has a row for a symbol."""
    return _find_row(symbol)[0] is not None


def condition_of(symbol: str) -> str:
    """Return the condition of a slope; empty for all other terms."""
    row = CONDITION_TERMS.get(symbol)
    return "" if row is None else row.effect.condition


def coefficient_of(symbol: str) -> str:
    """Return the coefficient that a slope changes; for all other terms, the symbol itself."""
    row = CONDITION_TERMS.get(symbol)
    return symbol if row is None else row.effect.coefficient


def mounting_name(symbol: str) -> str:
    """Return the mounting, or position, that a symbol names; empty if it names none."""
    return _find_row(symbol)[1].rpartition(".")[2]


def accelerometer_name(symbol: str) -> str:
    """Return the accelerometer that the symbol of a machine's term names; empty without one."""
    return _find_row(symbol)[1].rpartition(".")[0]


def shared_symbol(symbol: str) -> str:
    """Return the symbol of the same term for all accelerometers of a mounting."""
    owner = accelerometer_name(symbol)
    return symbol.replace(f".{owner}.", ".", 1) if owner else symbol


def affects_readings(symbol: str) -> bool:
    """Return True if the term of a symbol may affect readings: machine terms and slopes."""
    row, _ = _find_row(symbol)
    return row is not None and bool(row.motions)


def term(symbol: str) -> Term[Any]:
    """Return the row of a symbol, for any mounting."""
    row, _ = _find_row(symbol)
    if row is None:
        raise ValueError(f"unknown term {symbol!r}; known: {', '.join(TABLE)}")
    return row


def find_symbol(name: str) -> str:
    """Return the term in the name of an unknown: ``K_II`` of ``Qx.K_II``."""
    return name if is_term(name) else name.partition(".")[2] or name


def describe_term(name: str) -> str:
    """Return the description of the term in the name of an unknown, with mounting or position.

    Empty if the name contains no term.
    """
    row, mounting = _find_row(find_symbol(name))
    if row is None:
        return ""
    return f"{row.words} ({mounting})" if mounting else row.words

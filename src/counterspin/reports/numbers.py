"""Formatting of numbers, rounded to their uncertainty, in display units.

By GUM 7.2.6, the uncertainty keeps two significant digits, and the value is rounded to the same
decimal place. A number without uncertainty keeps a requested number of digits.
"""

from __future__ import annotations

import math
from decimal import ROUND_HALF_EVEN, Decimal
from typing import Final

from counterspin.frozen import frozen
from counterspin.physics.terms import ARCSEC, DEGREE_PER_HOUR

NOT_DETERMINED: Final = "not determined"

_MICRO_PER_UNIT: Final = 1e6

#: Unit of a result -> display unit, and conversion factor.
_DISPLAY_UNITS: Final = {
    "g": ("ug", _MICRO_PER_UNIT),
    "g/g^2": ("ug/g^2", _MICRO_PER_UNIT),
    "g/g^3": ("ug/g^3", _MICRO_PER_UNIT),
    "g/g^4": ("ug/g^4", _MICRO_PER_UNIT),
    "rad": ("arcsec", 1.0 / ARCSEC),
    "rad/g": ("arcsec/g", 1.0 / ARCSEC),
    "rad/s": ("deg/h", 1.0 / DEGREE_PER_HOUR),
    "rad/s/g": ("deg/h/g", 1.0 / DEGREE_PER_HOUR),
    "rad/s/g^2": ("deg/h/g^2", 1.0 / DEGREE_PER_HOUR),
    "1/s": ("ppm/h", 3600.0 * _MICRO_PER_UNIT),
}

#: Exponents written without a power of ten: from 0.001 to below a million.
_PLAIN_EXPONENTS: Final = range(-3, 6)

#: Smallest p-value that is stated as a number.
_MIN_P: Final = 1e-300

#: Significant digits of a double; if more are needed, value and u are formatted separately.
_MAX_SIGNIFICANT_DIGITS: Final = 15


def find_display_unit(unit: str) -> tuple[str, float]:
    """Return the display unit of a quantity, and the conversion factor to it.

    unit: Unit in a result: SI or g-units.
    """
    return _DISPLAY_UNITS.get(unit, (unit, 1.0))


@frozen
class RoundedEstimate:
    """A value and its uncertainty, both to the second digit of the uncertainty."""

    #: Digits, in units of ten to the power of `exponent`.
    value: str
    u: str
    exponent: int  #: The common power of ten; 0 where none is needed.
    last_digit: int  #: Power of ten of the last digit.

    @property
    def power(self) -> str:
        """Return the suffix of a number for the power of ten, such as ``e-6``; empty for 0."""
        return f"e{self.exponent}" if self.exponent else ""

    def format(self, number: float) -> str:
        """Return another number with the same last digit and power of ten."""
        return _format_digits(_to_decimal(number), self.last_digit, self.exponent)


def round_to_uncertainty(value: float, u: float) -> RoundedEstimate | None:
    """Round a value to its uncertainty (GUM 7.2.6; halves to even, ISO 80000-1 B.3 rule A).

    Returns: None if a double does not have enough digits for two digits of u.
    """
    value_decimal, u_decimal = _to_decimal(value), _to_decimal(u)
    last_digit = u_decimal.adjusted() - 1
    # 0.0996 rounds to 0.10: one decimal fewer, or it would have three digits.
    last_digit += _round_at_digit(u_decimal, last_digit).adjusted() - u_decimal.adjusted()
    if value_decimal and value_decimal.adjusted() - last_digit >= _MAX_SIGNIFICANT_DIGITS:
        return None
    largest_exponent = max(
        abs(_round_at_digit(value_decimal, last_digit)), _round_at_digit(u_decimal, last_digit)
    ).adjusted()
    # Insignificant zeros before the decimal point would look significant.
    exponent = 0 if last_digit <= 0 and largest_exponent in _PLAIN_EXPONENTS else largest_exponent
    return RoundedEstimate(
        value=_format_digits(value_decimal, last_digit, exponent),
        u=_format_digits(u_decimal, last_digit, exponent),
        exponent=exponent,
        last_digit=last_digit,
    )


def format_estimate(value: float | None, u: float | None, unit: str = "") -> str:
    """Format a value with its standard uncertainty and unit.

    value: None or not finite: not determined, and no value is shown.
    u: Standard uncertainty. 0: the value is exact. None: unknown, and none is shown. Infinite: the
        value is not determined.
    unit: Unit of both; empty for a pure number.
    """
    if not _is_determined(value, u):
        return NOT_DETERMINED
    assert value is not None
    if not u:
        text = format_number(value, 12 if u == 0.0 else 6)
        return _append_unit(text, unit) + (" (exact)" if u == 0.0 else "")
    rounded = round_to_uncertainty(value, u)
    if rounded is None:
        return _append_unit(f"{format_number(value, 17)} ± {format_number(u, 2)}", unit)
    text = f"{rounded.value} ± {rounded.u}"
    if rounded.exponent:
        text = f"({text}) x 1e{rounded.exponent}"
    return _append_unit(text, unit)


def format_compact(value: float | None, u: float | None) -> str:
    """Format a value with the uncertainty of its last digits in parentheses (GUM 7.2.2).

    Parameters and errors are those of `format_estimate`. Examples: ``1.570796301(12)``,
    ``2.70445(37)e-5``; an uncertainty above 1 keeps its decimal point, as in ``3.1(1.2)``.
    """
    if not _is_determined(value, u):
        return NOT_DETERMINED
    assert value is not None
    if not u:
        return format_number(value, 12 if u == 0.0 else 6)
    rounded = round_to_uncertainty(value, u)
    if rounded is None:
        return format_estimate(value, u)
    u_digits = rounded.u.removeprefix("0.").lstrip("0") if rounded.u.startswith("0.") else rounded.u
    return f"{rounded.value}({u_digits}){rounded.power}"


def format_interval(value: float, u: float, half_width: float, unit: str = "") -> str:
    """Format the interval value ± half_width, with ends rounded to the last digit of u."""
    rounded = round_to_uncertainty(value, u)
    ends = (value - half_width, value + half_width)
    if rounded is None:
        return _append_unit(" to ".join(format_number(end, 17) for end in ends), unit)
    text = " to ".join(rounded.format(end) for end in ends)
    if rounded.exponent:
        text = f"({text}) x 1e{rounded.exponent}"
    return _append_unit(text, unit)


def format_uncertainty(u: float) -> str:
    """Format an uncertainty alone, to two significant digits (GUM 7.2.6)."""
    mantissa, exponent_mark, exponent = f"{u:#.2g}".partition("e")
    return mantissa.rstrip(".") + (f"e{int(exponent)}" if exponent_mark else "") if u else "0"


def format_number(value: float, n_digits: int = 3) -> str:
    """Format a number to a number of significant digits, without trailing zeros."""
    text = f"{value:.{n_digits}g}"
    mantissa, exponent_mark, exponent = text.partition("e")
    return f"{mantissa}e{int(exponent)}" if exponent_mark else text


def format_distinct(value: float, other: float) -> str:
    """Return a number with three digits, or with as many as distinguish it from another number."""
    text_pairs = ((f"{value:.{n_digits}g}", f"{other:.{n_digits}g}") for n_digits in range(3, 18))
    return next((text for text, other_text in text_pairs if text != other_text), f"{value:.3g}")


def format_count(value: float) -> str:
    """Format a count: as an integer from 1000, otherwise with four digits."""
    return f"{value:.0f}" if 1e3 <= abs(value) < 1e9 else format_number(value, 4)


def format_share(share: float) -> str:
    """Format a share in per cent, with "<" if it would round to zero."""
    percent = 100.0 * share
    if 0.0 < percent < 0.05:
        return "< 0.1 %"
    return f"{percent:.1f} %" if percent < 9.95 else f"{percent:.0f} %"


def format_probability(probability: float) -> str:
    """Format a probability in per cent, with "<" or ">" if it would round to 0 or 100 %."""
    if probability < 0.0005:
        return "< 0.1 %"
    if probability > 0.9995:
        return "> 99.9 %"
    return f"{100.0 * probability:.1f} %"


def format_p(p: float) -> str:
    """Format a p-value, such as ``p = 0.03``; one too small for a double is not zero."""
    return f"p = {format_number(p, 2)}" if p >= _MIN_P else f"p < {_MIN_P:g}"


def format_items(count: int, noun: str) -> str:
    """Format a count with its noun: ``1 gap``, ``2 gaps``."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def _is_determined(value: float | None, u: float | None) -> bool:
    if u is not None and u < 0.0:
        raise ValueError(f"a standard uncertainty cannot be negative; got {u}")
    if value is None or not math.isfinite(value):
        return False
    return u is None or math.isfinite(u)


def _append_unit(text: str, unit: str) -> str:
    return f"{text} {unit}" if unit else text


def _to_decimal(number: float) -> Decimal:
    # Use the shortest decimal text: 0.125 ± 0.05 is a tie for a reader, whatever its binary digits.
    return Decimal(repr(float(number)))


def _round_to_steps(number: Decimal, last_digit: int) -> Decimal:
    """Return the number in steps of 10^last_digit, rounded."""
    # Convert by an integer: a Decimal such as 2E+1 would lack its zeros.
    return Decimal(int(number.scaleb(-last_digit).to_integral_value(ROUND_HALF_EVEN)))


def _round_at_digit(number: Decimal, last_digit: int) -> Decimal:
    return _round_to_steps(number, last_digit).scaleb(last_digit)


def _format_digits(number: Decimal, last_digit: int, exponent: int) -> str:
    return f"{_round_to_steps(number, last_digit).scaleb(last_digit - exponent):f}"

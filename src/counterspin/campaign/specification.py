"""[specification]: tolerance limits of coefficients, and the decision rule.

The table is in ``campaign.toml`` or, for a certificate, in the laboratory's file.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace
from typing import Annotated, Any, Final, get_args

from pydantic import AfterValidator, ConfigDict, Field, PlainValidator, PrivateAttr

from counterspin.campaign.documents import KeyPath
from counterspin.campaign.field_types import Contradiction, SettingsSection, key_field, parse_exact
from counterspin.campaign.quantity import NUMBER, PLUS_MINUS, parse_quantity
from counterspin.campaign.validation import Problems, suggest_name
from counterspin.errors import InputError, OutOfRangeError
from counterspin.inference.conformity import DecisionRule, Specification
from counterspin.inference.global_risk import Process
from counterspin.inference.verdicts import RuleName
from counterspin.physics.terms import TERMS

_SPECIFICATION_FORMS: Final = (
    '"abs <= A UNIT", "<= A UNIT", ">= A UNIT", "A to B UNIT" or "V ± T UNIT"'
)

_PLATFORM_TERM_REFUSAL: Final = (
    "is a machine term; only accelerometer terms can have a specification"
)

_RANGE = re.compile(rf"({NUMBER})\s+to\s+({NUMBER})\s*(\S.*)")
_ONE_SIDED = re.compile(r"(abs\s*)?(<=|>=)\s*(.*)")
_TOLERANCE = re.compile(PLUS_MINUS)


def _check_rule_name(value: object) -> object:
    known_rules = get_args(RuleName)
    if value not in known_rules:
        raise InputError(
            f"must be {', '.join(map(repr, known_rules[:-1]))} or {known_rules[-1]!r}",
            "unknown-choice",
        )
    return value


def _check_number(value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise InputError("must be a number", "wrong-type")
    return float(value)


def _check_guard_factor(value: float) -> float:
    if value < 0.0:
        raise OutOfRangeError(
            "must not be negative: the guard band lies inside the tolerance limits"
        )
    return value


def _check_probability(value: float) -> float:
    if not 0.5 < value < 1.0:
        raise OutOfRangeError("must be between 0.5 and 1")
    return value


class Specifications(SettingsSection):
    """[specification]: limits for the coefficients, and the decision rule.

    The fields are the keys of the decision rule; other keys are terms, or tables of terms by
    accelerometer.
    """

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, str | dict[str, str]] = Field(init=False)

    decision_rule: Annotated[RuleName, PlainValidator(_check_rule_name)] = key_field(
        "rule for deciding between pass and fail", "simple", "guarded"
    )
    guard_factor: Annotated[
        float, PlainValidator(_check_number), AfterValidator(_check_guard_factor)
    ] = key_field(
        "width of the guard band, divided by the expanded uncertainty U; only with the rule "
        "`guarded`",
        0.5,
        1.0,
        kind="number",
    )
    conformance_probability: Annotated[
        float, PlainValidator(_check_number), AfterValidator(_check_probability)
    ] = key_field(
        "required probability of conformity; only with the rule `probability`",
        0.99,
        0.95,
        kind="number",
    )

    process: dict[str, str] = key_field(
        "distribution of each term over items of the same type, as mean ± standard deviation; "
        "used for the [global risks](conformity.md#global-risk)",
        {"K_II": "0 ± 2.5e-5 g/g^2"},
        {},
        absent="none",
    )

    _terms: Mapping[str, Mapping[str, Specification]] = PrivateAttr()

    @property
    def rule(self) -> DecisionRule:
        """The decision rule."""
        return DecisionRule(self.decision_rule, self.guard_factor, self.conformance_probability)

    @property
    def terms(self) -> Mapping[str, Mapping[str, Specification]]:
        """Accelerometer -> term symbol -> specification."""
        return self._terms

    def contradictions(self) -> Iterator[Contradiction]:
        """Yield keys that belong to another decision rule."""
        for key, rule in _RULE_OF_KEY.items():
            if key in self.model_fields_set and self.decision_rule != rule:
                message = f"applies to the decision rule {rule!r}, not to {self.decision_rule!r}"
                yield (key,), message, "decision_rule"


#: Key of the table -> decision rule to which it belongs.
_RULE_OF_KEY: Final = {"guard_factor": "guarded", "conformance_probability": "probability"}


def parse_specification(text: object, unit: str, *, gravity: float | None = None) -> Specification:
    """Parse tolerance limits.

    unit: The coefficient's, in which the limits are returned.
    gravity: The site's, m/s^2, as in `counterspin.campaign.quantity.parse_quantity`.
    """
    if not isinstance(text, str):
        raise InputError(f"must be a string, such as {_SPECIFICATION_FORMS}", "wrong-type")
    normalized_text = " ".join(text.replace("−", "-").replace("≤", "<=").replace("≥", ">=").split())
    lower_limit: float | None
    upper_limit: float | None
    if match := _ONE_SIDED.fullmatch(normalized_text):
        limit = parse_exact(match[3], unit, gravity)
        if match[1]:
            if match[2] == ">=":
                raise ValueError(f'{text!r}: a magnitude can only have an upper limit, "abs <= A"')
            if limit <= 0.0:
                raise ValueError(f"{text!r}: the limit of a magnitude must be greater than zero")
            lower_limit, upper_limit = -limit, limit
        else:
            lower_limit, upper_limit = (None, limit) if match[2] == "<=" else (limit, None)
    elif match := _RANGE.fullmatch(normalized_text):
        lower_limit, upper_limit = (
            parse_exact(f"{limit_text} {match[3]}", unit, gravity)
            for limit_text in (match[1], match[2])
        )
        if not lower_limit < upper_limit:
            raise ValueError(f"{text!r}: the first limit must be below the second")
    elif _TOLERANCE.search(normalized_text):
        tolerance = parse_quantity(normalized_text, unit, gravity=gravity)
        if tolerance.u <= 0.0:
            raise ValueError(f"{text!r}: the tolerance must be greater than zero")
        lower_limit, upper_limit = tolerance.value - tolerance.u, tolerance.value + tolerance.u
    else:
        raise ValueError(f"{text!r} is not a specification; write {_SPECIFICATION_FORMS}")
    return Specification(normalized_text, lower_limit, upper_limit, unit)


def resolve_specifications(
    raw: Mapping[str, Any],
    accelerometers: Collection[str],
    *,
    problems: Problems,
    gravity: float | None,
) -> Specifications | None:
    """Return the specifications; None, with the mistakes reported, if they are invalid.

    gravity: Gravity of the site, m/s^2.
    """
    path = ("specification",)
    n_problems = len(problems.lines)
    keys = Specifications.model_fields
    rule = problems.check(Specifications, {key: raw[key] for key in raw if key in keys}, path)
    tables = {key: value for key, value in raw.items() if isinstance(value, Mapping)}
    common_limits = {key: raw[key] for key in raw if key not in keys and key not in tables}
    common_terms = _parse_terms(
        common_limits, path, [*keys, *TERMS, *accelerometers], problems, gravity
    )
    terms_by_accelerometer = {}
    for name in [key for key in tables if key not in keys]:
        if name == "platform" and name not in accelerometers:
            problems.add((*path, name), _PLATFORM_TERM_REFUSAL)
            continue
        if name not in accelerometers:
            problems.add(
                (*path, name),
                f'no accelerometer is named "{name}"'
                + _suggest_accelerometer(name, accelerometers),
                "unknown-accelerometer",
            )
        terms_by_accelerometer[name] = _parse_terms(
            tables[name], (*path, name), list(TERMS), problems, gravity
        )
    if (
        not common_terms
        and not any(terms_by_accelerometer.values())
        and len(problems.lines) == n_problems
    ):
        problems.add(
            path,
            f"contains no term; write, for example, K_II = {_SPECIFICATION_FORMS.split(',')[0]}",
            "missing-value",
        )
    if rule is None or len(problems.lines) > n_problems:
        return None
    terms = {
        name: {**common_terms, **terms_by_accelerometer.get(name, {})} for name in accelerometers
    }
    processes = _resolve_processes(rule.process, terms, path, problems, gravity)
    if len(problems.lines) > n_problems:
        return None
    return rule.replace_private(
        terms={
            name: {
                symbol: replace(specification, process=processes.get(symbol))
                for symbol, specification in limits.items()
            }
            for name, limits in terms.items()
        }
    )


def _resolve_processes(
    raw: Mapping[str, str],
    terms: Mapping[str, Mapping[str, Specification]],
    path: KeyPath,
    problems: Problems,
    gravity: float | None,
) -> dict[str, Process]:
    """Return the distribution of each term over items of the same type."""
    specified_symbols = {symbol for specifications in terms.values() for symbol in specifications}
    processes = {}
    for symbol, text in raw.items():
        key = (*path, "process", symbol)
        if symbol not in specified_symbols:
            problems.add(key, f'"{symbol}" has no limits in [specification]', "missing-key")
            continue
        quantity = problems.collect(key, parse_quantity, text, TERMS[symbol].unit, gravity=gravity)
        if quantity is not None and quantity.u <= 0.0:
            problems.add(
                key, "needs a standard deviation, such as 0 ± 2.5e-5 g/g^2", "wrong-uncertainty"
            )
        elif quantity is not None:
            processes[symbol] = Process(quantity.value, quantity.u)
    return processes


def _parse_terms(
    raw: Mapping[str, Any],
    path: KeyPath,
    known_names: list[str],
    problems: Problems,
    gravity: float | None,
) -> dict[str, Specification]:
    specifications = {}
    for symbol, text in raw.items():
        if symbol not in TERMS:
            if symbol.split(".")[0] in ("platform", "centrifuge", "encoder"):
                message = _PLATFORM_TERM_REFUSAL
            else:
                message = f'unknown term "{symbol}"' + suggest_name(symbol, known_names)
            problems.add((*path, symbol), message, "unknown-term")
            continue
        specification = problems.collect(
            (*path, symbol), parse_specification, text, TERMS[symbol].unit, gravity=gravity
        )
        if specification is not None:
            specifications[symbol] = specification
    return specifications


def _suggest_accelerometer(name: str, accelerometers: Collection[str]) -> str:
    return suggest_name(name, accelerometers) if accelerometers else ""

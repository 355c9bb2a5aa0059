"""Conformity of the coefficients of a result with their specifications."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from counterspin.calibration.result import Result
from counterspin.calibration.result_parts import AccelerometerResult
from counterspin.campaign.specification import Specifications
from counterspin.inference.conformity import (
    DecisionRule,
    Specification,
    decide,
    undecided_conformity,
)
from counterspin.inference.verdicts import Conformity

_AS_PRINTED_REASON: Final = (
    "the equations as printed yield half the true K_II, so conformity cannot be decided"
)
_CONTRADICTED_REASON: Final = "the records contradict the result, so conformity cannot be decided"


def judge_conformity(result: Result, specifications: Specifications) -> Result:
    """Return the result with `conformity` of every accelerometer that has a specification.

    specifications: From the campaign or the laboratory's file; those that the result has are
        replaced.
    """
    accelerometers = {
        name: accelerometer.model_copy(
            update={
                "conformity": judge_accelerometer(
                    accelerometer,
                    specifications.terms.get(name, {}),
                    specifications.rule,
                    model=result.model,
                    is_contradicted=accelerometer.state == "contradicted"
                    and result.accepted_misfit is None,
                )
            }
        )
        for name, accelerometer in result.accelerometers.items()
    }
    return result.model_copy(update={"accelerometers": accelerometers})


def judge_accelerometer(
    accelerometer: AccelerometerResult,
    specifications: Mapping[str, Specification],
    rule: DecisionRule,
    *,
    model: str,
    is_contradicted: bool = False,
) -> dict[str, Conformity]:
    """Return the verdicts by term; undecided, with the reason, if there is no estimate.

    model: Observation model of the result, ``exact`` or ``as-printed``.
    is_contradicted: True if the records contradict the result and the misfit was not accepted.
    """
    general_reason = (
        _AS_PRINTED_REASON
        if model == "as-printed"
        else _CONTRADICTED_REASON
        if is_contradicted
        else None
    )
    return {
        symbol: _judge_term(accelerometer, symbol, specification, rule, general_reason)
        for symbol, specification in specifications.items()
    }


def _judge_term(
    accelerometer: AccelerometerResult,
    symbol: str,
    specification: Specification,
    rule: DecisionRule,
    general_reason: str | None,
) -> Conformity:
    """Return the verdict on a term; `general_reason` makes every verdict undecided."""
    coefficient = accelerometer.coefficients.get(symbol)
    if coefficient is None:
        reason = f"{symbol} is not among the terms of the model"
    elif not coefficient.estimated or coefficient.value is None or coefficient.u is None:
        reason = f"the records do not determine {symbol}"
    elif general_reason is not None:
        reason = general_reason
    else:
        return decide(coefficient.value, coefficient.u, coefficient.dof, specification, rule)
    return undecided_conformity(specification, rule, reason)

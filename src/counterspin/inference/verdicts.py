"""The verdict on a coefficient and its specification, as a result states it."""

from __future__ import annotations

from dataclasses import KW_ONLY
from typing import Literal

from counterspin.frozen import frozen

RuleName = Literal["simple", "guarded", "probability"]
Verdict = Literal["pass", "fail", "undecided"]


@frozen
class GlobalRisk:
    """Risks of a decision rule for items of a process (JCGM 106, clause 9)."""

    _: KW_ONLY
    mean: float  #: Mean of the process, in the unit of the limits.
    sigma: float  #: Standard deviation of the process.
    consumer: float  #: Probability that an item is accepted and does not conform.
    producer: float  #: Probability that an item conforms and is not accepted.


@frozen
class Conformity:
    """Verdict on a coefficient's specification, by a stated decision rule (JCGM 106)."""

    _: KW_ONLY
    specification: str  #: Specification as written, such as ``abs <= 5e-5 g/g^2``.
    low: float | None  #: Lower tolerance limit, in `unit`; None without one.
    high: float | None  #: Upper tolerance limit, in `unit`; None without one.
    unit: str  #: Unit of the limits, the guard band and the coefficient.
    rule: RuleName  #: Decision rule: ``simple``, ``guarded`` or ``probability``.
    #: Width in `unit` by which the acceptance limits lie inside the tolerance limits, 0 without
    #: guard bands; None without an estimate.
    guard_band: float | None
    needed: float | None = None  #: Probability that the rule requires; None if it requires none.
    verdict: Verdict  #: Verdict by the rule: ``pass``, ``fail`` or ``undecided``.
    #: Probability that the coefficient conforms, given the estimate and its uncertainty.
    probability: float | None
    #: Probability that the verdict is wrong: the specific consumer's risk of a pass, the specific
    #: producer's risk of a fail; None if it is undecided.
    risk: float | None
    reason: str | None = None  #: Reason for an undecided verdict; otherwise None.
    #: Risks for items of the stated process; None if none is stated.
    global_risk: GlobalRisk | None = None

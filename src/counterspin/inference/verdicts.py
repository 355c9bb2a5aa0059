"""Verdict of a result on a coefficient and its specification."""

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
    consumer: float  #: Probability that an item does not conform but is accepted.
    producer: float  #: Probability that an item conforms but is not accepted.


@frozen
class Conformity:
    """Verdict on a coefficient's specification, by a stated decision rule (JCGM 106)."""

    _: KW_ONLY
    specification: str  #: Specification as written, such as ``abs <= 5e-5 g/g^2``.
    low: float | None  #: Lower tolerance limit, in `unit`; null if there is none.
    high: float | None  #: Upper tolerance limit, in `unit`; null if there is none.
    unit: str  #: Unit of the limits, the guard band and the coefficient.
    rule: RuleName  #: Decision rule: ``simple``, ``guarded`` or ``probability``.
    #: Distance by which the acceptance limits lie inside the tolerance limits, in `unit`; 0 without
    #: a guard band, null without an estimate.
    guard_band: float | None
    #: Conformance probability that the rule requires; null if the rule does not require one.
    needed: float | None = None
    #: Verdict according to the decision rule: ``pass``, ``fail`` or ``undecided``.
    verdict: Verdict
    #: Probability that the coefficient conforms, given the estimate and its uncertainty.
    probability: float | None
    #: Probability that the verdict is wrong. For a pass, this is the specific consumer's risk; for
    #: a fail, the specific producer's risk; null for an undecided verdict.
    risk: float | None
    reason: str | None = None  #: Reason for an undecided verdict; otherwise None.
    #: Consumer's and producer's risk for items drawn from the stated production process; null if no
    #: process is stated.
    global_risk: GlobalRisk | None = None

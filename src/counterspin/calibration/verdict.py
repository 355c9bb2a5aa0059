"""Is a result good? In words, from what the result itself says.

- `verdict`: of one accelerometer
- `Verdict`
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from counterspin.calibration.pages.accelerometer import noticed_if_left_out
from counterspin.calibration.result_parts import AccelerometerResult
from counterspin.inference.diagnostics import AGREEMENT, SIGNIFICANCE
from counterspin.reports.numbers import format_number


@dataclass(frozen=True)
class Verdict:
    """Whether K_II may be relied on.

    Attributes
    ----------
    grade
        ``good``; ``with reservations``: something was found that its uncertainty may not hold;
        ``not determined``: there is no K_II.
    speaks_for, speaks_against
        Reasons, clauses without a full stop.
    taken_as_zero
        Terms that the model leaves out and that would be noticed in K_II.
    """

    grade: Literal["good", "with reservations", "not determined"]
    speaks_for: tuple[str, ...]
    speaks_against: tuple[str, ...]
    taken_as_zero: tuple[str, ...] = ()

    def sentence(self, name: str) -> str:
        """Return it in words for the accelerometer of this name."""
        opening = {
            "good": f"{name} is good",
            "with reservations": f"{name} is to be used with reservations",
            "not determined": f"{name}: these records do not determine K_II",
        }[self.grade]
        reasons = self.speaks_against or self.speaks_for
        sentences = [f"{opening}: {'; '.join(reasons)}." if reasons else f"{opening}."]
        if self.speaks_against and self.speaks_for:
            sentences.append(f"For it speaks: {'; '.join(self.speaks_for)}.")
        if self.taken_as_zero:
            sentences.append(
                f"It rests on these being zero, which the model leaves out: "
                f"{', '.join(self.taken_as_zero)}."
            )
        return " ".join(sentences)


def verdict(found: AccelerometerResult, model: str) -> Verdict:
    """Judge the K_II of one accelerometer.

    Parameters
    ----------
    found
        Its result.
    model
        The result's model: K_II of the equations as printed is half the true one.
    """
    speaks_for: list[str] = []
    against: list[str] = []
    if model == "as-printed":
        against.append("the equations as printed return half the true K_II")
    for good, words in _findings(found):
        (speaks_for if good else against).append(words)
    k_ii = found.coefficients.get("K_II")
    if k_ii is None or not k_ii.estimated:
        return Verdict("not determined", (), tuple(against))
    grade: Literal["good", "with reservations"] = "with reservations" if against else "good"
    zero = tuple(noticed_if_left_out(found))
    return Verdict(grade, tuple(speaks_for), tuple(against), zero)


def _findings(found: AccelerometerResult) -> Iterator[tuple[bool, str]]:
    p = found.residual.lack_of_fit_p
    if p is not None:
        like = "the residuals look like" if p >= SIGNIFICANCE else "the residuals do not look like"
        noise = "the stated noise" if found.residual.chi2 is not None else "independent noise"
        yield p >= SIGNIFICANCE, f"{like} {noise} (p = {format_number(p, 2)})"
    driving = [line for line in found.jackknife if line.z is not None]
    if driving:
        worst = max(driving, key=lambda line: abs(line.z or 0.0))
        drives = abs(worst.z or 0.0) > AGREEMENT
        yield (
            not drives,
            f"K_II without {worst.run} disagrees with that of all runs"
            if drives
            else "no run drives the result",
        )
    if found.two_stage is not None:
        agrees = abs(found.two_stage.z) <= AGREEMENT
        yield agrees, f"the two-stage method {'agrees' if agrees else 'does not agree'}"
    if count := len(found.warnings):
        yield False, "1 warning" if count == 1 else f"{count} warnings"

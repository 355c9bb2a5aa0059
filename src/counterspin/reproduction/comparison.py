"""All figures of the paper beside ours, section by section."""

from __future__ import annotations

from counterspin.reproduction import equations, stages
from counterspin.reproduction.plan import stated_inputs
from counterspin.reproduction.result import PaperSection, Reproduction


def reproduce() -> Reproduction:
    """Recompute the paper's figures and say where they and ours part.

    Returns
    -------
    Reproduction
    """
    return Reproduction(
        inputs=stated_inputs(),
        sections=(
            PaperSection("Equations 5 to 19", equations.coefficients()),
            PaperSection("First stage: sigma(b2), after Eq. 31", stages.first_stage_spread()),
            PaperSection("Second stage: sigma(K_II), after Eq. 34", stages.second_stage_spread()),
            PaperSection(
                "Which K_II is recovered: simulated by Eq. 7, without noise", stages.recovery()
            ),
            PaperSection("What the second unknown of Eq. 26 achieves", stages.second_unknown()),
        ),
    )

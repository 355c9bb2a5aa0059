"""``counterspin reproduce``: the paper's figures beside what they should be, and why.

Only what the paper states goes in: Tables 1 and 2, the plan of section 2.3, its printed
sigma(b2) and sigma(K_II). Everything else is computed when the command runs. The observations
are simulated from first principles, by integrating Eq. 7 with the exact kinematics, so that
they owe nothing to either of the two observation models that they judge.

- `reproduce`: the whole story
- `Reproduction`, `Section`, `Row`: its result
- `simulate_strobes`: one run of the paper's plan without noise
"""

from __future__ import annotations

from counterspin.reproduction import equations, stages
from counterspin.reproduction.plan import simulate_strobes, stated_inputs
from counterspin.reproduction.result import Reproduction, Row, Section

__all__ = ["Reproduction", "Row", "Section", "reproduce", "simulate_strobes"]


def reproduce() -> Reproduction:
    """Recompute the paper's figures and say where they and ours part.

    Returns
    -------
    Reproduction
    """
    return Reproduction(
        stated_inputs(),
        (
            Section("Equations 5 to 19", equations.coefficients()),
            Section("First stage: sigma(b2), after Eq. 31", stages.first_stage_spread()),
            Section("Second stage: sigma(K_II), after Eq. 34", stages.second_stage_spread()),
            Section("Whose K_II comes back: simulated by Eq. 7, without noise", stages.recovery()),
            Section("What the second unknown of Eq. 26 is good for", stages.second_unknown()),
        ),
    )

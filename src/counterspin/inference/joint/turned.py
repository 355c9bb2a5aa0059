"""An accelerometer turned about its input axis, which its records may not show.

Which way the pendulous and output axes point decides what the terms with a_P and a_O are: half a
turn reverses the sign of K_IP, K_IO, delta_O and delta_P, a quarter exchanges K_PP and K_OO.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from counterspin.inference.joint.fit import JointFit
from counterspin.inference.joint.prepared import Prepared
from counterspin.physics.accelerometer import Mounting
from counterspin.physics.terms import TERMS

#: The terms that the turn changes.
ACROSS: Final = tuple(
    symbol for symbol, row in TERMS.items() if not {"P", "O"}.isdisjoint(row.effect.factors)
)


def turned(mounting: Mounting, quarters: int) -> Mounting:
    """Return a mounting after quarter turns about its input axis, from P towards O."""
    along, pendulous, output = mounting.matrix
    for _ in range(quarters % 4):
        pendulous, output = output, -pendulous
    return Mounting.from_axes(along.tolist(), pendulous.tolist(), output.tolist())


def with_turned(fit: JointFit, accelerometer: str, quarters: int) -> JointFit:
    """Return a relaxed fit with an accelerometer turned; what was stated is of its axes then."""
    observations = tuple(
        _with_columns(fit, one, quarters)
        if isinstance(one, Prepared) and one.accelerometer == accelerometer
        else one
        for one in fit.observations
    )
    fit = replace(fit, observations=observations)
    return fit.with_noise({name: fit.noise[name] for name in fit.noise if name == accelerometer})


def _with_columns(fit: JointFit, part: Prepared, quarters: int) -> Prepared:
    symbols = [fit.model.unknowns[place].symbol for place in part.unknowns]
    places = [k for k, symbol in enumerate(symbols) if symbol in ACROSS]
    series = replace(part.series, mounting=turned(part.series.mounting, quarters))
    design = part.design.copy()
    if places:
        shown = series.columns([symbols[k] for k in places], part.scale_factor)
        design[:, places] = np.asarray(shown)
    return replace(part, series=series, design=design)

"""How a calibration is made; nothing here takes time to load.

- `Method`: the joint fit of full records, or the paper's two stages
- `TwoStageOptions`: how the paper's method is applied
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from counterspin.physics.as_printed import RippleModel

Method = Literal["joint", "two-stage"]


@dataclass(frozen=True)
class TwoStageOptions:
    """How the paper's method is applied.

    Attributes
    ----------
    model
        ``exact`` or ``as-printed``.
    weighted
        Whether the second stage weights runs by sigma(b2); the paper does not.
    ripple
        As printed: the ripple's ``amplitude`` or its ``ratio`` to the rate is common to the runs.
    fit_bias
        Whether K_F is estimated, with its prior, or taken as known.
    from_residuals
        Whether sigma is taken from the residuals even where the campaign states it.
    """

    model: Literal["exact", "as-printed"] = "exact"
    weighted: bool = True
    ripple: RippleModel = "amplitude"
    fit_bias: bool = True
    from_residuals: bool = False

    def words(self) -> list[str]:
        """Return the options as they are typed, where they are not the defaults."""
        usual = TwoStageOptions()
        typed = {
            "model": f"--model={self.model}",
            "weighted": "--no-weighted",
            "ripple": f"--ripple={self.ripple}",
            "fit_bias": "--no-fit-bias",
            "from_residuals": "--sigma=residuals",
        }
        return [text for key, text in typed.items() if getattr(self, key) != getattr(usual, key)]

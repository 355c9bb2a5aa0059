"""How a calibration is made; nothing here takes time to load."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final, Literal

from counterspin.errors import CampaignError
from counterspin.frozen import frozen

if TYPE_CHECKING:
    from counterspin.physics.as_printed import RippleModel

Method = Literal["joint", "two-stage"]


@frozen
class TwoStageOptions:
    """How the paper's method is applied."""

    model: Literal["exact", "as-printed"] = "exact"  #: ``exact`` or ``as-printed``.
    #: Whether the second stage weights runs by sigma(b2); the paper does not.
    weighted: bool = True
    #: As printed: the ripple's ``amplitude`` or its ``ratio`` to the rate is common to the
    #: runs.
    ripple: RippleModel = "amplitude"
    fit_bias: bool = True  #: Whether K_F is estimated, with its prior, or taken as known.
    #: Whether sigma is taken from the residuals even where the campaign states it.
    from_residuals: bool = False


def acceptance_arguments(accepted_misfit: str | None) -> list[str]:
    """Return the words by which a command line accepts a misfit, if it was accepted."""
    return [] if accepted_misfit is None else [f"--accept-misfit={accepted_misfit}"]


#: The module of intervals by Monte Carlo, loaded where they are asked for.
MONTE_CARLO: Final = "counterspin.calibration.monte_carlo"


def further_arguments(without: Sequence[str], monte_carlo: int) -> list[str]:
    """Return the words by which a command line leaves runs out and draws inputs."""
    trial_arguments = [f"--monte-carlo={monte_carlo}"] if monte_carlo else []
    return [*(f"--without={name}" for name in without), *trial_arguments]


def command_arguments(method: str, options: TwoStageOptions) -> list[str]:
    """Return the words of a command line that asks for a calibration, where it is not the usual.

    A result keeps them, so that whoever reads it can repeat it: the one place below the command
    line that knows its options, and a test has the command line read them back.
    """
    if method == "joint":
        return []
    defaults = TwoStageOptions()
    arguments = {
        "model": f"--model={options.model}",
        "weighted": "--no-weighted",
        "ripple": f"--ripple={options.ripple}",
        "fit_bias": "--no-fit-bias",
        "from_residuals": "--sigma=residuals",
    }
    return [
        "--method=two-stage",
        *(
            text
            for key, text in arguments.items()
            if getattr(options, key) != getattr(defaults, key)
        ),
    ]


#: Words without a value, and the option that each sets.
_FLAGS: Final[dict[str, dict[str, Any]]] = {
    "--no-weighted": {"weighted": False},
    "--no-fit-bias": {"fit_bias": False},
    "--sigma=residuals": {"from_residuals": True},
}


def parse_options(arguments: Sequence[str]) -> tuple[Method, TwoStageOptions, tuple[str, ...]]:
    """Return the method, its options and the runs left out that a result's words ask for."""
    method: Method = "joint"
    keywords: dict[str, Any] = {}
    without = []
    for argument in arguments:
        key, _, value = argument.partition("=")
        if argument == "--method=two-stage":
            method = "two-stage"
        elif argument in _FLAGS:
            keywords |= _FLAGS[argument]
        elif key in ("--model", "--ripple"):
            keywords[key.removeprefix("--")] = value
        elif key == "--without":
            without.append(value)
        else:
            raise CampaignError(
                "the options of the result",
                [f"{argument}: this version does not have this option"],
                code="newer-version",
            )
    return method, TwoStageOptions(**keywords), tuple(without)

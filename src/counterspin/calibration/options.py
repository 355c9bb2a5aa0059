"""Options of a calibration, without imports that take time to load."""

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
    """Options of the two-stage method."""

    model: Literal["exact", "as-printed"] = "exact"  #: ``exact`` or ``as-printed``.
    #: Whether the second stage weights runs by 1/sigma(b2)^2; the paper does not.
    weighted: bool = True
    #: With the printed equations: whether all runs have the same ripple ``amplitude``, or the
    #: same ``ratio`` of ripple to rate.
    ripple: RippleModel = "amplitude"
    fit_bias: bool = True  #: Whether K_F is estimated with its prior; if false, it is fixed.
    #: Whether sigma is estimated from the residuals even if the campaign states it.
    from_residuals: bool = False


def acceptance_arguments(accepted_misfit: str | None) -> list[str]:
    """Return the command-line arguments that accept a misfit; empty if none was accepted."""
    return [] if accepted_misfit is None else [f"--accept-misfit={accepted_misfit}"]


#: Module of the Monte Carlo intervals, loaded on demand.
MONTE_CARLO: Final = "counterspin.calibration.monte_carlo"


def extra_arguments(without: Sequence[str], monte_carlo: int) -> list[str]:
    """Return the command-line arguments that omit runs and request Monte Carlo intervals."""
    trial_arguments = [f"--monte-carlo={monte_carlo}"] if monte_carlo else []
    return [*(f"--without={name}" for name in without), *trial_arguments]


def command_arguments(method: str, options: TwoStageOptions) -> list[str]:
    """Return the command-line arguments of a calibration that differ from the defaults.

    The result stores them so that the calibration can be repeated.
    """
    if method == "joint":
        return []
    default_options = TwoStageOptions()
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
            if getattr(options, key) != getattr(default_options, key)
        ),
    ]


#: Argument without a value -> option that it sets.
_VALUELESS_ARGUMENTS: Final[dict[str, dict[str, Any]]] = {
    "--no-weighted": {"weighted": False},
    "--no-fit-bias": {"fit_bias": False},
    "--sigma=residuals": {"from_residuals": True},
}


def parse_options(arguments: Sequence[str]) -> tuple[Method, TwoStageOptions, tuple[str, ...]]:
    """Return method, options and omitted runs from the arguments that a result stores."""
    method: Method = "joint"
    option_values: dict[str, Any] = {}
    without = []
    for argument in arguments:
        key, _, value = argument.partition("=")
        if argument == "--method=two-stage":
            method = "two-stage"
        elif argument in _VALUELESS_ARGUMENTS:
            option_values |= _VALUELESS_ARGUMENTS[argument]
        elif key in ("--model", "--ripple"):
            option_values[key.removeprefix("--")] = value
        elif key == "--without":
            without.append(value)
        else:
            raise CampaignError(
                "the options recorded in the result",
                [f"{argument}: this version has no such option"],
                code="newer-version",
            )
    return method, TwoStageOptions(**option_values), tuple(without)

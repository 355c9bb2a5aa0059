"""Extensions of a calibration: functions that it loads by name.

Coefficients, uncertainties, tests and states do not depend on them. The diagnosis adds the causes
of a misfit. The two-stage method is that of the paper, and checks the joint K_II. Readings and
poses of a triad are further data of the joint fit.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final, cast

from counterspin.calibration.accelerometer_view import AccelerometerView, ReadingData
from counterspin.calibration.findings import Cause
from counterspin.calibration.joint_problem import JointProblem
from counterspin.calibration.options import TwoStageOptions
from counterspin.calibration.outcome import Outcome
from counterspin.calibration.result import Result
from counterspin.calibration.result_parts import AccelerometerResult, Comparison, Trace
from counterspin.errors import CampaignError
from counterspin.frozen import frozen
from counterspin.inference.joint.estimation import Estimate
from counterspin.loading import is_installed, load_name

if TYPE_CHECKING:
    from counterspin.campaign.specification import Specifications

DIAGNOSIS_FUNCTION: Final = "counterspin.calibration.diagnosis.search:diagnose"
TWO_STAGE_FUNCTION: Final = "counterspin.calibration.two_stage.method:calibrate_two_stage"
CONFORMITY_FUNCTION: Final = "counterspin.calibration.conformity:judge_conformity"
READINGS_FUNCTION: Final = "counterspin.readings.joint_data:join_readings"
COMPARISON_FUNCTION: Final = "counterspin.calibration.two_stage.comparison:compare_k_ii"
TRACES_FUNCTION: Final = "counterspin.calibration.pages.traces:thin_residuals"


@frozen
class Diagnosis:
    """The causes of the findings on a campaign, and remarks on unverifiable inputs."""

    causes: tuple[Cause, ...] = ()  #: The main cause first.
    remarks: tuple[str, ...] = ()


#: Arguments: views of the joint fit, and results by accelerometer.
Diagnose = Callable[[Sequence[AccelerometerView], Mapping[str, AccelerometerResult]], Diagnosis]


def find_diagnosis() -> Diagnose | None:
    """Return the function that searches for causes; None if it is not installed."""
    return cast("Diagnose | None", _load_optional(DIAGNOSIS_FUNCTION))


def apply_two_stage(problem: JointProblem, options: TwoStageOptions) -> Outcome:
    """Return the outcome of the two-stage method; CampaignError if it is not installed."""
    method = _load_optional(TWO_STAGE_FUNCTION)
    if method is None:
        raise CampaignError(
            "calibrate",
            ["`method`: this installation does not include the two-stage method"],
            code="missing-package",
        )
    if problem.campaign.model.correlations:
        raise CampaignError(
            str(problem.campaign.path),
            [
                "model.priors.correlation: the two-stage method treats priors as independent; "
                "use the joint method, or remove the correlations"
            ],
            code="conflicting-keys",
        )
    return cast(Outcome, method(problem, options))


def compare_two_stage(view: AccelerometerView) -> Comparison | None:
    """Return the comparison with the two-stage K_II; None if the method does not apply."""
    compare = _load_optional(COMPARISON_FUNCTION)
    return None if compare is None else cast("Comparison | None", compare(view))


def thin_residuals(view: AccelerometerView) -> dict[str, Trace]:
    """Return the thinned residuals for plots, by run; empty if pages are not installed."""
    make_traces = _load_optional(TRACES_FUNCTION)
    return {} if make_traces is None else cast("dict[str, Trace]", make_traces(view))


def join_readings(problem: JointProblem) -> tuple[Estimate, ReadingData]:
    """Return the estimate from records, readings and poses, and its readings and poses."""
    if (join := _load_optional(READINGS_FUNCTION)) is None:
        raise CampaignError(
            "calibrate",
            ["this installation cannot read tables of readings"],
            code="missing-package",
        )
    return cast("tuple[Estimate, ReadingData]", join(problem))


def apply_specifications(result: Result, specifications: Specifications) -> Result:
    """Return the result with the conformity of its coefficients."""
    return cast(Result, load_name(CONFORMITY_FUNCTION)(result, specifications))


def _load_optional(name: str) -> Callable[..., Any] | None:
    return load_name(name) if is_installed(name) else None

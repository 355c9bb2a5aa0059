"""`counterspin calibrate`: one campaign, or several with a summary."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, Literal

from cyclopts import Parameter

from counterspin.cli.words import NOT_SAVED, OnOff, Saved, group
from counterspin.errors import CampaignError, CounterspinError
from counterspin.frozen import frozen

if TYPE_CHECKING:
    from counterspin.calibration.options import TwoStageOptions
    from counterspin.output import FileKind

_CONTRADICTED: Final = "the records contradict the result"
_WHAT_TO_DO: Final = (
    "Find the cause and calibrate again; or, if the result is to be used all the same, say why: "
    "--accept-misfit REASON"
)


@group
@frozen
class Estimation:
    """How the coefficients are estimated.

    Parameters
    ----------
    method
        All samples in one weighted fit, or the paper's two stages.
    model
        Observation model of the two-stage method: the exact one, or the paper's as printed.
    weighted
        Two-stage: weight the runs by sigma(b2); the paper does not.
    ripple
        Two-stage, as printed: what is common to all rates, the ripple's amplitude or its ratio.
    fit_bias
        Two-stage: estimate K_F with its prior, or take it as known.
    sigma
        Two-stage: the displacement noise that the campaign gives, or that of the residuals.
    without
        A run to leave out; once for each. Of several campaigns, each must have it.
    """

    method: Literal["joint", "two-stage"] = "joint"
    model: Literal["exact", "as-printed"] = "exact"
    weighted: OnOff = True
    ripple: Literal["amplitude", "ratio"] = "amplitude"
    fit_bias: OnOff = True
    sigma: Literal["given", "residuals"] = "given"
    without: Annotated[tuple[str, ...], Parameter(consume_multiple=False)] = ()


@group
@frozen
class Printed:
    """What is printed beside the coefficients.

    Parameters
    ----------
    budget
        Joint: print where the uncertainty of each coefficient comes from, line by line.
    details
        Print all that was found: tests of each run, samples left out, correlations.
    """

    budget: bool = False
    details: bool = False


@group
@frozen
class BatchWorkers:
    """Who calibrates several campaigns.

    Parameters
    ----------
    workers
        Several campaigns: processes.
    cluster
        Several campaigns: address of a Dask scheduler, whose workers see the same folders.
    """

    workers: int = 1
    cluster: str | None = None


@group
@frozen
class Kept:
    """What is kept of a result: why it is used, and in which instrument's ledger it is.

    Parameters
    ----------
    accept_misfit
        The reason for which the result is to be used even if the records contradict it.
    ledger
        Enter the result's file, that of --json, in this ledger, to which entries are only added.
    who
        With --ledger: who enters it.
    why
        With --ledger: why, in words.
    """

    accept_misfit: str | None = None
    ledger: Path | None = None
    who: str | None = None
    why: str | None = None

    def check(self, campaigns: int, json: Path | None) -> None:
        """Refuse what cannot be entered, before there is a result."""
        if self.ledger is None:
            if self.who or self.why:
                raise CampaignError("calibrate", ["--who and --why go with --ledger FILE"])
            return
        if campaigns > 1:
            raise CampaignError("calibrate", ["--ledger enters the result of one campaign"])
        if json is None or not self.who or not self.why:
            raise CampaignError(
                "calibrate", ["with --ledger, give --json FILE, --who NAME and --why REASON"]
            )
        if json.resolve() == self.ledger.resolve():
            raise CampaignError("calibrate", ["--ledger and --json name the same file"])
        from counterspin.certificates.entering import check_ledger

        check_ledger(self.ledger)

    def enter(self, json: Path | None) -> None:
        """Enter the result's file, where that is asked for."""
        if self.ledger is not None and json is not None and self.who and self.why:
            from counterspin.cli.ledger import add

            add(self.ledger, json, who=self.who, why=self.why)


_USUAL, _BRIEF, _ALONE, _NOWHERE = Estimation(), Printed(), BatchWorkers(), Kept()


def calibrate(
    directory: Path,
    /,
    *more: Path,
    saved: Saved = NOT_SAVED,
    estimation: Estimation = _USUAL,
    printed: Printed = _BRIEF,
    kept: Kept = _NOWHERE,
    workforce: BatchWorkers = _ALONE,
) -> None:
    """Determine the accelerometers' coefficients from a campaign's records.

    Parameters
    ----------
    directory
        The campaign's folder, or its campaign.toml.
    more
        Further campaigns: a summary of all is printed, and a failing one stops no other.
    """
    from counterspin.calibration.calibrate import calibrate as run
    from counterspin.calibration.options import TwoStageOptions
    from counterspin.reports.progress import progress

    options = TwoStageOptions(
        model=estimation.model,
        weighted=estimation.weighted,
        ripple=estimation.ripple,
        fit_bias=estimation.fit_bias,
        from_residuals=estimation.sigma == "residuals",
    )
    kept.check(1 + len(more), saved.json)
    if more:
        calibrate_several(
            (directory, *more), saved, estimation, options, kept.accept_misfit, workforce
        )
        return
    saved.reserve(_result_kind)
    with progress() as advance:
        result = run(
            directory,
            method=estimation.method,
            options=options,
            accept_misfit=kept.accept_misfit,
            without=estimation.without,
            progress=advance,
        )
    # Loaded last, so that reading begins as early as can be.
    from counterspin.calibration.pages.terminal import print_result
    from counterspin.reports.text import report_console

    with saved.written(result):
        print_result(result, report_console(), budget=printed.budget, details=printed.details)
    kept.enter(saved.json)
    if result.state == "contradicted" and result.accepted_misfit is None:
        raise CounterspinError(f"{_CONTRADICTED}: {result.findings[0].text} {_WHAT_TO_DO}")


def _result_kind() -> FileKind:
    from counterspin.calibration.result import Result

    return Result.file_kind()


def calibrate_several(
    directories: tuple[Path, ...],
    saved: Saved,
    estimation: Estimation,
    options: TwoStageOptions,
    accept_misfit: str | None,
    workforce: BatchWorkers,
) -> None:
    """Calibrate campaigns one by one, print a summary, and raise if any failed."""
    from counterspin.calibration.batch import BatchResult, calibrate_many
    from counterspin.reports.progress import work_progress
    from counterspin.reports.text import report_console
    from counterspin.workers import Workers

    saved.reserve(BatchResult.file_kind)
    with work_progress("Campaigns") as advance:
        batch = calibrate_many(
            directories,
            method=estimation.method,
            options=options,
            accept_misfit=accept_misfit,
            without=estimation.without,
            workers=Workers(workforce.workers, workforce.cluster),
            progress=advance,
        )
    with saved.written(batch):
        report_console().print(batch)
    if batch.failed:
        raise CounterspinError(
            f"{len(batch.failed)} of {len(batch.campaigns)} campaigns could not be calibrated"
        )
    if batch.contradicted:
        raise CounterspinError(f"{_CONTRADICTED} of {len(batch.contradicted)}. {_WHAT_TO_DO}")

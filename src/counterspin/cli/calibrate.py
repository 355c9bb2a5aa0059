"""`counterspin calibrate`: one campaign, or several with a summary."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, Literal

from cyclopts import Parameter

from counterspin.cli.common import (
    NO_RESULT_FILE,
    OnOff,
    SaveOptions,
    WholeNumber,
    command,
    option_group,
)
from counterspin.errors import CounterspinError, CounterspinWarning, UsageError
from counterspin.frozen import frozen

if TYPE_CHECKING:
    from counterspin.calibration.options import TwoStageOptions
    from counterspin.output import FileType

_CONTRADICTION_TEXT: Final = "the records contradict the result"
_REMEDY_TEXT: Final = (
    "Find the cause and calibrate again, or accept the misfit and state the reason: "
    "--accept-misfit REASON"
)


@option_group
@frozen
class EstimationOptions:
    """Estimation of the coefficients.

    Parameters
    ----------
    method
        Estimation method: a single weighted fit of all samples (joint), or the two-stage method of
        the paper.
    model
        Observation model of the two-stage method: exact, or as printed in the paper.
    weighted
        Two-stage: weight each run by 1/sigma(b2)^2. The paper uses equal weights.
    ripple
        Two-stage as printed: whether the amplitude of the rate ripple is the same at all rates, or
        its ratio to the rate.
    fit_bias
        Two-stage: estimate K_F with its prior, or treat K_F as known.
    sigma
        Two-stage: use the displacement noise stated in the campaign, or estimate it from the
        residuals.
    without
        Exclude the run with this name; may be repeated. With several campaigns, the run must exist
        in every campaign.
    monte_carlo
        Number of Monte Carlo trials (JCGM 101) for the coverage intervals, at least 10000. The
        result states whether the trials validate the GUM intervals. Single campaign only.
    """

    method: Literal["joint", "two-stage"] = "joint"
    model: Literal["exact", "as-printed"] = "exact"
    weighted: OnOff = True
    ripple: Literal["amplitude", "ratio"] = "amplitude"
    fit_bias: OnOff = True
    sigma: Literal["given", "residuals"] = "given"
    without: Annotated[tuple[str, ...], Parameter(consume_multiple=False)] = ()
    monte_carlo: WholeNumber = 0


@option_group
@frozen
class PrintOptions:
    """Output in addition to the coefficients.

    Parameters
    ----------
    budget
        Print the uncertainty budget of each coefficient (joint method). Single campaign only.
    details
        Print all diagnostics: findings, tests of each run, rejected samples, correlations. Single
        campaign only.
    """

    budget: bool = False
    details: bool = False


@option_group
@frozen
class BatchWorkers:
    """Processes that calibrate several campaigns.

    Parameters
    ----------
    workers
        Number of processes for several campaigns.
    cluster
        Address of a Dask scheduler for several campaigns; its workers need access to the same
        folders.
    """

    workers: WholeNumber = 1
    cluster: str | None = None

    def check_unused(self) -> None:
        """Check the options of a single campaign, and warn that they have no effect."""
        if (self.workers, self.cluster) == (1, None):
            return
        from counterspin.workers import Workers

        Workers(self.workers, self.cluster)
        text = "`workers` and `cluster` have no effect on a single campaign"
        warnings.warn(CounterspinWarning(text, code="too-many-workers"), stacklevel=3)


@option_group
@frozen
class LedgerOptions:
    """Acceptance of a misfit, and entry in the instrument's ledger.

    Parameters
    ----------
    accept_misfit
        Reason for accepting a result that the records contradict.
    ledger
        Enter the file written by --json in this append-only ledger.
    who
        With --ledger: name of the person who makes the entry.
    why
        With --ledger: reason for the entry.
    """

    accept_misfit: str | None = None
    ledger: Path | None = None
    who: str | None = None
    why: str | None = None

    def check(self, n_campaigns: int, json: Path | None) -> None:
        """Raise UsageError for incomplete options, and check the ledger."""
        if self.ledger is None:
            if self.who or self.why:
                raise UsageError("calibrate", ["--who and --why require --ledger FILE"])
            return
        if n_campaigns > 1:
            raise UsageError("calibrate", ["--ledger accepts the result of a single campaign only"])
        if json is None or not (self.who or "").strip() or not (self.why or "").strip():
            raise UsageError(
                "calibrate", ["--ledger requires --json FILE, --who NAME and --why REASON"]
            )
        if json.resolve() == self.ledger.resolve():
            raise UsageError("calibrate", ["--ledger and --json name the same file"])
        from counterspin.certificates.ledger import check_ledger

        check_ledger(self.ledger)

    def add_result(self, json: Path | None) -> None:
        """Enter the result's file in the ledger, if requested."""
        if self.ledger is not None and json is not None and self.who and self.why:
            from counterspin.cli.results import add_to_ledger

            add_to_ledger(self.ledger, json, who=self.who, why=self.why)


_DEFAULT_ESTIMATION = EstimationOptions()
_DEFAULT_PRINT = PrintOptions()
_DEFAULT_WORKERS = BatchWorkers()
_NO_LEDGER = LedgerOptions()


@command
def calibrate(
    directory: Path,
    /,
    *more: Path,
    save_options: SaveOptions = NO_RESULT_FILE,
    estimation_options: EstimationOptions = _DEFAULT_ESTIMATION,
    print_options: PrintOptions = _DEFAULT_PRINT,
    ledger_options: LedgerOptions = _NO_LEDGER,
    worker_options: BatchWorkers = _DEFAULT_WORKERS,
) -> None:
    """Estimate the coefficients of accelerometers from the records of a campaign.

    Parameters
    ----------
    directory
        Campaign folder, or its campaign.toml.
    more
        Additional campaigns. counterspin prints a summary. If a campaign fails, the others are
        still calibrated.
    """
    from counterspin.calibration.calibrate import calibrate as run_calibration
    from counterspin.calibration.options import TwoStageOptions
    from counterspin.reports.text import show_progress

    options = TwoStageOptions(
        model=estimation_options.model,
        weighted=estimation_options.weighted,
        ripple=estimation_options.ripple,
        fit_bias=estimation_options.fit_bias,
        from_residuals=estimation_options.sigma == "residuals",
    )
    ledger_options.check(1 + len(more), save_options.json)
    if more and (print_options.budget or print_options.details):
        raise UsageError("calibrate", ["--budget and --details accept a single campaign only"])
    if more and estimation_options.monte_carlo:
        raise UsageError("calibrate", ["--monte-carlo accepts a single campaign only"])
    if more:
        calibrate_several(
            (directory, *more),
            save_options,
            estimation_options,
            options,
            ledger_options.accept_misfit,
            worker_options,
        )
        return
    worker_options.check_unused()
    save_options.check_writable(_result_file_type)
    with show_progress() as advance:
        result = run_calibration(
            directory,
            method=estimation_options.method,
            options=options,
            accept_misfit=ledger_options.accept_misfit,
            without=estimation_options.without,
            monte_carlo=estimation_options.monte_carlo,
            progress=advance,
        )
    # Loaded last, so that reading begins as early as possible.
    from counterspin.calibration.pages.document import print_result
    from counterspin.reports.text import make_console

    with save_options.saving(result):
        print_result(
            result, make_console(), budget=print_options.budget, details=print_options.details
        )
    ledger_options.add_result(save_options.json)
    if result.state == "contradicted" and result.accepted_misfit is None:
        raise CounterspinError(
            f"{_CONTRADICTION_TEXT}: {result.findings[0].text} {_REMEDY_TEXT}", code="contradicted"
        )
    if result.state == "not-determined":
        first_finding = result.findings[0]
        raise CounterspinError(
            f"{first_finding.subject} is not determined: {first_finding.text}",
            code="not-determined",
        )


def _result_file_type() -> FileType:
    from counterspin.calibration.result import Result

    return Result.file_kind()


def calibrate_several(
    directories: tuple[Path, ...],
    save_options: SaveOptions,
    estimation_options: EstimationOptions,
    options: TwoStageOptions,
    accept_misfit: str | None,
    worker_options: BatchWorkers,
) -> None:
    """Calibrate campaigns one by one, print a summary, and raise if any failed."""
    from counterspin.calibration.batch import BatchResult, calibrate_many
    from counterspin.reports.text import make_console, show_work_progress
    from counterspin.workers import Workers

    save_options.check_writable(BatchResult.file_kind)
    with show_work_progress("Campaigns") as advance:
        batch = calibrate_many(
            directories,
            method=estimation_options.method,
            options=options,
            accept_misfit=accept_misfit,
            without=estimation_options.without,
            workers=Workers(worker_options.workers, worker_options.cluster),
            progress=advance,
        )
    with save_options.saving(batch):
        make_console().print(batch)
    if batch.failed:
        raise CounterspinError(
            f"{len(batch.failed)} of {len(batch.campaigns)} campaigns could not be calibrated",
            code="batch-failed",
        )
    if batch.contradicted:
        raise CounterspinError(
            f"{_CONTRADICTION_TEXT} of {len(batch.contradicted)}. {_REMEDY_TEXT}",
            code="contradicted",
        )
    if batch.not_determined:
        names = ", ".join(batch.not_determined)
        raise CounterspinError(
            f"the data of {len(batch.not_determined)} of {len(batch.campaigns)} campaigns do not "
            f"determine all requested terms: {names}",
            code="not-determined",
        )

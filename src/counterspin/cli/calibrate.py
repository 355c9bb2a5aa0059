"""`counterspin calibrate`: one campaign, or several with a summary."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

from counterspin.cli.words import JsonFile
from counterspin.errors import CounterspinError

if TYPE_CHECKING:
    from counterspin.calibration.options import TwoStageOptions


def calibrate(
    directory: Path,
    /,
    *more: Path,
    method: Literal["joint", "two-stage"] = "joint",
    model: Literal["exact", "as-printed"] = "exact",
    json: JsonFile = None,
    weighted: bool = True,
    ripple: Literal["amplitude", "ratio"] = "amplitude",
    fit_bias: bool = True,
    sigma: Literal["given", "residuals"] = "given",
    budget: bool = False,
    details: bool = False,
    workers: int = 1,
    cluster: str | None = None,
) -> None:
    """Determine the accelerometers' coefficients from a campaign's records.

    Parameters
    ----------
    directory
        The campaign's folder, or its campaign.toml.
    more
        Further campaigns: a summary of all is printed, and a failing one stops no other.
    method
        All samples in one weighted fit, or the paper's two stages.
    model
        Observation model of the two-stage method: the exact one, or the paper's as printed.
    json
        Write the result to this file too.
    weighted
        Two-stage: weight the runs by sigma(b2); the paper does not.
    ripple
        Two-stage, as printed: what is common to all rates, the ripple's amplitude or its ratio.
    fit_bias
        Two-stage: estimate K_F with its prior, or take it as known.
    sigma
        Two-stage: the displacement noise that the campaign gives, or that of the residuals.
    budget
        Joint: print where the uncertainty of each coefficient comes from, line by line.
    details
        Print all that was found: tests of each run, samples left out, correlations.
    workers
        Several campaigns: processes.
    cluster
        Several campaigns: address of a Dask scheduler, whose workers see the same folders.
    """
    from counterspin.calibration.calibrate import calibrate as run
    from counterspin.calibration.options import TwoStageOptions
    from counterspin.reports.progress import progress

    options = TwoStageOptions(
        model=model,
        weighted=weighted,
        ripple=ripple,
        fit_bias=fit_bias,
        from_residuals=sigma == "residuals",
    )
    if more:
        calibrate_several((directory, *more), json, method, options, workers, cluster)
        return
    with progress() as advance:
        result = run(directory, method=method, options=options, progress=advance)
    # Loaded last, so that reading begins as early as can be.
    from counterspin.calibration.pages.terminal import print_result
    from counterspin.reports.text import report_console

    print_result(result, report_console(), budget=budget, details=details)
    if json is not None:
        # Last: a file that cannot be written must not cost the report as well.
        result.write(json)


def calibrate_several(
    directories: tuple[Path, ...],
    json: Path | None,
    method: Literal["joint", "two-stage"],
    options: TwoStageOptions,
    workers: int,
    cluster: str | None,
) -> None:
    """Calibrate campaigns one by one, print a summary, and raise if any failed."""
    from counterspin.calibration.batch import calibrate_many
    from counterspin.calibration.pages.batch import render_batch
    from counterspin.reports.progress import work_progress
    from counterspin.reports.text import report_console

    with work_progress("Campaigns") as advance:
        batch = calibrate_many(
            directories,
            method=method,
            options=options,
            workers=workers,
            cluster=cluster,
            progress=advance,
        )
    if json is not None:
        batch.write(json)
    report_console().print(render_batch(batch))
    if batch.failed:
        raise CounterspinError(
            f"{len(batch.failed)} of {len(batch.campaigns)} campaigns could not be calibrated"
        )

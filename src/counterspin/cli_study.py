"""The command line of work for many cores: words to calls, nothing else.

- `study`: the command, which `counterspin.cli` offers
- `calibrate_several`: `counterspin calibrate` with several campaigns
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from counterspin.errors import CounterspinError

if TYPE_CHECKING:
    from counterspin.commands.method import TwoStageOptions


def study(
    campaign: Path,
    *,
    trials: int | None = None,
    seed: int | None = None,
    engine: Literal["auto", "surrogate", "exact", "full"] = "auto",
    workers: int = 1,
    cluster: str | None = None,
    output: Annotated[Path | None, Parameter(name=["--output", "-o"])] = None,
    keep_trials: bool = False,
    resume: bool = False,
    json: Annotated[Path | None, Parameter(name="--json")] = None,
) -> None:
    """Try analyses on many simulated campaigns: bias, scatter, and whether claims hold.

    Parameters
    ----------
    campaign
        Campaign with [truth] and perhaps [study], its folder, or a study's own file.
    trials
        How many, in place of the study's own number.
    seed
        Of the random numbers, in place of the study's own.
    engine
        How trials are made; auto takes the fastest that is valid.
    workers
        Processes; the result is the same for any number.
    cluster
        Address of a Dask scheduler, such as tcp://HOST:8786.
    output
        Folder for study.json, figures, and what --resume needs.
    keep_trials
        Write every trial to trials.parquet in that folder.
    resume
        Go on with the study that was begun in that folder.
    json
        Write the result to this file too.
    """
    from json import dumps

    from counterspin.campaign.output import write_text
    from counterspin.commands.study import study as run
    from counterspin.report.progress import work_progress
    from counterspin.report.study import render_study
    from counterspin.report.text import report_console

    with work_progress("Trials") as advance:
        result = run(
            campaign,
            trials=trials,
            seed=seed,
            engine=engine,
            workers=workers,
            cluster=cluster,
            output=output,
            keep_trials=keep_trials,
            resume=resume,
            progress=advance,
        )
    if json is not None:
        write_text(json, dumps(result.to_dict(), indent=1) + "\n")
    if output is not None:
        from counterspin.report.study_figures import write_figures

        write_figures(result, output)
    report_console().print(render_study(result))
    if not result.complete:
        if output is not None:
            print("counterspin: stopped; the same command with --resume goes on", file=sys.stderr)
        raise KeyboardInterrupt


def calibrate_several(
    directories: tuple[Path, ...],
    json: Path | None,
    method: Literal["joint", "two-stage"],
    options: TwoStageOptions,
    workers: int,
    cluster: str | None,
) -> None:
    """Calibrate campaigns one by one, print a summary, and raise if any failed."""
    from counterspin.campaign.output import write_text
    from counterspin.commands.batch import calibrate_many, to_json
    from counterspin.report.batch import render_batch
    from counterspin.report.progress import work_progress
    from counterspin.report.text import report_console

    with work_progress("Campaigns") as advance:
        outcomes = calibrate_many(
            directories,
            method=method,
            options=options,
            workers=workers,
            cluster=cluster,
            progress=advance,
        )
    if json is not None:
        write_text(json, to_json(outcomes))
    report_console().print(render_batch(outcomes))
    failed = sum(one.result is None for one in outcomes)
    if failed:
        raise CounterspinError(f"{failed} of {len(outcomes)} campaigns could not be calibrated")

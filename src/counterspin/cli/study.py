"""`counterspin study`: analyses tested on many simulated campaigns."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from counterspin.cli.common import (
    NO_RESULT_FILE,
    OutputFile,
    SaveOptions,
    WholeNumber,
    command,
    option_group,
)
from counterspin.errors import CounterspinError
from counterspin.frozen import frozen


@option_group
@frozen
class TrialOptions:
    """Number, seed and engine of the trials.

    Parameters
    ----------
    trials
        Number of trials; overrides the number in the study.
    seed
        Seed of the random number generator; overrides the seed in the study.
    engine
        Engine that computes the trials; auto selects the fastest valid one.
    """

    trials: WholeNumber | None = None
    seed: WholeNumber | None = None
    engine: Literal["auto", "linear", "full"] = "auto"


@option_group
@frozen
class StudyWorkers:
    """Processes that compute the trials.

    Parameters
    ----------
    workers
        Number of processes, which does not affect the result.
    cluster
        Address of a Dask scheduler, such as tcp://HOST:8786.
    """

    workers: WholeNumber = 1
    cluster: str | None = None


_DEFAULT_TRIALS, _DEFAULT_WORKERS = TrialOptions(), StudyWorkers()


@command
def study(
    campaign: Path,
    /,
    *,
    trial_options: TrialOptions = _DEFAULT_TRIALS,
    worker_options: StudyWorkers = _DEFAULT_WORKERS,
    output: OutputFile = None,
    keep_trials: bool = False,
    resume: bool = False,
    save_options: SaveOptions = NO_RESULT_FILE,
) -> None:
    """Test analyses on many simulated campaigns: bias, scatter and coverage of the intervals.

    Parameters
    ----------
    campaign
        Campaign with [truth] and optionally [study], its folder, or a study file.
    output
        Folder for study.json, figures and the files required by --resume.
    keep_trials
        Write every trial to trials.parquet in the output folder.
    resume
        Continue the study in the output folder.
    """
    from counterspin.reports.text import make_console, show_work_progress
    from counterspin.studies.folder import StudyFolder
    from counterspin.studies.result import StudyResult
    from counterspin.studies.study import study as run_study
    from counterspin.workers import Workers

    if output is None and (keep_trials or resume):
        option_name = "`keep_trials`" if keep_trials else "`resume`"
        raise CounterspinError(
            f"{option_name} requires the folder of the study (`output`)", code="wrong-usage"
        )
    save_options.check_writable(StudyResult.file_kind)
    study_folder = output and StudyFolder(output, keep_trials, resume, save_options.overwrite)
    with show_work_progress("Trials") as advance:
        result = run_study(
            campaign,
            trials=trial_options.trials,
            seed=trial_options.seed,
            engine=trial_options.engine,
            workers=Workers(worker_options.workers, worker_options.cluster),
            output=study_folder,
            progress=advance,
        )
    with save_options.saving(result):
        if output is not None:
            from counterspin.studies.page import write_figures

            write_figures(result, output, overwrite=resume or save_options.overwrite)
        make_console().print(result)
    if not result.complete:
        advice = "" if output is None else "; to continue, repeat the command with --resume"
        raise KeyboardInterrupt(f"stopped{advice}")

"""The command line: words to calls, errors to one paragraph, nothing else.

Each command imports what it uses when it runs, so that `--help` answers at once.
"""

from __future__ import annotations

import os
import sys
from errno import ENOSPC
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import App, CycloptsError, Parameter

from counterspin._version import __version__
from counterspin.cli_documents import certificate, history, report
from counterspin.cli_study import study
from counterspin.errors import CampaignError, CounterspinError

app = App(
    name="counterspin",
    help="Calibrate inertial accelerometers on precision centrifuges.",
    version=__version__,
    help_format="plaintext",  # nothing there is Markdown, whose reader takes long to load
    suppress_keyboard_interrupt=False,  # `main` has a word for it
)

OutputDirectory = Annotated[Path, Parameter(name=["--output", "-o"])]
JsonFile = Annotated[Path | None, Parameter(name="--json")]


app.command(study)
app.command(report)
app.command(certificate)
app.command(history)


@app.command
def init(directory: Path, /) -> None:
    """Write a commented example campaign to start from.

    Parameters
    ----------
    directory
        Folder for campaign.toml; made if it is not there.
    """
    from counterspin.commands.init import init as run

    written = run(directory)
    print(
        f"Wrote {written}. Edit it, or try it:\n"
        f"  counterspin simulate {_word(written)} -o {_word(directory / 'simulated')}\n"
        f"  counterspin calibrate {_word(directory / 'simulated')}"
    )


@app.command
def simulate(campaign: Path, /, *, output: OutputDirectory, overwrite: bool = False) -> None:
    """Make the records of a campaign whose coefficients are known.

    Parameters
    ----------
    campaign
        Campaign description with [truth] tables, or its folder.
    output
        Folder for the records and a copy of the description.
    overwrite
        Replace records that are already there.
    """
    from counterspin.commands.simulate import simulate as run

    written = run(campaign, output, overwrite=overwrite)
    print(f"Wrote {len(written)} records and campaign.toml to {output}.")


@app.command
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
    from counterspin.commands.calibrate import calibrate as run
    from counterspin.commands.method import TwoStageOptions
    from counterspin.report.progress import progress

    options = TwoStageOptions(
        model=model,
        weighted=weighted,
        ripple=ripple,
        fit_bias=fit_bias,
        from_residuals=sigma == "residuals",
    )
    if more:
        from counterspin.cli_study import calibrate_several

        calibrate_several((directory, *more), json, method, options, workers, cluster)
        return
    with progress() as advance:
        result = run(directory, method=method, options=options, progress=advance)
    # Loaded last, so that reading begins as early as can be.
    from counterspin.campaign.result import write_result
    from counterspin.report.text import print_result, report_console

    print_result(result, report_console(), budget=budget, details=details)
    if json is not None:
        # Last: a file that cannot be written must not cost the report as well.
        write_result(result, json)


@app.command
def apply(
    result: Path,
    file: Path,
    /,
    *,
    accelerometer: str,
    output: OutputDirectory,
    column: Annotated[str | None, Parameter(name="--input")] = None,
    unit: str = "g",
    pendulous: Annotated[str | None, Parameter(allow_leading_hyphen=True)] = None,
    output_axis: Annotated[str | None, Parameter(allow_leading_hyphen=True)] = None,
    others: str | None = None,
    force: bool = False,
) -> None:
    """Correct indicated specific force for a calibrated accelerometer.

    Parameters
    ----------
    result
        Result that `counterspin calibrate --json` wrote.
    file
        Table with a column of indicated specific force, .csv or .parquet.
    accelerometer
        Which of the result's accelerometers it is.
    output
        File to write: the table and two more columns, corrected force and its uncertainty.
    column
        The column to correct; may be left out where only one is possible.
    unit
        Unit of the table's forces: g, m/s^2, mg.
    pendulous
        Specific force along the pendulous axis: a column, or a constant such as "-1 g".
    output_axis
        Specific force along the output axis, likewise.
    others
        Accelerometers beside it, from which both follow: Qy=COLUMN,Qz=COLUMN.
    force
        Apply even a result of the equations as printed, whose K_II is half the true one.
    """
    from counterspin.campaign.result import read_result
    from counterspin.commands.apply_file import apply_file, parse_others
    from counterspin.report.application import render_application
    from counterspin.report.text import report_console

    done = apply_file(
        read_result(result),
        accelerometer,
        file,
        output,
        column=column,
        unit=unit,
        pendulous=pendulous,
        output_axis=output_axis,
        others=parse_others(others),
        force=force,
    )
    report_console().print(render_application(done))


@app.command
def plan(
    file: Path | None = None,
    *,
    check: Path | None = None,
    init: Path | None = None,
    output: Annotated[Path | None, Parameter(name=["--output", "-o"])] = None,
    json: JsonFile = None,
    figures: Path | None = None,
    sampling_rate: str | None = None,
    revolutions: float | None = None,
) -> None:
    """Choose rates, lengths, senses and attitudes of the runs, and predict what they will tell.

    Parameters
    ----------
    file
        The plan: limits and goal.
    check
        In place of a plan: a campaign's folder, to predict what it will tell without its records.
    init
        In place of a plan: write a commented example to this file.
    output
        Folder for the planned campaign's campaign.toml, ready for recording and for `simulate`.
    json
        Write the result to this file too.
    figures
        Folder for figures: u against time, against the highest rate, and its sources.
    sampling_rate
        With --check: of the records, such as "50 Hz", where the campaign does not say it.
    revolutions
        With --check: of each run for which the campaign says no length.
    """
    from counterspin.campaign.plan_result import write_plan_result
    from counterspin.campaign.settings import exact
    from counterspin.commands.plan import check as forecast
    from counterspin.commands.plan import plan as search
    from counterspin.commands.plan import write_campaign, write_example
    from counterspin.report.planning import render_plan
    from counterspin.report.planning_figure import save_figures
    from counterspin.report.text import report_console

    if sum(given is not None for given in (file, check, init)) != 1:
        raise CampaignError("plan", ["give a plan's file, or --check DIR, or --init FILE"])
    if init is not None:
        print(f"Wrote {write_example(init)}. Edit it, or try it:\n  counterspin plan {init}")
        return
    if check is not None:
        if output is not None or figures is not None:
            raise CampaignError("plan", ["--output and --figures need a plan, not --check"])
        try:
            rate = None if sampling_rate is None else exact(sampling_rate, "Hz")
        except ValueError as error:
            raise CampaignError("--sampling-rate", [str(error)]) from error
        result = forecast(check, sampling_rate=rate, revolutions=revolutions)
    else:
        assert file is not None  # one of the three is
        planned = search(file, curves=figures is not None)
        result = planned.result
    if json is not None:
        write_plan_result(result, json)
    report_console().print(render_plan(result))
    if output is not None:
        written = write_campaign(planned, output)
        print(f"\nWrote {written}. Record its runs, or try them:")
        print(f"  counterspin simulate {written} -o {output}/simulated")
    if figures is not None:
        print(f"\nWrote {', '.join(p.name for p in save_figures(result, figures))} to {figures}.")


@app.command
def reproduce(*, json: JsonFile = None) -> None:
    """Recompute the paper's figures beside what is printed, and say why they differ.

    Parameters
    ----------
    json
        Write all figures to this file too.
    """
    from json import dumps

    from counterspin.campaign.output import write_text
    from counterspin.report.reproduction import render_reproduction
    from counterspin.report.text import report_console
    from counterspin.reproduction import reproduce as run

    reproduction = run()
    if json is not None:
        write_text(json, dumps(reproduction.to_dict(), indent=1) + "\n")
    report_console().print(render_reproduction(reproduction))


@app.command
def demo(
    *,
    output: OutputDirectory = Path("counterspin-demo"),
    figure: Literal["svg", "png", "pdf"] = "svg",
) -> None:
    """Simulate and calibrate the paper's plan: truth beside each method, and a figure.

    Parameters
    ----------
    output
        Folder for the campaign, its records and the figure.
    figure
        Format of the figure.
    """
    from counterspin.commands.demo import demo as run
    from counterspin.report.demonstration import demonstration_figure, render_demonstration
    from counterspin.report.figure import save
    from counterspin.report.text import report_console

    shown = run(output)
    drawn = output / f"displacement.{figure}"
    save(demonstration_figure(shown), drawn)
    report_console().print(render_demonstration(shown))
    print(
        f"\nWrote campaign.toml, {len(shown.records)} records and {drawn.name} to {output}. Next:\n"
        f"  counterspin calibrate {_word(output)}"
    )


def _word(path: Path) -> str:
    """Return a path as it may be typed into a shell, blanks and all."""
    from shlex import quote

    return quote(str(path))


def _unforeseen(error: Exception) -> str:
    """Return in words what nothing before has caught: mostly, but not always, our own fault."""
    if isinstance(error, MemoryError):
        return "there is not enough memory for this"
    if isinstance(error, OSError) and error.errno == ENOSPC:
        return "the output cannot be written: there is no space left"
    return (
        f"internal error ({type(error).__name__}: {error}). This is a fault of counterspin, not "
        "of your files: please report it, with the output that COUNTERSPIN_DEBUG=1 gives."
    )


def main(arguments: list[str] | None = None) -> int:
    """Run the command line and return the exit status: 0 done, 1 failed, 2 wrong usage."""
    try:
        app(arguments, exit_on_error=False, print_error=False, result_action="return_value")
    except CounterspinError as error:
        print(f"counterspin: {error}", file=sys.stderr)
        return error.exit_status
    except CycloptsError as error:
        print(f"counterspin: {error}\nTry counterspin --help.", file=sys.stderr)
        return CampaignError.exit_status
    except KeyboardInterrupt:
        print("counterspin: stopped", file=sys.stderr)
        return 130
    except BrokenPipeError:
        sys.stderr.close()
        return 0
    except Exception as error:
        # Never a traceback for a user; with this variable set, one for whoever mends it.
        if os.environ.get("COUNTERSPIN_DEBUG"):
            raise
        print(f"counterspin: {_unforeseen(error)}", file=sys.stderr)
        return 1
    return 0

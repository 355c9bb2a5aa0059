"""`counterspin applied`: the uncertainty budget of the applied acceleration."""

from __future__ import annotations

from pathlib import Path

from counterspin.cli.common import NOT_SAVED, SaveOptions, option_group, print_output
from counterspin.frozen import frozen


@option_group
@frozen
class BudgetOptions:
    """Options of the uncertainty budget.

    Parameters
    ----------
    mounting
        Mounting whose stated alignment counts, if the campaign states several.
    draws
        Number of Monte Carlo draws.
    seed
        Seed of the draws.
    budget
        Print the full budget of each level.
    """

    mounting: str | None = None
    draws: int = 200_000
    seed: int = 1
    budget: bool = False


_DEFAULT_BUDGET = BudgetOptions()


def applied(
    directory: Path,
    /,
    *,
    levels: str | None = None,
    chosen: BudgetOptions = _DEFAULT_BUDGET,
    report: Path | None = None,
    figure: Path | None = None,
    saved: SaveOptions = NOT_SAVED,
) -> None:
    """State the uncertainty budget of the acceleration that an arm centrifuge applies.

    Parameters
    ----------
    directory
        Campaign folder, or its campaign.toml.
    levels
        Accelerations, such as 1,10,50,100g; default: those of the stated rates.
    report
        Also write a report with the full budgets: .html, .pdf or .md.
    figure
        Plot the relative uncertainty against the level: .svg, .png or .pdf.
    """
    from counterspin.acceleration_standard.budget import applied as run
    from counterspin.acceleration_standard.page import (
        FILE_DESCRIPTION,
        relative_plot,
        report_blocks,
    )
    from counterspin.acceleration_standard.result import AppliedAcceleration
    from counterspin.output import marked, reserve
    from counterspin.reports.charts import check_format, save_figure
    from counterspin.reports.publication import check_format as check_report
    from counterspin.reports.text import Report, report_console

    if report is not None:
        check_report(report)
        kind = AppliedAcceleration.report_kind()
        reserve(report, lambda: marked(kind), overwrite=saved.overwrite)
    if figure is not None:
        check_format(figure)
        reserve(figure, lambda: marked(FILE_DESCRIPTION), overwrite=saved.overwrite)
    saved.reserve(AppliedAcceleration.file_kind)
    result = run(directory, levels, mounting=chosen.mounting, draws=chosen.draws, seed=chosen.seed)
    with saved.writing(result):
        if figure is not None:
            save_figure(
                [relative_plot(result)], figure, FILE_DESCRIPTION, overwrite=saved.overwrite
            )
        if report is not None:
            result.write_report(report, overwrite=saved.overwrite)
        blocks = report_blocks(result) if chosen.budget else result.blocks()
        report_console().print(Report(list(blocks)))
    for path in (report, figure):
        if path is not None:
            print_output(f"Wrote {path}.")

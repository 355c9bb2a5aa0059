"""`counterspin demo`: the paper's plan, simulated and calibrated."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from counterspin.cli.words import OutputFolder, say, shell_word


def demo(
    *,
    output: OutputFolder = Path("counterspin-demo"),
    figure: Literal["svg", "png", "pdf"] = "svg",
    overwrite: bool = False,
) -> None:
    """Simulate and calibrate the paper's plan, and compare each method with the truth.

    Parameters
    ----------
    output
        Folder for the campaign, its records and the figure.
    figure
        Format of the figure.
    overwrite
        Replace an earlier demonstration.
    """
    from counterspin.reports.charts import reserve_figures, save
    from counterspin.reports.text import report_console
    from counterspin.reproduction.demo import demo as run
    from counterspin.reproduction.page import (
        FIGURE,
        demonstration_plots,
        render_demonstration,
    )

    drawn = output / f"displacement.{figure}"
    reserve_figures([drawn], FIGURE, overwrite=overwrite)
    shown = run(output, overwrite=overwrite)
    save(demonstration_plots(shown), drawn, FIGURE, overwrite=overwrite)
    report_console().print(render_demonstration(shown))
    say(
        "",
        f"Wrote campaign.toml, {len(shown.records)} records and {drawn.name} to {output}. Next:",
        f"  counterspin calibrate {shell_word(output)}",
    )

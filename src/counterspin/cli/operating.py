"""`counterspin operating`: operating tests of IEEE Std 1293 from a table."""

from __future__ import annotations

from pathlib import Path

from counterspin.cli.common import (
    NO_RESULT_FILE,
    SaveOptions,
    command,
    option_group,
    print_output,
    require_distinct_files,
)
from counterspin.frozen import frozen


@option_group
@frozen
class TableColumns:
    """Columns and units of the table.

    Parameters
    ----------
    input
        Column of the applied inputs.
    time
        Column of the times since switch-on, in seconds; use it instead of --input for a warm-up
        test.
    input_unit
        Unit of the inputs.
    output_unit
        Unit of the outputs.
    full_scale
        Full scale of the input, in the unit of the inputs; default: the largest input in the table.
    """

    input: str | None = None
    time: str | None = None
    input_unit: str = "g"
    output_unit: str | None = None
    full_scale: float | None = None


_DEFAULT_COLUMNS = TableColumns()


@command
def operating(
    table: Path,
    /,
    *,
    output: str,
    columns: TableColumns = _DEFAULT_COLUMNS,
    report: Path | None = None,
    figure: Path | None = None,
    save_options: SaveOptions = NO_RESULT_FILE,
) -> None:
    """Evaluate linearity, hysteresis, threshold, resolution, dead band or warm-up.

    Parameters
    ----------
    table
        Table of inputs and outputs, or of times and outputs, in the order of recording.
    output
        Column of the outputs.
    report
        Also write a report: .html, .pdf or .md.
    figure
        Plot the deviations from the fitted line, or the warm-up: .svg, .png or .pdf.
    """
    from counterspin.operating_tests.measure import operating as run_operating_tests
    from counterspin.operating_tests.page import FILE_DESCRIPTION, operating_plot
    from counterspin.operating_tests.result import OperatingTests
    from counterspin.output import check_writable, marked_file_type
    from counterspin.reports.charts import require_figure_format, save_figure
    from counterspin.reports.publication import require_report_format
    from counterspin.reports.text import Report, make_console

    require_distinct_files(json=save_options.json, report=report, figure=figure)
    overwrite = save_options.overwrite
    if report is not None:
        require_report_format(report)
        document_type = OperatingTests.report_kind()
        check_writable(report, lambda: marked_file_type(document_type), overwrite=overwrite)
    if figure is not None:
        require_figure_format(figure)
        check_writable(figure, lambda: marked_file_type(FILE_DESCRIPTION), overwrite=overwrite)
    save_options.check_writable(OperatingTests.file_kind)
    result = run_operating_tests(
        table,
        output=output,
        input=columns.input,
        time=columns.time,
        input_unit=columns.input_unit,
        output_unit=columns.output_unit or "",
        full_scale=columns.full_scale,
    )
    with save_options.saving(result):
        if figure is not None:
            save_figure([operating_plot(result)], figure, FILE_DESCRIPTION, overwrite=overwrite)
        if report is not None:
            result.write_report(report, overwrite=overwrite)
        make_console().print(Report(list(result.blocks())))
    for path in (report, figure):
        if path is not None:
            print_output(f"Wrote {path}.")

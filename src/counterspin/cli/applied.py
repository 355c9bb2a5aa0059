"""`counterspin applied`: the uncertainty budget of the applied acceleration."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from counterspin.cli.certificate import NO_SIGNATURE, SigningOptions
from counterspin.cli.common import (
    NO_RESULT_FILE,
    SaveOptions,
    WholeNumber,
    command,
    option_group,
    print_output,
    require_distinct_files,
)
from counterspin.errors import UsageError
from counterspin.frozen import frozen

if TYPE_CHECKING:
    from counterspin.acceleration_standard.result import AppliedAcceleration


@option_group
@frozen
class BudgetOptions:
    """Options of the uncertainty budget.

    Parameters
    ----------
    mounting
        Mounting whose stated alignment is used, if the campaign states several mountings.
    draws
        Number of Monte Carlo draws.
    seed
        Seed of the random number generator.
    budget
        Print the full budget of each level.
    """

    mounting: str | None = None
    draws: WholeNumber = 200_000
    seed: WholeNumber = 1
    budget: bool = False


@option_group
@frozen
class CertificateOptions:
    """Options of the certificate.

    Parameters
    ----------
    lab
        Laboratory data (LAB.toml), in which [item] describes the centrifuge.
    certificate
        Write the certificate to this file: .xml, or .pdf with the XML attached.
    signing
        Validation and signature of the certificate.
    """

    lab: Path | None = None
    certificate: Path | None = None
    signing: SigningOptions = NO_SIGNATURE

    def check(self) -> None:
        """Raise CounterspinError for incomplete options and existing files."""
        if (self.lab is None) != (self.certificate is None):
            raise UsageError("applied", ["give both `certificate` and `lab`, or neither of them"])
        if self.certificate is not None:
            self.signing.check_output(self.certificate)

    def write(self, result: AppliedAcceleration) -> None:
        """Write the certificate, if requested."""
        from counterspin.acceleration_standard.certificate import certify_applied

        if self.lab is not None and self.certificate is not None:
            signing = self.signing
            certificate = certify_applied(
                result, self.lab, schema=signing.schema, signer=signing.signer_reader()
            )
            signing.write(certificate, self.certificate)


_NO_CERTIFICATE = CertificateOptions()
_DEFAULT_BUDGET = BudgetOptions()


@command
def applied(
    directory: Path,
    /,
    *,
    levels: str | None = None,
    budget_options: BudgetOptions = _DEFAULT_BUDGET,
    report: Path | None = None,
    figure: Path | None = None,
    certificate_options: CertificateOptions = _NO_CERTIFICATE,
    save_options: SaveOptions = NO_RESULT_FILE,
) -> None:
    """Calculate the uncertainty budget of the acceleration applied by an arm centrifuge.

    Parameters
    ----------
    directory
        Campaign folder, or its campaign.toml.
    levels
        Accelerations, such as 1,10,50,100g; default: the accelerations at the stated rates.
    report
        Also write a report with the full budgets: .html, .pdf or .md.
    figure
        Plot the relative uncertainty against the level: .svg, .png or .pdf.
    """
    from counterspin.acceleration_standard.budget import applied as compute_budget
    from counterspin.acceleration_standard.page import (
        FILE_DESCRIPTION,
        relative_plot,
        report_blocks,
    )
    from counterspin.acceleration_standard.result import AppliedAcceleration
    from counterspin.output import check_writable, marked_file_type
    from counterspin.reports.charts import require_figure_format, save_figure
    from counterspin.reports.publication import require_report_format
    from counterspin.reports.text import Report, make_console

    require_distinct_files(
        json=save_options.json,
        report=report,
        figure=figure,
        certificate=certificate_options.certificate,
    )
    overwrite = save_options.overwrite
    if report is not None:
        require_report_format(report)
        document_type = AppliedAcceleration.report_kind()
        check_writable(report, lambda: marked_file_type(document_type), overwrite=overwrite)
    if figure is not None:
        require_figure_format(figure)
        check_writable(figure, lambda: marked_file_type(FILE_DESCRIPTION), overwrite=overwrite)
    save_options.check_writable(AppliedAcceleration.file_kind)
    certificate_options.check()
    result = compute_budget(
        directory,
        levels,
        mounting=budget_options.mounting,
        draws=budget_options.draws,
        seed=budget_options.seed,
    )
    with save_options.saving(result):
        certificate_options.write(result)
        if figure is not None:
            save_figure([relative_plot(result)], figure, FILE_DESCRIPTION, overwrite=overwrite)
        if report is not None:
            result.write_report(report, overwrite=overwrite)
        blocks = report_blocks(result) if budget_options.budget else result.blocks()
        make_console().print(Report(list(blocks)))
    for path in (report, figure):
        if path is not None:
            print_output(f"Wrote {path}.")

"""Commands for schemas, the web interface, the demonstration and reference cases."""

from __future__ import annotations

from pathlib import Path
from typing import Final, Literal

from counterspin.cli.common import (
    NO_RESULT_FILE,
    OnOff,
    OutputFolder,
    SaveOptions,
    WholeNumber,
    command,
    print_output,
    quote_path,
)
from counterspin.errors import CounterspinError, MissingPackageError, UsageError, install_command

_MAX_PORT: Final = 65535


@command
def schema(document: Literal["campaign", "plan", "study", "lab", "result", "noise"], /) -> None:
    """Print the JSON Schema (draft 2020-12) of a document, for editors and other programs.

    The schema gives the meaning, the unit and an example of every key. A document names its schema
    in the first line, `#:schema campaign.schema.json`. Editors with TOML support can then explain
    and complete keys, and mark errors. Only counterspin checks conditions that involve several
    keys.

    Parameters
    ----------
    document
        campaign.toml, PLAN.toml, a study file, LAB.toml, or the result of `calibrate --json` or
        `noise --json`.
    """
    from counterspin.schemas import schema_text

    print(schema_text(document), end="")


@command
def install_completion(
    *, shell: Literal["bash", "zsh", "fish", "powershell"] | None = None
) -> None:
    """Install the completion of commands and options in your shell.

    Parameters
    ----------
    shell
        Shell; default: the current shell. counterspin extends its startup file.
    """
    from cyclopts.completion import ShellDetectionError

    from counterspin.cli import app

    try:
        path = app.install_completion(shell=shell)
    except ShellDetectionError as error:
        raise UsageError("--install-completion", ["name the shell with --shell"]) from error
    print_output(f"Wrote {path}. To use the completion, restart the shell.")


@command
def serve(
    directory: Path,
    /,
    *,
    port: WholeNumber = 0,
    browser: OnOff = True,
    signer: str | None = None,
    cert: Path | None = None,
) -> None:
    """Start the local web interface (reachable from this computer only).

    Parameters
    ----------
    directory
        Folder with the campaigns; files outside it are neither read nor written.
    port
        Port to listen on; 0 selects a free port.
    browser
        Open the page in the browser.
    signer
        Command that signs certificates: it reads bytes from standard input and writes their
        signature to standard output, for example with a smart card or token.
    cert
        X.509 certificate (PEM) of the key that the command uses.
    """
    if (signer is None) != (cert is None):
        raise UsageError("serve", ["give both --signer and --cert"])
    if not 0 <= port <= _MAX_PORT:
        raise UsageError("serve", [f"--port: must be from 0 to {_MAX_PORT}, not {port}"])
    try:
        from counterspin.application.server import serve as run_server
    except ModuleNotFoundError as error:
        if error.name not in ("starlette", "uvicorn", "tomlkit"):
            raise
        raise MissingPackageError(
            f"the web interface requires Starlette and uvicorn: {install_command('application')}"
        ) from error
    signing_command = None if signer is None or cert is None else (signer, cert)
    run_server(
        directory, port=port, browser=browser, signing=signing_command, print_line=print_output
    )


@command
def demo(
    *,
    output: OutputFolder = Path("counterspin-demo"),
    figure: Literal["svg", "png", "pdf"] = "svg",
    overwrite: bool = False,
) -> None:
    """Simulate and calibrate the paper's test plan, and compare each method with the true values.

    Parameters
    ----------
    output
        Folder for the campaign, its records and the figure.
    figure
        Format of the figure.
    overwrite
        Replace an earlier demonstration.
    """
    from counterspin.reports.charts import check_figures_writable, save_figure
    from counterspin.reports.text import make_console
    from counterspin.reproduction.demo import demo as run_demo
    from counterspin.reproduction.page import (
        FILE_DESCRIPTION,
        demonstration_plots,
        demonstration_report,
    )

    figure_path = output / f"displacement.{figure}"
    check_figures_writable([figure_path], FILE_DESCRIPTION, overwrite=overwrite)
    demonstration = run_demo(output, overwrite=overwrite)
    save_figure(
        demonstration_plots(demonstration), figure_path, FILE_DESCRIPTION, overwrite=overwrite
    )
    make_console().print(demonstration_report(demonstration))
    print_output(
        "",
        f"Wrote campaign.toml, {len(demonstration.records)} records and "
        f"{figure_path.name} to {output}. Next:",
        f"  counterspin calibrate {quote_path(output)}",
    )


@command
def reproduce(*, save_options: SaveOptions = NO_RESULT_FILE) -> None:
    """Recompute the paper's numbers and explain the differences."""
    from counterspin.reports.text import make_console
    from counterspin.reproduction.comparison import reproduce as run_reproduction
    from counterspin.reproduction.plan import Reproduction

    save_options.check_writable(Reproduction.file_kind)
    reproduction = run_reproduction()
    with save_options.saving(reproduction):
        make_console().print(reproduction)


@command
def validate(*, output: OutputFolder, schema: Path | None = None, overwrite: bool = False) -> None:
    """Run the reference cases on this installation and write a validation report for assessors.

    Parameters
    ----------
    output
        Folder for validation.html, validation.pdf and validation.json.
    schema
        DCC schema (folder or file), to validate a certificate against it as well.
    overwrite
        Replace an earlier validation report; other files are never replaced.
    """
    from counterspin.reports.text import make_console, show_progress
    from counterspin.validation.validate import check_folder, write_dossier
    from counterspin.validation.validate import validate as run_validation

    check_folder(output, overwrite=overwrite)
    with show_progress(labels=("Running cases", "Running cases", "Writing")) as advance:
        dossier = run_validation(schema=schema, progress=advance)
        write_dossier(dossier, output, overwrite=overwrite)
    make_console().print(dossier)
    print_output(f"Wrote {quote_path(output)}")
    if dossier.failed:
        raise CounterspinError(
            f"reference cases failed: {'; '.join(dossier.failed)}", code="validation-failed"
        )
    if not dossier.passed:
        installation = dossier.installation
        file_names_text = ", ".join([*installation.altered, *installation.missing])
        raise CounterspinError(
            f"installed files are altered or missing: {file_names_text}; reinstall counterspin",
            code="installation-altered",
        )

"""The command line of what is made from results: words to calls, nothing else.

- `report`: a result as HTML, PDF, Markdown or in the terminal
- `certificate`: a result as Digital Calibration Certificate
- `history`: results of one instrument over time
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from counterspin.errors import CampaignError, CounterspinError


def report(
    source: Path,
    /,
    *,
    output: Annotated[Path | None, Parameter(name=["--output", "-o"])] = None,
    identifier: str | None = None,
    date: str | None = None,
) -> None:
    """Write the full report of a result: answer, checks, budget, residuals, origin.

    Parameters
    ----------
    source
        Result file, or a campaign's folder or description, which is calibrated first.
    output
        The report: .html, .pdf or .md; without it, the report is printed.
    identifier
        What it is known by; else it follows from the result.
    date
        When it was made, such as 2026-03-01; else SOURCE_DATE_EPOCH or now.
    """
    from counterspin.campaign.result import read_result
    from counterspin.report.document import document
    from counterspin.report.publishing import check_format, issue_date, write_report
    from counterspin.report.text import Report, report_console

    issued = issue_date(date)
    if output is not None:
        check_format(output)
    if source.suffix.lower() == ".json" or (source.is_file() and source.suffix != ".toml"):
        found = read_result(source)
    else:
        from counterspin.commands.calibrate import calibrate
        from counterspin.report.progress import progress

        with progress() as advance:
            found = calibrate(source, progress=advance)
    if output is None:
        report_console().print(Report(document(found)))
        return
    write_report(found, output, identifier=identifier, issued=issued)
    print(f"Wrote {output}.")


def certificate(
    result: Path | None = None,
    lab: Path | None = None,
    /,
    *,
    output: Annotated[Path | None, Parameter(name=["--output", "-o"])] = None,
    schema: Path | None = None,
    key: Path | None = None,
    cert: Path | None = None,
    init: Path | None = None,
    verify: Path | None = None,
) -> None:
    """Write the Digital Calibration Certificate of a result, or check one.

    Parameters
    ----------
    result
        Result that `counterspin calibrate --json` wrote.
    lab
        What the laboratory says: LAB.toml.
    output
        The certificate: .xml, or .pdf with the XML attached (PDF/A-3).
    schema
        Folder or file of the schema of DCC, to validate against.
    key
        Private key (PEM) to sign with, not encrypted.
    cert
        X.509 certificate (PEM): of the key, or with --verify of who must have signed.
    init
        In place of all else: write a commented example of LAB.toml to this file.
    verify
        In place of a result: a certificate, to check it and print its numbers.
    """
    from counterspin.report.certificate.issuing import (
        certificate_blocks,
        check_certificate,
        issue_certificate,
    )
    from counterspin.report.certificate.lab import write_example
    from counterspin.report.text import Report, report_console

    if sum(given is not None for given in (result, init, verify)) != 1:
        raise CampaignError(
            "certificate", ["give RESULT and LAB.toml, or --init LAB.toml, or --verify FILE.xml"]
        )
    if init is not None:
        print(f"Wrote {write_example(init)}. Fill it in; all of it is an example.")
        return
    if verify is not None:
        found = check_certificate(verify, schema=schema, cert=cert)
        report_console().print(Report(list(certificate_blocks(found))))
        print("\nThe signature is valid." if cert is not None else "\nNo signature was checked.")
        return
    if result is None or lab is None or output is None:
        raise CampaignError("certificate", ["give RESULT, LAB.toml, and -o FILE.xml or FILE.pdf"])
    done = issue_certificate(result, lab, output, schema=schema, key=key, cert=cert)
    print(f"Wrote {output}: certificate {done.identifier} of {', '.join(done.accelerometers)}.")
    for note in done.notes:
        print(note)


def history(
    *paths: Path,
    term: str = "K_II",
    serial: str | None = None,
    json: Annotated[Path | None, Parameter(name="--json")] = None,
    figure: Path | None = None,
) -> None:
    """Follow a coefficient of each instrument through its results: drift, and whether they agree.

    Parameters
    ----------
    paths
        Result files, and folders in which all are found.
    term
        The coefficient.
    serial
        Only the instrument with this serial number.
    json
        Write the history to this file too.
    figure
        Draw a control chart of one instrument: .svg, .png or .pdf.
    """
    from counterspin.campaign.output import write_text
    from counterspin.commands.history import history as run
    from counterspin.report.figure import check_format, save
    from counterspin.report.history import history_figure, render_history
    from counterspin.report.text import report_console

    if not paths:
        raise CampaignError("history", ["give result files, or folders that hold them"])
    if figure is not None:
        check_format(figure)
    found = run(paths, term=term, serial=serial)
    report_console().print(render_history(found))
    if json is not None:
        write_text(json, found.to_json())
    if figure is not None:
        save(history_figure(found), figure)
    if found.damaged:
        raise CounterspinError(
            f"{len(found.damaged)} of the files are results that cannot be read; the history is "
            "without them"
        )

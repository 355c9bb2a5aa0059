"""`counterspin validate`: the reference cases, run on what is installed."""

from __future__ import annotations

from pathlib import Path

from counterspin.cli.words import OutputFolder, say, shell_word
from counterspin.errors import CounterspinError


def validate(*, output: OutputFolder, schema: Path | None = None, overwrite: bool = False) -> None:
    """Run the reference cases on this installation and write a dossier for an assessor.

    Parameters
    ----------
    output
        The dossier's folder: validation.html, validation.pdf and validation.json.
    schema
        Folder or file of the DCC schema; a certificate is validated against it too.
    overwrite
        Replace an earlier dossier; other files are never replaced.
    """
    from counterspin.reports.text import progress, report_console
    from counterspin.validation.validate import check_folder, write_dossier
    from counterspin.validation.validate import validate as run

    check_folder(output, overwrite=overwrite)
    with progress(words=("Running cases", "Running cases", "Writing")) as advance:
        dossier = run(schema=schema, progress=advance)
        write_dossier(dossier, output, overwrite=overwrite)
    report_console().print(dossier)
    say(f"Wrote {shell_word(output)}")
    if dossier.failed:
        raise CounterspinError(f"reference cases failed: {'; '.join(dossier.failed)}")
    if not dossier.passed:
        there = dossier.installation
        named = ", ".join([*there.altered, *there.missing])
        raise CounterspinError(
            f"files of the installation are altered or missing: {named}; reinstall counterspin"
        )

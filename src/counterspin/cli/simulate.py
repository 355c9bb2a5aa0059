"""`counterspin simulate`: records and readings of a campaign whose coefficients are known."""

from __future__ import annotations

from pathlib import Path

from counterspin.cli.words import OutputFolder, say


def simulate(campaign: Path, /, *, output: OutputFolder, overwrite: bool = False) -> None:
    """Simulate the records and readings of a campaign with known coefficients.

    Parameters
    ----------
    campaign
        Campaign description with [truth] tables, or its folder.
    output
        Folder for the records, the readings and the description.
    overwrite
        Replace the files of an earlier simulation; other files are never replaced.
    """
    from counterspin.campaign.description import read_campaign
    from counterspin.campaign.questions import questions
    from counterspin.reports.text import progress
    from counterspin.simulation.simulate import simulate as run

    described = read_campaign(campaign)
    with progress(words=("Simulating", "Files", "Files")) as advance:
        written = run(described, output, overwrite=overwrite, progress=advance)
    say(*(f"Warning: {question.text}" for question in questions(described)))
    files = f"{len(written)} {'file' if len(written) == 1 else 'files'} and " if written else ""
    say(f"Wrote {files}campaign.toml to {output}.")

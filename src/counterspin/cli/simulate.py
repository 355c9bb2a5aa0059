"""`counterspin simulate`: records of a campaign whose coefficients are known."""

from __future__ import annotations

from pathlib import Path

from counterspin.cli.words import OutputFolder, say


def simulate(campaign: Path, /, *, output: OutputFolder, overwrite: bool = False) -> None:
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
    from counterspin.campaign.simulation import simulate as run

    written = run(campaign, output, overwrite=overwrite)
    say(f"Wrote {len(written)} records and campaign.toml to {output}.")

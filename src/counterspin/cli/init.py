"""`counterspin init`: a commented campaign to start from."""

from __future__ import annotations

from pathlib import Path

from counterspin.campaign.starter import Test
from counterspin.cli.words import say, shell_word


def init(directory: Path, /, *, test: Test = "double-turntable") -> None:
    """Write a commented example campaign to start from.

    Parameters
    ----------
    directory
        Folder for campaign.toml; made if it is not there.
    test
        Kind of test: records of a double turntable, readings of a multi-position tumble, or
        readings on the arm of a centrifuge.
    """
    from counterspin.campaign.starter import init as run

    written = run(directory, test)
    say(
        f"Wrote {written}. Edit it, or try it:",
        f"  counterspin simulate {shell_word(written)} -o {shell_word(directory / 'simulated')}",
        f"  counterspin calibrate {shell_word(directory / 'simulated')}",
    )

"""A folder as `counterspin serve` finds it: a campaign, its records and its results."""

from pathlib import Path

from campaigns import SMALL, write

from counterspin.calibration.calibrate import calibrate
from counterspin.campaign.simulation import simulate

#: Shorter than the other tests' campaign: nobody asks here what comes out.
SHORT = (
    SMALL.replace("revolutions = 20", "revolutions = 6")
    .replace("[site]", '[campaign]\ndate = "2026-01-12"\n\n[site]')
    .replace("[accelerometers.Qx]", '[accelerometers.Qx]\nserial_number = "17"')
)

#: What a recorder's files do not say.
ANSWERS = {"gravity": "9.8066 m/s^2", "latitude": "45.75 deg", "radius": "2.5 m"}


def write_folder(folder: Path, plan: Path) -> Path:
    """Write a campaign, "three", its records and its result; return the folder.

    Parameters
    ----------
    folder
        What is served.
    plan
        Another folder, which takes what is simulated.
    """
    simulate(write(plan, SHORT, "plan.toml"), folder / "three")
    calibrate(folder / "three").write(folder / "three" / "result.json")
    return folder

"""Small campaigns for the tests of commands, written and read back as a user would."""

import re
from collections.abc import Sequence
from pathlib import Path

from counterspin.campaign.description import read_campaign

#: Where a campaign takes place, on what, and the columns of its records.
PLACE = """
schema = 1

[site]
gravity = "9.8066 m/s^2"
latitude = "45.75 deg"

[centrifuge]
radius = "2.5 m"

[records]
time = { column = "time_s", unit = "s" }
angle = { column = "angle_rad", unit = "rad" }
"""


def format_runs(*names: str, rates: Sequence[str] = ("0.25 rev/s", "0.5 rev/s", "1 rev/s")) -> str:
    """Return [[runs]] with these names and rates; each record has the name of its run."""
    return "".join(
        f'\n[[runs]]\nname = "{name}"\nrate = "{rate}"\nrecord = "{name}.csv"\n'
        for name, rate in zip(names, rates, strict=True)
    )


def find_runs(campaign, *names):
    """Return the entries of some runs in a campaign's description."""
    return [run for run in campaign.source.document["runs"] if run["name"] in names]


#: The merge patch that leaves Qx alone.
WITHOUT_QY = {"accelerometers": {"Qy": None}, "truth": {"Qy": None}}


SMALL = f"""{PLACE}
[accelerometers.Qx]
input_axis = "east"
pendulous_axis = "down"
scale_factor = "1.002 g/g"
displacement = {{ column = "east_m", unit = "m" }}

[accelerometers.Qy]
input_axis = "north"
pendulous_axis = "down"
scale_factor = "0.999 g/g"
displacement = {{ column = "north_m", unit = "m" }}

[noise]
displacement = "0.01 m"

[model]
assume = "all"

{format_runs("slow", "middle", "fast")}
[simulation]
sampling_rate = "20 Hz"
seed = 1
revolutions = 20

[truth.Qx]
K_F = "0.005 g"
K_I = "1.002 g/g"
K_II = "2.7e-5 g/g^2"
K_III = "3e-6 g/g^3"
start_offset = "0.02 m"
start_velocity = "-1e-3 m/s"

[truth.Qy]
K_F = "-0.003 g"
K_I = "0.999 g/g"
K_II = "-3.2e-5 g/g^2"

[truth.spindle]
drift = "1e-6 1/s"
ripple = [{{ harmonic = 1, ratio = 1e-5, phase = "30 deg" }}]

[truth.noise]
displacement = "0.01 m"
angle = "1e-6 rad"
"""


def replace_parts(text: str, *pairs: tuple[str, str]) -> str:
    """Return a description with existing pieces of text replaced."""
    for old, new in pairs:
        assert old in text, old
        text = text.replace(old, new)
    return text


def remove_table(text: str, table: str) -> str:
    """Return a description without a table."""
    pattern = rf"(?ms)^\[{re.escape(table)}\]\n.*?(?=^\[|\Z)"
    assert re.search(pattern, text)
    return re.sub(pattern, "", text)


def write_description(folder: Path, text: str, name: str = "campaign.toml") -> Path:
    """Write a description and return its path."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def write_and_read_campaign(folder: Path, text: str):
    """Write and read a description."""
    return read_campaign(write_description(folder, text))

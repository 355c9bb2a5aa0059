"""Records of a simulated campaign in the export formats of different recorders.

- `campaign_folder`: simulates the campaign, as plain CSV
- `EXPORTS`: name -> what writes a run's record, and what [records] says of it
- `write_export`: a folder with the records of one make
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import polars as pl
from campaigns import PLACE, format_runs, replace_parts, write_description
from nptdms import ChannelObject, TdmsWriter
from scipy.io import savemat
from workbooks import write_workbook

from counterspin.simulation.simulate import simulate

RUNS = {"slow": "0.5 rev/s", "fast": "1 rev/s"}

INSTRUMENT = """
[accelerometers.Qx]
input_axis = "east"
pendulous_axis = "down"
bias = "0.005 ± 1e-5 g"
scale_factor = "1.002 ± 1e-5 g/g"
displacement = { column = "east_m", unit = "m" }

[noise]
displacement = "0.01 m"
"""

TRUTH = """
[simulation]
sampling_rate = "20 Hz"
revolutions = 20

[truth.Qx]
K_F = "0.005 g"
K_I = "1.002 g/g"
K_II = "2.7e-5 g/g^2"

[truth.spindle]
drift = "1e-6 1/s"
"""


def simulate_campaign(folder: Path) -> Path:
    text = f"{PLACE}{INSTRUMENT}{format_runs(*RUNS, rates=list(RUNS.values()))}{TRUTH}"
    simulate(write_description(folder, text, "plan.toml"), folder / "plain")
    return folder / "plain"


def _numbers(frame: pl.DataFrame, mark: str) -> list[list[str]]:
    return [[repr(float(x)).replace(".", mark) for x in row] for row in frame.rows()]


def _labview(frame: pl.DataFrame, path: Path) -> None:
    """Write a German LabVIEW file: metadata lines, tabs, decimal commas, trailing delimiter."""
    head = ["Messung 12", "Datum:\t22.11.2026", "Prüfstand:\t3", "", "Kanäle:\t2"]
    rows = ["\t".join([*frame.columns, ""])]
    rows += ["\t".join([*row, ""]) for row in _numbers(frame, ",")]
    path.write_text("\r\n".join([*head, *rows]) + "\r\n", encoding="latin-1")


def _units_row(frame: pl.DataFrame, path: Path) -> None:
    frame = frame.with_columns(pl.col("time_s") * 1000)
    rows = [";".join(row) for row in _numbers(frame, ".")]
    path.write_text("\n".join([";".join(frame.columns), "[ms];[rad];[m]", *rows]) + "\n")


def _stamps(frame: pl.DataFrame, path: Path) -> None:
    begun = np.datetime64("2026-03-01T23:59:58", "ns")
    after = [np.timedelta64(round(t * 1e9), "ns") for t in frame["time_s"]]
    stamps = [f"{begun + t}Z".replace("T", " ") for t in after]
    frame.with_columns(time_s=pl.Series(stamps)).write_csv(path)


def _clockwise(frame: pl.DataFrame, path: Path) -> None:
    angle = (90.0 - np.degrees(frame["angle_rad"].to_numpy())) % 360.0
    frame.with_columns(angle_rad=pl.Series(angle)).write_csv(path)


def _counts(frame: pl.DataFrame, path: Path) -> None:
    counts = np.round(frame["angle_rad"].to_numpy() / (2 * np.pi) * 2**24).astype(int) % 2**24
    frame.with_columns(angle_rad=pl.Series(counts)).write_csv(path)


def compute_pulse_times(frame: pl.DataFrame) -> np.ndarray:
    angle, time = frame["angle_rad"].to_numpy(), frame["time_s"].to_numpy()
    turns = np.arange(np.ceil(angle[0] / (2 * np.pi)), angle[-1] / (2 * np.pi) + 1e-9)
    return np.interp(2 * np.pi * turns, angle, time)


def _pulses(frame: pl.DataFrame, path: Path) -> None:
    pulses = compute_pulse_times(frame)
    column = [*pulses, *[None] * (frame.height - len(pulses))]
    frame.drop("angle_rad").with_columns(index=pl.Series(column)).write_csv(path)


def _excel(frame: pl.DataFrame, path: Path) -> None:
    head = [["Test 12", None, None], [None] * 3, [*frame.columns], ["s", "rad", "m"]]
    write_workbook(path, {"About": [["by nobody"]], "Run": [*head, *map(list, frame.rows())]})


def _tdms(frame: pl.DataFrame, path: Path) -> None:
    channels = [
        ChannelObject("Measurement", name, frame[name].to_numpy(), {"unit_string": unit})
        for name, unit in zip(frame.columns, ("s", "rad", "m"), strict=True)
    ]
    other = ChannelObject("Events", "time_s", np.array([1.0]))
    with TdmsWriter(path) as file:
        file.write_segment([*channels, other])


def _matlab(frame: pl.DataFrame, path: Path) -> None:
    data = {name: frame[name].to_numpy() for name in frame.columns}
    savemat(path, {"run1": {"about": "a test", "data": data}, "comment": "text"})


def _hdf5(frame: pl.DataFrame, path: Path) -> None:
    with h5py.File(path, "w") as file:
        file["about/version"] = 3
        for name in frame.columns:
            file[f"run1/data/{name}"] = frame[name].to_numpy()


@dataclass(frozen=True)
class Export:
    write: Callable[[pl.DataFrame, Path], None]
    time: str = '{ column = "time_s", unit = "s" }'
    angle: str = '{ column = "angle_rad", unit = "rad" }'
    other: str = ""
    ending: str = ".csv"


EXPORTS = {
    "labview": Export(_labview, ending=".txt"),
    "units row": Export(_units_row, '{ column = "time_s" }', '{ column = "angle_rad" }'),
    "time stamps": Export(_stamps, '{ column = "time_s", unit = "iso" }'),
    "excel": Export(_excel, other='sheet = "Run"', ending=".xlsx"),
    "tdms": Export(
        _tdms,
        '{ column = "time_s" }',
        '{ column = "angle_rad" }',
        other='group = "Measurement"',
        ending=".tdms",
    ),
    "matlab": Export(_matlab, other='group = "run1.data"', ending=".mat"),
    "hdf5": Export(_hdf5, other='group = "run1/data"', ending=".h5"),
    "clockwise from north": Export(
        _clockwise,
        angle='{ column = "angle_rad", unit = "deg", sense = "clockwise", zero = "north" }',
    ),
    "encoder counts": Export(
        _counts, angle='{ column = "angle_rad", unit = "count", per_revolution = 16777216 }'
    ),
    "pulse": Export(_pulses, angle='{ column = "index", unit = "s", pulses = true }'),
    "sampling rate": Export(
        lambda frame, path: frame.drop("time_s").write_csv(path), '{ sampling_rate = "20 Hz" }'
    ),
}


def write_records(plain: Path, folder: Path, export: Export) -> list[Path]:
    folder.mkdir(exist_ok=True)
    paths = []
    for name in RUNS:
        paths.append(folder / f"{name}{export.ending}")
        export.write(pl.read_csv(plain / f"{name}.csv"), paths[-1])
    return paths


def write_export(plain: Path, folder: Path, export: Export) -> Path:
    write_records(plain, folder, export)
    records_section = replace_parts(
        PLACE,
        ('time = { column = "time_s", unit = "s" }', f"time = {export.time}\n{export.other}"),
        ('angle = { column = "angle_rad", unit = "rad" }', f"angle = {export.angle}"),
    )
    runs = format_runs(*RUNS, rates=list(RUNS.values())).replace(".csv", export.ending)
    return write_description(folder, f"{records_section}{INSTRUMENT}{runs}", "campaign.toml")

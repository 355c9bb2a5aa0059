"""Time calibrations against the number of accelerometers, runs, readings and poses.

    python benchmarks/sizes.py          # a few seconds for each quantity
    python benchmarks/sizes.py --full   # 60 accelerometers, 300 runs, 10,000 readings and poses

Times are for whole processes that print the result and write the JSON file. The order of growth is
the slope, on logarithmic scales, of the processor time minus that of the smallest campaign.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import polars as pl

from header import EAST, HEAD
from make_campaign import NOISE, RATES, displacement
from process import COUNTERSPIN, measure_interleaved
from table import Cell, Table, run_script

NOISE_SECTION = '\n[noise]\ndisplacement = "0.01 m"\n'
SITE_SECTION = 'schema = 1\nsite = { gravity = "9.8066 m/s^2", latitude = "45.75 deg" }\n'
AXIS_SECTIONS = "\n".join(
    f'[accelerometers.{name}]\ninput_axis = "{axis}"\npendulous_axis = "{pendulous}"\n'
    'grade = "consumer"\noutput = { unit = "m/s^2", sensitivity = "9.8066 m/s^2/g" }\n'
    for name, axis, pendulous in (("X", "east", "north"), ("Y", "north", "up"), ("Z", "up", "east"))
)


def write_records(folder: Path, n_accelerometers: int, n_runs: int, n_rows: int) -> None:
    """Write records of several accelerometers, 0.1 s between rows."""
    rng = np.random.default_rng(2)
    column_names = [f"east{k}_m" for k in range(n_accelerometers)]
    text = HEAD.format(title="Sizes") + NOISE_SECTION
    for k, column in enumerate(column_names):
        text += EAST.replace("Qx", f"Q{k}").replace("east_m", column)
    time = np.arange(n_rows) * 0.1
    for run in range(n_runs):
        rate = RATES[run % 3] * (1.0 + 0.01 * (run // 3))
        columns = {
            "time_s": time,
            "angle_rad": rate * time + 1e-6 * rng.standard_normal(n_rows),
        }
        for column in column_names:
            columns[column] = displacement(time, rate) + NOISE * rng.standard_normal(n_rows)
        pl.DataFrame(columns).write_csv(folder / f"run{run}.csv", float_precision=9)
        text += f'\n[[runs]]\nname = "run{run}"\nrate = "{rate!r} rad/s"\nrecord = "run{run}.csv"\n'
    (folder / "campaign.toml").write_text(text, encoding="utf-8")


def write_readings(folder: Path, n_readings: int) -> None:
    """Write a tumble test with many positions."""
    angle = np.arange(n_readings) * 360.0 / n_readings
    cos, sin = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    readings = 0.002 + 1.001 * cos + 1e-5 * sin
    readings += 2e-6 * np.random.default_rng(1).standard_normal(n_readings)
    table = pl.DataFrame({"angle": angle, "reading": readings, "u": np.full(n_readings, 2e-6)})
    table.write_csv(folder / "readings.csv")
    (folder / "campaign.toml").write_text(
        f'{SITE_SECTION}[accelerometers.A]\ninput_axis = "up"\npendulous_axis = "west"\n'
        '[model]\nterms = ["K_F", "K_I", "delta_O"]\n[readings]\nfile = "readings.csv"\n'
        'columns = { attitude = "angle", reading = "reading", u = "u" }\nabout = "north"\n',
        encoding="utf-8",
    )


def write_poses(folder: Path, n_poses: int) -> None:
    """Write a table of poses of a triad at unknown attitudes."""
    rng = np.random.default_rng(1)
    directions = rng.normal(size=(n_poses, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    matrix = np.array([[1.004, 0.0, 0.0], [0.002, 0.997, 0.0], [-0.003, 0.001, 1.006]])
    readings = directions @ matrix.T + [0.010, -0.020, 0.035]
    readings = 9.8066 * (readings + 1e-4 * rng.normal(size=readings.shape))
    pl.DataFrame(dict(zip("xyz", readings.T, strict=True))).write_csv(folder / "poses.csv")
    (folder / "campaign.toml").write_text(
        f'{SITE_SECTION}{AXIS_SECTIONS}[triad]\naccelerometers = ["X", "Y", "Z"]\n'
        '[readings]\nfile = "poses.csv"\nattitude = "unknown"\n'
        'columns = { reading = { X = "x", Y = "y", Z = "z" } }\n',
        encoding="utf-8",
    )


def tables(full: bool = False, repeats: int | None = None) -> list[Table]:
    """Return the table of campaigns of several sizes."""
    writers: dict[str, tuple[Callable[[Path, int], None], tuple[int, ...]]] = {
        "accelerometers": (lambda f, n: write_records(f, n, 3, 1000), (3, 12, 30, 60)),
        "runs": (lambda f, n: write_records(f, 1, n, 600), (3, 30, 100, 300)),
        "readings": (write_readings, (100, 1_000, 10_000)),
        "poses": (write_poses, (100, 1_000, 10_000)),
    }
    rows: list[list[Cell]] = []
    for quantity, (write, sizes) in writers.items():
        selected_sizes = sizes if full else sizes[:2]
        with tempfile.TemporaryDirectory() as parent:
            commands = {}
            for size in selected_sizes:
                folder = Path(parent) / str(size)
                folder.mkdir()
                write(folder, size)
                output_options = ["--json", str(folder / "result.json"), "--overwrite"]
                commands[str(size)] = [*COUNTERSPIN, "calibrate", str(folder), *output_options]
            measurements = measure_interleaved(commands, repeats or 3)
        smallest_time = measurements[str(selected_sizes[0])].cpu_time
        previous: tuple[int, float] | None = None
        for size in selected_sizes:
            measurement = measurements[str(size)]
            growth = measurement.cpu_time - smallest_time
            order = None
            if previous and growth > 0.0:
                order = math.log(growth / previous[1]) / math.log(size / previous[0])
            rows.append(
                [
                    f"{size} {quantity}",
                    measurement.fastest,
                    measurement.cpu_time,
                    measurement.peak_memory,
                    order,
                ]
            )
            previous = (size, growth) if growth > 0.0 else None
    remark = (
        "Times are for a whole process, and are the fastest of three repetitions. The process "
        "reads and fits the data, performs the checks, prints the result and writes the JSON "
        "file. The order describes the growth of the processor time in excess of that for the "
        "smallest campaign."
    )
    columns = ["campaign", "fastest (s)", "processor (s)", "memory (MB)", "order of growth"]
    return [Table("Sizes of a calibration", remark, columns, rows)]


if __name__ == "__main__":
    run_script(__doc__.splitlines()[0], tables)

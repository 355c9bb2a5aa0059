"""Growth of a calibration with accelerometers, runs, readings and poses.

    python benchmarks/sizes.py          # a few seconds for each kind
    python benchmarks/sizes.py --full   # 60 accelerometers, 300 runs, 10,000 readings and poses

Whole processes with their printed result and JSON file. The order of growth is the slope of the
processor time, less that of the smallest campaign, on logarithmic scales.
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
from process import COUNTERSPIN, interleaved
from table import Cell, Table, script

NOISE_TABLE = '\n[noise]\ndisplacement = "0.01 m"\n'
SITE = 'schema = 1\nsite = { gravity = "9.8066 m/s^2", latitude = "45.75 deg" }\n'
AXES = "\n".join(
    f'[accelerometers.{name}]\ninput_axis = "{axis}"\npendulous_axis = "{pendulous}"\n'
    'grade = "consumer"\noutput = { unit = "m/s^2", sensitivity = "9.8066 m/s^2/g" }\n'
    for name, axis, pendulous in (("X", "east", "north"), ("Y", "north", "up"), ("Z", "up", "east"))
)


def write_records(folder: Path, accelerometers: int, runs: int, rows: int) -> None:
    """Write records of several accelerometers, 0.1 s between rows."""
    generator = np.random.default_rng(2)
    names = [f"east{k}_m" for k in range(accelerometers)]
    text = HEAD.format(title="Sizes") + NOISE_TABLE
    for k, name in enumerate(names):
        text += EAST.replace("Qx", f"Q{k}").replace("east_m", name)
    time = np.arange(rows) * 0.1
    for run in range(runs):
        rate = RATES[run % 3] * (1.0 + 0.01 * (run // 3))
        columns = {
            "time_s": time,
            "angle_rad": rate * time + 1e-6 * generator.standard_normal(rows),
        }
        for name in names:
            columns[name] = displacement(time, rate) + NOISE * generator.standard_normal(rows)
        pl.DataFrame(columns).write_csv(folder / f"run{run}.csv", float_precision=9)
        text += f'\n[[runs]]\nname = "run{run}"\nrate = "{rate!r} rad/s"\nrecord = "run{run}.csv"\n'
    (folder / "campaign.toml").write_text(text, encoding="utf-8")


def write_readings(folder: Path, count: int) -> None:
    """Write a tumble with many positions."""
    angle = np.arange(count) * 360.0 / count
    cos, sin = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    value = 0.002 + 1.001 * cos + 1e-5 * sin
    value += 2e-6 * np.random.default_rng(1).standard_normal(count)
    table = pl.DataFrame({"angle": angle, "reading": value, "u": np.full(count, 2e-6)})
    table.write_csv(folder / "readings.csv")
    (folder / "campaign.toml").write_text(
        f'{SITE}[accelerometers.A]\ninput_axis = "up"\npendulous_axis = "west"\n'
        '[model]\nterms = ["K_F", "K_I", "delta_O"]\n[readings]\nfile = "readings.csv"\n'
        'columns = { attitude = "angle", reading = "reading", u = "u" }\nabout = "north"\n',
        encoding="utf-8",
    )


def write_poses(folder: Path, count: int) -> None:
    """Write a table of poses of a triad at unknown attitudes."""
    generator = np.random.default_rng(1)
    direction = generator.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    matrix = np.array([[1.004, 0.0, 0.0], [0.002, 0.997, 0.0], [-0.003, 0.001, 1.006]])
    value = direction @ matrix.T + [0.010, -0.020, 0.035]
    value = 9.8066 * (value + 1e-4 * generator.normal(size=value.shape))
    pl.DataFrame(dict(zip("xyz", value.T, strict=True))).write_csv(folder / "poses.csv")
    (folder / "campaign.toml").write_text(
        f'{SITE}{AXES}[triad]\naccelerometers = ["X", "Y", "Z"]\n[readings]\nfile = "poses.csv"\n'
        'attitude = "unknown"\ncolumns = { reading = { X = "x", Y = "y", Z = "z" } }\n',
        encoding="utf-8",
    )


def tables(full: bool = False, repeats: int | None = None) -> list[Table]:
    """Time campaigns of several sizes."""
    kinds: dict[str, tuple[Callable[[Path, int], None], tuple[int, ...]]] = {
        "accelerometers": (lambda f, n: write_records(f, n, 3, 1000), (3, 12, 30, 60)),
        "runs": (lambda f, n: write_records(f, 1, n, 600), (3, 30, 100, 300)),
        "readings": (write_readings, (100, 1_000, 10_000)),
        "poses": (write_poses, (100, 1_000, 10_000)),
    }
    rows: list[list[Cell]] = []
    for kind, (write, sizes) in kinds.items():
        chosen = sizes if full else sizes[:2]
        with tempfile.TemporaryDirectory() as name:
            commands = {}
            for size in chosen:
                folder = Path(name) / str(size)
                folder.mkdir()
                write(folder, size)
                saved = ["--json", str(folder / "result.json"), "--overwrite"]
                commands[str(size)] = [*COUNTERSPIN, "calibrate", str(folder), *saved]
            found = interleaved(commands, repeats or 3)
        least = found[str(chosen[0])].cpu
        before: tuple[int, float] | None = None
        for size in chosen:
            measured = found[str(size)]
            growth = measured.cpu - least
            order = None
            if before and growth > 0.0:
                order = math.log(growth / before[1]) / math.log(size / before[0])
            rows.append([f"{size} {kind}", measured.fastest, measured.cpu, measured.peak, order])
            before = (size, growth) if growth > 0.0 else None
    remark = (
        "Times are for a whole process, and are the fastest of three repetitions. The process "
        "reads and fits the data, performs the checks, prints the result and writes the JSON "
        "file. The order describes the growth of the processor time in excess of that for the "
        "smallest campaign."
    )
    columns = ["campaign", "fastest (s)", "processor (s)", "memory (MB)", "order of growth"]
    return [Table("Sizes of a calibration", remark, columns, rows)]


if __name__ == "__main__":
    script(__doc__.splitlines()[0], tables)

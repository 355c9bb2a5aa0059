"""Make a campaign of long records: three rates of 400 s each, one accelerometer, known truth.

    python benchmarks/make_campaign.py FOLDER ROWS .parquet

At constant rate, the displacement has a closed form (docs/physics.md), so the records are
independent of the tested package. They are written in chunks.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np
import polars as pl

from header import EAST, header

GRAVITY, EARTH_UP = 9.8066, 7.292115e-5 * math.sin(math.radians(45.75))
RADIUS, DURATION = 2.5, 400.0
RATES = (math.pi / 2, math.pi, 2 * math.pi)
TRUTH = {"K_F": 0.0050312, "K_I": 1.0019732, "K_II": 2e-5, "K_III": 3e-6}
COLUMNS = ("time_s", "angle_rad", "east_m")
NOISE = 0.01  # m, of a sample
ANGLE_NOISE = 1e-6  # rad
CHUNK_SIZE = 1_000_000  # rows

DESCRIPTION = (
    header("Long records", EAST)
    + """
[noise]
displacement = "0.01 m"
"""
)

RUN = """
[[runs]]
name = "{name}"
rate = "{rate!r} rad/s"
record = "{name}{suffix}"
"""


def displacement(t: np.ndarray, rate: float) -> np.ndarray:
    """Return the noiseless recorded displacement to the east, m: Eq. 7, integrated twice."""
    # Centripetal and Coriolis acceleration both point inward.
    force = (RADIUS * rate**2 + 2 * EARTH_UP * RADIUS * rate) / GRAVITY
    constant = 0.5 * t**2
    first, second, third = ((1 - np.cos(n * rate * t)) / (n * rate) ** 2 for n in (1, 2, 3))
    acceleration_error = (
        TRUTH["K_F"] * constant
        - (TRUTH["K_I"] - 1) * force * first
        + TRUTH["K_II"] * force**2 * 0.5 * (constant + second)
        - TRUTH["K_III"] * force**3 * 0.25 * (3 * first + third)
    )
    return RADIUS * np.cos(rate * t) + GRAVITY * acceleration_error


def write_campaign(folder: Path, n_rows: int, suffix: str) -> None:
    """Write the description and three records, with `n_rows` rows in total."""
    folder.mkdir(parents=True, exist_ok=True)
    runs = [RUN.format(name=f"run{n}", rate=rate, suffix=suffix) for n, rate in enumerate(RATES)]
    (folder / "campaign.toml").write_text(DESCRIPTION + "".join(runs), encoding="utf-8")
    for n, rate in enumerate(RATES):
        write_record(folder / f"run{n}{suffix}", rate, n_rows // len(RATES), seed=n)


def write_record(path: Path, rate: float, n_rows: int, seed: int) -> None:
    """Write one record; the suffix of the path selects the file type."""
    rng = np.random.default_rng(seed)
    chunk_files = []
    for start in range(0, n_rows, CHUNK_SIZE):
        time = np.arange(start, min(start + CHUNK_SIZE, n_rows)) * (DURATION / n_rows)
        angle = rate * time + ANGLE_NOISE * rng.standard_normal(time.size)
        east = displacement(time, rate) + NOISE * rng.standard_normal(time.size)
        frame = pl.DataFrame(dict(zip(COLUMNS, (time, angle, east), strict=True)))
        if path.suffix == ".csv":
            with path.open("ab") as file:
                # Nanoseconds, nanoradians, nanometres.
                frame.write_csv(file, float_precision=9, include_header=start == 0)
        else:
            chunk_files.append(path.with_name(f"{path.stem}-{start}.parquet"))
            frame.write_parquet(chunk_files[-1])
    if chunk_files:
        pl.scan_parquet(chunk_files).sink_parquet(path)
        for chunk_file in chunk_files:
            chunk_file.unlink()


if __name__ == "__main__":
    write_campaign(Path(sys.argv[1]), int(float(sys.argv[2])), sys.argv[3])

"""Records of a rotating accelerometer, their files, and the results of reading them."""

import math
from pathlib import Path

import h5py
import numpy as np
import polars as pl
import pytest
from scipy.io import savemat

from counterspin.errors import RecordError
from counterspin.records.reading import read_record
from counterspin.records.record import ColumnSpec, NominalMotion, Record, RecordColumns
from counterspin.records.signals import FirstHarmonic

RATE = math.pi
RADIUS = 2.5
TIME, ANGLE, SIGNAL = "time_s", "angle_rad", "east_m"


def simulate_columns(
    n: int = 1000, step: float = 0.02, rate: float = RATE, seed: int = 1, noise: float = 0.01
) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    time = np.round(np.arange(n) * step, 9)
    angle = rate * time + 1e-6 * rng.standard_normal(n)
    signal = RADIUS * np.cos(rate * time) + 1e-3 * time**2 + noise * rng.standard_normal(n)
    return {TIME: time, ANGLE: angle, SIGNAL: signal}


def format_lines(columns: dict[str, np.ndarray], separator: str = ",") -> list[str]:
    rows = zip(*columns.values(), strict=True)
    return [separator.join(columns)] + [separator.join(repr(float(x)) for x in row) for row in rows]


def write_record(path: Path, columns: dict[str, np.ndarray] | list[str]) -> Path:
    if path.suffix == ".parquet":
        pl.DataFrame(columns).write_parquet(path)
    elif path.suffix == ".mat":
        savemat(path, columns, do_compression=True)
    elif path.suffix == ".h5":
        with h5py.File(path, "w") as file:
            for name, values in columns.items():
                file[name] = values
    else:
        text = columns if isinstance(columns, list) else format_lines(columns)
        path.write_text("\n".join(text) + "\n", encoding="utf-8")
    return path


def read_written_record(path: Path, rate: float = RATE, block="auto", **changed) -> Record:
    columns = {
        "time": ColumnSpec(TIME),
        "angle": ColumnSpec(ANGLE),
        "signals": {"Qx": ColumnSpec(SIGNAL)},
    }
    signals = changed.pop("swings", {"Qx": FirstHarmonic(RADIUS, "m")})
    motion = NominalMotion(rate, signals)
    return read_record(path, RecordColumns(**columns | changed), motion, block=block)


def read_error_message(path: Path, **options) -> str:
    with pytest.raises(RecordError) as caught:
        read_written_record(path, **options)
    # A long name is shortened.
    assert path.name[:50] in str(caught.value)
    return str(caught.value)


def make_dense_columns(n: int = 300_000) -> dict[str, np.ndarray]:
    return simulate_columns(n=n, step=2 / (64 * 50.5))  # 50 samples to a block
